"""Prices of the constraints at a solution: its Lagrange multipliers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stiffopt.optimise.problem import Point, Problem
from stiffopt.optimise.quadratic import FAR, solve_qp
from stiffopt.optimise.reach import attempt

Vector = NDArray[np.float64]

_BINDING = 1e-4  # how nearly, relatively, a constraint must hold to count as binding
_BEYOND = 1e-3  # bar; where the price of a limit is taken, outside of it


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


def prices_at(problem: Problem, point: Point) -> Multipliers | None:
    """Multipliers at a solution: those that leave the least of the Lagrangian's gradient.

    Each constraint that binds pulls with a weight that is not negative; the weights of the
    objective's largest terms sum to one.
    """
    values, gradients = problem.objective.terms(point)
    n = len(point.x)
    columns: list[Vector] = []
    top = [i for i, value in enumerate(values) if value > values.max() - _BINDING]
    columns += [gradients[i] for i in top]
    floors = [i for i, bound in enumerate(problem.floors) if point.floors[i] < bound + _BINDING]
    columns += [-point.floor_gradients[i] for i in floors]
    balls = [ball for ball in point.constraints if ball.error > (1 - _BINDING) * ball.radius]
    columns += [ball.residual / ball.error @ ball.jacobian for ball in balls]
    sides = [(i, -1.0) for i in range(n) if point.x[i] <= problem.lower[i]]
    sides += [(i, 1.0) for i in range(n) if point.x[i] >= problem.upper[i]]
    columns += [side * np.eye(n)[i] for i, side in sides]
    A = np.array(columns).T
    total = (np.arange(len(columns)) < len(top)).astype(float)[np.newaxis]
    low = np.concatenate([np.zeros(len(columns)), [1.0]])
    high = np.concatenate([np.full(len(columns), FAR), [1.0]])
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
        moved = attempt(problem.needed, beyond)
        slope = _slope(problem, moved, prices)[i] if moved is not None else -side * weight
        bounds[i] += side * max(0.0, -side * float(slope))
    return prices


def _slope(problem: Problem, point: Point, multipliers: Multipliers) -> Vector:
    """Gradient of the Lagrangian with the multipliers held, bounds left out."""
    slope = multipliers.terms @ problem.objective.terms(point)[1]
    if len(problem.floors):
        slope = slope - multipliers.floors @ point.floor_gradients
    for ball in point.constraints:
        slope = slope + multipliers.balls[ball.name] @ ball.jacobian
    return slope
