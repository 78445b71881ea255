"""Onto the pose: Levenberg-Marquardt steps that mind the pressure limits."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import EquilibriumError
from stiffopt.optimise.problem import Point, Problem

Vector = NDArray[np.float64]


def reach(problem: Problem, x: Vector, most_iterations: int = 40) -> Point | None:
    """Bring pressures to the pose; the point nearest to it that was found otherwise.

    None if the arm has no equilibrium at the start.
    """
    point = attempt(problem.pose, x)
    if point is None:
        return None
    rows, scale = problem.bounding.rows, problem.bounding.scale
    damping = 1e-4
    before = _misfit(point.residual[rows] / scale)
    for _ in range(most_iterations):
        if point.reached:
            return point
        residual, jacobian = point.residual[rows], point.jacobian[rows]
        d = bounded_step(
            jacobian,
            -residual,
            damping * problem.bounding.far_damping,
            np.maximum(problem.lower - point.x, -1.0),
            np.minimum(problem.upper - point.x, 1.0),
        )
        promised = before - _misfit((residual + jacobian @ d) / scale)
        if not promised >= 1e-9 * before:
            return point
        trial = attempt(problem.pose, within(problem.lower, point.x + d, problem.upper))
        after = math.inf if trial is None else _misfit(trial.residual[rows] / scale)
        gained = before - after
        if trial is not None and gained > 0.1 * promised:
            point, before = trial, after
            damping = max(damping * (0.1 if gained > 0.7 * promised else 1.0), 1e-10)
        else:
            damping *= 10
            if damping > 1e6:
                return point
    return point


def reach_all(problem: Problem, x: Vector, most_iterations: int = 20) -> tuple[Vector, Vector]:
    """Bring pressures (N, n) of an arm without loads to the pose, all at once.

    Returns where they came to, and by how much (N,) the worst residual there exceeds its radius,
    as a ratio: at most one where the pose was reached.
    """
    bounding = problem.bounding
    x = within(problem.lower, x, problem.upper)
    if not bounding.spheres:
        return x, np.zeros(len(x))
    rows, scale = bounding.rows, bounding.scale
    residual, jacobian = (part[:, rows] for part in problem.poses(x))
    before = _misfits(residual / scale)
    ratio = bounding.errors(residual)
    damping = np.full(len(x), 1e-4)
    going = np.flatnonzero((ratio > 1) & np.isfinite(before))
    for _ in range(most_iterations):
        if not len(going):
            break
        here, r, J, misfit = x[going], residual[going], jacobian[going], before[going]
        low = np.maximum(problem.lower - here, -1.0)
        high = np.minimum(problem.upper - here, 1.0)
        D = damping[going, np.newaxis, np.newaxis] * bounding.far_damping
        d = bounded_steps(J, -r, D, low, high)
        left = _misfits((r + np.matmul(J, d[..., np.newaxis])[..., 0]) / scale)
        promised = misfit - left
        trial = within(problem.lower, here + d, problem.upper)
        new_residual, new_jacobian = (part[:, rows] for part in problem.poses(trial))
        after = _misfits(new_residual / scale)
        gained = misfit - after
        better = gained > 0.1 * promised
        taken = going[better]
        x[taken], before[taken] = trial[better], after[better]
        residual[taken], jacobian[taken] = new_residual[better], new_jacobian[better]
        ratio[taken] = bounding.errors(new_residual[better])
        change = np.where(better, np.where(gained > 0.7 * promised, 0.1, 1.0), 10.0)
        damping[going] = np.maximum(damping[going] * change, 1e-10)
        hopeful = (promised >= 1e-9 * misfit) & (damping[going] <= 1e6)
        going = going[hopeful & (ratio[going] > 1)]
    return x, ratio


def bounded_steps(J: Vector, wanted: Vector, D: Vector, low: Vector, high: Vector) -> Vector:
    """Steps d (..., n) within [low, high] that make ``|W (J d - wanted)|^2 + |d|^2`` small.

    J (..., m, n), wanted (..., m), and D (..., m, m), the inverse of ``W^2``.  Components that
    would leave their range are put on its end and the rest is solved again.
    """
    Jt = J.swapaxes(-1, -2)
    y = _solved(J @ Jt + D, wanted[..., np.newaxis])
    d = (Jt @ y)[..., 0]
    leaving = (d < low) | (d > high)
    held = leaving
    while leaving.any():
        d = np.where(held, within(low, d, high), 0.0)
        free = J * ~held[..., np.newaxis, :]
        rest = wanted[..., np.newaxis] - J @ d[..., np.newaxis]
        free_t = free.swapaxes(-1, -2)
        d = d + (free_t @ _solved(free @ free_t + D, rest))[..., 0]
        leaving = ((d < low) | (d > high)) & ~held
        held = held | leaving
    return d


def bounded_step(J: Vector, wanted: Vector, D: Vector, low: Vector, high: Vector) -> Vector:
    """The same for one row, which is most of the cost of small steps."""
    d = _solved(J.dot(J.T) + D, wanted).dot(J)
    leaving = (d < low) | (d > high)
    return bounded_steps(J, wanted, D, low, high) if leaving.any() else d


def _solved(A: Vector, b: Vector) -> Vector:
    """Solution of A y = b with A positive definite, but for rounding: then that of least length."""
    try:
        return np.asarray(np.linalg.solve(A, b), dtype=float)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(A, hermitian=True) @ b)


def _misfit(residual: Vector) -> float:
    return float(residual.dot(residual))


def _misfits(residuals: Vector) -> Vector:
    """Squared lengths (N,) of residuals (N, m), infinite where anything is not finite."""
    squares = np.einsum("ij,ij->i", residuals, residuals)
    return np.where(np.isfinite(squares), squares, np.inf)


def within(low: Vector, x: Vector, high: Vector) -> Vector:
    """The nearest to x within [low, high]."""
    return np.minimum(np.maximum(x, low), high)


def attempt(evaluate: Callable[[Vector], Point], x: Vector) -> Point | None:
    """Evaluate; None where the arm has no stable equilibrium or anything is not finite."""
    try:
        point = evaluate(x)
    except EquilibriumError:
        return None
    return point if point.is_finite else None
