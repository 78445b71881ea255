"""The design that the studio edits: a robot and a task, with every possible change.

A `Design` is immutable: a change returns a new one, or raises `InputError` like an invalid file.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from stiffopt import lie
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import load_robot
from stiffopt.model.robot_files import load_description, robot_path
from stiffopt.model.scene import Scene, SceneObject
from stiffopt.optimise.goal import StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Load, PressureRange, Task
from stiffopt.optimise.term import Tolerance
from stiffopt.schema import Schema

Angular = Literal["any", "pointing", "orientation"]
"""The part of the tip's orientation that a target prescribes."""
SchemaT = TypeVar("SchemaT", bound=Schema)

_BENT = 0.4  # share of the range of each segment's first channel, in the first task of a robot


def _rounded(values: ArrayLike) -> tuple[float, ...]:
    return tuple(np.round(np.asarray(values, dtype=float), 4).tolist())


def changed(schema: SchemaT, **update: Any) -> SchemaT:
    """Return a copy of a description with other values, validated anew."""
    given = {name: getattr(schema, name) for name in type(schema).model_fields}  # no cached values
    return type(schema)(**{**given, **update})


@dataclass(frozen=True)
class Design:
    """A robot and a task on it."""

    description: RobotDescription  # the present robot
    task: Task  # the task on it
    robot: str  # name or absolute path of the original robot
    original: RobotDescription  # the robot before any change

    @classmethod
    def of_robot(cls, name_or_path: str | os.PathLike[str]) -> Design:
        """Return a robot with a first task, see `of_description`."""
        return cls.of_description(
            load_description(name_or_path), robot_path(os.fspath(name_or_path), "")
        )

    @classmethod
    def of_description(cls, description: RobotDescription, name: str) -> Design:
        """Return a robot with a first task: hold its tip where it bends a little, stiff along x."""
        robot = load_robot(description)
        low, high = robot.pressure_min, robot.pressure_max
        pressures, first = low.copy(), [own[0] for own in description.channel_ranges]
        pressures[first] += _BENT * (high - low)[first]
        position = robot.tip_pose(np.clip(pressures, low, high))[:3, 3]
        task = Task(
            target=Target(position=tuple(position.round(4).tolist())),
            stiffness=StiffnessGoal(maximise=StiffnessMeasure(direction=(1.0, 0.0, 0.0))),
        )
        return cls(description, task, name, description)

    @classmethod
    def of_task(cls, task: Task) -> Design:
        """Return a task with the robot that it names."""
        description = task.resolve_robot()
        folder = Path("") if task.source is None else task.source.parent
        return cls(description, task, robot_path(task.robot or "", folder), description)

    @property
    def has_own_robot(self) -> bool:
        """Whether the robot was changed."""
        return self.description != self.original

    # -- the target -------------------------------------------------------------------------

    @property
    def angular(self) -> Angular:
        """The part of the tip's orientation that the target prescribes."""
        target = self.task.target
        if target.orientation is not None:
            return "orientation"
        return "any" if target.pointing is None else "pointing"

    @property
    def free(self) -> tuple[bool, bool, bool]:
        """Whether each axis of the position is free."""
        x, y, z = self.task.target.position or (None, None, None)
        return (x is None, y is None, z is None)

    def with_target(self, **parts: Any) -> Design:
        """Change `position`, `pointing`, `orientation` or `tolerance` of the target."""
        return self.with_task(target=changed(self.task.target, **parts))

    def at_pose(self, position: ArrayLike, quaternion: ArrayLike) -> Design:
        """Move the target to a pose (quaternion w first); free axes stay free.

        It is rounded to 0.01 mm and, in directions, to 1e-4.
        """
        parts: dict[str, Any] = {}
        if not all(self.free):
            pairs = zip(np.asarray(position).tolist(), self.free, strict=True)
            parts["position"] = tuple(None if free else round(float(x), 5) for x, free in pairs)
        if self.angular == "orientation":
            parts["orientation"] = _rounded(quaternion)
        elif self.angular == "pointing":
            rotation = np.asarray(lie.rotation_from_quaternion(np.asarray(quaternion)))
            parts["pointing"] = _rounded(rotation[:, 2])
        return self.with_target(**parts)

    def with_free(self, free: Sequence[bool], tip: ArrayLike) -> Design:
        """Choose the free axes; one that becomes prescribed takes the tip's coordinate."""
        old = self.task.target.position or (None, None, None)
        pairs = zip(free, old, np.asarray(tip).tolist(), strict=True)
        position = tuple(
            None if is_free else round(float(at), 5) if was is None else was
            for is_free, was, at in pairs
        )
        return self.with_target(position=None if all(free) else position)

    def with_angular(self, angular: Angular, quaternion: ArrayLike) -> Design:
        """Prescribe another part of the tip's orientation, taken from a quaternion (w first)."""
        parts: dict[str, Any] = {"pointing": None, "orientation": None}
        rotation = np.asarray(lie.rotation_from_quaternion(np.asarray(quaternion)))
        if angular == "pointing":
            parts["pointing"] = _rounded(rotation[:, 2])
        elif angular == "orientation":
            parts["orientation"] = _rounded(quaternion)
        return self.with_target(**parts)

    def with_tolerance(self, position: float, angle: float) -> Design:
        """Change the tolerances, in m and rad."""
        return self.with_target(tolerance=Tolerance(position=position, angle=angle))

    # -- stiffness, loads and limits ----------------------------------------------------------

    @property
    def measure(self) -> StiffnessMeasure | None:
        """The stiffness that is maximised, if it is the only goal and has a direction."""
        goal = self.task.stiffness
        if goal is None or len(goal.maximise) != 1 or goal.at_least or goal.match is not None:
            return None
        return goal.maximise[0]

    def with_measure(self, **parts: Any) -> Design:
        """Maximise the present stiffness with another direction, kind, frame or boundary."""
        given = self.measure or StiffnessMeasure(direction=(1.0, 0.0, 0.0))
        return self.with_task(stiffness=StiffnessGoal(maximise=changed(given, **parts)))

    def with_least_pressure(self) -> Design:
        """Minimise the pressures instead of maximising a stiffness."""
        return self.with_task(stiffness=None)

    def with_force(self, force: Sequence[float]) -> Design:
        """Change the force at the tip, in N, in its present frame; zero removes it."""
        given = self.task.load or Load()
        load = changed(given, force=tuple(map(float, force)))
        return self.with_task(load=load if any((*load.force, *load.moment)) else None)

    def with_highest(self, pressure: float) -> Design:
        """Change the highest pressure of all channels, in Pa; at most the robot's own."""
        highest = max(self.description.pressure_max)
        limit = None if pressure >= highest * (1 - 1e-9) else float(pressure)
        return self.with_task(pressure=PressureRange(min=self.task.pressure.min, max=limit))

    def with_gravity(self, gravity: Sequence[float], tip_mass: float) -> Design:
        """Change gravity, in m/s^2, and the mass at the tip, in kg."""
        description = changed(
            self.description, gravity=tuple(map(float, gravity)), tip_mass=float(tip_mass)
        )
        return replace(self, description=description)

    # -- the scene ----------------------------------------------------------------------------

    @property
    def objects(self) -> tuple[SceneObject, ...]:
        """The objects around the arm."""
        return () if self.task.scene is None else self.task.scene.objects

    def with_objects(self, objects: Sequence[SceneObject]) -> Design:
        """Change the objects around the arm; raise `InputError` if they leave it no room."""
        if not objects:
            return self.with_task(scene=None)
        clearance = 0.0 if self.task.scene is None else self.task.scene.clearance
        scene = Scene(clearance=clearance, objects=tuple(objects))
        scene.check_against(self.description)
        return self.with_task(scene=scene)

    def with_clearance(self, clearance: float) -> Design:
        """Change the clearance from all objects, in m."""
        if self.task.scene is None:
            return self
        scene = Scene(clearance=clearance, objects=self.objects)
        scene.check_against(self.description)
        return self.with_task(scene=scene)

    def with_task(self, **parts: Any) -> Design:
        """Change parts of the task."""
        return replace(self, task=changed(self.task, **parts))
