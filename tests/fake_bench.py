"""A bench without an arm: what the peers of the virtual lab are tested against."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Lock

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.lab.bench import TrackerFrame

FRAME_RATE = 40.0  # Hz


class FakeBench:
    """In place of a `Bench`: regulators that obey at once, a resting sensor, a moving stage.

    Attributes
    ----------
    pressures : what was last commanded (n,), in Pa.
    commands : all commands in order: channel counted from 0, pressure in Pa.
    readings : what the regulators report (n,), in Pa; None: what was commanded.
    valve_open : state of the dump valve; an open one makes `pressures_in_arm` 0.
    valve_states : all states it was given.
    position, quaternion : of the sensor in the tracker's frame.
    frozen : number of the frame at which the tracker hangs; None: it runs.
    faults : of each device; what is not here is ``ok``.
    force_at : force in N for a position of the stage in m.
    """

    def __init__(self, n: int = 3) -> None:
        self.pressures: Array = np.zeros(n)
        self.commands: list[tuple[int, float]] = []
        self.readings: Array | None = None
        self.valve_open = False
        self.valve_states: list[bool] = []
        self.position: ArrayLike = (0.01, -0.02, -0.15)
        self.quaternion: ArrayLike = (1.0, 0.0, 0.0, 0.0)
        self.frozen: int | None = None
        self.faults: dict[str, str] = {}
        self.force_at: Callable[[float], float] = lambda position: 0.0
        self._lock = Lock()
        self._began = time.monotonic()
        self._stage = (0.0, 0.0, 0.0, self._began)  # from, to, speed, since

    @property
    def n(self) -> int:
        return len(self.pressures)

    @property
    def pressures_in_arm(self) -> Array:
        with self._lock:
            return np.zeros(self.n) if self.valve_open else self.pressures.copy()

    def command(self, channel: int, pressure: float) -> None:
        with self._lock:
            self.commands.append((channel, float(pressure)))
            self.pressures[channel] = pressure

    def fill(self, pressures: ArrayLike) -> None:
        with self._lock:
            self.pressures = np.array(pressures, float)

    def channel_faults(self) -> dict[int, str]:
        return dict.fromkeys(range(self.n), self.fault("supply"))

    def measured(self) -> Array:
        return self.pressures_in_arm if self.readings is None else np.array(self.readings, float)

    def dump(self, *, open_valve: bool) -> None:
        with self._lock:
            self.valve_open = open_valve
            self.valve_states.append(open_valve)

    def frame(self) -> TrackerFrame | None:
        number = self.frozen
        if number is None:
            number = int((time.monotonic() - self._began) * FRAME_RATE) + 1
        captured = self._began + (number - 1) / FRAME_RATE
        position, quaternion = (np.array(x, float) for x in (self.position, self.quaternion))
        return TrackerFrame(number, captured, position, quaternion)

    def fault(self, device: str) -> str:
        return self.faults.get(device, "ok")

    @property
    def stage_position(self) -> float:
        with self._lock:
            return self._stage_now()

    @property
    def stage_moving(self) -> bool:
        with self._lock:
            return self._stage_now() != self._stage[1]

    def stage_move(self, position: float, speed: float) -> None:
        with self._lock:
            self._stage = (self._stage_now(), position, abs(speed), time.monotonic())

    def stage_stop(self) -> None:
        with self._lock:
            here = self._stage_now()
            self._stage = (here, here, 0.0, time.monotonic())

    def force(self) -> float:
        return self.force_at(self.stage_position)

    def _stage_now(self) -> float:
        start, end, speed, since = self._stage
        way = speed * (time.monotonic() - since)
        return end if way >= abs(end - start) else start + float(np.copysign(way, end - start))
