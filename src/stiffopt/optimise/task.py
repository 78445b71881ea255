"""`Task`: target, stiffness goal, load and limits; the schema of the task file and a class in code.

Everything is in SI: m, rad, Pa, N, N m. Built in code::

    Task(
        target=Target(position=(0, 0, 0.18)),
        stiffness=StiffnessGoal(maximise=StiffnessMeasure(direction=(1, 0, 0))),
    )
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    ValidationInfo,
    model_validator,
)
from pydantic_core import PydanticKnownError

from stiffopt.directions import Frame
from stiffopt.errors import FileError, InputError
from stiffopt.files import SourceFile, line_of, read_file
from stiffopt.model.description import RobotDescription, one_or_list
from stiffopt.model.robot_files import load_description
from stiffopt.model.scene import SceneOrFile
from stiffopt.notebook import ShownInNotebook
from stiffopt.optimise.brace import Brace
from stiffopt.optimise.goal import StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.press import Press
from stiffopt.optimise.target import Target
from stiffopt.schema import BadKeyError, Items, Schema, Vector
from stiffopt.units import Force, Moment, Pressure, read_from_file, within


class Load(Schema):
    """A load at the tip.

    Attributes
    ----------
    force : in N.
    moment : in N m.
    frame : base, it keeps its direction; tip, it follows the tip.
    """

    force: Vector[Annotated[Force, within(1e6, "N")]] = (0.0, 0.0, 0.0)
    moment: Vector[Annotated[Moment, within(1e6, "N*m")]] = (0.0, 0.0, 0.0)
    frame: Frame = "base"


PerChannelLimit = Annotated[
    Annotated[Pressure, Tag("<one>")] | Annotated[Items[Pressure | None], Tag("<list>")],
    Discriminator(one_or_list),
]


class PressureRange(Schema):
    """Limits that tighten the robot's; one for all channels or one per channel.

    Attributes
    ----------
    min, max : in Pa, gauge; None, for all or in the list, for the robot's.
    """

    min: PerChannelLimit | None = None
    max: PerChannelLimit | None = None


def _robot_name(value: Any, info: ValidationInfo) -> Any:
    """Let a path stand for its text; refuse a file that names no robot."""
    if value is None and read_from_file(info):
        raise PydanticKnownError("missing")
    return os.fspath(value) if isinstance(value, Path) else value


class ForRobot(Schema, ShownInNotebook):
    """What tasks and paths have in common: the robot, its load and limits, and what is around it.

    Attributes
    ----------
    robot : name of a built-in robot, or path of a robot file relative to this file.  In code it may
        be left out: the robot is the one that a solver is given.
    load : load at the tip, or None.
    pressure : limits that tighten the robot's.
    scene : what is around the arm, or None.
    source : the file that this was read from, or None.
    """

    robot: Annotated[
        Annotated[str, Field(min_length=1)] | None,
        BeforeValidator(_robot_name),
        Field(validate_default=True),
    ] = None
    load: Load | None = None
    pressure: PressureRange = PressureRange()
    scene: SceneOrFile | None = None
    source: SourceFile = None

    def _conditions(self) -> list[str]:
        """Return in words what makes it harder: load, limits and scene."""
        parts = []
        if self.load is not None:
            parts.append("with a load")
        if self.pressure != type(self.pressure)():
            parts.append("with pressure limits")
        if self.scene is not None:
            parts.append("in a scene")
        return parts

    def resolve_robot(self) -> RobotDescription:
        """Return the robot; a relative path starts at the folder of the file.

        Raises
        ------
        InputError
            There is no such robot, or its file is wrong; or none is named.
        """
        if self.robot is None:
            name = type(self).__name__
            raise InputError(
                f"{name}.robot: the {name.lower()} names no robot; name one, or load it yourself"
            )
        here = self.source
        try:
            return load_description(self.robot, base=None if here is None else here.parent)
        except FileError as error:
            if Path(error.path).exists():
                raise
            raise self.error_at("robot", f"there is no file '{error.path}'") from None
        except InputError as error:
            raise self.error_at("robot", str(error)) from None

    def check_scene(self, description: RobotDescription) -> None:
        """Refuse a scene that makes no sense for a robot.

        Raises
        ------
        InputError
            See `Scene.check_against`.
        """
        if self.scene is not None:
            self.scene.check_against(description, self.source)

    def pressure_bounds(
        self, description: RobotDescription
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the limits that hold: the robot's, tightened by those in `pressure`.

        Parameters
        ----------
        description :
            The robot, with n channels.

        Returns
        -------
        lower, upper : (n,) arrays
            In Pa, with lower <= upper.

        Raises
        ------
        InputError
            A list of the wrong length, or a channel whose range is empty.
        """
        lower = np.array(description.pressure_min)
        upper = np.array(description.pressure_max)
        try:
            for key, value in self.pressure:
                description.check_per_channel(key, value)
        except BadKeyError as error:
            raise self.error_at(f"pressure.{error.loc[0]}", str(error)) from None
        lower = np.fmax(lower, np.array(self.pressure.min, dtype=float))  # None is nan: no limit
        upper = np.fmin(upper, np.array(self.pressure.max, dtype=float))
        for index in np.flatnonzero(lower > upper):
            key = "max" if self.pressure.max is not None else "min"
            raise self.error_at(
                f"pressure.{key}",
                f"leaves {description.channel_name(int(index))} no pressure, as its min is "
                f"{lower[index] * 1e-5:g} bar and its max {upper[index] * 1e-5:g} bar "
                "with the robot's own limits",
            )
        return lower, upper

    def error_at(self, key: str, reason: str) -> InputError:
        """Return the error that blames a key, in the file if this was read from one."""
        if self.source is None:
            return InputError(f"{type(self).__name__}.{key}: {reason}")
        return FileError(self.source, reason, line=line_of(self.source, *key.split(".")), key=key)


class Task(ForRobot):
    """Where an arm's tip should be, and how stiff.

    Attributes
    ----------
    robot : name of a built-in robot, or path of a robot file relative to the task file.  In code it
        may be left out: the robot is the one that the task is given to a solver with.
    target : tip pose.
    stiffness : stiffness goal, or None: the pose with the least pressure.
    load : load at the tip, or None.
    press : what the tip presses with at the target, in place of a load, or None.
    brace : objects of the scene that the arm may lean on to be stiff, or None.
    pressure : limits that tighten the robot's.
    scene : what is around the arm, or None.
    source : the file that the task was read from, or None.
    """

    target: Target
    stiffness: StiffnessGoal | None = None
    press: Press | None = None
    brace: Brace | None = None

    @model_validator(mode="after")
    def _can_lean(self) -> Task:
        if self.brace is not None:
            self.brace.check(self)
        return self

    @model_validator(mode="after")
    def _can_press(self) -> Task:
        press = self.press
        if press is None:
            return self
        if self.load is not None:
            raise BadKeyError("press", "cannot be combined with load; remove one of the two")
        position = self.target.position or (None, None, None)
        needed = [press.frame == "tip" or abs(part) > 1e-9 for part in press.direction]
        if any(axis is None for axis, need in zip(position, needed, strict=True) if need):
            raise BadKeyError(
                "press", "needs a target with a position along its direction, where it begins"
            )
        return self

    @property
    def unbraced(self) -> Task:
        """The same task for an arm that keeps clear of all objects."""
        return self if self.brace is None else self.model_copy(update={"brace": None})

    @property
    def tip_load(self) -> Load | None:
        """The load at the tip in the wanted state: what was given, or the reaction of a press."""
        press = self.press
        if press is None:
            return self.load
        reaction = tuple(-press.force * part for part in press.direction)
        return Load(force=cast("tuple[float, float, float]", reaction), frame=press.frame)

    def __repr__(self) -> str:
        parts = [] if self.robot is None else [self.robot]
        parts.append(repr(self.target))
        if self.stiffness is not None:
            parts.append(repr(self.stiffness))
        if self.press is not None:
            parts.append(repr(self.press))
        if self.brace is not None:
            parts.append(repr(self.brace))
        return f"Task({', '.join([*parts, *self._conditions()])})"

    __str__ = __repr__

    @property
    def measures(self) -> tuple[StiffnessMeasure, ...]:
        """All stiffnesses that are named: maximised, then matched, then floors."""
        goal = self.stiffness
        if goal is None:
            return ()
        named = (*goal.first, *goal.at_least)
        return tuple(cast(StiffnessMeasure, m) for m in named if m.is_stiffness)


def load_task(path: str | os.PathLike[str]) -> Task:
    """Read a task file.

    Raises
    ------
    FileError
        With the line and the key of the first mistake.
    """
    return read_file(path, "task", Task).model_copy(update={"source": Path(path)})
