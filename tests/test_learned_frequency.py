"""The frequency of the vibration, as the whole loop learns and reports it."""

from __future__ import annotations

import numpy as np
import pytest

from test_controller import HANGING, Bench

pytestmark = pytest.mark.usefixtures("compiled")


def learned(bench):
    numbers = bench.controller.status(bench.rig.clock.now()).adapted
    return next(each for each in numbers if each.key == "frequency_factor")


def test_the_frequency_is_learned_in_a_motion_and_stays_at_rest():
    bench = Bench(HANGING, "full")
    begun = learned(bench)
    assert begun.deviation == pytest.approx(0.03)
    bench.settled(duration=3.0)
    moved = learned(bench)
    assert moved.deviation < 0.9 * begun.deviation
    assert moved.value != begun.value
    bench.run(1.5)
    rested = learned(bench).value
    bench.run(1.0)
    assert learned(bench).value == rested


def test_a_frequency_at_its_bound_is_told():
    bench = Bench(HANGING, "full")
    tip = bench.controller._arm.tip
    tip.detuning = np.array([-0.15, 4e-4])
    (notice,) = bench.controller.notices()
    assert (notice.kind, notice.standing, notice.hold) == ("frequency", True, False)
    assert "0.85 of the model's frequency" in notice.text
    tip.detuning = np.array([-0.13, 4e-4])  # it comes and goes by as much with each sample
    assert [notice.kind for notice in bench.controller.notices()] == ["frequency"]
    tip.detuning = np.array([-0.11, 4e-4])
    assert bench.controller.notices() == ()
    tip.detuning = np.array([-0.14, 4e-4])
    assert bench.controller.notices() == ()


def test_the_frequency_is_not_learned_while_the_pressures_are_held():
    bench = Bench(HANGING, "full")
    bench.settled(duration=0.3)
    tip = bench.controller._arm.tip
    assert tip.learns
    bench.run(0.1, steer=False)
    assert not tip.learns
    known = tip.detuning.copy()
    bench.run(0.5, steer=False)
    assert (tip.detuning == known).all()
    bench.controller.begin(bench.rig.clock.now())
    assert not tip.learns


@pytest.mark.parametrize("dynamics", ["quasi-static", "full"])
def test_an_arm_that_leans_in_motion_keeps_its_estimated_tip(dynamics):
    bench = Bench(HANGING, dynamics)
    bench.settled(duration=0.4)
    arm = bench.controller._arm
    before = arm.tip.estimate.position
    # the same model, but linearised here
    assert np.abs(arm.lean_on(None)).max() < 1e-5
    assert np.abs(arm.change_robot(bench.controller.robot.description)).max() < 1e-5
    assert arm.tip.estimate.position == pytest.approx(before, abs=1e-5)
