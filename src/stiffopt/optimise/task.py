"""`Task`: target, stiffness goal, load and limits.  It is also the schema of the task file.

All values are in SI: m, rad, Pa, N, N m.  In code::

    Task(
        target=Target(position=(0, 0, 0.18)),
        stiffness=StiffnessGoal(maximise=StiffnessMeasure(direction=(1, 0, 0))),
    )
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import numpy as np
from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticKnownError

from stiffopt.arrays import Array
from stiffopt.directions import Frame
from stiffopt.errors import FileError, InputError, dotted
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

if TYPE_CHECKING:
    from stiffopt.model.manipulator import Manipulator


class Load(Schema):
    """A load at the tip.

    Attributes
    ----------
    force : in N.
    moment : in N m.
    frame : "base": the load keeps its direction; "tip": it follows the tip.
    """

    force: Vector[Annotated[Force, within(1e6, "N")]] = (0.0, 0.0, 0.0)
    moment: Vector[Annotated[Moment, within(1e6, "N*m")]] = (0.0, 0.0, 0.0)
    frame: Frame = "base"


PerChannelLimit = Annotated[
    Annotated[Pressure, Tag("<one>")] | Annotated[Items[Pressure | None], Tag("<list>")],
    Discriminator(one_or_list),
]


class PressureRange(Schema):
    """Pressure limits that tighten the robot's: one for all channels, or one per channel.

    Attributes
    ----------
    min, max : in Pa, gauge; None (for all channels or in a list) leaves the robot's limit.
    """

    min: PerChannelLimit | None = None
    max: PerChannelLimit | None = None


def _robot_name(value: Any, info: ValidationInfo) -> Any:
    """Convert a `Path` to text; reject a file without a robot."""
    if value is None and read_from_file(info):
        raise PydanticKnownError("missing")
    return os.fspath(value) if isinstance(value, Path) else value


class ForRobot(Schema, ShownInNotebook):
    """Base of tasks and paths: the robot, its load, its pressure limits and its surroundings.

    Attributes
    ----------
    robot : name of a built-in robot, or path of a robot file relative to this file.  In code it may
        be None: the solver's robot is used then.
    load : load at the tip, or None.
    pressure : limits that tighten the robot's.
    scene : objects around the arm, or None.
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
        """Describe the load, limits and scene, for `repr`."""
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

        Raises `InputError`: no robot is named, it does not exist, or its file is wrong.
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
        """Reject a scene that does not suit a robot.

        Raises `InputError`: see `Scene.check_against`.
        """
        if self.scene is not None:
            self.scene.check_against(description, self.source)

    def pressure_bounds(self, description: RobotDescription) -> tuple[Array, Array]:
        """Return the pressure limits of each channel: the robot's, tightened by `pressure`.

        `description`: the robot, with n channels. Raises `InputError`: a list of the wrong length,
        or a channel whose range is empty.

        Returns
        -------
        lower, upper : (n,) arrays
            In Pa, with lower <= upper.
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
        """Return an error about a key, with file and line if this was read from a file."""
        place = [int(step) if step.isdigit() else step for step in key.split(".")]
        key = dotted(place)
        if self.source is None:
            return InputError(f"{type(self).__name__}.{key}: {reason}")
        return FileError(self.source, reason, line=line_of(self.source, *place), key=key)


class Task(ForRobot):
    """Where the arm's tip should be, and how stiff.

    Attributes
    ----------
    robot : name of a built-in robot, or path of a robot file relative to the task file.  In code it
        may be None: the solver's robot is used then.
    target : conditions on the tip pose.
    stiffness : stiffness goal.  None: the pose with the least pressure.
    load : load at the tip, or None.
    press : force with which the tip presses at the target, instead of a load, or None.
    brace : objects of the scene that the arm may lean on to be stiffer, or None.
    pressure : limits that tighten the robot's.
    scene : objects around the arm, or None.
    source : the file that the task was read from, or None.
    """

    target: Target
    stiffness: StiffnessGoal | None = None
    press: Press | None = None
    brace: Brace | None = None

    @field_validator("brace")
    @classmethod
    def _on_objects(cls, brace: Brace | None, info: ValidationInfo) -> Brace | None:
        """Check the names whatever is wrong elsewhere, unless it is the scene."""
        scene = info.data.get("scene")
        if brace is not None and scene is not None:
            brace.check_objects(scene)
        return brace

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
        """The same task without its brace: the arm keeps clear of all objects."""
        return self if self.brace is None else self.model_copy(update={"brace": None})

    @property
    def tip_load(self) -> Load | None:
        """The load at the tip in the wanted state: the given one, or the reaction to a press."""
        press = self.press
        if press is None:
            return self.load
        reaction = tuple(-press.force * part for part in press.direction)
        return Load(force=cast("tuple[float, float, float]", reaction), frame=press.frame)

    def loaded(self, robot: Manipulator) -> Manipulator:
        """Return an arm with that load."""
        load = self.tip_load
        return robot.with_load(load.force, load.moment, load.frame) if load else robot

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
        """All stiffness measures of the task: maximised ones, then the matched one, then floors."""
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
