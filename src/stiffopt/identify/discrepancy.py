"""Systematic model error: the part of the residuals that rows at nearby pressures share.

Repeating the same circle does not reveal more about a model's systematic error: rows at nearby
pressures share it.  So the error of each axis is modelled as the sum of a smooth function of the
pressures, a Gaussian process (M. C. Kennedy and A. O'Hagan, Bayesian calibration of computer
models, 2001), and independent noise: ``error = Z b + noise``.  The coefficients b belong to centres
among the recorded pressures and have variance one.  For any parameters of the model, the best b
follows by linear least squares; the fit's residuals are then the remaining errors and b itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stiffopt.arrays import Array
from stiffopt.identify.settings import FIT

_JITTER = 1e-6  # added to the diagonal of the centres' correlation, so that it stays regular


def centres(points: Array, spacing: float, limit: int, chosen: Sequence[int] = (0,)) -> list[int]:
    """Choose points that spread over the set (farthest-point sampling).

    Start from `chosen`. Add the point farthest from those chosen until every point lies within
    `spacing` of one of them, or until `limit` are chosen.

    Parameters
    ----------
    points : (M, k)
    spacing : in units of the points.
    limit : largest number of points, those of `chosen` included.
    chosen : rows to begin with.

    Returns
    -------
    Rows of `points`, in the order of their choice.
    """
    rows = list(chosen)
    nearest = np.min([((points - points[row]) ** 2).sum(axis=1) for row in rows], axis=0)
    while len(rows) < limit and nearest.max() > spacing**2:
        rows.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, ((points - points[rows[-1]]) ** 2).sum(axis=1))
    return rows


def smooth_functions(pressures: Array) -> Array:
    """Return basis functions Z (M, m) at recorded pressures (M, n).

    ``Z Z'`` approximates the correlation of the rows, which is ``exp(-r^2 / 2 l^2)`` for rows at a
    distance r in pressure; l is the share `FitSettings.near` of the highest recorded pressure.
    """
    points = pressures / (FIT.near * (np.abs(pressures).max(initial=0.0) or 1.0))
    middle = points[centres(points, FIT.centres_apart, FIT.most_centres)]
    root = np.linalg.cholesky(_correlation(middle, middle) + _JITTER * np.eye(len(middle)))
    return np.asarray(np.linalg.solve(root, _correlation(middle, points)).T)


def _correlation(one: Array, other: Array) -> Array:
    squared = ((one[:, np.newaxis] - other[np.newaxis]) ** 2).sum(axis=2)
    return np.asarray(np.exp(-squared / 2))


@dataclass(frozen=True, eq=False)
class Systematic:
    """Splits errors of rows into a systematic part and the rest, in deviations of their noise.

    Attributes
    ----------
    functions : basis functions Z (M, m); their coefficients have variance one.
    """

    functions: Array
    _orthogonal: Array
    _triangle: Array

    @classmethod
    def of(cls, functions: Array) -> Systematic:
        """Factorise basis functions (M, m), which are zero in rows that do not count."""
        stacked = np.vstack([functions, np.eye(functions.shape[1])])
        orthogonal, triangle = np.linalg.qr(stacked)
        return cls(functions, orthogonal, triangle)

    def residuals(self, errors: Array) -> Array:
        """Return ``errors - Z b`` for errors (M, c), then ``-b``, stacked: (M + m, c).

        b minimises ``|errors - Z b|^2 + |b|^2``. The minimum, the sum of the squared residuals, is
        ``errors' (1 + Z Z')^-1 errors``.
        """
        found = -self._orthogonal @ (self._orthogonal[: len(errors)].T @ errors)
        found[: len(errors)] += errors
        return np.asarray(found)

    def part(self, errors: Array) -> Array:
        """Return the systematic part ``Z b`` (M, c) of errors (M, c)."""
        taken = self._orthogonal[: len(errors)].T @ errors
        return np.asarray(self.functions @ np.linalg.solve(self._triangle, taken))

    @property
    def root(self) -> Array:
        """Root U (M, m) of the covariance ``U U' = Z (1 + Z'Z)^-1 Z'`` of `part`, for each axis.

        That is how far the systematic part may still be from `part`, its mean given the errors.
        """
        return self._orthogonal[: len(self.functions)]
