"""A supply without a device, on a clock that is moved by hand."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import DeviceError
from stiffopt.rig.interface import Clock, PressureLimits, PressureSupply

Array = NDArray[np.float64]

HIGH = np.array([1.5e5, 1.0e5, 1.2e5])
SLEW = np.array([5e5, 2e5, 1e5])


class HandClock(Clock):
    """Time that passes only while somebody sleeps, or where a test moves it."""

    def __init__(self, t: float = 50.0) -> None:
        self.t = t

    def now(self) -> float:
        return self.t

    def sleep_until(self, moment: float) -> None:
        self.t = max(self.t, moment)


class FakeSupply(PressureSupply):
    """Keeps what it is told; dies when asked to, before or after it has taken a command.

    Attributes
    ----------
    written : all that it has taken.
    dead : ``before`` or ``after``; empty while it is well.
    opened : how often it was connected to.
    """

    def __init__(self, clock: Clock, low: ArrayLike = 0.0) -> None:
        super().__init__(PressureLimits(np.broadcast_to(low, 3), HIGH), clock)
        self.written: list[Array] = []
        self.dead = ""
        self.opened = 0

    endpoints: tuple[str, ...] = ()  # nothing that others could command too
    has_watchdog = True

    def _open(self) -> None:
        self.opened += 1

    def _close(self) -> None: ...

    def _write(self, pressures: Array) -> None:
        if self.dead == "before":
            raise DeviceError("it does not answer")
        self.written.append(pressures)
        if self.dead == "after":
            raise DeviceError("it answers no more")

    def _read(self) -> ArrayLike:
        return self.written[-1] + 7.0
