"""Holds that the loop enters by itself end in letting down; how an arm is let down past a scene."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from conftest import use_compiler
from simulated_loop import TASK, Lab
from stiffopt.control.arming import late_ticks
from stiffopt.control.interface import Notice
from stiffopt.control.state import State
from stiffopt.control.ways import ClearanceWatch
from stiffopt.errors import InputError
from stiffopt.model.manipulator import load_robot
from stiffopt.model.scene import Scene
from stiffopt.optimise.target import Target
from stiffopt.rig.settings import Safety
from stiffopt.safety.realtime import load_of_processors

DOUBT = (Notice("drift", "the tip seems to move on", standing=True, hold=True),)
TIMEOUT = 0.5  # s
Array = NDArray[np.float64]


def lab(**safety: object) -> Lab:
    return Lab(safety={"hold_timeout": TIMEOUT, "ramp_time": 0.2, **safety}).under_pressure()


def test_without_an_answer_of_the_solver_it_is_held_and_then_let_down() -> None:
    arm = lab()
    arm.controller.valid = False
    arm.until(State.HOLDING)
    held = arm.now
    arm.until(State.INACTIVE, within=2.0)
    assert arm.now - held == pytest.approx(TIMEOUT + 0.2, abs=0.05)
    assert "hold-timeout" in arm.kinds
    assert arm.is_vented()


def test_a_hold_of_a_client_lasts() -> None:
    arm = lab()
    arm.loop.hold("lunch")
    assert arm.ticks(150).state is State.HOLDING
    arm.loop.hold("the client has gone", lasting=False)
    arm.until(State.INACTIVE, within=2.0)
    assert "hold-timeout" in arm.kinds


def test_a_hold_without_words_outlasts_one_of_the_tracker() -> None:
    arm = lab()
    arm.world.inject("tracker", "off")
    arm.until(State.HOLDING)
    arm.loop.hold("")
    arm.world.inject("tracker", "ok")
    assert arm.ticks(150).state is State.HOLDING


def test_a_stream_of_targets_does_not_keep_a_hold_alive() -> None:
    arm = lab()
    arm.controller.valid = False
    arm.until(State.HOLDING)
    begin = arm.now
    while arm.state is not State.INACTIVE:
        if "hold-timeout" not in arm.kinds:
            arm.loop.set_target(Target(position=(0.0, 0.0, 0.1)))
        arm.ticks(5)
        assert arm.now < begin + 2.0
    assert "hold-timeout" in arm.kinds


def test_a_doubt_holds_until_there_is_a_task_and_not_a_target() -> None:
    arm = lab()
    arm.controller.said = DOUBT
    arm.until(State.HOLDING)
    assert "hold-doubt" in arm.kinds
    arm.controller.said = ()
    arm.loop.set_target(Target(position=(0.0, 0.0, 0.1)))
    assert arm.tick().state is State.HOLDING
    arm.loop.set_task(TASK)
    assert arm.tick().state is State.ACTIVE


def test_a_second_doubt_lets_down_at_once() -> None:
    arm = lab(hold_timeout=60.0)
    arm.controller.said = DOUBT
    arm.until(State.HOLDING)
    arm.controller.said = ()
    arm.loop.set_task(TASK)
    arm.ticks(50)
    arm.controller.said = DOUBT
    arm.until(State.HOLDING)
    again = arm.now
    arm.until(State.INACTIVE)
    assert arm.now - again < 0.3
    assert "doubt-again" in arm.kinds


def test_a_hold_stops_the_arm_where_the_chambers_are_and_not_where_the_commands_led() -> None:
    arm = Lab(safety={"hold_timeout": TIMEOUT}, supply={"driver": "simulated", "lag": 0.2})
    arm.controller.wanted = np.array([1e5, 0.0, 0.0])
    arm.ticks(30)
    arm.controller.said = DOUBT
    held = arm.until(State.HOLDING)
    inside = arm.world.pressures.copy()
    assert arm.loop.snapshot().commanded[0] > inside[0] + 1e4
    arm.ticks(30)
    assert held < 1.0
    assert arm.world.pressures[0] < inside[0] + 1e4


def test_a_doubt_undoes_the_latest_motion_or_a_share_of_it() -> None:
    held = []
    for undo in (0.0, 0.5, 1.0):
        arm = Lab(safety={"hold_timeout": TIMEOUT}, supply={"driver": "simulated", "lag": 0.1})
        arm.controller.wanted = np.array([1e5, 0.0, 0.0])
        arm.ticks(10)
        arm.controller.said = (replace(DOUBT[0], undo=undo),)
        arm.until(State.HOLDING)
        arm.ticks(30)
        held.append(arm.loop.snapshot().commanded[0])
    assert held[1] == pytest.approx((held[0] + held[2]) / 2, rel=0.2)
    assert held[2] < 0.5 * held[0]


def test_a_doubted_motion_stops_as_the_controller_says_and_then_stays() -> None:
    arm = lab()
    change = np.array([-2e3, -2e3, 2e3])
    way = [arm.loop.snapshot().commanded + k * change for k in (1, 2)]
    left = iter(way)
    arm.controller.stopping = lambda now: next(left, None)
    arm.controller.said = DOUBT
    arm.until(State.HOLDING)
    held = [arm.tick().commanded for _ in range(40)]
    assert held[0] == pytest.approx(way[0], abs=1.0)
    assert held[1] == pytest.approx(way[1], abs=1.0)
    assert held[-1] == pytest.approx(way[1], abs=1.0)
    arm.until(State.INACTIVE, within=2.0)


@pytest.mark.parametrize("wrong", [np.full(3, np.nan), np.zeros(2)])
def test_a_stop_that_makes_no_sense_is_an_ordinary_hold(wrong: Array) -> None:
    held = []
    for stopping in (None, wrong):
        arm = lab()
        arm.controller.stopping = lambda now, stopping=stopping: stopping
        arm.controller.said = DOUBT
        arm.until(State.HOLDING)
        held.append(arm.ticks(20).commanded)
    assert held[0] == pytest.approx(held[1], abs=1.0)


def test_a_stop_ends_after_a_while() -> None:
    arm = Lab(safety={"hold_timeout": 5.0}).under_pressure()
    begin = arm.now
    arm.controller.stopping = lambda now: np.array([2e4 + 1e4 * min(now - begin, 10), 1e4, 0.0])
    arm.controller.said = DOUBT
    arm.until(State.HOLDING)
    at_last = arm.ticks(200).commanded
    assert arm.ticks(100).commanded == pytest.approx(at_last)


def test_a_hold_never_commands_more_than_was_commanded_whatever_a_gauge_reads() -> None:
    arm = lab()
    arm.controller.wanted = np.zeros(3)
    arm.ticks(15)  # falling: the chambers have more than is commanded
    before = arm.loop.snapshot().commanded
    assert before.max() > 1e4
    _, most = arm.loop._supervisor._recent.range()  # of the last 0.3 s
    arm.world.inject("supply", "wrong", channel=2)  # reads 0.2 bar of an empty chamber
    arm.controller.said = DOUBT
    for _ in range(30):
        arm.tick()
        assert (arm.loop.snapshot().commanded <= most + 1e-6).all()


def test_a_doubt_leads_back_the_way_where_pressures_rise_and_fall() -> None:
    arm = Lab(safety={"hold_timeout": TIMEOUT}, supply={"driver": "simulated", "lag": 0.1})
    arm.controller.wanted = before = np.array([1e5, 0.0, 0.5e5])
    arm.ticks(200)
    arm.controller.wanted = np.array([0.0, 1e5, 0.5e5])
    arm.ticks(8)
    arm.controller.said = DOUBT
    arm.until(State.HOLDING)
    assert arm.world.pressures[0] < 0.97e5
    arm.ticks(45)
    assert arm.world.pressures == pytest.approx(before, abs=2e3)


def test_no_timeout_has_to_be_accepted() -> None:
    with pytest.raises(InputError, match="unlimited_hold: accepted"):
        Safety(hold_timeout="none")
    assert Safety(hold_timeout="none", unlimited_hold="accepted").hold_timeout is None
    arm = Lab(safety={"hold_timeout": None, "unlimited_hold": "accepted"}).under_pressure()
    arm.controller.valid = False
    arm.until(State.HOLDING)
    assert arm.ticks(1200).state is State.HOLDING


def _watch(scene: Scene) -> ClearanceWatch:
    watch = ClearanceWatch(load_robot("stiff-flop-2"), scene)
    watch._cost = 0.0  # of a quick machine
    return watch


def _scene(*position: float) -> Scene:
    sphere = {"centre": list(position), "radius": 0.005}
    return Scene(clearance=0.001, objects=[{"name": "post", "sphere": sphere}])


BENT = np.array([0.0, 1.5e5, 0.0, 0.0, 1.5e5, 1.5e5])


def test_the_way_down_takes_the_segments_one_after_the_other_where_that_is_clear() -> None:
    robot = load_robot("stiff-flop-2")
    ways = _watch(_scene(0.5, 0.5, 0.5))._ways_down
    assert len(ways) == 3
    together, distal_first = ways[0], ways[1]
    np.testing.assert_array_equal(distal_first[1], [1, 1, 1, 0, 0, 0])
    np.testing.assert_array_equal(together[-1], np.zeros(6))
    # an object where the tip is on the way when all fall together, and not on the other way
    on_the_way = _scene(*robot.tip_pose(0.75 * BENT)[:3, 3])
    taken, warning = _watch(on_the_way).way_down(BENT)
    assert warning == ""
    np.testing.assert_array_equal(taken, distal_first)
    for before, after in pairwise(taken):
        for share in np.linspace(0, 1, 20):
            state = ((1 - share) * before + share * after) * BENT
            assert robot.clearance(state, on_the_way) > 0


def test_a_way_down_that_is_nowhere_clear_is_taken_with_a_warning() -> None:
    robot = load_robot("stiff-flop-2")
    middle = robot.pose(np.zeros(6), 0.09)[:3, 3]  # where the arm is when it is vented
    _, warning = _watch(_scene(*middle)).way_down(BENT)
    assert "on the way down the body would go" in warning
    assert "'post'" in warning


def test_a_way_down_that_would_take_too_long_to_find_is_straight_and_says_so() -> None:
    watch = _watch(_scene(0.5, 0.5, 0.5))
    watch._cost = 1.0
    taken, warning = watch.way_down(BENT)
    assert len(taken) == 2
    assert "was not looked at" in warning


def test_after_preparing_without_kept_code_the_way_down_is_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All code is there then: none is still made in the background."""
    use_compiler(monkeypatch, tmp_path)
    watch = ClearanceWatch(load_robot("stiff-flop-2"), _scene(0.5, 0.5, 0.5))
    watch.prepare()
    assert watch.way_down(BENT)[1] == ""


def test_arming_says_what_to_change_on_a_computer_that_is_late() -> None:
    arm = Lab(ready=False)
    arm.loop.configure()
    for late in (0.03, 0.028, 0.026, 0.0, 0.2):  # one tick that is very late is no habit
        arm.rig.clock.sleep(late)
        arm.loop.tick(arm.now - late)
        arm.loop.tick(arm.now)  # an overrun has an end
    arm.arm()
    (said,) = [event for event in arm.loop.events.since(0)[0] if event.kind == "timing"]
    assert "repeatedly 28 ms late" in said.text
    assert "guard_timeout: 100 ms" in said.text


def test_a_computer_that_is_too_late_is_not_armed() -> None:
    arm = Lab(ready=False)
    arm.loop.configure()
    for _ in range(3):
        arm.rig.clock.sleep(0.08)
        arm.loop.tick(arm.now - 0.08)
        arm.loop.tick(arm.now)
    with pytest.raises(InputError, match=r"repeatedly 80 ms late.*guard_timeout: 200 ms"):
        arm.arm()
    for _ in range(3000):  # half a minute
        arm.loop.tick(arm.now)
    arm.arm()


def test_a_computer_with_more_to_do_than_processors_is_told_of() -> None:
    assert late_ticks(0.001, 0.05, load=0.9) == ""
    text = late_ticks(0.001, 0.05, load=3.2)
    assert text == (
        "timing: this computer is too busy: 3.2 processes compete for each processor, and the "
        "guard vents the arm after 50 ms without a command. To mend it, close other programs, or "
        "grant the real-time rights that 'stiffopt run' reported missing when it started; if "
        "neither helps, set 'safety.guard_timeout: 100 ms' in the rig file"
    )
    assert "guard_timeout" not in late_ticks(0.001, 0.2, load=3.2), "patient already"
    assert "guard_timeout" not in late_ticks(5.0, 0.05), "longer than it may be"
    assert load_of_processors() > 0
