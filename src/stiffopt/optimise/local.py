"""Local optimisation that stays on the pose: a feasible-path SQP method.

`descend` starts at a point on the pose (`stiffopt.optimise.reach`) and minimises the objective.
Each step solves a convex quadratic program within a trust region.  It is then pulled back into the
pose's balls, so that every iterate reaches the target and progress is measured by the objective
alone; no merit function has to weigh pose against stiffness.

In the quadratic program, a ball |r| <= rho becomes a box around it whose first axis points along
the multiplier, plus the curvature mu/rho J'J of the sphere; both are exact to second order at the
solution.  The rest of the Lagrangian's Hessian is a damped BFGS estimate.

The folder ``native`` holds the same method in C.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.optimise.prices import Multipliers, prices_at
from stiffopt.optimise.problem import Objective, PressureProblem, ProgramPoint
from stiffopt.optimise.quadratic import FAR, solve_qp
from stiffopt.optimise.reach import attempt, bounded_step, within
from stiffopt.optimise.settings import DESCENT

_CURVED = 2.0  # estimated second-order error of a correction e, in units of e^2 / scale


@dataclass(frozen=True, eq=False)
class LocalResult:
    """End of a descent."""

    problem: PressureProblem  # the program that was solved
    point: ProgramPoint
    value: float  # objective there
    violation: float  # sum of the violations of floors, in logarithms of stiffness
    converged: bool
    is_optimum: bool = True  # False: the point is only a candidate, without prices

    @classmethod
    def at(cls, problem: PressureProblem, point: ProgramPoint) -> "LocalResult":
        """Return the result for a known solution."""
        value, missed = problem.objective.value(point), violation(problem, point)
        return cls(problem, point, value, missed, converged=True)

    @property
    def objective(self) -> Objective:
        """The objective of the program."""
        return self.problem.objective

    @cached_property
    def multipliers(self) -> Multipliers | None:
        """Prices of the constraints; None where they cannot be computed."""
        if not self.is_optimum:
            return None
        self.problem.restart()
        return prices_at(self.problem, self.point)

    @property
    def holds_floors(self) -> bool:
        """Whether the floors hold; the method aims at `floor_margin` above them."""
        return self.violation < 0.5 * DESCENT.floor_margin


def violation(problem: PressureProblem, point: ProgramPoint) -> float:
    """Return the sum of the violations of floors, in logarithms of stiffness."""
    if not len(problem.floors):
        return 0.0
    return float(np.maximum(problem.floors - point.floors, 0.0).sum())


class _Place:
    """An iterate with its objective.

    Attributes
    ----------
    values : (t,), terms of the objective.
    value, missed : the largest term, and the violation of floors.
    slopes : (t + f + m, n), gradients of the terms, of the negative floors, and of the residuals in
        finite balls, in the order of the multipliers.
    """

    __slots__ = ("missed", "point", "slopes", "value", "values")

    def __init__(self, problem: PressureProblem, point: ProgramPoint) -> None:
        self.point = point
        self.values, gradients = problem.objective.terms(point)
        self.value = float(self.values.max())
        self.missed = violation(problem, point)
        parts = [gradients, point.jacobian[problem.bounding.rows]]
        if len(problem.floors):
            parts.insert(1, -point.floor_gradients)
        self.slopes = np.concatenate(parts)


def descend(
    problem: PressureProblem,
    start: ProgramPoint,
    known: Sequence[LocalResult] = (),
    same: float = 0.0,
) -> LocalResult:
    """Minimise the problem's objective from a point that reaches the pose.

    A descent that comes close to a known optimum, with values that differ by at most `same`, ends
    there: the result is that optimum.
    """
    point: ProgramPoint | None = start
    if not len(start.terms):
        point = attempt(problem.needed, start.x)
    if point is None:
        return LocalResult(problem, start, math.inf, math.inf, converged=False)
    here = _Place(problem, point)
    subproblem = _Subproblem(problem, len(here.values))
    precision = problem.objective.precision
    B = problem.objective.curvature(point)
    B = B + 1e-8 * np.trace(B) * np.eye(len(B))
    radius, price = DESCENT.first_radius, 10.0
    weights: Array | None = None
    held = np.zeros(len(point.x), dtype=bool)
    converged = False
    for _ in range(DESCENT.iterations):
        step = subproblem.step(here, B, held, radius, price, weights)
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
            if radius < DESCENT.last_radius:
                break
            continue
        there = _Place(problem, trial)
        gained = here.value - there.value + price * (here.missed - there.missed)
        moved, slope = trial.x - here.point.x, weights @ there.slopes
        held |= _pushed_back(problem, here.point.x, moved * slope)
        held &= not gained > 0
        _update(B, moved, slope - weights @ here.slopes)
        share = gained / promised
        if share < 0.25:
            radius = 0.4 * length
        elif share > 0.7 and length > 0.8 * radius:
            radius = min(2.5 * radius, DESCENT.largest_radius)
        if gained > 0:
            here = there
            found = _next_to(here, known, same)
            if found is not None:
                return found
        if radius < DESCENT.last_radius:
            converged = abs(promised) < 1e3 * precision
            break
    here = _snapped(problem, here)
    return LocalResult(problem, here.point, here.value, here.missed, converged)


def _pushed_back(problem: PressureProblem, x: Array, rise: Array) -> Flags:
    """Return which steps off a limit met a slope back to it.

    If such a step gained nothing, there is a kink at the limit, as in the norm law where a segment
    is unpressurised.
    """
    return (rise > 0) & ((x <= problem.lower) | (x >= problem.upper))


def _last_step(problem: PressureProblem, here: _Place, d: Array, price: float) -> _Place:
    """Return the place after a step of negligible gain, if it gains at all."""
    trial = _pulled_back(problem, here.point, d, problem.lower, problem.upper)
    if trial is None:
        return here
    there = _Place(problem, trial)
    gained = here.value - there.value + price * (here.missed - there.missed)
    return there if gained > 0 else here


def _next_to(here: _Place, known: Sequence[LocalResult], same: float) -> LocalResult | None:
    """Return a known optimum that an iterate has almost reached."""
    for result in known:
        same_value = abs(here.value - result.value) <= same
        if same_value and np.abs(here.point.x - result.point.x).max() < DESCENT.next_to:
            return result
    return None


def _update(B: Array, s: Array, y: Array) -> None:
    """Apply Powell's damped BFGS update in place, which keeps B positive definite."""
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
    problem: PressureProblem, point: ProgramPoint, d: Array, lower: Array, upper: Array
) -> ProgramPoint | None:
    """Return a point near x + d within all balls, evaluated as needed; None if there is none."""
    bounding = problem.bounding
    x = within(lower, point.x + d, upper)
    if not bounding.constraints:
        return attempt(problem.needed, x)
    allowed = 2 * float(np.abs(d).max()) + DESCENT.shortest_pull_back
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
        _, jacobian = bounding.missing(wanted, trial.jacobian[bounding.rows])
        for index, c in zip(bounding.indices, bounding.constraints, strict=True):
            beyond = trial.errors[index] - c.radius * DESCENT.inside
            if beyond > 0:
                # overshoot long corrections by their estimated second-order error
                wrong = min(_CURVED * beyond**2 / c.scale, 0.3 * c.radius)
                wrong = wrong if beyond > c.radius else 0.0
                wanted[c.first : c.end] *= -(beyond + wrong) / trial.errors[index]
            else:
                wanted[c.first : c.end] = 0.0
        back = bounded_step(
            jacobian,
            wanted,
            DESCENT.pull_back_damping * bounding.near_damping,
            lower - x,
            upper - x,
        )
        if not np.abs(back).max() <= allowed:
            return None
        x = within(lower, x + back, upper)
        # one correction is mostly enough, so evaluate the rest at once
        trial, complete = attempt(problem.needed, x), True
    return None


def _snapped(problem: PressureProblem, here: _Place) -> _Place:
    """Return the place with pressures that almost touch a limit moved onto it, if that holds."""
    x = here.point.x
    low = x < problem.lower + DESCENT.touching
    high = x > problem.upper - DESCENT.touching
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
    """The quadratic program of each step of one descent; its arrays are reused.

    Its variables are the step d (n,), the largest term t (if there are several) and the floors'
    slack s (if there are any).  Its rows are those of `_Place.slopes`, except that a single term
    goes into the linear objective.
    """

    def __init__(self, problem: PressureProblem, n_terms: int) -> None:
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
        self._one_sided = [c.first for c in problem.bounding.constraints if c.one_sided]

    def dearest_floor(self, weights: Array) -> float:
        """Return the largest multiplier of a floor."""
        return float(weights[self._floors].max()) if self._floored else 0.0

    def step(
        self,
        here: _Place,
        B: Array,
        held: Flags,
        radius: float,
        price: float,
        weights: Array | None,
    ) -> tuple[Array, float, Array] | None:
        """Return a step (n,), its promised decrease of the merit, and multipliers of the slopes.

        Pressures that are held (n,) do not change.  The multipliers of a ball combine those of the
        box around it and of its curvature.
        """
        problem, point, n, size = self._problem, here.point, self._n, self._size
        H, g, A, low, high = self._H, self._g, self._A, self._low, self._high
        jacobian = here.slopes[self._balls :]
        residual = point.residual[problem.bounding.rows]
        self._turn_boxes(here, weights, residual, jacobian)
        H[:n, :n] = B + (jacobian.T * self._curvature) @ jacobian
        np.maximum(problem.lower - point.x, -radius, out=low[:n])
        np.minimum(problem.upper - point.x, radius, out=high[:n])
        low[:n][held] = 0.0
        high[:n][held] = 0.0
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
        low[size + above :][self._one_sided] = -FAR
        np.maximum(1.0 - across, 0.0, out=high[size + above :])
        answer = solve_qp(H, g, A, low, high)
        if answer is None:
            return None
        z, dual = answer
        promised = price * here.missed - float(g.dot(z) + 0.5 * z.dot(H.dot(z)))
        new = np.ones(len(here.slopes))
        new[self._skipped :] = dual[size:]
        new[self._balls :] = new[self._balls :] @ self._axes + self._curvature * (jacobian @ z[:n])
        return z[:n], promised, new

    def _turn_boxes(
        self, here: _Place, weights: Array | None, residual: Array, jacobian: Array
    ) -> None:
        """Set the axes of the box around each ball; the first is where the ball will be active."""
        bounding = self._problem.bounding
        residuals = residual.tolist()
        pulls = None if weights is None else weights[self._balls :].tolist()
        for index, c in zip(bounding.indices, bounding.constraints, strict=True):
            first, end, rho = c.first, c.end, c.radius * DESCENT.inside
            if c.one_sided:
                self._axes[first, first] = 1 / rho
                continue
            if pulls is None:
                steepest = here.slopes[int(here.values.argmax())]
                pull = _least_squares(jacobian[first:end], -steepest)
            else:
                pull = pulls[first:end]
            self._curvature[first:end] = math.hypot(*pull) / rho
            binds = here.point.errors[index] > 0.9 * c.radius
            self._axes[first:end, first:end] = axes_along(residuals[first:end] if binds else pull)
            self._axes[first:end, first:end] /= rho


def _least_squares(rows: Array, wanted: Array) -> list[float]:
    """Return the weights of rows (k, n) whose sum is nearest to a vector (n,)."""
    square = rows @ rows.T
    square += 1e-10 * np.trace(square) * np.eye(len(square))
    try:
        found: list[float] = np.linalg.solve(square, rows @ wanted).tolist()
    except np.linalg.LinAlgError:
        found = [0.0] * len(rows)
    return found


def axes_along(vector: list[float]) -> Array:
    """Return orthonormal axes (k, k) by rows, the first along a vector (k,); any if it is zero."""
    length = math.hypot(*vector)
    axes = np.eye(len(vector))
    if not length > 0:
        return axes
    first = np.array(vector) / length
    mirror = first + math.copysign(1.0, first[0]) * axes[0]  # Householder's reflection
    axes -= np.outer(mirror, mirror / (1 + abs(first[0])))
    axes[0] = first
    return axes
