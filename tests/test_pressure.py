"""A supply vents whatever happens: interrupts, threads, devices that come back."""

from __future__ import annotations

import threading
from collections.abc import Callable

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
