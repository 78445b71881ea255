"""The virtual lab's tracker behind an OpenIGTLink server, such as PLUS, over TCP."""

from __future__ import annotations

import selectors
import socket
import threading
import time
from collections import deque
from typing import Any

import numpy as np

from stiffopt import lie
from stiffopt.errors import DeviceError
from stiffopt.lab.bench import Bench, DevicePeer, TrackerFrame
from stiffopt.rig.drivers.openigtlink import OpenIGTLinkSettings, pyigtl_messages

__all__ = ["OpenIGTLinkPeer"]

HOST = "127.0.0.1"
PAUSE = 0.002  # s between two looks at the bench
SLOW = 0.2  # s, by which a slow server sends late


class OpenIGTLinkPeer(DevicePeer[OpenIGTLinkSettings]):
    """Sends each frame once to whoever is connected, and nothing when the tool is not seen.

    Frames carry the time of their capture on a clock of the server's own, as PLUS does. pyigtl
    packs the messages; its server is not used, as it replaces the signal handlers of the process
    that vents at Ctrl-C, serves one client at a time and does not notice when that one leaves.

    Parameters
    ----------
    port : to listen on; 0 takes a free one.
    """

    def __init__(self, settings: OpenIGTLinkSettings, bench: Bench, port: int = 0) -> None:
        super().__init__(settings, bench)
        self._port = port
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._messages: Any = None

    @classmethod
    def stand_in(cls, simulated: Any, n: int) -> OpenIGTLinkSettings:
        """Return settings with the simulated tracker's registration and latency."""
        return OpenIGTLinkSettings(registration=simulated.registration, latency=simulated.latency)

    def start(self) -> OpenIGTLinkSettings:
        """Listen on loopback."""
        self._messages = pyigtl_messages()
        try:
            self._listener = socket.create_server((HOST, self._port))
        except OSError as error:
            raise DeviceError(
                f"the virtual lab cannot listen on port {self._port}: {error.strerror}"
            ) from None
        self._listener.setblocking(False)
        self._stopping.clear()
        self._thread = threading.Thread(target=self._serve, name="openigtlink-peer", daemon=True)
        self._thread.start()
        port = self._listener.getsockname()[1]
        return self.settings.model_copy(update={"host": HOST, "port": port})

    def close(self) -> None:
        """Hang up and stop listening."""
        if self._thread is None:
            return
        self._stopping.set()
        self._thread.join()
        self._thread = None

    def _serve(self) -> None:
        clients: set[socket.socket] = set()
        waiting: deque[tuple[float, bytes]] = deque()
        newest = -1
        with selectors.DefaultSelector() as selector, self._listener:
            selector.register(self._listener, selectors.EVENT_READ)
            while not self._stopping.is_set():
                for key, _ in selector.select(PAUSE):
                    self._attend(key.fileobj, selector, clients)
                fault, frame = self.bench.fault("tracker"), self.bench.frame()
                if frame is not None and frame.number != newest:
                    newest = frame.number
                    if fault != "off" and np.isfinite(frame.position).all():
                        delay = SLOW if fault == "slow" else 0.0
                        waiting.append((time.monotonic() + delay, self._packed(frame)))
                while waiting and waiting[0][0] <= time.monotonic():
                    self._send(waiting.popleft()[1], selector, clients)
                self._stopping.wait(PAUSE)  # what clients send could keep select from waiting
        for client in clients:
            client.close()

    def _attend(
        self, ready: Any, selector: selectors.BaseSelector, clients: set[socket.socket]
    ) -> None:
        """Take a new client, or what a client says, which does not matter."""
        if ready is self._listener:
            client, _ = self._listener.accept()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            selector.register(client, selectors.EVENT_READ)
            clients.add(client)
            return
        try:
            said = ready.recv(4096)
        except OSError:
            said = b""
        if not said:
            _hang_up(ready, selector, clients)

    def _send(
        self, message: bytes, selector: selectors.BaseSelector, clients: set[socket.socket]
    ) -> None:
        for client in list(clients):
            try:
                client.sendall(message)
            except OSError:  # it left, or does not read
                _hang_up(client, selector, clients)

    def _packed(self, frame: TrackerFrame) -> bytes:
        sensor = np.eye(4)
        sensor[:3, :3] = lie.rotation_from_quaternion(frame.quaternion)
        sensor[:3, 3] = frame.position * 1e3
        stamp = frame.time + time.time() - time.monotonic()
        message = self._messages.TransformMessage(
            sensor, timestamp=stamp, device_name=self.settings.name
        )
        return bytes(message.pack())


def _hang_up(
    client: socket.socket, selector: selectors.BaseSelector, clients: set[socket.socket]
) -> None:
    selector.unregister(client)
    clients.discard(client)
    client.close()
