"""A supply that follows goals: it is armed, vented, opened and closed, and it fails."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.typing import NDArray

from fake_supply import HIGH, SLEW, FakeSupply
from goal_bench import PERIOD, Bench
from stiffopt.errors import CommandError, DeviceError

Array = NDArray[np.float64]

# -- arming, venting, opening and closing ---------------------------------------------------------


def test_nothing_is_taken_before_it_is_armed() -> None:
    bench = Bench()
    assert not bench.supply.armed
    for _ in range(2):
        with pytest.raises(CommandError, match=r"the supply is vented .* arm it first"):
            bench.goal(1e4, 1e4, 1e4)
    bench.clock.sleep(1.0)
    assert bench.vented()


def test_an_armed_supply_without_a_goal_stays_at_zero() -> None:
    bench = Bench().armed()
    steps = bench.steps(3.0)
    assert len(steps) > 290  # it is kept awake: the first goal may come late
    assert not any(told.any() for _, told in steps)
    assert bench.supply.armed
    bench.goal(1e4, 1e4, 1e4)
    bench.clock.sleep(1.0)
    np.testing.assert_array_equal(bench.device.commanded, [1e4] * 3)


def test_to_arm_twice_begins_from_zero() -> None:
    bench = Bench().pressed(*HIGH)
    before = len(bench.device.written)
    bench.supply.arm()
    assert not bench.device.written[before].any()
    assert not bench.supply.commanded.any()
    assert not any(told.any() for _, told in bench.steps(1.0))  # no goal is left either
    bench.supply.arm()
    bench.hand.t += PERIOD
    bench.goal(*HIGH)
    np.testing.assert_allclose(bench.device.commanded, PERIOD * SLEW)


def test_to_arm_after_expiry_takes_goals_again() -> None:
    bench = Bench().pressed(1e4, 1e4, 1e4, valid_for=4.0)
    bench.clock.sleep(3.0)
    assert bench.vented()
    bench.armed()
    bench.clock.sleep(1.0)
    bench.supply.vent()
    with pytest.raises(CommandError, match="arm it first"):  # no longer because of the expiry
        bench.goal(1e4, 1e4, 1e4)


def test_to_vent_is_at_once_and_lasts() -> None:
    bench = Bench().pressed(*HIGH)
    bench.supply.vent()
    assert bench.vented()
    assert bench.follower.due == math.inf
    assert not bench.steps(5.0)
    assert bench.vented()


def test_a_supply_that_cannot_be_vented_for_arming_is_not_armed() -> None:
    bench = Bench().pressed(*HIGH)
    bench.device.dead = "before"
    with pytest.raises(DeviceError, match="does not answer"):
        bench.supply.arm()
    assert not bench.supply.armed
    bench.device.dead = ""
    bench.clock.sleep(1.0)
    assert not bench.supply.armed
    bench.armed()
    assert not bench.device.commanded.any()


@pytest.mark.parametrize("vented", ["gate", "device"])
def test_a_supply_that_somebody_else_vented_rests(vented: str) -> None:
    bench = Bench().pressed(3e4, 3e4, 3e4)
    getattr(bench, vented).vent()
    bench.clock.sleep(1.0)
    assert bench.vented()
    assert bench.follower.due == math.inf
    with pytest.raises(CommandError, match=r"vented .* arm it first"):
        bench.goal(3e4, 3e4, 3e4)


def test_to_close_vents() -> None:
    bench = Bench().pressed(*HIGH)
    bench.supply.close()
    assert not bench.device.is_open
    assert not bench.device.written[-1].any()
    assert bench.follower.due == math.inf
    assert not bench.supply.armed
    for act in (bench.supply.read, bench.supply.vent, bench.supply.arm):
        with pytest.raises(DeviceError, match="is not open"):
            act()
    with pytest.raises(DeviceError, match="is not open"):
        bench.supply.command(np.zeros(3))
    bench.supply.open()
    assert bench.device.opened == 2
    assert not bench.supply.armed
    with pytest.raises(CommandError, match=r"^the supply is vented and nothing was written"):
        bench.supply.command(np.zeros(3))


def test_a_supply_that_may_never_be_armed(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    monkeypatch.setattr(FakeSupply, "has_watchdog", False)
    for act in (bench.supply.check_arming, bench.supply.arm):
        with pytest.raises(CommandError, match="neither a watchdog nor a dump valve"):
            act()
    assert not bench.supply.armed
    monkeypatch.setattr(FakeSupply, "has_dump_valve", True, raising=False)
    assert bench.supply.has_dump_valve
    bench.supply.check_arming()


def test_what_is_told_can_be_kept() -> None:
    bench = Bench().pressed(1e4, 1e4, 1e4)
    told = bench.supply.commanded
    told[:] = 9e9
    np.testing.assert_array_equal(bench.supply.commanded, [1e4] * 3)
    bench.clock.sleep(1.0)
    np.testing.assert_array_equal(bench.device.commanded, [1e4] * 3)
    assert bench.supply.n == 3
    assert not bench.supply.has_dump_valve


def test_nobody_else_gets_in_while_the_outlet_is_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    free: list[bool] = []
    write = bench.device._write

    def note(pressures: Array) -> None:
        with ThreadPoolExecutor(1) as other:
            free.append(other.submit(bench.follower._lock.acquire, blocking=False).result())
        write(pressures)

    monkeypatch.setattr(bench.device, "_write", note)
    bench.supply.arm()
    bench.goal(0, 0, 0)
    bench.follower.tick()
    bench.supply.vent()
    bench.follower.fail(DeviceError("no answer"))
    bench.supply.close()
    assert free == [False] * 6


# -- a supply that fails --------------------------------------------------------------------------


def test_a_tick_that_fails_is_told_by_the_next_command_and_vented() -> None:
    bench = Bench().pressed(3e4, 3e4, 3e4)
    device = bench.device
    write = device._write

    def fail_once(pressures: Array) -> None:
        device._write = write  # type: ignore[method-assign]
        raise DeviceError("a cable is loose")

    device._write = fail_once  # type: ignore[method-assign]
    bench.clock.sleep(1.0)
    assert bench.vented()
    for _ in range(2):
        with pytest.raises(DeviceError, match=r"^a cable is loose; the supply was vented$"):
            bench.goal(3e4, 3e4, 3e4)
    assert bench.vented()
    bench.armed()
    bench.goal(3e4, 3e4, 3e4)
    bench.clock.sleep(1.0)
    np.testing.assert_array_equal(device.commanded, [3e4] * 3)


def test_a_failed_tick_that_cannot_be_vented_says_so() -> None:
    bench = Bench().pressed(3e4, 3e4, 3e4)
    bench.device.dead = "before"
    bench.clock.sleep(1.0)
    assert not bench.supply.armed
    assert bench.follower.due < math.inf  # it is tried again and again
    with pytest.raises(DeviceError, match="not answer; THE SUPPLY COULD NOT BE VENTED: it does no"):
        bench.goal(3e4, 3e4, 3e4)
    bench.device.dead = ""
    bench.clock.sleep(0.02)
    assert bench.vented()
    assert bench.follower.due == math.inf


def test_a_command_that_fails_is_told_at_once_and_vents() -> None:
    bench = Bench().pressed(3e4, 3e4, 3e4)
    bench.device.dead = "before"
    with pytest.raises(DeviceError, match="does not answer"):
        bench.goal(1e4, 1e4, 1e4)
    bench.device.dead = ""
    bench.clock.sleep(0.1)
    assert bench.vented()
    assert not bench.supply.armed
    bench.armed()
    bench.goal(1e4, 1e4, 1e4)
    bench.clock.sleep(1.0)
    np.testing.assert_array_equal(bench.device.commanded, [1e4] * 3)


def test_a_supply_that_cannot_be_vented_is_pressed_no_more() -> None:
    bench = Bench().pressed(3e4, 3e4, 3e4)
    bench.device.dead = "before"
    with pytest.raises(DeviceError):
        bench.supply.vent()
    assert bench.follower.due == math.inf
    assert not bench.supply.armed
