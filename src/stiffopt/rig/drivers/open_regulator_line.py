"""The serial line to an open regulator: frames, requests and answers (docs/open-regulator.md)."""

from __future__ import annotations

import binascii
import struct
import time
from contextlib import suppress
from dataclasses import dataclass
from threading import RLock
from typing import Any, Self

from stiffopt.errors import DeviceError
from stiffopt.rig.device import library

VERSION = 1
EXTRA = "open-regulator"
UNIT = 10.0
"""Unit of pressures on the line, in Pa."""

IDENTITY, LIMITS, ARM, SET, VENT, READ, STATISTICS = range(1, 8)
REPLY, ERROR_REPLY = 0x80, 0xFF
IS_VENTED = 6
_LOOK = 0.005  # s between checks of the time while nothing arrives
_NAMES = {
    IDENTITY: "say what it is",
    LIMITS: "take limits",
    ARM: "arm",
    SET: "take set-points",
    VENT: "vent",
    READ: "report",
    STATISTICS: "report statistics",
}
_CAUSES = {
    1: "it was switched on",
    2: "it was reset, by its button or because the serial port was opened",
    3: "its supply voltage had dropped (brown-out)",
    4: "its program had hung and the watchdog restarted it",
    5: "it was told to",
    6: "no command had come in time",
    7: "the sensor of {} is broken or not connected",
    8: "the pressure of {} was above its limit",
    9: "the pressure of {} did not follow its set-point",
    10: "air was let into {} and its sensor did not show it",
}
_ERRORS = {
    1: "it speaks another version of the protocol",
    2: "it does not know this request",
    3: "the request has the wrong length for it",
    4: "a value is out of its range",
    5: "the command came too late",
    7: "something is wrong: {fault}",
    8: "it is armed",
}


@dataclass(frozen=True)
class Identity:
    """The identity of a board, as it reports it."""

    board: int  # its number
    version: int  # of the protocol
    firmware: str  # its version
    channels: int  # number of channels
    silence: float  # time without a command after which it vents, in s
    # max_pressure, max_slew: limits that it never exceeds, in Pa and Pa/s
    max_pressure: float
    max_slew: float

    @classmethod
    def of(cls, board: int, payload: bytes) -> Self:
        """Decode a payload, which is the same in all versions of the protocol."""
        version, major, minor, channels, silence, pressure, slew = struct.unpack(
            "<BBBBHHH", payload
        )
        limits = (silence * 1e-3, pressure * UNIT, slew * UNIT * 1e3)
        return cls(board, version, f"{major}.{minor}", channels, *limits)


@dataclass(frozen=True)
class Status:
    """A report of a board.

    Attributes
    ----------
    time : since the board's start, in ms.
    armed : whether it accepts set-points; otherwise it is vented.
    reason : why it is vented, or was last, in words.
    supply : pressure in front of the valves, in units.
    set_points, readings : of each channel, in units.
    """

    time: int
    armed: bool
    reason: str
    supply: int
    set_points: tuple[int, ...]
    readings: tuple[int, ...]

    @classmethod
    def of(cls, payload: bytes) -> Self:
        """Decode a payload; raise `DeviceError` if it is invalid."""
        if len(payload) < 13 or len(payload) % 4 != 1:
            raise DeviceError(f"a report of {len(payload)} bytes makes no sense")
        moment, armed, cause, channel, supply = struct.unpack_from("<IBBBh", payload)
        values = struct.unpack_from(f"<{(len(payload) - 9) // 2}h", payload, 9)
        reason = in_words(cause, channel, len(values) // 2)
        return cls(moment, bool(armed), reason, supply, values[::2], values[1::2])


def in_words(cause: int, channel: int, n: int = 6) -> str:
    """Return why a board has vented; the channel after the last one is the supply line."""
    place = f"its channel {channel}" if channel <= n else "the supply line"
    return _CAUSES.get(cause, f"of cause {cause}").format(place)


def framed(body: bytes) -> bytes:
    """Return the frame of a body: with its CRC, COBS-encoded, between zeros."""
    whole = body + struct.pack("<H", binascii.crc_hqx(body, 0xFFFF))
    return b"\0" + bytes(_cobs().encode(whole)) + b"\0"


def body_of(frame: bytes) -> bytes | None:
    """Return the body of a frame (without zeros), or None if its CRC is wrong."""
    with suppress(_cobs().DecodeError):
        whole = bytes(_cobs().decode(frame))
        if len(whole) >= 6 and binascii.crc_hqx(whole[:-2], 0xFFFF) == int.from_bytes(
            whole[-2:], "little"
        ):
            return whole[:-2]
    return None


class BoardLine:
    """Sends requests to a board and returns its answers; nothing is sent twice.

    After a failure, old input is dropped before the next request; a lost port is reopened. Any
    thread may call any method.

    Parameters
    ----------
    port, baudrate : of the serial line.
    board : number of the board that must answer.
    timeout : time for each answer, in s.
    """

    def __init__(self, port: str, baudrate: int, board: int, timeout: float) -> None:
        self.port, self.baudrate = port, baudrate
        self.board, self.timeout = board, timeout
        self._serial: Any = None
        self._sequence = 0
        self._doubtful = False  # whether a late answer may come
        self._failures = _failures()
        self._lock = RLock()

    def __str__(self) -> str:
        return f"the open regulator on {self.port}"

    def close(self) -> None:
        """Close the port."""
        with self._lock:
            line, self._serial = self._serial, None
            if line is not None:
                with suppress(*self._failures):
                    line.close()

    def identity(self, timeout: float) -> Identity:
        """Return the identity of any board on the line; wait for it up to `timeout`, in s."""
        body = self._exchange(IDENTITY, b"", 0, timeout)
        if body[3] == ERROR_REPLY or len(body) < 14:
            raise DeviceError(wrong_version(str(self), body[0]))
        return Identity.of(body[1], body[4:14])

    def status(self, kind: int = READ, payload: bytes = b"") -> Status:
        """Send a request whose answer is a status; return it."""
        return Status.of(self.ask(kind, payload))

    def ask(self, kind: int, payload: bytes = b"") -> bytes:
        """Send a request and return the payload of the answer.

        Raises `DeviceError`: the board refuses, does not answer, or answers wrongly.
        """
        body = self._exchange(kind, payload, self.board, self.timeout)
        if body[0] != VERSION:
            raise DeviceError(wrong_version(str(self), body[0]))
        if body[3] == ERROR_REPLY:
            raise self._refusal(kind, body[4:])
        return body[4:]

    def _refusal(self, kind: int, payload: bytes) -> DeviceError:
        code, _, cause, channel, fault, faulty = payload[:6]
        if code == IS_VENTED:
            told = f"it has vented: {in_words(cause, channel)}"
        else:
            told = _ERRORS.get(code, f"error {code}").format(fault=in_words(fault, faulty))
        return DeviceError(f"{self} does not {_NAMES[kind]}: {told}")

    def _exchange(self, kind: int, payload: bytes, board: int, timeout: float) -> bytes:
        with self._lock:
            self._sequence = self._sequence % 255 + 1
            head = bytes((VERSION, board, self._sequence, kind))
            try:
                line = self._ready()
                line.write(framed(head + payload))
                body = self._answer(line, kind, timeout)
            except self._failures as error:
                self.close()
                raise DeviceError(
                    f"{self} cannot be reached: {error}; is it plugged in, is the port right, may "
                    "you use it (group dialout)?"
                ) from None
            except BaseException:
                self._doubtful = True
                raise
        if board not in (0, body[1]):
            raise DeviceError(f"board {body[1]} answers on {self.port} for board {board}")
        return body

    def _ready(self) -> Any:
        """Return the port, open and without old input."""
        if self._serial is None:
            self._serial = self._port()
            self._doubtful = True
        if self._doubtful:
            self._serial.reset_input_buffer()
            self._doubtful = False
        elif self._serial.in_waiting:
            raise DeviceError(
                f"{self} sent an unrequested message: is there a second board or a second "
                "program on this line?"
            )
        return self._serial

    def _port(self) -> Any:
        serial = library("serial", "pyserial", EXTRA)
        return serial.Serial(self.port, self.baudrate, timeout=_LOOK, write_timeout=self.timeout)

    def _answer(self, line: Any, kind: int, timeout: float) -> bytes:
        end, received = time.monotonic() + timeout, b""
        while not received.endswith(b"\0"):
            received += line.read(line.in_waiting or 1)
            if time.monotonic() > end:
                heard = "sends noise" if received else "does not answer"
                within = f"within {timeout * 1e3:g} ms"
                raise DeviceError(f"{self} was asked to {_NAMES[kind]} and {heard} {within}")
        body = body_of(received[:-1])
        if body is None:
            raise DeviceError(f"{self} was not understood when asked to {_NAMES[kind]}: noise")
        if body[2] != self._sequence or body[3] not in (kind | REPLY, ERROR_REPLY):
            raise DeviceError(f"{self} sent an answer to another request")
        return body


def wrong_version(who: str, version: int) -> str:
    """Return the message for a board with another protocol."""
    return (
        f"{who} speaks version {version} of the protocol and this driver version {VERSION}; write "
        "the firmware of this stiffopt to the board (make -C firmware flash)"
    )


def _cobs() -> Any:
    return library("cobs.cobs", "cobs", EXTRA)


def _failures() -> tuple[type[Exception], ...]:
    """Return the exceptions that pyserial raises or lets through when a port is gone."""
    with suppress(ImportError):
        import termios

        return OSError, ValueError, termios.error
    return OSError, ValueError
