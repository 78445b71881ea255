"""From a task and an arm to a nonlinear program over the pressures.

Variables are the pressures x (n,) in bar.  The pose is asked for by *balls*: residuals r(x) with
|r| <= radius, which is how tolerances are used and not ignored.  What is sought is the lowest
value of an objective, with some stiffnesses bounded from below.  The functions behind it belong
to the structure of the task (`stiffopt.optimise.program`) and stay with the robot.
"""

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.arm import Evaluator
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.functions import functions
from stiffopt.optimise.goal import StiffnessGoal
from stiffopt.optimise.program import BAR, Program
from stiffopt.optimise.task import Task
from stiffopt.optimise.terms import Ball

Vector = NDArray[np.float64]

FLOOR_MARGIN = 1e-6
"""How far above a stiffness that must be kept the optimiser aims, relatively."""


class Sphere(NamedTuple):
    """The ball of some rows, first to end - 1, of the residual."""

    name: str
    first: int
    end: int
    radius: float


class Point:
    """The program at one set of pressures.

    Attributes
    ----------
    x : ndarray (n,)
        Pressures in bar.
    residual : ndarray (m,)
        Of all balls, in m or rad.
    jacobian : ndarray (m, n)
        Per bar.
    spheres : tuple of Sphere
        Which rows make which ball.
    errors : tuple of float
        Length of each ball's residual.
    reached : bool
        Whether every residual lies within its ball.
    terms : ndarray (t,)
        Of the task's objective; empty where only the pose was evaluated.
    term_gradients : ndarray (t, n)
        Per bar.
    floors : ndarray (f,)
        Logarithms of the stiffnesses that are bounded from below.
    floor_gradients : ndarray (f, n)
        Per bar.
    """

    __slots__ = (
        "errors", "floor_gradients", "floors", "jacobian", "reached", "residual", "spheres",
        "term_gradients", "terms", "x",
    )  # fmt: skip

    def __init__(
        self,
        x: Vector,
        residual: Vector,
        jacobian: Vector,
        spheres: tuple[Sphere, ...],
        terms: Vector,
        term_gradients: Vector,
        floors: Vector,
        floor_gradients: Vector,
    ) -> None:
        self.x, self.residual, self.jacobian = x, residual, jacobian
        self.spheres = spheres
        values = residual.tolist()
        self.errors = tuple([math.hypot(*values[first:end]) for _, first, end, _ in spheres])
        self.reached = all(
            error <= sphere.radius for error, sphere in zip(self.errors, spheres, strict=True)
        )
        self.terms, self.term_gradients = terms, term_gradients
        self.floors, self.floor_gradients = floors, floor_gradients

    @property
    def balls(self) -> tuple[Ball, ...]:
        """The balls one by one."""
        return tuple(
            Ball(name, self.residual[first:end], self.jacobian[first:end], radius)
            for name, first, end, radius in self.spheres
        )

    @property
    def constraints(self) -> tuple[Ball, ...]:
        """The balls that are not infinite."""
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
    """What is minimised, as a function of a point.

    The value is the largest of `terms` (t,); several terms are minimised together (the smallest
    of several stiffnesses maximised).  `curvature` is a convex guess of the Hessian.  With
    `of_pose` the residuals are all that it needs.
    """

    terms: Callable[[Point], tuple[Vector, Vector]]  # values (t,), gradients (t, n)
    curvature: Callable[[Point], Vector]  # (n, n)
    precision: float  # decrease that no longer matters
    unit: str  # of what a decrease gains, for prices
    gain: Callable[[Point], float]  # that gain per unit of decrease
    of_pose: bool = False

    def value(self, point: Point) -> float:
        """Value at a point."""
        return float(self.terms(point)[0].max())


class Problem:
    """The nonlinear program of one task on one arm (which carries the task's load).

    Attributes
    ----------
    lower, upper : ndarray (n,)
        Bounds of the variables, in bar.
    objective : Objective
    floors : ndarray (f,)
        What `Point.floors` may not fall below; empty where they do not matter.
    radii : dict of str to float
        Radii of balls, by name, other than the target's.
    """

    def __init__(self, robot: Manipulator, task: Task) -> None:
        self.robot = robot
        self.task = task
        lower, upper = task.pressure_bounds(robot.description)
        self.lower, self.upper = lower / BAR, upper / BAR
        self.radii: dict[str, float] = {}
        self._set_program(Program.of(task.target, task.stiffness))
        self.objective = self._objective()
        self.floors = floor_bounds(task.stiffness)

    def _set_program(self, program: Program) -> None:
        self.program = program
        self.parameters = self.robot.parameters(program.parameters)
        self._functions = functions(self.robot, program)
        self._is_loaded = self.robot.is_loaded
        self._pose = Evaluator(self.robot, self._functions.pose)
        self._full = Evaluator(self.robot, self._functions.point)
        self._set_spheres()

    def _set_spheres(self) -> None:
        spheres, first = [], 0
        for term in self.program.terms:
            end = first + term.size
            spheres.append(Sphere(term.name, first, end, self.radii.get(term.name, term.radius)))
            first = end
        self.spheres = tuple(spheres)
        self.bounding = Bounding(self.spheres, self.robot.length)

    # -- evaluation -------------------------------------------------------------------------

    def restart(self) -> None:
        """Forget the equilibrium of the last evaluation (see `Evaluator`)."""
        self._pose.restart()

    def pose(self, x: Vector) -> Point:
        """The balls alone at pressures x; cheaper than `point`."""
        if self._is_loaded:
            residual, jacobian = self._pose(x * BAR, self.parameters)
        else:
            residual, jacobian = self._functions.pose(x * BAR, self.parameters)
        return Point(x, residual[:, 0], jacobian.T * BAR, self.spheres, *_NOTHING)

    def poses(self, x: Vector) -> tuple[Vector, Vector]:
        """Residuals (N, m) and Jacobians (N, m, n) at pressures (N, n) of an arm without loads."""
        residuals, jacobians = self._functions.pose.many(x * BAR, self.parameters, threads=1)
        return residuals[:, :, 0], jacobians.swapaxes(1, 2) * BAR

    def point(self, x: Vector) -> Point:
        """Everything at pressures x."""
        if self._is_loaded:
            self._full.restart(self._pose.state)
            outputs = self._full(x * BAR, self.parameters)
            self._pose.restart(self._full.state)
        else:
            outputs = self._functions.point(x * BAR, self.parameters)
        residual, jacobian, terms, term_gradients, floors, floor_gradients = outputs
        return Point(
            x,
            residual[:, 0],
            jacobian.T * BAR,
            self.spheres,
            terms[:, 0],
            term_gradients.T * BAR,
            floors[:, 0] if floors.size else _NONE,
            floor_gradients.reshape(len(x), -1).T * BAR,
        )

    def needed(self, x: Vector) -> Point:
        """As much as objective and floors take at pressures x."""
        of_pose = self.objective.of_pose and not len(self.floors)
        return self.pose(x) if of_pose else self.point(x)

    def worth(self, x: Vector) -> Point:
        """Enough of a point at pressures x that reach the pose to rank it by its objective."""
        worth = self._functions.worth
        if self.objective.of_pose or worth is None:
            return self.needed(x)
        terms, floors = worth(x * BAR, self.parameters)
        at_target = np.zeros(self.spheres[-1].end)
        none = np.zeros((0, len(x)))
        floors = floors[:, 0] if floors.size else _NONE
        return Point(x, at_target, none, self.spheres, terms[:, 0], none, floors, none)

    def judged(self, pressures: Vector) -> tuple[list[float], Vector, Vector, list[float]]:
        """What `Judgement.of` takes, at pressures (n,) in Pa of an arm without loads."""
        residuals, pose, compliance, values = self._functions.judge(pressures, self.parameters)
        return residuals.ravel().tolist(), pose.T, compliance.T, values.ravel().tolist()

    # -- objectives -------------------------------------------------------------------------

    def _objective(self) -> Objective:
        n = len(self.lower)
        program, goal = self.program, self.task.stiffness
        unit = "bar^2" if program.aim == "least pressure" else "1"
        gain: Callable[[Point], float] = lambda point: 1.0  # noqa: E731
        if program.aim == "maximise" and goal is not None:
            unit = goal.maximise[0].unit
            gain = lambda point: float(np.exp(-point.terms.max()))  # noqa: E731
        return Objective(
            lambda point: (point.terms, point.term_gradients),
            lambda point: program.steepness * np.eye(n),
            precision=program.precision,
            unit=unit,
            gain=gain,
        )

    def closest(self, name: str) -> Objective:
        """Half the squared error of one ball over a scale: what brings the tip closest."""
        scale = self.robot.length if name == "position" else 1.0

        (rows,) = [slice(first, end) for which, first, end, _ in self.spheres if which == name]

        def terms(point: Point) -> tuple[Vector, Vector]:
            residual, jacobian = point.residual[rows] / scale, point.jacobian[rows] / scale
            return np.array([0.5 * residual.dot(residual)]), (residual @ jacobian)[np.newaxis]

        def curvature(point: Point) -> Vector:
            jacobian = point.jacobian[rows] / scale
            return jacobian.T @ jacobian

        def gain(point: Point) -> float:
            return scale**2 / max(math.hypot(*point.residual[rows].tolist()), 1e-12)

        unit = "m" if name == "position" else "rad"
        return Objective(terms, curvature, precision=1e-10, unit=unit, gain=gain, of_pose=True)

    def best_floors(self) -> Objective:
        """The most by which a floor is missed: what brings all floors as close as they come."""
        return Objective(
            lambda point: (self.floors - point.floors, -point.floor_gradients),
            lambda point: self.program.steepness * np.eye(len(point.x)),
            precision=1e-7,
            unit="1",
            gain=lambda point: 1.0,
        )

    # -- similar programs -------------------------------------------------------------------

    def changed(self, objective: Objective, floors: bool = True, **radii: float) -> "Problem":
        """The same program with another objective, without floors, or with other radii.

        An infinite radius frees a ball.
        """
        other = copy(self)
        other.objective = objective
        if not floors:
            other.floors = np.zeros(0)
        other.radii = {**self.radii, **radii}
        other._set_spheres()
        return other


class Bounding:
    """What the steps of local searches take from the balls that are not infinite.

    Attributes
    ----------
    spheres : tuple of Sphere
        Rows are counted within `rows`.
    indices : tuple of int
        Which of all balls they are.
    rows : slice
        Their rows of the residual.
    radius, scale : ndarray (m,)
        Radius of each row's ball; what its residual is compared with while the pose is far.
    """

    def __init__(self, spheres: tuple[Sphere, ...], length: float) -> None:
        kept = [(i, sphere) for i, sphere in enumerate(spheres) if sphere.radius < math.inf]
        begin = kept[0][1].first if kept else 0
        self.indices = tuple(i for i, _ in kept)
        self.spheres = tuple(
            sphere._replace(first=sphere.first - begin, end=sphere.end - begin)
            for _, sphere in kept
        )
        self.rows = slice(begin, kept[-1][1].end if kept else 0)
        self.radius = np.ones(self.rows.stop - begin)
        self.scale = np.ones(self.rows.stop - begin)
        for name, first, end, radius in self.spheres:
            self.radius[first:end] = radius
            self.scale[first:end] = length if name == "position" else 1.0

    @cached_property
    def far_damping(self) -> Vector:
        """Squared scales (m, m), on the diagonal."""
        return np.diag(self.scale**2)

    @cached_property
    def near_damping(self) -> Vector:
        """Squared radii (m, m), on the diagonal."""
        return np.diag(self.radius**2)

    def errors(self, residuals: Vector) -> Vector:
        """Largest ratio (N,) of a residual's length to its ball's radius, of (N, m)."""
        worst = np.zeros(len(residuals))
        for _, first, end, radius in self.spheres:
            part = residuals[:, first:end]
            np.maximum(worst, np.sqrt(np.einsum("ij,ij->i", part, part)) / radius, out=worst)
        return worst


def floor_bounds(goal: StiffnessGoal | None) -> Vector:
    """Logarithms (f,) that the floors of a goal may not fall below, with some margin."""
    values = [floor.value for floor in goal.at_least] if goal is not None else []
    bounds: Vector = np.log(np.array(values)) + FLOOR_MARGIN
    return bounds


_total = np.add.reduce
_NONE = np.zeros(0)
_NOTHING = (_NONE, np.zeros((0, 0)), _NONE, np.zeros((0, 0)))
