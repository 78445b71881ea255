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

from stiffopt import lie
from stiffopt.model.compliance import directional_stiffness, stiffness_block
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.shape import Shape
from stiffopt.optimise.task import MatchMatrix, MatchValue, StiffnessMeasure, Target, Task

Vector = NDArray[np.float64]

BAR = 1e5
"""Pressure scale of the variables, in Pa."""

FLOOR_MARGIN = 1e-6
"""How far above a stiffness that must be kept the optimiser aims, relatively."""


@dataclass(frozen=True)
class Ball:
    """A residual of the pose that shall not leave a ball.

    Attributes
    ----------
    name : str
        "position" (m) or "angle" (rad).
    residual : ndarray (k,)
    jacobian : ndarray (k, n)
        Per bar.
    radius : float
    """

    name: str
    residual: Vector
    jacobian: Vector
    radius: float

    @property
    def error(self) -> float:
        """Length of the residual."""
        return float(np.linalg.norm(self.residual))


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
        self._measures = _measures(task)
        self._parameters = np.concatenate(
            [np.zeros(0), *(_parameters(measure) for measure in self._measures)]
        )
        self._pose = robot.evaluator("pose and jacobian", _pose_outputs)
        structure = tuple(_structure(measure) for measure in self._measures)
        self._full = robot.evaluator(
            ("values", structure), _value_outputs(structure), len(self._parameters)
        )
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

    def _point(
        self,
        x: Vector,
        position: Vector,
        rotation: Vector,
        jacobian: Vector,
        values: Vector,
        gradients: Vector,
    ) -> Point:
        balls = pose_balls(self.task.target, position[:, 0], rotation, jacobian * BAR)
        balls = tuple(
            replace(ball, radius=self.radii.get(ball.name, ball.radius)) for ball in balls
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

        return Objective(terms, curvature, precision=1e-10)

    def best_floors(self) -> Objective:
        """The most by which a floor is missed: what brings all floors as close as they come."""
        indices = [index for index, _ in self.floors]
        bounds = np.array([bound for _, bound in self.floors])
        return Objective(
            lambda point: (bounds - point.values[indices], -point.gradients[indices]),
            lambda point: 0.1 * np.eye(len(point.x)),
            precision=1e-7,
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
        return other


def pose_balls(
    target: Target, position: Vector, rotation: Vector, jacobian: Vector
) -> tuple[Ball, ...]:
    """Residuals of a tip pose from a target, with their Jacobians.

    Parameters
    ----------
    position, rotation : (3,), (3, 3)
        Pose of the tip in the base frame.
    jacobian : (6, n)
        Body twist of the tip per variable.
    """
    balls = []
    if target.position is not None:
        asked = [axis for axis in range(3) if target.position[axis] is not None]
        wanted = np.array([target.position[axis] for axis in asked], dtype=float)
        balls.append(
            Ball(
                "position",
                position[asked] - wanted,
                (rotation @ jacobian[:3])[asked],
                target.tolerance.position,
            )
        )
    if target.pointing is not None:
        residual, per_turn = _pointing_error(np.array(target.pointing), rotation)
        balls.append(Ball("angle", residual, per_turn @ jacobian[3:], target.tolerance.angle))
    if target.orientation is not None:
        wanted_rotation = lie.rotation_from_quaternion(np.array(target.orientation))
        residual, per_turn = _orientation_error(wanted_rotation, rotation)
        balls.append(Ball("angle", residual, per_turn @ jacobian[3:], target.tolerance.angle))
    return tuple(balls)


def _pointing_error(wanted: Vector, rotation: Vector) -> tuple[Vector, Vector]:
    """Angle between the tip's z axis and a unit vector, as a vector (2,) across the latter.

    Returns it with its derivative (2, 3) by a turn in tip axes.  The axis is unrolled from the
    sphere onto the plane that touches it at the wanted direction, so that distances from there
    are angles.
    """
    across = np.linalg.svd(wanted[np.newaxis])[2][1:]  # (2, 3)
    axis = rotation[:, 2]
    cosine = float(np.clip(wanted @ axis, -1.0, 1.0))
    flat = across @ axis
    sine = float(np.hypot(*flat))
    angle = np.arctan2(sine, cosine)
    if sine > 1e-4:
        factor = angle / sine
        slope = (cosine * factor - 1) / sine**2  # of the factor by the cosine
    elif cosine > 0:
        factor, slope = 1.0 + sine**2 / 6, -1 / 3
    else:  # opposite: every way round is as good
        return np.array([np.pi, 0.0]), across @ _axis_per_turn(rotation)
    per_axis = factor * across + slope * np.outer(flat, wanted)
    return factor * flat, per_axis @ _axis_per_turn(rotation)


def _axis_per_turn(rotation: Vector) -> Vector:
    """Derivative (3, 3) of the tip's z axis by a turn in tip axes."""
    x, y = rotation[:, 0], rotation[:, 1]
    return np.column_stack([-y, x, np.zeros(3)])  # turn x z


def _orientation_error(wanted: Vector, rotation: Vector) -> tuple[Vector, Vector]:
    """Rotation vector (3,) from a wanted orientation, with its derivative by a turn (3, 3)."""
    q = lie.quaternion_from_rotation(wanted.T @ rotation)
    vector = lie.rotation_vector_from_quaternion(q)
    angle_squared = float(vector @ vector)
    first, second, _ = lie.exponential_coefficients(max(angle_squared, 1e-12))
    W = lie.hat(vector)
    # inverse of the right Jacobian of SO(3)
    factor = 1 / 12 if angle_squared < 1e-8 else (1 - first / (2 * second)) / angle_squared
    return vector, np.eye(3) + 0.5 * W + factor * (W @ W)


# -- stiffness values -----------------------------------------------------------------------

Measure = StiffnessMeasure | MatchMatrix


def _measures(task: Task) -> tuple[Measure, ...]:
    """All that is computed of the stiffness: what is sought, then the floors."""
    goal = task.stiffness
    if goal is None:
        return ()
    match = (goal.match,) if goal.match is not None else ()
    return (*goal.maximise, *match, *goal.at_least)


def _structure(measure: Measure) -> tuple[str, ...]:
    if isinstance(measure, MatchMatrix):
        return ("matrix", measure.frame, measure.boundary)
    return (measure.kind, measure.frame, measure.boundary)


def _parameters(measure: Measure) -> Vector:
    if isinstance(measure, MatchMatrix):
        return np.array(measure.matrix).ravel()
    return np.array(measure.direction)


def _pose_outputs(shape: Shape, _: Any) -> list[Any]:
    return [shape.position, shape.rotation, shape.jacobian]


def _value_outputs(structure: tuple[tuple[str, ...], ...]) -> Callable[[Shape, Any], list[Any]]:
    """Pose, Jacobian, values and gradients for a structure of measures."""

    def outputs(shape: Shape, parameters: Any) -> list[Any]:
        values, used = [], 0
        for kind, frame, boundary in structure:
            size = 9 if kind == "matrix" else 3
            own = parameters[used : used + size]
            used += size
            if kind == "matrix":
                values.append(_matrix_distance(shape, own, frame, boundary))
            else:
                values.append(
                    ca.log(
                        directional_stiffness(
                            shape.compliance,
                            shape.rotation,
                            own,
                            frame=frame,  # type: ignore[arg-type]
                            kind=kind,  # type: ignore[arg-type]
                            boundary=boundary,  # type: ignore[arg-type]
                        )
                    )
                )
        pose = _pose_outputs(shape, None)
        if not values:
            return [*pose, ca.DM.zeros(0, 1), ca.DM.zeros(0, 0)]
        column = ca.vertcat(*values)
        return [*pose, column, ca.densify(shape.total_jacobian(column))]

    return outputs


def _matrix_distance(shape: Shape, wanted: Any, frame: str, boundary: str) -> Any:
    """Squared relative Frobenius distance of the translational stiffness from a matrix."""
    K = stiffness_block(shape.compliance, "translation", boundary)  # type: ignore[arg-type]
    if frame == "base":
        K = shape.rotation @ K @ shape.rotation.T
    return ca.sumsqr(ca.vec(K) - wanted) / ca.sumsqr(wanted)
