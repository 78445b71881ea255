"""Solve small convex quadratic programs with daqp."""

import math

import daqp
import numpy as np

from stiffopt.arrays import Array

FAR = 1e6
"""Value of a bound that is absent."""


def solve_qp(H: Array, g: Array, A: Array, low: Array, high: Array) -> tuple[Array, Array] | None:
    """Minimise ``z'Hz/2 + g'z`` subject to ``low <= (z, Az) <= high``.

    Arrays must be contiguous.  Returns the solution and the multipliers; None if the solver's
    answer is not finite or not marked as optimal.
    """
    sense = np.zeros(len(low), dtype=np.int32)
    z, _, flag, info = daqp.solve(H, g, A, high, low, sense, primal_tol=1e-9)
    z, multipliers = np.asarray(z), np.asarray(info["lam"])
    if flag < 1 or not math.isfinite(z.dot(z) + multipliers.dot(multipliers)):
        return None
    return z, multipliers
