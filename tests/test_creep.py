"""The creep of a tip: learned at rest and predicted, for made-up tips."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt.control.contact_tuning import CreepTuning
from stiffopt.control.creep import CreepEstimator

Array = NDArray[np.float64]

FRAME, NOISE = 0.025, 5e-5
JACOBIAN = np.array([[4e-7, -2e-7, -2e-7], [0, 3.5e-7, -3.5e-7], [5e-8, 5e-8, 5e-8]])  # m/Pa
STEP = np.array([8e4, 1e4, 3e4])  # Pa, from rest at time 1 s
WAY = JACOBIAN @ STEP
ALONG = WAY / np.linalg.norm(WAY)


def creep(time: float, shares: tuple[float, ...], times: tuple[float, ...]) -> Array:
    """Return the displacement (3,) that creep leaves to come, by the step response of a lag."""
    since = time - 1.0
    left = sum(a * np.exp(-since / T) for a, T in zip(shares, times, strict=True))
    return -WAY * left if since > 0 else np.zeros(3)


def learned(
    shares: tuple[float, ...], times: tuple[float, ...], until: float, extra: Array | None = None
) -> CreepEstimator:
    """Return what is learned from a step, whose model errs by 8 % of it, and an extra motion."""
    estimator, rng = CreepEstimator(3, False, CreepTuning()), np.random.default_rng(5)
    for time in np.arange(0, until, FRAME):
        moved = time >= 1.0
        estimator.advance(FRAME if time else np.inf, moved * STEP, JACOBIAN)
        steps = abs(time - 1.0) < FRAME / 2
        away = 0.08 * WAY * moved + creep(time, shares, times) + NOISE * rng.standard_normal(3)
        if extra is not None and time > 3.0:
            away = away + extra * (time - 3.0)
        way = float(np.linalg.norm(WAY)) if steps else 0.0
        estimator.learn(FRAME, away, way**2, way / FRAME, np.eye(3))
    return estimator


@pytest.mark.parametrize(
    ("shares", "times"),
    [((0.05, 0.05), (2.0, 20.0)), ((0.06,), (8.0,)), ((0.0,), (5.0,)), ((0.03,), (35.0,))],
)
def test_what_is_seen_in_six_seconds_predicts_the_next_twenty(
    shares: tuple[float, ...], times: tuple[float, ...]
) -> None:
    estimator = learned(shares, times, 7.0)
    before = estimator.displacement
    deviation = estimator.deviation(ALONG, 20.0)
    for _ in range(round(20.0 / FRAME)):
        estimator.advance(FRAME, STEP, JACOBIAN)
    crept = estimator.displacement - before
    true = creep(27.0, shares, times) - creep(7.0, shares, times)
    assert np.linalg.norm(WAY) > 0.02
    assert np.linalg.norm(crept - true) < min(3 * deviation, 0.012 * np.linalg.norm(WAY))


def test_the_deviation_falls_while_it_rests() -> None:
    found = [learned((0.05,), (6.0,), until).deviation(ALONG, 20.0) for until in (2.0, 5.0, 12.0)]
    assert found[0] > found[1] > found[2] > 0


def test_a_tip_that_moves_as_no_creep_does_is_not_learned_from() -> None:
    estimator = learned((0.05,), (6.0,), 9.0, extra=-3e-3 * ALONG)  # 3 mm/s, such as an obstacle
    assert (np.abs(estimator.shares - CreepTuning().share) <= 3 * CreepTuning().deviation).all()


def test_an_arm_whose_creep_is_calibrated_has_none_that_is_missing() -> None:
    estimator = CreepEstimator(3, True, CreepTuning())
    estimator.advance(np.inf, np.zeros(3), JACOBIAN)
    estimator.advance(FRAME, STEP, JACOBIAN)
    assert not estimator.displacement.any()
    unknown = CreepEstimator(3, False, CreepTuning())
    unknown.advance(np.inf, np.zeros(3), JACOBIAN)
    unknown.advance(FRAME, STEP, JACOBIAN)
    assert 0 < estimator.deviation(ALONG, 20.0) < 0.5 * unknown.deviation(ALONG, 20.0)


def test_another_model_and_another_jacobian_move_nothing() -> None:
    estimator = learned((0.05, 0.05), (2.0, 20.0), 5.0)
    before = estimator.displacement.copy()
    change = estimator.take_over(1.3 * JACOBIAN)
    np.testing.assert_allclose(change, 0.3 * before, rtol=1e-12)
    np.testing.assert_allclose(estimator.displacement, before + change, rtol=1e-12)


@pytest.mark.parametrize("until", [5.0, 5.025, 5.05, 5.075])
def test_a_jacobian_that_changes_between_two_corrections_teaches_nothing(until: float) -> None:
    shares, times = (0.05, 0.05), (2.0, 20.0)
    estimator = learned(shares, times, until)
    before = estimator.shares.copy()
    estimator.take_over(1.5 * JACOBIAN)
    for time in until + FRAME * np.arange(4):
        estimator.advance(FRAME, STEP, 1.5 * JACOBIAN)
        estimator.learn(FRAME, 0.08 * WAY + creep(time, shares, times), 0.0, 0.0, np.eye(3))
    np.testing.assert_allclose(estimator.shares, before, atol=4e-3)


def test_creep_that_is_soon_seen_tells_of_the_creep_to_come() -> None:
    """A rest of a few seconds by itself shows nothing of a time constant of 25 s."""
    shares = learned((0.06, 0.06), (2.0, 20.0), 4.0).shares
    assert shares[2] > CreepTuning().share + 0.004


def test_elongation_creeps_otherwise_and_teaches_nothing() -> None:
    """Nothing creeps across the arm, much along it, where no force is felt."""
    along = STEP @ JACOBIAN.T
    along = along / np.linalg.norm(along)
    across = np.eye(3) - np.outer(along, along)
    estimators = [CreepEstimator(3, False, CreepTuning()) for _ in range(2)]
    for time in np.arange(0, 6.0, FRAME):
        moved = time >= 1.0
        away = 0.08 * WAY * moved + creep(time, (0.1,), (2.0,))
        for estimator, felt in zip(estimators, (np.eye(3), across), strict=True):
            estimator.advance(FRAME if time else np.inf, moved * STEP, JACOBIAN)
            estimator.learn(FRAME, away, 0.0, 0.0, felt)
    told, untold = (np.abs(each.shares - CreepTuning().share).max() for each in estimators)
    assert told > 0.02
    assert untold < 1e-3
