"""Principal axes of a symmetric matrix (3, 3), as a formula.

In a tick, whose caches are cold, LAPACK takes longer for such a matrix than for all the rest that
depends on it.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

Symbols = Any  # of CasADi

_SWEEPS = 5  # each squares what is left off the diagonal
_TINY = 1e-300


def principal_axes(matrix: Symbols) -> tuple[Symbols, Symbols]:
    """Return the eigenvalues (3,) of a symmetric matrix (3, 3), ascending, and its axes (3, 3).

    The axes are columns. Jacobi's method: each rotation turns one element off the diagonal into
    zero, by the smaller of the two angles that do (G. Golub, C. Van Loan, Matrix Computations,
    section 8.5).
    """
    A, axes = ca.SX(matrix), ca.SX.eye(3)
    for _ in range(_SWEEPS):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            twice, apart = 2 * A[p, q], A[q, q] - A[p, p]
            sign = ca.if_else(apart < 0, -1, 1)
            tangent = sign * twice / (ca.fabs(apart) + ca.sqrt(apart**2 + twice**2) + _TINY)
            c = 1 / ca.sqrt(1 + tangent**2)
            s = tangent * c
            turn = ca.SX.eye(3)
            turn[p, p], turn[p, q], turn[q, p], turn[q, q] = c, s, -s, c
            A, axes = turn.T @ A @ turn, axes @ turn
            A[p, q] = A[q, p] = 0
    values, columns = ca.vertsplit(ca.diag(A)), ca.horzsplit(axes)
    for i, k in ((0, 1), (1, 2), (0, 1)):
        swap = values[i] > values[k]
        for of in (values, columns):
            of[i], of[k] = ca.if_else(swap, of[k], of[i]), ca.if_else(swap, of[i], of[k])
    return ca.vertcat(*values), ca.horzcat(*columns)
