"""Bring pressures to the target: Levenberg-Marquardt method within the pressure limits."""

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError
from stiffopt.model.stopping import checkpoint
from stiffopt.optimise.problem import PressureProblem, ProgramPoint
from stiffopt.optimise.settings import REACH

Point = TypeVar("Point", bound=ProgramPoint)


def reach(
    problem: PressureProblem, x: Array, most_iterations: int = REACH.iterations
) -> ProgramPoint | None:
    """Bring pressures to the pose, or as near to it as possible.

    Returns the last point; None if the arm has no equilibrium at the start.
    """
    point = attempt(problem.pose, x)
    if point is None:
        return None
    bounding = problem.bounding
    rows, scale, step = bounding.rows, bounding.scale, REACH.longest_step
    damping = REACH.damping
    residual, jacobian = bounding.missing(point.residual[rows], point.jacobian[rows])
    before = _misfit(residual / scale)
    for _ in range(most_iterations):
        if point.reached:
            return point
        d = bounded_step(
            jacobian,
            -residual,
            damping * bounding.far_damping,
            np.maximum(problem.lower - point.x, -step),
            np.minimum(problem.upper - point.x, step),
        )
        promised = before - _misfit((residual + jacobian @ d) / scale)
        if not promised >= REACH.least_progress * before:
            return point
        trial = attempt(problem.pose, within(problem.lower, point.x + d, problem.upper))
        after = math.inf
        if trial is not None:
            lacking = bounding.missing(trial.residual[rows], trial.jacobian[rows])
            after = _misfit(lacking[0] / scale)
        gained = before - after
        if trial is not None and gained > 0.1 * promised:
            point, before = trial, after
            residual, jacobian = lacking
            damping = max(damping * (0.1 if gained > 0.7 * promised else 1.0), REACH.least_damping)
        else:
            damping *= 10
            if damping > REACH.most_damping:
                return point
    return point


def can_reach(problem: PressureProblem, candidates: list[Array]) -> bool:
    """Return whether one of these pressures (n,) can be brought to the pose."""
    if not problem.robot.is_loaded:
        return bool((reach_all(problem, np.array(candidates))[1] <= 1).any())
    for x in candidates:
        problem.restart()
        point = reach(problem, x)
        if point is not None and point.reached:
            return True
    return False


def reach_all(problem: PressureProblem, x: Array) -> tuple[Array, Array]:
    """Bring pressures (N, n) of an arm without loads to the pose, all at once.

    Returns the final pressures, and the largest ratio (N,) of a residual to its radius: at most one
    where the pose was reached.  Obstacles are ignored.
    """
    bounding = problem.terms_bounding
    x = within(problem.lower, x, problem.upper)
    if not bounding.constraints:
        return x, np.zeros(len(x))
    rows, scale, step = bounding.rows, bounding.scale, REACH.longest_step
    full, slopes = (part[:, rows] for part in problem.poses(x))
    ratio = bounding.errors(full)
    residual, jacobian = bounding.missing(full, slopes)
    before = _misfits(residual / scale)
    damping = np.full(len(x), REACH.damping)
    going = np.flatnonzero((ratio > 1) & np.isfinite(before))
    for _ in range(REACH.iterations_of_many):
        checkpoint()
        if not len(going):
            break
        here, r, J, misfit = x[going], residual[going], jacobian[going], before[going]
        low = np.maximum(problem.lower - here, -step)
        high = np.minimum(problem.upper - here, step)
        D = damping[going, np.newaxis, np.newaxis] * bounding.far_damping
        d = bounded_steps(J, -r, D, low, high)
        left = _misfits((r + np.matmul(J, d[..., np.newaxis])[..., 0]) / scale)
        promised = misfit - left
        trial = within(problem.lower, here + d, problem.upper)
        full, slopes = (part[:, rows] for part in problem.poses(trial))
        new_residual, new_jacobian = bounding.missing(full, slopes)
        after = _misfits(new_residual / scale)
        gained = misfit - after
        better = gained > 0.1 * promised
        taken = going[better]
        x[taken], before[taken] = trial[better], after[better]
        residual[taken], jacobian[taken] = new_residual[better], new_jacobian[better]
        ratio[taken] = bounding.errors(full[better])
        change = np.where(better, np.where(gained > 0.7 * promised, 0.1, 1.0), 10.0)
        damping[going] = np.maximum(damping[going] * change, REACH.least_damping)
        hopeful = (promised >= REACH.least_progress * misfit) & (
            damping[going] <= REACH.most_damping
        )
        going = going[hopeful & (ratio[going] > 1)]
    return x, ratio


def bounded_steps(J: Array, wanted: Array, D: Array, low: Array, high: Array) -> Array:
    """Return steps d (..., n) within [low, high] that make ``|W (J d - wanted)|^2 + |d|^2`` small.

    J is (..., m, n), wanted (..., m), and D (..., m, m) the inverse of ``W^2``.  Components that
    leave their range are fixed at its end, and the others are solved for again.
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


def bounded_step(J: Array, wanted: Array, D: Array, low: Array, high: Array) -> Array:
    """Return a single step of `bounded_steps`, with less overhead.

    Rows of J that are zero, as those of distant obstacles, are skipped.
    """
    used = J.any(axis=1)
    if not used.all():
        J, wanted, D = J[used], wanted[used], D[np.ix_(used, used)]
    d = _solved(J.dot(J.T) + D, wanted).dot(J)
    leaving = (d < low) | (d > high)
    return bounded_steps(J, wanted, D, low, high) if leaving.any() else d


def _solved(A: Array, b: Array) -> Array:
    """Solve A y = b for positive definite A; if rounding makes it singular, with least norm."""
    try:
        return np.asarray(np.linalg.solve(A, b), dtype=float)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(A, hermitian=True) @ b)


def _misfit(residual: Array) -> float:
    return float(residual.dot(residual))


def _misfits(residuals: Array) -> Array:
    """Return squared lengths (N,) of residuals (N, m), infinite where any is not finite."""
    squares = np.einsum("ij,ij->i", residuals, residuals)
    return np.where(np.isfinite(squares), squares, np.inf)


def within(low: Array, x: Array, high: Array) -> Array:
    """Clip x to [low, high]."""
    return np.minimum(np.maximum(x, low), high)


def attempt(evaluate: Callable[[Array], Point], x: Array) -> Point | None:
    """Evaluate; return None without a stable equilibrium or with non-finite numbers."""
    try:
        point = evaluate(x)
    except EquilibriumError:
        return None
    return point if point.is_finite else None
