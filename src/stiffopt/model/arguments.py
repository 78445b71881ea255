"""Checking of what callers of the model pass in."""

from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import InputError
from stiffopt.model.compliance import Boundary, Frame, Kind
from stiffopt.model.numeric import checked_vector, length_and_unit
from stiffopt.model.screws import Wrench

Vector = NDArray[np.float64]


class DirectionalMeasure(NamedTuple):
    """A directional stiffness that was checked; `direction` is of unit length."""

    direction: tuple[float, ...]
    kind: Kind
    boundary: Boundary
    frame: Frame


def checked_measure(
    direction: ArrayLike, kind: Kind, boundary: Boundary, frame: Frame
) -> DirectionalMeasure:
    """Directional stiffness from arguments; the direction need not be of unit length."""
    vector = checked_vector("direction", direction)
    if not vector.any():
        raise InputError("direction must not be zero")
    check_choice("kind", kind, get_args(Kind))
    check_choice("boundary", boundary, get_args(Boundary))
    check_choice("frame", frame, get_args(Frame))
    return DirectionalMeasure(tuple(length_and_unit(vector)[1].tolist()), kind, boundary, frame)


def check_choice(name: str, value: object, choices: tuple[str, ...]) -> None:
    """Raise unless a value is one of the choices."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"unknown {name} {value!r}; choose one of {', '.join(choices)}")


def checked_wrench(value: "ArrayLike | Wrench") -> Vector:
    """Coordinates (6,) of a wrench, force first."""
    return checked_vector("wrench", value.coordinates if isinstance(value, Wrench) else value, 6)


def dead_and_follower(wrench: Vector, frame: Frame) -> Vector:
    """Wrench (6,) as `Loads` has it (12,): dead where its frame is the base, else follower."""
    check_choice("frame", frame, get_args(Frame))
    none = np.zeros(6)
    return np.concatenate([wrench, none] if frame == "base" else [none, wrench])
