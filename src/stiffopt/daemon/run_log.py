"""Reader of a recorded run, and its conversion to a log for calibration."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array, Flags
from stiffopt.control.state import Event, SeenPose, Severity, Snapshot, State
from stiffopt.control.state_fields import Entry, Kind, entries
from stiffopt.daemon.topics import FORMAT, METADATA, STATES
from stiffopt.errors import FileError
from stiffopt.logs.log import Log
from stiffopt.logs.mcap_file import McapContents, read_mcap
from stiffopt.logs.mcap_log import LOG_METADATA, log_of_contents

_HELD = ("/limits",)  # topics that are logged only when they change


@dataclass(frozen=True)
class RunSpan:
    """An interval with one state and its reason, or with an alarm and its text; times in s."""

    begin: float
    end: float
    kind: str
    text: str


@dataclass(frozen=True, eq=False)
class RecordedRun:
    """A recorded run, in SI units; unknown values are NaN. Time 0 is the start of the recording.

    Fields of `stiffopt.control.state.Snapshot` that are logged as numbers, flags or arrays are
    attributes, with one row per tick: ``run.commanded`` is (N, n), ``run.position_error`` (N,).

    Attributes
    ----------
    about : metadata: ``rig``, ``robot``, ``robot_file`` (its text), ``stiffopt`` (version),
        ``start_ns`` (date of time 0, since 1970).
    channels : number of channels of each segment.
    time : of the ticks (N,), in s.
    fields : the state in each tick, by the names of `Snapshot`.
    captured : capture times of the tracker's samples (M,), in s, increasing.
    stiffness_unit : unit of the stiffnesses; all units if the recording has several or none.
    seen_position, seen_quaternion : of the tip in the samples (M, 3) and (M, 4), w first.
    doubted : samples (M,) too far for any motion of the arm, or that came with such a sample.
    states, alarms, events : in order of time.
    timing : the last ``/timing`` message; empty if there is none.
    complete : whether the recording was ended properly and is undamaged.
    """

    about: Mapping[str, str]
    channels: tuple[int, ...]
    time: Array
    fields: Mapping[str, Array]
    captured: Array
    seen_position: Array
    seen_quaternion: Array
    doubted: Flags
    states: tuple[RunSpan, ...] = ()
    alarms: tuple[RunSpan, ...] = ()
    events: tuple[Event, ...] = ()
    timing: Mapping[str, Any] = field(default_factory=dict)
    stiffness_unit: str = "N/m, N*m/rad"
    complete: bool = True

    def __getattr__(self, name: str) -> Array:
        try:
            return self.__dict__["fields"][name]
        except KeyError:
            raise AttributeError(f"a run has no '{name}'") from None

    def __len__(self) -> int:
        return len(self.time)

    @property
    def n(self) -> int:
        """Number of channels."""
        return sum(self.channels)

    def snapshots(self) -> Iterator[Snapshot]:
        """Yield the state in each tick; fields that were not logged have their defaults."""
        places = {entry.name: entry for entry in entries(Snapshot) if entry.name in self.fields}
        spans = iter(self.states)
        span = next(spans, None)
        for row, time in enumerate(self.time.tolist()):
            while span is not None and span.end <= time and (later := next(spans, None)):
                span = later
            logged: dict[str, Any] = {}
            for name, entry in places.items():
                value = self.fields[name][row]
                known = not entry.optional or bool(np.isfinite(value).any())
                if entry.kind in (Kind.NUMBER, Kind.COUNT, Kind.FLAG):
                    value = value.item()
                logged[name] = value if known else None
            state, reason = (State.UNCONFIGURED, "") if span is None else (span.kind, span.text)
            yield Snapshot(**{**logged, "time": time, "state": State(state), "reason": reason})


def read_run(path: str | os.PathLike[str]) -> RecordedRun:
    """Read a recording of the daemon, even if it was cut short by a kill.

    Raises `FileError`: it cannot be read, is no recording of a run, or has no whole message left;
    `MissingExtraError`: mcap is not installed.
    """
    found = read_mcap(path)
    if LOG_METADATA in found.metadata:
        raise FileError(
            path, "is a recording of an experiment; expected one of a run of 'stiffopt run'"
        )
    return _run_of_contents(path, found)


def read_log_of_recording(path: str | os.PathLike[str]) -> tuple[Log, bool]:
    """Read the log of a run or of an experiment (.mcap), and whether the recording is whole.

    Raises as `read_run`.
    """
    found = read_mcap(path)
    if LOG_METADATA in found.metadata:
        return log_of_contents(path, found), True
    run = _run_of_contents(path, found)
    return log_of_run(run), run.complete


def _run_of_contents(path: str | os.PathLike[str], found: McapContents) -> RecordedRun:
    about = found.metadata.get(METADATA, {})
    if not about:
        raise FileError(path, "is no recording of stiffopt; expected one (.mcap) of 'stiffopt run'")
    if about.get("format") != FORMAT:
        raise FileError(
            path, f"has the format '{about.get('format')}'; this stiffopt reads '{FORMAT}'"
        )
    if not found.of_topic("/pressure"):
        raise FileError(path, "has no complete message of a run; it was truncated too early")
    try:
        return _run(about, found)
    except (AttributeError, KeyError, MemoryError, OverflowError, ValueError, TypeError) as error:
        raise FileError(path, f"is damaged: {error}") from None


def _run(about: Mapping[str, str], found: McapContents) -> RecordedRun:
    begin = float(about["start_s"])
    channels = tuple(int(count) for count in about["channels"].split(","))
    n = sum(channels)
    time = _scalars(found.of_topic("/pressure"), "time_s") - begin
    frames = sorted(found.of_topic("/tracker"), key=lambda frame: float(frame["time_s"]))
    seen = {entry.name: _column(frames, entry, n) for entry in entries(SeenPose)}
    states, timing = found.of_topic("/state"), found.of_topic("/timing")
    units = {tip.get("stiffness_unit") for tip in found.of_topic("/tip")} - {None}
    return RecordedRun(
        about=about,
        channels=channels,
        time=time,
        fields=_fields(found, time, begin, n),
        captured=seen["time"] - begin,
        seen_position=seen["position"],
        seen_quaternion=seen["quaternion"],
        doubted=seen["doubted"] == 1,
        states=_states(states, begin, float(time[-1])),
        alarms=_alarms(states, begin, float(time[-1])),
        events=tuple(
            Event(float(e["time_s"]) - begin, e["kind"], e["text"], Severity(e["severity"]))
            for e in found.of_topic("/event")
        ),
        timing=timing[-1] if timing else {},
        stiffness_unit=str(units.pop()) if len(units) == 1 else RecordedRun.stiffness_unit,
        complete=found.complete,
    )


def _fields(found: McapContents, time: Array, begin: float, n: int) -> dict[str, Array]:
    """Return the state's numeric fields in ticks at times (N,)."""
    fields: dict[str, Array] = {}
    for entry in entries(Snapshot):
        topic = entry.shown.topic
        is_row = entry.in_array or entry.kind in (Kind.NUMBER, Kind.COUNT, Kind.FLAG)
        if not topic or not is_row:  # texts, records, and lists of any length
            continue
        messages = found.of_topic(topic)
        moments = _scalars(messages, "time_s") - begin
        rows = (_held if topic in _HELD else _rows_of)(time, moments)
        values = _picked(_column(messages, entry, n), rows)
        if entry.kind in (Kind.FLAG, Kind.FLAGS):
            values = values == 1
        elif entry.name.endswith("_time"):
            values = values - begin
        fields[entry.name] = values
    return fields


def _column(messages: Sequence[Mapping[str, Any]], entry: Entry, n: int) -> Array:
    """Return a field of messages, (N,) or (N, m); NaN where it is missing."""
    if entry.in_array:
        return _vectors(messages, entry.key, entry.shown.size or n)
    return _scalars(messages, entry.key)


def _scalars(messages: Sequence[Mapping[str, Any]], key: str) -> Array:
    return np.array([_number(message.get(key)) for message in messages], dtype=float)


def _vectors(messages: Sequence[Mapping[str, Any]], key: str, count: int) -> Array:
    unknown = [None] * count
    rows = [message.get(key) or unknown for message in messages]
    for row in rows:
        if len(row) != count:
            raise ValueError(f"{key} has {len(row)} numbers, not {count}")
    return np.array(rows, dtype=float).reshape(len(rows), count)


def _number(value: Any) -> float:
    return np.nan if value is None else float(value)


def _rows_of(time: Array, other: Array) -> NDArray[np.int_]:
    """Return for each tick the index of the message of the same tick, or -1."""
    if not len(other):
        return np.full(len(time), -1)
    at = np.minimum(np.searchsorted(other, time), len(other) - 1)
    return np.where(other[at] == time, at, -1)


def _held(time: Array, changes: Array) -> NDArray[np.int_]:
    """Return for each tick the index of the last message until then, or -1."""
    return np.searchsorted(changes, time, side="right") - 1


def _picked(values: Array, rows: NDArray[np.int_]) -> Array:
    """Return rows of values; NaN where the index is -1."""
    if not len(values):
        return np.full((len(rows), *values.shape[1:]), np.nan)
    picked = values[rows]
    picked[rows < 0] = np.nan
    return picked


def _states(messages: Sequence[Mapping[str, Any]], begin: float, end: float) -> tuple[RunSpan, ...]:
    spans: list[RunSpan] = []
    for index, message in enumerate(messages):
        state, reason = str(message["state"]), str(message.get("reason", ""))
        if state not in STATES:
            raise ValueError(f"there is no state '{state}'")
        start = float(message["time_s"]) - begin
        until = float(messages[index + 1]["time_s"]) - begin if index + 1 < len(messages) else end
        if spans and (spans[-1].kind, spans[-1].text) == (state, reason):
            start = spans.pop().begin
        spans.append(RunSpan(start, until, state, reason))
    return tuple(spans)


def _alarms(messages: Sequence[Mapping[str, Any]], begin: float, end: float) -> tuple[RunSpan, ...]:
    spans: list[RunSpan] = []
    open_since: dict[str, tuple[float, str]] = {}
    for message in messages:
        now = float(message["time_s"]) - begin
        standing = {alarm["kind"]: alarm for alarm in message["alarms"]}
        for kind in [kind for kind in open_since if kind not in standing]:
            since, text = open_since.pop(kind)
            spans.append(RunSpan(since, now, kind, text))
        for kind, alarm in standing.items():
            open_since.setdefault(kind, (_number(alarm.get("since_s", now)) - begin, alarm["text"]))
    spans += [RunSpan(since, end, kind, text) for kind, (since, text) in open_since.items()]
    return tuple(sorted(spans, key=lambda span: span.begin))


_GAP = 0.1  # s without a sample, after which rows without a tip are added ...
_STEP = 0.05  # ... at intervals of this, in s
_NEAR = 0.1  # s at most between a sample and its pressure reading
_DIGITS = 6  # of a time in s, as in log v1


def log_of_run(run: RecordedRun) -> Log:
    """Return the log of a run, with a row for each sample of the tracker; it may be empty.

    A doubted sample, or one without a tip, gives a row without a tip. Two samples of the same time
    give one row. Samples before the first command are left out, since their pressures are unknown.
    """
    within = (run.captured >= run.time[0]) & (run.captured <= run.time[-1] + _NEAR)
    captured = np.round(run.captured[within], _DIGITS)
    position = run.seen_position[within].copy()
    quaternion = run.seen_quaternion[within].copy()
    unknown = run.doubted[within] | ~np.isfinite(position).all(axis=1)
    position[unknown] = quaternion[unknown] = np.nan

    order = np.lexsort((unknown, captured))  # at equal times, samples with a tip come first
    captured, first = np.unique(captured[order], return_index=True)
    position, quaternion = position[order][first], quaternion[order][first]

    between = _fillers(run.time, captured)
    time = np.concatenate([captured, between])
    nothing = np.full((len(between), 1), np.nan)
    order = np.argsort(time, kind="stable")
    time = time[order]
    position = np.concatenate([position, nothing.repeat(3, axis=1)])[order]
    quaternion = np.concatenate([quaternion, nothing.repeat(4, axis=1)])[order]
    turns = bool(np.isfinite(quaternion).any())
    measured = _between(run, time)
    return Log(
        time=time,
        commanded=_commands_at(run, time),
        measured=measured if np.isfinite(measured).any() else None,
        tip_position=position,
        tip_quaternion=quaternion if turns else None,
    )


def _fillers(ticks: Array, captured: Array) -> Array:
    """Return times of ticks, `_STEP` apart, where no sample was captured for `_GAP`."""
    after = np.searchsorted(captured, ticks, side="right")
    edges = np.concatenate([[-np.inf], captured, [np.inf]])
    before, next_one = edges[after], edges[after + 1]
    alone = (next_one - before > _GAP) & (ticks - before >= _STEP) & (next_one - ticks >= _STEP)
    chosen: list[float] = []
    for tick in np.round(ticks[alone], _DIGITS):
        if not chosen or tick >= chosen[-1] + _STEP - 1e-9:
            chosen.append(float(tick))
    return np.array(chosen)


def _commands_at(run: RecordedRun, time: Array) -> Array:
    """Return the commands (N, n) that held at times (N,); NaN where ticks are missing."""
    slack = 10.0**-_DIGITS  # times were rounded
    tick = np.maximum(np.searchsorted(run.time, time + slack, side="right") - 1, 0)
    period = float(np.median(np.diff(run.time))) if len(run) > 1 else 0.0
    commanded = run.commanded[tick]
    commanded[time - run.time[tick] > max(_NEAR, 3 * period)] = np.nan
    return commanded


def _between(run: RecordedRun, time: Array) -> Array:
    """Return measured pressures (N, n) at times (N,), NaN where no reading is near."""
    read = np.where(np.isfinite(run.measured_time), run.measured_time, run.time)
    read, first = np.unique(read, return_index=True)
    values = run.measured[first]
    measured = np.full((len(time), run.n), np.nan)
    for channel in range(run.n):
        known = np.isfinite(values[:, channel])
        if known.any():
            at = read[known]
            line = np.interp(time, at, values[known, channel])
            after = np.searchsorted(at, time)
            edges = np.concatenate([[-np.inf], at, [np.inf]])
            nearest = np.minimum(time - edges[after], edges[after + 1] - time)
            measured[:, channel] = np.where(nearest <= _NEAR, line, np.nan)
    return measured
