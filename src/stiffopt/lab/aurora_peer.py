"""The virtual lab's tracker: an NDI Aurora on a pseudo-terminal.

It follows NDI's description of the protocol (Aurora Application Program Interface Guide), not the
library that the driver uses. A command is ``NAME:parameters``, a CRC-16 in hexadecimal digits and a
carriage return, or ``NAME parameters`` without a CRC. A reply ends with its CRC-16; binary replies
have a header.
"""

from __future__ import annotations

import asyncio
import os
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import Any

import numpy as np

from stiffopt.errors import DeviceError
from stiffopt.lab.bench import Bench, ServedPeer, TrackerFrame
from stiffopt.rig.drivers.aurora import AuroraSettings

FIRST_HANDLE = 0x0A  # handle that an Aurora gives to the first wired tool
SLOW = 0.2  # s, delay of a slow device's answers
SPEEDS = {"0": 9600, "2": 19200, "3": 38400, "4": 57600, "5": 115200}
TOOL_IN_PORT, INITIALISED, ENABLED = 0x01, 0x10, 0x20
VERSION = (
    "Northern Digital Inc.\nAurora Control Firmware\nNDI S/N: virtual\n"
    "Characterization Date: 01/01/01\nFreeze Tag: {tag}\nFreeze Date: 01/01/01\n"
    "(C) Northern Digital Inc.\n"
)


class AuroraPeer(ServedPeer[AuroraSettings]):
    """The tracker's control unit with one or more sensors; the bench's is at the driver's port.

    Attributes
    ----------
    firmware : version that it reports.
    garble : whether to spoil the CRC of replies, to rehearse a bad line.
    """

    def __init__(
        self, settings: AuroraSettings, bench: Bench, firmware: str = "AURORA Rev 013"
    ) -> None:
        super().__init__(settings, bench)
        self.firmware = firmware
        self.garble = False
        self._handles = [FIRST_HANDLE + i for i in range(settings.sensor)]
        self._speed = 9600
        self._forget()

    @classmethod
    def stand_in(cls, simulated: Any, n: int) -> AuroraSettings:
        """Return settings with the simulated tracker's registration and latency."""
        return AuroraSettings(registration=simulated.registration, latency=simulated.latency)

    @asynccontextmanager
    async def _listening(self) -> AsyncIterator[AuroraSettings]:
        """Answer on a pseudo-terminal."""
        try:
            import termios
            import tty
        except ImportError:
            raise DeviceError(
                "the virtual lab's Aurora needs pseudo-terminals, which Windows does not have"
            ) from None
        self._attributes = termios.tcgetattr
        self._baud = {getattr(termios, f"B{speed}"): speed for speed in SPEEDS.values()}
        self._speed = 9600
        self._forget()
        self._master, self._slave = os.openpty()  # keep the slave, or the line would hang up
        try:
            tty.setraw(self._slave)
            reader = asyncio.StreamReader()
            line, _ = await asyncio.get_running_loop().connect_read_pipe(
                lambda: asyncio.StreamReaderProtocol(reader), os.fdopen(self._master, "rb", 0)
            )
            answering = asyncio.create_task(self._answer_all(reader))
            yield self.settings.model_copy(update={"port": os.ttyname(self._slave)})
            answering.cancel()
            line.close()
        finally:
            os.close(self._slave)

    def _forget(self) -> None:
        self._initialised = False
        self._tracking = False
        self._ready: set[int] = set()
        self._enabled: set[int] = set()

    # The line -----------------------------------------------------------------------------------

    async def _answer_all(self, reader: asyncio.StreamReader) -> None:
        while command := await reader.readuntil(b"\r"):
            await self._answer(command[:-1])

    async def _answer(self, command: bytes) -> None:
        fault = self.bench.fault("tracker")
        if fault == "off" or not self._hears():
            return
        if fault == "slow":
            await asyncio.sleep(SLOW)
        speed = self._speed
        reply = self._reply(command)
        if self.garble:
            reply = reply[:-2] + bytes([reply[-2] ^ 0x01]) + reply[-1:]
        with suppress(BlockingIOError):
            os.write(self._master, reply)
        if command.startswith(b"COMM") and reply.startswith(b"OKAY"):
            speed = SPEEDS[command.partition(b":")[2][:1].decode()]
        self._speed = speed

    def _hears(self) -> bool:
        """Return whether both ends have the same speed; otherwise the device receives noise."""
        return self._baud.get(self._attributes(self._slave)[5]) == self._speed

    def _reply(self, command: bytes) -> bytes:
        try:
            name, parameters = parse(command)
            if name == "BX":
                return self._binary_frame(parameters)
            text = self._obey(name, parameters)
        except NdiRefusedError as refused:
            text = f"ERROR{refused.args[0]:02X}"
        return f"{text}{crc16(text.encode()):04X}\r".encode()

    # The commands -------------------------------------------------------------------------------

    def _obey(self, name: str, parameters: str) -> str:
        commands: dict[str, Callable[[str], str]] = {
            "INIT": self._init,
            "RESET": self._reset,
            "COMM": self._comm,
            "BEEP": lambda _: "1",
            "VER": lambda _: VERSION.format(tag=self.firmware),
            "PHSR": self._list_handles,
            "PHINF": self._describe_handle,
            "PHF": lambda text: self._drop(text, self._ready, self._enabled),
            "PDIS": lambda text: self._drop(text, self._enabled),
            "PINIT": self._initialise_handle,
            "PENA": self._enable_handle,
            "TSTART": self._start_tracking,
            "TSTOP": self._stop_tracking,
            "TX": self._text_frame,
        }
        if name not in commands:
            raise NdiRefusedError(NdiRefusedError.INVALID)
        if not self._initialised and name not in ("INIT", "RESET", "COMM", "VER", "BEEP"):
            raise NdiRefusedError(NdiRefusedError.SYSTEM_NOT_INITIALISED)
        return commands[name](parameters)

    def _init(self, _: str) -> str:
        self._forget()
        self._initialised = True
        return "OKAY"

    def _reset(self, _: str) -> str:
        self._forget()
        return "RESET"

    def _comm(self, parameters: str) -> str:
        if len(parameters) != 5 or parameters[0] not in SPEEDS or parameters[1:] != "0000":
            raise NdiRefusedError(NdiRefusedError.BAD_PARAMETERS)
        return "OKAY"

    def _list_handles(self, parameters: str) -> str:
        self._must_not_track()
        known = {
            0: self._handles,
            1: [],
            2: [handle for handle in self._handles if handle not in self._ready],
            3: [handle for handle in self._ready if handle not in self._enabled],
            4: list(self._enabled),
        }
        listed = known.get(hexadecimal(parameters or "0"))
        if listed is None:
            raise NdiRefusedError(NdiRefusedError.BAD_PARAMETERS)
        rows = (f"{handle:02X}{self._status(handle):03X}" for handle in sorted(listed))
        return f"{len(listed):02X}{''.join(rows)}"

    def _describe_handle(self, parameters: str) -> str:
        handle = self._handle(parameters)
        kind, maker, revision, serial = "02000000", f"{'NDI':12}", "001", f"{handle:08X}"
        return f"{kind}{maker}{revision}{serial}{self._status(handle):02X}"

    def _drop(self, parameters: str, *sets: set[int]) -> str:
        self._must_not_track()
        handle = self._handle(parameters)
        for each in sets:
            each.discard(handle)
        return "OKAY"

    def _initialise_handle(self, parameters: str) -> str:
        self._must_not_track()
        self._ready.add(self._handle(parameters))
        return "OKAY"

    def _enable_handle(self, parameters: str) -> str:
        self._must_not_track()
        handle = self._handle(parameters)
        if parameters[2:] not in ("S", "D", "B"):
            raise NdiRefusedError(0x09)
        if handle not in self._ready:
            raise NdiRefusedError(NdiRefusedError.NOT_INITIALISED)
        self._enabled.add(handle)
        return "OKAY"

    def _start_tracking(self, _: str) -> str:
        self._tracking = True
        return "OKAY"

    def _stop_tracking(self, _: str) -> str:
        if not self._tracking:
            raise NdiRefusedError(NdiRefusedError.WRONG_MODE)
        self._tracking = False
        return "OKAY"

    def _must_not_track(self) -> None:
        if self._tracking:
            raise NdiRefusedError(NdiRefusedError.WRONG_MODE)

    def _handle(self, parameters: str) -> int:
        handle = hexadecimal(parameters[:2])
        if handle not in self._handles:
            raise NdiRefusedError(NdiRefusedError.BAD_HANDLE)
        return handle

    def _status(self, handle: int) -> int:
        flags = (INITIALISED, handle in self._ready), (ENABLED, handle in self._enabled)
        return TOOL_IN_PORT + sum(flag for flag, is_set in flags if is_set)

    # The frames ---------------------------------------------------------------------------------

    def _poses(self, parameters: str) -> list[tuple[int, TrackerFrame | None]]:
        """Return the frame of each enabled sensor; all see the same."""
        if not self._tracking:
            raise NdiRefusedError(NdiRefusedError.WRONG_MODE)
        if not hexadecimal(parameters or "0001") & 0x0001:
            raise NdiRefusedError(NdiRefusedError.BAD_PARAMETERS)
        frame = self.bench.frame()
        return [(handle, frame) for handle in sorted(self._enabled)]

    def _text_frame(self, parameters: str) -> str:
        rows = []
        for handle, frame in self._poses(parameters):
            number = 0 if frame is None else frame.number & 0xFFFFFFFF
            pose = "MISSING" if frame is None else pose_as_text(frame)
            rows.append(f"{handle:02X}{pose}{self._status(handle):08X}{number:08X}\n")
        return f"{len(rows):02X}{''.join(rows)}0000"

    def _binary_frame(self, parameters: str) -> bytes:
        poses = self._poses(parameters)
        body = struct.pack("<B", len(poses))
        for handle, frame in poses:
            number = 0 if frame is None else frame.number & 0xFFFFFFFF
            if frame is None or not np.isfinite(frame.position).all():
                body += struct.pack("<BB", handle, 0x02)
            else:
                numbers = (*frame.quaternion, *(frame.position * 1e3), 0.1)
                body += struct.pack("<BB8f", handle, 0x01, *numbers)
            body += struct.pack("<II", self._status(handle), number)
        return framed(body + struct.pack("<H", 0))


class NdiRefusedError(Exception):
    """A command that the device answers with an error code."""

    INVALID = 0x01
    BAD_CRC = 0x04
    BAD_PARAMETERS = 0x07
    BAD_HANDLE = 0x08
    WRONG_MODE = 0x0C
    NOT_INITIALISED = 0x0E
    SYSTEM_NOT_INITIALISED = 0x10


def crc16(data: bytes) -> int:
    """Return the CRC-16 of the protocol: polynomial x^16 + x^15 + x^2 + 1, reflected, from 0."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


def parse(command: bytes) -> tuple[str, str]:
    """Return name and parameters of a command; check its CRC if it has one."""
    text = command.decode("latin-1")
    name, colon, rest = text.partition(":")
    if not colon:
        name, _, parameters = text.partition(" ")
        return name, parameters
    if f"{crc16(text[:-4].encode('latin-1')):04X}" != rest[-4:].upper():
        raise NdiRefusedError(NdiRefusedError.BAD_CRC)
    return name, rest[:-4]


def hexadecimal(text: str) -> int:
    """Return a number of hexadecimal digits."""
    try:
        return int(text, 16)
    except ValueError:
        raise NdiRefusedError(NdiRefusedError.BAD_PARAMETERS) from None


def pose_as_text(frame: TrackerFrame) -> str:
    """Return signs and digits, without points: 1e-4 of the quaternion, 0.01 mm, 1e-4 mm."""
    numbers = np.array([*frame.quaternion * 1e4, *frame.position * 1e5])
    if not np.isfinite(numbers).all() or np.abs(numbers[4:]).max() > 999999:
        return "MISSING"
    turns = "".join(f"{round(x):+06d}" for x in numbers[:4])
    places = "".join(f"{round(x):+07d}" for x in numbers[4:])
    return f"{turns}{places}{1000:+06d}"


def framed(body: bytes) -> bytes:
    """Return a binary reply: start, length and their CRC-16, the body and its CRC-16."""
    header = struct.pack("<HH", 0xA5C4, len(body))
    parts = (header, struct.pack("<H", crc16(header)), body, struct.pack("<H", crc16(body)))
    return b"".join(parts)
