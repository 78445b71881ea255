"""Read the values of options: quantities with units, lists of them, directions, channels.

Each function raises `InputError`, which names the option, if it cannot read the text.
"""

import math
import re

from stiffopt.errors import InputError, shown
from stiffopt.units import parse_quantity

_LIST = re.compile(r"\s*([-+0-9.,:eE\s]*[0-9.])\s*([A-Za-z].*?)\s*")
_NUMBER = re.compile(r"[-+0-9.eE]+")
_LAST_UNIT = re.compile(r"[-+0-9.eE]+\s*([A-Za-z].*)")
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_MAX_VALUES = 1000  # of a range


def quantity(option: str, text: str, unit: str, what: str) -> float:
    """Return one quantity in SI."""
    try:
        return parse_quantity(text, unit, what)
    except InputError as error:
        raise InputError(f"{option}: {error}") from None


def choice(option: str, text: str, allowed: tuple[str, ...]) -> None:
    """Raise `InputError` if a word is not one of those that an option allows."""
    if text not in allowed:
        raise InputError(f"{option}: expected {' or '.join(allowed)}, not {shown(text)}")


def pressures(option: str, text: str) -> tuple[float, ...]:
    """Return pressures in Pa from ``0.4,0.8,1.0 bar`` or, with both ends, ``0:1.5:0.25 bar``."""
    example = "expected pressures such as '0.4,0.8,1.0 bar' or '0:1.5:0.25 bar'"
    found = _LIST.fullmatch(text)
    if found is None:
        raise InputError(f"{option}: {shown(text)} is no list of pressures; {example}")
    numbers, unit = found.groups()
    separator = ":" if ":" in numbers else ","
    parts = [
        quantity(option, f"{part.strip()} {unit}", "Pa", "pressure")
        for part in numbers.split(separator)
    ]
    if separator == ",":
        if len(set(parts)) < len(parts):
            raise InputError(f"{option}: a pressure is given twice")
        return tuple(parts)
    if len(parts) != 3:
        raise InputError(f"{option}: a range has a start, an end and a step; {example}")
    start, end, step = parts
    if step <= 0 or end < start:
        raise InputError(f"{option}: a range goes up, in steps above 0; {example}")
    count = int((end - start) / step * (1 + 1e-9)) + 1
    if count > _MAX_VALUES:
        raise InputError(
            f"{option}: these are {count} pressures; at most {_MAX_VALUES} are allowed"
        )
    return tuple(round(start + step * k, 6) for k in range(count))


def listed(option: str, text: str, unit: str, what: str) -> tuple[float, ...]:
    """Return quantities in SI from ``0.2 bar, 0 bar, 30 kPa`` or ``0.2, 0, 0.3 bar``."""
    parts = [part.strip() for part in text.split(",")]
    last = _LAST_UNIT.fullmatch(parts[-1])
    if last is not None and all(_NUMBER.fullmatch(part) for part in parts[:-1]):
        parts[:-1] = [f"{part} {last[1]}" for part in parts[:-1]]
    return tuple(quantity(option, part, unit, what) for part in parts)


def view(text: str | None) -> tuple[float, ...] | None:
    """Return the elevation and the azimuth in rad of ``--view '20 deg, -60 deg'``, if it is given.

    Raises `InputError`: the text is not two angles, or the elevation exceeds 90 deg.
    """
    if text is None:
        return None
    angles = listed("--view", text, "rad", "angle")
    if len(angles) != 2 or abs(angles[0]) > math.pi / 2:
        raise InputError(
            "--view: expected an elevation of at most 90 deg and an azimuth, such as "
            f"'20 deg, -60 deg'; got {shown(text)}"
        )
    return angles


def directions(option: str, text: str) -> tuple[tuple[float, ...], ...]:
    """Return unit vectors from names such as ``x,y,-z``."""
    found = []
    for part in text.split(","):
        name = part.strip()
        vector = _AXES.get(name.removeprefix("-").removeprefix("+"))
        if vector is None:
            raise InputError(
                f"{option}: {shown(name)} is no direction; expected some of x, y, z, -x, -y, -z"
            )
        sign = -1.0 if name.startswith("-") else 1.0
        found.append(tuple(sign * component + 0.0 for component in vector))
    if len(set(found)) < len(found):
        raise InputError(f"{option}: a direction is given twice")
    return tuple(found)


def direction(option: str, text: str) -> tuple[float, ...]:
    """Return a vector from ``x``, ``y``, ``z`` or three numbers such as ``0,0.6,0.8``."""
    if text.strip() in _AXES:
        return _AXES[text.strip()]
    try:
        parts = tuple(float(part) for part in text.split(","))
    except ValueError:
        parts = ()
    if len(parts) != 3:
        raise InputError(
            f"{option}: {shown(text)} is no direction; expected x, y, z or three numbers "
            "such as 0,0.6,0.8"
        )
    return parts


def channels(option: str, text: str) -> tuple[int, ...]:
    """Return channel numbers, counted from 1, from ``1,2``."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise InputError(f"{option}: {shown(text)} are no channels; expected numbers such as 1,2")
    found = tuple(int(part) for part in parts)
    if len(set(found)) < len(found):
        raise InputError(f"{option}: a channel is given twice")
    return found
