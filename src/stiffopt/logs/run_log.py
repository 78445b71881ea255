"""What the daemon has recorded of a run, read back: whatever is whole, also after a kill."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import FileError
from stiffopt.logs.mcap_log import require_mcap
from stiffopt.logs.run_schemas import FORMAT, METADATA, STATES

__all__ = ["Run", "RunEvent", "RunSpan", "is_of_experiment", "read_run"]

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_EXPERIMENT = "stiffopt-log"  # metadata of the recordings of experiments
_FOREIGN = "is no recording of stiffopt; expected one (.mcap) of 'stiffopt run'"


@dataclass(frozen=True)
class RunEvent:
    """Something that happened; see `stiffopt.control.state.Event`. The time is that of the run."""

    time: float
    kind: str
    text: str
    severity: str


@dataclass(frozen=True)
class RunSpan:
    """A time in which something was so: a state with its reason, an alarm with its text."""

    begin: float
    end: float
    kind: str
    text: str


@dataclass(frozen=True, eq=False)
class Run:
    """A run, in SI units; what is missing is NaN. Time 0 is when the recording began.

    Attributes
    ----------
    about : what the recording says of itself: ``rig``, ``robot``, ``robot_file`` (its text),
        ``stiffopt`` (version), ``start_ns`` (date of time 0, since 1970).
    channels : number of channels of each segment.
    time : of the ticks (N,), in s.
    commanded, measured, plan, low, high : pressures and limits (N, n), in Pa.
    measured_time : when `measured` was read (N,), in s.
    saturated : channels (N, n) at a limit that kept them from doing what they should.
    tip, target : estimated position and the one asked for (N, 3), in m.
    position_error, angle_error : of the estimate (N,), in m and rad.
    stiffness, best_stiffness : along the task's direction (N,), in N/m or N m/rad.
    captured : when the tracker captured its frames (M,), in s, increasing.
    seen_position, seen_quaternion : where it saw the tip (M, 3) and (M, 4), w first.
    doubted : frames (M,) that no arm could have moved to, or that came with such a one.
    states, alarms : in order of time.
    events : in order of time.
    timing : the last ``/timing`` message; empty if there is none.
    complete : whether the recording was ended properly, and nothing in it is damaged.
    """

    about: Mapping[str, str]
    channels: tuple[int, ...]
    time: Array
    commanded: Array
    measured: Array
    measured_time: Array
    plan: Array
    low: Array
    high: Array
    saturated: Flags
    tip: Array
    target: Array
    position_error: Array
    angle_error: Array
    stiffness: Array
    best_stiffness: Array
    captured: Array
    seen_position: Array
    seen_quaternion: Array
    doubted: Flags
    states: tuple[RunSpan, ...] = ()
    alarms: tuple[RunSpan, ...] = ()
    events: tuple[RunEvent, ...] = ()
    timing: Mapping[str, Any] = field(default_factory=dict)
    complete: bool = True

    def __len__(self) -> int:
        return len(self.time)

    @property
    def n(self) -> int:
        """Number of channels."""
        return int(self.commanded.shape[1])


def read_run(path: str | os.PathLike[str]) -> Run:
    """Read a recording of the daemon, also one that was cut short by a kill.

    Raises
    ------
    FileError
        It cannot be read, is no recording of a run, or nothing whole is left of it.
    MissingExtraError
        mcap is not installed.
    """
    require_mcap()
    name = os.fspath(path)
    with _opened(name) as stream:
        about, messages, complete = _messages(stream, name)
    if not messages["/pressure"]:
        raise FileError(name, "has no whole message of a run; it was cut short too early")
    try:
        return _run(about, messages, complete)
    except (KeyError, ValueError, TypeError) as error:
        raise FileError(name, f"is damaged: {error}") from None


def is_of_experiment(path: str | os.PathLike[str]) -> bool:
    """Whether a recording is one of an experiment, for `read_mcap_log`.

    Raises
    ------
    FileError
        It cannot be read, or is no recording of stiffopt.
    MissingExtraError
        mcap is not installed.
    """
    require_mcap()
    from mcap.records import Metadata

    name = os.fspath(path)
    with _opened(name) as stream:
        for record in _records(stream):
            if isinstance(record, Metadata) and record.name in (METADATA, _EXPERIMENT):
                return record.name == _EXPERIMENT
    raise FileError(name, _FOREIGN)


@contextmanager
def _opened(name: str) -> Iterator[BinaryIO]:
    """Context with a file, whose errors are readable."""
    try:
        with open(name, "rb") as stream:
            yield stream
    except FileNotFoundError:
        raise FileError(name, "there is no such file") from None
    except IsADirectoryError:
        raise FileError(name, "is a folder; expected a recording (.mcap)") from None
    except OSError as error:
        raise FileError(name, f"cannot be read: {(error.strerror or '').lower()}") from None


def _records(stream: BinaryIO) -> Iterator[Any]:
    """Yield records up to the end, or to where it was cut short; damaged chunks are left out."""
    from mcap.exceptions import McapError
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader, breakup_chunk

    records = iter(StreamReader(stream, emit_chunks=True).records)
    while True:
        try:
            record = next(records)
        except (StopIteration, McapError, EOFError, struct.error, ValueError):
            return
        if not isinstance(record, Chunk):
            yield record
            continue
        try:
            parts = breakup_chunk(record, validate_crc=True)
        except Exception:  # whatever a decompressor makes of noise
            yield None
            continue
        yield from parts


def _messages(stream: BinaryIO, name: str) -> tuple[dict[str, str], dict[str, list[Any]], bool]:
    """Return metadata, messages by topic in the order in which they were logged, and the end."""
    from mcap.records import Channel, Footer, Message, Metadata

    about: dict[str, str] = {}
    topics: dict[int, str] = {}
    wanted = ("/pressure", "/limits", "/tip", "/tracker", "/state", "/timing", "/event")
    found: dict[str, list[Any]] = {topic: [] for topic in wanted}
    complete, damaged = False, False
    for record in _records(stream):
        if record is None:
            damaged = True
        elif isinstance(record, Message):
            topic = topics.get(record.channel_id, "")
            if topic in found:
                found[topic].append(_parsed(record.data, name))
        elif isinstance(record, Channel):
            topics[record.id] = record.topic if record.message_encoding == "json" else ""
        elif isinstance(record, Metadata) and record.name in (METADATA, _EXPERIMENT):
            about = {**record.metadata, "record": record.name}
            _must_be_run(about, name)
        elif isinstance(record, Footer):
            complete = True
    if not about:
        raise FileError(name, _FOREIGN)
    return about, found, complete and not damaged


def _must_be_run(about: Mapping[str, str], name: str) -> None:
    if about["record"] == _EXPERIMENT:
        raise FileError(
            name, "is a recording of an experiment; expected one of a run of 'stiffopt run'"
        )
    if about.get("format") != FORMAT:
        raise FileError(
            name, f"has the format '{about.get('format')}'; this stiffopt reads '{FORMAT}'"
        )


def _parsed(data: bytes, name: str) -> Any:
    try:
        return json.loads(data)
    except ValueError:
        raise FileError(name, "is damaged: a message is no JSON") from None


def _run(about: Mapping[str, str], messages: Mapping[str, list[Any]], complete: bool) -> Run:
    begin = float(about["start_s"])
    channels = tuple(int(count) for count in about["channels"].split(","))
    n = sum(channels)
    ticks, tips = messages["/pressure"], messages["/tip"]
    time = _scalars(ticks, "time_s") - begin
    tip_rows = _rows_of(time, _scalars(tips, "time_s") - begin)
    limits = messages["/limits"]
    held = _held(time, _scalars(limits, "time_s") - begin)
    frames = sorted(messages["/tracker"], key=lambda frame: float(frame["time_s"]))

    def of_tip(values: Array) -> Array:
        return _picked(values, tip_rows)

    return Run(
        about=about,
        channels=channels,
        time=time,
        commanded=_vectors(ticks, "commanded_pa", n),
        measured=_vectors(ticks, "measured_pa", n),
        measured_time=_scalars(ticks, "measured_time_s") - begin,
        plan=_vectors(ticks, "plan_pa", n),
        low=_picked(_vectors(limits, "low_pa", n), held),
        high=_picked(_vectors(limits, "high_pa", n), held),
        saturated=_vectors(ticks, "saturated", n) == 1,
        tip=of_tip(_vectors(tips, "position_m", 3)),
        target=of_tip(_vectors(tips, "target_position_m", 3)),
        position_error=of_tip(_scalars(tips, "position_error_m")),
        angle_error=of_tip(_scalars(tips, "angle_error_rad")),
        stiffness=of_tip(_scalars(tips, "stiffness")),
        best_stiffness=of_tip(_scalars(tips, "best_stiffness")),
        captured=_scalars(frames, "time_s") - begin,
        seen_position=_vectors(frames, "position_m", 3),
        seen_quaternion=_vectors(frames, "quaternion_wxyz", 4),
        doubted=np.array([bool(frame.get("doubted")) for frame in frames], dtype=bool),
        states=_states(messages["/state"], begin, float(time[-1])),
        alarms=_alarms(messages["/state"], begin, float(time[-1])),
        events=tuple(
            RunEvent(float(e["time_s"]) - begin, e["kind"], e["text"], e["severity"])
            for e in messages["/event"]
        ),
        timing=messages["/timing"][-1] if messages["/timing"] else {},
        complete=complete,
    )


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
