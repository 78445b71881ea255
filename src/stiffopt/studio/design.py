"""What is designed in the studio: a robot and a task, and each way to change them.

A `Design` is immutable: a change returns another one, or raises `InputError` as a file would.
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
"""What a target asks of the tip's direction."""
SchemaT = TypeVar("SchemaT", bound=Schema)

_BENT = 0.4  # of the range of the first channel of each segment, for the task of a bare robot


def _rounded(values: ArrayLike) -> tuple[float, ...]:
    return tuple(np.round(np.asarray(values, dtype=float), 4).tolist())


def changed(schema: SchemaT, **update: Any) -> SchemaT:
    """Return a description with other values, checked as a new one is."""
    given = {name: getattr(schema, name) for name in type(schema).model_fields}  # no cached values
    return type(schema)(**{**given, **update})


@dataclass(frozen=True)
class Design:
    """A robot and a task on it.

    Attributes
    ----------
    description : the robot as it is now.
    task : what is asked of it.
    robot : name or path of the robot that it began with, as a file anywhere names it.
    original : that robot.
    """

    description: RobotDescription
    task: Task
    robot: str
    original: RobotDescription

    @classmethod
    def of_robot(cls, name_or_path: str | os.PathLike[str]) -> Design:
        """A robot with a task that it can do, see `of_description`."""
        return cls.of_description(
            load_description(name_or_path), robot_path(os.fspath(name_or_path), "")
        )

    @classmethod
    def of_description(cls, description: RobotDescription, name: str) -> Design:
        """A robot and its name, with a task: its tip, bent by a few channels, stiff along x."""
        robot = load_robot(description)
        low, high = robot.pressure_min, robot.pressure_max
        pressures, channel = low.copy(), 0
        for segment in description.segments:
            pressures[channel] += _BENT * (high - low)[channel]
            channel += segment.n_channels
        position = robot.tip_pose(np.clip(pressures, low, high))[:3, 3]
        task = Task(
            target=Target(position=tuple(position.round(4).tolist())),
            stiffness=StiffnessGoal(maximise=StiffnessMeasure(direction=(1.0, 0.0, 0.0))),
        )
        return cls(description, task, name, description)

    @classmethod
    def of_task(cls, task: Task) -> Design:
        """A task with the robot that it names."""
        description = task.resolve_robot()
        folder = Path("") if task.source is None else task.source.parent
        return cls(description, task, robot_path(task.robot or "", folder), description)

    @property
    def has_own_robot(self) -> bool:
        """Whether the robot is no longer the one that it began with."""
        return self.description != self.original

    # -- the target -------------------------------------------------------------------------

    @property
    def angular(self) -> Angular:
        """What the target asks of the tip's direction."""
        target = self.task.target
        if target.orientation is not None:
            return "orientation"
        return "any" if target.pointing is None else "pointing"

    @property
    def free(self) -> tuple[bool, bool, bool]:
        """Which axes of the position are free."""
        x, y, z = self.task.target.position or (None, None, None)
        return (x is None, y is None, z is None)

    def with_target(self, **parts: Any) -> Design:
        """Another target: `position`, `pointing`, `orientation` or `tolerance` of it."""
        return self.with_task(target=changed(self.task.target, **parts))

    def at_pose(self, position: ArrayLike, quaternion: ArrayLike) -> Design:
        """The target at a pose (w first) as far as it asks for one: free axes stay free.

        It is rounded to what a hand can place: 0.01 mm, and 1e-4 of a direction.
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
        """Other free axes; one that is no longer free is asked to be where the tip is."""
        old = self.task.target.position or (None, None, None)
        pairs = zip(free, old, np.asarray(tip).tolist(), strict=True)
        position = tuple(
            None if is_free else round(float(at), 5) if was is None else was
            for is_free, was, at in pairs
        )
        return self.with_target(position=None if all(free) else position)

    def with_angular(self, angular: Angular, quaternion: ArrayLike) -> Design:
        """Ask for another part of the tip's direction: as a quaternion (w first) has it."""
        parts: dict[str, Any] = {"pointing": None, "orientation": None}
        rotation = np.asarray(lie.rotation_from_quaternion(np.asarray(quaternion)))
        if angular == "pointing":
            parts["pointing"] = _rounded(rotation[:, 2])
        elif angular == "orientation":
            parts["orientation"] = _rounded(quaternion)
        return self.with_target(**parts)

    def with_tolerance(self, position: float, angle: float) -> Design:
        """Other tolerances, in m and rad."""
        return self.with_target(tolerance=Tolerance(position=position, angle=angle))

    # -- stiffness, loads and limits ----------------------------------------------------------

    @property
    def measure(self) -> StiffnessMeasure | None:
        """The one stiffness along a direction that is maximised, if that is the goal."""
        goal = self.task.stiffness
        if goal is None or len(goal.maximise) != 1 or goal.at_least or goal.match is not None:
            return None
        return goal.maximise[0]

    def with_measure(self, **parts: Any) -> Design:
        """Maximise a stiffness: that of now, with another direction, kind, frame or boundary."""
        given = self.measure or StiffnessMeasure(direction=(1.0, 0.0, 0.0))
        return self.with_task(stiffness=StiffnessGoal(maximise=changed(given, **parts)))

    def with_least_pressure(self) -> Design:
        """Ask for no stiffness, but for the least pressure."""
        return self.with_task(stiffness=None)

    def with_force(self, force: Sequence[float]) -> Design:
        """Another force at the tip, in N, that keeps its frame; none if it is zero."""
        given = self.task.load or Load()
        load = changed(given, force=tuple(map(float, force)))
        return self.with_task(load=load if any((*load.force, *load.moment)) else None)

    def with_highest(self, pressure: float) -> Design:
        """Another limit for all channels, in Pa; the robot's own if it is not below that."""
        highest = max(self.description.pressure_max)
        limit = None if pressure >= highest * (1 - 1e-9) else float(pressure)
        return self.with_task(pressure=PressureRange(min=self.task.pressure.min, max=limit))

    def with_gravity(self, gravity: Sequence[float], tip_mass: float) -> Design:
        """Other gravity, in m/s^2, and another mass at the tip, in kg."""
        description = changed(
            self.description, gravity=tuple(map(float, gravity)), tip_mass=float(tip_mass)
        )
        return replace(self, description=description)

    # -- the scene ----------------------------------------------------------------------------

    @property
    def objects(self) -> tuple[SceneObject, ...]:
        """What is around the arm."""
        return () if self.task.scene is None else self.task.scene.objects

    def with_objects(self, objects: Sequence[SceneObject]) -> Design:
        """Other objects around the arm, or none; refused where they leave it no place."""
        if not objects:
            return self.with_task(scene=None)
        clearance = 0.0 if self.task.scene is None else self.task.scene.clearance
        scene = Scene(clearance=clearance, objects=tuple(objects))
        scene.check_against(self.description)
        return self.with_task(scene=scene)

    def with_clearance(self, clearance: float) -> Design:
        """Another distance, in m, that is kept from all objects."""
        if self.task.scene is None:
            return self
        scene = Scene(clearance=clearance, objects=self.objects)
        scene.check_against(self.description)
        return self.with_task(scene=scene)

    def with_task(self, **parts: Any) -> Design:
        """Other parts of the task."""
        return replace(self, task=changed(self.task, **parts))
