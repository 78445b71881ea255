"""What every pressure supply must do, whatever is behind it.

`test_supply_contract.py` says which supplies there are; a new one is one function there.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt.errors import CommandError, DeviceError
from stiffopt.rig.interface import PressureCommand, PressureReading, PressureSupply

Array = NDArray[np.float64]

CHILD = """
import atexit, sys
sys.path.insert(0, {tests!r})
atexit.register(lambda: print("after", *case.wire()))  # runs after what the supply has registered
from test_supply_contract import CASES
context = CASES[{name!r}]()
case = context.__enter__()
case.supply.open()
case.supply.arm()
case.supply.command(case.supply.limits.high)
case.settle()
print("before", *case.wire())
{ending}
"""


@dataclass
class Case:
    """A supply to be tested.

    Attributes
    ----------
    supply : not yet open; its limits are 0 to something.
    wire : returns the pressures (n,) in Pa that the device was told last.
    tolerance : by which they may differ from what was commanded, in Pa; never above a limit.
    settle : waits until the device has taken what was sent, if it does not confirm it.
    disturb : sets the device to some pressure behind the supply's back; None: not possible.
    valve_open : tells the state of the dump valve, where there is one.
    """

    supply: PressureSupply
    wire: Callable[[], Array]
    tolerance: float = 1e-6
    settle: Callable[[], None] = lambda: None
    disturb: Callable[[], None] | None = None
    valve_open: Callable[[], bool] | None = None
    name: str = ""

    def told(self) -> Array:
        self.settle()
        return np.array(self.wire(), dtype=float)

    def some(self, share: float = 0.5) -> Array:
        """Return pressures within the limits, another one for each channel."""
        return self.supply.limits.high * share * np.linspace(0.6, 1.0, self.supply.n)


def bad_commands(supply: PressureSupply) -> dict[str, Any]:
    """Return what must be refused, by what is wrong with it."""
    n, high, now = supply.n, supply.limits.high, supply.clock.now()

    def with_first(value: float) -> Array:
        return np.concatenate([[value], high[1:] / 2])

    def with_last(value: float) -> Array:
        return np.concatenate([high[:-1] / 2, [value]])

    return {
        "nan": with_last(np.nan),
        "inf": with_first(np.inf),
        "minus inf": with_last(-np.inf),
        "too high": with_last(1.01 * high[-1]),
        "far too high": with_first(1e12),
        "too low": with_first(supply.limits.low[0] - 0.01 * high[0]),
        "too few": high[:-1] / 2,
        "too many": np.append(high, 0.0),
        "one number": float(high[0] / 2),
        "a matrix": np.tile(high / 2, (n, 1)),
        "empty": [],
        "text": ["full"] * n,
        "quantities": ["1 bar"] * n,
        "none": None,
        "ragged": [high[0] / 2, [0.0]],
        "expired": PressureCommand(high / 2, time=now - 10.0, valid_for=0.5),
        "of the future": PressureCommand(high / 2, time=now + 10.0),
        "bad in a command": PressureCommand(with_first(np.nan), time=now, valid_for=10.0),
    }


class SupplyContract:
    """The tests; the fixture `case` yields a `Case`."""

    @pytest.fixture
    def ready(self, case: Case) -> Any:
        case.supply.open()
        case.supply.arm()
        yield case
        case.supply.close()

    def test_opens_vented(self, case: Case) -> None:
        if case.disturb is None:
            pytest.skip("nobody else can set this device")
        case.disturb()
        assert case.told().any()
        with case.supply:
            assert not case.told().any()

    @pytest.mark.parametrize("method", ["command", "exchange"])
    def test_refuses(self, ready: Case, method: str) -> None:
        supply = ready.supply
        for what in bad_commands(supply):
            supply.command(ready.some())
            before, commanded = ready.told(), supply.commanded.copy()
            assert before.any()
            with pytest.raises(CommandError):
                pytest.fail(f"{what}: {getattr(supply, method)(bad_commands(supply)[what])}")
            np.testing.assert_array_equal(ready.told(), before, err_msg=what)
            np.testing.assert_array_equal(supply.commanded, commanded, err_msg=what)

    @pytest.mark.parametrize("method", ["command", "exchange"])
    def test_carries_out(self, ready: Case, method: str) -> None:
        supply = ready.supply
        for share in (0.3, 1.0, 0.7):
            p = ready.some(share)
            getattr(supply, method)(p)
            np.testing.assert_allclose(ready.told(), p, rtol=0, atol=ready.tolerance)
            np.testing.assert_array_equal(supply.commanded, p)
            p[:] = 0  # the caller's array is his own
            assert supply.commanded.all()

    def test_carries_out_a_command_in_time(self, ready: Case) -> None:
        p = ready.some()
        ready.supply.command(PressureCommand(p, ready.supply.clock.now(), valid_for=60.0))
        np.testing.assert_allclose(ready.told(), p, rtol=0, atol=ready.tolerance)

    @pytest.mark.parametrize("method", ["command", "exchange"])
    def test_limits_may_be_commanded(self, ready: Case, method: str) -> None:
        limits = ready.supply.limits
        for p in (limits.high, limits.low, np.zeros(limits.n)):
            getattr(ready.supply, method)(p)
            told = ready.told()
            np.testing.assert_allclose(told, p, rtol=0, atol=ready.tolerance)
            assert np.all(told <= limits.high)

    def test_clamps_what_was_not_refused(self, ready: Case) -> None:
        limits = ready.supply.limits
        for junk in (np.nan, np.inf, -np.inf, 1e12, -1e12, 1.5 * limits.high.max()):
            ready.supply.command(ready.some())
            ready.supply._write_clamped(np.full(limits.n, junk))
            told = ready.told()
            assert np.all((told >= limits.low - ready.tolerance) & (told <= limits.high)), junk

    def test_reads(self, ready: Case) -> None:
        supply = ready.supply
        for reading in (supply.read(), supply.exchange(ready.some()), supply.read()):
            assert isinstance(reading, PressureReading)
            assert reading.pressures.shape == (supply.n,)
            assert reading.pressures.dtype == float
            assert 0 <= supply.clock.now() - reading.time < 60

    def test_vents(self, ready: Case) -> None:
        supply = ready.supply
        supply.command(ready.some())
        supply.vent()
        assert not ready.told().any()
        assert not supply.commanded.any()
        assert not supply.armed
        if ready.valve_open is not None:
            assert ready.valve_open()
        with pytest.raises(CommandError, match="arm it"):
            supply.command(ready.some())
        supply.command(np.zeros(supply.n))  # to ask for nothing is always allowed
        assert not ready.told().any()
        supply.arm()
        if ready.valve_open is not None:
            assert not ready.valve_open()
        assert not ready.told().any()
        supply.command(ready.some())
        assert ready.told().any()

    def test_arming_begins_from_nothing(self, ready: Case) -> None:
        if ready.disturb is None:
            pytest.skip("nothing can be set behind its back")
        ready.supply.vent()
        ready.disturb()
        assert ready.told().any()
        ready.supply.arm()
        assert not ready.told().any()

    def test_it_opens_vented(self, case: Case) -> None:
        with case.supply as supply:
            assert not supply.armed
            with pytest.raises(CommandError, match="arm it"):
                supply.exchange(case.some())
            assert not case.told().any()

    def test_valve_and_its_description_agree(self, case: Case) -> None:
        assert case.supply.has_dump_valve == (case.valve_open is not None)

    def test_vents_when_closed(self, ready: Case) -> None:
        ready.supply.command(ready.some())
        assert ready.told().any()
        ready.supply.close()
        assert not ready.told().any()
        assert not ready.supply.is_open
        ready.supply.close()
        assert not ready.told().any()

    def test_vents_when_something_raises(self, case: Case) -> None:
        def fail() -> None:
            with case.supply as supply:
                supply.arm()
                supply.command(case.some())
                assert case.told().any()
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            fail()
        assert not case.told().any()
        assert not case.supply.is_open

    def test_is_of_no_use_while_closed(self, case: Case) -> None:
        supply = case.supply
        uses: tuple[Callable[[], Any], ...] = (
            lambda: supply.command(case.some()),
            lambda: supply.exchange(case.some()),
            lambda: supply.command(np.full(supply.n, np.nan)),
            supply.read,
            supply.vent,
            supply.arm,
        )
        for _ in range(2):  # before it is opened, and after it was closed
            for use in uses:
                with pytest.raises(DeviceError):
                    use()
            supply.open()
            supply.close()

    def test_opens_again(self, case: Case) -> None:
        for _ in range(2):
            with case.supply as supply:
                supply.arm()
                supply.command(case.some())
                supply.open()  # to open what is open does nothing
                np.testing.assert_allclose(case.told(), case.some(), rtol=0, atol=case.tolerance)
            assert not case.told().any()

    @pytest.mark.one_in(3)
    @pytest.mark.parametrize("ending", ["", "raise RuntimeError('lost')", "sys.exit(3)"])
    def test_vents_when_the_interpreter_exits(self, case: Case, ending: str) -> None:
        tests = str(Path(__file__).parent)
        script = CHILD.format(tests=tests, name=case.name, ending=ending)
        child = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False
        )
        lines = dict(line.split(maxsplit=1) for line in child.stdout.splitlines())
        assert {"before", "after"} <= lines.keys(), child.stdout + child.stderr
        before, after = (np.array(lines[key].split(), float) for key in ("before", "after"))
        assert before.all()
        assert not after.any()
