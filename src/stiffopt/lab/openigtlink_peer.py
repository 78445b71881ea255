"""The virtual lab's tracker behind an OpenIGTLink server, such as PLUS, over TCP."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import numpy as np

from stiffopt import lie
from stiffopt.errors import DeviceError
from stiffopt.lab.bench import Bench, ServedPeer, TrackerFrame
from stiffopt.rig.drivers.openigtlink import OpenIGTLinkSettings, pyigtl_messages

HOST = "127.0.0.1"
PAUSE = 0.002  # s between polls of the bench
SLOW = 0.2  # s, delay of a slow server
_UNREAD = 1 << 16  # bytes; a client that leaves more unread is disconnected


class OpenIGTLinkPeer(ServedPeer[OpenIGTLinkSettings]):
    """Sends each frame once to all clients, and nothing if the tool is not seen.

    Frames carry the time of their capture on the server's own clock, as those of PLUS do. pyigtl
    packs the messages. Its server is not used: it replaces the signal handlers of the process that
    vents at Ctrl-C, serves one client at a time and does not notice when that one leaves.

    Parameters
    ----------
    port : port to listen on; 0: any free one.
    """

    def __init__(self, settings: OpenIGTLinkSettings, bench: Bench, port: int = 0) -> None:
        super().__init__(settings, bench)
        self._port = port
        self._messages: Any = None
        self._clients: set[asyncio.StreamWriter] = set()

    @classmethod
    def stand_in(cls, simulated: Any, n: int) -> OpenIGTLinkSettings:
        """Return settings with the simulated tracker's registration and latency."""
        return OpenIGTLinkSettings(registration=simulated.registration, latency=simulated.latency)

    @asynccontextmanager
    async def _listening(self) -> AsyncIterator[OpenIGTLinkSettings]:
        """Listen on loopback."""
        self._messages = pyigtl_messages()
        try:
            server = await asyncio.start_server(self._attend, HOST, self._port)
        except OSError as error:
            raise DeviceError(
                f"the virtual lab cannot listen on port {self._port}: {error.strerror}"
            ) from None
        sending = asyncio.create_task(self._send_frames())
        port = server.sockets[0].getsockname()[1]
        yield self.settings.model_copy(update={"host": HOST, "port": port})
        sending.cancel()
        server.close()

    async def _attend(self, reader: asyncio.StreamReader, client: asyncio.StreamWriter) -> None:
        """Keep a client until it leaves; ignore its messages."""
        self._clients.add(client)
        try:
            with suppress(OSError):
                while await reader.read(4096):
                    pass
        finally:
            self._clients.discard(client)
            client.close()

    async def _send_frames(self) -> None:
        waiting: deque[tuple[float, bytes]] = deque()
        newest = -1
        while True:
            await asyncio.sleep(PAUSE)
            fault, frame = self.bench.fault("tracker"), self.bench.frame()
            if frame is not None and frame.number != newest:
                newest = frame.number
                if fault != "off" and np.isfinite(frame.position).all():
                    delay = SLOW if fault == "slow" else 0.0
                    waiting.append((time.monotonic() + delay, self._packed(frame)))
            while waiting and waiting[0][0] <= time.monotonic():
                _, message = waiting.popleft()
                for client in list(self._clients):
                    client.write(message)
                    if client.transport.get_write_buffer_size() > _UNREAD:
                        client.transport.abort()

    def _packed(self, frame: TrackerFrame) -> bytes:
        sensor = np.eye(4)
        sensor[:3, :3] = lie.rotation_from_quaternion(frame.quaternion)
        sensor[:3, 3] = frame.position * 1e3
        stamp = frame.time + time.time() - time.monotonic()
        message = self._messages.TransformMessage(
            sensor, timestamp=stamp, device_name=self.settings.name
        )
        return bytes(message.pack())
