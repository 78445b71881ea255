"""Counts of Modbus registers: never beyond a limit, in whatever order of words."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stiffopt.errors import InputError
from stiffopt.rig.drivers.modbus_registers import PressureRegister, PressureScale

TYPES = ("int16", "uint16", "int32", "uint32", "float32")


SCALES = (
    PressureScale(counts=(0, 32767), pressure=(0.0, 1e6)),
    PressureScale(counts=(6553, 32767), pressure=(0.0, 1e6)),
    PressureScale(counts=(0, 4095), pressure=(2e5, -1e4)),
    PressureScale(counts=(0, 1), pressure=(0.0, 100.0)),
)


@given(
    st.sampled_from(TYPES),
    st.sampled_from(["big", "little"]),
    st.sampled_from(SCALES),
    st.floats(0, 1.5e5),
)
def test_counts_never_say_more_than_the_limit(
    kind: Any, order: Any, scale: PressureScale, pressure: float
) -> None:
    point = PressureRegister(7, "holding", kind, order, scale)
    per_count = abs(np.diff(scale.pressure)[0] / np.diff(scale.counts)[0])
    for highest, slack in ((pressure, 1.0), (1e9, 0.5)):
        registers = point.encode(pressure, highest=highest)
        assert len(registers) == point.width
        assert all(0 <= word <= 0xFFFF for word in registers)
        said = point.decode(registers)
        assert said <= highest + 1e-9 * highest
        assert abs(said - pressure) <= (slack + 1e-3) * per_count


@given(
    st.sampled_from(TYPES),
    st.sampled_from(SCALES),
    st.lists(st.floats(-1.5e5, 1.5e5), min_size=3, max_size=3),
)
def test_counts_stay_within_both_limits(
    kind: Any, scale: PressureScale, pressures: list[float]
) -> None:
    low, pressure, high = sorted(pressures)
    point = PressureRegister(7, "holding", kind, "big", scale)
    per_count = abs(np.diff(scale.pressure)[0] / np.diff(scale.counts)[0])
    reach = point.pressure_range()
    try:
        said = point.decode(point.encode(pressure, lowest=low, highest=high))
    except InputError:  # only where the register can say nothing between them
        assert min(high, reach[1]) - max(low, reach[0]) < 1.001 * per_count
    else:
        assert low <= said <= high or (pressure == 0 and said <= max(high, 0))
        assert abs(said - pressure) <= 1.001 * per_count or not reach[0] <= pressure <= reach[1]
    vented = point.decode(point.encode(0.0, lowest=low, highest=high))
    assert -1.001 * per_count <= vented <= max(high, 0.0)


def test_words_are_in_order() -> None:
    scale = PressureScale(counts=(0, 1), pressure=(0.0, 1.0))
    for kind, value, words in (
        ("int32", 0x12345, (0x0001, 0x2345)),
        ("uint32", 0x12345, (0x0001, 0x2345)),
        ("int16", -1.0, (0xFFFF,)),
        ("float32", 1.5, (0x3FC0, 0x0000)),
    ):
        assert PressureRegister(0, "holding", kind, "big", scale).encode(value) == words
        little = PressureRegister(0, "holding", kind, "little", scale)
        assert little.encode(value) == words[::-1]
        assert little.decode(words[::-1]) == value


def test_counts_stay_in_the_register() -> None:
    scale = PressureScale(counts=(0, 1), pressure=(0.0, 1.0))
    assert PressureRegister(0, "holding", "int16", "big", scale).encode(1e9) == (0x7FFF,)
    assert PressureRegister(0, "holding", "uint16", "big", scale).encode(-5.0) == (0,)
    with pytest.raises(InputError):
        PressureRegister(0, "holding", "int16", "big", scale).encode(float("nan"))
