"""What the control loop and the guard process say to each other, and the socket they say it on.

Every message is one packet of a local socket that keeps packets apart. The frequent ones are
packed, the rest is JSON. All times are on `time.monotonic`, which is one clock for all processes.
"""

from __future__ import annotations

import json
import math
import select
import socket
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.rig.interface import PoseSample

__all__ = ["Answer", "Channel", "CommandFrame", "Message", "Poses", "Request", "Word", "unpack"]

Array = NDArray[np.float64]

_LARGEST = 1 << 16  # bytes of a packet
_COMMAND = struct.Struct("<cQddd")
_ANSWER = struct.Struct("<cQQQ???dH")
_AT_ONCE = 1000  # packets: whoever sends without end must not keep the other from all else
_NUMBERS = 1 << 64
_POSE = 10  # numbers: time, received, frame, position, quaternion


@dataclass(frozen=True)
class CommandFrame:
    """A command of pressures.

    Attributes
    ----------
    sequence : counts whatever is sent to the guard.
    sent : when, in s.
    time, valid_for : of the command, in s.
    pressures : (n,), in Pa.
    goal : whether the guard shall approach and repeat it while it is valid, see
        `stiffopt.safety.goal`; otherwise it is one of a stream whose silence makes the guard vent.
    """

    sequence: int
    sent: float
    time: float
    valid_for: float
    pressures: Array
    goal: bool = False

    def pack(self) -> bytes:
        """Return the packet."""
        kind = b"G" if self.goal else b"C"
        head = _COMMAND.pack(kind, self.sequence, self.sent, self.time, self.valid_for)
        return head + np.ascontiguousarray(self.pressures, dtype="<f8").tobytes()


@dataclass(frozen=True)
class Answer:
    """What became of what was sent to the guard, and how things stand there.

    Attributes
    ----------
    sequence : of the newest that this answers; older commands without an answer were overtaken.
    commanded : what the supply has been told (n,), in Pa.
    measured, time : pressures (n,), in Pa, and when they were read; NaN where unknown.
    armed, limited : whether commands are taken, and whether this one was limited.
    force_limited : whether it was limited for the total force.
    trips : how often the guard has tripped so far.
    broken : packets so far that the guard could not understand.
    tripped : why it is tripped now; empty where it is not.
    refused : why the command was not passed on; empty where it was.
    error : what the supply or the guard could not do; empty where it could.
    value : what was asked for, for requests that ask for something else.
    """

    sequence: int
    commanded: Array
    measured: Array
    time: float
    armed: bool = False
    limited: bool = False
    force_limited: bool = False
    trips: int = 0
    broken: int = 0
    tripped: str = ""
    refused: str = ""
    error: str = ""
    value: Any = None

    def pack(self) -> bytes:
        """Return the packet."""
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
class Request:
    """Something else that the guard shall do: ``arm``, ``vent``, ``read``, ``close`` and others.

    Attributes
    ----------
    sequence : counts whatever is sent to the guard.
    do : the word.
    about : what it needs to know.
    """

    sequence: int
    do: str
    about: dict[str, Any] = field(default_factory=dict)

    def pack(self) -> bytes:
        """Return the packet."""
        return b"R" + json.dumps([self.sequence, self.do, self.about]).encode()


@dataclass(frozen=True)
class Word:
    """Something that the guard says unasked: ``ready``, ``failed`` or ``notice``.

    Attributes
    ----------
    kind : which of them.
    about : the rest.
    """

    kind: str
    about: dict[str, Any] = field(default_factory=dict)

    def pack(self) -> bytes:
        """Return the packet."""
        return b"W" + json.dumps([self.kind, self.about]).encode()


@dataclass(frozen=True)
class Poses:
    """Samples of a tracker that the guard process hosts."""

    samples: tuple[PoseSample, ...]

    def pack(self) -> bytes:
        """Return the packet."""
        rows = np.full((len(self.samples), _POSE), np.nan)
        for row, sample in zip(rows, self.samples, strict=True):
            row[:3] = sample.time, sample.received, sample.frame
            row[3:6] = sample.position
            if sample.quaternion is not None:
                row[6:] = sample.quaternion
        return b"P" + rows.astype("<f8").tobytes()


Message = CommandFrame | Answer | Request | Word | Poses


def unpack(packet: bytes) -> Message:
    """Return the message in a packet.

    Raises
    ------
    ValueError
        It is not one.
    """
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
                return Request(_number(sequence), _text(do), _named(about))
            case b"W":
                kind, about = json.loads(packet[1:])
                return Word(_text(kind), _named(about))
            case b"P":
                rows = _numbers(packet[1:]).reshape(-1, _POSE)
                return Poses(tuple(_pose(row) for row in rows))
    except (struct.error, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"a broken packet: {error}") from None
    raise ValueError(f"a packet of unknown kind: {packet[:1]!r}")


def _number(given: Any) -> int:
    """Return what can be sent back as the number of a message."""
    if type(given) is not int or not 0 <= given < _NUMBERS:
        raise ValueError("the number of a message is a whole one of 64 bits")
    return given


def _text(given: Any) -> str:
    if not isinstance(given, str):
        raise ValueError("expected a word")
    return given


def _named(given: Any) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise ValueError("expected things with names")
    return given


def _numbers(packed: bytes) -> Array:
    return np.frombuffer(packed, "<f8").astype(float)  # a copy: aligned, and one may write to it


def _answer(packet: bytes) -> Answer:
    _, sequence, trips, broken, armed, limited, forced, time, n = _ANSWER.unpack_from(packet)
    end = _ANSWER.size + 16 * n
    numbers = _numbers(packet[_ANSWER.size : end]).reshape(2, n)
    tail = json.loads(packet[end:]) if len(packet) > end else ("", "", "", None)
    known = (sequence, numbers[0], numbers[1], time, armed, limited, forced, trips, broken)
    return Answer(*known, *tail)


def _pose(row: Array) -> PoseSample:
    time, received, frame = row[:3]
    quaternion = None if np.isnan(row[6:]).any() else row[6:]
    return PoseSample(float(time), float(received), int(frame), row[3:6], quaternion)


class Channel:
    """One end of a local socket that keeps packets apart. Nothing here waits for the other side.

    Parameters
    ----------
    end :
        Of a pair of the kind `socket.SOCK_SEQPACKET`.

    Attributes
    ----------
    closed : whether the other end is gone, or this one was closed.
    broken : packets that were no messages, and were left out.
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
        """Let a wait end also when one of these can be read."""
        for descriptor in descriptors:
            self._poll.register(descriptor, select.POLLIN)

    def send(self, message: Message) -> bool:
        """Send a message; say whether it could be, which it cannot where nobody takes any."""
        try:
            self._end.send(message.pack())
        except BlockingIOError:
            return False
        except OSError:
            self.closed = True
            return False
        return True

    def receive(self, wait: float = 0.0) -> list[Message]:
        """Return all that has come; wait up to `wait` s for something. What is broken is left out.

        A pause is measured in whole milliseconds, rounded up.
        """
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
        """Say whether nothing more can come: an empty packet reads like the end."""
        gone = select.POLLHUP | select.POLLRDHUP | select.POLLERR | select.POLLNVAL
        return any(events & gone for _, events in self._hang_up.poll(0))

    def close(self) -> None:
        """Let the other end know that nothing more comes."""
        self.closed = True
        self._end.close()
