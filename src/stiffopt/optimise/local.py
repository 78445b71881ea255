"""Local optimisation that stays on the pose: a feasible-path SQP method.

`reach` brings pressures to the pose (Levenberg-Marquardt with bounds); `descend` goes down the
objective from there.  Each step solves a convex quadratic program within a trust region and is
then pulled back into the pose's balls, so that every iterate reaches the target and progress is
judged by the objective alone: no merit function between pose and stiffness is needed.

A ball |r| <= rho enters the quadratic program as a box around it whose first axis points where
the multiplier pulls, together with the curvature mu/rho J'J of the sphere; both are exact to
second order at the solution.  The rest of the Lagrangian's Hessian is a damped BFGS model.
"""

from copy import copy
from dataclasses import dataclass

import daqp
import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import EquilibriumError
from stiffopt.optimise.problem import FLOOR_MARGIN, Objective, Point, Problem
from stiffopt.optimise.terms import Ball

Vector = NDArray[np.float64]

_MOST_ITERATIONS = 80
_FIRST_RADIUS = 0.3  # of the trust region, in bar
_LAST_RADIUS = 1e-6
_INSIDE = 1 - 1e-7  # share of a ball's radius that is used, so that rounding stays within
_TOUCHING = 1e-5  # bar; a pressure that near to a limit is meant to be at it
_BINDING = 1e-4  # how nearly, relatively, a constraint must hold to count as binding
_BEYOND = 1e-3  # bar; where the price of a limit is taken, outside of it
_FAR = 1e6  # stands for no bound in the quadratic program


@dataclass(frozen=True)
class Multipliers:
    """Prices at a solution: what the objective would gain per unit of each constraint.

    Attributes
    ----------
    bounds : ndarray (n,)
        Per bar; positive where the upper bound holds back, negative where the lower does.
    balls : dict of str to ndarray
        Vector per ball, per m or rad; its length is the price of the radius.
    terms : ndarray (m,)
        Weights of the objective's terms, which sum to one.
    floors : ndarray
        Per unit of each floor's logarithm.
    """

    bounds: Vector
    balls: dict[str, Vector]
    terms: Vector
    floors: Vector


@dataclass(frozen=True)
class LocalResult:
    """Where a descent ended.

    Attributes
    ----------
    point : Point
    value : float
        Objective there.
    violation : float
        Sum by which floors are missed, in logarithms of stiffness.
    converged : bool
    objective : Objective
        What was minimised.
    multipliers : Multipliers or None
        None if no quadratic program was solved.
    """

    point: Point
    value: float
    violation: float
    converged: bool
    objective: Objective
    multipliers: Multipliers | None

    @property
    def holds_floors(self) -> bool:
        """Whether no floor is missed by more than the margin that is aimed above it."""
        return self.violation < 0.5 * FLOOR_MARGIN


def solve_qp(
    H: Vector, g: Vector, A: Vector, low: Vector, high: Vector
) -> tuple[Vector, Vector] | None:
    """Minimise ``z'Hz/2 + g'z`` with ``low <= (z, Az) <= high``: solution and multipliers.

    None where the solver's answer is not finite or not marked as optimal.
    """
    if not (np.isfinite(H).all() and np.isfinite(g).all() and np.isfinite(A).all()):
        return None
    sense = np.zeros(len(low), dtype=np.int32)
    z, _, flag, info = daqp.solve(
        np.ascontiguousarray(H), g.copy(), np.ascontiguousarray(A), high, low, sense,
        primal_tol=1e-9,
    )  # fmt: skip
    z, multipliers = np.asarray(z), np.asarray(info["lam"])
    if flag < 1 or not np.isfinite(z).all() or not np.isfinite(multipliers).all():
        return None
    return z, multipliers


def reach(problem: Problem, x: Vector, most_iterations: int = 40) -> Point | None:
    """Bring pressures to the pose; the point nearest to it that was found otherwise.

    None if the arm has no equilibrium at the start.
    """
    scales = {"position": problem.robot.length, "angle": 1.0}

    def stacked(point: Point) -> tuple[Vector, Vector]:
        residual = np.concatenate([ball.residual / scales[ball.name] for ball in point.constraints])
        jacobian = np.vstack([ball.jacobian / scales[ball.name] for ball in point.constraints])
        return residual, jacobian

    point = _attempt(problem, x, pose_only=True)
    if point is None:
        return None
    damping = 1e-4
    none = np.zeros((0, len(x)))
    for _ in range(most_iterations):
        if point.reached:
            return point
        residual, jacobian = stacked(point)
        gradient = residual @ jacobian
        low = np.maximum(problem.lower - point.x, -1.0)
        high = np.minimum(problem.upper - point.x, 1.0)
        H = jacobian.T @ jacobian + damping * np.eye(len(x))
        step = solve_qp(H, gradient, none, low, high)
        if step is None:
            return point
        d = step[0]
        promised = -(gradient @ d + 0.5 * d @ jacobian.T @ jacobian @ d)
        if promised < 1e-9 * (residual @ residual):
            return point
        trial = _attempt(problem, np.clip(point.x + d, problem.lower, problem.upper), True)
        gained = float("-inf")
        if trial is not None:
            new = stacked(trial)[0]
            gained = 0.5 * float(residual @ residual - new @ new)
        if trial is not None and gained > 0.1 * promised:
            point = trial
            damping = max(damping * (0.1 if gained > 0.7 * promised else 1.0), 1e-10)
        else:
            damping *= 10
            if damping > 1e6:
                return point
    return point


def descend(problem: Problem, start: Point) -> LocalResult:
    """Minimise the problem's objective from a point that reaches the pose."""
    point = _attempt(problem, start.x, pose_only=False)
    if point is None:
        return LocalResult(start, np.inf, np.inf, False, problem.objective, None)
    objective = problem.objective
    B = objective.curvature(point)
    B = B + 1e-8 * np.trace(B) * np.eye(len(B))
    radius, price = _FIRST_RADIUS, 10.0
    multipliers: Multipliers | None = None
    converged = False
    for _ in range(_MOST_ITERATIONS):
        step = _quadratic_step(problem, point, B, radius, price, multipliers)
        if step is None:
            break
        d, promised, multipliers = step
        price = max(price, 2 * float(multipliers.floors.max(initial=0.0)))
        if promised < objective.precision:
            converged = True
            break
        trial = _pulled_back(problem, point, d)
        if trial is None:
            radius = 0.3 * float(np.abs(d).max())
            if radius < _LAST_RADIUS:
                break
            continue
        gained = _merit(problem, point, price) - _merit(problem, trial, price)
        B = _bfgs(B, trial.x - point.x, _slope(problem, trial, multipliers)
                  - _slope(problem, point, multipliers))  # fmt: skip
        share = gained / promised
        if share < 0.25:
            radius = 0.4 * float(np.abs(d).max())
        elif share > 0.7 and np.abs(d).max() > 0.8 * radius:
            radius = min(2.5 * radius, 2.0)
        if gained > 0:
            point = trial
        if radius < _LAST_RADIUS:
            converged = abs(promised) < 1e3 * objective.precision
            break
    point = _snapped(problem, point)
    multipliers = _prices(problem, point) or multipliers
    return LocalResult(
        point, objective.value(point), violation(problem, point), converged, objective, multipliers
    )


def _snapped(problem: Problem, point: Point) -> Point:
    """The same point with pressures that all but touch a limit put onto it, if that holds."""
    low = point.x < problem.lower + _TOUCHING
    high = point.x > problem.upper - _TOUCHING
    x = np.where(low, problem.lower, np.where(high, problem.upper, point.x))
    if (x == point.x).all():
        return point
    fixed = copy(problem)
    fixed.lower = np.where(high, problem.upper, problem.lower)
    fixed.upper = np.where(low, problem.lower, problem.upper)
    moved = _pulled_back(fixed, point, x - point.x)
    if moved is None or violation(problem, moved) > violation(problem, point):
        return point
    worse = problem.objective.value(moved) - problem.objective.value(point)
    return moved if worse < 100 * problem.objective.precision else point


def _prices(problem: Problem, point: Point) -> Multipliers | None:
    """Multipliers at a solution: those that leave the least of the Lagrangian's gradient.

    Each constraint that binds pulls with a weight that is not negative; the weights of the
    objective's largest terms sum to one.
    """
    values, gradients = problem.objective.terms(point)
    n = len(point.x)
    columns: list[Vector] = []
    top = [i for i, value in enumerate(values) if value > values.max() - _BINDING]
    columns += [gradients[i] for i in top]
    floors = [
        i for i, (k, bound) in enumerate(problem.floors) if point.values[k] < bound + _BINDING
    ]
    columns += [-point.gradients[problem.floors[i][0]] for i in floors]
    balls = [ball for ball in point.constraints if ball.error > (1 - _BINDING) * ball.radius]
    columns += [ball.residual / ball.error @ ball.jacobian for ball in balls]
    sides = [(i, -1.0) for i in range(n) if point.x[i] <= problem.lower[i]]
    sides += [(i, 1.0) for i in range(n) if point.x[i] >= problem.upper[i]]
    columns += [side * np.eye(n)[i] for i, side in sides]
    A = np.column_stack(columns)
    total = (np.arange(len(columns)) < len(top)).astype(float)[np.newaxis]
    low = np.concatenate([np.zeros(len(columns)), [1.0]])
    high = np.concatenate([np.full(len(columns), _FAR), [1.0]])
    H = A.T @ A
    H += 1e-12 * np.trace(H) * np.eye(len(H)) + 1e-300 * np.eye(len(H))
    answer = solve_qp(H, np.zeros(len(columns)), total, low, high)
    if answer is None:
        return None
    weights = iter(np.maximum(answer[0], 0.0))
    terms, held, bounds = np.zeros(len(values)), np.zeros(len(problem.floors)), np.zeros(n)
    for i in top:
        terms[i] = next(weights)
    for i in floors:
        held[i] = next(weights)
    pulls = {ball.name: np.zeros(len(ball.residual)) for ball in point.constraints}
    for ball in balls:
        pulls[ball.name] = next(weights) * ball.residual / ball.error
    prices = Multipliers(bounds, pulls, terms, held)
    for (i, side), weight in zip(sides, weights, strict=True):
        # a little beyond the limit: the norm law has a kink where a segment is unpressurised
        beyond = point.x + side * _BEYOND * np.eye(n)[i]
        moved = _attempt(problem, beyond, pose_only=False)
        slope = _slope(problem, moved, prices)[i] if moved is not None else -side * weight
        bounds[i] += side * max(0.0, -side * float(slope))
    return prices


def violation(problem: Problem, point: Point) -> float:
    """Sum by which floors are missed, in logarithms of stiffness."""
    return float(sum(max(0.0, bound - point.values[index]) for index, bound in problem.floors))


def _merit(problem: Problem, point: Point, price: float) -> float:
    return problem.objective.value(point) + price * violation(problem, point)


def _attempt(problem: Problem, x: Vector, pose_only: bool) -> Point | None:
    """Evaluate; None where the arm has no stable equilibrium or anything is not finite."""
    try:
        point = problem.pose(x) if pose_only else problem.point(x)
    except EquilibriumError:
        return None
    finite = np.isfinite(point.values).all() and np.isfinite(point.gradients).all()
    return point if finite and all(np.isfinite(b.residual).all() for b in point.balls) else None


def _axes(ball: Ball, multipliers: Multipliers | None, gradient: Vector) -> tuple[Vector, float]:
    """Axes (k, k) of the box around a ball, the first one where it will bind, and its price."""
    if multipliers is not None:
        pull = multipliers.balls[ball.name]
    else:  # least-squares estimate of the multiplier
        pull = np.asarray(np.linalg.lstsq(ball.jacobian.T, -gradient, rcond=None)[0], float)
    size = float(np.linalg.norm(pull))
    first = ball.residual if ball.error > 0.9 * ball.radius else pull
    if not np.linalg.norm(first) > 0:
        return np.eye(len(pull)), size
    basis = np.linalg.qr(np.column_stack([first, np.eye(len(first))]))[0].T
    return basis * np.sign(basis[:1] @ first), size


def _quadratic_step(
    problem: Problem,
    point: Point,
    B: Vector,
    radius: float,
    price: float,
    multipliers: Multipliers | None,
) -> tuple[Vector, float, Multipliers] | None:
    """Step (n,), promised decrease of the merit, and multipliers of the quadratic program.

    Its variables are the step d, the largest term t (if there are several) and the floors'
    slack s (if there are any).
    """
    n = len(point.x)
    values, gradients = problem.objective.terms(point)
    several, floored = len(values) > 1, bool(problem.floors)
    size = n + several + floored
    H = np.zeros((size, size))
    H[:n, :n] = B
    H[n:, n:] = 1e-6 * np.eye(size - n)
    g = np.zeros(size)
    rows: list[Vector] = []
    low: list[Vector] = [np.maximum(problem.lower - point.x, -radius)]
    high: list[Vector] = [np.minimum(problem.upper - point.x, radius)]
    if several:
        g[n] = 1.0
        rows.append(np.hstack([gradients, -np.ones((len(values), 1)),
                               np.zeros((len(values), int(floored)))]))  # fmt: skip
        low.append(np.full(1, -_FAR))
        high.append(np.full(1, _FAR))
    else:
        g[:n] = gradients[0]
    if floored:
        g[-1] = price
        indices = [index for index, _ in problem.floors]
        block = np.zeros((len(indices), size))
        block[:, :n] = point.gradients[indices]
        block[:, -1] = 1.0
        rows.append(block)
        low.append(np.zeros(1))
        high.append(np.full(1, _FAR))
    if several:
        low.append(np.full(len(values), -_FAR))
        high.append(values.max() - values)
    if floored:
        bounds = np.array([bound for _, bound in problem.floors])
        low.append(bounds - point.values[indices])
        high.append(np.full(len(bounds), _FAR))
    frames = []
    steepest = gradients[int(values.argmax())]
    for ball in point.constraints:
        axes, pull = _axes(ball, multipliers, steepest)
        frames.append(axes)
        rho = ball.radius * _INSIDE
        H[:n, :n] += pull / rho * ball.jacobian.T @ ball.jacobian
        across = axes @ ball.residual / rho
        rows.append(np.hstack([axes @ ball.jacobian / rho, np.zeros((len(axes), size - n))]))
        low.append(np.minimum(-1.0 - across, 0.0))
        high.append(np.maximum(1.0 - across, 0.0))
    A = np.vstack(rows) if rows else np.zeros((0, size))
    answer = solve_qp(H, g, A, np.concatenate(low), np.concatenate(high))
    if answer is None:
        return None
    z, dual = answer
    promised = price * violation(problem, point) - float(g @ z + 0.5 * z @ H @ z)
    used = size
    terms = dual[used : used + len(values)] if several else np.ones(1)
    used += len(values) if several else 0
    floors = -dual[used : used + len(problem.floors)]
    used += len(problem.floors)
    pulls = {}
    for ball, axes in zip(point.constraints, frames, strict=True):
        k = len(axes)
        pulls[ball.name] = axes.T @ dual[used : used + k] / (ball.radius * _INSIDE)
        used += k
    return z[:n], promised, Multipliers(dual[:n], pulls, terms, floors)


def _slope(problem: Problem, point: Point, multipliers: Multipliers) -> Vector:
    """Gradient of the Lagrangian with the multipliers held, bounds left out."""
    slope = multipliers.terms @ problem.objective.terms(point)[1]
    for (index, _), weight in zip(problem.floors, multipliers.floors, strict=True):
        slope = slope - weight * point.gradients[index]
    for ball in point.constraints:
        slope = slope + multipliers.balls[ball.name] @ ball.jacobian
    return slope


def _bfgs(B: Vector, s: Vector, y: Vector) -> Vector:
    """Powell's damped update, which keeps B positive definite."""
    Bs = B @ s
    sBs = float(s @ Bs)
    if sBs < 1e-16:
        return B
    sy = float(s @ y)
    if sy < 0.2 * sBs:
        theta = 0.8 * sBs / (sBs - sy)
        y = theta * y + (1 - theta) * Bs
        sy = float(s @ y)
    return B - np.outer(Bs, Bs) / sBs + np.outer(y, y) / sy


def _pulled_back(problem: Problem, point: Point, d: Vector) -> Point | None:
    """Point near x + d within all balls, evaluated in full; None if there is none near."""
    x = np.clip(point.x + d, problem.lower, problem.upper)
    if point.constraints:
        none = np.zeros((0, len(x)))
        for _ in range(8):
            trial = _attempt(problem, x, pose_only=True)
            if trial is None:
                return None
            if trial.reached:
                break
            H, g = 1e-3 * np.eye(len(x)), np.zeros(len(x))
            for ball in trial.constraints:
                inside = ball.residual * min(1.0, ball.radius * _INSIDE / max(ball.error, 1e-300))
                J = ball.jacobian / ball.radius
                H += J.T @ J
                g += J.T @ ((ball.residual - inside) / ball.radius)
            step = solve_qp(H, g, none, problem.lower - x, problem.upper - x)
            if step is None or np.abs(step[0]).max() > 2 * np.abs(d).max() + 1e-4:
                return None
            x = np.clip(x + step[0], problem.lower, problem.upper)
        else:
            return None
    full = _attempt(problem, x, pose_only=False)
    return full if full is not None and full.reached else None
