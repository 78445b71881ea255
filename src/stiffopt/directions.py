"""Directions and rotations as a user gives them: brought to length 1, or refused."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator

from stiffopt.errors import InputError
from stiffopt.schema import Vector, items_of
from stiffopt.units import Number


def unit_vector(vector: tuple[float, ...]) -> tuple[float, ...]:
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


def unit_quaternion(quaternion: tuple[float, ...]) -> tuple[float, ...]:
    """Return a quaternion at length 1 with w >= 0; it must be nearly one already."""
    norm = math.hypot(*quaternion)
    if abs(norm - 1) > 1e-3:
        raise InputError(
            f"has norm {norm:.4g}; expected a unit quaternion (w, x, y, z) such as [1, 0, 0, 0]"
        )
    sign = math.copysign(1, quaternion[0]) if quaternion[0] else 1.0
    return tuple(sign * x for x in unit_vector(quaternion))


Frame = Literal["base", "tip"]
"""The axes in which a vector is given."""
Direction = Annotated[Vector[Number], AfterValidator(unit_vector)]
"""A unit vector."""
Quaternion = Annotated[
    tuple[Number, Number, Number, Number],
    BeforeValidator(items_of(4)),
    AfterValidator(unit_quaternion),
]
"""A unit quaternion (w, x, y, z) with w >= 0."""


def direction_name(direction: Sequence[float]) -> str:
    """Return the name of a unit vector (3,) for people: ``x``, ``-z``, ``(0.6, 0.8, 0)``."""
    for axis, name in enumerate("xyz"):
        if abs(abs(direction[axis]) - 1) < 1e-9:
            return name if direction[axis] > 0 else f"-{name}"
    return f"({', '.join(f'{round(part, 3) + 0.0:g}' for part in direction)})"
