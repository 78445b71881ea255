"""What is asked of the tip's pose: the part ``target`` of the task."""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, model_validator

from stiffopt.directions import Direction, Quaternion
from stiffopt.schema import BadKeyError, Schema, Vector
from stiffopt.units import Angle, Length, format_quantity, within

__all__ = ["Target", "Tolerance"]


def _coordinate(value: Any) -> Any:
    """Let `free` (None in code) stand for an axis that does not matter."""
    return None if isinstance(value, str) and value.strip() == "free" else value


def _all_free_is_none(position: tuple[float | None, ...] | None) -> tuple[float | None, ...] | None:
    return None if position is None or all(x is None for x in position) else position


def _write_coordinate(value: float | None) -> str:
    return "free" if value is None else format_quantity(value, "m", "mm")


Coordinate = Annotated[
    Annotated[Length, within(1e3, "m")] | None,
    BeforeValidator(_coordinate),
    PlainSerializer(_write_coordinate, return_type=str, when_used="json"),
]


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
