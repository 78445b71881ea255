"""The simulated lab: plant, regulators, tracker and stage under one clock.

What devices are told and tell is in their terms; what is true (`tip_pose`, `pressures`) is here
and nowhere in the interface of the rig, so that no controller reads it by accident.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt import lie
from stiffopt.errors import InputError
from stiffopt.model.description import RobotDescription
from stiffopt.rig.interface import Clock, PressureLimits
from stiffopt.rig.simulated.plant import Plant
from stiffopt.rig.simulated.regulators import Regulators, regulate
from stiffopt.rig.simulated.settings import (
    PlantSettings,
    SimulatedProbeSettings,
    SimulatedSupplySettings,
    SimulatedTrackerSettings,
)

__all__ = ["FAULTS", "Frame", "World"]

Array = NDArray[np.float64]

FAULTS = {
    "supply": ("ok", "off", "stuck", "garbage", "wrong", "slow", "leak", "high"),
    "tracker": ("ok", "off", "stuck", "garbage", "wrong", "slow", "missing", "flip"),
    "probe": ("ok", "off", "stuck", "garbage", "wrong", "slow"),
}
"""What can be injected, by device. ``stuck`` holds the last value, ``wrong`` is plausible but off,
``garbage`` is not plausible at all; ``high`` is a regulator stuck at its highest pressure."""

_IMMOBILE = ("off", "stuck")  # faults of a stage that does not move
_SLOW = 0.5  # s, by which a slow device is late
_LEAK = 0.3  # s; time constant of an injected leak
_AWAY = np.array([0.02, -0.015, 0.01])  # m, by which a wrong tracker is off
_KEPT = 4096  # frames that wait to be read
_LONGEST = 1.0  # s of real time that is caught up with at once; more than that is skipped


@dataclass(frozen=True)
class Frame:
    """A frame of the tracker, in its own terms.

    Attributes
    ----------
    number : counted from 1.
    captured, delivered : when, in s.
    position : of the sensor in the tracker's frame (3,), in m; NaN where it is not seen.
    quaternion : (4,), w first, of any sign.
    """

    number: int
    captured: float
    delivered: float
    position: Array
    quaternion: Array


class World:
    """An arm and its devices in time. Methods may be called by any thread.

    Parameters
    ----------
    robot :
        What the robot file says.
    limits :
        Of the pressures.
    plant, supply, tracker, probe :
        Settings.
    real_time :
        Whether time passes by itself; otherwise it passes in `advance_to`.
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
        self.supply, self.tracker, self.probe = supply, tracker, probe
        self.faults = dict.fromkeys(FAULTS, "ok")
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
        """What the regulators were told (n,), in Pa."""
        self._commanded_at = 0.0
        self.pressures = np.zeros(n)
        """In the chambers (n,), in Pa."""
        streams = np.random.SeedSequence([plant.seed, 2]).spawn(4)
        self._ripple, self._gauge, self._optics, self._balance = map(np.random.default_rng, streams)
        self._frames: deque[Frame] = deque(maxlen=_KEPT)
        self._captured = 0
        self._last_frame: Frame | None = None
        self._axis: Array | None = None
        self._stage_origin = 0.0
        self.stage_position = 0.0
        self._stage_target = 0.0
        self._stage_speed = 0.0
        self._run(0)  # compiles what has not been compiled yet: no time for that later
        self.plant.contact_force()
        self._epoch = time.monotonic()

    # Time ----------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Time of the world, in s."""
        return self.plant.time

    @property
    def epoch(self) -> float:
        """The moment 0 of the world on `time.monotonic`, in real time."""
        return self._epoch

    def now(self) -> float:
        """Time on the rig's clock, in s."""
        return time.monotonic() - self._epoch if self._real_time else self.time

    def catch_up(self) -> None:
        """Let the world reach the present; does nothing unless it runs in real time."""
        if self._real_time:
            with self.lock:
                behind = self.now() - self.time
                if behind > _LONGEST:  # a busy machine: that time did not happen
                    self._epoch += behind - _LONGEST
                self.advance_to(self.now())

    def advance_to(self, moment: float) -> None:
        """Let the world run until it is at a moment, in s."""
        with self.lock:
            step = self.plant.step
            goal = int(np.ceil(moment / step - 1e-6))
            while (here := round(self.time / step)) < goal:
                self._run(min(goal, self._next_event(here)) - here)

    def _next_event(self, here: int) -> int:
        """Return the step at which something other than physics happens next."""
        step = self.plant.step
        events = [here + 1_000_000]
        if self.tracker is not None:
            events.append(self._capture_step(self._captured))
        if self._stage_speed:
            distance = abs(self._stage_target - self.stage_position)
            events.append(here + max(1, int(distance / self._stage_speed / step)))
        if self.supply.watchdog is not None and self.set_point.any():
            events.append(int(np.ceil((self._commanded_at + self.supply.watchdog) / step)))
        return max(here + 1, min(events))

    def _capture_step(self, count: int) -> int:
        """Return the step in which a frame (counted from 0) is captured."""
        rate = self.tracker.rate if self.tracker else 1.0
        return round((count + 1) / rate / self.plant.step)

    def _run(self, steps: int) -> None:
        trace = np.empty((steps, self._n))
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
        self._place_plate(steps)
        self.plant.follow(trace)
        self._move_stage(steps)
        here = round(self.time / self.plant.step)
        if self.tracker is not None and steps and here >= self._capture_step(self._captured):
            self._capture()
        watchdog = self.supply.watchdog
        if watchdog is not None and self.time - self._commanded_at >= watchdog:
            self.set_point[:] = 0.0

    # Supply --------------------------------------------------------------------------------------

    def command(self, pressures: ArrayLike) -> None:
        """Give the regulators their set-points (n,), in Pa."""
        with self.lock:
            self._commanded_at = self.time
            p = np.array(pressures, dtype=float)
            if self.supply.resolution > 0:
                p = np.round(p / self.supply.resolution) * self.supply.resolution
            if self.faults["supply"] != "off":
                self.set_point[:] = p

    def command_channel(self, channel: int, pressure: float) -> None:
        """Give one regulator (from 0) its set-point, in Pa."""
        with self.lock:
            p = self.set_point.copy()
            p[channel] = pressure
            self.command(p)

    def measured(self) -> Array:
        """Return the pressures (n,) that the regulators measure, in Pa."""
        with self.lock:
            p = self.pressures + self.supply.noise * self._gauge.standard_normal(self._n)
            if self.supply.resolution > 0:
                p = np.round(p / self.supply.resolution) * self.supply.resolution
            for channel, fault in self._faulty.items():
                if fault == "garbage":
                    p[channel] = np.nan if self._gauge.random() < 0.5 else 9.9e9
                elif fault == "wrong":
                    p[channel] = 0.7 * p[channel] + 2e4
            return p

    def dump(self, *, open_valve: bool) -> None:
        """Open or close the valve that empties all chambers."""
        with self.lock:
            self._regulators = self._regulators._replace(dumped=open_valve)

    @property
    def valve_open(self) -> bool:
        """Whether the dump valve is open."""
        return bool(self._regulators.dumped)

    # Tracker -------------------------------------------------------------------------------------

    def frames(self) -> list[Frame]:
        """Return the frames that have been delivered since the last call."""
        with self.lock:
            ready = []
            while self._frames and self._frames[0].delivered <= self.now() + 1e-9:
                ready.append(self._frames.popleft())
            return ready

    def _capture(self) -> None:
        tracker, fault = self.tracker, self.faults["tracker"]
        self._captured += 1
        if tracker is None:
            return
        chances = self._optics.random(3)  # drawn in every frame, so that faults shift no stream
        noise = self._optics.standard_normal(6)
        if fault == "off" or chances[0] < tracker.missing:
            return
        T = self._as_tracked(noise)
        position, q = T[:3, 3].copy(), np.asarray(lie.quaternion_from_rotation(T[:3, :3]))
        if fault == "missing" or chances[1] < tracker.dropouts:
            position, q = np.full(3, np.nan), np.full(4, np.nan)
        elif fault == "wrong":
            position = position + _AWAY
        elif fault == "garbage":
            position, q = position * 1e3 * noise[:3], np.full(4, np.nan)
        if chances[2] < tracker.flips or (fault == "flip" and self._captured % 2):
            q = -q
        late = tracker.latency + (_SLOW if fault == "slow" else 0.0)
        captured = self.time
        frame = Frame(self._captured, captured, captured + late, position, q)
        if fault == "stuck" and self._last_frame is not None:
            last = self._last_frame
            frame = Frame(
                last.number, last.captured, captured + late, last.position, last.quaternion
            )
        self._last_frame = frame
        self._frames.append(frame)

    def _as_tracked(self, noise: Array) -> Array:
        """Pose (4, 4) of the sensor in the tracker's frame, with the tracker's noise."""
        tracker = self.tracker
        tip = np.linalg.inv(self.plant.mismatch.registration.transform()) @ self.plant.tip_pose()
        if tracker is None:
            return tip
        T = tracker.registration.sensor_in_tracker(tip)
        T[:3, 3] += tracker.noise * noise[:3]
        turn = np.concatenate((np.zeros(3), tracker.angular_noise * noise[3:]))
        T[:3, :3] = T[:3, :3] @ np.asarray(lie.exp(turn))[:3, :3]
        return T

    # Probe ---------------------------------------------------------------------------------------

    def align_stage(self, direction: ArrayLike | None) -> None:
        """Mount the stage along a unit vector (3,) just clear of the tip, or take it away."""
        with self.lock:
            if direction is None or self.probe is None:
                self._axis = None
            else:
                self._axis = np.array(direction, dtype=float)
                self._axis /= np.linalg.norm(self._axis)
                tip = self.plant.tip_pose()[:3, 3]
                self._stage_origin = float(self._axis @ tip) - self.probe.clearance
            self.stage_position = self._stage_target = self._stage_speed = 0.0
            self._place_plate(0)

    def move_stage(self, position: float, speed: float) -> None:
        """Let the stage start to move, m and m/s."""
        with self.lock:
            if self.probe is None:
                return
            speed = min(speed, self.probe.speed)
            if self.faults["probe"] == "slow":
                speed /= 10
            self._stage_target = position
            moving = position != self.stage_position and self.faults["probe"] not in _IMMOBILE
            self._stage_speed = speed if moving else 0.0

    def stop_stage(self) -> None:
        """Stop the stage."""
        with self.lock:
            self._stage_speed = 0.0

    @property
    def stage_moving(self) -> bool:
        """Whether the stage moves."""
        return self._stage_speed > 0

    def force(self) -> float:
        """Force that the sensor at the stage feels, in N."""
        with self.lock:
            noise = (self.probe.noise if self.probe else 0.0) * self._balance.standard_normal()
            force = self.plant.contact_force() if self._axis is not None else 0.0
            fault = self.faults["probe"]
            if fault == "garbage":
                return float("nan") if noise > 0 else 1e6 * noise
            return (0.5 * force + 0.1 if fault == "wrong" else force) + noise

    def _place_plate(self, steps: int) -> None:
        if self._axis is None or self.probe is None:
            self.plant.set_plate(None)
            return
        direction = np.sign(self._stage_target - self.stage_position)
        at = self._stage_origin + self.stage_position
        speed = direction * self._stage_speed if steps else 0.0
        self.plant.set_plate(self._axis, at, self.probe.stiffness, speed)

    def _move_stage(self, steps: int) -> None:
        if self._stage_speed:
            distance = self._stage_target - self.stage_position
            moved = self._stage_speed * steps * self.plant.step
            if moved >= abs(distance) - 1e-9:
                self.stage_position, self._stage_speed = self._stage_target, 0.0
            else:
                self.stage_position += float(np.sign(distance)) * moved
        self._place_plate(0)

    # Faults --------------------------------------------------------------------------------------

    def inject(self, device: str, fault: str, channel: int | None = None) -> None:
        """Let a device misbehave from now on, or be ``ok`` again.

        Parameters
        ----------
        device, fault :
            See `FAULTS`.
        channel :
            Of the supply (from 0) that misbehaves; by default all do.

        Raises
        ------
        InputError
            There is no such device, fault or channel, or the rig file does not allow faults.
        """
        if not self.plant.settings.faults:
            raise InputError("faults are not enabled; say 'faults: true' in the rig file's plant")
        if fault not in FAULTS.get(device, ()):
            known = "; ".join(f"{name}: {', '.join(names)}" for name, names in FAULTS.items())
            raise InputError(f"there is no fault '{fault}' of '{device}'; there are {known}")
        if channel is not None and (device != "supply" or not 0 <= channel < self._n):
            raise InputError(f"there is no channel {channel} of '{device}'")
        with self.lock:
            self.catch_up()
            self.faults[device] = fault
            if device == "supply":
                self._set_faulty(fault, range(self._n) if channel is None else [channel])
            if device == "probe" and fault in _IMMOBILE:
                self._stage_speed = 0.0

    def _set_faulty(self, fault: str, channels: range | list[int]) -> None:
        regulators, settings = self._regulators, self.supply
        for c in channels:
            self._faulty.pop(c, None)
            if fault != "ok":
                self._faulty[c] = fault
            held = {"stuck": self.pressures[c], "high": regulators.saturation[c]}
            regulators.held[c] = held.get(fault, np.nan)
            regulators.lag[c] = settings.lag + (_SLOW if fault == "slow" else 0.0)
            leak = 0.0 if settings.leak is None else 1 / settings.leak
            regulators.leak[c] = 1 / _LEAK if fault == "leak" else leak
        if not self._faulty:
            self.faults["supply"] = "ok"


class WorldClock(Clock):
    """The clock of a world: real, or one that only moves when somebody sleeps."""

    def __init__(self, world: World, *, real_time: bool) -> None:
        self._world = world
        self._real_time = real_time

    def now(self) -> float:
        """Time of the world, in s."""
        return self._world.now()

    def sleep_until(self, moment: float) -> None:
        """Let the world reach a moment."""
        if not self._real_time:
            self._world.advance_to(moment)
            return
        while (remaining := moment - self._world.now()) > 0:
            time.sleep(min(remaining, 0.05))
            self._world.catch_up()
