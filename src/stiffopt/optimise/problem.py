"""From a task and an arm to a nonlinear program over the pressures.

Variables are the pressures x (n,) in bar.  The pose is asked for by *balls*: residuals r(x) with
|r| <= radius, which is how tolerances are used and not ignored.  What is sought is the lowest
value of an objective, with some stiffnesses bounded from below.  All stiffnesses enter by their
logarithm, so that a tenth of a newton per metre weighs the same wherever it is a tenth.

The compiled functions depend on the *structure* of a task only (which kinds of stiffness, not
which directions or values), and stay with the robot.
"""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.model.manipulator import Manipulator
from stiffopt.model.shape import Shape
from stiffopt.optimise.goal import MatchValue
from stiffopt.optimise.measures import Measure, measures
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.optimise.terms import Ball, pose_terms

Vector = NDArray[np.float64]

BAR = 1e5
"""Pressure scale of the variables, in Pa."""

FLOOR_MARGIN = 1e-6
"""How far above a stiffness that must be kept the optimiser aims, relatively."""


@dataclass(frozen=True)
class Point:
    """The program at one set of pressures.

    Attributes
    ----------
    x : ndarray (n,)
        Pressures in bar.
    balls : tuple of Ball
    values : ndarray (m,)
        Logarithms of the stiffnesses, or the distance to a matrix; empty where only the pose
        was evaluated.
    gradients : ndarray (m, n)
        Per bar.
    """

    x: Vector
    balls: tuple[Ball, ...]
    values: Vector
    gradients: Vector

    @property
    def constraints(self) -> tuple[Ball, ...]:
        """The balls that are not infinite."""
        return tuple(ball for ball in self.balls if np.isfinite(ball.radius))

    @property
    def reached(self) -> bool:
        """Whether every residual lies within its ball."""
        return all(ball.error <= ball.radius for ball in self.balls)


@dataclass(frozen=True)
class Objective:
    """What is minimised, as a function of a point.

    The value is the largest of `terms` (m,); several terms are minimised together (the smallest
    of several stiffnesses maximised).  `curvature` is a convex guess of the Hessian.
    """

    terms: Callable[[Point], tuple[Vector, Vector]]  # values (m,), gradients (m, n)
    curvature: Callable[[Point], Vector]  # (n, n)
    precision: float  # decrease that no longer matters
    unit: str  # of what a decrease gains, for prices
    gain: Callable[[Point], float]  # that gain per unit of decrease

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
    floors : tuple of (int, float)
        Values that are bounded from below, as (index into `Point.values`, bound).
    """

    def __init__(self, robot: Manipulator, task: Task) -> None:
        self.robot = robot
        self.task = task
        lower, upper = task.pressure_bounds(robot.description)
        self.lower, self.upper = lower / BAR, upper / BAR
        found = measures(task)
        self._parameters = np.concatenate([np.zeros(0), *(each.parameters for each in found)])
        self._pose = robot.evaluator("pose and jacobian", _pose_outputs)
        structure = tuple(each.structure for each in found)
        self._full = robot.evaluator(
            ("values", structure), _value_outputs(found), len(self._parameters)
        )
        self._terms = pose_terms(task.target)
        self.objective = self._objective()
        goal = task.stiffness
        first = len(goal.maximise) + (goal.match is not None) if goal else 0
        self.floors = tuple(
            (first + index, float(np.log(floor.value)) + FLOOR_MARGIN)
            for index, floor in enumerate(goal.at_least if goal else ())
        )
        self.radii: dict[str, float] = {}

    # -- evaluation -------------------------------------------------------------------------

    def restart(self) -> None:
        """Forget the equilibrium of the last evaluation (see `Evaluator`)."""
        self._pose.restart()

    def pose(self, x: Vector) -> Point:
        """The balls alone at pressures x; cheaper than `point`."""
        position, rotation, jacobian = self._pose(x * BAR)
        return self._point(x, position, rotation, jacobian, np.zeros((0, 1)), np.zeros((0, 0)))

    def point(self, x: Vector) -> Point:
        """Everything at pressures x."""
        self._full.restart(self._pose.state)
        outputs = self._full(x * BAR, self._parameters)
        self._pose.restart(self._full.state)
        return self._point(x, *outputs)

    def objective_values(self, xs: Vector) -> Vector:
        """Objective (N,) at many pressures (N, n) of an arm without loads."""
        outputs = self._full.many(xs * BAR, self._parameters)
        points = (self._point(x, *row) for x, *row in zip(xs, *outputs, strict=True))
        return np.array([self.objective.value(point) for point in points])

    def _point(
        self,
        x: Vector,
        position: Vector,
        rotation: Vector,
        jacobian: Vector,
        values: Vector,
        gradients: Vector,
    ) -> Point:
        found = (term.ball(position[:, 0], rotation, jacobian * BAR) for term in self._terms)
        balls = tuple(
            replace(ball, radius=self.radii.get(ball.name, ball.radius)) for ball in found
        )
        return Point(x, balls, values[:, 0], gradients * BAR)

    # -- objectives -------------------------------------------------------------------------

    def _objective(self) -> Objective:
        goal = self.task.stiffness
        if goal is not None and goal.maximise:
            count = len(goal.maximise)
            return Objective(
                lambda point: (-point.values[:count], -point.gradients[:count]),
                lambda point: 0.1 * np.eye(len(point.x)),
                precision=1e-7,
                unit=goal.maximise[0].unit,
                gain=lambda point: float(np.exp(point.values[:count].min())),
            )
        if goal is not None and isinstance(goal.match, MatchValue):
            wanted = float(np.log(goal.match.value))
            return self._and_some_pressure(
                lambda point: (point.values[0] - wanted) ** 2,
                lambda point: 2 * (point.values[0] - wanted) * point.gradients[0],
                lambda point: 2 * np.outer(point.gradients[0], point.gradients[0]),
            )
        if goal is not None and goal.match is not None:
            return self._and_some_pressure(
                lambda point: point.values[0],
                lambda point: point.gradients[0],
                lambda point: 0.1 * np.eye(len(point.x)),
            )
        return self.least_pressure

    def closest(self, name: str) -> Objective:
        """Half the squared error of one ball over a scale: what brings the tip closest."""
        scale = self.robot.length if name == "position" else 1.0

        def ball(point: Point) -> Ball:
            return next(ball for ball in point.balls if ball.name == name)

        def terms(point: Point) -> tuple[Vector, Vector]:
            residual, jacobian = ball(point).residual / scale, ball(point).jacobian / scale
            return np.array([0.5 * residual @ residual]), (residual @ jacobian)[np.newaxis]

        def curvature(point: Point) -> Vector:
            jacobian = ball(point).jacobian / scale
            return jacobian.T @ jacobian

        def gain(point: Point) -> float:
            return scale**2 / max(ball(point).error, 1e-12)

        unit = "m" if name == "position" else "rad"
        return Objective(terms, curvature, precision=1e-10, unit=unit, gain=gain)

    def best_floors(self) -> Objective:
        """The most by which a floor is missed: what brings all floors as close as they come."""
        indices = [index for index, _ in self.floors]
        bounds = np.array([bound for _, bound in self.floors])
        return Objective(
            lambda point: (bounds - point.values[indices], -point.gradients[indices]),
            lambda point: 0.1 * np.eye(len(point.x)),
            precision=1e-7,
            unit="1",
            gain=lambda point: 1.0,
        )

    @property
    def least_pressure(self) -> Objective:
        """Mean square of the pressures, in bar^2: the stiffness-blind choice."""
        n = len(self.lower)
        return Objective(
            lambda point: (
                np.array([point.x @ point.x / n]),
                2 * point.x[np.newaxis] / n,
            ),
            lambda point: 2 * np.eye(n) / n,
            precision=1e-9,
            unit="bar^2",
            gain=lambda point: 1.0,
        )

    def _and_some_pressure(
        self,
        value: Callable[[Point], float],
        gradient: Callable[[Point], Vector],
        curvature: Callable[[Point], Vector],
    ) -> Objective:
        """Match, and of all that match equally well prefer the one with less pressure."""
        share = 1e-7

        def terms(point: Point) -> tuple[Vector, Vector]:
            x = point.x
            return (
                np.array([value(point) + share * (x @ x)]),
                (gradient(point) + 2 * share * x)[np.newaxis],
            )

        return Objective(
            terms,
            lambda point: curvature(point) + 2 * share * np.eye(len(point.x)),
            precision=1e-10,
            unit="1",
            gain=lambda point: 1.0,
        )

    def changed(
        self,
        objective: Objective | None = None,
        floors: tuple[tuple[int, float], ...] | None = None,
        **radii: float,
    ) -> "Problem":
        """The same program with another objective, floors or radii; infinite frees a ball."""
        other = copy(self)
        other.objective = objective or self.objective
        other.floors = self.floors if floors is None else floors
        other.radii = {**self.radii, **radii}
        return other

    def at_target(self, target: Target) -> "Problem":
        """The same program for another target."""
        other = copy(self)
        other.task = self.task.model_copy(update={"target": target})
        other._terms = pose_terms(target)
        return other


def _pose_outputs(tip: Shape, _: Any) -> list[Any]:
    return [tip.position, tip.rotation, tip.jacobian]


def _value_outputs(found: tuple[Measure, ...]) -> Callable[[Shape, Any], list[Any]]:
    """Pose, Jacobian, values and gradients for measures."""

    def outputs(tip: Shape, parameters: Any) -> list[Any]:
        pose = _pose_outputs(tip, parameters)
        if not found:
            return [*pose, ca.DM.zeros(0, 1), ca.DM.zeros(0, 0)]
        ends = np.cumsum([0, *(len(measure.parameters) for measure in found)])
        values = ca.vertcat(
            *(
                measure.value(tip, parameters[int(start) : int(end)])
                for measure, start, end in zip(found, ends[:-1], ends[1:], strict=True)
            )
        )
        return [*pose, values, ca.densify(tip.total_jacobian(values))]

    return outputs
