"""Quantities: text with a unit in files, floats in SI in code.

A quantity in a file is a string, a decimal number and its unit: ``90 mm``. This module gets exact
decimal factors from pint, so that ``90 mm`` is the float ``0.09``. It rejects two things that pint
accepts: an angle without a unit (the radian counts as a dimension here) and
a moment in joules. The field types at the end apply these rules in pydantic models.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal, DecimalException
from functools import cache, lru_cache
from numbers import Real
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo
from pydantic_core import core_schema

from stiffopt.errors import InputError, shown

if TYPE_CHECKING:
    import pint

FROM_FILE = {"from_file": True}
"""Pydantic validation context of data from a file, in which quantities must have units."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,4})?")
_QUANTITY = r"^ *[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,4})? *[A-Za-zµμ°%(].*$"
_UNIT = re.compile(r"(?=[A-Za-zµμ°%(])(?:[A-Za-zµμ°%²³·*/^() ]|-?[0-9](?![0-9]))+")
_TOKEN = re.compile(
    r"""\ *(?:
        (?P<power> (?:\^|\*\*)\ *(?:-?[0-9]|\(\ *-?[0-9]\ *\))(?![A-Za-z0-9]) | [²³] )
        | (?P<factor> [A-Za-zµμ°%][A-Za-zµμ°%0-9]* | 1(?![A-Za-z0-9]) )
        | (?P<open> \( ) | (?P<close> \) ) | (?P<operator> [*/·] )
    )\ *""",
    re.VERBOSE,
)
_POWER_WORD = re.compile(r"\b(?:sq|squared?|cubic|cubed)\b")  # exponents to pint
_LONGEST = 80  # characters; longer than any quantity that a person writes
_MAX_FACTORS, _MAX_DEPTH = 10, 2  # of a unit: factors, and nested parentheses


@dataclass(frozen=True)
class QuantityKind:
    """A kind of quantity: its SI unit, name, example, and unit in files.

    It is part of the types below, so that the unit of a field can be found from its type.
    """

    unit: str
    what: str
    example: str
    written: str

    def __get_pydantic_core_schema__(self, *_: Any) -> core_schema.CoreSchema:
        """Return how such a quantity is read, and written by ``model_dump(mode="json")``."""
        return core_schema.with_info_before_validator_function(
            self._read,
            core_schema.float_schema(allow_inf_nan=False),
            serialization=core_schema.plain_serializer_function_ser_schema(
                self._write, return_schema=core_schema.str_schema(), when_used="json"
            ),
        )

    def __get_pydantic_json_schema__(self, *_: Any) -> dict[str, Any]:
        """Return the JSON Schema of such a quantity in a file."""
        return quantity_schema(self.what, self.example)

    def _read(self, value: Any, info: ValidationInfo) -> float:
        """Read text with its unit, or in code a number in SI."""
        if isinstance(value, str) or read_from_file(info):
            if isinstance(value, float) and not math.isfinite(value):
                raise InputError(f"{value} is not a finite number")
            return parse_quantity(value, self.unit, self.what)
        return finite_number(value)

    def _write(self, value: float) -> str:
        return format_quantity(value, self.unit, self.written)


_LENGTH = QuantityKind("m", "length", "90 mm", "mm")
_ANGLE = QuantityKind("rad", "angle", "30 deg", "deg")
_PRESSURE = QuantityKind("Pa", "pressure", "1.5 bar", "kPa")
_PRESSURE_RATE = QuantityKind("Pa/s", "rate of pressure", "5 bar/s", "kPa/s")
_MASS = QuantityKind("kg", "mass", "20 g", "g")
_DENSITY = QuantityKind("kg/m^3", "density", "1070 kg/m^3", "kg/m^3")
_ACCELERATION = QuantityKind("m/s^2", "acceleration", "9.81 m/s^2", "m/s^2")
_FORCE = QuantityKind("N", "force", "0.02 N", "N")
_MOMENT = QuantityKind("N*m", "moment", "0.001 N*m", "N*m")
_TRANSLATIONAL = QuantityKind("N/m", "translational stiffness", "1.3 N/m", "N/m")
_ROTATIONAL = QuantityKind("N*m/rad", "rotational stiffness", "0.2 N*m/rad", "N*m/rad")
_DURATION = QuantityKind("s", "duration", "20 ms", "s")
_FREQUENCY = QuantityKind("Hz", "frequency", "50 Hz", "Hz")
_SPEED = QuantityKind("m/s", "speed", "10 mm/s", "mm/s")
_VOLTAGE = QuantityKind("V", "voltage", "10 V", "V")
_FORCE_PER_VOLTAGE = QuantityKind("N/V", "force per voltage", "0.5 N/V", "N/V")
_RATIO = QuantityKind("", "ratio", "1 %", "")

_KINDS = (
    *(_LENGTH, _ANGLE, _PRESSURE, _PRESSURE_RATE, _MASS, _DENSITY, _ACCELERATION, _FORCE),
    *(_MOMENT, _TRANSLATIONAL, _ROTATIONAL, _DURATION, _FREQUENCY, _SPEED, _RATIO),
    *(_VOLTAGE, _FORCE_PER_VOLTAGE),
)
_EXAMPLES = {kind.unit: kind.example for kind in _KINDS}

_DEGREE = "0.01745329251994329576923690768"


# Common units in SI units. pint gives the same factors, but takes 0.2 s to load, so it is used only
# for other units.
_COMMON = {
    "m": {"m": "1", "cm": "0.01", "mm": "0.001", "um": "1e-6", "µm": "1e-6"},
    "rad": {"rad": "1", "deg": _DEGREE, "°": _DEGREE},
    "Pa": {"Pa": "1", "kPa": "1e3", "MPa": "1e6", "mbar": "100", "bar": "1e5"},
    "Pa/s": {"Pa/s": "1", "kPa/s": "1e3", "bar/s": "1e5"},
    "kg": {"kg": "1", "g": "0.001"},
    "kg/m^3": {"kg/m^3": "1", "g/cm^3": "1e3"},
    "m/s^2": {"m/s^2": "1"},
    "N": {"N": "1", "mN": "0.001"},
    "N*m": {"N*m": "1", "mN*m": "0.001", "N*mm": "0.001"},
    "N/m": {"N/m": "1", "N/cm": "100", "N/mm": "1e3"},
    "N*m/rad": {"N*m/rad": "1"},
    "s": {"s": "1", "ms": "0.001"},
    "Hz": {"Hz": "1"},
    "m/s": {"m/s": "1", "mm/s": "0.001"},
    "V": {"V": "1", "mV": "0.001"},
    "N/V": {"N/V": "1"},
    "": {"%": "0.01"},
}


def parse_quantity(text: str, unit: str, what: str = "quantity") -> float:
    """Return the value in SI of a number with a unit.

    Returns the float nearest to the exact value: ``"90 mm"`` gives ``0.09``. Raises `InputError`:
    not a string, no unit, a unit of another quantity, or not a finite number.

    Parameters
    ----------
    text : for example ``"90 mm"``.
    unit : the SI unit of the result, for example ``"m"``; ``""`` for a ratio such as ``"1 %"``.
    what : name of the quantity, for the error message, for example ``"length"``.
    """
    expected = f"expected {_article(what)} such as '{_EXAMPLES.get(unit, f'1 {unit}'.strip())}'"
    if isinstance(text, Real) and not isinstance(text, bool):
        raise InputError(f"bare number {shown(text)} has no unit; {expected}")
    if not isinstance(text, str):
        raise InputError(f"{shown(text)} is not a quantity; {expected}")
    stripped = text.strip()
    number = _NUMBER.match(stripped) if len(stripped) <= _LONGEST else None
    if number is None:
        raise InputError(f"{shown(text)} is not a number with a unit; {expected}")
    unit_text = stripped[number.end() :].strip()
    if unit_text[:1] in tuple(",._0123456789"):
        raise InputError(f"{shown(text)} is not a number with a unit; {expected}")
    if not unit_text:
        raise InputError(f"{shown(text)} has no unit; {expected}")
    factor = _factor(unit_text, unit)
    if isinstance(factor, str):
        reason = f"{factor} {what}" if factor.endswith(" of") else factor
        raise InputError(f"{shown(text)}: {shown(unit_text)} {reason}; {expected}")
    try:
        value = float(Decimal(number.group()) * factor)
    except DecimalException:
        value = math.inf
    if not math.isfinite(value):
        raise InputError(f"{shown(text)} is too large a number; {expected}")
    return value


def format_quantity(value: float, unit: str, written: str | None = None) -> str:
    """Return a text that `parse_quantity` reads back as exactly `value`.

    Parameters
    ----------
    value : in SI, finite.
    unit : the SI unit of `value`.
    written : the unit of the text if that is exact, for example ``"mm"``; otherwise `unit` is used.
    """
    if written is not None and written != unit:
        factor = _factor(written, unit)
        if not isinstance(factor, str):
            scaled = value / float(factor)
            text = f"{scaled:.12g} {written}"
            if math.isfinite(scaled) and parse_quantity(text, unit) == value:
                return text
    number = f"{value:.15g}"
    return f"{number if float(number) == value else repr(float(value))} {unit}".rstrip()


def in_unit_of(given: Any, value: float, unit: str) -> str:
    """Return a value in SI as text in the unit of a given text if that is exact, else in SI."""
    number = _NUMBER.match(given.strip()) if isinstance(given, str) else None
    written = given.strip()[number.end() :].strip() if number else None
    return "0" if value == 0 else format_quantity(value, unit, written)


def quantity_schema(what: str, *examples: str) -> dict[str, Any]:
    """Return the JSON Schema of a quantity in a file."""
    return {
        "type": "string",
        "pattern": _QUANTITY,
        "description": f"{what} with its unit, such as {' or '.join(examples)}",
        "examples": list(examples),
    }


def unit_size(text: str, unit: str) -> Decimal | None:
    """Return how many of the SI unit `unit` one `text` is; None if the quantities differ."""
    factor = _factor(text, unit)
    return None if isinstance(factor, str) else factor


def unit_suffix(unit: str) -> str:
    """Return the suffix of names for a unit: ``_nm_per_rad`` for N*m/rad, "" for none."""
    return f"_{unit.replace('*', '').replace('/', '_per_').lower()}" if unit else ""


def read_from_file(info: ValidationInfo) -> bool:
    """Return whether a pydantic validator checks a file (rather than a call)."""
    return isinstance(info.context, Mapping) and bool(info.context.get("from_file"))


@cache
def _registry() -> pint.UnitRegistry[Any]:
    """Return pint's registry with exact decimals; created at first use, as that is slow."""
    import pint

    return pint.UnitRegistry(non_int_type=Decimal, cache_folder=None)


@lru_cache(maxsize=1024)
def _factor(text: str, unit: str) -> Decimal | str:
    """Return the number of `unit` in one `text`, or what is wrong with `text`."""
    common = _COMMON.get(unit, {}).get(text)
    if common is not None:
        return Decimal(common)
    unknown = "is not a known unit"
    if not _is_simple(text):
        return unknown
    registry = _registry()
    joule = registry.get_root_units("joule")[1]
    try:
        given, wanted = registry.parse_units(text), registry.parse_units(unit)
        # Root units, unlike dimensions, include the radian: N*m/rad is not N*m, 1 is not an angle.
        if registry.get_root_units(given)[1] != registry.get_root_units(wanted)[1]:
            return "is not a unit of"
        if any(registry.get_root_units(part)[1] == joule for part in given._units):
            return "is a unit of energy, not of"
        zero, one = (registry.convert(Decimal(n), given, wanted) for n in (0, 1))
    except Exception:  # pint, its tokenizer and its evaluator raise many kinds for junk
        return unknown
    return Decimal(one) if zero == 0 else unknown  # reject units with an offset


def _is_simple(text: str) -> bool:
    """Return whether text is a product of few units, each with at most one exponent of one digit.

    Only such text is passed to pint, which evaluates it: 9^9^9 would take forever.
    """
    if len(text) > _LONGEST or not _UNIT.fullmatch(text):
        return False
    at = depth = factors = powers = 0
    before = ""
    while at < len(text):
        token = _TOKEN.match(text, at)
        if token is None or token.end() == at:
            return False
        at, kind = token.end(), token.lastgroup or ""
        factors += kind == "factor"
        powers += kind == "power"
        depth += (kind == "open") - (kind == "close")
        if not 0 <= depth <= _MAX_DEPTH or factors > _MAX_FACTORS:
            return False
        if kind == "power" and before not in ("factor", "close"):  # such as a power of a power
            return False
        before = kind
    words = len(_POWER_WORD.findall(text))
    return depth == 0 and (not words or words + powers == 1)


def get_ready() -> None:
    """Load the units that are not common, which takes a second, before time is critical."""
    _registry()


def _article(noun: str) -> str:
    return f"{'an' if noun[:1] in 'aeiou' else 'a'} {noun}"


def finite_number(value: Any) -> float:
    """Return a finite real number; reject booleans, text, NaN and infinities."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise InputError(f"{shown(value)} is not a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{shown(value)} is not a finite number")
    return number


def _ratio(value: Any) -> float:
    return parse_quantity(value, "", "ratio") if isinstance(value, str) else finite_number(value)


def within(limit: float, unit: str) -> AfterValidator:
    """Return the validator that rejects magnitudes beyond a limit, both in SI."""

    def check(value: float) -> float:
        if abs(value) > limit:
            raise InputError(
                f"{value:g} {unit} is out of range; expected -{limit:g} {unit} to {limit:g} {unit}"
            )
        return value

    return AfterValidator(check)


_FINITE = Field(allow_inf_nan=False)

Number = Annotated[float, BeforeValidator(finite_number), _FINITE]
"""A finite number that has no unit."""
Ratio = Annotated[float, BeforeValidator(_ratio, json_schema_input_type=float | str), _FINITE]
"""A finite number that has no unit and may be written in per cent."""

# Each in the SI unit of its kind; pressures are gauge pressures.
Length = Annotated[float, _LENGTH]
Angle = Annotated[float, _ANGLE]
Pressure = Annotated[float, _PRESSURE]
PressureRate = Annotated[float, _PRESSURE_RATE]
Mass = Annotated[float, _MASS]
Density = Annotated[float, _DENSITY]
Acceleration = Annotated[float, _ACCELERATION]
Force = Annotated[float, _FORCE]
Moment = Annotated[float, _MOMENT]
TranslationalStiffness = Annotated[float, _TRANSLATIONAL]
Duration = Annotated[float, _DURATION]
Frequency = Annotated[float, _FREQUENCY]
Speed = Annotated[float, _SPEED]
Voltage = Annotated[float, _VOLTAGE]
ForcePerVoltage = Annotated[float, _FORCE_PER_VOLTAGE]
