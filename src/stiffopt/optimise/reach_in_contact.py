"""Bring pressures to a target in contact, with the contact kept on the way.

A Gauss-Newton method within a trust region. Each step solves a quadratic program for the change d
of the variables and for s, how far each row of the residual is then outside its bounds,

    minimise |s|^2 + damping |d|^2  subject to  low <= (r + J d) / scale - s <= high,

in which the bounds are a share of the tolerances and of the demands on contacts. The sum F of the
contact forces must keep a share of its value, ``F + F' d >= kept F``: without contact, there is
nothing to follow.
"""

from __future__ import annotations

import math

import numpy as np

from stiffopt.arrays import Array
from stiffopt.optimise.leaning import BracedPoint, BracedProblem
from stiffopt.optimise.problem import Bounding
from stiffopt.optimise.quadratic import FAR, solve_qp
from stiffopt.optimise.reach import attempt, within
from stiffopt.optimise.settings import REACH_IN_CONTACT


def reach_in_contact(problem: BracedProblem, x: Array) -> BracedPoint | None:
    """Bring pressures (n,) to the target in contact, or as near to it as possible.

    Returns the last point; None if the arm has no equilibrium in contact at the start.
    """
    settings = REACH_IN_CONTACT
    point = attempt(problem.pose, x)
    radius, misses = settings.first_radius, _Misses(problem.bounding)
    for _ in range(settings.iterations):
        if point is None or point.reached:
            break
        before = misses.of(point.residual)
        d = misses.step(problem, point, radius)
        if d is None:
            break
        promised = before - misses.of(point.residual + point.jacobian @ d)
        length = float(np.abs(d).max())
        if not promised > settings.least_progress * before:
            break
        problem.here = point.equilibrium  # whatever the last trial found
        trial = attempt(problem.pose, within(problem.lower, point.x + d, problem.upper))
        gained = -math.inf if trial is None else before - misses.of(trial.residual)
        if gained > 0.1 * promised:
            point = trial
            if gained > 0.7 * promised:
                radius = max(radius, 2 * length)
        else:
            radius = 0.3 * length
            if radius < settings.least_radius:
                break
    if point is not None:
        problem.here = point.equilibrium
    return point


class _Misses:
    """How far each row of a residual is outside its bounds, divided by the row's scale."""

    def __init__(self, bounding: Bounding) -> None:
        self._bounding, self._scale = bounding, bounding.scale
        sizes = [c.end - c.first for c in bounding.constraints]
        # the box within each ball
        box = REACH_IN_CONTACT.inside * bounding.radius / np.sqrt(np.repeat(sizes, sizes))
        one_sided = np.repeat([c.one_sided for c in bounding.constraints], sizes)
        self._high = box / self._scale
        self._low = np.where(one_sided, -math.inf, -self._high)

    def of(self, residual: Array) -> float:
        """Return the sum of the squares of these distances."""
        rows = residual[self._bounding.rows] / self._scale
        missed = rows - np.clip(rows, self._low, self._high)
        return float(missed @ missed)

    def step(self, problem: BracedProblem, point: BracedPoint, radius: float) -> Array | None:
        """Return the step (n,) that brings the rows nearest to their bounds, or None."""
        n, m, settings = len(point.x), len(self._scale), REACH_IN_CONTACT
        rows = self._bounding.rows
        residual = point.residual[rows] / self._scale
        H = np.diag(np.concatenate([np.full(n, settings.damping), np.ones(m)]))
        A = np.zeros((m + 1, n + m))
        A[:m, :n] = point.jacobian[rows] / self._scale[:, np.newaxis]
        A[:m, n:] = -np.eye(m)
        A[m, :n] = point.force_gradient
        free, far = np.full(m, FAR), np.array([FAR])
        low = np.concatenate([
            np.maximum(problem.lower - point.x, -radius), -free,
            np.maximum(self._low - residual, -FAR), [(settings.kept - 1) * point.force],
        ])  # fmt: skip
        high = np.concatenate([
            np.minimum(problem.upper - point.x, radius), free, self._high - residual, far,
        ])  # fmt: skip
        answer = solve_qp(H, np.zeros(n + m), A, low, high)
        return None if answer is None else answer[0][:n]
