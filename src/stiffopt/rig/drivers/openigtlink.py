"""The driver ``openigtlink``: trackers behind an OpenIGTLink server such as PLUS (pyigtl)."""

from __future__ import annotations

import socket
import struct
import threading
import time
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.errors import DeviceError
from stiffopt.rig.device import library
from stiffopt.rig.interface import Clock, StreamedSettings, StreamedTracker
from stiffopt.units import Duration

_HEADER = 58  # bytes before the body of a message
_LONGEST = 64 * 2**20  # bytes of a body; a longer one means that the stream is not OpenIGTLink
_BETWEEN_TRIES = 0.5  # s between attempts to reach a lost server
_CALL = 0.5  # s for a lost server to accept a connection
_PATIENCE = 0.2  # s, timeout of a read, so that closing is prompt
_SKEW = 0.01  # by which the columns of a rotation may fail to be orthonormal
_DRIFT = 1e-3  # by which the sender's clock may be fast or slow; NTP slews by half of it


class OpenIGTLinkSettings(StreamedSettings):
    """A server that sends the pose of the sensor as TRANSFORM messages, in mm.

    Attributes
    ----------
    host, port : of the server.
    name : device name in the messages, such as ``TipToTracker``: sensor to tracker.
    reconnect_after : time of silence after which the connection is renewed, in s; PLUS is also
        silent while it sees no tool.
    """

    extra: ClassVar[str] = "openigtlink"
    peer: ClassVar[str] = "stiffopt.lab.openigtlink_peer:OpenIGTLinkPeer"

    driver: Literal["openigtlink"] = "openigtlink"
    host: Annotated[str, Field(min_length=1)] = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535)] = 18944
    name: Annotated[str, Field(min_length=1, max_length=20)] = "TipToTracker"
    reconnect_after: Annotated[Duration, Field(gt=0, le=600)] = 10.0

    def device(self, clock: Clock | None = None) -> OpenIGTLinkTracker:
        """Return the tracker, not yet open."""
        return OpenIGTLinkTracker(self, clock)


class SenderClock:
    """Maps times of the sender's clock to ours from the arrival times of messages.

    The smallest difference between arrival and stamp so far belongs to the fastest message. A
    message's stamp plus this difference is when it would have arrived without a delay. The smallest
    difference grows slowly with time, as clocks drift; a clock that jumps back was set.
    """

    def __init__(self) -> None:
        self._newest = -np.inf
        self._fastest = (0.0, np.inf)  # stamp and difference of the fastest message

    def fastest_arrival(self, stamp: float, arrival: float) -> float:
        """Return when a message with this stamp would have arrived without a delay."""
        if not stamp > 0:  # senders without a clock write 0
            return arrival
        difference = arrival - stamp
        fastest_stamp, least = self._fastest
        least += _DRIFT * (stamp - fastest_stamp)
        if stamp < self._newest or difference <= least:
            self._fastest = (stamp, difference)
            least = difference
        self._newest = stamp
        return min(stamp + least, arrival)  # rounding may make it later


class OpenIGTLinkTracker(StreamedTracker):
    """Reads the server's stream in a thread; pyigtl decodes the messages.

    pyigtl's own client is not used: when the server closes the connection, it occupies a core
    without noticing; it loses its place in the stream when a header arrives in two parts; and it
    delivers at most about 97 messages a second, without the time of their arrival.

    PLUS sends nothing for a tool that it does not see: only the age of the last sample shows it.

    `heard`: names of the devices in the messages; helpful if `OpenIGTLinkSettings.name` is wrong.
    """

    def __init__(self, settings: OpenIGTLinkSettings, clock: Clock | None = None) -> None:
        super().__init__(settings, clock)
        self.settings = settings
        self.heard: set[str] = set()
        self._thread: threading.Thread | None = None
        self._messages: Any = None
        self._sender = SenderClock()
        self._address: tuple[Any, ...] = ()
        self._stamp = -1.0
        self._frame = 0

    @property
    def _where(self) -> str:
        return f"{self.settings.host}:{self.settings.port}"

    def _open(self) -> None:
        self._messages = pyigtl_messages()
        self._stopping.clear()
        self._sender = SenderClock()
        try:
            chosen = self.settings
            found = socket.getaddrinfo(chosen.host, chosen.port, type=socket.SOCK_STREAM)
            self._address = found[0][4][:2]  # resolved once: a name server may be slow
            connection = self._connect(chosen.connect_timeout)
        except OSError as error:
            raise DeviceError(
                f"openigtlink: no server answers at {self._where} ({error}); start the "
                "OpenIGTLink server of PLUS or Slicer, and check host and port"
            ) from None
        self._thread = threading.Thread(
            target=self._run, args=(connection,), name="openigtlink", daemon=True
        )
        self._thread.start()

    def _close(self) -> None:
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _connect(self, patience: float) -> socket.socket:
        connection = socket.create_connection(self._address, patience)
        connection.settimeout(_PATIENCE)
        return connection

    def _run(self, connection: socket.socket | None) -> None:
        """Read from the server, reconnecting if necessary, until the tracker is closed."""
        while not self._stopping.is_set():
            try:
                if connection is None:
                    connection = self._connect(_CALL)
                with connection:
                    self._follow(connection)
            except (OSError, ValueError) as error:
                self._count(f"openigtlink: the server at {self._where} is lost: {error}")
            connection = None
            self._stopping.wait(_BETWEEN_TRIES)

    def _follow(self, connection: socket.socket) -> None:
        while not self._stopping.is_set():
            header = self._receive(connection, _HEADER)
            if not header:
                return
            arrival = self.clock.now()
            fields = self._messages.MessageBase.parse_header(header)
            if fields["body_size"] > _LONGEST:
                raise ValueError("what it sends is not OpenIGTLink")
            body = self._receive(connection, fields["body_size"])
            if len(body) == fields["body_size"]:
                self._take({**fields, "crc": int.from_bytes(header[-8:])}, body, arrival)

    def _receive(self, connection: socket.socket, size: int) -> bytes:
        """Return `size` bytes, or none when the tracker is being closed."""
        received = bytearray()
        began = time.monotonic()
        while len(received) < size and not self._stopping.is_set():
            try:
                chunk = connection.recv(size - len(received))
            except TimeoutError:
                if time.monotonic() - began > self.settings.reconnect_after:
                    raise TimeoutError("it sends nothing") from None
                continue
            if not chunk:
                raise ConnectionError("it closed the connection")
            received += chunk
        return bytes(received) if len(received) == size else b""

    def _take(self, fields: dict[str, Any], body: bytes, arrival: float) -> None:
        name, kind = fields["device_name"], fields["message_type"]
        self.heard.add(name)
        if name != self.settings.name or kind != "TRANSFORM":
            if self._frame == 0:
                self.last_error = (
                    f"openigtlink: no TRANSFORM named {self.settings.name} came yet from "
                    f"{self._where}; it sends {', '.join(sorted(self.heard))}"
                )
            return
        message = self._unpacked(fields, body)
        if message is None:
            self._count(f"openigtlink: a message named {name} is damaged")
            return
        if message.timestamp == self._stamp:
            return  # the same sample, sent again
        self._stamp = message.timestamp or -1.0
        self._frame += 1
        fastest = self._sender.fastest_arrival(message.timestamp, arrival)
        self._take_matrix(fastest - self.settings.latency, np.array(message.matrix, dtype=float))

    def _unpacked(self, fields: dict[str, Any], body: bytes) -> Any:
        if fields["crc"] and fields["crc"] != self._messages.CRC64(body):  # 0: none was computed
            return None
        message = self._messages.TransformMessage()
        try:
            message.unpack(fields, body)
        except (struct.error, ValueError, IndexError):
            return None
        return message

    def _take_matrix(self, captured: float, sensor: Array) -> None:
        rotation = sensor[:3, :3]
        skew = np.abs(rotation.T @ rotation - np.eye(3)).max()
        if not (np.isfinite(sensor).all() and skew <= _SKEW and np.linalg.det(rotation) > 0):
            self._hand_over_nothing(captured, self._frame)
            return
        quaternion = np.asarray(lie.quaternion_from_rotation(rotation))
        self._hand_over(captured, self._frame, sensor[:3, 3] * 1e-3, quaternion)


def pyigtl_messages() -> Any:
    """Return the module of pyigtl that packs and unpacks messages."""
    return library("pyigtl", "pyigtl", OpenIGTLinkSettings.extra).messages
