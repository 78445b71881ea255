"""What a model cannot describe: a systematic error that rows at nearby pressures share.

A thousand rows on one turn of a circle, and a thousand turns of it, tell the same of a model that
is wrong there.  So the errors of each axis are taken for the sum of a smooth function of the
pressures, a Gaussian process (M. C. Kennedy and A. O'Hagan, Bayesian calibration of computer
models, 2001), and of noise of each row: ``error = Z b + noise`` with coefficients b of variance
one, about centres among the recorded pressures.  Whatever the numbers of the model, the best b is
found along with the residuals; these are what it leaves, and b itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stiffopt.identify.settings import FIT

Array = NDArray[np.float64]

_ROUNDING = 1e-6  # of a correlation, that keeps the centres' matrix regular


def centres(points: Array, apart: float, most: int, chosen: Sequence[int] = (0,)) -> list[int]:
    """Rows of points (M, k), each as far as can be from those before it, until all are near one.

    Parameters
    ----------
    points : (M, k)
    apart : distance that counts as near.
    most : of them.
    chosen : rows to begin with.
    """
    found = list(chosen)
    nearest = np.min([((points - points[row]) ** 2).sum(axis=1) for row in found], axis=0)
    while len(found) < most and nearest.max() > apart**2:
        found.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, ((points - points[found[-1]]) ** 2).sum(axis=1))
    return found


def smooth_functions(pressures: Array) -> Array:
    """Functions (M, m) of recorded pressures (M, n); their products are correlations of rows.

    Rows at a distance r in pressure are correlated by ``exp(-r^2 / 2 l^2)``, where l is the share
    `FitSettings.near` of the highest recorded pressure.
    """
    points = pressures / (FIT.near * (np.abs(pressures).max(initial=0.0) or 1.0))
    middle = points[centres(points, FIT.centres_apart, FIT.most_centres)]
    root = np.linalg.cholesky(_correlation(middle, middle) + _ROUNDING * np.eye(len(middle)))
    return np.asarray(np.linalg.solve(root, _correlation(middle, points)).T)


def _correlation(one: Array, other: Array) -> Array:
    squared = ((one[:, np.newaxis] - other[np.newaxis]) ** 2).sum(axis=2)
    return np.asarray(np.exp(-squared / 2))


@dataclass(frozen=True, eq=False)
class Systematic:
    """Systematic errors of rows, in deviations of their noise.

    Attributes
    ----------
    functions : Z (M, m), of coefficients that have the variance one.
    """

    functions: Array
    _orthogonal: Array
    _triangle: Array

    @classmethod
    def of(cls, functions: Array) -> Systematic:
        """Of functions (M, m), zero in rows that do not count."""
        stacked = np.vstack([functions, np.eye(functions.shape[1])])
        orthogonal, triangle = np.linalg.qr(stacked)
        return cls(functions, orthogonal, triangle)

    def residuals(self, errors: Array) -> Array:
        """What is left of errors (M, c), and the coefficients that took the rest: (M + m, c).

        Their sum of squares is the least of ``|errors - Z b|^2 + |b|^2``, which is
        ``errors' (1 + Z Z')^-1 errors``.
        """
        found = -self._orthogonal @ (self._orthogonal[: len(errors)].T @ errors)
        found[: len(errors)] += errors
        return np.asarray(found)

    def part(self, errors: Array) -> Array:
        """The systematic part (M, c) of errors (M, c)."""
        taken = self._orthogonal[: len(errors)].T @ errors
        return np.asarray(self.functions @ np.linalg.solve(self._triangle, taken))
