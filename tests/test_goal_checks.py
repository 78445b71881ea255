"""Which goals are taken: within the limits, and valid for a while that has not passed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from fake_supply import HIGH
from goal_bench import PERIOD, RAMP, Bench
from stiffopt.errors import CommandError
from stiffopt.rig.interface import PressureCommand, PressureLimits
from stiffopt.safety.goal import check_goal
from stiffopt.safety.settings import COMMANDS

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


def test_text_is_no_time() -> None:
    bench = Bench().armed()
    goal = PressureCommand(np.zeros(3), bench.clock.now(), "3")  # type: ignore[arg-type]
    with pytest.raises(CommandError, match="expected a number of seconds for valid_for"):
        bench.supply.command(goal)


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
