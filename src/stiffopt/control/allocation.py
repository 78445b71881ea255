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

The reference and the gate limit the slew too: the reference as a whole, so that its path stays
straight, the gate each channel, by the time since the last command. Here it is a bound of the
program, which thus finds the best pressures that the gate passes unchanged; a test checks that.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import casadi as ca
import daqp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.control.feedback import TrackingRows
from stiffopt.control.formula import Formula
from stiffopt.control.tuning import FeedbackTuning

Array = NDArray[np.float64]

_BAR = 1e5
_SLACK = 1e-4  # bar; a pressure within this of a limit counts as being at it
_BOUND_ERROR = 1e-3  # bar; a solution that violates its bounds by more is rejected


class QuadraticSolver(ABC):
    """Solves ``min 1/2 x^T H x + f^T x``, lower <= (x, A x) <= upper, for n unknowns and m rows."""

    @abstractmethod
    def __init__(self, n: int, m: int) -> None: ...

    @abstractmethod
    def solve(self, H: Array, f: Array, A: Array, lower: Array, upper: Array) -> Array | None:
        """Return x (n,), not checked; None if the solver finds none."""


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
        self._solution = _solution(law)
        self._solver = SOLVERS[solver](len(low), 3)
        self._none_held = np.zeros(len(low), dtype=bool)
        self.limit(low, high)

    def limit(self, low: Array, high: Array) -> None:
        """Change the limits of the pressures (n,), in Pa."""
        self._low, self._high = low / _BAR, high / _BAR

    def solve(
        self, inputs: Sequence[ArrayLike], reference: Array, last: Array
    ) -> tuple[Array | None, NDArray[np.bool_], float]:
        """Solve the program for inputs of the feedback law, r and the last pressures (n,), in Pa.

        Returns
        -------
        Pressures (n,) in Pa, None without a usable solution; flags (n,) of the channels at a limit;
        and the residual of the task's rows, in m.
        """
        H, f, G, lower, upper, finite, J, v = self._program(
            *inputs, reference, last, self._low, self._high
        )
        if not math.isfinite(finite[0]):
            return None, self._none_held, math.nan
        change = self._solver.solve(H, f, G, lower, upper)
        if change is None or change.shape != last.shape:
            return None, self._none_held, math.nan
        p, held, residual, violation = self._solution(
            change, lower, upper, G, J, v, reference, last, self._low, self._high
        )
        if not violation[0] <= _BOUND_ERROR**2:  # NaN is rejected too
            return None, self._none_held, math.nan
        return p, held > 0, float(residual[0])


def _program(law: TrackingRows, step: Array, tip_step: float, weight: float) -> Formula:
    """Return the formula of the program for the change of pressures; in bar, and scaled.

    Outputs: H (n, n), f (n,), G (3, n), the bounds (n + 3,), a number that is finite only if all
    inputs are (an entry of H that is not finite makes f so too), J and v.
    """
    J, v, n = law.rows, law.values, len(step)
    reference, last = ca.SX.sym("reference", n), ca.SX.sym("last", n)
    low, high = ca.SX.sym("low", n), ca.SX.sym("high", n)
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
    inputs = [*law.inputs, reference, last, low, high]
    bounds = [ca.vertcat(lower, -displacement), ca.vertcat(upper, displacement)]
    return Formula(inputs, [H, f, G, *bounds, finite, J, v], [*law.matrices, H, G, J])


def _solution(law: TrackingRows) -> Formula:
    """Return the formula that evaluates a change of the pressures (n,), in bar.

    Outputs: pressures (n,) in Pa, 1 for channels at a limit (n,), the residual of the task's rows
    in m, and the square of the violation of the change's bounds, in bar^2.
    """
    t, n = law.rows.shape
    change = ca.SX.sym("change", n)
    lower, upper = ca.SX.sym("lower", n + 3), ca.SX.sym("upper", n + 3)
    G = ca.SX.sym("G", 3, n)
    J, v = ca.SX.sym("J", t, n), ca.SX.sym("v", t)
    reference, last = ca.SX.sym("reference", n), ca.SX.sym("last", n)
    low, high = ca.SX.sym("low", n), ca.SX.sym("high", n)
    bounded = ca.fmin(ca.fmax(change, lower[:n]), upper[:n])
    # The change nearest to none is within all bounds, and so is the way from it up to a share s.
    least = ca.fmin(ca.fmax(0, lower[:n]), upper[:n])
    start, way = G @ least, G @ (bounded - least)
    room = upper[n:] - ca.sign(way) * start
    share = ca.mmin(ca.fmin(1, room / ca.fmax(ca.fabs(way), 1e-12)))
    p = last / _BAR + least + share * (bounded - least)
    held = ca.logic_or(p <= low + _SLACK, p >= high - _SLACK)
    residual = (J @ (p * _BAR - reference) - v)[: law.task_rows]
    violation = ca.sumsqr(change - bounded)
    inputs = [change, lower, upper, G, J, v, reference, last, low, high]
    return Formula(inputs, [p * _BAR, held, ca.norm_2(residual), violation], [G, J])
