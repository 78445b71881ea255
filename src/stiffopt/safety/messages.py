"""Messages between the guard process and its client, and the local socket that carries them.

Each message is one packet of a ``SOCK_SEQPACKET`` socket. The frequent ones (commands, answers and
poses) are packed in binary form, the others are JSON. All times are on `time.monotonic`, one clock
for all processes of a machine.
"""

from __future__ import annotations

import json
import math
import select
import socket
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.rig.interface import PoseSample

_LARGEST = 1 << 16  # bytes in a packet
_COMMAND = struct.Struct("<cQddd")
_ANSWER = struct.Struct("<cQQQ???dH")
_AT_ONCE = 1000  # packets per receive: a flood must not keep the receiver from its other work
_SEQUENCE_END = 1 << 64
_POSE = 10  # numbers per pose: time, received, frame, position (3), quaternion (4)
JSON = "json"
"""Command line argument that makes a guard process write JSON lines on stderr."""


@dataclass(frozen=True)
class CommandFrame:
    """A pressure command to the guard."""

    sequence: int  # number of the message; the client counts all its messages
    sent: float  # when it was sent, in s
    # time, valid_for: when the command was given and for how long it is valid, in s
    time: float
    valid_for: float
    pressures: Array  # (n,), in Pa
    # True: the guard approaches and repeats the pressures while they are valid, see
    # `stiffopt.safety.goal`. False: one command of a stream; the guard vents when the stream stops
    goal: bool = False

    def pack(self) -> bytes:
        """Return the packet (bytes)."""
        kind = b"G" if self.goal else b"C"
        head = _COMMAND.pack(kind, self.sequence, self.sent, self.time, self.valid_for)
        return head + np.ascontiguousarray(self.pressures, dtype="<f8").tobytes()


@dataclass(frozen=True)
class GuardAnswer:
    """The guard's answer to a command or request, with the state of the supply."""

    # number of the message that is answered; 0: a report of the guard. It replaces the missing
    # answers to older commands
    sequence: int
    commanded: Array  # set-points (n,) of the supply, in Pa
    # measured, time: measured pressures (n,), in Pa, and when they were read; NaN if unknown
    measured: Array
    time: float
    armed: bool = False  # whether the guard accepts commands
    # limited, force_limited: whether the command was limited at all, and by the total force
    limited: bool = False
    force_limited: bool = False
    trips: int = 0  # number of trips of the guard so far
    broken: int = 0  # number of packets so far that the guard could not decode
    tripped: str = ""  # why the guard is tripped now; empty if it is not
    refused: str = ""  # why the command was refused; empty if it was carried out
    error: str = ""  # why the request failed; empty if it did not
    value: Any = None  # result of a request that has one

    def pack(self) -> bytes:
        """Return the packet (bytes)."""
        head = _ANSWER.pack(
            b"A",
            self.sequence,
            self.trips,
            self.broken,
            self.armed,
            self.limited,
            self.force_limited,
            self.time,
            len(self.commanded),
        )
        tail = [self.tripped, self.refused, self.error, self.value]
        rest = b"" if tail == ["", "", "", None] else json.dumps(tail).encode()
        return head + np.concatenate([self.commanded, self.measured]).astype("<f8").tobytes() + rest


@dataclass(frozen=True)
class GuardRequest:
    """A request to the guard: ``arm``, ``vent``, ``read``, ``restrict``, ``ping``, ``close`` ..."""

    sequence: int  # number of the message; the client counts all its messages
    do: str  # name of the request
    about: dict[str, Any] = field(default_factory=dict)  # its arguments by name

    def pack(self) -> bytes:
        """Return the packet (bytes)."""
        return b"R" + json.dumps([self.sequence, self.do, self.about]).encode()


@dataclass(frozen=True)
class GuardNotice:
    """A report of a starting guard: ``notice``, then ``ready`` or ``failed``.

    `kind`: which of these. `about`: its details by name.
    """

    kind: str
    about: dict[str, Any] = field(default_factory=dict)

    def pack(self) -> bytes:
        """Return the packet (bytes)."""
        return b"W" + json.dumps([self.kind, self.about]).encode()


@dataclass(frozen=True)
class TrackedPoses:
    """Samples of a simulated tracker in the guard process."""

    samples: tuple[PoseSample, ...]

    def pack(self) -> bytes:
        """Return the packet (bytes)."""
        rows = np.full((len(self.samples), _POSE), np.nan)
        for row, sample in zip(rows, self.samples, strict=True):
            row[:3] = sample.time, sample.received, sample.frame
            row[3:6] = sample.position
            if sample.quaternion is not None:
                row[6:] = sample.quaternion
        return b"P" + rows.astype("<f8").tobytes()


Message = CommandFrame | GuardAnswer | GuardRequest | GuardNotice | TrackedPoses


def unpack(packet: bytes) -> Message:
    """Decode a packet. Raises `ValueError`: the packet is no valid message."""
    try:
        match packet[:1]:
            case b"C" | b"G" as kind:
                _, sequence, sent, time, valid_for = _COMMAND.unpack_from(packet)
                pressures = _numbers(packet[_COMMAND.size :])
                return CommandFrame(sequence, sent, time, valid_for, pressures, kind == b"G")
            case b"A":
                return _answer(packet)
            case b"R":
                sequence, do, about = json.loads(packet[1:])
                _require((sequence, int), (do, str), (about, dict))
                if not 0 <= sequence < _SEQUENCE_END:  # it must fit into the answer
                    raise ValueError("a sequence number is an unsigned integer of 64 bits")
                return GuardRequest(sequence, do, about)
            case b"W":
                kind, about = json.loads(packet[1:])
                _require((kind, str), (about, dict))
                return GuardNotice(kind, about)
            case b"P":
                rows = _numbers(packet[1:]).reshape(-1, _POSE)
                return TrackedPoses(tuple(_pose(row) for row in rows))
    except (struct.error, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"a broken packet: {error}") from None
    raise ValueError(f"a packet of unknown kind: {packet[:1]!r}")


def _require(*given: tuple[Any, type]) -> None:
    """Raise `ValueError` unless each value is exactly of its type; True is no integer here."""
    for value, kind in given:
        if type(value) is not kind:
            raise ValueError(f"expected {kind.__name__}, not {type(value).__name__}")


def _numbers(packed: bytes) -> Array:
    return np.frombuffer(packed, "<f8").astype(float)  # a copy: aligned and writable


def _answer(packet: bytes) -> GuardAnswer:
    _, sequence, trips, broken, armed, limited, forced, time, n = _ANSWER.unpack_from(packet)
    end = _ANSWER.size + 16 * n
    numbers = _numbers(packet[_ANSWER.size : end]).reshape(2, n)
    tail = json.loads(packet[end:]) if len(packet) > end else ("", "", "", None)
    known = (sequence, numbers[0], numbers[1], time, armed, limited, forced, trips, broken)
    return GuardAnswer(*known, *tail)


def _pose(row: Array) -> PoseSample:
    time, received, frame = row[:3]
    quaternion = None if np.isnan(row[6:]).any() else row[6:]
    return PoseSample(float(time), float(received), int(frame), row[3:6], quaternion)


class GuardChannel:
    """One end of the socket between guard and client; it never waits for the other end.

    Parameters
    ----------
    end : one end of a `socket.SOCK_SEQPACKET` pair.

    Attributes
    ----------
    closed : whether either end is closed.
    broken : number of packets that could not be decoded and were dropped.
    """

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._end.setblocking(False)
        self._poll = select.poll()
        self._poll.register(end, select.POLLIN | select.POLLRDHUP)
        self._hang_up = select.poll()
        self._hang_up.register(end, select.POLLIN | select.POLLRDHUP)
        self.closed = False
        self.broken = 0

    def wake_for(self, descriptors: Sequence[int]) -> None:
        """Make `receive` return early if one of these file descriptors becomes readable."""
        for descriptor in descriptors:
            self._poll.register(descriptor, select.POLLIN)

    def send(self, message: Message) -> bool:
        """Send a message; return False if the socket is full or closed."""
        try:
            self._end.send(message.pack())
        except BlockingIOError:
            return False
        except OSError:
            self.closed = True
            return False
        return True

    def receive(self, wait: float = 0.0) -> list[Message]:
        """Return all messages that have arrived; wait up to `wait` s (rounded up to ms) for one."""
        messages: list[Message] = []
        if not self.closed and wait > 0:
            self._poll.poll(math.ceil(wait * 1e3))
        for _ in range(_AT_ONCE):
            if self.closed:
                break
            try:
                packet = self._end.recv(_LARGEST)
            except BlockingIOError:
                break
            except OSError:
                self.closed = True
                break
            if not packet and self._hung_up():
                self.closed = True
                break
            try:
                messages.append(unpack(packet))
            except ValueError:
                self.broken += 1
        return messages

    def _hung_up(self) -> bool:
        """Return whether the other end is closed; an empty packet alone does not mean that."""
        gone = select.POLLHUP | select.POLLRDHUP | select.POLLERR | select.POLLNVAL
        return any(events & gone for _, events in self._hang_up.poll(0))

    def close(self) -> None:
        """Close this end, which the other one notices."""
        self.closed = True
        self._end.close()


def json_line(level: str, kind: str, text: str, when: datetime | None = None, **more: Any) -> str:
    """Return a log line for programs: JSON with ``time`` (UTC), ``level``, ``kind``, ``text``.

    Parameters
    ----------
    level, kind, text : severity (``info``, ``warning``, ``error``), a word for programs, a sentence
        for people.
    when : time with its time zone; None: now.
    more : further keys.
    """
    moment = (when or datetime.now(UTC)).astimezone(UTC)
    stamp = moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
    told = {"time": stamp, "level": level, "kind": kind, "text": text, **more}
    return json.dumps(told, ensure_ascii=True)
