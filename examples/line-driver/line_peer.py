"""The device that `line_driver` commands, played in the virtual lab of `stiffopt lab`."""

from __future__ import annotations

import socketserver
import sys
import time
from functools import partial
from threading import Event, Lock, Thread
from typing import Any

from line_driver import LineSettings

from stiffopt.lab.bench import Bench, DevicePeer

LATE = 0.3  # s after which a slow device answers
LOOK = 0.01  # s between two looks at the watchdog


class LinePeer(DevicePeer[LineSettings]):
    """A TCP server on a free port that follows the device's manual, with the bench behind it."""

    def __init__(self, settings: LineSettings, bench: Bench) -> None:
        super().__init__(settings, bench)
        self._lock = Lock()
        self._closing = Event()
        self._server: socketserver.ThreadingTCPServer | None = None
        self._threads: list[Thread] = []
        self._watchdog = 0.0  # s; 0: off
        self._last_set: float | None = None

    @classmethod
    def stand_in(cls, simulated: Any, n: int) -> LineSettings:
        """Return settings for regulators in place of simulated ones."""
        return LineSettings(driver="line", channels=[{} for _ in range(n)])

    def start(self) -> LineSettings:
        """Listen, and return the settings with the address."""
        self._server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), partial(_Handler, self))
        self._server.daemon_threads = True
        serve = partial(self._server.serve_forever, poll_interval=0.05)
        self._threads = [Thread(target=run, daemon=True) for run in (serve, self._watch)]
        for thread in self._threads:
            thread.start()
        host, port = self._server.server_address[:2]
        return self.settings.model_copy(update={"host": host, "port": port})

    def close(self) -> None:
        """Stop."""
        self._closing.set()
        if sys.is_finalizing():  # the threads have ended with the interpreter
            return
        server, self._server = self._server, None
        if server is not None:
            server.shutdown()
            server.server_close()
        for thread in self._threads:
            thread.join()

    def answer(self, line: str) -> str | None:
        """Carry out a line and return what the device says; None: nothing."""
        fault = self.bench.fault("supply")
        if fault == "off" or self._closing.is_set():
            return None
        if fault == "slow":
            self._closing.wait(LATE)
        with self._lock:
            try:
                return self._obey(line.split())
            except (ValueError, IndexError):
                return f"ERROR I do not understand {line}"

    def _obey(self, words: list[str]) -> str:
        match words:
            case ["SET", number, pressure, "bar"] if 1 <= int(number) <= self.bench.n:
                self.bench.command(int(number) - 1, round(float(pressure) * 1e5, 3))
                self._last_set = time.monotonic()
            case ["GET"]:
                return " ".join([*(f"{p * 1e-5:.5f}" for p in self.bench.measured()), "bar"])
            case ["VENT"]:
                self._vent()
            case ["WATCHDOG", duration, "s"]:
                self._watchdog = float(duration)
            case _:
                raise ValueError
        return "OK"

    def _vent(self) -> None:
        self._last_set = None
        for channel in range(self.bench.n):
            self.bench.command(channel, 0.0)

    def _watch(self) -> None:
        while not self._closing.wait(LOOK):
            with self._lock:
                last = self._last_set
                if self._watchdog and last and time.monotonic() - last > self._watchdog:
                    self._vent()


class _Handler(socketserver.StreamRequestHandler):
    def __init__(self, peer: LinePeer, *args: Any) -> None:
        self._peer = peer
        super().__init__(*args)

    def handle(self) -> None:
        for line in self.rfile:
            answer = self._peer.answer(line.decode("ascii", "replace").strip())
            if answer is not None:
                self.wfile.write(f"{answer}\n".encode())
