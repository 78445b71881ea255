"""Check arguments of the model's functions; normalise vectors without over- or underflow."""

import operator
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.model.compliance import Boundary, Frame, Kind


class DirectionalMeasure(NamedTuple):
    """A checked directional stiffness; `direction` is of unit length."""

    direction: tuple[float, ...]
    kind: Kind
    boundary: Boundary
    frame: Frame


def checked_measure(
    direction: ArrayLike, kind: Kind, boundary: Boundary, frame: Frame
) -> DirectionalMeasure:
    """Return a checked directional stiffness; the direction need not be of unit length."""
    vector = checked_vector("direction", direction)
    if not vector.any():
        raise InputError("direction must not be zero")
    check_choice("kind", kind, get_args(Kind))
    check_choice("boundary", boundary, get_args(Boundary))
    check_choice("frame", frame, get_args(Frame))
    return DirectionalMeasure(tuple(length_and_unit(vector)[1].tolist()), kind, boundary, frame)


def check_choice(name: str, value: object, choices: tuple[str, ...]) -> None:
    """Raise `InputError` unless a value is one of the choices."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"unknown {name} {value!r}; choose one of {', '.join(choices)}")


def real_numbers(value: ArrayLike) -> Array:
    """Return an array of real numbers; reject text, booleans and complex numbers.

    Raises `ValueError` if there is anything but real numbers, or rows differ in length.
    """
    numbers = np.asarray(value)
    if numbers.dtype.kind not in "iuf":
        raise ValueError(f"expected real numbers, not {numbers.dtype}")
    return numbers.astype(float)


def checked_number(name: str, value: ArrayLike) -> float:
    """Return an argument as a finite number."""
    try:
        number = real_numbers(value)
    except ValueError as error:
        raise InputError(f"{name} must be a number; got {value!r}") from error
    if number.ndim != 0 or not np.isfinite(number):
        raise InputError(f"{name} must be a finite number; got {value!r}")
    return float(number)


def checked_integer(name: str, value: Any, least: int) -> int:
    """Return an argument as an integer, Python's or NumPy's, of at least `least`."""
    try:
        number = None if isinstance(value, bool | np.bool_) else operator.index(value)
    except TypeError:
        number = None
    if number is None or number < least:
        raise InputError(f"{name} must be an integer of at least {least}; got {value!r}")
    return number


def checked_vector(name: str, value: ArrayLike, size: int = 3) -> Array:
    """Return an argument as a finite vector (size,)."""
    try:
        vector = real_numbers(value)
    except ValueError as error:
        raise InputError(f"{name} must be {size} numbers; got {value!r}") from error
    if vector.shape != (size,) or not np.isfinite(vector).all():
        raise InputError(f"{name} must be {size} finite numbers; got {value!r}")
    return vector


def checked_motion(name: str, value: ArrayLike) -> Array:
    """Return an argument as a rigid motion (4, 4)."""
    problem = f"{name} must be a rigid motion (4, 4), a rotation and a position over 0 0 0 1"
    try:
        T = real_numbers(value)
    except ValueError as error:
        raise InputError(f"{problem}; got {value!r}") from error
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"{problem}; got {value!r}")
    R = T[:3, :3]
    if np.abs(R).max() < 2 and np.linalg.det(R) > 0:
        off = np.abs(R.T @ R - np.eye(3)).max() + np.abs(T[3] - (0, 0, 0, 1)).max()
        if off < 1e-3:
            return T
    raise InputError(f"{problem}; got {value!r}")


def length_and_unit(vector: Array) -> tuple[float, Array]:
    """Return the length of a vector and the unit vector along it; zero for zero."""
    largest = float(np.abs(vector).max())
    if largest == 0:
        return 0.0, np.zeros_like(vector)
    scaled = vector / largest
    length = float(np.linalg.norm(scaled))
    return largest * length, scaled / length
