"""How a doubted motion of an arm that vibrates is stopped: back on a smooth path."""

from __future__ import annotations

import numpy as np
import pytest

from stiffopt.control.motion_watch import Doubt
from test_controller import BAR, HANGING, Bench, moving

pytestmark = pytest.mark.usefixtures("compiled")


def test_a_doubted_motion_stops_without_a_swing():
    """Twice less at least than if the commands just stay."""
    swings = []
    for stops in (True, False):
        bench = moving(rested=3.0, moved=0.35)
        steered = bench.controller._arm.watch
        steered.doubt = Doubt("no-response", "made up")
        for _ in range(80 if stops else 0):
            before = bench.command
            stopping = bench.controller.stop(bench.rig.clock.now())
            if stopping is None:
                break
            bench.command = stopping
            bench.run(bench.period, steer=False)
            assert np.all(np.abs(bench.command - before) <= bench.slew * bench.period + 1e-3)
        bench.run(0.2, steer=False)
        tips = []
        for _ in range(60):
            bench.run(bench.period, steer=False)
            tips.append(bench.tip[:3, 3].copy())
        swings.append(np.linalg.norm(np.ptp(np.array(tips), axis=0)))
    assert swings[0] < 0.5 * swings[1]


@pytest.mark.parametrize("is_of_arm", [False, True])
def test_what_feedback_added_is_taken_back_without_a_swing(is_of_arm):
    """It stays if only the arm is doubted."""
    bench = Bench(HANGING, "full")
    bench.settled(duration=4.0)
    controller = bench.controller
    more = np.array([0.3, 0.0, 0.0, 0.2, 0.0, 0.0]) * BAR
    path, added = controller._way_back._places[0]
    controller._way_back._places[0] = path, added + more
    offset = controller._arm.pressures.command_offset
    now_added = bench.command - (controller._reference.command - offset)
    back = path[: bench.n] - offset + (now_added if is_of_arm else added + more)
    controller._arm.watch.doubt = Doubt("slip", "made up", is_of_arm=is_of_arm)
    tips = []
    for _ in range(200):
        stopping = controller.stop(bench.rig.clock.now())
        bench.command = bench.command if stopping is None else stopping
        bench.run(bench.period, steer=False)
        tips.append(bench.tip[:3, 3].copy())
    way, swing = np.linalg.norm(tips[-1] - tips[0]), np.linalg.norm(np.ptp(tips[100:], axis=0))
    assert swing < max(0.2 * way, 5e-4)
    assert stopping is None
    assert bench.command == pytest.approx(back, abs=0.06 * BAR)


def test_a_channel_that_acts_the_wrong_way_stops_at_the_pressure_at_which_it_followed():
    bench = moving(rested=3.0, moved=0.3)
    channels = bench.controller._arm.channels
    followed = float(channels.last_followed[1])
    channels.opposed = np.arange(bench.n) == 1
    for _ in range(20):
        bench.command = bench.controller.stop(bench.rig.clock.now())
        bench.run(bench.period, steer=False)
        channels.opposed = np.arange(bench.n) == 1
        channels._followed[2, 1] = followed
    assert bench.command[1] == pytest.approx(followed, abs=1.0)
