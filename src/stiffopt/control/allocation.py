"""The quadratic program that turns the feedback law into pressures, solved in every tick.

The tip is to move by v relative to the reference, with pressures p as near to the reference's r as
possible::

    minimise   |W (J (p - r) - v)|^2 + epsilon |p - r|^2
    such that  low <= p <= high,   |p - last| <= slew,   |G (p - last)| <= speed

``p = last`` is feasible as long as the last pressures are within their limits, which they are. So
there is always a solution, though OSQP gives up on one in a thousand of the hardest problems. All
inputs and outputs are checked to be finite and within bounds, because solvers' flags are not
reliable: OSQP answers 2e9 to a contradiction, and NaN for ever after one NaN; DAQP may return NaN
with a flag of success. An answer that moves the tip too fast (OSQP, where it ran out of iterations)
is shortened until it does not.

Most often the same bounds are active as in the tick before. So the formula that makes the program
also solves it with these bounds as equations, and checks the conditions of an optimum (Karush, Kuhn
and Tucker). The program is strictly convex, so what meets them is its only solution; otherwise the
solver is asked.

The reference and the gate limit the slew too: the reference as a whole, so that its path stays
straight, the gate each channel, by the time since the last command. Here it is a bound of the
program, which thus finds the best pressures that the gate passes unchanged; a test checks that.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import casadi as ca
import daqp
import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array, Flags
from stiffopt.control.feedback import TrackingRows
from stiffopt.control.formula import Formula
from stiffopt.control.tuning import FeedbackTuning

Symbols = Any  # of CasADi

_BAR = 1e5
_SLACK = 1e-4  # bar; a pressure within this of a limit counts as being at it
_BOUND_ERROR = 1e-3  # bar; a solution that violates its bounds by more is rejected
_ROUNDING = 1e-11  # bar; a bound counts as kept, and as active, within this


class QuadraticSolver(ABC):
    """Solves ``min 1/2 x^T H x + f^T x``, lower <= (x, A x) <= upper, for n unknowns and m rows."""

    @abstractmethod
    def __init__(self, n: int, m: int) -> None: ...

    @abstractmethod
    def solve(self, H: Array, f: Array, A: Array, lower: Array, upper: Array) -> Array | None:
        """Return x (n,), not checked; None if the solver finds none.

        The next program may overwrite the arrays, which are contiguous.
        """


class DaqpSolver(QuadraticSolver):
    """DAQP: a dual active-set method."""

    def __init__(self, n: int, m: int) -> None:
        self._sense = np.zeros(n + m, dtype=np.int32)

    def solve(self, H: Array, f: Array, A: Array, lower: Array, upper: Array) -> Array | None:
        """See `QuadraticSolver.solve`."""
        x, _, _, _ = daqp.solve(H, f, A, upper, lower, self._sense.copy())
        return np.array(x) if x is not None else None


class OsqpSolver(QuadraticSolver):
    """OSQP: an operator-splitting method, with a persistent workspace."""

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
        # indices of A's entries in the data, column by column, below those of the unit matrix
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
            self._make()  # the workspace keeps NaN otherwise
            return None
        return np.array(x)


SOLVERS: dict[str, type[QuadraticSolver]] = {"daqp": DaqpSolver, "osqp": OsqpSolver}


class Allocation:
    """The quadratic program of an arm with n channels.

    The feedback law gives J, v and G, the tuning W and epsilon. Commands stay between `low` and
    `high` (n,), in Pa, and change by at most `step` (n,) from tick to tick; the tip moves by at
    most `tip_step` along each axis, in m.
    """

    def __init__(
        self,
        law: TrackingRows,
        low: Array,
        high: Array,
        step: Array,
        tip_step: float,
        solver: str = "daqp",
        tuning: FeedbackTuning | None = None,
    ) -> None:
        weight = (tuning or FeedbackTuning()).posture_weight
        self._program = _program(law, step / _BAR, tip_step, weight)
        self._solution = _solution(law, self._program)
        self._solver = SOLVERS[solver](len(low), 3)
        self._none_held = np.zeros(len(low), dtype=bool)
        # active bounds (n,) of the last solution: 1 for upper ones, -1 for lower ones
        self._active: Array = np.zeros(len(low))
        self.limit(low, high)

    def limit(self, low: Array, high: Array) -> None:
        """Change the limits of the pressures (n,), in Pa."""
        self._low, self._high = low, high

    def solve(
        self, inputs: Sequence[ArrayLike], reference: Array, last: Array
    ) -> tuple[Array | None, Flags, float]:
        """Solve the program for inputs of the feedback law, r and the last pressures (n,), in Pa.

        Returns
        -------
        Pressures (n,) in Pa, None without a usable solution; flags (n,) of the channels at a limit;
        and the residual of the task's rows, in m.
        """
        H, f, G, lower, upper, finite, _, _, _, p, held, residual, is_solution = self._program.view(
            *inputs, reference, last, self._low, self._high, self._active
        )
        if not math.isfinite(finite[0]):
            return None, self._none_held, math.nan
        if is_solution[0]:
            return p.copy(), held > 0, float(residual[0])
        change = self._solver.solve(H.T, f, G.T, lower, upper)
        if change is None or change.shape != last.shape:
            return None, self._none_held, math.nan
        p, held, residual, violation = self._solution.view(change)
        if not violation[0] <= _BOUND_ERROR**2:  # NaN is rejected too
            return None, self._none_held, math.nan
        above = change >= upper[: len(last)] - _ROUNDING
        below = change <= lower[: len(last)] + _ROUNDING
        self._active = np.where(above, 1.0, np.where(below, -1.0, 0.0))
        return p.copy(), held > 0, float(residual[0])


def _program(law: TrackingRows, step: Array, tip_step: float, weight: float) -> Formula:
    """Return the formula of the program for the change of pressures; in bar, and scaled.

    Outputs: H (n, n), f (n,), the transpose of G (n, 3), the bounds (n + 3,), a number that is
    finite only if all inputs are (an entry of H that is not finite makes f so too), J, v, and r
    and the last pressures, in Pa, and the limits, in bar (n, 4). Then, with active bounds (n,) as
    in the last input: pressures, channels at a limit and residual as in `_solution`, and 1 if that
    is the solution.
    """
    J, v, n = law.rows, law.values, len(step)
    reference, last = ca.SX.sym("reference", n), ca.SX.sym("last", n)
    limits, active = [ca.SX.sym("low", n), ca.SX.sym("high", n)], ca.SX.sym("active", n)
    low, high = (limit / _BAR for limit in limits)
    scaled, G = J * (_BAR / weight), law.linear * _BAR
    before, reach = last / _BAR, ca.DM(step)
    H = ca.tril2symm(ca.tril(scaled.T @ scaled)) + ca.SX.eye(n)
    f = scaled.T @ (v / -weight) - H @ (reference / _BAR - before)
    # a limit may be below the last pressures: go down as fast as the slew allows
    upper = ca.fmax(ca.fmin(high - before, reach), -reach)
    lower = ca.fmin(ca.fmax(low - before, -reach), upper)
    # the tip may be faster by what such a limit requires
    forced = ca.fmax(ca.fmax(-upper, lower), 0)
    displacement = max(tip_step, 1e-9) + ca.fabs(G) @ forced
    finite = ca.sumsqr(f) + ca.sumsqr(G)
    bounds = [ca.vertcat(lower, -displacement), ca.vertcat(upper, displacement)]
    known = ca.horzcat(reference, last, low, high)
    change = _with_active(H, f, ca.if_else(active > 0, upper, lower), active**2)
    beyond = ca.vertcat(change - upper, lower - change, ca.fabs(G @ change) - displacement)
    inward = active * (H @ change + f) * (upper > lower)  # an active bound must hold it back
    kept = ca.vertcat(beyond, inward) <= _ROUNDING  # not for NaN
    outputs = [H, f, G.T, *bounds, finite, J, v, known]
    *found, _ = _evaluated(outputs, change, law.task_rows)
    is_solution = ca.sum1(kept) == kept.numel()
    inputs = [*law.inputs, reference, last, *limits, active]
    return Formula(inputs, [*outputs, *found, is_solution], [*law.matrices, H, J])


def _with_active(H: Symbols, f: Symbols, fixed: Symbols, is_fixed: Symbols) -> Symbols:
    """Return x (n,) that minimises ``1/2 x^T H x + f^T x`` with some x_i fixed, by Cholesky."""
    n, free = H.shape[0], 1 - is_fixed
    fixed = is_fixed * fixed
    M = ca.diag(free) @ H @ ca.diag(free) + ca.diag(is_fixed)
    x = ca.vertsplit(fixed - free * (f + H @ fixed))
    L = ca.SX.zeros(n, n)
    for i in range(n):
        for k in range(i):
            L[i, k] = (M[i, k] - ca.dot(L[i, :k], L[k, :k])) / L[k, k]
        L[i, i] = ca.sqrt(M[i, i] - ca.sumsqr(L[i, :i]))
        x[i] = (x[i] - sum(L[i, k] * x[k] for k in range(i))) / L[i, i]
    for i in reversed(range(n)):
        x[i] = (x[i] - sum(L[k, i] * x[k] for k in range(i + 1, n))) / L[i, i]
    return ca.vertcat(*x)


def _solution(law: TrackingRows, program: Formula) -> Formula:
    """Return the formula that evaluates a change of the pressures (n,), in bar, after a program.

    Outputs: pressures (n,) in Pa, 1 for channels at a limit (n,), the residual of the task's rows
    in m, and the square of the violation of the change's bounds, in bar^2.
    """
    t, n = law.rows.shape
    of_program = [(n, n), (n, 1), (n, 3), (n + 3, 1), (n + 3, 1), (1, 1), (t, n), (t, 1), (n, 4)]
    of_program += [(n, 1), (n, 1), (1, 1), (1, 1)]
    outputs = [ca.SX.sym("output", *shape) for shape in of_program]
    change = ca.SX.sym("change", n)
    found = _evaluated(outputs, change, law.task_rows)
    return Formula([*outputs, change], found, before=program)


def _evaluated(program: Sequence[Symbols], change: Symbols, task_rows: int) -> list[Symbols]:
    """Return what `_solution` does, for outputs of the program and a change (n,)."""
    _, _, transposed, lower, upper, _, J, v, known, *_ = program
    n, G = change.shape[0], transposed.T
    reference, last, low, high = ca.horzsplit(known)
    bounded = ca.fmin(ca.fmax(change, lower[:n]), upper[:n])
    # The change nearest to none is within all bounds, and so is the way from it up to a share s.
    least = ca.fmin(ca.fmax(0, lower[:n]), upper[:n])
    start, way = G @ least, G @ (bounded - least)
    room = upper[n:] - ca.sign(way) * start
    share = ca.mmin(ca.fmin(1, room / ca.fmax(ca.fabs(way), 1e-12)))
    p = last / _BAR + least + share * (bounded - least)
    held = ca.logic_or(p <= low + _SLACK, p >= high - _SLACK)
    residual = (J @ (p * _BAR - reference) - v)[:task_rows]
    violation = ca.sumsqr(change - bounded)
    return [p * _BAR, held, ca.norm_2(residual), violation]
