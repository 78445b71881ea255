"""Histories along whole logs: as a memory in fine steps has them; derivatives by differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt.identify import past
from stiffopt.identify.past import Effective, Past, Start, pause_between
from stiffopt.identify.settings import FIT
from stiffopt.model.history import Creep, History, Memory, Part, Play

Array = NDArray[np.float64]

KPA = 1e3
PLAYS = (Play(width=4 * KPA, share=0.2), Play(width=15 * KPA, share=0.15))
CREEPS = (Creep(time=0.7, share=0.1), Creep(time=20.0, share=0.05))
FULL = History(
    dead_time=0.1313,
    lag=0.3,
    lag_falling=0.7,
    memory=(0.5, 1.2, 0.9),
    play=PLAYS,
    creep=CREEPS,
)
PARTS = FULL.model_copy(  # of pressure, of elongation and of bending
    update={
        "play": (PLAYS[0].model_copy(update={"of": "bending"}), PLAYS[1]),
        "creep": (CREEPS[0], CREEPS[1].model_copy(update={"of": "elongation"})),
    }
)
SOFT = PARTS.model_copy(update={"softening": -4e-6})
STRAIN = SOFT.model_copy(
    update={
        "remembers": "strain",
        "play": (PLAYS[0].model_copy(update={"of": "opposite"}), PLAYS[1]),
    }
)
KINDS = {
    "none": History(),
    "lag": History(lag=0.3),
    "two lags": History(lag=0.3, lag_falling=0.6),
    "play": History(play=PLAYS),
    "creep": History(creep=CREEPS),
    "lag and creep": History(lag=0.2, creep=CREEPS),
    "lag, creep and dead time": History(lag=0.2, creep=CREEPS, dead_time=0.132),
    "all but dead time": FULL.model_copy(update={"dead_time": 0.0}),
    "all": FULL,
    "elongation": History(play=[play.model_copy(update={"of": "elongation"}) for play in PLAYS]),
    "parts": PARTS,
    "softening": SOFT,
    "strain": STRAIN,
}
SHARES = ("play[0].share", "play[1].share", "creep[0].share", "creep[1].share")
SIDES = np.array([0.5, -0.2, 0.1])
EVERYWHERE = 1e6 * np.array([[-1.0] * 3, [1.0] * 3])  # visited pressures, in Pa
FINE = 2e-3  # s


def course(count: int, seed: int = 0, even: float | None = None) -> tuple[Array, Array]:
    """Times (N,) and pressures (N, 3): sums of sines, so that all turn many times."""
    random = np.random.default_rng(seed)
    steps = np.full(count, even) if even else FINE * random.integers(20, 60, count)
    time = 3.0 + np.cumsum(steps)
    phase = random.uniform(0, 2 * np.pi, (3, 3))
    rates = np.array([0.9, 2.3, 0.17])
    waves = np.sin(time[:, None, None] * rates + phase) @ [12 * KPA, 5 * KPA, 20 * KPA]
    return time, 40 * KPA + waves


def run(history: History, time: Array, pressures: Array, start: Start | None = None) -> Effective:
    """Effective pressures in every row."""
    begun = start or Start.from_rest(history, pressures[0])
    every = np.arange(len(time))
    return Past(history, pressures.shape[1]).effective(time, pressures, every, begun, history)


def in_fine_steps(history: History, time: Array, pressures: Array, before: Array) -> Array:
    """The same (N, c) by a memory, from rest at pressures (c,), under commands that run evenly."""
    memory = Memory([history] * pressures.shape[1], places=range(pressures.shape[1]))
    memory.start(before)
    first = time[0] - np.median(np.diff(time))
    knots, values = np.concatenate([[first], time]), np.vstack([before, pressures])
    count = round((time[-1] - first) / FINE)
    middles = first + FINE * (np.arange(count) + 0.5)
    commands = np.column_stack([np.interp(middles, knots, column) for column in values.T])
    effective = memory.run(FINE, commands)
    return np.asarray(effective[np.round((time - first) / FINE).astype(int) - 1])


@pytest.mark.parametrize("kind", KINDS)
def test_along_a_log_it_is_what_a_memory_does_in_fine_steps(kind: str) -> None:
    history = KINDS[kind]
    time, pressures = course(250)
    before = np.array([60.0, 10.0, 30.0]) * KPA
    found = run(history, time, pressures, Start.from_rest(history, before)).pressures
    expected = in_fine_steps(history, time, pressures, before)
    # rows are 0.08 s apart; what turns between two of them is met by interpolation
    exact = history.lag and not (history.play or history.lag_falling)
    assert found == pytest.approx(expected, abs=2.0 if exact else 300.0)
    assert np.sqrt(np.mean((found - expected) ** 2)) < 50.0
    if kind != "none":
        assert np.abs(found - pressures).max() > 1 * KPA


def test_a_dead_time_of_whole_rows_moves_the_answer_by_these_rows() -> None:
    time, pressures = course(300, even=0.05)
    now = KINDS["all but dead time"]
    late = now.model_copy(update={"dead_time": 0.25})  # longer than a row
    there, then = run(now, time, pressures).pressures, run(late, time, pressures).pressures
    assert then[5:] == pytest.approx(there[:-5], abs=1e-6)
    assert then[:5] == pytest.approx(np.tile(then[0], (5, 1)), abs=10 * KPA)
    assert in_fine_steps(late, time, pressures, pressures[0]) == pytest.approx(then, abs=200.0)


def test_a_step_of_pressure_arrives_a_dead_time_and_a_lag_later() -> None:
    history = History(dead_time=0.3, lag=0.4)
    time = 0.01 * np.arange(300)
    pressures = np.full((300, 1), 50 * KPA)
    start = Start.from_rest(history, np.zeros(1))
    found = run(history, time, pressures, start).pressures[:, 0]
    expected = 50 * KPA * (1 - np.exp(-np.maximum(time + 0.005 - 0.3, 0) / 0.4))
    assert found == pytest.approx(expected, abs=100.0)  # the step takes one row of 0.01 s
    assert (found[time < 0.28] == 0).all()


def test_a_dead_time_ends_between_rows_that_are_far_apart() -> None:
    time = np.array([0.0, 0.1, 0.11, 2.0, 4.0])  # rows on straight lines were left out
    pressures = np.array([[0.0, 0.0, 50.0, 50.0, 50.0]]).T * KPA
    found = run(History(dead_time=0.7, lag=0.9), time, pressures).pressures[:, 0]
    expected = 50 * KPA * (1 - np.exp(-np.maximum(time - 0.105 - 0.7, 0) / 0.9))
    assert found == pytest.approx(expected, abs=2.0)


@pytest.mark.parametrize("kind", ["lag", "all", "parts"])
def test_a_dead_time_of_whole_rows_is_no_corner(kind: str) -> None:
    """Where a row meets a delayed row, errors have a slope by the dead time like elsewhere."""
    time, pressures = course(300, even=0.08)

    def at(dead_time: float) -> Effective:
        return run(KINDS[kind].model_copy(update={"dead_time": dead_time}), time, pressures)

    middle, step = at(0.16), 1e-6
    before = (middle.pressures - at(0.16 - step).pressures) / step
    after = (at(0.16 + step).pressures - middle.pressures) / step
    scale = np.abs(before).max()
    assert np.quantile(np.abs(after - before), 0.95) < 1e-3 * scale
    found = middle.per_number["dead_time"]
    assert np.quantile(np.abs(found - before), 0.95) < 1e-3 * scale


# -- derivatives ----------------------------------------------------------------------------


def difference(at: Callable[[float], Effective], step: float) -> Array:
    return (at(step).pressures - at(-step).pressures) / (2 * step)


def almost_everywhere(found: Array, expected: Array, share: float = 0.99) -> None:
    """Same but in a few rows in which a turning point crosses a row, where there are kinks."""
    scale = np.abs(expected).max()
    assert scale > 0
    error = np.abs(found - expected) / scale
    assert np.quantile(error, share) < 1e-5
    assert np.quantile(error, 0.5) < 1e-7


@pytest.fixture(scope="module", params=["all", "parts", "softening", "strain"])
def log(request: pytest.FixtureRequest) -> tuple[History, Array, Array, Start, Effective]:
    history = KINDS[request.param]
    time, pressures = course(1500, seed=3)
    start = Start.settled(history, pressures[0] - 7 * KPA, SIDES, EVERYWHERE)
    return history, time, pressures, start, run(history, time, pressures, start)


@pytest.mark.parametrize("name", ["lag", "lag_falling", "dead_time"])
def test_derivatives_by_times(
    name: str, log: tuple[History, Array, Array, Start, Effective]
) -> None:
    history, time, pressures, start, found = log

    def at(change: float) -> Effective:
        value = getattr(history, name) + change
        return run(history.model_copy(update={name: value}), time, pressures, start)

    almost_everywhere(found.per_number[name], difference(at, 1e-6))


@pytest.mark.parametrize("j", range(4))
def test_derivatives_by_shares(j: int, log: tuple[History, Array, Array, Start, Effective]) -> None:
    history, time, pressures, start, found = log

    def at(change: float) -> Effective:
        parts: list[Any] = list(history.parts)
        parts[j] = parts[j].model_copy(update={"share": parts[j].share + change})
        changed = history.model_copy(update={"play": tuple(parts[:2]), "creep": tuple(parts[2:])})
        return run(changed, time, pressures, start)

    assert found.per_number[SHARES[j]] == pytest.approx(difference(at, 1e-5), abs=1e-4)
    assert np.abs(found.per_number[SHARES[j]]).max() > 1 * KPA


@pytest.mark.parametrize("c", range(3))
def test_derivatives_by_memory(c: int, log: tuple[History, Array, Array, Start, Effective]) -> None:
    history, time, pressures, start, found = log

    def at(change: float) -> Effective:
        memory = [factor + change * (i == c) for i, factor in enumerate(history.memory)]
        return run(history.model_copy(update={"memory": tuple(memory)}), time, pressures, start)

    expected = found.per_number[f"memory[{c}]"]
    others = np.delete(expected, c, axis=1)
    assert others.any() == bool(history.softening)
    assert difference(at, 1e-5) == pytest.approx(expected, abs=1e-4)
    assert np.abs(expected).max() > 1 * KPA


@pytest.mark.parametrize("history", [FULL, PARTS, SOFT, STRAIN])
@pytest.mark.parametrize("c", range(3))
def test_derivatives_by_sides(c: int, history: History) -> None:
    time, pressures = course(200, seed=4)
    pressures = pressures[0] + 0.2 * (pressures - pressures[0])  # the wide play is not dragged yet

    def at(change: float) -> Effective:
        start = Start.settled(history, pressures[0], SIDES + change * np.eye(3)[c], EVERYWHERE)
        return run(history, time, pressures, start)

    found = at(0.0).per_side[:, :, c]
    assert difference(at, 1e-4) == pytest.approx(found, abs=1e-3)
    assert abs(found[0, c]) > 500
    assert abs(found[-1, c]) < abs(found[0, c])  # the narrow one forgot
    others = np.delete(found, c, axis=1)
    assert others.any() == (history is not FULL)


def test_without_a_lag_nothing_depends_on_it() -> None:
    time, pressures = course(100)
    found = run(History(play=PLAYS), time, pressures)
    assert not found.per_number["lag"].any()
    assert not found.per_number["lag_falling"].any()
    assert not found.per_number["dead_time"][0].any()


# -- from log to log ------------------------------------------------------------------------


def test_the_state_is_carried_from_log_to_log() -> None:
    time, pressures = course(400, seed=5)
    cut = 170
    first = run(FULL, time[:cut], pressures[:cut])
    pause = time[cut - 1] + 30.0  # the knot until which the last pressures are held
    again = pause + (time[cut:] - time[cut - 1])
    begun = Past(FULL, 3).rested(first.end, pause_between(time[:cut], again), FULL)
    second = run(FULL, again, pressures[cut:], begun)
    once = np.concatenate([time[:cut], [pause], again])
    all_pressures = np.vstack([pressures[:cut], pressures[cut - 1], pressures[cut:]])
    together = run(FULL, once, all_pressures).pressures
    assert second.pressures == pytest.approx(together[cut + 1 :], abs=150.0)
    forgotten = run(FULL, again, pressures[cut:]).pressures
    assert np.abs(forgotten - together[cut + 1 :])[:20].max() > 400.0


def test_logs_whose_clocks_begin_anew_are_a_minute_apart() -> None:
    earlier = np.array([5.0, 6.0, 7.0])
    assert pause_between(earlier, earlier + 4.5) == pytest.approx(2.5)
    assert pause_between(earlier, earlier) == FIT.between_logs == 60.0
    assert pause_between(earlier, earlier + 2.0) == FIT.between_logs


@pytest.mark.parametrize("name", ["lag", "lag_falling", "dead_time", "side"])
def test_derivatives_go_on_in_the_next_log(name: str) -> None:
    time, pressures = course(300, seed=6)
    # the second log is too small for the wide play to be dragged: it stays where the first left it
    small = pressures[-1] + 0.15 * (pressures - pressures[-1])

    def at(change: float) -> Effective:
        history = FULL
        if name != "side":
            history = FULL.model_copy(update={name: getattr(FULL, name) + change})
        sides = SIDES + (change if name == "side" else 0.0)
        one = pressures if name != "side" else small[::-1]
        start = Start.settled(history, one[0], sides, EVERYWHERE)
        first = run(history, time, one, start)
        return run(history, time, small, Past(history, 3).rested(first.end, 60.0, history))

    found = at(0.0)
    per = found.per_side.sum(axis=2) if name == "side" else found.per_number[name]
    almost_everywhere(per, difference(at, 1e-6), 0.97)


# -- how it is run --------------------------------------------------------------------------


def test_results_do_not_depend_on_how_many_rows_are_run_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    time, pressures = course(700, seed=7)
    usual = run(FULL, time, pressures)
    monkeypatch.setattr(past, "_CHUNKS", (1, 3, 64))
    other = run(FULL, time, pressures)
    for name in ("pressures", "per_side"):
        assert getattr(usual, name) == pytest.approx(getattr(other, name), rel=1e-12, abs=1e-9)
    for name, per in usual.per_number.items():
        assert per == pytest.approx(other.per_number[name], rel=1e-12, abs=1e-9)
    assert usual.end.states == pytest.approx(other.end.states, rel=1e-12)


@pytest.mark.parametrize("count", [1, 2, 31, 32, 33, 2048, 2049])
def test_logs_of_every_length(count: int) -> None:
    time, pressures = course(2200, seed=8)
    long = run(FULL, time, pressures)
    short = run(FULL, time[:count], pressures[:count])
    assert short.pressures.shape == (count, 3)
    # the first row of a log begins a median step before it, and that is another one here
    if count > 30:
        assert short.pressures[-1] == pytest.approx(long.pressures[count - 1], abs=20.0)
    assert np.isfinite(short.end.states).all()


def test_a_single_row_at_rest() -> None:
    pressures = np.array([[20.0, 0.0, 50.0]]) * KPA
    found = run(FULL, np.array([5.0]), pressures)
    expected = Memory([FULL] * 3, places=range(3))
    expected.start(pressures[0])
    assert found.pressures[0] == pytest.approx(expected.effective)
    assert found.end.before == pytest.approx(pressures[0])


def test_only_wanted_rows_are_returned() -> None:
    time, pressures = course(2100, seed=9)
    start = Start.from_rest(FULL, pressures[0])
    rows = np.array([0, 5, 6, 2047, 2048, 2099])
    found = Past(FULL, 3).effective(time, pressures, rows, start, FULL)
    every = run(FULL, time, pressures)
    assert found.pressures == pytest.approx(every.pressures[rows], rel=1e-12)
    for name in SHARES:
        assert found.per_number[name].shape == (6, 3)
        expected = every.per_number[name][rows]
        assert found.per_number[name] == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_starts() -> None:
    pressures = np.array([2.0, 30.0, 0.0]) * KPA
    rest = Start.from_rest(FULL, pressures)
    # x, then plays within their widths below, then creeps
    assert rest.states[:, 0] == pytest.approx([2 * KPA, 0.0, 0.0, 2 * KPA, 2 * KPA])
    assert rest.states[:, 1] == pytest.approx(np.array([30, 26, 15, 30, 30]) * KPA)
    assert not rest.per_side.any()
    settled = Start.settled(FULL, pressures, np.array([1.0, -1.0, 0.0]), EVERYWHERE)
    assert settled.states[:, 0] == pytest.approx(np.array([2, 6, 17, 2, 2]) * KPA)
    assert settled.states[:, 1] == pytest.approx(np.array([30, 26, 15, 30, 30]) * KPA)
    assert settled.per_side[0, :, 2] == pytest.approx([0, 4 * KPA, 15 * KPA, 0, 0])


@pytest.mark.parametrize("limits", [(0.0, 100.0), (20.0, 100.0), (-30.0, 100.0), (0.0, 15.0)])
@pytest.mark.parametrize("of", ["pressure", "elongation"])
def test_no_way_to_a_pressure_begins_a_log_beyond_its_sides(
    of: Part, limits: tuple[float, float]
) -> None:
    plays = [Play(width=w * KPA, share=0.2, of=of) for w in (3.0, 12.0, 40.0)]
    history, rng = History(memory=(0.5, 1.0, 1.5), play=plays), np.random.default_rng(3)
    low, high = np.array(limits) * KPA
    memory = Memory([history] * 3, [0, 1, 2])

    def after(*way: Array) -> Array:
        memory.start(np.zeros(3))
        return memory.run(1.0, np.array(way))[-1]

    ends = np.array([low, high])[:, np.newaxis] * np.ones(3)
    for p in rng.uniform(low, high, (5, 3)):
        starts = [Start.settled(history, p, np.full(3, side), ends) for side in (-1.0, 1.0)]
        least, most = (np.array(history.effective(each.states)).ravel() for each in starts)
        reached = np.array([after(*way, p) for way in rng.uniform(low, high, (60, 3, 3))])
        assert (least <= reached.min(axis=0) + 1e-6).all()
        assert (reached.max(axis=0) <= most + 1e-6).all()
        assert after(np.minimum(ends[0], 0), p) == pytest.approx(least, abs=1e-6)
        assert after(ends[1], p) == pytest.approx(most, abs=1e-6)
