"""The first motion after arming is slow until the tip has responded."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stiffopt.control.controller import TipController
from stiffopt.control.first_motion import FirstMotion
from stiffopt.control.tuning import FirstMotionTuning
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from test_controller import LATERAL, PERIOD, Bench

TUNING = FirstMotionTuning()
X, Y = np.eye(3)[:2]
BASE = np.array([0.01, 0.0, 0.2])


def parts(way: np.ndarray, *shares: float) -> np.ndarray:
    """Parts (3, n) of the channels in a way (3,)."""
    return way[:, None] * np.array(shares)


@pytest.mark.parametrize(
    ("seen", "responds"),
    [(X, True), (0.6 * X, True), (1.4 * X, True), (0 * X, False), (-X, False), (Y, False)],
)
def test_it_ends_when_the_tip_has_followed_the_model(seen: np.ndarray, responds: bool) -> None:
    first = FirstMotion(TUNING)
    for way in np.linspace(0.0, 2 * TUNING.way, 20):
        first.take(BASE + way * X, BASE + [0.0, 2e-3, 0.0] + way * seen, parts(way * X, 0.9, 0.1))
        if way < TUNING.way:
            assert np.all(first.slew_share == TUNING.slew_share)
    assert first.slew_share[0] == (math.inf if responds else TUNING.slew_share)
    assert first.slew_share[1] == TUNING.slew_share
    assert not first.is_over
    first.begin()
    assert first.slew_share == TUNING.slew_share


@pytest.mark.parametrize(("seen", "responds"), [(X, True), (Y, False)])
def test_a_channel_that_comes_later_is_slow_until_the_tip_follows_it(
    seen: np.ndarray, responds: bool
) -> None:
    """The way before it, on which the tip has followed the others, does not count for it."""
    first = FirstMotion(TUNING)
    for way in np.linspace(0.0, 0.04, 20):
        first.take(BASE + way * X, BASE + way * X, parts(way * X, 1.0, 0.0))
    assert first.slew_share.tolist() == [math.inf, TUNING.slew_share]
    here = BASE + 0.04 * X
    for way in np.linspace(0.0, 2 * TUNING.way, 20):
        both = parts(0.04 * X, 1.0, 0.0) + parts(way * X, 0.0, 1.0)
        first.take(here + way * X, here + way * seen, both)
        if way < TUNING.way:
            assert first.slew_share[1] == TUNING.slew_share
    assert first.is_over is responds


def test_a_first_motion_without_bounds_is_fast_at_once() -> None:
    first = FirstMotion(replace(TUNING, slew_share=math.inf, correction=math.inf))
    assert first.slew_share == math.inf
    assert first.largest_correction(BASE) == math.inf


def test_until_then_feedback_corrects_no_more_than_an_error_of_the_model() -> None:
    first = FirstMotion(TUNING)
    assert first.largest_correction(BASE) == TUNING.correction
    later = first.largest_correction(BASE + 0.004 * X)
    assert later == pytest.approx(TUNING.correction + 0.004 * TUNING.correction_share)
    first.take(BASE, BASE, parts(0 * X, 1.0))
    first.take(BASE + 0.02 * X, BASE + 0.02 * X, parts(0.02 * X, 1.0))
    assert first.largest_correction(BASE) == math.inf
    first.begin()
    assert first.largest_correction(BASE + 0.1 * X) == TUNING.correction


@pytest.mark.usefixtures("compiled")
def test_an_arm_with_swapped_channels_is_stopped_before_it_has_moved_far() -> None:
    """Slowly it goes less far before the doubt; without a fault it arrives all the same."""
    ways = {}
    for slow, swapped in ((False, True), (True, True), (True, False)):
        bench = Bench(period=PERIOD)
        bench.controller = TipController(
            bench.controller.robot, bench.limits, bench.slew, period=PERIOD,
            safety=bench.description.safety, vibrates=False, slow_first_motion=slow,
        )  # fmt: skip
        bench.controller.check()
        bench.controller.begin(bench.rig.clock.now())
        start = bench.tip[:3, 3]
        goal = bench.pose_at([0.2e5, 0.9e5, 0.1e5, 0.3e5, 0.8e5, 0.2e5])[:3, 3]
        plant = bench.rig.world.plant
        if swapped:
            follow = plant.follow
            plant.follow = lambda p, f=follow: f(np.ascontiguousarray(p[:, [1, 0, 2, 3, 4, 5]]))
        target = Target(position=tuple(goal.tolist()))
        task = Task(robot="stiff-flop-2-hanging", target=target, stiffness=LATERAL)
        bench.controller.set_task(task)
        tips = []
        for _ in range(round(4.0 / PERIOD)):
            bench.run(PERIOD)
            tips.append(bench.tip[:3, 3])
            if any(notice.hold for notice in bench.controller.notices()):
                break
        if not swapped:
            assert np.linalg.norm(tips[-1] - goal) < 1e-3
        else:
            assert len(tips) < round(4.0 / PERIOD)
            ways[slow] = float(np.linalg.norm(tips[-1] - start))
    assert ways[True] < 0.010
    assert ways[True] < ways[False]
