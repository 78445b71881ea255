"""The virtual lab's probe: a Zaber stage on TCP, and the NI-DAQ device that reads its sensor.

The stage speaks Zaber's ASCII protocol. It implements the commands to identify, home, move, stop
and watch one axis, and rejects all others as the real device does.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from functools import partial
from typing import Any, NamedTuple

from stiffopt.errors import DeviceError
from stiffopt.lab.bench import Bench, DevicePeer, ServedPeer
from stiffopt.lab.nidaq_peer import DaqServer
from stiffopt.rig.drivers.probe import SPEED_FACTOR, ZaberProbeSettings

LATE = 0.3  # s, delay of a slow device's answers

_NOT_HOMED, _INTERRUPTED = "WR", "NI"
_IDENTITY = {
    "device.id": "50081",
    "deviceid": "50081",
    "system.serial": "12345",
    "system.axiscount": "1",
    "system.access": "1",
    "version": "7.38",
    "version.build": "15000",
    "peripheral.id": "0",
    "peripheralid": "0",
    "device.hw.modified": "0",
    "peripheral.hw.modified": "0",
    "resolution": "64",
    "comm.alert": "0",
}


class _Request(NamedTuple):
    """A request line: device, axis and number of the message as written, and words."""

    device: int
    axis: int
    number: str
    words: list[str]


class _Answer(NamedTuple):
    data: str = "0"
    accepted: bool = True


_BAD_COMMAND = _Answer("BADCOMMAND", accepted=False)
_BAD_DATA = _Answer("BADDATA", accepted=False)


class ZaberPeer(ServedPeer[ZaberProbeSettings]):
    """The stage of a probe; the middle of its travel is the position 0 of the bench's stage.

    Parameters
    ----------
    homed : whether it has been homed since it was switched on.
    """

    def __init__(self, settings: ZaberProbeSettings, bench: Bench, *, homed: bool = True) -> None:
        super().__init__(settings, bench)
        stage = settings.stage
        self._stage = stage
        self._middle = 0.5 * (stage.travel[0] + stage.travel[1])
        self._flags: set[str] = set() if homed else {_NOT_HOMED}

    @asynccontextmanager
    async def _listening(self) -> AsyncIterator[ZaberProbeSettings]:
        port = self._stage.port if self.on_loopback(self._stage.host) else 0
        try:
            server = await asyncio.start_server(self._attend, "127.0.0.1", port)
        except OSError:
            raise DeviceError(
                f"the virtual stage cannot listen on 127.0.0.1:{port}: the port is in use; end "
                "what uses it, or remove 'host' to take a free one"
            ) from None
        host, port = server.sockets[0].getsockname()
        stage = self._stage.model_copy(update={"host": host, "port": port, "serial": None})
        yield self.settings.model_copy(update={"stage": stage})
        server.close()

    async def _attend(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer the lines of a connection."""
        try:
            with suppress(OSError, ValueError):  # the client has left, or sends no lines
                async for line in reader:
                    if text := line.decode("ascii", "replace").strip():
                        writer.write((await self._reply(text)).encode())
        finally:
            writer.close()

    async def _reply(self, line: str) -> str:
        """Return the answer to a line; empty if the device stays silent."""
        fault = self.bench.fault("probe")
        if fault == "slow":
            await asyncio.sleep(LATE)
        request = _parsed(line)
        if fault == "off" or request is None or request.device not in (0, self._stage.device):
            return ""
        answer = self._carry_out(request)
        status = "BUSY" if self.bench.stage_moving else "IDLE"
        flag = max(self._flags, default="--")  # WR outranks NI
        number = f" {request.number}" if request.number else ""
        verdict = "OK" if answer.accepted else "RJ"
        text = f"{self._stage.device:02d} {request.axis}{number} {verdict} {status} {flag}"
        reply = f"{text} {answer.data}"
        checked = f"{reply}:{_checksum(reply):02X}" if ":" in line else reply
        return f"@{checked}\r\n"

    def _carry_out(self, request: _Request) -> _Answer:
        if request.axis not in (0, self._stage.axis):
            return _Answer("BADAXIS", accepted=False)
        commands: dict[str, Callable[[list[str]], _Answer]] = {
            "get": self._get,
            "warnings": self._warnings,
            "home": self._home,
            "move": self._move,
            "stop": self._stop,
            "estop": self._stop,
        }
        if not request.words:
            return _Answer()
        name, *words = request.words
        return commands[name](words) if name in commands else _BAD_COMMAND

    def _get(self, words: list[str]) -> _Answer:
        low, high = (round(place / self._stage.microstep) for place in self._stage.travel)
        values = {
            **_IDENTITY,
            "pos": str(round(self._place() / self._stage.microstep)),
            "limit.min": str(low),
            "limit.max": str(high),
            "maxspeed": str(self._native_max_speed),
            "limit.home.triggered": str(int(_NOT_HOMED not in self._flags)),
        }
        return _Answer(values[words[0]]) if words and words[0] in values else _BAD_COMMAND

    def _warnings(self, words: list[str]) -> _Answer:
        flags = sorted(self._flags, reverse=True)
        if words == ["clear"]:
            self._flags.discard(_INTERRUPTED)
        return _Answer(" ".join([f"{len(flags):02d}", *flags]))

    def _home(self, words: list[str]) -> _Answer:
        self._flags.clear()
        self._go(self._stage.travel[0], self._native_max_speed)
        return _Answer()

    def _move(self, words: list[str]) -> _Answer:
        if len(words) < 2 or words[0] not in ("abs", "rel"):
            return _BAD_COMMAND
        try:
            position, speed, *_ = *(float(word) for word in words[1:]), self._native_max_speed
        except ValueError:
            return _BAD_DATA
        place = position * self._stage.microstep + (self._place() if words[0] == "rel" else 0.0)
        low, high = self._stage.travel
        slack = self._stage.microstep
        if not (low - slack <= place <= high + slack and 0 < speed <= self._native_max_speed):
            return _BAD_DATA
        if _NOT_HOMED in self._flags and words[0] == "abs":
            return _BAD_DATA
        self._flags.discard(_INTERRUPTED)
        self._go(place, speed)
        return _Answer()

    def _stop(self, words: list[str]) -> _Answer:
        if self.bench.stage_moving:
            self._flags.add(_INTERRUPTED)
        self.bench.stage_stop()
        return _Answer()

    @property
    def _native_max_speed(self) -> int:
        return round(self._stage.max_speed / self._stage.microstep * SPEED_FACTOR)

    def _place(self) -> float:
        """Return the position on the rail, in m from home."""
        return self._middle + self._stage.towards_tip * self.bench.stage_position

    def _go(self, place: float, native_speed: float) -> None:
        speed = native_speed / SPEED_FACTOR * self._stage.microstep
        self.bench.stage_move(self._stage.towards_tip * (place - self._middle), speed)


def _checksum(text: str) -> int:
    return -sum(text.encode()) & 0xFF


def _parsed(line: str) -> _Request | None:
    """Parse a line; return None if it is damaged, since a device ignores that."""
    body, colon, checksum = line.removeprefix("/").partition(":")
    if not line.startswith("/") or (colon and checksum != f"{_checksum(body):02X}"):
        return None
    words = body.split()
    numbers: list[str] = []
    while words and len(numbers) < 3 and words[0].isdecimal():
        numbers.append(words.pop(0))
    device, axis, number = [*numbers, *["0", "0", ""][len(numbers) :]]
    return _Request(int(device), int(axis), number, words)


class ProbePeer(DevicePeer[ZaberProbeSettings]):
    """Stage and sensor.

    The sensor's device listens on a free port, whatever ``grpc`` is: on a real rig, one server
    often serves both the supply and the sensor.

    Parameters
    ----------
    homed : whether the stage has been homed since it was switched on.
    """

    def __init__(self, settings: ZaberProbeSettings, bench: Bench, *, homed: bool = True) -> None:
        super().__init__(settings, bench)
        self._stage = ZaberPeer(settings, bench, homed=homed)
        self._sensor = DaqServer(
            None,
            settings.extra,
            inputs={settings.force.channel: self._volts},
            fault=partial(bench.fault, "probe"),
        )

    @classmethod
    def stand_in(cls, simulated: Any, n: int) -> ZaberProbeSettings:
        """Return a stage on TCP and a sensor of 2 N/V."""
        return ZaberProbeSettings(stage={}, force={"channel": "Dev2/ai0", "sensitivity": 2.0})

    def start(self) -> ZaberProbeSettings:
        """Listen, and return the settings with both addresses."""
        try:
            settings = self._stage.start()
            force = settings.force.model_copy(update={"grpc": self._sensor.start()})
        except BaseException:
            self.close()
            raise
        return settings.model_copy(update={"force": force})

    def close(self) -> None:
        """Stop both."""
        self._stage.close()
        self._sensor.close()

    def _volts(self) -> float:
        force = self.settings.force
        return (self.bench.force() - force.offset) / force.sensitivity
