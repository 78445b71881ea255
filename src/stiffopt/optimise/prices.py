"""Prices of the constraints at a solution: its Lagrange multipliers.

A solution is exact to the optimiser's precision only, so that a constraint that binds may be off by
a little.  Whether it binds is therefore not tested: all that nearly hold are weighed, and each the
less the more it is off.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stiffopt.optimise.problem import PressureProblem, ProgramPoint
from stiffopt.optimise.quadratic import FAR, solve_qp
from stiffopt.optimise.reach import attempt
from stiffopt.optimise.settings import PRICES

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Multipliers:
    """Lagrange multipliers: what the objective would gain per unit of each constraint.

    Attributes
    ----------
    bounds : ndarray (n,)
        Per unit of the variables; positive where the upper bound holds back, negative where the
        lower does.
    balls : tuple of ndarray
        Vector for each of the point's `bounded` constraints, per unit of the term; its length is
        the price of the radius.
    terms : ndarray (m,)
        Weights of the objective's terms, which sum to one.
    floors : ndarray
        Per unit of each floor's logarithm.
    """

    bounds: Vector
    balls: tuple[Vector, ...]
    terms: Vector
    floors: Vector


def prices_at(problem: PressureProblem, point: ProgramPoint) -> Multipliers | None:
    """Multipliers at a solution: those that leave the least of the Lagrangian's gradient.

    With gradients c_i, each times the size of its constraint, and shares s_i of that size by which
    the constraints are off, the weights w_i >= 0 minimise
    ``|sum w_i c_i|^2 + sum (slack s_i w_i |c_i|)^2``; those of the objective's terms sum to one.
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
            # a little beyond the limit: the norm law has a kink where a segment is unpressurised
            i, side = abs(number) - 1, np.sign(number)
            moved = attempt(problem.needed, point.x + side * PRICES.beyond * np.eye(n)[i])
            slope = -side * weight
            if moved is not None:
                slope = _slope(problem, point, moved, prices)[i]
            bounds[i] += side * max(0.0, -side * float(slope))
    return prices


class _Weights:
    """Gradients of constraints that are weighed against each other."""

    def __init__(self) -> None:
        self.names: list[tuple[str, int]] = []
        self._columns: list[Vector] = []
        self._slacks: list[float] = []
        self._sizes: list[float] = []

    def add(
        self, gradient: Vector, off: float, size: float = 1.0, name: tuple[str, int] = ("term", 0)
    ) -> None:
        """One more gradient, of a constraint of some size that is off by a share of it."""
        if off < PRICES.near:
            self._columns.append(gradient * size)
            self._slacks.append(max(off, 0.0))
            self._sizes.append(size)
            self.names.append(name)

    def solved(self, terms: int) -> Vector | None:
        """Weights per unit of each constraint; those of the first ones sum to one."""
        count = len(self._columns)
        A = np.array(self._columns).T
        peak = float(np.abs(A[:, :terms]).max())
        A /= peak if peak > 1e-150 else 1.0  # least pressure, where there is none: no slope
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
        found: Vector = np.maximum(answer[0], 0.0) * scale * np.array(self._sizes)
        return found


def _slope(
    problem: PressureProblem, point: ProgramPoint, moved: ProgramPoint, multipliers: Multipliers
) -> Vector:
    """Gradient of the Lagrangian at a moved point, multipliers held, bounds left out."""
    objective = problem.objective
    gradients = objective.held(point, moved) if objective.held else objective.terms(moved)[1]
    slope: Vector = multipliers.terms @ gradients
    if len(problem.floors):
        slope = slope - multipliers.floors @ moved.floor_gradients
    for ball, pull in zip(moved.bounded, multipliers.balls, strict=True):
        slope = slope + pull @ ball.jacobian
    return slope
