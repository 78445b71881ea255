"""Goals: approached, repeated, let down and vented, on a clock that is moved by hand."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from fake_supply import HIGH, SLEW, FakeSupply, HandClock
from stiffopt.errors import CommandError, DeviceError
from stiffopt.rig.interface import PressureCommand, PressureLimits
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import SafetyGate, let_down
from stiffopt.safety.goal import GoalFollower, GoalSupply, TickingClock, check_goal
from stiffopt.safety.settings import COMMANDS

Array = NDArray[np.float64]

PERIOD = 0.01
RAMP = 0.5
EXPIRED = "no command came for as long as the last one was valid, so the pressures were let down"


class Bench:
    """A follower over a gate and a fake supply, and how programs see it."""

    def __init__(self, low: ArrayLike = 0.0, **safety: Any) -> None:
        self.hand = HandClock()
        self.device = FakeSupply(self.hand, low)
        self.gate = SafetyGate(
            self.device,
            slew=safety.pop("slew", SLEW),
            safety=Safety(**safety),
            force_per_pressure=None,
            clock=self.hand,
            period=PERIOD,
        )
        self.follower = GoalFollower(self.gate, period=PERIOD, ramp_time=RAMP, clock=self.hand)
        self.clock = TickingClock(self.hand, self.follower)
        self.supply = GoalSupply(self.follower, self.clock)
        self.supply.open()

    def armed(self) -> Bench:
        self.supply.arm()
        return self

    def pressed(self, *p: float, valid_for: float = 100.0) -> Bench:
        """Armed, and arrived at a goal."""
        self.armed().goal(*p, valid_for=valid_for)
        self.clock.sleep(3.0)
        np.testing.assert_array_equal(self.device.commanded, p)
        return self

    def goal(self, *p: float, valid_for: float = 100.0, age: float = 0.0) -> None:
        self.supply.command(PressureCommand(np.array(p), self.clock.now() - age, valid_for))

    def vented(self) -> bool:
        told = not self.device.commanded.any() and not self.supply.commanded.any()
        return told and not self.device.armed and not self.supply.armed

    def steps(self, seconds: float) -> list[tuple[float, Array]]:
        """Let time pass, and return when the set-points were written, and which."""
        told: list[tuple[float, Array]] = []
        end = self.hand.t + seconds
        while self.hand.t < end - 1e-9:
            before = len(self.device.written)
            self.clock.sleep_until(min(end, max(self.hand.t, self.follower.due) + 1e-9))
            told += [(self.hand.t, written) for written in self.device.written[before:]]
            if self.follower.due > end:
                break
        self.clock.sleep_until(end)
        return told


# a goal is approached ----------------------------------------------------------------------------


def test_a_goal_is_approached_and_kept() -> None:
    bench = Bench().armed()
    assert bench.supply.armed
    bench.goal(1e5, 5e4, 3e4)
    first = bench.device.commanded
    np.testing.assert_array_equal(first, [0, 0, 0])  # no time has passed since it was armed
    bench.clock.sleep(0.5)
    np.testing.assert_array_equal(bench.supply.commanded, [1e5, 5e4, 3e4])
    np.testing.assert_array_equal(bench.device.commanded, [1e5, 5e4, 3e4])
    reading = bench.supply.read()
    np.testing.assert_array_equal(reading.pressures, np.array([1e5, 5e4, 3e4]) + 7)


def test_to_command_and_read_at_once() -> None:
    bench = Bench().armed()
    bench.clock.sleep(0.1)
    reading = bench.supply.exchange(PressureCommand(np.full(3, 2e3), bench.clock.now()))
    np.testing.assert_array_equal(reading.pressures, bench.device.commanded + 7)
    assert bench.device.commanded.any()


def test_14_a_goal_is_never_approached_faster_than_may_be() -> None:
    bench = Bench().armed()
    bench.goal(*HIGH)
    before, at = np.zeros(3), bench.hand.t
    steps = bench.steps(2.0)
    bench.goal(0, 0, 0)
    steps += bench.steps(2.0)
    assert len(steps) >= 395
    for now, told in steps:
        assert (np.abs(told - before) <= SLEW * (now - at) + 1e-6).all()
        assert ((told >= 0) & (told <= HIGH)).all()
        before, at = told, now
    assert any((told == HIGH).all() for _, told in steps)
    assert not steps[-1][1].any()


def test_a_goal_is_repeated_in_each_period_while_it_is_valid() -> None:
    bench = Bench().pressed(3e4, 2e4, 1e4)
    steps = bench.steps(5.0)
    times = [now for now, _ in steps]
    np.testing.assert_allclose(np.diff(times), PERIOD, atol=1e-6)
    assert len(times) >= 499
    assert all(told.tolist() == [3e4, 2e4, 1e4] for _, told in steps)


def test_who_commands_in_each_period_is_not_repeated() -> None:
    bench = Bench().armed()
    before = len(bench.device.written)
    for _ in range(100):
        bench.goal(2e4, 2e4, 2e4)
        assert bench.follower.due == pytest.approx(bench.hand.t + 1.5 * PERIOD)
        bench.clock.sleep(PERIOD)
    assert len(bench.device.written) - before == 100


def test_a_goal_is_replaced() -> None:
    bench = Bench().pressed(3e4, 3e4, 3e4, valid_for=4.0)
    bench.goal(1e4, 5e4, 3e4, valid_for=50.0)
    bench.clock.sleep(10.0)  # the last one's end is no more
    np.testing.assert_array_equal(bench.device.commanded, [1e4, 5e4, 3e4])
    bench.goal(2e4, 2e4, 2e4, valid_for=0.2)
    bench.clock.sleep(10.0)  # and neither is a later one's
    assert bench.vented()


def test_plain_pressures_hold_for_half_a_second() -> None:
    bench = Bench(slew=1e9).armed()
    bench.clock.sleep(PERIOD)
    bench.supply.command([2e4, 2e4, 2e4])
    bench.clock.sleep(0.5)
    np.testing.assert_array_equal(bench.device.commanded, [2e4, 2e4, 2e4])
    bench.clock.sleep(RAMP + 2 * PERIOD)
    assert bench.vented()


# it expires --------------------------------------------------------------------------------------


def test_an_expired_goal_is_let_down_and_vented_and_told() -> None:
    p = np.array([3e4, 2e4, 1e4])
    bench = Bench().armed()
    began = bench.hand.t
    bench.goal(*p, valid_for=2.0)
    steps = bench.steps(4.0)
    for now, told in steps:
        late = now - began - 2.0
        if now - began > 1.0 and late <= 0:
            np.testing.assert_array_equal(told, p)
        if late > 1e-6:
            share = max(0.0, 1 - late / RAMP)
            np.testing.assert_allclose(told, p * share, rtol=1e-6, atol=1e-3)
    falling = [told for now, told in steps if now - began > 2.0 + 1e-6]
    assert len(falling) == pytest.approx(RAMP / PERIOD, abs=2)
    assert not falling[-1].any()
    assert steps[-1][0] - began <= 2.0 + RAMP + 2 * PERIOD
    assert bench.vented()
    assert bench.follower.due == math.inf
    bench.follower.tick()  # one that comes late does nothing, and forgets nothing
    with pytest.raises(CommandError, match=EXPIRED):
        bench.goal(1e4, 1e4, 1e4)
    assert bench.vented()


def test_a_goal_holds_to_the_last_instant() -> None:
    bench = Bench(command_timeout=10.0).pressed(3e4, 3e4, 3e4)
    bench.clock.sleep_until(64.0)  # and all moments after it, too, are exact in binary
    bench.goal(3e4, 3e4, 3e4, valid_for=1.0)
    bench.hand.t = 65.0
    bench.follower.tick()
    np.testing.assert_array_equal(bench.device.commanded, [3e4] * 3)
    bench.hand.t = 65.0 + 2.0**-20
    bench.follower.tick()
    np.testing.assert_allclose(bench.device.commanded, 3e4 * (1 - 2.0**-20 / RAMP), rtol=1e-12)
    assert bench.supply.armed


def test_letting_down_ends_with_venting_at_the_last_instant() -> None:
    bench = Bench(slew=1e9, command_timeout=10.0).pressed(3e4, 3e4, 3e4)
    bench.clock.sleep_until(64.0)
    bench.goal(3e4, 3e4, 3e4, valid_for=1.0)
    bench.hand.t = 65.0 + 0.5 * RAMP
    bench.follower.tick()
    np.testing.assert_allclose(bench.device.commanded, 1.5e4)
    bench.hand.t = 65.0 + RAMP - 2.0**-20
    bench.follower.tick()
    assert bench.device.commanded.all()
    assert bench.device.armed
    assert bench.follower.due == bench.hand.t + PERIOD
    bench.hand.t = 65.0 + RAMP
    bench.follower.tick()
    assert bench.vented()


def test_an_expired_goal_without_pressure_is_vented_at_once() -> None:
    bench = Bench().armed()
    bench.goal(0, 0, 0, valid_for=0.2)
    bench.clock.sleep(0.2 + 2 * PERIOD)
    assert bench.vented()


def test_the_age_of_a_goal_counts() -> None:
    bench = Bench().pressed(1e4, 1e4, 1e4)
    bench.goal(1e4, 1e4, 1e4, valid_for=0.2, age=0.15)
    bench.clock.sleep(0.1)
    assert (bench.device.commanded < 1e4).all()
    assert bench.supply.armed
    bench.clock.sleep(RAMP)
    assert bench.vented()


def test_a_goal_that_comes_while_pressures_are_let_down_is_approached_from_there() -> None:
    bench = Bench().pressed(3e4, 3e4, 3e4, valid_for=4.0)
    bench.clock.sleep(1.0 + 0.5 * RAMP)
    low = bench.device.commanded
    assert ((low > 1e4) & (low < 2e4)).all()
    bench.goal(3e4, 3e4, 3e4, valid_for=1.0)
    assert (bench.device.commanded <= low + 2 * PERIOD * SLEW + 1e-6).all()
    bench.clock.sleep(1.0)
    np.testing.assert_array_equal(bench.device.commanded, [3e4] * 3)
    bench.clock.sleep(0.5 * RAMP)  # let down from there once more, not from where it was before
    np.testing.assert_allclose(bench.device.commanded, 1.5e4, rtol=0.1)
    assert bench.supply.armed
    bench.clock.sleep(RAMP)
    assert bench.vented()


def test_a_lower_goal_that_comes_while_pressures_are_let_down_never_rises_again() -> None:
    bench = Bench().pressed(6e4, 6e4, 6e4, valid_for=4.0)
    bench.clock.sleep(1.0 + 0.5 * RAMP)
    bench.goal(1e4, 1e4, 1e4, valid_for=1.0)
    before = bench.device.commanded
    for _, told in bench.steps(1.0 + RAMP + 0.1):
        assert (told <= before).all()
        before = told
    assert bench.vented()


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


def test_a_supply_that_cannot_be_vented_is_pressed_no_more() -> None:
    bench = Bench().pressed(3e4, 3e4, 3e4)
    bench.device.dead = "before"
    with pytest.raises(DeviceError):
        bench.supply.vent()
    assert bench.follower.due == math.inf
    assert not bench.supply.armed


def test_a_goal_that_expires_on_its_way_is_let_down_from_where_it_was() -> None:
    bench = Bench().armed()
    bench.goal(*HIGH, valid_for=0.1)
    bench.clock.sleep(0.1)
    reached = bench.device.commanded
    assert (reached < HIGH).all()
    assert all((told <= reached).all() for _, told in bench.steps(1.0))
    assert bench.vented()


def test_a_low_limit_above_zero_is_left_when_pressures_are_let_down() -> None:
    bench = Bench([1.9e4, 0, 0]).pressed(4e4, 4e4, 3e4, valid_for=4.0)
    for _, told in bench.steps(1.0 + RAMP + 0.1):
        assert told[0] == 0 or told[0] >= 1.9e4
    assert bench.vented()


def test_a_command_after_too_long_a_pause_is_told_why() -> None:
    """As if this process had been stopped: nobody ticked, and the gate has had enough."""
    bench = Bench(command_timeout=0.3).pressed(3e4, 3e4, 3e4)
    bench.hand.t += 0.4
    with pytest.raises(CommandError, match=r"no command came for 0\.3 s"):
        bench.goal(3e4, 3e4, 3e4)
    assert bench.vented()
    bench.clock.sleep(1.0)
    with pytest.raises(CommandError, match=r"no command came for 0\.3 s"):
        bench.goal(3e4, 3e4, 3e4)
    assert bench.vented()


def test_a_tick_after_too_long_a_pause_vents_and_tells_why() -> None:
    bench = Bench(command_timeout=0.3).pressed(3e4, 3e4, 3e4)
    bench.hand.t += 0.4
    bench.follower.tick()
    assert bench.vented()
    assert bench.follower.due == math.inf
    with pytest.raises(CommandError, match=r"no command came for 0\.3 s"):
        bench.goal(3e4, 3e4, 3e4)


def test_a_goal_is_approached_to_the_last_instant() -> None:
    bench = Bench().armed()
    bench.clock.sleep_until(64.0)
    bench.goal(*HIGH, valid_for=1.0 / 64)
    before = bench.device.commanded
    bench.hand.t = 64.0 + 1.0 / 64
    bench.follower.tick()
    np.testing.assert_allclose(bench.device.commanded, before + SLEW / 64)


@pytest.mark.parametrize(
    ("share", "expected"),
    [(1.0, 4e4), (0.5, 2e4), (0.0, 0.0), (-3.0, 0.0), (1.5, 4e4), (math.inf, 4e4)],
)
def test_a_share_of_pressures(share: float, expected: float) -> None:
    limits = PressureLimits(np.array([0.0, -5e4, 0.0]), HIGH)
    np.testing.assert_array_equal(let_down(np.full(3, 4e4), share, limits), [expected] * 3)


def test_a_share_of_pressures_with_a_low_limit_above_zero() -> None:
    limits = PressureLimits(np.array([2e4, -2e4, 0.0]), HIGH)
    at = np.array([4e4, -2e4, 4e4])
    np.testing.assert_array_equal(let_down(at, 0.5, limits), [2e4, -1e4, 2e4])
    np.testing.assert_array_equal(let_down(at, 0.25, limits), [0.0, -5e3, 1e4])


# which goals are taken ---------------------------------------------------------------------------

LIMITS = PressureLimits(np.zeros(3), HIGH)


@pytest.mark.parametrize(
    "valid_for", [math.nextafter(0.0, 1.0), 1e-3, 0.5, 60.0, COMMANDS.longest_goal]
)
def test_goals_that_are_valid_for_long_enough(valid_for: float) -> None:
    goal = PressureCommand(np.full(3, 1e4), 0.0, valid_for)
    np.testing.assert_array_equal(check_goal(goal, 0.0, LIMITS), [1e4] * 3)


@pytest.mark.parametrize(
    "valid_for",
    [
        math.nan,
        math.inf,
        -math.inf,
        0.0,
        -0.0,
        -1.0,
        math.nextafter(COMMANDS.longest_goal, 1e9),
        1e5,
    ],
)
def test_goals_that_are_not_valid_for_any_such_time(valid_for: float) -> None:
    bench = Bench().pressed(1e4, 1e4, 1e4)
    for take in (bench.supply.command, bench.follower.pursue):
        with pytest.raises(CommandError, match="more than 0 s and at most 3600 s, not "):
            take(PressureCommand(np.full(3, 2e4), bench.hand.t, valid_for))
    bench.clock.sleep(1.0)
    np.testing.assert_array_equal(bench.device.commanded, [1e4] * 3)


@pytest.mark.parametrize("age", [0.0, 0.3, 0.5])
def test_goals_that_have_not_expired(age: float) -> None:
    goal = PressureCommand(np.full(3, 1e4), 8.0 - age, 0.5)
    np.testing.assert_array_equal(check_goal(goal, 8.0, LIMITS), [1e4] * 3)


@pytest.mark.parametrize("age", [math.nextafter(0.5, 1), 0.6, -1e-9, -1.0, math.nan, math.inf])
def test_goals_that_have_expired_or_are_from_the_future(age: float) -> None:
    bench = Bench().pressed(1e4, 1e4, 1e4)
    bench.hand.t = 0.0
    for take in (bench.supply.command, bench.follower.pursue):
        with pytest.raises(CommandError, match="has expired; nothing was written"):
            take(PressureCommand(np.full(3, 2e4), -age, 0.5))


def test_the_longest_goal_is_kept_that_long() -> None:
    bench = Bench(command_timeout=10.0).pressed(1e4, 1e4, 1e4)
    bench.goal(1e4, 1e4, 1e4, valid_for=COMMANDS.longest_goal)
    for _ in range(400):
        bench.hand.t += COMMANDS.longest_goal / 400 - 1e-6
        bench.follower.tick()
        np.testing.assert_array_equal(bench.device.commanded, [1e4] * 3)
    bench.clock.sleep(RAMP + 1.0)
    assert bench.vented()


@pytest.mark.parametrize(
    ("pressures", "match"),
    [
        ([1.6e5, 0, 0], "channel 1: 1.6 bar is out of range"),
        ([0, -1e3, 0], "channel 2: -0.01 bar is out of range"),
        ([0, 0, math.nan], "channel 3: nan is not"),
        ([1e4, 1e4], "expected 3 pressures"),
        (None, "expected one pressure in Pa"),
    ],
)
def test_13_goals_out_of_range_are_refused(pressures: Any, match: str) -> None:
    bench = Bench().pressed(1e4, 1e4, 1e4)
    command = PressureCommand(pressures, bench.hand.t)
    for take in (bench.supply.command, bench.supply.exchange, bench.follower.pursue):
        with pytest.raises(CommandError, match=match):
            take(command)
    bench.clock.sleep(1.0)
    np.testing.assert_array_equal(bench.device.commanded, [1e4] * 3)


def test_13_the_limits_are_those_of_the_gate() -> None:
    bench = Bench(max_pressure=(5e4, 9e4, 1e4))
    np.testing.assert_array_equal(bench.supply.limits.high, [5e4, 9e4, 1e4])
    bench.armed()
    with pytest.raises(CommandError, match=r"channel 1: 0\.6 bar is out of range"):
        bench.goal(6e4, 0, 0)


def test_what_is_refused_does_not_even_reach_the_outlet(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench().armed()
    reached: list[object] = []
    monkeypatch.setattr(bench.follower, "pursue", reached.append)
    with pytest.raises(CommandError):
        bench.goal(9e9, 0, 0)
    with pytest.raises(CommandError):
        bench.goal(0, 0, 0, valid_for=math.nan)
    assert not reached


def test_a_goal_that_the_supply_refuses_leaves_the_last_one() -> None:
    bench = Bench().pressed(3e4, 3e4, 3e4, valid_for=5.0)
    wide = bench.device.limits
    bench.device.limits = PressureLimits(np.zeros(3), np.full(3, 3.0e4))
    with pytest.raises(CommandError, match="out of range"):
        bench.goal(4e4, 4e4, 4e4, valid_for=50.0)
    bench.device.limits = wide
    bench.clock.sleep(1.0)
    np.testing.assert_array_equal(bench.device.commanded, [3e4] * 3)
    bench.clock.sleep(1.0 + RAMP + 2 * PERIOD)  # and its end
    assert bench.vented()


def test_a_goal_that_is_refused_while_pressures_are_let_down_changes_nothing() -> None:
    bench = Bench().pressed(3e4, 3e4, 3e4, valid_for=4.0)
    bench.clock.sleep(1.0 + 0.5 * RAMP)
    wide = bench.device.limits
    bench.device.limits = PressureLimits(np.zeros(3), np.full(3, 1e3))
    with pytest.raises(CommandError, match="out of range"):
        bench.goal(4e4, 4e4, 4e4, valid_for=50.0)
    bench.device.limits = wide
    bench.clock.sleep(0.5 * RAMP + 2 * PERIOD)
    assert bench.vented()


# arming, venting, opening and closing ------------------------------------------------------------


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


def test_a_supply_that_somebody_else_vented_rests() -> None:
    bench = Bench().pressed(3e4, 3e4, 3e4)
    bench.gate.vent()
    bench.clock.sleep(1.0)
    assert bench.vented()
    assert bench.follower.due == math.inf
    with pytest.raises(CommandError, match="arm it first"):
        bench.goal(3e4, 3e4, 3e4)


def test_a_device_that_was_vented_behind_the_gate_rests() -> None:
    bench = Bench().pressed(3e4, 3e4, 3e4)
    bench.device.vent()
    bench.clock.sleep(1.0)
    assert bench.vented()
    with pytest.raises(CommandError, match="vented"):
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


# a supply that fails -----------------------------------------------------------------------------


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


# the clock ---------------------------------------------------------------------------------------


def test_the_clock_stops_at_each_tick_and_ends_where_it_should() -> None:
    bench = Bench().armed()
    begin = bench.hand.t
    seen: list[float] = []
    tick = bench.follower.tick

    def ticked() -> None:
        seen.append(bench.clock.now() - begin)
        tick()

    bench.follower.tick = ticked  # type: ignore[method-assign]
    bench.clock.sleep_until(begin + 0.105)
    assert bench.clock.now() == begin + 0.105
    np.testing.assert_allclose(seen, [0.01 * i for i in range(1, 11)])
    bench.clock.sleep_until(bench.follower.due)  # what is due at the end is left for the next
    assert len(seen) == 10
    bench.clock.sleep(1e-6)
    assert len(seen) == 11
    bench.supply.vent()
    bench.clock.sleep(100.0)
    assert len(seen) == 11


# a rig's own ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("period", "often"), [(0.5, 0.1), (0.02, 0.02)])
def test_a_slow_rig_repeats_goals_before_they_are_too_old(period: float, often: float) -> None:
    bench = Bench()
    safety = Safety(command_timeout=0.4, ramp_time=0.7)
    bench.follower = GoalFollower.before(bench.gate, safety, period, bench.hand)
    bench.clock = TickingClock(bench.hand, bench.follower)
    bench.supply = GoalSupply(bench.follower, bench.clock)
    bench.supply.open()
    bench.armed()
    assert bench.follower.due == pytest.approx(bench.hand.t + often)
    bench.goal(1e4, 1e4, 1e4, valid_for=5.0)
    bench.clock.sleep(4.9)
    assert bench.supply.armed
    np.testing.assert_array_equal(bench.device.commanded, [1e4] * 3)
    bench.clock.sleep(0.1 + 0.35)
    np.testing.assert_allclose(bench.device.commanded, [5e3] * 3, atol=2e3)
    bench.clock.sleep(0.6)
    assert bench.vented()


def test_text_is_no_time() -> None:
    bench = Bench().armed()
    goal = PressureCommand(np.zeros(3), bench.clock.now(), "3")  # type: ignore[arg-type]
    with pytest.raises(CommandError, match="expected a number of seconds for valid_for"):
        bench.supply.command(goal)
