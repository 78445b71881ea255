"""Whoever commands, by whatever driver: no limit is exceeded, and the arm ends vented.

The contract runs over all ways to command an arm and all drivers, a third-party one included; see
`commanding.py`. All of it is on an injected clock. `test_commanding_processes.py` has the same with
real processes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from commanding import DRIVERS, LIMITS, PERIOD, WAYS, Bench, N, Way
from stiffopt.errors import DeviceError, StiffoptError
from stiffopt.rig.registry import driver_names


def test_every_driver_of_a_supply_is_held_to_the_contract() -> None:
    for driver in set(driver_names("supply")) - {"line"}:  # which is the third party
        assert any(name.startswith(driver) for name in DRIVERS), driver


@pytest.fixture(params=DRIVERS)
def driver(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def rough(seed: int, high: float, more: int = 30) -> Iterator[Any]:
    """Yield what a careless or broken program may ask for, and so many random commands more."""
    random = np.random.default_rng(seed)
    yield np.full(N, high)
    yield np.full(N, 10 * high)
    yield np.array([np.nan, high, 0.0])
    yield np.zeros(N)
    yield np.array([high, 0.0, high])
    yield np.full(N, np.inf)
    yield -np.full(N, high)
    yield np.full(N, high)
    for _ in range(more):
        yield random.uniform(-0.2, 1.2, N) * high


@pytest.mark.one_in(6, "driver", "way")
@pytest.mark.parametrize(
    ("way", "limit"),
    [(way, limit) for way in WAYS for limit in LIMITS if limit != "task" or way == "control-loop"],
)
def test_no_limit_is_exceeded_and_the_arm_is_vented(driver: str, way: str, limit: str) -> None:
    with DRIVERS[driver](LIMITS[limit]) as bench:
        who = WAYS[way](bench)
        who.start()
        highest = press(who, bench)
        for wanted in rough(1, 1.5e5):
            who.push(wanted)
        who.finish()
        bench.check()
        assert not bench.last.any()
        assert highest > 0.5 * expected(bench), "the arm was hardly ever under pressure"


def press(who: Way, bench: Bench, ticks: int = 100) -> float:
    """Go as high as the limits let us, within so many ticks; return how high that was, in Pa."""
    high, reached, same = bench.limits.high, 0.0, 0
    for _ in range(ticks):
        who.push(np.full(N, high))
        before, reached = reached, float(bench.last.max())
        same = same + 1 if reached == before else 0
        if same == 10:  # it is as high as it gets
            break
    return reached


def expected(bench: Bench) -> float:
    """Return what the highest channel should have after `press`, roughly, in Pa."""
    limits = bench.limits
    found = [limits.high, 0.8 * limits.slew]
    if limits.force is not None:
        from commanding import AREAS

        found.append(limits.force / AREAS.sum())
    return min(found)


# single failures ---------------------------------------------------------------------------------


class Fails:
    """Makes a method of a supply fail some times, before or after it has done its work."""

    def __init__(self, supply: Any, names: tuple[str, ...], when: str, times: int) -> None:
        self.left = times
        for name in names:
            self._wrap(supply, name, when)

    def _wrap(self, supply: Any, name: str, when: str) -> None:
        real = getattr(supply, name)

        def failing(*args: Any, **options: Any) -> Any:
            if self.left <= 0:
                return real(*args, **options)
            self.left -= 1
            if when == "after":
                real(*args, **options)
            raise DeviceError("it does not answer")

        setattr(supply, name, failing)


def a_write_fails(who: Way, bench: Bench) -> None:
    Fails(bench.supply, ("_write", "_exchange"), "before", 1)


def an_answer_is_lost(who: Way, bench: Bench) -> None:
    Fails(bench.supply, ("_write", "_exchange"), "after", 1)


def writes_fail_for_a_while(who: Way, bench: Bench) -> None:
    Fails(bench.supply, ("_write", "_exchange"), "before", 4)


def a_reading_fails(who: Way, bench: Bench) -> None:
    Fails(bench.supply, ("_read", "_exchange"), "after", 1)


def the_client_falls_silent(who: Way, bench: Bench) -> None:
    who.rest(3.0)
    assert not bench.last.any(), "nobody commands, and the arm is still under pressure"


def the_client_goes(who: Way, bench: Bench) -> None:
    who.finish()
    assert not bench.last.any()


def the_clock_jumps(who: Way, bench: Bench) -> None:
    bench.clock.sleep(20.0)  # the computer was asleep: nobody ticked


def the_commands_make_no_sense(who: Way, bench: Bench) -> None:
    for wanted in (np.full(N, np.nan), np.full(N, 1e9), -np.full(N, 1e9), np.full(N, np.inf)):
        who.push(wanted)


def someone_vents_the_supply(who: Way, bench: Bench) -> None:
    bench.supply.vent()


FAILURES = {
    f.__name__: f
    for f in (
        a_write_fails,
        an_answer_is_lost,
        writes_fail_for_a_while,
        a_reading_fails,
        the_client_falls_silent,
        the_client_goes,
        the_clock_jumps,
        the_commands_make_no_sense,
        someone_vents_the_supply,
    )
}


@pytest.mark.one_in(6)
@pytest.mark.parametrize("failure", FAILURES)
@pytest.mark.parametrize("way", WAYS)
def test_a_single_failure_ends_vented_and_within_the_limits(
    driver: str, way: str, failure: str
) -> None:
    with DRIVERS[driver](LIMITS["all"]) as bench:
        who = WAYS[way](bench)
        who.start()
        assert press(who, bench, ticks=30) > 0
        FAILURES[failure](who, bench)
        for wanted in rough(2, 1.5e5, more=6):
            with suppress(StiffoptError):
                who.push(wanted, 2 * PERIOD)
        who.finish()
        bench.check()
        assert not bench.last.any()
