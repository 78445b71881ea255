"""Which pressures to command: a small quadratic program, solved in each tick.

The tip shall be moved by v from where the reference puts it, with pressures p as near to the
reference's as that leaves free::

    minimise   |W (J (p - r) - v)|^2 + epsilon |p - r|^2
    such that  low <= p <= high,   |p - last| <= slew,   |G (p - last)| <= speed

``p = last`` fulfils all of it as long as the last pressures are within their limits, which they
are: there is always an answer, though OSQP gives up on one in a thousand of the hardest.
Everything that goes in and comes out is checked for being finite and within the bounds, since what
solvers say of themselves cannot be relied on: OSQP answers 2e9 to a contradiction and NaN for ever
after one NaN, DAQP may give NaN with a flag of success.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import casadi as ca
import daqp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.control.demand import Demand
from stiffopt.control.formula import Formula

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
    demand :
        J, v and G, in symbols.
    low, high :
        What may be commanded (n,), in Pa.
    step :
        Greatest change from tick to tick (n,), in Pa.
    tip_step :
        By how much each coordinate of the tip may move from tick to tick, in m.
    solver :
        See `SOLVERS`.
    """

    def __init__(
        self,
        demand: Demand,
        low: Array,
        high: Array,
        step: Array,
        tip_step: float,
        solver: str = "daqp",
    ) -> None:
        self._program = _program(demand, step / _BAR, tip_step)
        self._answer = _answer(demand)
        self._solver = SOLVERS[solver](len(low), 3)
        self._nothing = np.zeros(len(low), dtype=bool)
        self.limit(low, high)

    def limit(self, low: Array, high: Array) -> None:
        """Allow these pressures (n,) from now on, in Pa."""
        self._low, self._high = low / _BAR, high / _BAR

    def solve(
        self, demanded: Sequence[ArrayLike], reference: Array, last: Array
    ) -> tuple[Array | None, NDArray[np.bool_], float]:
        """Answer the program.

        Parameters
        ----------
        demanded :
            Inputs of the demand.
        reference, last :
            r and the last pressures (n,), in Pa.

        Returns
        -------
        Pressures (n,) in Pa, None if there is no answer that can be used; which channels (n,) are
        held by a limit; and what the task's rows miss, in m.
        """
        H, f, G, lower, upper, finite, J, v = self._program(
            *demanded, reference, last, self._low, self._high
        )
        if not math.isfinite(finite[0]):
            return None, self._nothing, math.nan
        change = self._solver.solve(H, f, G, lower, upper)
        if change is None or change.shape != last.shape:
            return None, self._nothing, math.nan
        p, held, missing, beyond = self._answer(
            change, lower, upper, J, v, reference, last, self._low, self._high
        )
        if not beyond[0] <= _TRUSTED**2:  # nor if it is NaN
            return None, self._nothing, math.nan
        return p, held > 0, float(missing[0])


def _program(demand: Demand, step: Array, tip_step: float) -> Formula:
    """The program in terms of the change of pressures; in bar, and scaled.

    Gives H (n, n), f (n,), G (3, n), the bounds (n + 3,), a number that is finite only if all that
    went in is (what is not so in H is in f), and J and v.
    """
    J, v, n = demand.rows, demand.values, len(step)
    reference, last = ca.SX.sym("reference", n), ca.SX.sym("last", n)
    least, most = ca.SX.sym("least", n), ca.SX.sym("most", n)
    scaled, G = J * (_BAR / _KEPT_NEAR), demand.linear * _BAR
    before, reach = last / _BAR, ca.DM(step)
    H = scaled.T @ scaled + ca.SX.eye(n)
    f = scaled.T @ (v / -_KEPT_NEAR) - H @ (reference / _BAR - before)
    # a limit may have been tightened below the last pressures: then down as fast as may be
    upper = ca.fmax(ca.fmin(most - before, reach), -reach)
    lower = ca.fmin(ca.fmax(least - before, -reach), upper)
    # by as much as it has to come down where a limit was tightened, the tip may move faster
    forced = ca.fmax(ca.fmax(-upper, lower), 0)
    moves = max(tip_step, 1e-9) + ca.fabs(G) @ forced
    finite = ca.sumsqr(f) + ca.sumsqr(G)
    inputs = [*demand.inputs, reference, last, least, most]
    outputs = [H, f, G, ca.vertcat(lower, -moves), ca.vertcat(upper, moves), finite, J, v]
    return Formula(inputs, outputs, [*demand.matrices, H, G, J])


def _answer(demand: Demand) -> Formula:
    """What a change of the pressures (n,), in bar, comes to.

    Gives pressures (n,) in Pa, 1 where a limit holds them (n,), what the task's rows miss, in m,
    and the square of how far the change is beyond its bounds, in bar^2.
    """
    t, n = demand.rows.shape
    change, low, high = ca.SX.sym("change", n), ca.SX.sym("low", n + 3), ca.SX.sym("high", n + 3)
    J, v = ca.SX.sym("J", t, n), ca.SX.sym("v", t)
    reference, last = ca.SX.sym("reference", n), ca.SX.sym("last", n)
    least, most = ca.SX.sym("least", n), ca.SX.sym("most", n)
    bounded = ca.fmin(ca.fmax(change, low[:n]), high[:n])
    p = last / _BAR + bounded
    held = ca.logic_or(p <= least + _SLACK, p >= most - _SLACK)
    missing = (J @ (p * _BAR - reference) - v)[: demand.task_rows]
    beyond = ca.sumsqr(change - bounded)
    inputs = [change, low, high, J, v, reference, last, least, most]
    return Formula(inputs, [p * _BAR, held, ca.norm_2(missing), beyond], [J])
