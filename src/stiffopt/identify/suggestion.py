"""Suggest poses to record next, which reduce the calibrated model's uncertainty the most.

Poses are chosen one after another from many candidates, each to minimise the tip's mean variance
over the arm's pressures (a greedy V-optimal design; Fedorov, Theory of Optimal Experiments, 1972).
The variance has two parts that recordings can reduce:

* the errors of the numbers with covariance C and slopes J of the tip, ``trace(J C J')``.  A pose
  with slopes J_c that is read with a covariance R leaves
  ``C - C J_c' (J_c C J_c' + R)^-1 J_c C``, so that the mean falls by
  ``trace((J_c C J_c' + R)^-1 J_c C M C J_c')`` with the mean M of ``J' J``;
* the discrepancy between model and arm, whose variance grows with the distance from recorded
  pressures (`stiffopt.model.calibration.ErrorModel`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.identify.settings import SUGGESTION
from stiffopt.model.calibration import Calibration, ErrorModel, RelativeErrors, growth
from stiffopt.model.description import RobotDescription
from stiffopt.model.parameters import Parameter
from stiffopt.model.uncertainty import ReadingSlopes


@dataclass(frozen=True, eq=False)
class Suggestion:
    """Poses to record next, with their expected benefit.

    Attributes
    ----------
    pressures : (m, n), in Pa, the most useful first.
    before, after : the reducible part of the tip's standard deviation, root mean square over the
        arm's pressures, in m: now, and expected after these poses are recorded.
    """

    pressures: Array
    before: float
    after: float


def suggest_poses(
    robot: RobotDescription,
    count: int = SUGGESTION.poses,
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
    is_allowed: Callable[[Array], bool] = lambda pressures: True,
) -> Suggestion:
    """Suggest poses to record next.

    Parameters
    ----------
    robot : calibrated.
    count : number of poses.
    low, high : (n,)
        Limits of pressures in Pa; by default the robot's.
    is_allowed : returns whether pressures (n,), in Pa, may be commanded.

    Raises
    ------
    InputError
        The robot file has no error model, or too few candidates are allowed.
    """
    calibration = robot.calibration
    if calibration is None or calibration.errors is None:
        raise InputError(
            f"robot '{robot.name}' has no model of its prediction errors; fit it to "
            "recordings with 'stiffopt calibrate'"
        )
    low = np.array(robot.pressure_min if low is None else low, dtype=float)
    high = np.array(robot.pressure_max if high is None else high, dtype=float)
    candidates = np.array([p for p in _candidates(low, high) if is_allowed(p)])
    if len(candidates) < count:
        raise InputError(f"there are only {len(candidates)} poses that the rig allows")
    return _Design(robot, calibration, calibration.errors, candidates).chosen(count)


def _candidates(low: Array, high: Array) -> Array:
    """Return pressures (N, n): each channel alone, all together, and a Halton set over the box."""
    from scipy.stats.qmc import Halton  # a large library; only fits need it

    base = np.clip(0.0, low, high)
    alone = [base + level * np.diag(high - base) for level in SUGGESTION.levels]
    together = [base + level * (high - base)[np.newaxis] for level in SUGGESTION.levels]
    spread = Halton(len(low), scramble=False).random(SUGGESTION.candidates)
    return np.round(np.vstack([*alone, *together, low + spread * (high - low)]), -2)


class _Design:
    """The uncertainty as poses are added; the candidates also represent all the arm's pressures."""

    def __init__(
        self,
        robot: RobotDescription,
        calibration: Calibration,
        errors: ErrorModel,
        candidates: Array,
    ) -> None:
        self._errors, self._candidates = errors, candidates
        self._channels = [segment.n_channels for segment in robot.segments]
        keys = [Parameter(each.key) for each in calibration.parameters]
        slopes = ReadingSlopes(robot, keys, len(calibration.frames))
        _, self._slopes, self._acting = slopes.at(candidates)
        self._covariance = calibration.covariance
        self._mean = np.mean(np.swapaxes(self._slopes, 1, 2) @ self._slopes, axis=0)
        # tip variance per variance of a segment's effective pressures, (N, segments)
        squares = (self._acting**2).sum(axis=1)
        ends = np.cumsum([0, *self._channels])
        self._weights = np.add.reduceat(squares, ends[:-1], axis=1)
        self._distances = errors.distances(self._channels, candidates)
        self._between = np.stack(
            [
                np.linalg.norm(candidates[:, np.newaxis, a:b] - candidates[:, a:b], axis=2)
                for a, b in pairwise(ends)
            ],
            axis=2,
        )
        recorded = np.array(errors.recorded)
        self._relative = [RelativeErrors(recorded[:, a:b], errors.range) for a, b in pairwise(ends)]
        self._smooth = [
            relative.covariance(candidates[:, a:b])
            for relative, (a, b) in zip(self._relative, pairwise(ends), strict=True)
        ]

    def chosen(self, count: int) -> Suggestion:
        """Choose poses greedily."""
        before, chosen = self._deviation(), list[int]()
        for _ in range(count):
            gains = self._gains()
            gains[chosen] = -np.inf
            chosen.append(int(np.argmax(gains)))
            self._record(chosen[-1])
        return Suggestion(self._candidates[chosen], before, self._deviation())

    def _variance(self, distances: Array, smooth: Array) -> Array:
        """Return a channel's discrepancy variance (N, segments), in Pa^2.

        Given are distances from recorded pressures, and variances of relative errors.
        """
        known = self._errors
        share = growth(distances, known.reach)
        return np.asarray(known.discrepancy**2 * share + known.gain**2 * smooth)

    def _after(self, index: int) -> list[Array]:
        """Return the covariances (N, N) of relative errors as if a candidate had been recorded."""
        return [
            relative.recorded(covariance, index)
            for relative, covariance in zip(self._relative, self._smooth, strict=True)
        ]

    def _reading(self, index: int) -> Array:
        """Return the covariance (3, 3), in m^2, of a candidate's reading given the parameters."""
        variance = np.repeat(self._errors.discrepancy**2, self._acting.shape[2])
        own = self._acting[index]
        return np.asarray(self._errors.residual**2 * np.eye(3) + (own * variance) @ own.T)

    def _seen(self, index: int) -> tuple[Array, Array]:
        """Return J C (3, k) of a candidate, and the inverse covariance (3, 3) of its reading."""
        slope = self._slopes[index]
        seen = slope @ self._covariance
        return seen, np.linalg.inv(seen @ slope.T + self._reading(index))

    def _gains(self) -> Array:
        """Return by how much each candidate (N,) would lower the mean variance, in m^2."""
        now = self._variance(self._distances, _diagonals(self._smooth))
        found = np.zeros(len(self._candidates))
        for index in range(len(self._candidates)):
            seen, inverse = self._seen(index)
            then = self._variance(
                np.minimum(self._distances, self._between[index]), _diagonals(self._after(index))
            )
            found[index] = np.trace(inverse @ seen @ self._mean @ seen.T)
            found[index] += np.mean((self._weights * (now - then)).sum(axis=1))
        return found

    def _record(self, index: int) -> None:
        """Update the uncertainty as if a candidate had been recorded."""
        seen, inverse = self._seen(index)
        self._covariance = self._covariance - seen.T @ inverse @ seen
        self._distances = np.minimum(self._distances, self._between[index])
        self._smooth = self._after(index)

    def _deviation(self) -> float:
        """Return the tip's standard deviation in m, root mean square over all pressures."""
        variance = self._variance(self._distances, _diagonals(self._smooth))
        discrepancy = np.mean((self._weights * variance).sum(axis=1))
        return float(np.sqrt(np.trace(self._mean @ self._covariance) + discrepancy))


def _diagonals(covariances: list[Array]) -> Array:
    """Return the diagonals (N, k) of k matrices (N, N)."""
    return np.stack([np.diagonal(each) for each in covariances], axis=1)
