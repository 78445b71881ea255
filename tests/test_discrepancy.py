"""Errors that rows at nearby pressures share: algebra, and what a curve in pressure space tells."""

from __future__ import annotations

import numpy as np
import pytest

from stiffopt.identify.discrepancy import Systematic, centres, smooth_functions

RANDOM = np.random.default_rng(0)


def test_what_is_left_has_the_likelihood_of_the_sum_of_both_errors() -> None:
    functions, errors = RANDOM.normal(size=(30, 4)), RANDOM.normal(size=(30, 2))
    found = Systematic.of(functions).residuals(errors)
    inverse = np.linalg.inv(np.eye(30) + functions @ functions.T)
    np.testing.assert_allclose(found.T @ found, errors.T @ inverse @ errors, atol=1e-12)


def test_the_systematic_part_is_its_mean_given_the_errors() -> None:
    functions, errors = RANDOM.normal(size=(30, 4)), RANDOM.normal(size=(30, 2))
    covariance = functions @ functions.T
    expected = covariance @ np.linalg.solve(np.eye(30) + covariance, errors)
    found = Systematic.of(functions)
    np.testing.assert_allclose(found.part(errors), expected, atol=1e-12)
    left = covariance - covariance @ np.linalg.solve(np.eye(30) + covariance, covariance)
    np.testing.assert_allclose(found.root @ found.root.T, left, atol=1e-12)


def test_smooth_functions_are_a_gaussian_process_of_pressure() -> None:
    pressures = RANDOM.uniform(0, 1e5, (60, 3))
    functions = smooth_functions(pressures)
    squared = ((pressures[:, np.newaxis] - pressures) ** 2).sum(axis=2)
    scale = 0.3 * pressures.max()
    expected = np.exp(-squared / 2 / scale**2)
    assert np.abs(functions @ functions.T - expected).max() < 0.25  # few centres
    assert (functions**2).sum(axis=1).max() < 1 + 1e-9


def test_centres_are_far_apart_and_everything_is_near_one() -> None:
    points = RANDOM.uniform(0, 1, (200, 2))
    chosen = points[centres(points, 0.2, 100)]
    distances = np.linalg.norm(points[:, np.newaxis] - chosen, axis=2)
    assert distances.min(axis=1).max() <= 0.2
    among = np.linalg.norm(chosen[:, np.newaxis] - chosen, axis=2) + np.eye(len(chosen))
    assert among.min() > 0.2
    assert len(centres(points, 0.0, 5)) == 5
    assert centres(np.zeros((4, 2)), 0.0, 3) == [0]


def deviation_of_the_mean(turns: int, shared: float) -> float:
    """Of the errors on a circle, whose rows have noise of deviation one."""
    angle = np.linspace(0, 2 * np.pi * turns, 200 * turns)
    pressures = 5e4 + 3e4 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    residual = Systematic.of(shared * smooth_functions(pressures)).residuals(
        np.ones((len(angle), 1))
    )
    return float(1 / np.sqrt((residual**2).sum()))


def test_a_curve_that_is_run_again_tells_little_more() -> None:
    once, often = deviation_of_the_mean(1, 3.0), deviation_of_the_mean(10, 3.0)
    assert 1.0 < often < 3.0  # as some errors that are independent of each other
    assert often == pytest.approx(once, rel=0.02)
    alone = deviation_of_the_mean(1, 1e-6), deviation_of_the_mean(10, 1e-6)
    assert alone[1] == pytest.approx(alone[0] / np.sqrt(10), rel=1e-3)
