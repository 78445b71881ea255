"""Effective pressures along a recording, with their derivatives by the numbers of the history.

The operators are those of `stiffopt.model.history`.  This module runs them over a whole log at
once, with derivatives by lag, dead time, shares and the initial state.

A dead time shifts the answer in time, and nothing else.  So the operators run along the commands
as they were given, whose corners they meet exactly, and each row reads its state a dead time
before it.  Were the delayed commands interpolated between rows, the errors of a fit would have a
corner at each dead time at which a row meets a delayed one, and a fit would end there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.identify.settings import FIT
from stiffopt.model.batch import CompiledFunction, InterpretedFunction
from stiffopt.model.codegen import dense
from stiffopt.model.compiled import compiling_at_once, library
from stiffopt.model.history import NO_HISTORY, History, part_of

_CHUNKS = (1, 8, 32, 128, 512, 2048)  # rows per call; shorter blocks are padded
_MAX_PADDING = 0.25  # largest padded share of a chunk; beyond it, a smaller chunk is run
_WORTH_PADDING = 128  # rows from which machine code pays, though it always runs the largest chunk
_WORTH_COMPILING = 100_000  # rows from which machine code pays; compiling takes a second
_TIMES = 2  # lag and falling lag
_AT_END = 1e-6  # Pa; a play this near to an end of its width is there


@dataclass(frozen=True, eq=False)
class Start:
    """Initial state of the c channels of a segment, with its derivatives.

    Attributes
    ----------
    states : of the operators (m, c).
    per_side : derivatives (s, m, c) of the states by the sides of the channels, see
        `History.settled`; s = 1, by all sides at once, if no operator couples channels, else s = c.
    before : pressures (c,) until the first row, in Pa.
    per_time : derivatives (2, m, c) of the states by lag and falling lag, carried over from the
        previous log; None without one.
    """

    states: Array
    per_side: Array
    before: Array
    per_time: Array | None = None

    @classmethod
    def from_rest(cls, history: History, pressures: Array) -> Start:
        """Return the state after a rise from zero to these pressures (c,)."""
        states = history.from_rest(pressures)
        return cls(states, np.zeros((_sides(history, len(pressures)), *states.shape)), pressures)

    @classmethod
    def settled(cls, history: History, pressures: Array, sides: Array, visited: Array) -> Start:
        """Return the settled state at these pressures (c,), on given sides (c,) of the plays.

        Each play lies between the ends to which ways from rest may drag it: at -1 on its side that
        of a rise, at 1 that of a fall. None of these ways leaves the range of zero and the
        pressures `visited` (N, c): wide plays then rest far from the middle of their width.
        """
        count = len(sides)
        changes = np.eye(count) if _sides(history, count) > 1 else np.ones((1, count))
        states = history.settled(pressures, np.zeros(count))
        per_side = np.zeros((len(changes), *states.shape))
        ways = history.followed(visited)
        low, high = np.minimum(ways.min(axis=0), 0), np.maximum(ways.max(axis=0), 0)
        for j, play in enumerate(history.play, start=1):
            projection, x, w = part_of(np.eye(count), play.of), states[j], play.width
            up, down = np.maximum(projection, 0), np.minimum(projection, 0)
            lowest = np.maximum(x - w, np.minimum(up @ low + down @ high + w, 0))
            highest = np.minimum(x + w, np.maximum(up @ high + down @ low - w, 0))
            half = (highest - lowest) / 2
            states[j] = lowest + half * (1 + part_of(sides, play.of))
            per_side[:, j] = half * part_of(changes, play.of)
        return cls(states, per_side, pressures)


@dataclass(frozen=True, eq=False)
class Effective:
    """Effective pressures at selected rows of a log.

    Attributes
    ----------
    pressures : (M, c), in Pa.
    per_number : their derivatives (M, c) by each number of the history, by its key: ``lag``,
        ``lag_falling``, ``dead_time``, ``memory[0]``, ``play[0].share``, ``creep[0].share``, ...
    per_side : their derivatives (M, c, c) by the initial sides of the channels.
    end : state after the last row.
    """

    pressures: Array
    per_number: dict[str, Array]
    per_side: Array
    end: Start


class Past:
    """Runs the history of one segment's channels along logs.

    Parameters
    ----------
    history : gives the operators' widths and times; each run supplies its own lag and shares.
    channels : number of channels c.
    """

    def __init__(self, history: History | None, channels: int) -> None:
        self.history = history or NO_HISTORY
        self._channels = channels
        self._runs: dict[tuple[bool, bool], _HistoryRun] = {}

    def effective(
        self,
        time: Array,
        pressures: Array,
        wanted: NDArray[np.intp],
        start: Start,
        history: History,
    ) -> Effective:
        """Return the effective pressures at the wanted rows of a log.

        Parameters
        ----------
        time : (N,)
            In s, increasing.
        pressures : (N, c)
            Commanded, in Pa; what the operators follow is linear between rows.
        wanted : (M,)
            Rows whose effective pressures are returned, increasing.
        start : state before the first row.
        history : the values to use; its operators must be those of this object.
        """
        first = time[0] - (np.median(np.diff(time)) if len(time) > 1 else 1.0)
        knots = np.concatenate([[first], time])
        values = history.followed(np.vstack([start.before, pressures]))
        run, lags = self._run(history), (history.lag, history.lag_falling)
        at = time[wanted] - history.dead_time
        places = np.maximum(np.searchsorted(knots, at) - 1, 0)  # of the last knots before
        state = _carried(start)
        kept = np.empty((len(wanted), *state.shape))
        for block in run.blocks(len(time)):
            found = run(state, values[:-1][block], values[1:][block], np.diff(knots)[block], lags)
            along = np.concatenate([state[np.newaxis], found])
            inside = (places >= block.start) & (places < block.stop)
            kept[inside] = along[places[inside] - block.start + (history.dead_time == 0)]
            state = found[-1]
        slope = (np.diff(values, axis=0) / np.diff(knots)[:, np.newaxis])[places]
        command = values[places] + slope * (at - knots[places])[:, np.newaxis]
        falls = command < kept[:, 0, : self._channels]
        if history.dead_time:
            late = at > first
            steps = (at - knots[places])[late]
            kept[late] = run.aside(kept[late], values[places][late], command[late], steps, lags)
            slope[~late], command[~late] = 0.0, values[0]
        memory = np.array([history.memory_of(channel) for channel in range(self._channels)])
        c = self._channels
        states, by_lag, by_falling, *by_side = (
            kept[:, :, k : k + c] for k in range(0, kept.shape[2], c)
        )
        rates = _rates(history, states, command, slope, falls)

        def held(states: Array, j: int) -> Array:
            of = history.parts[j].of
            return np.asarray(part_of(states[:, 1 + j] - part_of(states[:, 0], of), of))

        def slow(states: Array) -> Array:
            parts = enumerate(history.parts)
            return sum((p.share * held(states, j) for j, p in parts), np.zeros_like(states[:, 0]))

        x, slowly = states[:, 0], memory * slow(states)
        by_x, by_slow = history.slopes_with_memory(x, slowly)

        def times(matrices: Array, vectors: Array) -> Array:
            return np.asarray((matrices @ vectors[..., np.newaxis])[..., 0])

        def mixed(slopes: Array) -> Array:
            own = slopes[:, 0]
            return np.asarray(times(by_x, own) + times(by_slow, memory * slow(slopes)))

        per_number = {
            "lag": mixed(by_lag),
            "lag_falling": mixed(by_falling),
            "dead_time": -mixed(rates),
        }
        for channel, own in enumerate(np.eye(c)):
            per_number[f"memory[{channel}]"] = times(by_slow, slow(states) * own)
        plays = len(history.play)
        for j in range(len(history.parts)):
            name = f"play[{j}]" if j < plays else f"creep[{j - plays}]"
            per_number[f"{name}.share"] = times(by_slow, held(states, j) * memory)
        end = self._start(state, pressures[-1])
        sides = np.stack([memory * slow(each) for each in by_side], axis=2)
        if len(by_side) < c:  # the side of a channel moves no other's plays
            sides = sides * np.eye(c)
        u = history.with_memory(x, slowly)
        return Effective(u, per_number, by_slow @ sides, end)

    def rested(self, end: Start, pause: float, history: History) -> Start:
        """Return the state a `pause` in s after the end of a log, at its last pressures."""
        same, lags = history.followed(end.before[np.newaxis]), (history.lag, history.lag_falling)
        (state,) = self._run(history)(_carried(end), same, same, np.array([pause]), lags)
        return self._start(state, end.before)

    def _start(self, state: Array, before: Array) -> Start:
        """Convert a state of `_HistoryRun` to the start of the next log."""
        states, *slopes = np.split(state, state.shape[1] // self._channels, axis=1)
        return Start(states, np.stack(slopes[_TIMES:]), before, np.stack(slopes[:_TIMES]))

    def _run(self, history: History) -> _HistoryRun:
        kind = (history.lag > 0, history.lag_falling > 0)
        if kind not in self._runs:
            self._runs[kind] = _HistoryRun(self.history, self._channels, *kind)
        return self._runs[kind]


def pause_between(earlier: Array, later: Array) -> float:
    """Return the time between two logs of a sequence, in s, from the times (N,) of their rows.

    Unless the later log's clock continues the earlier one's, that is `FIT.between_logs`.
    """
    apart = float(later[0] - earlier[-1])
    return apart if apart > 0 else FIT.between_logs


def _sides(history: History, channels: int) -> int:
    """Return how many derivatives by sides to carry: one if no play couples channels, else c."""
    return 1 if all(play.of == "pressure" for play in history.play) else channels


def _carried(start: Start) -> Array:
    """Convert a start to a state (m, (3 + s) c) of `_HistoryRun`."""
    none = np.zeros((_TIMES, *start.states.shape))
    per_time = none if start.per_time is None else start.per_time
    return np.concatenate([start.states, *per_time, *start.per_side], axis=1)


class _HistoryRun:
    """Runs the operators of several channels over many rows, with their derivatives.

    A state (m, (3 + s) c) holds the operators of each channel, then their derivatives by lag,
    falling lag and sides.
    """

    def __init__(self, history: History, channels: int, lags: bool, falls: bool) -> None:
        self._shape = (history.n_states, (1 + _TIMES + _sides(history, channels)) * channels)
        self._step = _steps(history, channels, lags, falls)
        self._interpreted: dict[int, InterpretedFunction] = {}
        self._aside: dict[int, InterpretedFunction] = {}
        operators = [part.model_dump(exclude={"share"}) for part in history.parts]
        self._content = ("past along commands", operators, channels, lags, falls, _CHUNKS[-1])
        self._compiled: CompiledFunction | None = None
        self._interpreted_rows = 0

    def blocks(self, count: int) -> Iterator[slice]:
        """Yield blocks of a log's rows, each to be run in one call."""
        begin = 0
        while begin < count:
            end = min(begin + self._at_once(count - begin), count)
            yield slice(begin, end)
            begin = end

    def _at_once(self, count: int) -> int:
        """Return the chunk to run for `count` remaining rows; a larger one means padding."""
        if self._compiled is not None and count >= _WORTH_PADDING:
            return _CHUNKS[-1]
        enough = next((rows for rows in _CHUNKS if rows >= count), _CHUNKS[-1])
        if count >= (1 - _MAX_PADDING) * enough:
            return enough
        return next(rows for rows in reversed(_CHUNKS) if rows <= count)

    def __call__(
        self,
        state: Array,
        before: Array,
        now: Array,
        steps: Array,
        lags: tuple[float, float],
    ) -> Array:
        """Return the states (N, m, (3 + s) c) after N steps between pressures (N, c)."""
        count = len(steps)
        size = self._at_once(count)
        given = np.broadcast_to(np.array(lags), (count, 2))
        arguments = (state, *(_columns(each, size) for each in (before, now, steps, given)))
        rows, width = self._shape
        found = self._function(size)(*arguments)[0].reshape(rows, size, width)
        return np.asarray(np.swapaxes(found[:, :count], 0, 1))

    def aside(
        self, states: Array, before: Array, now: Array, steps: Array, lags: tuple[float, float]
    ) -> Array:
        """Return the states (M, m, (3 + s) c) one step after each of others (M, m, (3 + s) c)."""
        rows, width = self._shape
        ends = np.empty_like(states)
        given = np.broadcast_to(np.array(lags), (len(steps), 2))
        size = next((each for each in _CHUNKS if each >= len(steps)), _CHUNKS[-1])
        if size not in self._aside:
            self._aside[size] = InterpretedFunction(dense(self._step.map(size)))
        for begin in range(0, len(steps), size):
            own = slice(begin, min(begin + size, len(steps)))
            first = _columns(states[own].reshape(own.stop - begin, -1), size)
            first = np.swapaxes(first.reshape(rows, width, size), 1, 2).reshape(rows, -1)
            others = (_columns(each[own], size) for each in (before, now, steps, given))
            found = self._aside[size](first, *others)[0].reshape(rows, size, width)
            ends[own] = np.swapaxes(found[:, : own.stop - begin], 0, 1)
        return ends

    def _function(self, rows: int) -> CompiledFunction | InterpretedFunction:
        """Return the function that runs `rows` steps; the largest one compiled, once it pays."""
        if rows == _CHUNKS[-1] and self._compiled is not None:
            return self._compiled
        before = self._interpreted_rows
        self._interpreted_rows += rows
        if before < _WORTH_COMPILING <= self._interpreted_rows:
            self._compile()
        if rows not in self._interpreted:
            self._interpreted[rows] = InterpretedFunction(dense(self._step.mapaccum("run", rows)))
        return self._interpreted[rows]

    def _compile(self) -> None:
        def make() -> list[ca.Function]:
            return [dense(self._step.mapaccum("past_run", _CHUNKS[-1]))]

        with compiling_at_once():
            code = library(self._content, make)
        self._compiled = code.function("past_run") if code else None


def _columns(values: Array, count: int) -> Array:
    """Transpose rows (N, c) or (N,) to columns (c, count), padded by repeating the last row."""
    rows = values.reshape(len(values), -1)
    filled = np.empty((count, rows.shape[1]))
    filled[: len(rows)] = rows
    filled[len(rows) :] = rows[-1]
    return filled[0] if count == 1 else filled.T


def _steps(history: History, channels: int, lags: bool, falls: bool) -> ca.Function:
    """Return one step of `_HistoryRun`: from state, pressures, step and lags to state."""
    blocks = 1 + _TIMES + _sides(history, channels)
    state = ca.SX.sym("state", history.n_states, blocks * channels)
    value, *slopes = ca.horzsplit(state, channels)
    before, now = (ca.SX.sym(name, channels) for name in ("before", "now"))
    step, lag = ca.SX.sym("step"), ca.SX.sym("lag", 2)
    update = {"lag": lag[0] if lags else 0.0, "lag_falling": lag[1] if falls else 0.0}
    end = history.model_copy(update=update).next_state(value, before, now, step)

    def change(of: Sequence[ca.SX], by: Sequence[ca.SX]) -> ca.SX:
        vectors = [ca.vertcat(*(ca.vec(each) for each in part)) for part in (of, by)]
        return ca.reshape(ca.jtimes(ca.vec(end), *vectors), *end.shape)

    one, none = ca.SX(1), ca.SX(0)
    ends = ca.horzcat(
        end,
        change([value, lag], [slopes[0], one, none]),
        change([value, lag], [slopes[1], none, one]),
        *(change([value], [slope]) for slope in slopes[_TIMES:]),
    )
    return ca.Function("step", [state, before, now, step, lag], [ends])


def _rates(
    history: History, states: Array, commands: Array, slopes: Array, falls: NDArray[np.bool_]
) -> Array:
    """Return the time derivatives (M, m, c) of states, under commands (M, c) with slopes (M, c).

    `falls` says which channels (M, c) have the lag of falling pressures.
    """
    x = states[:, 0]
    lags = np.where(falls & (history.lag_falling > 0), history.lag_falling, history.lag)
    moves = (commands - x) / lags if history.lag else slopes
    rates = [moves]
    for y, play in zip(np.moveaxis(states, 1, 0)[1:], history.play, strict=False):
        ahead, move = part_of(x, play.of) - y, part_of(moves, play.of)
        rates.append(np.where(np.abs(ahead) > play.width - _AT_END, move, 0.0))
    for z, creep in zip(
        np.moveaxis(states, 1, 0)[1 + len(history.play) :], history.creep, strict=True
    ):
        rates.append((part_of(x, creep.of) - z) / creep.time)
    return np.stack(rates, axis=1)
