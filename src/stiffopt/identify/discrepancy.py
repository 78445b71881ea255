"""What a model cannot describe: a systematic error that rows at nearby pressures or times share.

A thousand rows on one turn of a circle, and a thousand turns of it, tell the same about a model
that is wrong there.  So the errors of each axis are taken for the sum of a smooth function of the
recorded pressures, a slow drift within each log, and noise of each row.  The first two are
Gaussian processes (M. C. Kennedy and A. O'Hagan, Bayesian calibration of computer models, 2001),
here by their projections on few centres: ``error = Z b + noise`` with b of variance one.  For every
model the best b is found along with the residuals, so that the fit sees what smooth errors and
noise cannot explain, and what is paid for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stiffopt.identify.settings import FIT

Array = NDArray[np.float64]


def basis(points: Array, most: int) -> Array:
    """Functions (M, m) of points (N = M, k), in scales: ``basis @ basis.T`` is their correlation.

    The correlation of two points at a distance of r scales is ``exp(-r^2 / 2)``.
    """
    centres = points[_centres(points, most)]
    among = _correlation(centres, centres) + 1e-6 * np.eye(len(centres))
    root = np.linalg.cholesky(among)
    return np.asarray(np.linalg.solve(root, _correlation(centres, points)).T)


def _centres(points: Array, most: int) -> list[int]:
    """Points far from each other, such that hardly a point is farther than a scale from one."""
    chosen = [0]
    nearest = ((points - points[0]) ** 2).sum(axis=1)
    while len(chosen) < most and nearest.max() > FIT.centres_apart**2:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
    return chosen


def _correlation(one: Array, other: Array) -> Array:
    squared = ((one[:, np.newaxis] - other[np.newaxis]) ** 2).sum(axis=2)
    return np.asarray(np.exp(-squared / 2))


@dataclass(frozen=True, eq=False)
class Shared:
    """Systematic errors of rows, by functions Z (M, m) whose coefficients have the variance one.

    Rows are divided by their noise; those that do not count are zero.
    """

    functions: Array
    orthogonal: Array  # (M + m, m), of the functions and the prior of their coefficients
    triangle: Array

    @classmethod
    def of(cls, functions: Array) -> Shared:
        """Of functions (M, m) that are divided by the noise of each row."""
        stacked = np.vstack([functions, np.eye(functions.shape[1])])
        orthogonal, triangle = np.linalg.qr(stacked)
        return cls(functions, orthogonal, triangle)

    def left(self, errors: Array) -> Array:
        """Errors (M + m, c) that are left of errors (M, c), and the coefficients that took them."""
        own = self.orthogonal.T[:, : len(errors)] @ errors
        found = -self.orthogonal @ own
        found[: len(errors)] += errors
        return np.asarray(found)

    def coefficients(self, errors: Array) -> tuple[Array, Array]:
        """Coefficients (m, c) of errors (M, c), and their variances (m,)."""
        own = self.orthogonal.T[:, : len(errors)] @ errors
        inverse = np.linalg.inv(self.triangle)
        return inverse @ own, np.asarray((inverse**2).sum(axis=1))
