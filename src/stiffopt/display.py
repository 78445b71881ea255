"""Units in which answers are displayed: in tables, figures and messages.

One choice holds for everything that is displayed, so that a table and its figure agree. It is made
by ``--units`` of the commands, by the environment variable ``STIFFOPT_UNITS``, or in Python by
`choose_units`. It does not affect JSON and the files that stiffopt writes.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from decimal import Decimal
from functools import lru_cache
from math import log10
from typing import Any

from stiffopt.errors import InputError, shown
from stiffopt.units import unit_size

VARIABLE = "STIFFOPT_UNITS"
"""Environment variable with units, in the form of ``--units``."""

FIGURES = "#.4g"
"""Format of a number with four significant figures, zeros at its end included."""

_USUAL = {
    "length": ("m", "mm"),
    "pressure": ("Pa", "bar"),
    "force": ("N", "N"),
    "stiffness": ("N/m", "N/m"),
    "rotational_stiffness": ("N*m/rad", "N*m/rad"),
    "angle": ("rad", "deg"),
}
"""SI unit and default display unit of each dimension."""
_EXAMPLE = "'mm, bar, N/mm'"


@dataclass(frozen=True)
class DisplayUnit:
    """A unit in which numbers are displayed."""

    name: str  # its readable name: ``mm``, ``N mm/rad``
    per_si: float = 1.0  # its number in one SI unit
    # additional decimals of numbers, compared to the default unit, for the same resolution
    more_decimals: int = 0

    def of(self, value: Any) -> Any:
        """Return an SI number or array in this unit."""
        return value * self.per_si

    def to_si(self, value: Any) -> Any:
        """Return a number or array of this unit in SI."""
        return value / self.per_si

    def number(self, value: float, form: str = ".4g") -> str:
        """Return an SI number in this unit as text.

        `form`: its format; decimals, such as ``.3f``, are those in the default unit.
        """
        if form.endswith("f"):
            form = f".{max(0, int(form[1:-1]) + self.more_decimals)}f"
        text = f"{self.of(value):{form}}".removesuffix(".")
        if not text.strip("-0."):
            text = text.removeprefix("-")
        return f"{Decimal(text):f}" if "e+" in text else text

    def text(self, value: float, form: str = ".4g") -> str:
        """Return an SI number in this unit, with the unit; see `number`."""
        return f"{self.number(value, form)} {self.name}"

    def __str__(self) -> str:
        return self.name


PLAIN = DisplayUnit("")
"""For numbers without a unit, or with a unit given elsewhere."""


@dataclass(frozen=True)
class DisplayUnits:
    """The units in which answers are displayed, one for each dimension.

    `length`, `pressure`, `force`, `stiffness`, `rotational_stiffness`, `angle`: by default mm, bar,
    N, N/m, N m/rad and degrees; `stiffness` is the translational one.
    """

    length: DisplayUnit
    pressure: DisplayUnit
    force: DisplayUnit
    stiffness: DisplayUnit
    rotational_stiffness: DisplayUnit
    angle: DisplayUnit

    @classmethod
    def named(cls, text: str = "") -> DisplayUnits:
        """Return the units in a text such as ``mm, bar, N/mm``, and the default ones for the rest.

        Raises `InputError` if a unit is unknown or measures something else, or two measure the
        same.
        """
        return _named(text)

    def of_si(self, unit: str | None) -> DisplayUnit:
        """Return the unit in which values of an SI unit, such as ``N*m/rad``, are displayed.

        Values of other dimensions are displayed in their SI unit.
        """
        for name, (si, _) in _USUAL.items():
            if si == unit:
                return getattr(self, name)
        return DisplayUnit(_readable(unit or ""))


@lru_cache(maxsize=16)
def _named(text: str) -> DisplayUnits:
    chosen: dict[str, str] = {}
    for part in text.split(",") if text.strip() else ():
        name = part.strip()
        dimension = _dimension(name)
        if dimension in chosen:
            raise InputError(
                f"{shown(chosen[dimension])} and {shown(name)} are both units of "
                f"{_readable_dimension(dimension)}; expected one of them"
            )
        chosen[dimension] = name
    return DisplayUnits(**{
        name: _unit(chosen.get(name, usual), si, usual) for name, (si, usual) in _USUAL.items()
    })  # fmt: skip


def _dimension(name: str) -> str:
    for dimension, (si, _) in _USUAL.items():
        if unit_size(name, si) is not None:
            return dimension
    dimensions = [_readable_dimension(each) for each in _USUAL]
    raise InputError(
        f"{shown(name)} is no unit of {', '.join(dimensions[:-1])} or {dimensions[-1]}; expected "
        f"units such as {_EXAMPLE}"
    )


def _unit(name: str, si: str, usual: str) -> DisplayUnit:
    size, usual_size = unit_size(name, si) or Decimal(1), unit_size(usual, si) or Decimal(1)
    return DisplayUnit(_readable(name), float(1 / size), round(log10(float(size / usual_size))))


def _readable(unit: str) -> str:
    return unit.replace("*", " ")


def _readable_dimension(dimension: str) -> str:
    return dimension.replace("_", " ")


_chosen: DisplayUnits | None = None


def choose_units(text: str | None) -> None:
    """Display everything in the units of a text such as ``mm, bar, N/mm``, from now on.

    `text`: dimensions that are not in it keep their default units. None: the units in the
    environment variable ``STIFFOPT_UNITS``. Raises `InputError` if a unit is unknown or measures
    something else, or two measure the same.
    """
    global _chosen
    _chosen = None if text is None else DisplayUnits.named(text)


def display_units() -> DisplayUnits:
    """Return the units in which to display values.

    Raises `InputError` if the environment variable ``STIFFOPT_UNITS`` does not name units.
    """
    if _chosen is not None:
        return _chosen
    try:
        return DisplayUnits.named(os.environ.get(VARIABLE, ""))
    except InputError as error:
        raise InputError(f"{VARIABLE}: {error}") from None
