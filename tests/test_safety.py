"""The gate before the supply: bounds, rates, force, age; what it refuses changes nothing."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from fake_supply import HIGH, SLEW, FakeSupply, HandClock
from stiffopt.errors import CommandError, DeviceError, InputError
from stiffopt.model.robot_files import load_description
from stiffopt.rig.interface import PressureCommand, PressureLimits
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import SafetyGate, check_protection, effective_slew, gate_before
from stiffopt.safety.settings import COMMANDS

AREAS = np.array([1e-5, 2e-5, 3e-5])


class Bench:
    def __init__(self, low: ArrayLike = 0.0, **options: Any) -> None:
        self.clock = HandClock()
        self.supply = FakeSupply(self.clock, low)
        safety = options.pop("safety", Safety())
        given = {"slew": SLEW, "force_per_pressure": None, "clock": self.clock, **options}
        self.gate = SafetyGate(self.supply, safety=safety, **given)
        self.gate.open()

    def armed(self) -> Bench:
        self.gate.arm()
        return self

    def ask(self, *p: float, wait: float = 0.01) -> Any:
        self.clock.t += wait
        return self.gate.apply(PressureCommand(np.array(p), self.clock.t))

    def until(self, *p: float, ticks: int = 300) -> Any:
        for _ in range(ticks):
            applied = self.ask(*p)
        return applied

    def refuses(self, command: PressureCommand, match: str) -> None:
        before, applied = len(self.supply.written), self.gate.apply(command)
        assert match in applied.refused
        assert len(self.supply.written) == before
        np.testing.assert_array_equal(applied.pressures, self.supply.commanded)
        np.testing.assert_array_equal(applied.reading.pressures, self.supply.commanded + 7.0)


def test_what_is_allowed_is_written_and_read_back() -> None:
    bench = Bench().armed()
    assert bench.gate.armed
    applied = bench.ask(1e3, 5e2, 0.0)
    np.testing.assert_array_equal(applied.pressures, [1e3, 5e2, 0.0])
    np.testing.assert_array_equal(applied.reading.pressures, [1007.0, 507.0, 7.0])
    np.testing.assert_array_equal(bench.supply.commanded, [1e3, 5e2, 0.0])
    assert not applied.limited
    assert not applied.refused
    np.testing.assert_array_equal(bench.gate.read().pressures, [1007.0, 507.0, 7.0])


@pytest.mark.parametrize(
    ("pressures", "match"),
    [
        ([1e3, math.nan, 0.0], "channel 2: nan is not a finite pressure"),
        ([math.inf, 0.0, 0.0], "channel 1: inf is not a finite pressure"),
        ([0.0, 1.1e5, 0.0], "channel 2: 1.1 bar is out of range"),
        ([0.0, 0.0, 1e12], "channel 3: 1e+07 bar is out of range"),
        ([-1e3, 0.0, 0.0], "channel 1: -0.01 bar is out of range"),
        ([1e3, 1e3], "expected 3 pressures"),
        ([[1e3, 1e3, 1e3]], "expected 3 pressures"),
        (None, "expected one pressure in Pa for each channel"),
        ("much", "expected one pressure in Pa for each channel"),
        ([True, True, True], "expected one pressure in Pa for each channel"),
        ([[1.0], [1.0, 2.0]], "expected one pressure in Pa for each channel"),
    ],
)
@pytest.mark.parametrize("array", [False, True])
def test_13_15_what_is_no_good_is_refused(pressures: Any, match: str, array: bool) -> None:
    bench = Bench().armed()
    bench.ask(1e3, 5e2, 2e2)
    if array and not match.startswith("expected one"):
        pressures = np.array(pressures)
    bench.refuses(PressureCommand(pressures, bench.clock.t), match)
    assert not bench.ask(1e3, 5e2, 2e2).refused  # it takes good ones as before


@pytest.mark.parametrize("channel", range(3))
@pytest.mark.parametrize("low", [0.0, -2e4])
def test_13_the_limits_to_the_last_pascal(channel: int, low: float) -> None:
    bench = Bench(low, slew=1e12).armed()
    for bound, sign in ((HIGH[channel], 1), (low, -1)):
        asked = np.zeros(3)
        for beyond in (0.0, 0.05):  # what rounding makes of it is taken for the limit
            asked[channel] = bound + sign * beyond
            applied = bench.ask(*asked)
            assert not applied.refused
            assert applied.pressures[channel] == bound
        asked[channel] = bound + sign * 0.3
        bench.refuses(PressureCommand(asked, bench.clock.t), f"channel {channel + 1}: ")


@pytest.mark.parametrize(
    ("age", "valid_for", "match"),
    [
        (0.2, 0.1, "has expired; it is 0.2 s old"),
        (0.6, 5.0, "has expired"),  # what the command says does not loosen the limit
        (-0.01, 0.5, "from the future, by 0.01 s"),
        (math.nan, 0.5, "has expired"),
        (0.0, math.nan, "has expired"),
        (math.inf, 0.5, "has expired"),
        (0.0, -1.0, "has expired"),
    ],
)
def test_old_commands_and_future_ones_are_refused(age: float, valid_for: float, match: str) -> None:
    bench = Bench().armed()
    bench.ask(1e3, 0.0, 0.0)
    bench.refuses(PressureCommand(np.array([2e3, 0, 0]), bench.clock.t - age, valid_for), match)


@pytest.mark.parametrize("wait", [0.001, 0.004, 0.01, 0.02, 0.03])
def test_14_raising_too_fast_is_limited(wait: float) -> None:
    bench = Bench().armed()
    before = np.zeros(3)
    for _ in range(12):
        applied = bench.ask(*HIGH, wait=wait)
        np.testing.assert_allclose(applied.pressures, np.minimum(before + SLEW * wait, HIGH))
        assert applied.limited == bool((applied.pressures < HIGH).any())
        before = applied.pressures
    at_the_end = bench.until(*HIGH)
    np.testing.assert_array_equal(at_the_end.pressures, HIGH)
    assert not at_the_end.limited


def test_14_falling_too_fast_is_limited_but_venting_is_not() -> None:
    bench = Bench().armed()
    bench.until(*HIGH)
    np.testing.assert_allclose(bench.ask(0, 0, 0).pressures, HIGH - 0.01 * SLEW)
    bench.gate.vent()
    assert not bench.supply.commanded.any()


def test_14_a_pause_allows_no_jump() -> None:
    bench = Bench(period=0.005).armed()
    bench.ask(0, 0, 0)
    applied = bench.ask(*HIGH, wait=0.4)
    np.testing.assert_allclose(applied.pressures, 3 * 0.005 * SLEW)


def test_14_a_clock_that_stands_still_allows_nothing() -> None:
    bench = Bench().armed()
    for _ in range(5):
        assert not bench.ask(*HIGH, wait=0.0).pressures.any()


def test_the_force_is_not_raised_above_its_limit() -> None:
    limit = 2.5
    bench = Bench(safety=Safety(max_force=limit), force_per_pressure=AREAS).armed()
    applied = bench.until(*HIGH)
    assert applied.limited
    assert float(AREAS @ applied.pressures) == pytest.approx(limit, rel=1e-9)
    # from one split to another: what falls passes, what rises gets what is left
    moved = bench.ask(*HIGH * [0.0, 1.0, 1.0])
    assert moved.pressures[0] < applied.pressures[0]
    assert float(AREAS @ moved.pressures) <= limit * (1 + 1e-9)
    assert not bench.until(1e4, 1e4, 1e4).limited


def test_a_force_above_the_limit_may_fall_but_not_rise() -> None:
    bench = Bench(safety=Safety(max_force=1e9), force_per_pressure=AREAS).armed()
    bench.until(*HIGH)
    bench.gate._max_force = 1.0  # as if it had been lowered
    before = bench.supply.commanded
    held = bench.ask(*before)
    np.testing.assert_array_equal(held.pressures, before)
    mixed = bench.ask(before[0] - 1e3, before[1] - 1e3, before[2] - 5e2)
    np.testing.assert_allclose(mixed.pressures, before - [1e3, 1e3, 5e2])
    swap = bench.ask(HIGH[0], before[1] - 3e3, before[2] - 1e3)
    assert swap.pressures[0] == mixed.pressures[0]
    assert swap.limited


def test_a_vacuum_relieves_no_force() -> None:
    safety = Safety(max_force=1.0)
    bench = Bench(-5e4, safety=safety, force_per_pressure=AREAS).armed()
    applied = bench.until(-5e4, 1e5, -5e4)
    np.testing.assert_allclose(applied.pressures, [-5e4, 1.0 / AREAS[1], -5e4])


def test_a_low_limit_above_zero_is_stepped_to_when_a_rise_would_be_there() -> None:
    bench = Bench([1.9e4, 0.0, 0.0]).armed()
    told = [bench.ask(5e4, 0.0, 0.0).pressures[0] for _ in range(14)]
    np.testing.assert_allclose(told, [0, 0, 0, *np.arange(1.9e4, 5e4, 5e3), *[5e4] * 4])
    down = [bench.ask(0.0, 0.0, 0.0).pressures[0] for _ in range(12)]
    np.testing.assert_allclose(down, [*np.arange(4.5e4, 1.9e4, -5e3), *[0] * 6])


def test_nothing_passes_a_gate_that_is_not_armed() -> None:
    bench = Bench()
    bench.refuses(PressureCommand(np.zeros(3), bench.clock.t), "arm it first")
    bench.armed().gate.vent()
    bench.refuses(PressureCommand(np.full(3, 1e3), bench.clock.t), "arm it first")


def test_arming_begins_at_zero() -> None:
    bench = Bench().armed()
    bench.until(*HIGH)
    bench.gate.vent()
    bench.clock.t += 10
    bench.gate.arm()
    np.testing.assert_allclose(bench.ask(*HIGH).pressures, 0.01 * SLEW)


def test_commands_that_stop_vent() -> None:
    bench = Bench(safety=Safety(command_timeout=0.2)).armed()
    bench.until(*HIGH)
    for _ in range(19):
        bench.clock.t += 0.01
        assert not bench.gate.expire(bench.clock.t)
    bench.refuses(PressureCommand(np.array([math.nan] * 3), bench.clock.t), "finite")  # no life
    bench.clock.t += 0.02
    assert bench.gate.expire(bench.clock.t)
    assert not bench.supply.commanded.any()
    assert not bench.gate.armed
    assert not bench.gate.expire(bench.clock.t)


def test_a_command_after_too_long_a_pause_finds_it_vented() -> None:
    bench = Bench().armed()
    bench.until(*HIGH)
    applied = bench.ask(*HIGH, wait=0.6)
    assert "no command came for 0.5 s" in applied.refused
    assert not applied.pressures.any()
    assert not bench.supply.commanded.any()


def test_a_supply_that_cannot_be_vented_is_vented_later() -> None:
    bench = Bench().armed()
    bench.until(*HIGH)
    bench.supply.dead = "before"
    for _ in range(3):
        with pytest.raises(DeviceError):
            bench.gate.vent()
        with pytest.raises(DeviceError):
            bench.gate.expire(bench.clock.t)
        with pytest.raises(DeviceError):
            bench.ask(*HIGH)
    bench.supply.dead = ""
    assert bench.gate.expire(bench.clock.t)
    assert not bench.supply.commanded.any()


@pytest.mark.parametrize("dead", ["before", "after"])
def test_after_a_command_whose_fate_is_unknown_nothing_jumps(dead: str) -> None:
    bench = Bench().armed()
    bench.until(1e5, 1e5, 1e5)
    bench.supply.dead = dead
    with pytest.raises(DeviceError):
        bench.ask(0, 0, 0)
    with pytest.raises(DeviceError):
        bench.ask(0, 0, 0)
    bench.supply.dead = ""
    applied = bench.ask(1e5, 1e5, 1e5)
    assert (applied.pressures <= 1e5 - 0.01 * SLEW + 1e-6).all()


@pytest.mark.parametrize("dead", ["before", "after"])
def test_a_write_that_failed_does_not_count_as_done(dead: str) -> None:
    """A raise that may not be there is no step from which the next one begins."""
    bench = Bench().armed()
    bench.until(5e4, 5e4, 5e4)
    bench.supply.dead = dead
    for _ in range(4):
        with pytest.raises(DeviceError):
            bench.ask(*HIGH)
    bench.supply.dead = ""
    refused = bench.ask(math.nan, 0, 0)
    np.testing.assert_array_equal(refused.pressures, [5e4] * 3)  # what is known to be there
    applied = bench.ask(*HIGH, wait=0.0)
    np.testing.assert_allclose(applied.pressures, 5e4 + 0.01 * SLEW)


def test_a_supply_that_somebody_else_vented_takes_nothing() -> None:
    bench = Bench().armed()
    bench.until(*HIGH)
    bench.supply.vent()
    applied = bench.ask(*HIGH)
    assert "vented" in applied.refused
    assert not applied.pressures.any()
    assert not bench.gate.armed


def test_a_refusal_of_the_supply_changes_nothing() -> None:
    bench = Bench().armed()
    bench.until(5e4, 5e4, 5e4)
    bench.supply.limits = PressureLimits(np.zeros(3), np.full(3, 5.2e4))
    applied = bench.ask(*HIGH)
    assert "out of range" in applied.refused
    np.testing.assert_array_equal(applied.pressures, [5e4] * 3)
    assert bench.gate.armed
    np.testing.assert_allclose(bench.ask(5.2e4, 5e4, 5e4).pressures, [5.2e4, 5e4, 5e4])


def test_25_without_a_rate_it_does_not_arm() -> None:
    bench = Bench(slew=[1e5, math.inf, 1e5])
    with pytest.raises(CommandError, match=r"set safety\.max_slew"):
        bench.gate.arm()
    assert not bench.supply.armed


@pytest.mark.parametrize("low", [0.0, -2e4, 1.9e4])
def test_arrays_and_lists_come_to_the_same(low: float) -> None:
    rng = np.random.default_rng(5)
    arrays, lists = Bench(low).armed(), Bench(low).armed()
    edges = [low, -0.0, 0.0, math.nan, math.inf, -math.inf, -1e3, 1e12, 1.0e5, 1.5e5, 1.2e5, 0.05]
    for _ in range(400):
        asked = rng.uniform(low, 1.2e5, 3)
        for channel in np.flatnonzero(rng.random(3) < 0.2):
            asked[channel] = rng.choice(edges)
        found = []
        for bench, given in ((arrays, asked), (lists, asked.tolist())):
            bench.clock.t += 0.01
            found.append(bench.gate.apply(PressureCommand(given, bench.clock.t)))
        one, other = found
        assert (one.limited, one.refused) == (other.limited, other.refused)
        np.testing.assert_array_equal(one.pressures, other.pressures)
        np.testing.assert_array_equal(arrays.supply.commanded, lists.supply.commanded)
        assert one.limited == (not one.refused and bool((one.pressures != asked).any()))


def test_a_command_that_is_changed_after_it_was_given_changes_nothing() -> None:
    bench = Bench().armed()
    asked = np.array([1e3, 5e2, 0.0])
    bench.clock.t += 0.01
    applied = bench.gate.apply(PressureCommand(asked, bench.clock.t))
    asked[:] = 1e12
    assert applied.pressures.tolist() == bench.supply.written[-1].tolist() == [1e3, 5e2, 0.0]
    assert bench.ask(1e3, 5e2, 0.0).pressures.tolist() == [1e3, 5e2, 0.0]


def test_its_limits_are_the_tighter_ones() -> None:
    bench = Bench(safety=Safety(max_pressure=(2e5, 9e4, 1e4))).armed()
    np.testing.assert_array_equal(bench.gate.limits.high, [1.5e5, 9e4, 1e4])
    bench.refuses(
        PressureCommand(np.array([0, 9.5e4, 0]), bench.clock.t), "channel 2: 0.95 bar is out"
    )


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"slew": [1e5, 1e5]}, "slew: expected one value, or 3"),
        ({"slew": 0.0}, "slew: expected values above 0"),
        ({"slew": math.nan}, "slew: expected values above 0"),
        ({"safety": Safety(max_force=1.0)}, "needs the chambers' areas"),
        ({"force_per_pressure": [1e-5, -1e-5, 0]}, "force_per_pressure: expected values above"),
        ({"period": 0.0}, "period must be above 0 s"),
        ({"safety": Safety(max_pressure=(1e5, 1e5))}, r"safety\.max_pressure: expected one"),
    ],
)
def test_settings_that_do_not_fit(options: dict[str, Any], match: str) -> None:
    with pytest.raises(InputError, match=match):
        Bench(**options)


def test_closing_vents() -> None:
    bench = Bench().armed()
    bench.until(*HIGH)
    bench.gate.close()
    assert not bench.supply.commanded.any()
    assert not bench.supply.is_open
    assert not bench.gate.armed


def test_areas_of_the_channels() -> None:
    robot = load_description("stiff-flop-2")
    areas = robot.channel_areas
    assert len(areas) == robot.n_pressures
    assert areas[0] == pytest.approx(2 * math.pi * robot.segments[0].chambers.radius ** 2)


# limits of a task --------------------------------------------------------------------------------


def test_no_channel_rises_above_a_task_s_limit() -> None:
    bench = Bench().armed()
    bench.gate.restrict([1e4, 2e4, 9e9])
    applied = bench.until(5e4, 5e4, 5e4)
    np.testing.assert_array_equal(applied.pressures, [1e4, 2e4, 5e4])
    assert applied.limited
    bench.gate.restrict(HIGH)
    np.testing.assert_array_equal(bench.until(5e4, 5e4, 5e4).pressures, [5e4] * 3)


def test_what_is_above_a_new_task_s_limit_may_stay_and_fall_but_not_rise() -> None:
    bench = Bench().armed()
    bench.until(5e4, 5e4, 5e4)
    bench.gate.restrict([1e4, 1e4, 1e4])
    np.testing.assert_array_equal(bench.until(6e4, 5e4, 3e4).pressures, [5e4, 5e4, 3e4])
    np.testing.assert_array_equal(bench.until(6e4, 2e4, 3e4).pressures, [5e4, 2e4, 3e4])
    np.testing.assert_array_equal(bench.until(0.0, 3e4, 4e4).pressures, [0.0, 2e4, 3e4])
    np.testing.assert_array_equal(bench.until(6e4, 0.0, 0.0).pressures, [1e4, 0.0, 0.0])


def test_to_arm_begins_without_a_task_s_limit() -> None:
    bench = Bench().armed()
    bench.gate.restrict([0.0, 0.0, 0.0])
    assert not bench.until(5e4, 5e4, 5e4).pressures.any()
    bench.gate.vent()
    bench.armed()
    np.testing.assert_array_equal(bench.until(5e4, 5e4, 5e4).pressures, [5e4] * 3)


@pytest.mark.parametrize("high", [1e4, [1e4, 1e4], [1e4, math.nan, 1e4], [1e4, math.inf, 1e4]])
def test_a_task_s_limits_are_one_pressure_for_each_channel(high: Any) -> None:
    bench = Bench().armed()
    with pytest.raises(InputError, match="one highest pressure in Pa for each channel"):
        bench.gate.restrict(high)
    np.testing.assert_array_equal(bench.until(5e4, 5e4, 5e4).pressures, [5e4] * 3)


def test_a_short_rise_below_a_low_limit_is_no_set_point() -> None:
    """The supply's own clamp would make the low limit of it."""
    bench = Bench([1.9e4, 0.0, 0.0]).armed()
    for wait in (1e-7, 1e-6, 2e-6):
        applied = bench.ask(*HIGH, wait=wait)
        assert applied.pressures[0] == 0
        assert bench.supply.commanded[0] == 0


def test_the_last_instant_of_a_command_and_of_a_silence() -> None:
    bench = Bench(safety=Safety(command_timeout=0.5)).armed()
    bench.clock.t = 50.25  # what follows is exact in binary
    command = PressureCommand(np.zeros(3), 50.0, 0.25)
    assert not bench.gate.apply(command).refused
    assert not bench.gate.expire(50.75)
    assert bench.gate.armed
    assert bench.gate.expire(math.nextafter(50.75, 51))
    assert bench.gate.armed is False
    bench.armed()
    bench.clock.t = math.nextafter(50.25, 51)
    assert "expired" in bench.gate.apply(command).refused


def test_what_the_force_shortens_is_told() -> None:
    bench = Bench(safety=Safety(max_force=2.5), force_per_pressure=AREAS).armed()
    assert bench.ask(1e3, 1e3, 1e3).force_limited is False
    assert bench.ask(*HIGH).force_limited is False  # limited, but by its rate
    assert bench.until(*HIGH).force_limited is True
    assert Bench().armed().ask(*HIGH).force_limited is False


def test_a_gate_tells_whether_it_is_armed() -> None:
    bench = Bench()
    assert bench.gate.armed is False
    bench.armed()
    assert bench.gate.armed is True
    bench.gate.vent()
    assert bench.gate.armed is False
    bench.armed().supply.vent()
    bench.ask(*HIGH)
    assert bench.gate.armed is False
    bench.armed().gate.close()
    assert bench.gate.armed is False


def test_14_a_gate_that_was_told_no_period_takes_it_for_short() -> None:
    bench = Bench().armed()
    np.testing.assert_allclose(bench.ask(*HIGH, wait=0.4).pressures, 3 * 0.01 * SLEW)


def test_to_vent_is_tried_again_also_while_nobody_arms() -> None:
    bench = Bench()
    bench.supply.dead = "before"
    with pytest.raises(DeviceError):
        bench.gate.vent()
    bench.supply.dead = ""
    before = len(bench.supply.written)
    assert bench.gate.expire(bench.clock.t)
    assert len(bench.supply.written) == before + 1
    assert not bench.gate.expire(bench.clock.t)


def test_a_command_while_venting_fails_does_not_pass() -> None:
    bench = Bench().armed()
    bench.until(5e4, 5e4, 5e4)
    bench.supply.dead = "before"
    with pytest.raises(DeviceError):
        bench.gate.vent()
    bench.supply.dead = ""
    applied = bench.ask(*HIGH)
    assert "the supply was vented" in applied.refused
    assert not bench.supply.commanded.any()


def test_a_supply_that_cannot_be_vented_takes_no_command_either() -> None:
    bench = Bench().armed()
    bench.supply.dead = "before"
    with pytest.raises(DeviceError):
        bench.gate.vent()
    assert bench.gate.armed is False


def test_a_supply_that_cannot_be_armed_is_not() -> None:
    bench = Bench()
    bench.supply.dead = "before"
    with pytest.raises(DeviceError):
        bench.gate.arm()
    assert bench.gate.armed is False


def test_a_fall_that_the_supply_refuses_has_not_happened(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench().armed()
    bench.until(5e4, 5e4, 5e4)

    def refuse(_: Any) -> Any:
        raise CommandError("busy")

    with monkeypatch.context() as busy:
        busy.setattr(bench.supply, "exchange", refuse)
        assert bench.ask(0, 0, 0).refused == "busy"
    np.testing.assert_array_equal(bench.ask(5e4, 5e4, 5e4, wait=0.0).pressures, [5e4] * 3)


def test_nobody_else_gets_in_while_the_supply_is_told_something(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench().armed()
    free: list[bool] = []
    write = bench.supply._write

    def note(pressures: Any) -> None:
        with ThreadPoolExecutor(1) as other:
            free.append(other.submit(bench.gate._lock.acquire, blocking=False).result())
        write(pressures)

    monkeypatch.setattr(bench.supply, "_write", note)
    bench.ask(0, 0, 0)
    bench.gate.vent()
    bench.gate.arm()
    bench.clock.t += 1.0
    bench.gate.expire(bench.clock.t)
    bench.gate.close()
    bench.gate.open()
    assert free == [False] * 6


def rig(**about: Any) -> Any:
    clock = HandClock()
    robot = SimpleNamespace(channel_areas=AREAS)
    given = {"supply": FakeSupply(clock), "clock": clock, "robot": robot, "slew": SLEW}
    return SimpleNamespace(**{**given, **about})


def test_the_gate_of_a_rig() -> None:
    of, safety = rig(), Safety(max_force=2.5, max_pressure=9e4)
    gate = gate_before(of, safety, 0.02)
    assert gate.supply is of.supply
    assert gate.clock is of.clock
    np.testing.assert_array_equal(gate.limits.high, [9e4] * 3)
    gate.open()
    gate.arm()
    of.clock.t += 0.4
    applied = gate.apply(PressureCommand(np.full(3, 9e4), of.clock.t))
    np.testing.assert_allclose(applied.pressures, 3 * 0.02 * SLEW)
    for _ in range(100):
        of.clock.t += 0.02
        applied = gate.apply(PressureCommand(np.full(3, 9e4), of.clock.t))
    assert float(AREAS @ applied.pressures) == pytest.approx(2.5)
    with pytest.raises(InputError, match="has a gate before it already"):
        gate_before(rig(supply=object()), safety, 0.02)


def test_25_a_rig_without_rates_has_one() -> None:
    slew = effective_slew(rig(slew=np.array([1e5, math.inf, math.nan])))
    np.testing.assert_array_equal(slew, [1e5, COMMANDS.default_slew, COMMANDS.default_slew])
    np.testing.assert_array_equal(effective_slew(rig()), SLEW)
    assert COMMANDS.default_slew == 5e5


@pytest.mark.parametrize("protects", ["is_simulated", "has_watchdog", "has_dump_valve", ""])
def test_a_supply_that_nothing_vents_is_refused_unless_that_is_accepted(protects: str) -> None:
    names = ("is_simulated", "has_watchdog", "has_dump_valve")
    supply: Any = SimpleNamespace(**{name: name == protects for name in names})
    accepted = Safety(unprotected_supply="accepted")
    check_protection(supply, accepted)
    if protects:
        check_protection(supply, Safety())
        return
    with pytest.raises(CommandError, match=r"safety: \{unprotected_supply: accepted\}$"):
        check_protection(supply, Safety())
