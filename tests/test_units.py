"""Quantities: exact values in, clear refusals out."""

from __future__ import annotations

import math
import subprocess
import sys
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from stiffopt import units
from stiffopt.errors import InputError
from stiffopt.units import (
    FROM_FILE,
    Angle,
    Length,
    Number,
    Ratio,
    format_quantity,
    parse_quantity,
)


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("90 mm", "m", 0.09),
        ("  90mm ", "m", 0.09),
        ("2.25 mm", "m", 0.00225),
        ("1e-3 m", "m", 0.001),
        ("-.5 m", "m", -0.5),
        ("1 µm", "m", 1e-6),
        ("1.5 bar", "Pa", 1.5e5),
        ("100 kPa", "Pa", 1e5),
        ("2 deg", "rad", math.radians(2)),
        ("2°", "rad", math.radians(2)),
        ("0.1 rad", "rad", 0.1),
        ("9.81 m/s^2", "m/s^2", 9.81),
        ("9.81 m/s**2", "m/s^2", 9.81),
        ("1070 kg/m^3", "kg/m^3", 1070.0),
        ("20 g", "kg", 0.02),
        ("0.02 N", "N", 0.02),
        ("0 N*m", "N*m", 0.0),
        ("3 mN*m", "N*m", 0.003),
        ("1.3 N/m", "N/m", 1.3),
        ("0.1403 N/cm", "N/m", 14.03),
        ("0.2 N*m/rad", "N*m/rad", 0.2),
        ("1 N*m/deg", "N*m/rad", math.degrees(1)),
        ("5 bar/s", "Pa/s", 5e5),
        ("50 Hz", "Hz", 50.0),
        ("1 %", "", 0.01),
    ],
)
def test_a_quantity_is_read_exactly(text: str, unit: str, value: float) -> None:
    assert parse_quantity(text, unit) == value


@pytest.mark.parametrize(
    ("text", "unit", "what", "message"),
    [
        (
            "90",
            "m",
            "length",
            "'90' has no unit; expected a length such as '90 mm'",
        ),
        (90, "m", "length", "bare number 90 has no unit; expected a length such as '90 mm'"),
        (True, "m", "length", "True is not a quantity"),
        (None, "m", "length", "None is not a quantity"),
        (["90 mm"], "m", "length", "a list is not a quantity"),
        ("", "m", "length", "'' is not a number with a unit"),
        ("junk", "m", "length", "'junk' is not a number with a unit"),
        ("nan mm", "m", "length", "'nan mm' is not a number with a unit"),
        ("inf mm", "m", "length", "'inf mm' is not a number with a unit"),
        ("1e9999 m", "m", "length", "'1e9999 m' is too large a number"),
        ("1,5 mm", "m", "length", "'1,5 mm' is not a number with a unit"),
        ("1_0 mm", "m", "length", "'1_0 mm' is not a number with a unit"),
        ("9 0 mm", "m", "length", "'9 0 mm' is not a number with a unit"),
        ("9 mm!", "m", "length", "'mm!' is not a known unit"),
        ("9 zz", "m", "length", "'zz' is not a known unit"),
        ("9 m^99", "m", "length", "'m^99' is not a known unit"),
        ("9 (m", "m", "length", "'(m' is not a known unit"),
        ("1" * 100 + " m", "m", "length", "...' is not a number with a unit"),
        ("9 kg", "m", "length", "'kg' is not a unit of length"),
        ("9 N/cm", "Pa", "pressure", "expected a pressure such as '1.5 bar'"),
        ("20 degC", "m", "length", "'degC' is not a unit of length"),
        ("20 degC", "K", "temperature", "'degC' is not a known unit"),
        ("3 dB", "", "ratio", "'dB' is not a known unit"),
        ("5", "rad", "angle", "'5' has no unit; expected an angle such as '30 deg'"),
        ("0.1 m/m", "rad", "angle", "'m/m' is not a unit of angle"),
        ("5 %", "rad", "angle", "'%' is not a unit of angle"),
        ("5 deg", "", "ratio", "'deg' is not a unit of ratio"),
        ("1 J", "N*m", "moment", "'J' is a unit of energy, not of moment"),
        ("1 N*m/rad", "N*m", "moment", "'N*m/rad' is not a unit of moment"),
        ("1 N*m", "N*m/rad", "stiffness", "expected a stiffness such as '0.2 N*m/rad'"),
    ],
)
def test_a_refusal_says_what_was_expected(text: object, unit: str, what: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_quantity(text, unit, what)  # type: ignore[arg-type]
    assert message in str(caught.value)
    assert "expected" in str(caught.value)


def test_common_units_are_what_pint_says(monkeypatch: pytest.MonkeyPatch) -> None:
    common = {(text, unit): units._factor(text, unit) for unit in units._COMMON
              for text in units._COMMON[unit]}  # fmt: skip
    monkeypatch.setattr(units, "_COMMON", {})
    units._factor.cache_clear()
    for (text, unit), factor in common.items():
        assert units._factor(text, unit) == factor, (text, unit)
    units._factor.cache_clear()


def test_every_kind_and_the_unit_it_is_written_in_are_common() -> None:
    for kind in units._KINDS:
        assert {kind.unit, kind.written} <= {"", *units._COMMON[kind.unit]}
        assert kind.example.split()[1] in units._COMMON[kind.unit]


@given(st.text(max_size=30))
def test_junk_is_read_or_refused_but_never_crashes(text: str) -> None:
    with suppress(InputError):
        assert math.isfinite(parse_quantity(text, "m", "length"))


@given(st.text("019.e+-*/^() mkgPabrdN%°²·", max_size=20))
def test_any_unit_text_never_crash(text: str) -> None:
    with suppress(InputError):
        parse_quantity(f"1 {text}", "m")


@given(
    st.floats(allow_nan=False, allow_infinity=False),
    st.sampled_from([("m", "mm"), ("Pa", "kPa"), ("rad", "deg"), ("N/m", None), ("Hz", "kHz")]),
)
def test_what_is_written_is_read_back(value: float, units: tuple[str, str | None]) -> None:
    assert parse_quantity(format_quantity(value, *units), units[0]) == value


def test_quantities_are_written_as_people_would() -> None:
    assert format_quantity(0.09, "m", "mm") == "90 mm"
    assert format_quantity(parse_quantity("-30 deg", "rad"), "rad", "deg") == "-30 deg"
    assert format_quantity(0.0, "N*m") == "0 N*m"
    assert format_quantity(1 / 3, "m", "no such unit") == "0.3333333333333333 m"


class Sample(BaseModel):
    length: Length = 0.0
    angle: Angle = 0.0
    number: Number = 0.0
    ratio: Ratio = 0.0


def test_in_code_numbers_are_si_and_text_has_units() -> None:
    sample = Sample.model_validate({"length": np.float32(0.5), "angle": "90 deg", "number": 2})
    assert (sample.length, sample.angle, sample.number) == (0.5, math.pi / 2, 2.0)
    assert type(sample.length) is float


def test_in_a_file_numbers_have_units() -> None:
    sample = Sample.model_validate({"length": "90 mm", "ratio": "1 %"}, context=FROM_FILE)
    assert (sample.length, sample.ratio) == (0.09, 0.01)
    with pytest.raises(ValidationError, match="bare number 90 has no unit; expected a length"):
        Sample.model_validate({"length": 90}, context=FROM_FILE)
    with pytest.raises(ValidationError, match="'90 mm' is not a number"):
        Sample.model_validate({"number": "90 mm"}, context=FROM_FILE)


@pytest.mark.parametrize("context", [None, FROM_FILE])
@pytest.mark.parametrize("key", ["length", "number", "ratio"])
@pytest.mark.parametrize("value", [math.nan, math.inf, True, None, 10**400, 1j])
def test_what_is_no_finite_number_is_refused(
    context: dict[str, bool] | None, key: str, value: object
) -> None:
    with pytest.raises(ValidationError):
        Sample.model_validate({key: value}, context=context)


def test_importing_the_task_schema_is_cheap() -> None:
    code = "import sys, stiffopt.optimise.task; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"scipy", "matplotlib", "pint"} & set(run.stdout.split())


EVALUATED = [
    "1 m^9^9",
    "1 m**9**9",
    "1 m^9^9^9",
    "1 (m^9)^9^9",
    "1 m^9**9",
    "1 m²³",
    "1 m²^9",
    "1 m^-9^-9",
    "1 m^(9)^9",
    "1 m^(9^9)",
    "1 m^1e9",
    "1 m^9e9",
    "1 m^0x9",
    "1 (1e9 m)",
    "1 cubic m^9",
    "1 m cubed^9",
    "1 cubic m cubed squared",
    "1 m^99",
    "1 m^",
    "1 m*9",
    "1 (((m)))",
    "1 " + "(" * 70 + "m",
    "1 " + "(" * 35 + "m" + ")" * 35,
    "1 )m(",
    "1 " + "m*" * 30 + "m/m",
    "1 " + "m" * 100_000,
    "1" * 100_000 + " m",
    "(" * 100_000,
    "9**9**9 m",
    "1e999999999 m",
    "1 9^9^9",
    "1 m^\u0663",
    "\u0663 m",
    "1 m\u2079",
    "1 __import__('os')",
]


@pytest.mark.parametrize("text", EVALUATED, ids=lambda text: text[:20])
def test_what_would_cost_time_is_never_evaluated(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def evaluate() -> None:
        raise AssertionError("handed to pint")

    monkeypatch.setattr(units, "_registry", evaluate)
    with pytest.raises(InputError, match=r"is not a (number with a unit|known unit); expected a"):
        parse_quantity(text, "m", "length")


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("1 m^2/m", "m", 1.0),
        ("1 m ^ 2 / m", "m", 1.0),
        ("1 m²/m", "m", 1.0),
        ("1 (m^2)/(m)", "m", 1.0),
        ("1 ((m/s)*s)", "m", 1.0),
        ("2 km s^-1 s", "m", 2000.0),
        ("1 m**(-1)*m**2", "m", 1.0),
        ("1 kg*m/s^2/m^2", "Pa", 1.0),
        ("1 kg per cubic m", "kg/m^3", 1.0),
        ("1 (1/s)", "Hz", 1.0),
        ("1 cmH2O", "Pa", 98.0665),
        ("1 inch", "m", 0.0254),
    ],
)
def test_rarer_units_and_products_are_read(text: str, unit: str, value: float) -> None:
    assert parse_quantity(text, unit) == pytest.approx(value, rel=1e-4)


def test_integers_of_thousands_of_digits_are_refused_like_others() -> None:
    with pytest.raises(InputError, match="bare number a huge int has no unit"):
        parse_quantity(10**5000, "m", "length")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="a huge int is not a finite number"):
        units.finite_number(10**5000)
