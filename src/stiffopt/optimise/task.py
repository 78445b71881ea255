"""What is asked of an arm: the schema of the task file and the task in code, in one.

Everything is in SI: m, rad, Pa, N, N m. Built in code::

    Task(
        robot="stiff-flop-2",
        target=Target(position=(0, 0, 0.18)),
        stiffness=StiffnessGoal(maximise=StiffnessMeasure(direction=(1, 0, 0))),
    )
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    PlainSerializer,
    Tag,
    ValidationInfo,
    field_serializer,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticKnownError

from stiffopt.errors import FileError, InputError
from stiffopt.files import BadKeyError, Items, Schema, Vector, items_of, line_of, read_file
from stiffopt.model.description import RobotDescription, load_description, one_or_list
from stiffopt.units import (
    Angle,
    Force,
    Length,
    Moment,
    Number,
    Pressure,
    Ratio,
    finite_number,
    format_quantity,
    parse_quantity,
    read_from_file,
)

__all__ = [
    "AtLeast",
    "Load",
    "MatchMatrix",
    "MatchValue",
    "PressureRange",
    "StiffnessGoal",
    "StiffnessMeasure",
    "Target",
    "Task",
    "Tolerance",
    "load_task",
]

Frame = Literal["base", "tip"]
Kind = Literal["translation", "rotation"]
Boundary = Literal["free", "guided", "clamped"]

_STIFFNESS_UNITS = {"translation": "N/m", "rotation": "N*m/rad"}

MeasureT = TypeVar("MeasureT")


def _unit_vector(vector: tuple[float, ...]) -> tuple[float, ...]:
    """Return a vector at length 1; leave it be if it has that already."""
    largest = max(map(abs, vector))
    if largest == 0:
        raise InputError("is zero; expected a direction such as [1, 0, 0]")
    norm = math.hypot(*vector)
    if abs(norm - 1) < 1e-15:
        return vector
    scaled = [x / largest for x in vector]
    norm = math.hypot(*scaled)
    return tuple(x / norm for x in scaled)


def _unit_quaternion(quaternion: tuple[float, ...]) -> tuple[float, ...]:
    norm = math.hypot(*quaternion)
    if abs(norm - 1) > 1e-3:
        raise InputError(
            f"has norm {norm:.4g}; expected a unit quaternion (w, x, y, z) such as [1, 0, 0, 0]"
        )
    sign = math.copysign(1, quaternion[0]) if quaternion[0] else 1.0
    return tuple(sign * x for x in _unit_vector(quaternion))


def _coordinate(value: Any) -> Any:
    """Let `free` (None in code) stand for an axis that does not matter."""
    return None if isinstance(value, str) and value.strip() == "free" else value


def _all_free_is_none(position: tuple[float | None, ...] | None) -> tuple[float | None, ...] | None:
    return None if position is None or all(x is None for x in position) else position


def _as_items(value: Any, info: ValidationInfo) -> Any:
    """Let one mapping stand for a list of one; refuse an empty list in a file."""
    if isinstance(value, Mapping | StiffnessMeasure):
        return (value,)
    if read_from_file(info) and not value:
        raise InputError("is empty; expected at least one mapping with a direction")
    return value


def _match_kind(value: Any) -> str:
    """Tell a stiffness matrix to match from a value to match."""
    matrix = "matrix" in value if isinstance(value, Mapping) else isinstance(value, MatchMatrix)
    return "<matrix>" if matrix else "<value>"


def _write_coordinate(value: float | None) -> str:
    return "free" if value is None else format_quantity(value, "m", "mm")


Coordinate = Annotated[
    Length | None,
    BeforeValidator(_coordinate),
    PlainSerializer(_write_coordinate, return_type=str, when_used="json"),
]
Direction = Annotated[Vector[Number], AfterValidator(_unit_vector)]
Quaternion = Annotated[
    tuple[Number, Number, Number, Number],
    BeforeValidator(items_of(4)),
    AfterValidator(_unit_quaternion),
]
OneOrMore = Annotated[Items[MeasureT], BeforeValidator(_as_items)]


class Tolerance(Schema):
    """How near is near enough.

    Attributes
    ----------
    position : Euclidean norm over the axes that are not free, in m.
    angle : between the axes (pointing) or of the rotation (orientation), in rad.
    """

    position: Annotated[Length, Field(gt=0)] = 1e-4
    angle: Annotated[Angle, Field(gt=0)] = math.radians(1)


class Target(Schema):
    """The tip pose asked for, in the base frame.

    Attributes
    ----------
    position : x, y, z in m, None for an axis that is free; or None if all are.
    pointing : unit vector along which the tip's z axis shall point, or None.
    orientation : unit quaternion (w, x, y, z) with w >= 0, or None.
    tolerance : how near is near enough.
    """

    position: Annotated[Vector[Coordinate] | None, AfterValidator(_all_free_is_none)] = None
    pointing: Direction | None = None
    orientation: Quaternion | None = None
    tolerance: Tolerance = Tolerance()

    @model_validator(mode="after")
    def _check(self) -> Target:
        if self.pointing is not None and self.orientation is not None:
            raise BadKeyError(
                "orientation", "cannot be combined with pointing; remove one of the two"
            )
        if self.position is None and self.pointing is None and self.orientation is None:
            raise ValueError("asks for nothing; expected a position, pointing or orientation")
        return self


class StiffnessMeasure(Schema):
    """One directional stiffness of the tip.

    Attributes
    ----------
    direction : unit vector of the force or, for a rotation, axis of the moment.
    frame : the axes in which `direction` is given.
    kind : stiffness against translation or rotation.
    boundary : free, the rest of the tip may move; guided, it may not translate (for a rotation:
        not rotate) otherwise; clamped, it may not move otherwise at all.
    """

    direction: Direction
    frame: Frame = "base"
    kind: Kind = "translation"
    boundary: Boundary = "free"

    @property
    def unit(self) -> Literal["N/m", "N*m/rad"]:
        """Unit of the stiffness."""
        return "N/m" if self.kind == "translation" else "N*m/rad"


class _ValuedMeasure(StiffnessMeasure):
    value: Annotated[float, Field(gt=0)]

    @field_validator("value", mode="before")
    @classmethod
    def _read_value(cls, value: Any, info: ValidationInfo) -> float:
        if not isinstance(value, str) and not read_from_file(info):
            return finite_number(value)
        kind = info.data.get("kind", "translation")
        return parse_quantity(value, _STIFFNESS_UNITS[kind], f"stiffness against {kind}")

    @field_serializer("value", when_used="json")
    def _write_value(self, value: float) -> str:
        return format_quantity(value, self.unit)


class AtLeast(_ValuedMeasure):
    """A stiffness that shall not be less than `value` (N/m, for a rotation N m/rad)."""


class MatchValue(_ValuedMeasure):
    """A stiffness that shall be `value` (N/m, for a rotation N m/rad).

    Attributes
    ----------
    tolerance : relative deviation that is near enough.
    """

    tolerance: Annotated[Ratio, Field(gt=0, lt=1)] = 0.01


class MatchMatrix(Schema):
    """A translational stiffness matrix that the tip shall have.

    Attributes
    ----------
    matrix : 3x3, symmetric and positive definite, in N/m whatever unit it was given in.
    unit : N/m.
    frame : the axes in which the matrix is given.
    boundary : guided, rotation is free; clamped, it is held.
    tolerance : relative Frobenius distance that is near enough.
    """

    unit: Literal["N/m"] = "N/m"
    matrix: Vector[Vector[Number]]
    frame: Frame = "base"
    boundary: Literal["guided", "clamped"] = "guided"
    tolerance: Annotated[Ratio, Field(gt=0, lt=1)] = 0.01

    @model_validator(mode="before")
    @classmethod
    def _to_si(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, Mapping):
            return data
        if "value" in data:
            raise BadKeyError("value", "cannot be combined with matrix; remove one of the two")
        unit = data.get("unit")
        if unit is None:
            if read_from_file(info):
                raise ValueError("the key 'unit' is missing; expected a unit such as 'N/m'")
            return data
        try:
            factor = parse_quantity(f"1 {unit}", "N/m", "stiffness")
        except InputError:
            raise BadKeyError(
                "unit", f"'{unit}' is not a unit of stiffness; expected one such as 'N/m'"
            ) from None
        return {**data, "unit": "N/m", "matrix": _scaled(data.get("matrix"), factor)}

    @model_validator(mode="after")
    def _check(self) -> MatchMatrix:
        matrix = np.array(self.matrix)
        if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0):
            raise BadKeyError("matrix", "is not symmetric; a stiffness matrix is")
        if np.linalg.eigvalsh(matrix)[0] <= 0:
            raise BadKeyError("matrix", "is not positive definite; a stable stiffness is")
        return self


class StiffnessGoal(Schema):
    """What is asked of the tip's stiffness.

    Attributes
    ----------
    maximise : the smallest of these is maximised.
    at_least : none of these may be less than its value.
    match : stiffness to have, instead of one to maximise.
    """

    maximise: OneOrMore[StiffnessMeasure] = ()
    at_least: OneOrMore[AtLeast] = ()
    match: (
        Annotated[
            Annotated[MatchValue, Tag("<value>")] | Annotated[MatchMatrix, Tag("<matrix>")],
            Discriminator(_match_kind),
        ]
        | None
    ) = None

    @model_validator(mode="after")
    def _check(self) -> StiffnessGoal:
        if not self.maximise and not self.at_least and self.match is None:
            raise ValueError("asks for nothing; expected maximise, at_least or match")
        if self.maximise and self.match is not None:
            raise BadKeyError("match", "cannot be combined with maximise; remove one of the two")
        if len({measure.kind for measure in self.maximise}) > 1:
            raise BadKeyError(
                "maximise",
                "mixes translation (N/m) and rotation (N*m/rad), whose smallest has no meaning; "
                "ask for one of the kinds with at_least",
            )
        return self


class Load(Schema):
    """A load at the tip.

    Attributes
    ----------
    force : in N.
    moment : in N m.
    frame : base, it keeps its direction; tip, it follows the tip.
    """

    force: Vector[Force] = (0.0, 0.0, 0.0)
    moment: Vector[Moment] = (0.0, 0.0, 0.0)
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


class Task(Schema):
    """What is asked of an arm.

    Attributes
    ----------
    robot : name of a built-in robot, or path of a robot file relative to the task file.
    target : tip pose.
    stiffness : what is asked of the stiffness, or None: the pose with the least pressure.
    load : load at the tip, or None.
    pressure : limits that tighten the robot's.
    source : the file that the task was read from, or None.
    """

    robot: Annotated[
        str,
        BeforeValidator(lambda value: os.fspath(value) if isinstance(value, Path) else value),
        Field(min_length=1),
    ]
    target: Target
    stiffness: StiffnessGoal | None = None
    load: Load | None = None
    pressure: PressureRange = PressureRange()
    source: Annotated[Path | None, Field(exclude=True)] = None

    @field_validator("source", mode="before")
    @classmethod
    def _not_in_a_file(cls, value: Any, info: ValidationInfo) -> Any:
        if read_from_file(info):
            raise PydanticKnownError("extra_forbidden")
        return value

    def resolve_robot(self) -> RobotDescription:
        """Return the robot; a relative path starts at the task file's folder.

        Raises
        ------
        InputError
            There is no such robot, or its file is wrong.
        """
        here = self.source
        try:
            return load_description(self.robot, base=None if here is None else here.parent)
        except FileError as error:
            if Path(error.path).exists():
                raise
            raise self._error("robot", f"there is no file '{error.path}'") from None
        except InputError as error:
            raise self._error("robot", str(error)) from None

    def pressure_bounds(
        self, description: RobotDescription
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the limits that hold for this task: the robot's, tightened by the task's.

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
            raise self._error(f"pressure.{error.loc[0]}", str(error)) from None
        lower = np.fmax(lower, np.array(self.pressure.min, dtype=float))  # None is nan: no limit
        upper = np.fmin(upper, np.array(self.pressure.max, dtype=float))
        for index in np.flatnonzero(lower > upper):
            key = "max" if self.pressure.max is not None else "min"
            raise self._error(
                f"pressure.{key}",
                f"leaves {description.channel_name(int(index))} no pressure, as its min is "
                f"{lower[index] * 1e-5:g} bar and its max {upper[index] * 1e-5:g} bar "
                "with the robot's own limits",
            )
        return lower, upper

    def _error(self, key: str, reason: str) -> InputError:
        """Return the error that blames a key, in the file if the task was read from one."""
        if self.source is None:
            return InputError(f"Task.{key}: {reason}")
        return FileError(self.source, reason, line=line_of(self.source, *key.split(".")), key=key)


def load_task(path: str | os.PathLike[str]) -> Task:
    """Read a task file.

    Raises
    ------
    FileError
        With the line and the key of the first mistake.
    """
    return read_file(path, "task", Task).model_copy(update={"source": Path(path)})


def _scaled(matrix: Any, factor: float) -> Any:
    """Return numbers in nested lists times a factor; leave alone what is no number."""
    if isinstance(matrix, np.ndarray):
        matrix = matrix.tolist()
    if isinstance(matrix, Sequence) and not isinstance(matrix, str):
        return [_scaled(item, factor) for item in matrix]
    if isinstance(matrix, int | float) and not isinstance(matrix, bool) and factor != 1:
        return matrix * factor
    return matrix
