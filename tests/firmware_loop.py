"""The firmware's logic on this machine, in a loop with the pneumatics (firmware/tests/loop.c)."""

from __future__ import annotations

import atexit
import ctypes
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from board_host import SET, Report, body_of, command, frame_of, report_of

FIRMWARE = Path(__file__).resolve().parent.parent / "firmware"
TICK = 2  # ms


@cache
def logic(**settings: int) -> Path:
    """Return the library, built once for all tests of this process."""
    folder = tempfile.mkdtemp(prefix="firmware-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return make(Path(folder), "loop.so", **settings)


class Air(ctypes.Structure):
    """`struct pneumatics`; pressures absolute in bar, conductances in dm3/(s bar)."""

    _fields_ = (
        ("channels", ctypes.c_int),
        *(
            (name, ctypes.c_double)
            for name in (
                *("source", "source_flow", "line_volume", "valve_flow", "valve_lag", "offset"),
                *("tube_flow", "dead_volume"),
            )
        ),
        ("volume", ctypes.c_double * 6),
        ("leak", ctypes.c_double * 6),
        ("cracking", ctypes.c_double),
        ("faults", ctypes.c_uint8 * 6),
        ("line", ctypes.c_double),
    )


def make(folder: Path, target: str, **settings: int) -> Path:
    """Build a target of the firmware's Makefile; skip where there are no tools for it."""
    for tool in ("make", "gcc"):
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} is not installed; install gcc and make")
    words = [f"{name}={value}" for name, value in settings.items()]
    done = subprocess.run(
        ["make", "--silent", "-C", str(FIRMWARE), target, f"BUILD={folder}", *words],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folder / target


class Loop:
    """A board with arms, and a host that commands it; time passes in `run` alone."""

    def __init__(
        self,
        library: Path,
        *,
        supply: float = 2.5,
        volume: float = 0.02,
        noise: float = 0.7,
        seed: int = 1,
        **air: float,
    ) -> None:
        self._c = ctypes.CDLL(str(library))
        for name in ("loop_air", "loop_regulator"):
            getattr(self._c, name).restype = ctypes.c_void_p
        self._c.loop_size.restype = ctypes.c_size_t
        self._memory = ctypes.create_string_buffer(self._c.loop_size())
        self._it = ctypes.byref(self._memory)
        doubles = map(ctypes.c_double, (supply, volume, noise))
        self._c.loop_init(self._it, *doubles, ctypes.c_uint64(seed))
        self.n = int(self._c.loop_channels())
        self.air = ctypes.cast(self._c.loop_air(self._it), ctypes.POINTER(Air)).contents
        assert self.air.channels == self.n
        for name, value in air.items():
            if name == "leak":
                self.air.leak = (ctypes.c_double * 6)(*[value] * 6)
            else:
                setattr(self.air, name, value)
        self._sequence = 0
        self.run(20)

    def run(self, ms: float) -> NDArray[np.float64]:
        """Let time pass; return the pressures of the chambers after each tick (t, n), in bar."""
        ticks = round(ms / TICK)
        trace = np.zeros((ticks, 2 * self.n))
        self._c.loop_run(self._it, ticks, trace.ctypes.data_as(ctypes.c_void_p))
        return trace[:, : self.n]

    def receive(self, data: bytes) -> bytes:
        """Send bytes; return the bytes of the answers."""
        replies = ctypes.create_string_buffer(62 * (data.count(b"\0") + 1))
        length = self._c.loop_receive(self._it, data, len(data), replies)
        return replies.raw[:length]

    def send(self, data: bytes) -> list[bytes]:
        """Send bytes; return the bodies of the answers."""
        frames = self.receive(data).split(b"\0")
        assert frames.pop() == b""
        return [body_of(frame + b"\0") for frame in frames]

    def ask(self, kind: int, payload: bytes = b"", **header: int) -> tuple[int, bytes]:
        self._sequence = self._sequence % 255 + 1
        (body,) = self.send(frame_of(kind, payload, sequence=self._sequence, **header))
        assert body[2] == self._sequence
        return body[3], body[4:]

    def report(self, kind: int, payload: bytes = b"") -> Report:
        answered, told = self.ask(kind, payload)
        assert answered == kind | 0x80, (answered, told)
        return report_of(told)

    def press(self, *set_points: float, ms: float = 0.0) -> NDArray[np.float64]:
        """Command set-points, in bar, again and again while time passes; see `run`."""
        counts = [round(p * 1e4) for p in (*set_points, *[0.0] * self.n)[: self.n]]
        parts = [np.zeros((0, self.n))]
        while True:
            last = self.report(6)
            self.report(SET, command(last, *counts))
            if ms <= 0:
                return np.concatenate(parts)
            parts.append(self.run(min(ms, 20.0)))
            ms -= 20.0

    def force(self, sensor: int, counts: int) -> None:
        """Let a sensor (that of the line comes last) show counts of 0 to 1023; 0: the truth."""
        self._c.loop_force(self._it, sensor, counts)


class LoopPort:
    """In place of pyserial's port: a board whose time is that of a clock.

    Attributes
    ----------
    wire : moment, channel and set-point in Pa whenever a frame has changed them.
    """

    def __init__(self, library: Path, clock: Any) -> None:
        self.loop = Loop(library)
        self.wire: list[tuple[float, int, float]] = []
        self._clock, self._at = clock, clock.now()
        self._answers = b""
        self._held: tuple[int, ...] = ()

    @property
    def in_waiting(self) -> int:
        return len(self._answers)

    def reset_input_buffer(self) -> None:
        self._answers = b""

    def close(self) -> None: ...

    def read(self, count: int) -> bytes:
        got, self._answers = self._answers[:count], self._answers[count:]
        return got

    def write(self, data: bytes) -> None:
        now = self._clock.now()
        self.loop.run(min(1e3 * (now - self._at), 2000.0))
        self._at = now
        self._answers += self.loop.receive(data)
        pressures = self.loop.report(6).set_points
        if pressures != self._held:  # else it was a question
            self.wire.extend((now, channel, 10.0 * p) for channel, p in enumerate(pressures))
        self._held = pressures
