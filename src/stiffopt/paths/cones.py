"""Solve a convex program over cones, by Clarabel."""

from __future__ import annotations

from collections.abc import Sequence

import clarabel
import numpy as np
from scipy import sparse

from stiffopt.arrays import Array


def minimised(
    P: sparse.csc_matrix, q: Array, A: sparse.csc_matrix, b: Array, cones: Sequence[object]
) -> tuple[Array, Array] | None:
    """Minimise ``x'Px/2 + q'x`` subject to ``A x + s = b``, s in the cones.

    P holds its upper triangle. Returns x and the multipliers; None if the solver fails.
    """
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    solution = clarabel.DefaultSolver(P, q, A, b, list(cones), settings).solve()
    if str(solution.status) not in ("Solved", "AlmostSolved"):
        return None
    return np.array(solution.x), np.array(solution.z)
