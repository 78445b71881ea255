"""From a task and an arm to a nonlinear program over the pressures.

Variables are the pressures x (n,), each as a share of its channel's range (`pressure_ranges`).
Terms of the task bound rows of a residual: ``|r(x)| <= radius``, which is how tolerances are used
and not ignored, or ``r(x) <= radius`` for an inequality.  What is sought is the lowest value of an
objective, with some stiffnesses bounded from below.  The functions behind it belong to the
structure of the task (`stiffopt.optimise.program`) and stay with the robot.
"""

import math
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.arm import Evaluator
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.stopping import checkpoint
from stiffopt.optimise.functions import functions
from stiffopt.optimise.goal import StiffnessGoal
from stiffopt.optimise.obstacles import Obstacles
from stiffopt.optimise.program import BAR, Constraint, Program, pressure_ranges
from stiffopt.optimise.settings import CLOSEST, DESCENT
from stiffopt.optimise.task import Task

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Ball:
    """A constraint with its residual at a point: ``|r| <= radius``.

    Attributes
    ----------
    constraint : Constraint
    residual : ndarray (k,)
    jacobian : ndarray (k, n)
        Per variable.
    """

    constraint: Constraint
    residual: Vector
    jacobian: Vector

    @property
    def name(self) -> str:
        """Of the term."""
        return self.constraint.name

    @property
    def radius(self) -> float:
        """Largest error."""
        return self.constraint.radius

    @property
    def error(self) -> float:
        """Length of the residual, or the residual itself if it is bounded on one side."""
        if self.constraint.one_sided:
            return float(self.residual[0])
        return math.sqrt(self.residual @ self.residual)

    @property
    def pull(self) -> Vector:
        """Gradient (n,) of the error, which is not zero."""
        if self.constraint.one_sided:
            row: Vector = self.jacobian[0]
            return row
        gradient: Vector = self.residual / self.error @ self.jacobian
        return gradient


class ProgramPoint:
    """The program at one set of pressures.

    Attributes
    ----------
    x : ndarray (n,)
        Pressures, as shares of the channels' ranges; all derivatives are by them.
    residual : ndarray (m,)
        Of all terms, in their units.
    jacobian : ndarray (m, n)
    constraints : tuple of Constraint
        How the rows are bounded.
    errors : tuple of float
        Of each constraint, see `Ball.error`.
    reached : bool
        Whether every constraint holds.
    terms : ndarray (t,)
        Of the task's objective; empty where only the pose was evaluated.
    term_gradients : ndarray (t, n)
    floors : ndarray (f,)
        Logarithms of the stiffnesses that are bounded from below.
    floor_gradients : ndarray (f, n)
    """

    __slots__ = (
        "constraints", "errors", "floor_gradients", "floors", "jacobian", "reached", "residual",
        "term_gradients", "terms", "x",
    )  # fmt: skip

    def __init__(
        self,
        x: Vector,
        residual: Vector,
        jacobian: Vector,
        constraints: tuple[Constraint, ...],
        terms: Vector,
        term_gradients: Vector,
        floors: Vector,
        floor_gradients: Vector,
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
        """The constraints one by one."""
        return tuple(
            Ball(c, self.residual[c.first : c.end], self.jacobian[c.first : c.end])
            for c in self.constraints
        )

    @property
    def bounded(self) -> tuple[Ball, ...]:
        """Those of them that are not infinitely wide."""
        return tuple(ball for ball in self.balls if ball.radius < math.inf)

    @property
    def is_finite(self) -> bool:
        """Whether all numbers are finite."""
        # a sum is as good as a look at each, and several times as fast
        total = sum(self.errors) + _total(self.jacobian, None)
        if self.terms.size:
            total += _total(self.terms) + _total(self.term_gradients, None)
        if self.floors.size:
            total += _total(self.floors) + _total(self.floor_gradients, None)
        return math.isfinite(total)


@dataclass(frozen=True)
class Objective:
    """A function of a point that is minimised.

    The value is the largest of `terms` (t,); several terms are minimised together (the smallest
    of several stiffnesses maximised).  `curvature` is a convex guess of the Hessian.  With
    `of_pose` the residuals are all that it needs.
    """

    terms: Callable[[ProgramPoint], tuple[Vector, Vector]]  # values (t,), gradients (t, n)
    curvature: Callable[[ProgramPoint], Vector]  # (n, n)
    precision: float  # decrease that no longer matters
    unit: str  # of what a decrease gains, for prices
    gain: Callable[[ProgramPoint], float]  # that gain per unit of decrease
    of_pose: bool = False
    held: Callable[[ProgramPoint, ProgramPoint], Vector] | None = None
    """Gradients (t, n) at the second point with weights that depend on x held at the first."""

    def value(self, point: ProgramPoint) -> float:
        """Value at a point."""
        return float(self.terms(point)[0].max())


class PressureProblem:
    """The nonlinear program of one task on one arm (which carries the task's load).

    Attributes
    ----------
    lower, upper : ndarray (n,)
        Bounds of the variables.
    unit : ndarray (n,)
        Pressures in Pa that are one unit of the variables.
    objective : Objective
    floors : ndarray (f,)
        What `ProgramPoint.floors` may not fall below; empty where they do not matter.
    constraints : tuple of Constraint
        How the residual is bounded.
    radii : dict of str to float
        Radii by name of the term, other than the target's.
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

    def pose(self, x: Vector) -> ProgramPoint:
        """The balls alone at pressures x; cheaper than `point`."""
        checkpoint()
        if self._is_loaded:
            residual, jacobian = self._pose(x * self.unit, self.parameters)
        else:
            residual, jacobian = self._functions["pose"](x * self.unit, self.parameters)
        residual, jacobian = self.with_obstacles(x, residual[:, 0], jacobian.T * self.unit)
        return ProgramPoint(x, residual, jacobian, self.constraints, *_NOTHING)

    def with_obstacles(
        self, x: Vector, residual: Vector, jacobian: Vector
    ) -> tuple[Vector, Vector]:
        """Rows of the terms (m,), (m, n) at pressures x, and those of obstacles after them."""
        if self.program.obstacles is None:
            return residual, jacobian
        rows, slopes = self.program.obstacles.rows(self.robot, x * self.unit)
        return np.append(residual, rows), np.vstack([jacobian, slopes * self.unit])

    def poses(self, x: Vector) -> tuple[Vector, Vector]:
        """Residuals (N, m) and Jacobians (N, m, n) at pressures (N, n) of an arm without loads.

        These are the terms' own: obstacles are not looked at.
        """
        checkpoint()
        residuals, jacobians = self._functions["pose"].many(
            x * self.unit, self.parameters, threads=1
        )
        return residuals[:, :, 0], jacobians.swapaxes(1, 2) * self.unit

    def point(self, x: Vector) -> ProgramPoint:
        """Everything at pressures x."""
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

    def needed(self, x: Vector) -> ProgramPoint:
        """As much as objective and floors take at pressures x."""
        of_pose = self.objective.of_pose and not len(self.floors)
        return self.pose(x) if of_pose else self.point(x)

    def worth(self, x: Vector) -> ProgramPoint:
        """Enough of a point at pressures x that reach the pose to rank it by its objective."""
        worth = self._functions.worth
        if self.objective.of_pose or worth is None:
            return self.needed(x)
        terms, floors = worth(x * self.unit, self.parameters)
        at_target = np.zeros(self.program.n_rows)
        none = np.zeros((0, len(x)))
        floors = floors[:, 0] if floors.size else _NONE
        return ProgramPoint(x, at_target, none, self.constraints, terms[:, 0], none, floors, none)

    def judged(self, pressures: Vector) -> tuple[list[float], Vector, Vector, list[float]]:
        """What `Judgement.of` takes, at pressures (n,) in Pa of an arm without loads."""
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
        """Half the squared error of one term over a scale: what brings the arm closest to it."""
        own = [c for c in self.constraints if c.name == name]
        rows, one_sided, scale = slice(own[0].first, own[-1].end), own[0].one_sided, own[0].scale
        (radius,) = {term.radius for term in self.program.terms if term.name == name}

        def error(point: ProgramPoint) -> Vector:
            residual = point.residual[rows]
            return (np.maximum(residual - radius, 0.0) if one_sided else residual) / scale

        def terms(point: ProgramPoint) -> tuple[Vector, Vector]:
            e = error(point)
            return np.array([0.5 * e.dot(e)]), held(point, point)

        def held(point: ProgramPoint, moved: ProgramPoint) -> Vector:
            gradient: Vector = error(point) @ moved.jacobian[rows] / scale
            return gradient[np.newaxis]

        def curvature(point: ProgramPoint) -> Vector:
            jacobian = point.jacobian[rows] / scale
            return jacobian.T @ jacobian

        def gain(point: ProgramPoint) -> float:
            return scale / max(math.hypot(*error(point).tolist()), 1e-12)

        (unit,) = {term.unit for term in self.program.terms if term.name == name}
        return Objective(terms, curvature, CLOSEST.precision, unit, gain, of_pose=True, held=held)

    def best_floors(self) -> Objective:
        """The most by which a floor is missed: what brings all floors as close as they come."""
        return Objective(
            lambda point: (self.floors - point.floors, -point.floor_gradients),
            lambda point: DESCENT.curvature * np.eye(len(point.x)),
            precision=1e-7,
            unit="1",
            gain=_one,
        )

    # -- similar programs -------------------------------------------------------------------

    def among(self, obstacles: Obstacles) -> "PressureProblem":
        """The same program with these rows for the objects of a scene."""
        other = copy(self)
        other.program = replace(self.program, obstacles=obstacles)
        other._set_constraints()
        return other

    def changed(
        self, objective: Objective, radii: Mapping[str, float] | None = None, floors: bool = True
    ) -> "PressureProblem":
        """The same program with another objective, without floors, or with other radii by name.

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
    constraints : tuple of Constraint
        Rows are counted within `rows`.
    indices : tuple of int
        Which of all constraints they are.
    rows : slice or ndarray of int
        Their rows of the residual.
    radius, scale : ndarray (m,)
        Of each row's constraint.
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
    def far_damping(self) -> Vector:
        """Squared scales (m, m), on the diagonal."""
        return np.diag(self.scale**2)

    @cached_property
    def near_damping(self) -> Vector:
        """Squared radii (m, m), on the diagonal."""
        return np.diag(self.radius**2)

    def missing(self, residual: Vector, jacobian: Vector) -> tuple[Vector, Vector]:
        """What residuals (..., m) lack of their middle, or of a bound on one side, and slopes.

        Rows (..., m, n) of the Jacobian are zero where a bound on one side holds.
        """
        if not self._is_one_sided:
            return residual, jacobian
        inside = DESCENT.inside * self.radius
        holds = self._one_sided & (residual <= inside)
        lacks = np.where(self._one_sided, np.maximum(residual - inside, 0.0), residual)
        return lacks, np.where(holds[..., np.newaxis], 0.0, jacobian)

    def errors(self, residuals: Vector) -> Vector:
        """Largest ratio (N,) of a constraint's error to its radius, of residuals (N, m)."""
        worst = np.zeros(len(residuals))
        for c in self.constraints:
            part = residuals[:, c.first : c.end]
            lengths = part[:, 0] if c.one_sided else np.sqrt(np.einsum("ij,ij->i", part, part))
            np.maximum(worst, lengths / c.radius, out=worst)
        return worst


def floor_bounds(goal: StiffnessGoal | None) -> Vector:
    """Logarithms (f,) that the floors of a goal may not fall below, with some margin."""
    values = [floor.value for floor in goal.at_least] if goal is not None else []
    bounds: Vector = np.log(np.array(values)) + DESCENT.floor_margin
    return bounds


def _one(point: ProgramPoint) -> float:
    return 1.0


_total = np.add.reduce
_NONE = np.zeros(0)
_NOTHING = (_NONE, np.zeros((0, 0)), _NONE, np.zeros((0, 0)))
