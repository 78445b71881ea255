"""Normalise or reject directions and rotations that a user gives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator

from stiffopt.errors import InputError
from stiffopt.schema import Vector, items_of
from stiffopt.units import Number


def unit_vector(vector: tuple[float, ...]) -> tuple[float, ...]:
    """Scale a vector to length 1; return it unchanged if it has that length."""
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
    """Scale a quaternion to length 1 with w >= 0; it must nearly have length 1 already."""
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
    """Return a readable name of a unit vector (3,): ``x``, ``-z``, ``(0.6, 0.8, 0)``."""
    for axis, name in enumerate("xyz"):
        if abs(abs(direction[axis]) - 1) < 1e-9:
            return name if direction[axis] > 0 else f"-{name}"
    return f"({', '.join(f'{round(part, 3) + 0.0:g}' for part in direction)})"
