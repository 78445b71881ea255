"""Prices of the constraints at a solution: its Lagrange multipliers.

A solution is exact only to the optimiser's precision, so an active constraint may be slightly off
its bound.  There is no sharp test for activity: all constraints that nearly hold are weighed, with
a penalty that grows with their distance from the bound.
"""

from dataclasses import dataclass

import numpy as np

from stiffopt.arrays import Array
from stiffopt.optimise.problem import PressureProblem, ProgramPoint
from stiffopt.optimise.quadratic import FAR, solve_qp
from stiffopt.optimise.reach import attempt
from stiffopt.optimise.settings import PRICES


@dataclass(frozen=True)
class Multipliers:
    """Lagrange multipliers: gain of the objective per unit of each constraint."""

    # (n,), per unit of the variables; positive at an active upper bound, negative at a lower one
    bounds: Array
    # vector for each of the point's `bounded` constraints, per unit of the term; its length is the
    # price of the radius
    balls: tuple[Array, ...]
    terms: Array  # (m,), weights of the objective's terms, which sum to one
    floors: Array  # per unit of each floor's logarithm


def prices_at(problem: PressureProblem, point: ProgramPoint) -> Multipliers | None:
    """Return the multipliers at a solution that minimise the Lagrangian's gradient.

    The weights w_i >= 0 minimise ``|sum w_i c_i|^2 + sum (slack s_i w_i |c_i|)^2``.  The c_i are
    the constraints' gradients, each times the size of its constraint; s_i is the distance from the
    bound as a share of that size.  The weights of the objective's terms sum to one.
    """
    values, gradients = problem.objective.terms(point)
    n = len(point.x)
    weights = _Weights()
    top = [i for i, value in enumerate(values) if value > values.max() - PRICES.near]
    for i in top:
        weights.add(gradients[i], float(values.max() - values[i]))
    for i, bound in enumerate(problem.floors):
        weights.add(-point.floor_gradients[i], float(point.floors[i] - bound), name=("floor", i))
    for i, ball in enumerate(point.bounded):
        off = 1 - ball.error / ball.radius
        if off < PRICES.near:
            weights.add(ball.pull, off, ball.radius, ("ball", i))
    for i in range(n):
        for side, off in ((-1, point.x[i] - problem.lower[i]), (1, problem.upper[i] - point.x[i])):
            if off <= 0:
                weights.add(side * np.eye(n)[i], 0.0, name=("bound", side * (i + 1)))
    found = weights.solved(len(top))
    if found is None:
        return None
    terms = np.zeros(len(values))
    terms[top] = found[: len(top)]
    named = dict(zip(weights.names[len(top) :], found[len(top) :], strict=True))
    floors = np.array([named.get(("floor", i), 0.0) for i in range(len(problem.floors))])
    pulls = []
    for i, ball in enumerate(point.bounded):
        weight = named.get(("ball", i), 0.0)
        pulls.append(weight / ball.error * ball.residual if weight else 0.0 * ball.residual)
    bounds = np.zeros(n)
    prices = Multipliers(bounds, tuple(pulls), terms, floors)
    for (kind, number), weight in named.items():
        if kind == "bound":
            # slightly beyond the limit, as the norm law has a kink at zero pressure of a segment
            i, side = abs(number) - 1, np.sign(number)
            moved = attempt(problem.needed, point.x + side * PRICES.beyond * np.eye(n)[i])
            slope = -side * weight
            if moved is not None:
                slope = _slope(problem, point, moved, prices)[i]
            bounds[i] += side * max(0.0, -side * float(slope))
    return prices


class _Weights:
    """Gradients of constraints, and the least-squares problem for their weights."""

    def __init__(self) -> None:
        self.names: list[tuple[str, int]] = []
        self._columns: list[Array] = []
        self._slacks: list[float] = []
        self._sizes: list[float] = []

    def add(
        self, gradient: Array, off: float, size: float = 1.0, name: tuple[str, int] = ("term", 0)
    ) -> None:
        """Add the gradient of a constraint of some size that is off its bound by a share of it."""
        if off < PRICES.near:
            self._columns.append(gradient * size)
            self._slacks.append(max(off, 0.0))
            self._sizes.append(size)
            self.names.append(name)

    def solved(self, terms: int) -> Array | None:
        """Return weights per unit of each constraint; those of the first `terms` sum to one."""
        count = len(self._columns)
        A = np.array(self._columns).T
        peak = float(np.abs(A[:, :terms]).max())
        A /= peak if peak > 1e-150 else 1.0  # the least pressure has no slope at zero
        lengths = np.linalg.norm(A, axis=0)
        scale = np.where(np.arange(count) < terms, 1.0, 1 / np.maximum(lengths, 1e-300))
        A = A * scale
        H = A.T @ A
        penalty = PRICES.slack * np.array(self._slacks) * lengths * scale
        H[np.diag_indices(count)] += penalty**2 + 1e-12
        total = (np.arange(count) < terms).astype(float)[np.newaxis]
        low = np.concatenate([np.zeros(count), [1.0]])
        high = np.concatenate([np.full(count, FAR), [1.0]])
        answer = solve_qp(np.ascontiguousarray(H), np.zeros(count), total, low, high)
        if answer is None:
            return None
        return np.maximum(answer[0], 0.0) * scale * np.array(self._sizes)


def _slope(
    problem: PressureProblem, point: ProgramPoint, moved: ProgramPoint, multipliers: Multipliers
) -> Array:
    """Return the Lagrangian's gradient at a moved point, multipliers fixed, bounds left out."""
    objective = problem.objective
    gradients = objective.held(point, moved) if objective.held else objective.terms(moved)[1]
    slope: Array = multipliers.terms @ gradients
    if len(problem.floors):
        slope = slope - multipliers.floors @ moved.floor_gradients
    for ball, pull in zip(moved.bounded, multipliers.balls, strict=True):
        slope = slope + pull @ ball.jacobian
    return slope
