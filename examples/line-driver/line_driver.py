"""A driver for pressure regulators that are commanded by lines of text over TCP.

The device answers each line with one line: ``OK``, measured pressures, or ``ERROR`` and a reason.

    SET 1 0.35 bar    set-point of channel 1
    GET               measured pressures of all channels, such as ``0.349 0.000 0.120 bar``
    VENT              all set-points to 0
    WATCHDOG 0.5 s    vent by itself when no SET has come for so long
"""

from __future__ import annotations

import math
import socket
import time
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from stiffopt.errors import DeviceError
from stiffopt.rig.endpoints import tcp_endpoints
from stiffopt.rig.interface import Clock, PressureLimits, PressureSupply, SupplySettings
from stiffopt.schema import Items, Schema
from stiffopt.units import Duration, Pressure


class LineChannel(Schema):
    """One regulator.

    Attributes
    ----------
    full_scale : the highest pressure that it can be set to, in Pa.
    min, max : limits that hold where they are tighter than those of the rig, in Pa.
    """

    full_scale: Annotated[Pressure, Field(gt=0)] = 2e5
    min: Pressure | None = None
    max: Pressure | None = None


class LineSettings(SupplySettings):
    """Where the device is, and its channels.

    Attributes
    ----------
    host, port : of the device.
    timeout : for each answer, in s.
    watchdog : the device vents when no set-point has come for so long, in s; None: never.
    channels : one for each channel of the robot, in its order.
    """

    peer: ClassVar[str] = "line_peer:LinePeer"

    host: Annotated[str, Field(min_length=1)] = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535)] = 4000
    timeout: Annotated[Duration, Field(gt=0, le=5)] = 0.2
    watchdog: Annotated[Duration, Field(gt=0, le=5)] | None = 0.5
    channels: Annotated[Items[LineChannel], Field(min_length=1)]

    def _make(self, limits: PressureLimits, clock: Clock | None) -> LineSupply:
        return LineSupply(self, limits, clock)

    def _reach(self, channel: int) -> tuple[float, float]:
        return 0.0, self.channels[channel].full_scale


class LineSupply(PressureSupply):
    """The regulators. A line without an answer ends the connection; the next one connects anew."""

    def __init__(
        self, settings: LineSettings, limits: PressureLimits, clock: Clock | None = None
    ) -> None:
        super().__init__(limits, clock)
        self._settings = settings
        self._connection: socket.socket | None = None
        self.has_watchdog = settings.watchdog is not None
        self.patience = (self.n + 3) * settings.timeout  # connect, watchdog, each channel, read

    @property
    def endpoints(self) -> tuple[str, ...]:
        """The device's address, by which only one program can claim it."""
        return tcp_endpoints(self._settings.host, self._settings.port)

    def _open(self) -> None:
        self._ask("VENT")

    def _close(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection = None

    def _write(self, pressures: NDArray[np.float64]) -> None:
        if not pressures.any():
            self._ask("VENT")
            return
        for number, pressure in enumerate(pressures, start=1):
            self._ask(f"SET {number} {math.trunc(pressure) * 1e-5:.5f} bar")  # never more

    def _read(self) -> ArrayLike:
        *pressures, unit = self._ask("GET").split()
        try:
            if unit != "bar":
                raise ValueError
            return [float(pressure) * 1e5 for pressure in pressures]
        except ValueError:
            raise DeviceError(f"{self._where} sends no pressures: {pressures} {unit}") from None

    @property
    def _where(self) -> str:
        return f"the regulators at {self._settings.host}:{self._settings.port}"

    def _ask(self, command: str) -> str:
        """Send a line and return the answer, in bounded time."""
        settings = self._settings
        try:
            if self._connection is None:
                address = (settings.host, settings.port)
                self._connection = socket.create_connection(address, settings.timeout)
                if settings.watchdog is not None:
                    self._exchange_lines(self._connection, f"WATCHDOG {settings.watchdog:g} s")
            return self._exchange_lines(self._connection, command)
        except (OSError, ValueError) as error:
            self._close()  # a late answer must not be taken for that to the next line
            raise DeviceError(
                f"{self._where} did not carry out '{command}': {error}; check that they are "
                "switched on, and host and port"
            ) from None

    def _exchange_lines(self, connection: socket.socket, command: str) -> str:
        end = time.monotonic() + self._settings.timeout
        connection.sendall(f"{command}\n".encode())
        answer = b""
        while not answer.endswith(b"\n"):
            connection.settimeout(max(end - time.monotonic(), 1e-3))
            received = connection.recv(256)
            answer += received
            if not received or len(answer) > 4096:
                raise ConnectionError("the connection broke")
        text = answer.decode("ascii").strip()
        if not text or text.startswith("ERROR"):
            raise ValueError(text.lower() or "an empty answer")
        return text
