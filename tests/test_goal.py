"""Goals: approached, repeated, let down and vented, on a clock that is moved by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fake_supply import HIGH, SLEW
from goal_bench import PERIOD, RAMP, Bench
from stiffopt.errors import CommandError
from stiffopt.rig.interface import PressureCommand, PressureLimits
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import let_down
from stiffopt.safety.goal import GoalFollower, GoalSupply, TickingClock

# -- a goal is approached -------------------------------------------------------------------------


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


def test_a_goal_is_approached_to_the_last_instant() -> None:
    bench = Bench().armed()
    bench.clock.sleep_until(64.0)
    bench.goal(*HIGH, valid_for=1.0 / 64)
    before = bench.device.commanded
    bench.hand.t = 64.0 + 1.0 / 64
    bench.follower.tick()
    np.testing.assert_allclose(bench.device.commanded, before + SLEW / 64)


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


# -- it expires -----------------------------------------------------------------------------------


EXPIRED = "no command came for as long as the last one was valid, so the pressures were let down"


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
