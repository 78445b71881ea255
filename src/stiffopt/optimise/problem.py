"""`PressureProblem`: the nonlinear program of a task on an arm, evaluated at pressures.

Variables are the pressures x (n,), each as a share of its channel's range (`pressure_ranges`).
The program minimises an objective.  Tolerances bound rows of a residual, ``|r(x)| <= radius``, and
inequalities ``r(x) <= radius``; some stiffnesses have lower bounds (floors).  Functions belong to
the structure of the task (`stiffopt.optimise.program`) and are cached by the robot.
"""

import math
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.arm import Evaluator
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.stopping import checkpoint
from stiffopt.optimise.functions import functions
from stiffopt.optimise.goal import StiffnessGoal
from stiffopt.optimise.obstacles import Obstacles
from stiffopt.optimise.program import BAR, Constraint, Program, pressure_ranges
from stiffopt.optimise.settings import CLOSEST, DESCENT
from stiffopt.optimise.task import Task


@dataclass(frozen=True)
class Ball:
    """A constraint with its residual at a point.

    `residual`: (k,). `jacobian`: (k, n), per variable.
    """

    constraint: Constraint
    residual: Array
    jacobian: Array

    @property
    def name(self) -> str:
        """Name of the term."""
        return self.constraint.name

    @property
    def radius(self) -> float:
        """Largest error that is allowed."""
        return self.constraint.radius

    @property
    def error(self) -> float:
        """Length of the residual; the residual itself if it is bounded on one side."""
        if self.constraint.one_sided:
            return float(self.residual[0])
        return math.sqrt(self.residual @ self.residual)

    @property
    def pull(self) -> Array:
        """Gradient (n,) of the error; the error must not be zero."""
        if self.constraint.one_sided:
            return self.jacobian[0]
        return self.residual / self.error @ self.jacobian


class ProgramPoint:
    """The program's values at one set of pressures.

    Attributes
    ----------
    x : (n,), pressures, as shares of the channels' ranges; all derivatives are with respect to
        them.
    residual : (m,), residuals of all terms, in their units.
    jacobian : ndarray (m, n)
    constraints : bounds on the rows.
    errors : error of each constraint, see `Ball.error`.
    reached : whether every constraint holds.
    terms : (t,), terms of the task's objective; empty where only the pose was evaluated.
    term_gradients : ndarray (t, n)
    floors : (f,), logarithms of the stiffnesses that have a lower bound.
    floor_gradients : ndarray (f, n)
    """

    __slots__ = (
        "constraints", "errors", "floor_gradients", "floors", "jacobian", "reached", "residual",
        "term_gradients", "terms", "x",
    )  # fmt: skip

    def __init__(
        self,
        x: Array,
        residual: Array,
        jacobian: Array,
        constraints: tuple[Constraint, ...],
        terms: Array,
        term_gradients: Array,
        floors: Array,
        floor_gradients: Array,
    ) -> None:
        self.x, self.residual, self.jacobian = x, residual, jacobian
        self.constraints = constraints
        values = residual.tolist()
        self.errors = tuple(
            [values[c.first] if c.one_sided else math.hypot(*values[c.first : c.end])
             for c in constraints]
        )  # fmt: skip
        self.reached = all(
            error <= c.radius for error, c in zip(self.errors, constraints, strict=True)
        )
        self.terms, self.term_gradients = terms, term_gradients
        self.floors, self.floor_gradients = floors, floor_gradients

    @property
    def balls(self) -> tuple[Ball, ...]:
        """All constraints with their residuals."""
        return tuple(
            Ball(c, self.residual[c.first : c.end], self.jacobian[c.first : c.end])
            for c in self.constraints
        )

    @property
    def bounded(self) -> tuple[Ball, ...]:
        """The constraints of finite radius."""
        return tuple(ball for ball in self.balls if ball.radius < math.inf)

    @property
    def is_finite(self) -> bool:
        """Whether all numbers are finite."""
        # a sum is finite if all summands are, and several times faster than checking each
        total = sum(self.errors) + _total(self.jacobian, None)
        if self.terms.size:
            total += _total(self.terms) + _total(self.term_gradients, None)
        if self.floors.size:
            total += _total(self.floors) + _total(self.floor_gradients, None)
        return math.isfinite(total)


@dataclass(frozen=True)
class Objective:
    """A function to minimise.

    Its value is the largest of `terms` (t,), so that the smallest of several stiffnesses can be
    maximised.  `curvature` is a convex estimate of the Hessian.  With `of_pose`, the objective
    depends on the residuals alone.
    """

    terms: Callable[[ProgramPoint], tuple[Array, Array]]  # values (t,), gradients (t, n)
    curvature: Callable[[ProgramPoint], Array]  # (n, n)
    precision: float  # decrease that no longer matters
    unit: str  # unit of `gain`, for prices
    gain: Callable[[ProgramPoint], float]  # stiffness or error gained per unit of decrease
    of_pose: bool = False
    held: Callable[[ProgramPoint, ProgramPoint], Array] | None = None
    """Gradients (t, n) at the second point, with their weights frozen at the first."""

    def value(self, point: ProgramPoint) -> float:
        """Return the value at a point."""
        return float(self.terms(point)[0].max())


class PressureProblem:
    """The nonlinear program of one task on one arm (which carries the task's load).

    Attributes
    ----------
    lower, upper : (n,), bounds of the variables.
    unit : (n,), pressures in Pa that are one unit of the variables.
    floors : (f,), lower bounds on `ProgramPoint.floors`; empty where floors are ignored.
    constraints : bounds on the residual.
    radii : radii that replace the target's, by name of the term.
    """

    def __init__(self, robot: Manipulator, task: Task) -> None:
        self.robot = robot
        self.task = task
        lower, upper = task.pressure_bounds(robot.description)
        self.unit = pressure_ranges(robot.description)
        self.lower, self.upper = lower / self.unit, upper / self.unit
        self.radii: dict[str, float] = {}
        self._set_functions()
        self._set_constraints()
        self.objective = self._objective()
        self.floors = floor_bounds(task.stiffness)

    def _set_functions(self) -> None:
        robot, self.program = self.robot, Program.of(self.task, self.robot.description)
        self.parameters = robot.parameters(self.program.parameters)
        self._functions = functions(robot, self.program)
        self._is_loaded = robot.is_loaded
        self._pose = Evaluator(robot, self._functions["pose"])
        self._full = Evaluator(robot, self._functions["point"])

    def _all_constraints(self) -> tuple[Constraint, ...]:
        return self.program.constraints(self.robot.length)

    def _set_constraints(self) -> None:
        self.constraints = tuple(
            c._replace(radius=self.radii.get(c.name, c.radius)) for c in self._all_constraints()
        )
        self.bounding = Bounding(self.constraints)
        own = self.program.n_own_rows
        self.terms_bounding = Bounding(tuple(c for c in self.constraints if c.first < own))

    # -- evaluation -------------------------------------------------------------------------

    def restart(self) -> None:
        """Forget the equilibrium of the last evaluation (see `Evaluator`)."""
        self._pose.restart()

    def pose(self, x: Array) -> ProgramPoint:
        """Return the constraints alone at pressures x; cheaper than `point`."""
        checkpoint()
        if self._is_loaded:
            residual, jacobian = self._pose(x * self.unit, self.parameters)
        else:
            residual, jacobian = self._functions["pose"](x * self.unit, self.parameters)
        residual, jacobian = self.with_obstacles(x, residual[:, 0], jacobian.T * self.unit)
        return ProgramPoint(x, residual, jacobian, self.constraints, *_NOTHING)

    def with_obstacles(self, x: Array, residual: Array, jacobian: Array) -> tuple[Array, Array]:
        """Append the rows of obstacles at pressures x to those of the terms, (m,) and (m, n)."""
        if self.program.obstacles is None:
            return residual, jacobian
        rows, slopes = self.program.obstacles.rows(self.robot, x * self.unit)
        return np.append(residual, rows), np.vstack([jacobian, slopes * self.unit])

    def poses(self, x: Array) -> tuple[Array, Array]:
        """Return residuals (N, m) and Jacobians (N, m, n) of an arm without loads.

        Rows of obstacles are not included.  Pressures are x (N, n).
        """
        checkpoint()
        residuals, jacobians = self._functions["pose"].many(
            x * self.unit, self.parameters, threads=1
        )
        return residuals[:, :, 0], jacobians.swapaxes(1, 2) * self.unit

    def point(self, x: Array) -> ProgramPoint:
        """Return all values and derivatives at pressures x."""
        checkpoint()
        if self._is_loaded:
            self._full.restart(self._pose.state)
            outputs = self._full(x * self.unit, self.parameters)
            self._pose.restart(self._full.state)
        else:
            outputs = self._functions["point"](x * self.unit, self.parameters)
        residual, jacobian, terms, term_gradients, floors, floor_gradients = outputs
        residual, jacobian = self.with_obstacles(x, residual[:, 0], jacobian.T * self.unit)
        return ProgramPoint(
            x,
            residual,
            jacobian,
            self.constraints,
            terms[:, 0],
            term_gradients.T * self.unit,
            floors[:, 0] if floors.size else _NONE,
            floor_gradients.reshape(len(x), -1).T * self.unit,
        )

    def needed(self, x: Array) -> ProgramPoint:
        """Return as much as objective and floors need at pressures x."""
        of_pose = self.objective.of_pose and not len(self.floors)
        return self.pose(x) if of_pose else self.point(x)

    def worth(self, x: Array) -> ProgramPoint:
        """Return the objective and floors at pressures x that reach the pose, for ranking."""
        worth = self._functions.worth
        if self.objective.of_pose or worth is None:
            return self.needed(x)
        terms, floors = worth(x * self.unit, self.parameters)
        at_target = np.zeros(self.program.n_rows)
        none = np.zeros((0, len(x)))
        floors = floors[:, 0] if floors.size else _NONE
        return ProgramPoint(x, at_target, none, self.constraints, terms[:, 0], none, floors, none)

    def judged(self, pressures: Array) -> tuple[list[float], Array, Array, list[float]]:
        """Return the arguments of `Judgement.of` at (n,) in Pa, for an arm without loads."""
        residuals, pose, compliance, values = self._functions["judge"](pressures, self.parameters)
        found = residuals.ravel().tolist()
        if self.program.obstacles is not None:
            found += self.program.obstacles.exact_rows(self.robot, pressures)
        return found, pose.T, compliance.T, values.ravel().tolist()

    # -- objectives -------------------------------------------------------------------------

    def _objective(self) -> Objective:
        n = len(self.lower)
        program, goal = self.program, self.task.stiffness
        unit, gain = "1", _one
        if program.aim == "least pressure":
            unit = "bar^2"
            gain = lambda point: (program.reference / BAR) ** 2  # noqa: E731
        if program.aim == "maximise" and goal is not None:
            unit = goal.maximise[0].unit
            gain = lambda point: float(np.exp(-point.terms.max()))  # noqa: E731
        return Objective(
            lambda point: (point.terms, point.term_gradients),
            lambda point: DESCENT.curvature * np.eye(n),
            precision=program.precision,
            unit=unit,
            gain=gain,
        )

    def closest(self, name: str) -> Objective:
        """Return the objective ``|error / scale|^2 / 2`` of one term, to approach it."""
        own = [c for c in self.constraints if c.name == name]
        rows, one_sided, scale = slice(own[0].first, own[-1].end), own[0].one_sided, own[0].scale
        (radius,) = {term.radius for term in self.program.terms if term.name == name}

        def error(point: ProgramPoint) -> Array:
            residual = point.residual[rows]
            return (np.maximum(residual - radius, 0.0) if one_sided else residual) / scale

        def terms(point: ProgramPoint) -> tuple[Array, Array]:
            e = error(point)
            return np.array([0.5 * e.dot(e)]), held(point, point)

        def held(point: ProgramPoint, moved: ProgramPoint) -> Array:
            gradient: Array = error(point) @ moved.jacobian[rows] / scale
            return gradient[np.newaxis]

        def curvature(point: ProgramPoint) -> Array:
            jacobian = point.jacobian[rows] / scale
            return jacobian.T @ jacobian

        def gain(point: ProgramPoint) -> float:
            return scale / max(math.hypot(*error(point).tolist()), 1e-12)

        (unit,) = {term.unit for term in self.program.terms if term.name == name}
        return Objective(terms, curvature, CLOSEST.precision, unit, gain, of_pose=True, held=held)

    def best_floors(self) -> Objective:
        """Return the objective that minimises the largest violation of a floor."""
        return Objective(
            lambda point: (self.floors - point.floors, -point.floor_gradients),
            lambda point: DESCENT.curvature * np.eye(len(point.x)),
            precision=1e-7,
            unit="1",
            gain=_one,
        )

    # -- similar programs -------------------------------------------------------------------

    def among(self, obstacles: Obstacles) -> "PressureProblem":
        """Return the same program with these rows for the objects of a scene."""
        other = copy(self)
        other.program = replace(self.program, obstacles=obstacles)
        other._set_constraints()
        return other

    def changed(
        self, objective: Objective, radii: Mapping[str, float] | None = None, floors: bool = True
    ) -> "PressureProblem":
        """Return the same program with another objective, other radii by name, or no floors.

        An infinite radius frees a term.
        """
        other = copy(self)
        other.objective = objective
        if not floors:
            other.floors = np.zeros(0)
        other.radii = {**self.radii, **(radii or {})}
        other._set_constraints()
        return other


class Bounding:
    """The constraints of finite radius, as arrays for the steps of local searches.

    Attributes
    ----------
    constraints : with rows numbered within `rows`.
    indices : their indices among all constraints.
    rows : their rows of the residual.
    radius, scale : (m,), values of each row's constraint.
    """

    def __init__(self, constraints: tuple[Constraint, ...]) -> None:
        kept = [(i, c) for i, c in enumerate(constraints) if c.radius < math.inf]
        self.indices = tuple(i for i, _ in kept)
        moved, rows = [], [row for _, c in kept for row in range(c.first, c.end)]
        end = 0
        for _, c in kept:
            first, end = end, end + c.end - c.first
            moved.append(c._replace(first=first, end=end))
        self.constraints = tuple(moved)
        begin = rows[0] if rows else 0
        contiguous = rows == list(range(begin, begin + len(rows)))
        self.rows = slice(begin, begin + len(rows)) if contiguous else np.array(rows)
        sizes = [c.end - c.first for c in moved]
        self.radius = np.repeat([c.radius for c in moved], sizes).astype(float)
        self.scale = np.repeat([c.scale for c in moved], sizes).astype(float)
        self._one_sided = np.repeat([c.one_sided for c in moved], sizes).astype(bool)
        self._is_one_sided = bool(self._one_sided.any())

    @cached_property
    def far_damping(self) -> Array:
        """Diagonal matrix (m, m) of squared scales."""
        return np.diag(self.scale**2)

    @cached_property
    def near_damping(self) -> Array:
        """Diagonal matrix (m, m) of squared radii."""
        return np.diag(self.radius**2)

    def missing(self, residual: Array, jacobian: Array) -> tuple[Array, Array]:
        """Return the violations of residuals (..., m), and their Jacobian.

        A two-sided residual is returned as it is; a one-sided one by how much it exceeds its bound,
        with rows (..., m, n) of the Jacobian zero where the bound holds.
        """
        if not self._is_one_sided:
            return residual, jacobian
        inside = DESCENT.inside * self.radius
        holds = self._one_sided & (residual <= inside)
        lacks = np.where(self._one_sided, np.maximum(residual - inside, 0.0), residual)
        return lacks, np.where(holds[..., np.newaxis], 0.0, jacobian)

    def errors(self, residuals: Array) -> Array:
        """Return the largest ratio (N,) of an error to its radius, for residuals (N, m)."""
        worst = np.zeros(len(residuals))
        for c in self.constraints:
            part = residuals[:, c.first : c.end]
            lengths = part[:, 0] if c.one_sided else np.sqrt(np.einsum("ij,ij->i", part, part))
            np.maximum(worst, lengths / c.radius, out=worst)
        return worst


def floor_bounds(goal: StiffnessGoal | None) -> Array:
    """Return the lower bounds (f,) on the logarithms of a goal's floors, with some margin."""
    values = [floor.value for floor in goal.at_least] if goal is not None else []
    return np.log(np.array(values)) + DESCENT.floor_margin


def _one(point: ProgramPoint) -> float:
    return 1.0


_total = np.add.reduce
_NONE = np.zeros(0)
_NOTHING = (_NONE, np.zeros((0, 0)), _NONE, np.zeros((0, 0)))
