"""Cross-validation folds: the data held back from a fit, on which models are compared.

With enough logs, each log is a fold.  With fewer, the folds are stretches of time, and regions of
pressure, which test how a model extrapolates: the highest and the lowest pressures, clusters of the
recorded pressures, and rising pressures.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.identify.discrepancy import centres
from stiffopt.identify.error_model import HeldBack
from stiffopt.identify.fit import Fit, fit
from stiffopt.identify.problem import CalibrationProblem
from stiffopt.identify.results import Errors
from stiffopt.identify.settings import CHOICE

Rows = NDArray[np.bool_]


def held_back(found: Fit, settle: float, on_evaluation: Callable[[], None]) -> dict[str, HeldBack]:
    """Hold back each fold in turn, fit the other rows, and predict the fold.

    Parameters
    ----------
    found : fit to all rows, at which the other fits begin.
    settle : time in s. A held-back log whose initial state or zero is unknown keeps this much of
        its beginning in the fit, since a prediction of it would also use that.
    on_evaluation : called at every evaluation.

    Returns
    -------
    Results by the names of the folds.

    Raises
    ------
    InputError
        No fold has a row to compare.
    """
    problem = found.problem
    parts = {}
    for name, away in folds(problem).items():
        kept = [_without_beginning(each, problem, i, settle) for i, each in enumerate(away)]
        if not any(each.any() for each in kept):
            continue  # the log is shorter than its beginning
        rows = np.concatenate(kept)
        others = fit(  # ended early, it would still know the held-back rows from its start
            problem.without(kept), [found.x], on_evaluation, rounds=0, tolerance=CHOICE.tolerance
        )
        distances = np.linalg.norm(others.predicted.errors[0], axis=1)
        errors = Errors.of(distances[rows], None)
        if errors.n:
            parts[name] = HeldBack(rows, others, errors)
    if not parts:
        raise InputError(
            "there is nothing left to compare models with; expected longer logs, a shorter "
            "`--beginning`, or name a model"
        )
    return parts


def folds(problem: CalibrationProblem) -> dict[str, list[Rows]]:
    """Return the folds by name, each as the held-back rows of every sample."""
    samples = problem.samples
    none = [np.zeros(len(each.rows), dtype=bool) for each in samples]
    if len(samples) >= CHOICE.logs:
        return {
            each.recording.name: [*none[:i], ~none[i], *none[i + 1 :]]
            for i, each in enumerate(samples)
        }
    found = {
        f"part {part + 1} of {CHOICE.parts}": [
            np.arange(len(rows)) * CHOICE.parts // len(rows) == part for rows in none
        ]
        for part in range(CHOICE.parts)
    }
    pressures = [each.recording.pressures[each.rows] for each in samples]
    everything = np.concatenate(pressures)
    norm = np.linalg.norm(everything, axis=1)
    rising = np.concatenate(
        [np.diff(each.sum(axis=1), prepend=each[:1].sum()) > 0 for each in pressures]
    )
    regions = {
        "highest pressures": norm > np.quantile(norm, 1 - CHOICE.top),
        "lowest pressures": norm < np.quantile(norm, CHOICE.top),
        "rising pressures": rising,
    }
    nearest = _nearest(everything)
    count = nearest.max() + 1
    regions |= {f"pressures, region {k + 1} of {count}": nearest == k for k in range(count)}
    ends = np.cumsum([len(rows) for rows in none])[:-1]
    for name, rows in regions.items():
        if 0 < rows.sum() < len(rows):
            found[name] = np.split(rows, ends)
    return found


def is_region(name: str) -> bool:
    """Whether a fold's name is that of a region of pressures, not of a log or stretch of time."""
    return "pressures" in name and not name.endswith((".csv", ".mcap"))


def _nearest(pressures: Array) -> NDArray[np.intp]:
    """Return the cluster (k-means) of each row of pressures (M, n)."""
    middles = pressures[centres(pressures, 0.0, CHOICE.regions)]
    for _ in range(CHOICE.rounds):
        squared = ((pressures[:, np.newaxis] - middles[np.newaxis]) ** 2).sum(axis=2)
        nearest = squared.argmin(axis=1)
        middles = np.array([pressures[nearest == k].mean(axis=0) for k in np.unique(nearest)])
    return np.unique(nearest, return_inverse=True)[1]


def _without_beginning(away: Rows, problem: CalibrationProblem, i: int, settle: float) -> Rows:
    sample = problem.samples[i]
    estimated = sample.begin == "unknown" or problem.unknowns.zeros[i]
    if not (estimated and away.all()):
        return away
    time = sample.recording.time[sample.rows]
    return np.asarray(away & (time > time[0] + settle))
