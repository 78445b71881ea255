"""Lag, dead time, play and creep against exact solutions and operators made in other ways."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from conftest import is_long
from independent.arms import FLOP
from stiffopt.errors import InputError
from stiffopt.model.history import NO_HISTORY, Creep, History, Memory, Part, Play, part_of
from stiffopt.model.segment import Segment

Vector = NDArray[np.float64]

KPA = 1e3
WIDTHS, SHARES = (4 * KPA, 10 * KPA, 25 * KPA), (0.1, 0.2, 0.15)
PLAYS = tuple(Play(width=w, share=s) for w, s in zip(WIDTHS, SHARES, strict=True))
CREEPS = (Creep(time=2.0, share=0.1), Creep(time=20.0, share=0.05))
HYSTERETIC = History(play=PLAYS)
EVERYTHING = History(dead_time=0.37, lag=0.3, play=PLAYS, creep=CREEPS)
pressures = st.floats(0, 100 * KPA)


def largest_memory(history: History) -> float:
    """Largest effect of plays on the shape, as a pressure at the modulus of rest, in Pa."""
    # |A v| <= k max |v| with k = 2 (1 - 1/c) for bending, 3 - 4/c for opposite fibres
    most = {"bending": 2, "opposite": 3}
    return sum(play.share * play.width * most.get(play.of, 1) for play in history.play)


def responses(history: History, path: Sequence[float], step: float = 1.0) -> Vector:
    """Effective pressures (m,) after each of some pressures, from rest."""
    return Memory([history]).run(step, np.array(path, dtype=float)[:, None])[:, 0]


@cache
def step_function(history: History) -> ca.Function:
    state = ca.SX.sym("state", history.n_states)
    before, now, step = ca.SX.sym("before"), ca.SX.sym("now"), ca.SX.sym("step")
    end = history.next_state(state, before, now, step)
    return ca.Function("step", [state, before, now, step], [end])


def after(history: History, state: Any, before: float, now: float, step: float) -> Vector:
    return step_function(history)(state, before, now, step).full()[:, 0]


# -- lag and creep --------------------------------------------------------------------------


def test_lag_after_a_step() -> None:
    times = 0.07 * np.arange(1, 60)
    u = responses(History(lag=0.4), [50 * KPA] * len(times), 0.07)
    assert u == pytest.approx(50 * KPA * (1 - np.exp(-times / 0.4)), rel=1e-12)


def test_lag_along_a_ramp() -> None:
    """A long time later it is behind by a lag's worth of the ramp."""
    history, rate, state, step = History(lag=0.4), 8 * KPA, np.zeros(1), 0.3
    for i in range(30):
        state = after(history, state, rate * step * i, rate * step * (i + 1), step)
        t = step * (i + 1)
        assert state[0] == pytest.approx(rate * (t - 0.4 + 0.4 * np.exp(-t / 0.4)), rel=1e-10)
    assert rate * 9.0 - state[0] == pytest.approx(rate * 0.4, rel=1e-6)


@pytest.mark.parametrize("lag", [0.0, 0.05, 1.99999, 2.0, 2.0003, 2.1, 30.0])
@pytest.mark.parametrize("step", [0.01, 1.0, 50.0])
def test_lag_and_creep_in_one_step(lag: float, step: float) -> None:
    history = History(lag=lag, creep=CREEPS)
    before, now = 30 * KPA, 70 * KPA
    state = np.array([before if lag == 0 else 12 * KPA, 50 * KPA, 5 * KPA])

    def slope(t: float, y: Vector) -> Vector:
        p = before + (now - before) * t / step
        x = p if lag == 0 else y[0]
        moved = (now - before) / step if lag == 0 else (p - x) / lag
        return np.array([moved, (x - y[1]) / 2.0, (x - y[2]) / 20.0])

    expected = solve_ivp(slope, (0, step), state, "DOP853", rtol=1e-11, atol=1e-9).y[:, -1]
    assert after(history, state, before, now, step) == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("lag", [0.1, 1.9, 1.9995, 2.0, 2.0005, 2.001, 5.0])
def test_derivatives_by_a_symbolic_lag(lag: float) -> None:
    symbol = ca.SX.sym("lag")
    history = History(lag=1.0, creep=CREEPS).model_copy(update={"lag": symbol})
    state = np.array([12 * KPA, 50 * KPA, 5 * KPA])
    end = history.next_state(ca.DM(state), 30 * KPA, 70 * KPA, 1.5)
    by_lag = ca.Function("by_lag", [symbol], [ca.jacobian(end, symbol)])
    nudge = 1e-4
    high, low = (
        after(History(lag=value, creep=CREEPS), state, 30 * KPA, 70 * KPA, 1.5)
        for value in (lag + nudge, lag - nudge)
    )
    assert by_lag(lag).full()[:, 0] == pytest.approx((high - low) / (2 * nudge), rel=1e-5)


def test_derivatives_by_symbolic_shares() -> None:
    symbols = ca.SX.sym("share", 2)
    creeps = tuple(c.model_copy(update={"share": symbols[k]}) for k, c in enumerate(CREEPS))
    history = History().model_copy(update={"creep": creeps})
    u = history.effective(ca.SX(ca.DM([50.0, 20.0, 60.0])))
    gradient = ca.Function("gradient", [symbols], [ca.jacobian(u, symbols)])
    assert gradient([0.3, 0.1]).full()[0] == pytest.approx([-30.0, 10.0])


def test_creep_goes_with_its_time_constants_however_time_is_cut() -> None:
    history, p = History(creep=CREEPS), 80 * KPA
    for step in (0.01, 0.5, 40.0):
        t = step * np.arange(1, 6)
        slow = 0.1 * np.exp(-t / 2) + 0.05 * np.exp(-t / 20)
        assert responses(history, [p] * 5, step) == pytest.approx(p * (1 - slow), rel=1e-10)


# -- dead time ------------------------------------------------------------------------------


@pytest.mark.parametrize(("dead_time", "step"), [(0.45, 0.001), (0.45, 0.07), (0.0104, 0.001)])
def test_nothing_happens_during_the_dead_time(dead_time: float, step: float) -> None:
    lag, n = 0.2, round(1 / step)
    u = responses(History(dead_time=dead_time, lag=lag), [60 * KPA] * n, step)
    late = np.maximum(step * np.arange(1, n + 1) - dead_time, 0.0)
    assert u == pytest.approx(60 * KPA * (1 - np.exp(-late / lag)), rel=1e-9, abs=1e-6)


def test_dead_time_alone_is_a_shift_by_whole_steps() -> None:
    path = np.random.default_rng(1).uniform(0, 100 * KPA, 3000)
    u = responses(History(dead_time=0.45), path.tolist(), 0.001)
    assert not u[:450].any()
    assert (u[450:] == path[:-450]).all()


def test_a_pulse_shorter_than_the_dead_time_comes_through() -> None:
    memory, lag = Memory([History(dead_time=0.5, lag=0.1)]), 0.1
    memory.advance(0.03, [90 * KPA])
    assert memory.advance(0.4, [0.0]) == 0
    rise = 90 * KPA * (1 - np.exp(-0.03 / lag))
    assert memory.advance(0.27, [0.0]) == pytest.approx(rise * np.exp(-0.17 / lag), rel=1e-9)


@settings(max_examples=60 if is_long() else 25, deadline=None, derandomize=True)
@given(
    levels=st.lists(pressures, min_size=1, max_size=4),
    cuts=st.lists(st.integers(1, 9), min_size=1, max_size=4),
)
def test_constant_pressures_may_be_cut_into_any_steps(levels: list[float], cuts: list[int]) -> None:
    histories = [EVERYTHING, None, HYSTERETIC]
    whole, cut = Memory(histories), Memory(histories)
    for index, level in enumerate(levels):
        p = np.array([level, 0.5 * level, 100 * KPA - level])
        pieces = cuts[index % len(cuts)]
        expected = whole.advance(0.9, p)
        for _ in range(pieces):
            found = cut.advance(0.9 / pieces, p)
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-6)


# -- play -----------------------------------------------------------------------------------


def test_a_loop_by_hand() -> None:
    """Half of the pressure acts through a play of 10: from rest to 40, to 0, 20, 30 and 25."""
    history = History(play=[Play(width=10, share=0.5)])
    found = responses(history, [8, 40, 0, 20, 30, 25])
    # the operator is at         0, 30, 10, 10, 20, 20
    assert found == pytest.approx([4, 35, 5, 15, 25, 22.5])


@pytest.mark.parametrize("seed", range(3))
def test_play_is_a_superposition_of_relays(seed: int) -> None:
    """Preisach's model: relays that switch on at v + width and off at v - width, for every v."""
    rng = np.random.default_rng(seed)
    path = rng.uniform(0, 100 * KPA, 60)
    cell = 20.0
    v = np.arange(-200 * KPA, 200 * KPA, cell) + cell / 2
    expected = path * (1 - sum(SHARES))
    for width, share in zip(WIDTHS, SHARES, strict=True):
        on = v < 0
        for i, p in enumerate(path):
            on = (on | (p >= v + width)) & ~(p <= v - width)
            expected[i] += share * cell / 2 * (on.sum() - (~on).sum())
    assert responses(HYSTERETIC, path.tolist()) == pytest.approx(expected, abs=cell)


@settings(max_examples=100 if is_long() else 40, deadline=None, derandomize=True)
@given(
    past=st.lists(pressures, max_size=5),
    ends=st.tuples(pressures, pressures),
    shares=st.lists(st.floats(0, 1), min_size=1, max_size=8),
    later=st.lists(pressures, min_size=1, max_size=5),
)
def test_a_way_within_the_last_one_is_forgotten(
    past: list[float], ends: tuple[float, float], shares: list[float], later: list[float]
) -> None:
    """Return-point memory: from a to b, anywhere in between, and back to b."""
    a, b = ends
    wandering = [a + share * (b - a) for share in shares]
    straight = responses(HYSTERETIC, [*past, a, b, *later])
    detour = responses(HYSTERETIC, [*past, a, b, *wandering, b, *later])
    assert detour[-len(later) - 1 :] == pytest.approx(straight[-len(later) - 1 :], abs=1e-6)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    first=st.lists(pressures, max_size=5),
    second=st.lists(pressures, max_size=5),
    ends=st.tuples(pressures, pressures),
)
def test_loops_between_the_same_ends_are_congruent(
    first: list[float], second: list[float], ends: tuple[float, float]
) -> None:
    a, b = ends
    ways = np.concatenate([np.linspace(a, b, 9), np.linspace(b, a, 9)])
    loops = []
    for past in (first, second):
        loop = responses(HYSTERETIC, [*past, a, b, *ways])[-len(ways) :]
        assert loop[-1] == pytest.approx(loop[0], abs=1e-6)  # it is closed
        loops.append(loop - loop[0])
    assert loops[0] == pytest.approx(loops[1], abs=1e-6)


@settings(max_examples=100 if is_long() else 40, deadline=None, derandomize=True)
@given(path=st.lists(st.floats(-50 * KPA, 150 * KPA), min_size=1, max_size=12))
def test_hysteresis_never_takes_more_than_the_largest_memory(path: list[float]) -> None:
    most = largest_memory(HYSTERETIC)
    assert most == pytest.approx(6.15 * KPA)  # 0.1 of 4, 0.2 of 10, 0.15 of 25
    assert np.abs(responses(HYSTERETIC, path) - path).max() <= most * (1 + 1e-9)
    up, down = path[-1] + 50 * KPA, path[-1] - 50 * KPA
    assert responses(HYSTERETIC, [*path, up])[-1] == pytest.approx(up - most)
    assert responses(HYSTERETIC, [*path, down])[-1] == pytest.approx(down + most)


def test_shaking_that_dies_away_leads_to_equilibrium() -> None:
    p, swing = 60 * KPA, 40 * KPA * 0.99 ** np.arange(1000)
    shaken = p + swing * (-1) ** np.arange(1000)
    assert responses(HYSTERETIC, shaken.tolist())[-1] == pytest.approx(p, abs=0.01 * KPA)


# -- memory ---------------------------------------------------------------------------------


def test_settled_in_the_middle_nothing_is_left() -> None:
    memory, p = Memory([EVERYTHING, None, HYSTERETIC]), np.array([70, 40, 20]) * KPA
    memory.settle(p)
    assert memory.effective == pytest.approx(p)
    for _ in range(3):
        assert memory.advance(2.0, p) == pytest.approx(p)


@pytest.mark.parametrize("side", [-1.0, 0.3, 1.0])
def test_settled_on_a_side(side: float) -> None:
    memory, p = Memory([EVERYTHING] * 2), np.array([70, 40]) * KPA
    memory.settle(p, side)
    assert memory.effective == pytest.approx(p + side * largest_memory(EVERYTHING))
    assert memory.advance(5.0, p) == pytest.approx(memory.effective)


def test_on_the_side_of_loading_a_rise_drags_all_operators_along() -> None:
    memory, p, more = Memory([HYSTERETIC] * 2), np.array([70, 40]) * KPA, 0.5 * KPA
    memory.settle(p, -1)
    assert memory.advance(1.0, p + more) == pytest.approx(p + more - largest_memory(HYSTERETIC))
    memory.settle(p, 1)
    follows = more * (1 - sum(SHARES))  # no operator moves
    assert memory.advance(1.0, p + more) == pytest.approx(p + follows + largest_memory(HYSTERETIC))


def test_a_start_is_a_rise_from_no_pressure() -> None:
    p = np.array([3, 8, 60]) * KPA
    risen, begun = Memory([EVERYTHING] * 3), Memory([EVERYTHING] * 3)
    for _ in range(100):
        risen.advance(5.0, p)
    begun.start(p)
    assert begun.effective == pytest.approx(risen.effective)
    assert begun.effective == pytest.approx(  # plays of 4, 10 and 25
        p - [0.45 * 3 * KPA, 0.4 * KPA + 0.35 * 8 * KPA, 6.15 * KPA]
    )
    assert begun.advance(1.0, 0.8 * p) == pytest.approx(risen.advance(1.0, 0.8 * p))


def test_channels_know_nothing_of_each_other() -> None:
    histories = [EVERYTHING, None, History(dead_time=0.2), HYSTERETIC, NO_HISTORY]
    rng = np.random.default_rng(4)
    path = rng.uniform(0, 100 * KPA, (50, len(histories)))
    together = Memory(histories).run(0.11, path)
    for channel, history in enumerate(histories):
        alone = Memory([history]).run(0.11, path[:, [channel]])[:, 0]
        assert together[:, channel] == pytest.approx(alone, rel=1e-9)
    for channel in (1, 4):
        assert (together[:, channel] == path[:, channel]).all()


def test_rows_are_steps() -> None:
    path = np.random.default_rng(5).uniform(0, 100 * KPA, (40, 2))
    at_once, one_by_one = Memory([EVERYTHING] * 2), Memory([EVERYTHING] * 2)
    found = at_once.run(0.05, path)
    assert found == pytest.approx(np.array([one_by_one.advance(0.05, p) for p in path]), rel=1e-9)
    assert (at_once.effective == found[-1]).all()
    assert at_once.run(0.05, np.empty((0, 2))).shape == (0, 2)
    assert (at_once.effective == found[-1]).all()


def test_a_copy_goes_its_own_way() -> None:
    memory, same = Memory([EVERYTHING]), Memory([EVERYTHING])
    for each in (memory, same):
        each.advance(0.5, [60 * KPA])
    other = copy.copy(memory)
    other.advance(3.0, [10 * KPA])
    assert memory.advance(0.3, [80 * KPA]) == same.advance(0.3, [80 * KPA])


# -- elongation and bending -------------------------------------------------------------------


def of_part(of: Part, **others: Any) -> History:
    plays = [play.model_copy(update={"of": of}) for play in PLAYS]
    creeps = [creep.model_copy(update={"of": of}) for creep in CREEPS]
    return History(play=plays, creep=creeps, **others)


def of_segment(history: History, path: Vector, step: float = 1.0) -> Vector:
    """Effective pressures (m, c) of the channels of one segment, from rest."""
    channels = path.shape[1]
    return Memory([history] * channels, range(channels)).run(step, path)


PATH = np.random.default_rng(6).uniform(0, 100 * KPA, (40, 3))
AWAY = PATH - PATH.mean(axis=1, keepdims=True)


def test_each_part_has_its_own_memory() -> None:
    """Of pressures that are all alike, and of such whose mean is zero."""
    alike = np.repeat(PATH[:, :1], 3, axis=1)
    own = of_segment(of_part("pressure"), alike)
    assert of_segment(of_part("elongation"), alike) == pytest.approx(own)
    assert of_segment(of_part("bending"), alike) == pytest.approx(alike)
    assert of_segment(of_part("elongation"), AWAY) == pytest.approx(AWAY)
    bent = of_segment(of_part("bending"), AWAY)
    assert np.abs(bent - AWAY).max() > 5 * KPA
    own = of_segment(of_part("pressure"), AWAY)
    assert bent == pytest.approx(own - own.mean(axis=1, keepdims=True))


@pytest.mark.parametrize("of", ["elongation", "bending"])
def test_neither_part_moves_the_other(of: Part) -> None:
    held = of_segment(of_part(of), PATH) - PATH
    mean = held.mean(axis=1, keepdims=True)
    none = mean if of == "bending" else held - mean
    assert np.abs(none).max() < 1e-6
    history = of_part(of)
    most = largest_memory(history) + 100 * KPA * 0.15 * (1 + (of == "bending"))  # and creep's share
    assert 5 * KPA < np.abs(held).max() < most


def test_creep_of_all_parts_is_that_of_pressure() -> None:
    """Being linear, unlike play."""
    every = of_segment(History(lag=0.3, creep=CREEPS), PATH)
    creeps = [c.model_copy(update={"of": of}) for c in CREEPS for of in ("elongation", "bending")]
    assert of_segment(History(lag=0.3, creep=creeps), PATH) == pytest.approx(every)


def test_deflated_chambers_stay_stretched() -> None:
    """All of 90, then two at none, then none: with a play of 10 of elongation, half of it."""
    history = History(play=[Play(width=10, share=0.5, of="elongation")])
    found = of_segment(history, np.array([[90.0, 90, 90], [90, 0, 0], [0, 0, 0]]))
    # the operator is at 80, 40 and 10; half of what it is away from the mean acts on all
    assert found == pytest.approx(np.array([[85.0, 85, 85], [95, 5, 5], [5, 5, 5]]))


def test_fibres_opposite_to_each_channel() -> None:
    """A unit of stress there is a unit of force, with the moment of the other side."""
    for count in (3, 4, 6):
        angles = 2 * np.pi * np.arange(count) / count
        places = np.column_stack([np.cos(angles), np.sin(angles)])
        opposite = part_of(np.eye(count), "opposite")
        assert opposite.sum(axis=1) == pytest.approx(1)
        assert opposite @ places == pytest.approx(-places)
        assert opposite @ opposite == pytest.approx(np.eye(count))
    two = PATH[:, :2]  # each opposite to the other
    expected = of_segment(of_part("pressure"), two)
    assert of_segment(of_part("opposite"), two) == pytest.approx(expected)
    history = of_part("opposite", lag=0.3)
    assert (
        np.abs(of_segment(history, PATH) - PATH).max() < largest_memory(history) + 100 * KPA * 0.45
    )
    memory = Memory([history] * 3, range(3))
    memory.settle(PATH[0])
    assert memory.effective == pytest.approx(PATH[0])


def test_parts_may_be_cut_into_any_steps_and_settle_in_the_middle() -> None:
    histories = [of_part(of, lag=0.3, dead_time=0.37) for of in ("elongation", "bending")]
    path, places = np.hstack([PATH[:8], PATH[8:16]]), [0, 1, 2, 0, 1, 2]
    each = [histories[0]] * 3 + [histories[1]] * 3
    whole, cut = Memory(each, places), Memory(each, places)
    for p in path:
        expected = whole.advance(0.9, p)
        for _ in range(7):
            found = cut.advance(0.9 / 7, p)
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-6)
    whole.settle(path[0])
    assert whole.effective == pytest.approx(path[0])
    assert whole.advance(2.0, path[0]) == pytest.approx(path[0])
    whole.settle(path[0], 1.0)  # all alike, they do not bend
    after_a_fall = path[0] + np.repeat([largest_memory(histories[0]), 0.0], 3)
    assert whole.effective == pytest.approx(after_a_fall)
    assert whole.advance(2.0, path[0]) == pytest.approx(after_a_fall)


def test_segments_and_lone_channels_know_nothing_of_each_other() -> None:
    history = of_part("elongation")
    path = np.hstack([PATH, PATH[::-1], PATH[:, :1]])
    found = Memory([history] * 7, [0, 1, 2, 0, 1, 2, 0]).run(1.0, path)
    assert found[:, :3] == pytest.approx(of_segment(history, PATH))
    assert found[:, 3:6] == pytest.approx(of_segment(history, PATH[::-1]))
    alone = Memory([of_part("pressure")]).run(1.0, PATH[:, :1])
    assert found[:, 6:] == pytest.approx(alone)


def test_shares_count_for_what_they_act_on() -> None:
    parts = [Play(width=1e4, share=0.6, of=of) for of in ("elongation", "bending")]
    assert History(play=parts).shares == (0.6, 0.6)
    assert History(play=parts[:1]).quick_share == pytest.approx(1 - 0.6 / 3)
    assert History(play=parts[1:]).quick_share == pytest.approx(1 - 0.6 * 2 / 3)
    with pytest.raises(InputError, match=r"add up to 1\.1;"):
        History(play=[*parts, Play(width=1e4, share=0.5)])


# -- mistakes -------------------------------------------------------------------------------


@pytest.mark.parametrize("x", [[90e3, 0.0, 0.0], [80e3, 70e3, 90e3], [0.0, 0.0, 0.0]])
def test_what_is_remembered_is_a_stress_at_the_present_modulus(x: list[float]) -> None:
    """Pressures x and s at the modulus of x have the strain of effective ones, to first order."""
    c, small = -2e-6, 1e-3
    now, remembered = np.array([x]), small * KPA * np.array([[-3.0, 5.0, -2.0]])
    history = History(softening=c, play=PLAYS)

    def strain(p: Vector, modulus_at: Vector) -> Vector:
        return np.asarray(p / (1 + c * np.linalg.norm(modulus_at)))

    acting = history.with_memory(now, remembered) - now
    expected = strain(now + remembered, now) - strain(now, now)
    found = strain(now + acting, now + acting) - strain(now, now)
    assert found == pytest.approx(expected, rel=1e-3)
    assert (acting != pytest.approx(remembered, rel=0.01)) == bool(now.any())
    none = history.model_copy(update={"softening": 0.0})
    assert none.with_memory(now, remembered) - now == pytest.approx(remembered)
    symbolic = history.with_memory(ca.SX(now), ca.SX(remembered))
    assert ca.evalf(symbolic).full() - now == pytest.approx(acting)


@pytest.mark.parametrize("of", ["pressure", "opposite"])
def test_operators_may_act_on_the_strain(of: Part) -> None:
    """They do to v = p / (1 + c |p|) what others do to p; their stress meets the modulus at p."""
    c = -2e-6
    plain = of_part(of, lag=0.3)
    history = plain.model_copy(update={"softening": c, "remembers": "strain"})
    modulus = 1 + c * np.linalg.norm(PATH, axis=1, keepdims=True)
    memory = Memory([history] * 3, range(3))
    memory.settle(PATH[-1])
    assert memory.effective == pytest.approx(PATH[-1])
    without_lag = plain.model_copy(update={"lag": 0.0})
    held = of_segment(without_lag, PATH / modulus) - PATH / modulus
    u = of_segment(history.model_copy(update={"lag": 0.0}), PATH)
    strain = u / (1 + c * np.linalg.norm(u, axis=1, keepdims=True))
    assert strain == pytest.approx(PATH / modulus + held / modulus)
    for p in PATH[:8]:
        end = memory.advance(1.0, p)
    cut = Memory([history] * 3, range(3))
    cut.settle(PATH[-1])
    for p in np.repeat(PATH[:8], 5, axis=0):
        cut.advance(0.2, p)
    assert cut.effective == pytest.approx(end)


def test_a_history_is_of_pressures_unless_it_says_so() -> None:
    keys = {"softening": -2e-6, "play": [{"width": "10 kPa", "share": 0.2}]}
    old = History.model_validate(keys)
    assert old.remembers == "pressure"
    same = History.model_validate(keys | {"remembers": "pressure"})
    assert (of_segment(old, PATH) == of_segment(same, PATH)).all()
    other = History.model_validate(keys | {"remembers": "strain"})
    assert np.abs(of_segment(other, PATH) - of_segment(old, PATH)).max() > 1 * KPA
    assert History.model_validate(other.model_dump()) == other
    with pytest.raises(InputError, match="'pressure' or 'strain'"):
        History(remembers="stress")  # type: ignore[arg-type]


def test_what_a_memory_refuses() -> None:
    with pytest.raises(InputError, match="at least one channel"):
        Memory([])
    memory = Memory([None, EVERYTHING])
    for step in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match=r"expected a positive number of s, not"):
            memory.advance(step, [0, 0])
    for call in (memory.start, memory.settle, lambda p: memory.advance(1.0, p)):
        with pytest.raises(InputError, match=r"expected 2 pressures, not an array of shape \(3,\)"):
            call([0, 0, 0])
        with pytest.raises(InputError, match="expected finite pressures"):
            call([0, np.nan])
    with pytest.raises(InputError, match=r"rows of 2 pressures, not an array of shape \(2,\)"):
        memory.run(1.0, [0, 0])


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        ({"play": [{"width": 1e4, "share": 0.6}, {"width": 2e4, "share": 0.4}]}, "play: .*up to 1"),
        ({"creep": [{"time": 1, "share": 0.7}, {"time": 9, "share": 0.5}]}, "creep: .*up to 1.2"),
        (
            {"play": [{"width": 1e4, "share": 0.6}], "creep": [{"time": 2, "share": 0.4}]},
            "the shares of play and creep add up to 1; expected less than 1",
        ),
        ({"play": [{"width": 0, "share": 0.1}]}, "width: must be greater than 0"),
        ({"play": [{"width": 1e4, "share": -0.1}]}, "share: must be at least 0"),
        ({"creep": [{"time": 0, "share": 0.1}]}, "time: must be greater than 0"),
        ({"creep": [{"time": 2, "share": 1}]}, "share: must be less than 1"),
        ({"play": [{"width": 1e4, "share": 0.1, "of": "twist"}]}, "of: .*bending"),
        ({"lag": -0.1}, "lag: must be at least 0"),
        ({"dead_time": -0.1}, "dead_time: must be at least 0"),
        ({"delay": 0.1}, "delay"),
    ],
)
def test_what_a_history_refuses(mistake: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        History(**mistake)
    with pytest.raises(InputError, match=message):
        Segment(**FLOP.mapping(), history=mistake)


def test_shares_just_below_one_are_fine() -> None:
    history = History(play=[Play(width=1e4, share=0.6)], creep=[Creep(time=2, share=0.399)])
    assert history.memory_at(0.0) == pytest.approx(0.999)


def test_a_play_keeps_a_former_pressure_unless_the_next_one_drags_it_along() -> None:
    span, width = 1e5, 2e4
    pressures = np.random.default_rng(3).uniform(0, span, 20000)
    held, kept = width, 0
    for p in pressures:
        after = np.clip(held, p - width, p + width)
        kept += after == held
        held = after
    share = kept / len(pressures)
    play = Play(width=width, share=0.3)
    history = History(play=(play,), memory=(1.0, 0.5))
    assert history.remembered_shares(2, span) == pytest.approx(
        [0.3 * share, 0.15 * share], rel=0.03
    )
    # a wide play, and creep, keep all of it
    history = History(play=(play,), creep=(Creep(time=5.0, share=0.1),))
    assert history.remembered_shares(1, 3e4) == pytest.approx([0.4])
    bending = play.model_copy(update={"of": "bending"})
    assert History(play=(play, bending)).remembered_shares(1, 3e4) == pytest.approx([0.6])
