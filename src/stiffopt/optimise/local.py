"""Local optimisation that stays on the pose: a feasible-path SQP method.

From a point on the pose (`stiffopt.optimise.reach`) `descend` goes down the objective.  Each
step solves a convex quadratic program within a trust region and is then pulled back into the
pose's balls, so that every iterate reaches the target and progress is judged by the objective
alone: no merit function between pose and stiffness is needed.

A ball |r| <= rho enters the quadratic program as a box around it whose first axis points where
the multiplier pulls, together with the curvature mu/rho J'J of the sphere; both are exact to
second order at the solution.  The rest of the Lagrangian's Hessian is a damped BFGS model.

The folder ``native`` holds the same method in C.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stiffopt.optimise.prices import Multipliers, prices_at
from stiffopt.optimise.problem import FLOOR_MARGIN, Objective, Point, Problem
from stiffopt.optimise.quadratic import FAR, solve_qp
from stiffopt.optimise.reach import attempt, bounded_step, within

Vector = NDArray[np.float64]

MOST_ITERATIONS = 80
FIRST_RADIUS = 0.3  # of the trust region, in bar
LAST_RADIUS = 1e-6
INSIDE = 1 - 1e-7  # share of a ball's radius that is used, so that rounding stays within
TOUCHING = 1e-5  # bar; a pressure that near to a limit is meant to be at it
NEXT_TO = 0.05  # bar; a descent that near to an optimum of the same value is on its way there
_CURVED = 2.0  # second-order error of a correction, for the squared first order over a scale


@dataclass(frozen=True, eq=False)
class LocalResult:
    """Where a descent ended.

    Attributes
    ----------
    problem : Problem
        What was solved.
    point : Point
    value : float
        Objective there.
    violation : float
        Sum by which floors are missed, in logarithms of stiffness.
    converged : bool
    is_optimum : bool
        False: the point is no more than a candidate, and has no prices.
    """

    problem: Problem
    point: Point
    value: float
    violation: float
    converged: bool
    is_optimum: bool = True

    @classmethod
    def at(cls, problem: Problem, point: Point) -> "LocalResult":
        """A solution that is known already."""
        value, missed = problem.objective.value(point), violation(problem, point)
        return cls(problem, point, value, missed, converged=True)

    @property
    def objective(self) -> Objective:
        """What was minimised."""
        return self.problem.objective

    @cached_property
    def multipliers(self) -> Multipliers | None:
        """Prices of the constraints; None where they cannot be had."""
        if not self.is_optimum:
            return None
        self.problem.restart()
        return prices_at(self.problem, self.point)

    @property
    def holds_floors(self) -> bool:
        """Whether no floor is missed by more than the margin that is aimed above it."""
        return self.violation < 0.5 * FLOOR_MARGIN


def violation(problem: Problem, point: Point) -> float:
    """Sum by which floors are missed, in logarithms of stiffness."""
    if not len(problem.floors):
        return 0.0
    return float(np.maximum(problem.floors - point.floors, 0.0).sum())


class _Place:
    """An iterate with its objective.

    Attributes
    ----------
    point : Point
    values : ndarray (t,)
        Terms of the objective.
    value, missed : float
        The largest of them, and by how much floors are missed.
    slopes : ndarray (t + f + m, n)
        Gradients of the terms, of the floors with their signs changed, and of the residuals in
        finite balls: what multipliers weigh.
    """

    __slots__ = ("missed", "point", "slopes", "value", "values")

    def __init__(self, problem: Problem, point: Point) -> None:
        self.point = point
        self.values, gradients = problem.objective.terms(point)
        self.value = float(self.values.max())
        self.missed = violation(problem, point)
        parts = [gradients, point.jacobian[problem.bounding.rows]]
        if len(problem.floors):
            parts.insert(1, -point.floor_gradients)
        self.slopes = np.concatenate(parts)


def descend(
    problem: Problem, start: Point, known: Sequence[LocalResult] = (), same: float = 0.0
) -> LocalResult:
    """Minimise the problem's objective from a point that reaches the pose.

    A descent that comes next to a known optimum, with the same value but for `same`, ends there:
    the result is that optimum.
    """
    point: Point | None = start
    if not len(start.terms):
        point = attempt(problem.needed, start.x)
    if point is None:
        return LocalResult(problem, start, math.inf, math.inf, converged=False)
    here = _Place(problem, point)
    subproblem = _Subproblem(problem, len(here.values))
    precision = problem.objective.precision
    B = problem.objective.curvature(point)
    B = B + 1e-8 * np.trace(B) * np.eye(len(B))
    radius, price = FIRST_RADIUS, 10.0
    weights: Vector | None = None
    converged = False
    for _ in range(MOST_ITERATIONS):
        step = subproblem.step(here, B, radius, price, weights)
        if step is None:
            break
        d, promised, weights = step
        price = max(price, 2 * subproblem.dearest_floor(weights))
        if promised < precision:
            here = _last_step(problem, here, d, price)
            converged = True
            break
        length = float(np.abs(d).max())
        trial = _pulled_back(problem, here.point, d, problem.lower, problem.upper)
        if trial is None:
            radius = 0.3 * length
            if radius < LAST_RADIUS:
                break
            continue
        there = _Place(problem, trial)
        gained = here.value - there.value + price * (here.missed - there.missed)
        _update(B, trial.x - here.point.x, weights @ (there.slopes - here.slopes))
        share = gained / promised
        if share < 0.25:
            radius = 0.4 * length
        elif share > 0.7 and length > 0.8 * radius:
            radius = min(2.5 * radius, 2.0)
        if gained > 0:
            here = there
            found = _next_to(here, known, same)
            if found is not None:
                return found
        if radius < LAST_RADIUS:
            converged = abs(promised) < 1e3 * precision
            break
    here = _snapped(problem, here)
    return LocalResult(problem, here.point, here.value, here.missed, converged)


def _last_step(problem: Problem, here: _Place, d: Vector, price: float) -> _Place:
    """The place after a step that gains next to nothing, if it gains at all."""
    trial = _pulled_back(problem, here.point, d, problem.lower, problem.upper)
    if trial is None:
        return here
    there = _Place(problem, trial)
    gained = here.value - there.value + price * (here.missed - there.missed)
    return there if gained > 0 else here


def _next_to(here: _Place, known: Sequence[LocalResult], same: float) -> LocalResult | None:
    """Known optimum that an iterate has all but come to."""
    for result in known:
        same_value = abs(here.value - result.value) <= same
        if same_value and np.abs(here.point.x - result.point.x).max() < NEXT_TO:
            return result
    return None


def _update(B: Vector, s: Vector, y: Vector) -> None:
    """Powell's damped BFGS update in place, which keeps B positive definite."""
    Bs = B @ s
    sBs = float(s @ Bs)
    if not sBs >= 1e-16:
        return
    sy = float(s @ y)
    if sy < 0.2 * sBs:
        theta = 0.8 * sBs / (sBs - sy)
        y = theta * y + (1 - theta) * Bs
        sy = float(s @ y)
    B += y[:, np.newaxis] * (y / sy) - Bs[:, np.newaxis] * (Bs / sBs)


def _pulled_back(
    problem: Problem, point: Point, d: Vector, lower: Vector, upper: Vector
) -> Point | None:
    """Point near x + d within all balls, evaluated as needed; None if there is none near."""
    bounding = problem.bounding
    x = within(lower, point.x + d, upper)
    if not bounding.spheres:
        return attempt(problem.needed, x)
    allowed = 2 * float(np.abs(d).max()) + 1e-4
    trial, complete = attempt(problem.pose, x), False
    for _ in range(8):
        if trial is None:
            return None
        if trial.reached:
            if complete:
                return trial
            trial = attempt(problem.needed, x)
            return trial if trial is not None and trial.reached else None
        wanted = trial.residual[bounding.rows].copy()
        for index, (_, first, end, radius) in zip(bounding.indices, bounding.spheres, strict=True):
            beyond = trial.errors[index] - radius * INSIDE
            if beyond > 0:
                # while steps are long, further in by as much as the correction may be wrong
                wrong = min(_CURVED * beyond**2 / bounding.scale[first], 0.3 * radius)
                wrong = wrong if beyond > radius else 0.0
                wanted[first:end] *= -(beyond + wrong) / trial.errors[index]
            else:
                wanted[first:end] = 0.0
        back = bounded_step(
            trial.jacobian[bounding.rows],
            wanted,
            1e-3 * bounding.near_damping,
            lower - x,
            upper - x,
        )
        if not np.abs(back).max() <= allowed:
            return None
        x = within(lower, x + back, upper)
        # one correction is enough most of the time, so the rest is evaluated at once
        trial, complete = attempt(problem.needed, x), True
    return None


def _snapped(problem: Problem, here: _Place) -> _Place:
    """The same place with pressures that all but touch a limit put onto it, if that holds."""
    x = here.point.x
    low = x < problem.lower + TOUCHING
    high = x > problem.upper - TOUCHING
    d = np.where(low, problem.lower, np.where(high, problem.upper, x)) - x
    if not d.any():
        return here
    lower = np.where(high, problem.upper, problem.lower)
    upper = np.where(low, problem.lower, problem.upper)
    moved = _pulled_back(problem, here.point, d, lower, upper)
    if moved is None:
        return here
    there = _Place(problem, moved)
    worse = there.value - here.value
    holds = there.missed <= here.missed and worse < 100 * problem.objective.precision
    return there if holds else here


class _Subproblem:
    """The quadratic program of each step of one descent; its arrays are used again and again.

    Its variables are the step d (n,), the largest term t (if there are several) and the floors'
    slack s (if there are any).  Its rows are those of `_Place.slopes`, less a single term.
    """

    def __init__(self, problem: Problem, n_terms: int) -> None:
        n, floors, rows = len(problem.lower), len(problem.floors), len(problem.bounding.radius)
        self._problem, self._n = problem, n
        self._several, self._floored = n_terms > 1, floors > 0
        self._skipped = 0 if self._several else n_terms  # a single term goes into the gradient
        self._terms = slice(0, n_terms)
        self._floors = slice(n_terms, n_terms + floors)
        self._balls = n_terms + floors
        size = n + self._several + self._floored
        above = self._balls - self._skipped  # rows above those of the balls
        self._H, self._g = np.zeros((size, size)), np.zeros(size)
        self._A = np.zeros((above + rows, size))
        self._low, self._high = (
            np.full(size + above + rows, -FAR),
            np.full(size + above + rows, FAR),
        )
        self._ball_rows = slice(above, above + rows)
        self._H[range(n, size), range(n, size)] = 1e-6
        if self._several:
            self._g[n] = 1.0
            self._A[:n_terms, n] = -1.0
        if self._floored:
            self._A[above - floors : above, -1] = -1.0
            self._low[size - 1] = 0.0
        self._size = size
        self._axes = np.zeros((rows, rows))  # over the radii
        self._curvature = np.zeros(rows)

    def dearest_floor(self, weights: Vector) -> float:
        """Largest multiplier of a floor."""
        return float(weights[self._floors].max()) if self._floored else 0.0

    def step(
        self, here: _Place, B: Vector, radius: float, price: float, weights: Vector | None
    ) -> tuple[Vector, float, Vector] | None:
        """Step (n,), promised decrease of the merit, and multipliers of the slopes."""
        problem, point, n, size = self._problem, here.point, self._n, self._size
        H, g, A, low, high = self._H, self._g, self._A, self._low, self._high
        jacobian = here.slopes[self._balls :]
        residual = point.residual[problem.bounding.rows]
        self._turn_boxes(here, weights, residual, jacobian)
        H[:n, :n] = B + (jacobian.T * self._curvature) @ jacobian
        np.maximum(problem.lower - point.x, -radius, out=low[:n])
        np.minimum(problem.upper - point.x, radius, out=high[:n])
        if self._several:
            high[size : size + len(here.values)] = here.value - here.values
        else:
            g[:n] = here.slopes[0]
        above = self._ball_rows.start
        if above:
            A[:above, :n] = here.slopes[self._skipped : self._balls]
        if self._floored:
            g[-1] = price
            high[size + above - len(problem.floors) : size + above] = point.floors - problem.floors
        A[self._ball_rows, :n] = self._axes @ jacobian
        across = self._axes @ residual
        np.minimum(-1.0 - across, 0.0, out=low[size + above :])
        np.maximum(1.0 - across, 0.0, out=high[size + above :])
        answer = solve_qp(H, g, A, low, high)
        if answer is None:
            return None
        z, dual = answer
        promised = price * here.missed - float(g.dot(z) + 0.5 * z.dot(H.dot(z)))
        new = np.ones(len(here.slopes))
        new[self._skipped :] = dual[size:]
        new[self._balls :] = new[self._balls :] @ self._axes
        return z[:n], promised, new

    def _turn_boxes(
        self, here: _Place, weights: Vector | None, residual: Vector, jacobian: Vector
    ) -> None:
        """Set the axes of the box around each ball, the first one where it will bind."""
        bounding = self._problem.bounding
        residuals = residual.tolist()
        pulls = None if weights is None else weights[self._balls :].tolist()
        for index, (_, first, end, radius) in zip(bounding.indices, bounding.spheres, strict=True):
            rho = radius * INSIDE
            if pulls is None:
                steepest = here.slopes[int(here.values.argmax())]
                pull = _least_squares(jacobian[first:end], -steepest)
            else:
                pull = pulls[first:end]
            self._curvature[first:end] = math.hypot(*pull) / rho
            binds = here.point.errors[index] > 0.9 * radius
            along = _axes_along(residuals[first:end] if binds else pull)
            self._axes[first:end, first:end] = [[value / rho for value in row] for row in along]


def _least_squares(rows: Vector, wanted: Vector) -> list[float]:
    """Weights of rows (k, n) that sum up to a vector (n,) as nearly as can be."""
    square = rows @ rows.T
    square += 1e-10 * np.trace(square) * np.eye(len(square))
    try:
        found: list[float] = np.linalg.solve(square, rows @ wanted).tolist()
    except np.linalg.LinAlgError:
        found = [0.0] * len(rows)
    return found


def _axes_along(vector: list[float]) -> list[list[float]]:
    """Orthonormal axes, the first along a vector of one to three components; any if it is zero."""
    length = math.hypot(*vector)
    if not length > 0:
        vector, length = [1.0, 0.0, 0.0][: len(vector)], 1.0
    a = [value / length for value in vector]
    if len(a) == 1:
        return [a]
    if len(a) == 2:
        return [a, [-a[1], a[0]]]
    least = min(range(3), key=lambda i: abs(a[i]))
    b = [-a[least] * value for value in a]
    b[least] += 1.0
    length = math.hypot(*b)
    b = [value / length for value in b]
    c = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    return [a, b, c]
