"""Optimise neighbouring points of a path together where the rates of the pressures bind.

Where no rate binds, each point is already at its own optimum.  Elsewhere the pressures x of a
window of points are optimised together, by sequential convex programming::

    minimise    max_i e_i + w mean_i e_i                (over the mean: the mean alone)
    subject to  c_i(x_i) <= e_i                         c: logarithms of stiffness, negative
                |r_i(x_i)| <= tolerance                 residuals of position and angle
                |x_{i+1} - x_i| <= steps_i,  lower <= x_i <= upper,  clearance(x_i) >= clearance

In each iteration costs, residuals and clearances are linearised, and second derivatives of the
Lagrangian enter as a convex quadratic term; Clarabel solves the program, a second-order cone for
each tolerance.  A trust region and an exact penalty decide whether a step is taken.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from stiffopt.arrays import Array
from stiffopt.model.stopping import checkpoint
from stiffopt.optimise.program import Constraint
from stiffopt.optimise.settings import DESCENT
from stiffopt.paths.cones import minimised
from stiffopt.paths.points import PathTasks, Slopes, joined
from stiffopt.paths.settings import REFINEMENT

Entries = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
"""Rows, columns and values of entries of a matrix."""


def refined(
    tasks: PathTasks, pressures: Array, steps: Array, over: str, fixed: Collection[int] = ()
) -> Array:
    """Return pressures (N, n) that are better where the rates bind.

    A window in which the body would not keep clear is left as it was.

    Parameters
    ----------
    pressures : (N, n), in Pa; they solve the tasks and keep the steps.
    steps : (N - 1, n), largest changes from point to point, in Pa.
    over : "worst" or "mean"
    fixed : indices of points that must not change.
    """
    done: list[range] = []
    body = tasks.body
    passes = REFINEMENT.passes if body is None else 1  # longer windows come too near, as a rule
    for _ in range(passes):  # a window may be held back at its ends: a wider one then
        windows = [each for each in _windows(pressures, steps) if not _is_within(each, done)]
        if over == "worst" and (done or body is not None):
            # a window is worth its time where the worst point is in it
            slopes = tasks.slopes(range(len(tasks)), pressures)
            worst = -1 if slopes is None else int(slopes.costs.max(axis=1).argmax())
            windows = [each for each in windows if worst in each]
        if done:
            windows = [_wider(each, len(pressures)) for each in windows]
        for window in windows:
            new = _Window(tasks, pressures, steps, over, window, fixed).optimised()
            near = new[max(window.start - 1, 0) : window.stop + 1]
            if body is None or body.motion(near).clear:
                pressures = new
        done += windows
    return pressures


def _is_within(window: range, others: Sequence[range]) -> bool:
    return any(each.start <= window.start and window.stop <= each.stop for each in others)


def _wider(window: range, count: int) -> range:
    """Return a window three times as long, within `count` points."""
    return range(max(0, window.start - len(window)), min(count, window.stop + len(window)))


def _windows(pressures: Array, steps: Array) -> list[range]:
    """Return windows of points about steps that are near the rates; overlapping ones are joined."""
    near = (np.abs(np.diff(pressures, axis=0)) > REFINEMENT.near * steps).any(axis=1)
    margin, count = REFINEMENT.margin, len(pressures)
    middles = (np.flatnonzero(near) + 1).tolist()
    return joined(range(max(0, k - margin), min(count, k + margin)) for k in middles)


@dataclass
class _State:
    """A window at some pressures, with its linearisation."""

    x: Array  # ndarray (k, n) As shares of the ranges
    slopes: Slopes
    # near, near_slopes: ndarray (k, b), (k, b, n) Values of one-sided constraints, which must be at
    # most 0, and their derivatives
    near: Array
    near_slopes: Array
    # merit, excess: the merit function, and the sum of the constraints' violations
    merit: float
    excess: float


class _Step(NamedTuple):
    """A step d (k, n), multipliers of costs (k, t) and residuals (k, m), and the predicted gain."""

    d: Array
    weights: Array
    pulls: Array
    promised: float


class _Window:
    """Optimises a window of neighbouring points; all others are fixed."""

    def __init__(
        self,
        tasks: PathTasks,
        pressures: Array,
        steps: Array,
        over: str,
        window: range,
        fixed: Collection[int],
    ) -> None:
        self._tasks, self._pressures, self._over = tasks, pressures, over
        free = [index for index in window if index not in fixed]
        self._free = range(free[0], free[-1] + 1)
        unit = tasks.unit
        self._x = pressures / unit
        self._steps = steps / unit * REFINEMENT.inside
        self._lower, self._upper = tasks.lower / unit, tasks.upper / unit
        bounds = list(zip(tasks.own_constraints, tasks.radii[list(self._free)].T, strict=True))
        self._balls = [(c, radii) for c, radii in bounds if not c.one_sided]
        self._one_sided = [(c, radii) for c, radii in bounds if c.one_sided]
        self._scene = tasks.scene
        others = [i for i in range(len(pressures)) if i not in self._free]
        self._floor = -np.inf
        if over == "worst" and others:
            slopes = tasks.slopes(others, pressures[others])
            if slopes is not None:
                self._floor = float(slopes.costs.max())
        self._price = REFINEMENT.price

    def optimised(self) -> Array:
        """Return all pressures (N, n), with those of the window optimised."""
        state = self._state(self._x[self._free.start : self._free.stop])
        if state is None:
            return self._pressures
        best, radius = state, REFINEMENT.radius
        weights = np.full(state.slopes.costs.shape, self._weight)
        pulls = np.zeros(state.slopes.residuals.shape)
        few = REFINEMENT.iterations_in_scene
        for _ in range(REFINEMENT.iterations if self._scene is None else few):
            checkpoint()
            curvature = self._curvature(state, weights, pulls)
            found = self._step(state, curvature, radius)
            if found is None:
                break
            trial = self._state(np.clip(state.x + found.d, self._lower, self._upper))
            d = found.d
            for _ in range(REFINEMENT.corrections):  # constraints are curved: correct the step
                if trial is None or trial.excess <= 0:
                    break
                corrected = self._step(self._bent(state, trial, d), curvature, radius)
                if corrected is None:
                    break
                d = corrected.d
                trial = self._state(np.clip(state.x + d, self._lower, self._upper))
            gained = -np.inf if trial is None else state.merit - trial.merit
            weights, pulls = found.weights, found.pulls
            if trial is not None and gained > 0.1 * found.promised:
                state = trial
                radius = min(2 * radius, 1.0) if gained > 0.7 * found.promised else radius
                if state.excess == 0 and state.merit < best.merit:
                    best = state
            else:
                radius = 0.3 * min(radius, float(np.abs(found.d).max()))
            if found.promised < REFINEMENT.last_gain or radius < REFINEMENT.last_radius:
                break
        pressures = self._pressures.copy()
        pressures[self._free.start : self._free.stop] = best.x * self._tasks.unit
        return pressures

    @property
    def _weight(self) -> float:
        """Initial multiplier of a cost."""
        return (1.0 + REFINEMENT.mean) / len(self._free)

    # -- evaluation -----------------------------------------------------------------------------

    @staticmethod
    def _bent(state: _State, trial: _State, d: Array) -> _State:
        """Return a state with linear constraints exact at a step d (second-order correction)."""
        bend = np.einsum("kmn,kn->km", state.slopes.jacobians, d)
        residuals = trial.slopes.residuals - bend
        near = trial.near - np.einsum("kbn,kn->kb", state.near_slopes, d)
        return replace(state, slopes=state.slopes._replace(residuals=residuals), near=near)

    def _state(self, x: Array) -> _State | None:
        tasks, pressures = self._tasks, x * self._tasks.unit
        slopes = tasks.slopes(self._free, pressures)
        if slopes is None or not all(np.isfinite(each).all() for each in slopes):
            return None
        near, near_slopes = self._near(slopes, pressures)
        excess = float(np.maximum(near, 0.0).sum())
        for ball, radii in self._balls:
            sizes = np.linalg.norm(slopes.residuals[:, ball.first : ball.end], axis=1)
            excess += float(np.maximum(sizes - radii * DESCENT.inside, 0.0).sum()) / ball.scale
        costs = slopes.costs.max(axis=1)
        merit = float(costs.mean())
        if self._over == "worst":
            merit = max(float(costs.max()), self._floor) + REFINEMENT.mean * merit
        return _State(x, slopes, near, near_slopes, merit + self._price * excess, excess)

    def _near(self, slopes: Slopes, pressures: Array) -> tuple[Array, Array]:
        """Return scaled inequalities of terms and clearances, each to be at most 0."""
        k, n = pressures.shape
        values: list[Array] = []
        derivatives: list[Array] = []
        for c, radii in self._one_sided:
            values.append((slopes.residuals[:, c.first] - radii) / c.scale)
            derivatives.append(slopes.jacobians[:, c.first] / c.scale)
        if self._scene is not None:
            robot = self._tasks.robot
            clear = robot.clearances(pressures, self._scene)
            wanted = self._scene.clearance + REFINEMENT.aside
            values += list((wanted - clear.distances.T) / robot.length)
            derivatives += list(-clear.gradients.swapaxes(0, 1) * self._tasks.unit / robot.length)
        if not values:
            return np.zeros((k, 0)), np.zeros((k, 0, n))
        return np.stack(values, axis=1), np.stack(derivatives, axis=1)

    def _curvature(self, state: _State, weights: Array, pulls: Array) -> Array:
        """Return the convex part (k, n, n) of the Lagrangian's second derivatives."""
        k, n = state.x.shape
        h = REFINEMENT.difference

        def gradients(slopes: Slopes) -> Array:
            found: Array = np.einsum("kt,ktn->kn", weights, slopes.gradients)
            found += np.einsum("km,kmn->kn", pulls, slopes.jacobians)
            return found

        here, columns = gradients(state.slopes), []
        for index in range(n):
            shifted = state.x.copy()
            shifted[:, index] += h
            there = self._tasks.slopes(self._free, shifted * self._tasks.unit)
            if there is None:
                return np.tile(1e-3 * np.eye(n), (k, 1, 1))
            columns.append((gradients(there) - here) / h)
        H = np.stack(columns, axis=2)
        values, vectors = np.linalg.eigh((H + H.swapaxes(1, 2)) / 2)
        values = np.maximum(values, 1e-6)
        return (vectors * values[:, np.newaxis, :]) @ vectors.swapaxes(1, 2)

    # -- the convex program ---------------------------------------------------------------------

    def _step(self, state: _State, curvature: Array, radius: float) -> _Step | None:
        """Solve the convex program for a step; None if that fails."""
        k, n = state.x.shape
        costs = state.slopes.costs
        worst = self._over == "worst"
        # variables: d (k n), e (k), slack (k), and the worst cost
        size = k * n + 2 * k + worst
        e, slack = k * n, k * n + k
        rows = _Rows(size)
        every, point = np.arange(k * n), np.arange(k)
        low = np.maximum(self._lower - state.x, -radius).ravel()
        high = np.minimum(self._upper - state.x, radius).ravel()
        rows.add(high, (every, every, np.ones(k * n)))
        rows.add(-low, (every, every, -np.ones(k * n)))
        self._add_rates(rows, state.x)
        rows.add(np.zeros(k), (point, slack + point, -np.ones(k)))
        if worst:
            last = np.full(k, size - 1)
            rows.add(np.zeros(k), (point, e + point, np.ones(k)), (point, last, -np.ones(k)))
            if np.isfinite(self._floor):
                rows.add(np.array([-self._floor]), (np.zeros(1), last[:1], -np.ones(1)))
        rows.add_upper(state.near, state.near_slopes, slack)
        costs_from = rows.count
        rows.add_upper(costs, state.slopes.gradients, e)
        cones: list[object] = [clarabel.NonnegativeConeT(rows.count)]
        balls_from = rows.count
        for ball, radii in self._balls:
            self._add_ball(rows, state, ball, radii, slack)
            cones += [clarabel.SecondOrderConeT(1 + ball.end - ball.first)] * k
        row, column = np.triu_indices(n)
        corner = n * np.arange(k)[:, np.newaxis]
        where = (corner + row).ravel(), (corner + column).ravel()
        P = sparse.csc_matrix((curvature[:, row, column].ravel(), where), shape=(size, size))
        q = np.zeros(size)
        q[e : e + k] = (REFINEMENT.mean if worst else 1.0) / k
        q[slack : slack + k] = self._price
        if worst:
            q[-1] = 1.0
        A, bounds = rows.matrix()
        solution = minimised(P, q, A, bounds, cones)
        if solution is None:
            return None
        x, z = solution
        d = x[: k * n].reshape(k, n)
        pulls = np.zeros(state.slopes.residuals.shape)
        at = balls_from
        for ball, _ in self._balls:
            width = 1 + ball.end - ball.first
            own = z[at : at + k * width].reshape(k, width)
            pulls[:, ball.first : ball.end] = -own[:, 1:] / ball.scale
            at += k * width
        weights = z[costs_from : costs_from + costs.size].reshape(costs.shape)
        hoped = float(q @ x)
        return _Step(d, weights, pulls, state.merit - hoped)

    def _add_rates(self, rows: "_Rows", x: Array) -> None:
        """Add the rates between points of the window, and to the neighbours outside."""
        k, n = x.shape
        first, last = self._free.start, self._free.stop - 1
        steps = self._steps[first:last]
        apart = np.diff(x, axis=0)
        index = np.arange((k - 1) * n)
        for side in (1.0, -1.0):
            rows.add(
                np.maximum(steps - side * apart, 0.0).ravel(),
                (index, index + n, np.full(len(index), side)),
                (index, index, np.full(len(index), -side)),
            )
        for outside, inside, step in ((first - 1, 0, first - 1), (last + 1, k - 1, last)):
            if not 0 <= outside < len(self._x):
                continue
            own = inside * n + np.arange(n)
            gap = x[inside] - self._x[outside]
            for side in (1.0, -1.0):
                rows.add(
                    np.maximum(self._steps[step] - side * gap, 0.0),
                    (np.arange(n), own, np.full(n, side)),
                )

    def _add_ball(
        self, rows: "_Rows", state: _State, ball: Constraint, radii: Array, slack: int
    ) -> None:
        """Add the scaled cones ``(radius + slack, r + J d)`` of one constraint, radii (k,)."""
        k, n = state.x.shape
        width = 1 + ball.end - ball.first
        own = slice(ball.first, ball.end)
        bounds = np.zeros((k, width))
        bounds[:, 0] = radii * REFINEMENT.of_tolerance / ball.scale
        bounds[:, 1:] = state.slopes.residuals[:, own] / ball.scale
        tops = np.arange(k) * width
        below = (tops[:, np.newaxis] + np.arange(1, width)).ravel()
        point = np.repeat(np.arange(k), width - 1)
        rows.add(
            bounds.ravel(),
            (tops, slack + np.arange(k), -np.ones(k)),
            (
                np.repeat(below, n),
                _columns(point, n),
                -state.slopes.jacobians[:, own].ravel() / ball.scale,
            ),
        )


class _Rows:
    """Collects rows of ``A x + s = b``."""

    def __init__(self, size: int) -> None:
        self._size, self.count = size, 0
        self._bounds: list[Array] = []
        self._entries: list[Entries] = []

    def add(self, bounds: Array, *entries: Entries) -> None:
        """Add rows with these b, and entries (row from the first of them, column, value)."""
        self._bounds.append(bounds)
        self._entries += [(row + self.count, column, value) for row, column, value in entries]
        self.count += len(bounds)

    def add_upper(self, values: Array, slopes: Array, bound: int) -> None:
        """Bound linearised values (k, b) of k points, with slopes (k, b, n), each by a variable.

        The bounds are the k variables from column `bound` on.
        """
        k, b, n = slopes.shape
        if b:
            point, index = np.repeat(np.arange(k), b), np.arange(k * b)
            self.add(
                -values.ravel(),
                (np.repeat(index, n), _columns(point, n), slopes.ravel()),
                (index, bound + point, -np.ones(k * b)),
            )

    def matrix(self) -> tuple[sparse.csc_matrix, Array]:
        """Return A and b."""
        row, column, value = (np.concatenate(each) for each in zip(*self._entries, strict=True))
        A = sparse.csc_matrix((value, (row, column)), shape=(self.count, self._size))
        return A, np.concatenate(self._bounds)


def _columns(points: NDArray[np.intp], n: int) -> NDArray[np.intp]:
    """Return the columns of the variables of some points, n for each."""
    return (points[:, np.newaxis] * n + np.arange(n)).ravel()
