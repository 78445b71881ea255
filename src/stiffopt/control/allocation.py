"""Which pressures to command: a small quadratic program, solved in each tick.

The tip shall be moved by v from where the reference puts it, with pressures p as near to the
reference's as that leaves free::

    minimise   |W (J (p - r) - v)|^2 + epsilon |p - r|^2
    such that  low <= p <= high,   |p - last| <= slew,   |G (p - last)| <= speed

``p = last`` fulfils all of it as long as the last pressures are within their limits, which they
are: there is always an answer.  Everything that goes in and comes out is checked for being finite
and within the bounds, since what solvers say of themselves cannot be relied on: OSQP answers 2e9
to a contradiction and NaN for ever after one NaN, DAQP may give NaN with a flag of success.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import daqp
import numpy as np
from numpy.typing import NDArray

__all__ = ["SOLVERS", "Allocation", "QuadraticSolver"]

Array = NDArray[np.float64]

_BAR = 1e5
_KEPT_NEAR = 0.3e-3  # m/bar; sqrt(epsilon): tip motions cheaper than this are left to the posture
_SLACK = 1e-4  # bar
_TRUSTED = 1e-3  # bar; a solver that breaks a bound by more has no answer


class QuadraticSolver(ABC):
    """Solves ``min 1/2 x^T H x + f^T x``, lower <= (x, A x) <= upper, for n unknowns and m rows."""

    @abstractmethod
    def __init__(self, n: int, m: int) -> None: ...

    @abstractmethod
    def solve(self, H: Array, f: Array, A: Array, lower: Array, upper: Array) -> Array | None:
        """Return x (n,), or what the solver has instead; None if it has nothing."""


class DaqpSolver(QuadraticSolver):
    """DAQP, a dual active-set method."""

    def __init__(self, n: int, m: int) -> None:
        self._sense = np.zeros(n + m, dtype=np.int32)

    def solve(self, H: Array, f: Array, A: Array, lower: Array, upper: Array) -> Array | None:
        """See `QuadraticSolver.solve`."""
        x, _, _, _ = daqp.solve(H, f, A, upper, lower, self._sense.copy())
        return np.array(x) if x is not None else None


class OsqpSolver(QuadraticSolver):
    """OSQP, an operator-splitting method, with a workspace that persists."""

    def __init__(self, n: int, m: int) -> None:
        self._n, self._m = n, m
        self._upper = np.triu_indices(n)
        order = np.lexsort(self._upper)  # by column, as OSQP stores them
        self._upper = (self._upper[0][order], self._upper[1][order])
        self._make()

    def _make(self) -> None:
        import osqp
        from scipy import sparse

        n, m = self._n, self._m
        P = sparse.csc_matrix(np.triu(np.ones((n, n))))
        rows = np.vstack([np.eye(n), np.ones((m, n))])
        self._A = sparse.csc_matrix(rows)
        # places of the entries of the rows below the unit matrix, by column
        self._values = self._A.data.copy()
        self._places = (np.arange(m) + 1 + np.arange(n)[:, None] * (m + 1)).ravel()
        P.data[:] = np.eye(n)[self._upper]
        bound = np.ones(n + m)
        self._problem = osqp.OSQP()
        self._problem.setup(
            P, np.zeros(n), self._A, -bound, bound,
            verbose=False, eps_abs=1e-6, eps_rel=1e-6, max_iter=2000, polishing=False,
            warm_starting=True,
        )  # fmt: skip

    def solve(self, H: Array, f: Array, A: Array, lower: Array, upper: Array) -> Array | None:
        """See `QuadraticSolver.solve`."""
        self._values[self._places] = A.T.ravel()
        self._problem.update(q=f, l=lower, u=upper, Px=H[self._upper], Ax=self._values)
        x = self._problem.solve(raise_error=False).x
        if x is None or not np.isfinite(x).all():
            self._make()  # it would stay so
            return None
        result: Array = np.array(x)
        return result


SOLVERS: dict[str, type[QuadraticSolver]] = {"daqp": DaqpSolver, "osqp": OsqpSolver}


class Allocation:
    """The quadratic program of an arm with n channels.

    Parameters
    ----------
    low, high :
        What may be commanded (n,), in Pa.
    step :
        Greatest change from tick to tick (n,), in Pa.
    solver :
        See `SOLVERS`.
    """

    def __init__(self, low: Array, high: Array, step: Array, solver: str = "daqp") -> None:
        self.limit(low, high)
        self._step = step / _BAR
        self._solver = SOLVERS[solver](len(low), 3)
        self._identity = np.eye(len(low))

    def limit(self, low: Array, high: Array) -> None:
        """Allow these pressures (n,) from now on, in Pa."""
        self._low, self._high = low / _BAR, high / _BAR

    def solve(
        self,
        jacobian: Array,
        wanted: Array,
        reference: Array,
        last: Array,
        tip_jacobian: Array,
        tip_step: float,
    ) -> tuple[Array | None, NDArray[np.bool_]]:
        """Answer the program.

        Parameters
        ----------
        jacobian, wanted :
            J (t, n) per Pa and v (t,), already weighted: all in m.
        reference, last :
            r and the last pressures (n,), in Pa.
        tip_jacobian, tip_step :
            G (3, n) per Pa, and by how much each coordinate of the tip may move, in m.

        Returns
        -------
        Pressures (n,) in Pa, None if there is no answer that can be used; and which channels (n,)
        are held by a limit.
        """
        nothing = np.zeros(len(last), dtype=bool)
        with np.errstate(invalid="ignore", over="ignore"):  # it is looked for
            J = jacobian * (_BAR / _KEPT_NEAR)
            before = last / _BAR
            H = J.T @ J + self._identity
            f = J.T @ (wanted * (-1 / _KEPT_NEAR)) - H @ (reference / _BAR - before)
            rows = tip_jacobian * _BAR
            given = float(f @ f) + float(np.vdot(rows, rows))  # what is not finite in H is in f
        if not math.isfinite(given):
            return None, nothing
        lower = np.maximum(self._low - before, -self._step)
        upper = np.minimum(self._high - before, self._step)
        # a limit may have been tightened below the last pressures: then down as fast as may be
        upper = np.maximum(upper, -self._step)
        lower = np.minimum(lower, upper)
        # by as much as it has to come down where a limit was tightened, the tip may move faster
        forced = np.maximum(np.maximum(-upper, lower), 0.0)
        reach = max(tip_step, 1e-9) + np.abs(rows) @ forced
        low, high = np.concatenate([lower, -reach]), np.concatenate([upper, reach])
        change = self._solver.solve(H, f, rows, low, high)
        if change is None or change.shape != last.shape:
            return None, nothing
        bounded = np.minimum(np.maximum(change, lower), upper)
        if not float(np.abs(bounded - change).max()) <= _TRUSTED:  # nor if it is NaN
            return None, nothing
        p = before + bounded
        held = (p <= self._low + _SLACK) | (p >= self._high - _SLACK)
        return p * _BAR, held
