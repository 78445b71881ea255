"""Which poses that do not change the watch of still sensors doubts, on motions made up here."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.control.motion_watch import MotionWatch
from stiffopt.control.noticing_tuning import MotionTuning
from stiffopt.control.tip_errors import turn_of_a_push
from stiffopt.model.manipulator import load_robot
from stiffopt.optimise.tip import TipModel

Array = NDArray[np.float64]
Course = Callable[[float], float]

NOISE = 5e-5, 1e-3  # m, rad
ROBOT = load_robot("stiff-flop-2")
P = np.array([4e4, 0.0, 2e4, 0.0, 5e4, 0.0])
TIP = TipModel(ROBOT).at(P)
Y = TIP.pose[:3, 1]  # across the tip
TURNS = np.linalg.pinv(turn_of_a_push(TIP), rcond=1e-6) @ Y  # by what a push turns it, m/rad
TURN = 0.08  # rad/s


def doubted_after(
    turns: Course, seen: Course, *, away: Array | None = None, frame: float = 0.025,
    noise: float = 1.0, held: bool = False, told: tuple[float, ...] = (),
) -> float:  # fmt: skip
    """Time of the first doubt of a tip that rests until 1 s; infinite without one.

    The model turns it about y by `turns` and moves it by as much of `away`, in m/rad; the sensor
    shows a turn by `seen` and no motion. Times `told` change the model.
    """
    rng, watch = np.random.default_rng(3), MotionWatch(ROBOT.description, MotionTuning())
    for time in np.arange(0.0, 4.0, frame):
        angles = turns(max(time - 1.0, 0.0)), seen(max(time - 1.0, 0.0))
        model, sensor = (lie.exp(np.array([0, 0, 0, *(angle * Y)]))[:3, :3] for angle in angles)
        offset = np.zeros(6)
        offset[3:] = (angles[1] - angles[0]) * Y
        predicted = np.zeros(3) if away is None else angles[0] * away
        offset[:3] = -predicted
        small = noise * NOISE[1] * rng.standard_normal(3)
        sensor = lie.exp(np.concatenate([np.zeros(3), small]))[:3, :3] @ sensor
        position = noise * NOISE[0] * rng.standard_normal(3)
        rotations = None if held else (sensor @ TIP.pose[:3, :3], model @ TIP.pose[:3, :3])
        watch.intend(time, np.zeros(3))
        watch.take(
            time, position, predicted, offset, np.zeros(6), TIP, turned=offset[3:],
            rotations=rotations,
        )  # fmt: skip
        if any(abs(time - moment) < frame / 2 for moment in told):
            watch.change_model(np.zeros(6))
        if watch.doubt is not None:
            assert watch.doubt.kind == "no-response"
            assert "lie still" in watch.doubt.text
            return float(time) - 1.0
    return np.inf


def rest(t: float) -> float:
    return 0.0


def steady(t: float) -> float:
    return TURN * t


@pytest.mark.parametrize("frame", [0.01, 0.025, 0.05])
def test_a_sensor_that_lies_still_while_the_tip_should_turn_is_doubted_soon(frame: float) -> None:
    assert doubted_after(steady, rest, frame=frame) < 0.8


def test_a_turn_that_is_seen_in_part_is_not_doubted() -> None:
    assert doubted_after(steady, lambda t: 0.3 * steady(t)) == np.inf
    assert doubted_after(steady, lambda t: -0.3 * steady(t)) == np.inf


def test_a_tip_that_should_hardly_turn_is_not_doubted() -> None:
    assert doubted_after(lambda t: min(steady(t), 0.02), rest) == np.inf


@pytest.mark.parametrize("share", [1.0, 1.5, 2.0])
def test_a_push_for_which_feedback_makes_up_explains_a_tip_that_lies_still(share: float) -> None:
    """It displaces the tip against the model's motion, and turns it back."""
    assert doubted_after(steady, rest, away=TURNS / share) == np.inf


def test_a_displacement_that_does_not_turn_the_tip_back_explains_nothing() -> None:
    assert doubted_after(steady, rest, away=-TURNS / 4) < 1.0


def test_a_noisier_tracker_than_the_rig_file_says_is_not_judged() -> None:
    assert doubted_after(steady, rest, noise=10.0) == np.inf


def test_a_tip_that_something_holds_is_not_judged() -> None:
    assert doubted_after(steady, rest, held=True) == np.inf


def test_a_change_of_the_model_is_no_turn() -> None:
    """It turns the model's tip at once; what was seen before is not compared with it."""
    jump = 0.2

    def changed(t: float) -> float:
        return jump if t > 1.0 else 0.0

    assert doubted_after(changed, rest) < 2.0
    assert doubted_after(changed, rest, told=(2.0,)) == np.inf
