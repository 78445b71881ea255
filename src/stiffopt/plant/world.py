"""The simulated world: plant, regulators, tracker and probe under one clock.

The devices report what real ones would: rounded, late and noisy values. The truth
(`Plant.tip_pose`, `World.pressures`) is only here, not in the interface of the rig, so that no
controller reads it by accident.
"""

from __future__ import annotations

import threading
import time

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.model.description import RobotDescription
from stiffopt.plant.hardware import (
    IMMOBILE,
    Camera,
    Frame,
    Regulators,
    SimulatedStage,
    regulate,
)
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import (
    FAULT_SIZES,
    PlantSettings,
    SimulatedProbeSettings,
    SimulatedSupplySettings,
    SimulatedTrackerSettings,
)
from stiffopt.rig.interface import Clock, PressureLimits

FAULTS = {
    "supply": ("ok", "off", "stuck", "garbage", "wrong", "slow", "leak", "high"),
    "tracker": (
        *("ok", "off", "stuck", "garbage", "wrong", "slow", "missing", "flip"),
        *("loose", "drifting", "turning", "shaking", "lagging"),
    ),
    "probe": ("ok", "off", "stuck", "garbage", "wrong", "slow"),
}
"""Faults that can be injected, by device. ``stuck`` holds the last value; ``wrong`` is plausible,
but off; ``garbage`` is implausible; ``high`` is a regulator stuck at its highest pressure; a
``loose`` sensor has come off and lies still; a ``lagging`` tracker reports older and older poses as
new."""

_LONG = 1_000_000  # steps, an upper bound of those without an event
_LONGEST = 30.0  # s of real time to catch up with at once; anything beyond is skipped


class World:
    """The simulated arm and its devices in time. Any thread may call any method.

    Parameters
    ----------
    robot : description of the arm.
    limits : limits of the pressures.
    plant, supply, tracker, probe : settings.
    real_time : whether time passes by itself; otherwise it passes in `advance_to`.
    """

    def __init__(
        self,
        robot: RobotDescription,
        limits: PressureLimits,
        plant: PlantSettings,
        supply: SimulatedSupplySettings,
        tracker: SimulatedTrackerSettings | None = None,
        probe: SimulatedProbeSettings | None = None,
        *,
        real_time: bool = False,
    ) -> None:
        self.plant = Plant(robot, plant)
        self.lock = threading.RLock()
        self.supply = supply
        self.faults = dict.fromkeys(FAULTS, "ok")
        self.known_faults = dict(FAULTS)
        """Faults that can be injected; a device of the virtual lab may add its own."""
        self._faulty: dict[int, str] = {}
        self._real_time = real_time
        n, step = limits.n, self.plant.step
        self._n = n
        saturation = limits.high if supply.saturation is None else supply.saturation
        self._regulators = Regulators(
            step=step,
            lag=np.full(n, supply.lag),
            slew=np.full(n, supply.slew),
            saturation=np.broadcast_to(saturation, n).astype(float),
            leak=np.full(n, 0.0 if supply.leak is None else 1 / supply.leak),
            held=np.full(n, np.nan),
            dumped=False,
        )
        self._delayed = np.zeros((round(supply.dead_time / step), n))
        self._first = 0
        self.set_point = np.zeros(n)
        """Set-points of the regulators (n,), in Pa."""
        self._commanded_at = 0.0
        self._filled: Array | None = None  # pressures from `fill`, in place of the regulators
        self.pressures = np.zeros(n)
        """Pressures in the chambers (n,), in Pa."""
        streams = np.random.SeedSequence([plant.seed, 2]).spawn(4)
        self._ripple, self._gauge, optics, balance = map(np.random.default_rng, streams)
        self.camera = None if tracker is None else Camera(tracker, self.plant, optics)
        self.stage = SimulatedStage(
            probe or SimulatedProbeSettings(), self.plant, balance, self.faults, self.lock
        )
        self._run(0)  # compiles everything now: later there is no time for it
        self.plant.contact_force()
        self.epoch = time.monotonic()
        """Time of `time.monotonic` at time 0 of the world, in real time, in s."""

    # Time ----------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Time of the world, in s."""
        return self.plant.time

    def now(self) -> float:
        """Return the time on the rig's clock, in s."""
        return time.monotonic() - self.epoch if self._real_time else self.time

    def catch_up(self) -> None:
        """Advance the world to the present; does nothing unless it runs in real time."""
        if self._real_time:
            with self.lock:
                now = self.now()
                if now - self.time > _LONGEST:  # the machine was busy: skip that time
                    self.plant.skip(now - self.time - _LONGEST)
                    if self.camera is not None:
                        self.camera.skip()
                self.advance_to(now)

    def advance_to(self, moment: float) -> None:
        """Advance the world to a time, in s."""
        with self.lock:
            step = self.plant.step
            goal = int(np.ceil(moment / step - 1e-6))
            while (here := round(self.time / step)) < goal:
                self._run(min(goal, self._next_event(here)) - here)

    def _next_event(self, here: int) -> int:
        """Return the next step with an event besides physics."""
        step = self.plant.step
        events = [here + _LONG]
        if self.camera is not None:
            events.append(self.camera.next_step())
        if (left := self.stage.steps_left()) is not None:
            events.append(here + left)
        if self.supply.watchdog is not None and self.set_point.any():
            runs_out = self._commanded_at + self.supply.watchdog
            events.append(int(np.ceil(runs_out / step - 1e-6)))
        return max(here + 1, min(events))

    def _run(self, steps: int) -> None:
        trace = np.empty((steps, self._n))
        if self._filled is None:
            ripple = self.supply.ripple * self._ripple.standard_normal((steps, self._n))
            self._first = regulate(
                self._regulators,
                self._delayed,
                self._first,
                self.set_point,
                self.pressures,
                ripple,
                trace,
            )
        elif steps:
            midway = (np.arange(steps) + 0.5)[:, None] / steps
            trace[:] = self.pressures + (self._filled - self.pressures) * midway
            self.pressures[:] = self._filled
        self.stage.place_plate(steps)
        self.plant.follow(trace)
        self.stage.advance(steps)
        here = round(self.time / self.plant.step)
        if self.camera is not None and here >= self.camera.next_step():
            self.camera.capture(self.faults["tracker"])
        watchdog = self.supply.watchdog
        if watchdog is not None and self.time - self._commanded_at >= watchdog - 1e-9:
            self.set_point[:] = 0.0

    # Supply --------------------------------------------------------------------------------------

    def command(self, pressures: ArrayLike) -> None:
        """Set the regulators' set-points (n,), in Pa."""
        with self.lock:
            p = np.array(pressures, dtype=float)
            if self.supply.resolution > 0:
                p = np.rint(p / self.supply.resolution) * self.supply.resolution
            if self.faults["supply"] != "off":  # a supply that is off receives nothing
                self._commanded_at = self.time
                self.set_point[:] = p

    def command_channel(self, channel: int, pressure: float) -> None:
        """Set the set-point of one regulator (from 0), in Pa."""
        with self.lock:
            p = self.set_point.copy()
            p[channel] = pressure
            self.command(p)

    def fill(self, pressures: ArrayLike) -> None:
        """Set the pressures (n,) in the chambers, in Pa; the world's regulators are idle then.

        The chambers reach them in the next step of time.
        """
        with self.lock:
            self._filled = np.array(pressures, dtype=float)

    def measured(self) -> Array:
        """Return the pressures (n,) that the regulators measure, in Pa."""
        with self.lock:
            p = self.pressures + self.supply.noise * self._gauge.standard_normal(self._n)
            if self.supply.resolution > 0:
                p = np.rint(p / self.supply.resolution) * self.supply.resolution
            for channel, fault in self._faulty.items():
                if fault == "garbage":
                    p[channel] = np.nan if self._gauge.random() < 0.5 else 9.9e9
                elif fault == "wrong":
                    p[channel] = FAULT_SIZES.reading_gain * p[channel] + FAULT_SIZES.reading_offset
            return p

    def dump(self, *, open_valve: bool) -> None:
        """Open or close the valve that empties all chambers."""
        with self.lock:
            self._regulators = self._regulators._replace(dumped=open_valve)

    @property
    def valve_open(self) -> bool:
        """Whether the dump valve is open."""
        return bool(self._regulators.dumped)

    def frames(self) -> list[Frame]:
        """Return the tracker's frames delivered since the last call."""
        with self.lock:
            return [] if self.camera is None else self.camera.delivered(self.now())

    # Faults --------------------------------------------------------------------------------------

    def inject(self, device: str, fault: str, channel: int | None = None) -> None:
        """Make a device faulty from now on, or ``ok`` again.

        `device`, `fault`: see `known_faults`. `channel`: faulty channel of the supply (from 0);
        None: all of them. Raises `InputError`: there is no such device, fault or channel, or the
        rig file does not allow faults.
        """
        if not self.plant.settings.faults:
            raise InputError("faults are not enabled; set 'faults: true' in the rig file's plant")
        if fault not in self.known_faults.get(device, ()):
            faults = self.known_faults.items()
            known = "; ".join(f"{name}: {', '.join(names)}" for name, names in faults)
            raise InputError(f"there is no fault '{fault}' of '{device}'; there are {known}")
        if channel is not None and (device != "supply" or not 0 <= channel < self._n):
            raise InputError(f"there is no channel {channel + 1} of '{device}'")
        with self.lock:
            self.catch_up()
            self.faults[device] = fault
            if device == "supply":
                self._set_faulty(fault, range(self._n) if channel is None else [channel])
            if device == "probe" and fault in IMMOBILE:
                self.stage.stop()

    def channel_faults(self) -> dict[int, str]:
        """Return the supply's faults by channel, counted from 0."""
        with self.lock:
            return dict(self._faulty)

    def _set_faulty(self, fault: str, channels: range | list[int]) -> None:
        regulators, settings = self._regulators, self.supply
        for c in channels:
            self._faulty.pop(c, None)
            if fault != "ok":
                self._faulty[c] = fault
            held = {"stuck": self.pressures[c], "high": regulators.saturation[c]}
            regulators.held[c] = held.get(fault, np.nan)
            regulators.lag[c] = settings.lag + (FAULT_SIZES.lag if fault == "slow" else 0.0)
            leak = 0.0 if settings.leak is None else 1 / settings.leak
            regulators.leak[c] = 1 / FAULT_SIZES.leak_time if fault == "leak" else leak
        if not self._faulty:
            self.faults["supply"] = "ok"


class WorldClock(Clock):
    """Clock of a world: real time, or time that passes only during sleeps."""

    def __init__(self, world: World, *, real_time: bool) -> None:
        self._world = world
        self._real_time = real_time

    def now(self) -> float:
        """Return the time of the world, in s."""
        return self._world.now()

    def sleep_until(self, moment: float) -> None:
        """Advance the world to a time, in s."""
        if not self._real_time:
            self._world.advance_to(moment)
            return
        while (remaining := moment - self._world.now()) > 0:
            time.sleep(min(remaining, 0.05))
            self._world.catch_up()
