"""What the loop learns on a trajectory about how much farther than modelled the tip moves."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt.control.motion_error import MotionErrorEstimator
from stiffopt.control.tuning import MotionErrorTuning
from stiffopt.optimise.target import Target
from stiffopt.paths.trajectory import Trajectory, Waypoint
from test_controller import Bench

Array = NDArray[np.float64]

PERIOD = 0.01
SLOPE = np.array([[0.1, -0.02, 0.0], [0.03, 0.06, 0.01], [0.0, 0.02, -0.05]])


def learned(slope: Array, seconds: float, speed: float = 0.01, scatter: float = 1e-4) -> Array:
    """The slope that is found on a circle that also rises and falls."""
    estimator, rng = MotionErrorEstimator(MotionErrorTuning()), np.random.default_rng(4)
    bias = np.array([3e-3, -2e-3, 1e-3])
    for time in np.arange(0.0, seconds, PERIOD):
        turn = time * speed / 0.02
        place = 0.02 * np.array([np.cos(turn), np.sin(turn), np.sin(2 * turn) / 2])
        offset = bias + slope @ place + scatter * rng.standard_normal(3)
        estimator.learn(PERIOD, place + np.array([0.0, 0.0, 0.2]), offset)
    return estimator.slope


def test_it_finds_how_the_offset_changes_with_the_motion() -> None:
    assert np.abs(learned(SLOPE, 12.0) - SLOPE).max() < 0.01
    assert np.abs(learned(0 * SLOPE, 12.0)).max() < 0.01
    way = np.array([np.cos(1.0) - 1, np.sin(1.0), np.sin(2.0) / 2])
    early = learned(SLOPE, 2.0) @ way  # after 20 mm it is known along the way alone
    assert np.linalg.norm(early - SLOPE @ way) < 0.4 * np.linalg.norm(SLOPE @ way)


def test_an_offset_in_fast_motion_tells_less() -> None:
    slow, fast = (learned(SLOPE, 0.02 / speed, speed) for speed in (0.01, 0.1))
    assert np.linalg.norm(fast) < 0.1 * np.linalg.norm(slow)


def test_what_was_learned_can_be_forgotten() -> None:
    estimator = MotionErrorEstimator(MotionErrorTuning())
    for k in range(200):
        place = np.array([1e-4 * k, 0.0, 0.2])
        estimator.learn(PERIOD, place, 0.1 * place)
    assert estimator.slope[0, 0] == pytest.approx(0.1, abs=0.02)
    estimator.stop()
    assert not estimator.slope.any()
    estimator.learn(PERIOD, np.zeros(3), np.ones(3))  # the first: where it begins
    assert not estimator.slope.any()


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("modulus", [0.8, 1.3])
def test_on_a_trajectory_a_wrong_modulus_delays_the_tip_little(
    modulus: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fifth to a quarter of the motion is missing, or too much, and feedback is 0.3 s late."""

    def delay() -> float:
        """By how much the tip is later than the trajectory's known delay, in s."""
        bench = Bench("stiff-flop-1", "full", modulus=modulus, spread=0.0)
        here = np.array(bench.settled((0.6, 0.6, 0.2), 4.0))
        turns, speed = np.linspace(0.0, 2 * np.pi, 41), 0.01
        times = turns * 0.01 / speed
        ways = 0.01 * np.stack([np.cos(turns) - 1, np.sin(turns), 0 * turns], axis=1)
        points = [
            Waypoint(time=float(t), target=Target(position=tuple((here + way).tolist())))
            for t, way in zip(times, ways, strict=True)
        ]
        known = bench.controller.trajectory_delay
        bench.controller.follow(Trajectory(waypoints=points), bench.rig.clock.now())
        late = []
        for k in range(round(times[-1] / bench.period)):
            bench.run(bench.period)
            turn = speed / 0.01 * ((k + 1) * bench.period - known)
            if turn > 1.0:
                velocity = speed * np.array([-np.sin(turn), np.cos(turn), 0.0])
                place = here + 0.01 * np.array([np.cos(turn) - 1, np.sin(turn), 0.0])
                late.append((place - bench.tip[:3, 3]) @ velocity / speed**2)
        bench.controller.close()
        bench.rig.close()
        return abs(float(np.mean(late)))

    with_it = delay()
    monkeypatch.setattr(MotionErrorEstimator, "learn", lambda *_: None)
    without = delay()
    assert without > 0.015
    assert with_it < 0.6 * without
