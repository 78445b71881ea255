"""Which model predicts what it was not fitted to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import InputError
from stiffopt.identify.comparison import Errors
from stiffopt.identify.fit import Fit, fit
from stiffopt.identify.problem import Problem
from stiffopt.identify.setup import without
from stiffopt.identify.structure import Structure

__all__ = ["Candidate", "best", "held_back_errors"]

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

_LOGS = 3  # as many or more are held back one by one; of fewer, parts are
_PARTS = 4
_TOP = 0.2  # share of the rows with the highest pressures, which are held back too
_MOST_EVALUATIONS = 20  # of a fit that begins near its end
_NO_WORSE = 0.02  # a simpler model may be so much worse


@dataclass(frozen=True, eq=False)
class Candidate:
    """A model and how it did.

    Attributes
    ----------
    structure : Structure
    fit : Fit
        To all rows of the trial.
    folds : dict of str to Errors
        Errors of what was held back, by what that was.
    """

    structure: Structure
    fit: Fit
    folds: dict[str, Errors] = field(default_factory=dict)

    @property
    def score(self) -> float:
        """Mean error over what was held back, in m."""
        return float(np.mean([errors.mean for errors in self.folds.values()]))


def held_back_errors(found: Fit, settle: float, tell: Callable[[], None]) -> dict[str, Errors]:
    """Errors in logs or parts of logs when the others are fitted.

    Parameters
    ----------
    found : Fit
        To all of them; the other fits begin there.
    settle : float
        Of a log that begins in an unknown state this many s at its beginning still count, as they
        would if it were predicted.
    """
    problem = found.problem
    errors = {}
    for name, away in _folds(problem).items():
        kept = [_without_beginning(each, problem, i, settle) for i, each in enumerate(away)]
        if not any(each.any() for each in kept):
            continue  # a log that ends before its beginning does
        x = fit(without(problem, kept), [found.x], tell, rounds=0, most=_MOST_EVALUATIONS).x
        distances = np.linalg.norm(problem.predict(x).errors[0], axis=1)
        found_there = Errors.of(distances[np.concatenate(kept)], None)
        if found_there.n:
            errors[name] = found_there
    if not errors:
        raise InputError(
            "there is nothing left to compare models with; expected longer logs, or name a model"
        )
    return errors


def best(candidates: Sequence[Candidate]) -> Candidate:
    """The simplest model of those that predict about as well as the best.

    About as well is within one standard error of the difference over what was held back, or
    within two per cent.
    """
    leader = min(candidates, key=lambda candidate: candidate.score)
    reference = _means(leader)
    for candidate in candidates:  # the simplest first
        worse = _means(candidate) - reference
        error = float(np.std(worse, ddof=1) / np.sqrt(len(worse))) if len(worse) > 1 else 0.0
        if worse.mean() <= max(error, _NO_WORSE * reference.mean()):
            return candidate
    return leader


def _means(candidate: Candidate) -> Array:
    return np.array([errors.mean for errors in candidate.folds.values()])


def _folds(problem: Problem) -> dict[str, list[Rows]]:
    """Rows of each sample that are held back together, by a name of them."""
    samples = problem.samples
    none = [np.zeros(len(each.rows), dtype=bool) for each in samples]
    folds: dict[str, list[Rows]] = {}
    if len(samples) >= _LOGS:
        for i, each in enumerate(samples):
            folds[each.recording.name] = [*none[:i], ~none[i], *none[i + 1 :]]
        return folds
    for part in range(_PARTS):
        folds[f"part {part + 1} of {_PARTS}"] = [
            np.arange(len(rows)) * _PARTS // len(rows) == part for rows in none
        ]
    norms = [np.linalg.norm(each.recording.pressures[each.rows], axis=1) for each in samples]
    high = np.quantile(np.concatenate(norms), 1 - _TOP)
    folds["highest pressures"] = [norm > high for norm in norms]
    return folds


def _without_beginning(away: Rows, problem: Problem, i: int, settle: float) -> Rows:
    sample = problem.samples[i]
    estimated = sample.begin == "unknown" or problem.unknowns.zeros[i]
    if not (estimated and away.all()):
        return away
    time = sample.recording.time[sample.rows]
    return np.asarray(away & (time > time[0] + settle))
