"""A supply vents whatever happens: interrupts, threads, devices that come back."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import CommandError, DeviceError, InputError
from stiffopt.rig import pressure
from stiffopt.rig.pressure import PressureLimits, PressureSupply

SOME = np.array([1e5, 5e4])


class Recorded(PressureSupply):
    """A supply that does what it is told and writes it down.

    Attributes
    ----------
    wire : what the device was told last.
    valve : state of its dump valve.
    story : what happened, in order.
    before_write : called before each write; it may raise.
    """

    def __init__(self, limits: PressureLimits | None = None) -> None:
        super().__init__(limits or PressureLimits(np.zeros(2), np.full(2, 1.5e5)))
        self.wire = np.full(self.limits.n, 7e4)  # of an earlier program
        self.valve = "open"
        self.story: list[str] = []
        self.before_write: Callable[[], None] = lambda: None

    @property
    def has_dump_valve(self) -> bool:
        return True

    def _open(self) -> None:
        self.story.append("connected")

    def _close(self) -> None:
        self.story.append("disconnected")

    def _write(self, pressures: NDArray[np.float64]) -> None:
        self.before_write()
        self.wire = pressures.copy()
        self.story.append("pressure" if pressures.any() else "zeros")

    def _read(self) -> ArrayLike:
        return self.wire

    def _dump(self, *, open_valve: bool) -> None:
        self.valve = "open" if open_valve else "shut"
        self.story.append(self.valve)


def failing(times: int, error: type[BaseException]) -> Callable[[], None]:
    left = [times]

    def fail() -> None:
        if left[0] > 0:
            left[0] -= 1
            raise error("not now")

    return fail


@pytest.fixture
def supply() -> Recorded:
    supply = Recorded()
    supply.open()
    supply.arm()
    supply.command(SOME)
    return supply


def test_opening_vents_and_arming_shuts_the_valve_last() -> None:
    supply = Recorded()
    supply.open()
    assert supply.story == ["connected", "open", "zeros"]
    with pytest.raises(CommandError, match="vented"):
        supply.command(SOME)
    supply.arm()
    assert supply.story[3:] == ["zeros", "shut"]
    supply.close()


def test_arming_after_a_vent_that_failed_does_not_let_the_pressure_back_in(
    supply: Recorded,
) -> None:
    supply.before_write = failing(1, DeviceError)
    with pytest.raises(DeviceError):
        supply.vent()
    assert supply.valve == "open"
    assert supply.wire.any()  # the regulators still want it
    del supply.story[:]
    supply.arm()
    assert supply.story == ["zeros", "shut"]
    supply.close()


def test_a_supply_that_cannot_be_set_to_nothing_is_not_armed(supply: Recorded) -> None:
    supply.vent()
    supply.before_write = failing(1, DeviceError)
    with pytest.raises(DeviceError):
        supply.arm()
    assert supply.valve == "open"
    assert not supply.armed
    supply.close()


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_interrupt_does_not_keep_an_arm_under_pressure(
    supply: Recorded, error: type[BaseException]
) -> None:
    supply.before_write = failing(1, error)
    with pytest.raises(error):
        supply.close()
    assert not supply.wire.any()
    assert supply.story[-1] == "disconnected"
    assert supply not in pressure._not_known_to_be_vented


def test_closing_tries_twice(supply: Recorded) -> None:
    supply.before_write = failing(1, DeviceError)
    supply.close()
    assert not supply.wire.any()
    assert supply not in pressure._not_known_to_be_vented


def test_what_could_not_be_vented_is_vented_when_the_interpreter_exits(
    supply: Recorded, capsys: pytest.CaptureFixture[str]
) -> None:
    other = Recorded()
    other.open()
    other.arm()
    other.command(SOME)
    supply.before_write = failing(2, DeviceError)
    with pytest.raises(DeviceError):
        supply.close()
    assert supply.wire.any()
    assert not supply.is_open
    other.before_write = failing(4, KeyboardInterrupt)  # somebody is impatient
    pressure._vent_all()
    assert not supply.wire.any()
    assert supply.story[-1] == "disconnected"
    assert "A SUPPLY COULD NOT BE VENTED" in capsys.readouterr().err
    pressure._vent_all()
    pressure._vent_all()
    assert not other.wire.any()


def test_no_thread_writes_after_closing(supply: Recorded) -> None:
    """A command that has been checked is written before the supply is vented, or not at all."""
    checked, go_on = threading.Event(), threading.Event()
    check = supply._checked

    def slowly(pressures: object) -> NDArray[np.float64]:
        p = check(pressures)  # type: ignore[arg-type]
        checked.set()
        go_on.wait(5)
        return p

    supply._checked = slowly  # type: ignore[method-assign, assignment]
    writer = threading.Thread(target=supply.command, args=(SOME,))
    writer.start()
    assert checked.wait(5)
    closer = threading.Thread(target=supply.close)
    closer.start()
    closer.join(0.1)
    go_on.set()
    for thread in (writer, closer):
        thread.join(5)
        assert not thread.is_alive()
    assert supply.story[-3:] == ["open", "zeros", "disconnected"]
    assert not supply.wire.any()


def test_opening_that_fails_to_vent_disconnects() -> None:
    supply = Recorded()
    supply.before_write = failing(9, DeviceError)
    with pytest.raises(DeviceError):
        supply.open()
    assert not supply.is_open
    assert supply.story[-1] == "disconnected"


@pytest.mark.parametrize(
    ("low", "high", "given", "expected"),
    [
        (0.0, 1e5, -5.0, 0.0),
        (0.0, 1e5, 2e5, 1e5),
        (-6e4, -1e4, -5e3, -1e4),
        (-6e4, -1e4, 0.0, 0.0),
        (-6e4, -1e4, np.inf, 0.0),
        (3e4, 1e5, 1e4, 3e4),
        (3e4, 1e5, 0.0, 0.0),
        (3e4, 1e5, np.nan, 0.0),
    ],
)
def test_the_last_clamp(low: float, high: float, given: float, expected: float) -> None:
    limits = PressureLimits(np.array([low]), np.array([high]))
    assert limits.clamp(np.array([given])) == pytest.approx([expected])


@pytest.mark.parametrize(
    ("low", "high"), [([0, 0], [1]), ([2.0], [1.0]), ([np.nan], [1.0]), ([], []), (0.0, 1.0)]
)
def test_limits_that_make_no_sense_are_refused(low: ArrayLike, high: ArrayLike) -> None:
    with pytest.raises(InputError):
        PressureLimits(np.asarray(low), np.asarray(high))


# What each tick does: plain arrays take a shorter way, with the same outcome ----------------------

BOUNDS = [(0.0, 1.5e5), (-6e4, 1e5), (3e4, 1e5), (-6e4, -1e4), (2e4, 2e4), (-0.0, 0.0)]


def telling_values(low: float, high: float) -> list[float]:
    slack = 1e-6 * (high - low)
    inside, outside = -slack, slack
    bounds = [
        value
        for bound, out in ((low, -1.0), (high, 1.0))
        for value in (
            bound,
            np.nextafter(bound, out * np.inf),
            np.nextafter(bound, -out * np.inf),
            bound + out * 0.5 * inside,
            bound + out * 0.5 * outside,
            bound + out * 2 * outside,
            bound + out * 1e3,
            bound + out * 1e12,
        )
    ]
    special = [0.0, -0.0, 5e-324, -5e-324, np.nan, np.inf, -np.inf, 0.5 * (low + high)]
    return [float(value) for value in bounds + special]


def outcome(limits: PressureLimits, pressures: ArrayLike) -> str | list[str]:
    """What `check` says, or what it returns, to the last bit."""
    try:
        checked = limits.check(pressures)
    except CommandError as error:
        return str(error)
    assert type(checked) is np.ndarray
    assert checked.dtype == np.float64
    assert checked.flags.writeable
    assert not np.shares_memory(checked, np.asarray(pressures))
    return [value.hex() for value in checked.tolist()]


def clamped(value: float, low: float, high: float) -> float:
    if value == 0 or not np.isfinite(value):
        return 0.0
    return min(max(value, low), high)


@pytest.mark.parametrize(("low", "high"), BOUNDS)
def test_an_array_is_refused_or_taken_just_as_a_list_is(low: float, high: float) -> None:
    limits = PressureLimits(np.array([low, low]), np.array([high, high]))
    values, slack = telling_values(low, high), 1e-6 * (high - low)
    for pair in itertools.product(values, values):
        found = outcome(limits, np.array(pair))
        assert found == outcome(limits, list(pair)), pair
        allowed = all(v == 0 or low - slack <= v <= high + slack for v in pair)
        assert allowed == isinstance(found, list), pair
        if allowed:
            assert found == [(clamped(v, low, high) + 0.0).hex() for v in pair]


@pytest.mark.parametrize(("low", "high"), BOUNDS)
def test_the_last_clamp_to_the_last_bit(low: float, high: float) -> None:
    limits = PressureLimits(np.array([low, low]), np.array([high, high]))
    values = telling_values(low, high)
    for pair in itertools.product(values, values):
        given = np.array(pair)
        found = limits.clamp(given)
        assert [v.hex() for v in found.tolist()] == [
            (clamped(v, low, high) + 0.0).hex() for v in pair
        ], pair
        assert not np.shares_memory(found, given)


class Liar(np.ndarray):
    """Looks harmless when it is asked."""

    def __add__(self, other: object) -> NDArray[np.float64]:  # type: ignore[override]
        return np.zeros(2)

    def tolist(self) -> list[float]:
        return [0.0, 0.0]


@pytest.mark.parametrize(
    "pressures",
    [
        np.array([1, 2]),
        np.array([1, 2], dtype=np.uint8),
        np.array([1e3, 2e3], dtype=np.float32),
        np.array([1e3, 2e3], dtype=">f8"),
        np.array([1e3, 9.0, 2e3, 9.0])[::2],
        np.array([3e5, 2e3]).view(Liar),
        np.array([1e3, 2e3]).view(Liar),
        np.array([1e3, 2e3], dtype=complex),
        np.array([True, False]),
        np.array(["1", "2"]),
        np.array(1e3),
        np.array([]),
        np.array([1e3]),
        np.array([1e3, 2e3, 3e3]),
        np.array([[1e3, 2e3]]),
        np.array([[1e3], [2e3]]),
        np.float64(1e3),
    ],
)
def test_what_is_no_plain_array_is_looked_at_for_what_it_is(pressures: NDArray[Any]) -> None:
    limits = PressureLimits(np.zeros(2), np.full(2, 1.5e5))
    plain = np.ndarray.tolist(pressures) if isinstance(pressures, Liar) else pressures.tolist()
    assert outcome(limits, pressures) == outcome(limits, plain)


def test_an_array_of_objects_is_no_pressure() -> None:
    limits = PressureLimits(np.zeros(2), np.full(2, 1.5e5))
    with pytest.raises(CommandError, match="expected one pressure in Pa"):
        limits.check(np.array([1e3, 2e3], dtype=object))


def test_what_was_checked_cannot_be_changed_afterwards() -> None:
    limits = PressureLimits(np.zeros(2), np.full(2, 1.5e5))
    given = np.array([1e3, 2e3])
    checked, last = limits.check(given), limits.clamp(given)
    given[:] = 1e12
    assert checked.tolist() == last.tolist() == [1e3, 2e3]


class AtOnce(Recorded):
    """Writes and reads in one exchange."""

    def _exchange(self, pressures: NDArray[np.float64]) -> ArrayLike:
        self._write(pressures)
        return self.wire


@pytest.mark.parametrize("kind", [Recorded, AtOnce])
@pytest.mark.parametrize("method", ["command", "exchange"])
def test_whatever_was_checked_is_clamped_before_the_driver(
    kind: type[Recorded], method: str
) -> None:
    supply = kind()
    supply.open()
    for junk in ([np.nan, np.inf], [1e12, -1e12], [1.5e5 + 0.1, -0.1]):
        supply._checked = lambda _, junk=junk: np.array(junk)  # type: ignore[method-assign, misc]
        getattr(supply, method)(SOME)
        assert ((supply.wire >= 0) & (supply.wire <= 1.5e5)).all()
        assert supply.wire.tolist() == supply.commanded.tolist()
    supply.close()


@pytest.mark.parametrize("method", ["command", "exchange"])
def test_a_vented_supply_takes_zeros_alone(supply: Recorded, method: str) -> None:
    supply.vent()
    for nothing in (np.zeros(2), np.array([-0.0, 0.0]), [0, 0]):
        getattr(supply, method)(nothing)
    for something in (SOME, np.array([0.0, 5e-324]), [0.0, 1.0]):
        with pytest.raises(CommandError, match="vented"):
            getattr(supply, method)(something)
    assert not supply.wire.any()
    supply.close()
