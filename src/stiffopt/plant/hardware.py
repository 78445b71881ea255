"""The hardware of the simulated devices: regulators, a tracking camera, a stage with a sensor.

Each acts on the plant or measures it, step by step, and can have faults.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from threading import RLock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.plant.jit import jit
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import (
    FAULT_SIZES,
    SimulatedProbeSettings,
    SimulatedTrackerSettings,
)

Compiled = Any  # an array of floats in compiled code; numba infers the rest

IMMOBILE = ("off", "stuck")
"""Faults with which a stage does not move."""
_QUEUED = 4096  # frames waiting to be read
_EMPTYING = 0.02  # s; time constant with which a chamber empties through the dump valve


class Regulators(NamedTuple):
    """Parameters of the regulators of n channels.

    Attributes
    ----------
    step : time step, s.
    lag, slew, saturation : (n,), s, Pa/s and Pa.
    leak : share of the pressure that a leak takes per second (n,).
    held : pressure at which a regulator is stuck (n,), Pa; NaN if it is not.
    dumped : whether the dump valve is open.
    """

    step: float
    lag: Compiled
    slew: Compiled
    saturation: Compiled
    leak: Compiled
    held: Compiled
    dumped: bool


@jit
def regulate(
    regulators: Regulators,
    delayed: Compiled,
    first: int,
    set_point: Compiled,
    pressure: Compiled,
    ripple: Compiled,
    trace: Compiled,
) -> int:
    """Simulate the regulators for a number of steps.

    Returns the index of the oldest set-point in the ring afterwards.

    Parameters
    ----------
    regulators : their parameters.
    delayed : set-points that have not reached the regulators yet (d, n), a ring buffer.
    first : index of the oldest in the ring.
    set_point : the newest set-points (n,).
    pressure : in the chambers (n,), without ripple; updated.
    ripple : added at each step (m, n).
    trace : set to the pressure midway through each step (m, n).
    """
    h = regulators.step
    depth = len(delayed)
    emptying = 1 - math.exp(-h / _EMPTYING)
    for i in range(len(trace)):
        for c in range(len(pressure)):
            wanted = set_point[c]
            if depth > 0:
                wanted, delayed[first, c] = delayed[first, c], wanted
            before = pressure[c]
            if not math.isnan(regulators.held[c]):
                wanted = regulators.held[c]
            wanted = min(wanted, regulators.saturation[c])
            change = wanted - before
            if regulators.lag[c] > 0:
                change *= 1 - math.exp(-h / regulators.lag[c])
            limit = regulators.slew[c] * h
            change = min(max(change, -limit), limit)
            change -= (1 - math.exp(-regulators.leak[c] * h)) * before
            if regulators.dumped:
                change = -emptying * before
            pressure[c] = before + change
            trace[i, c] = before + 0.5 * change + ripple[i, c]
        if depth > 0:
            first = (first + 1) % depth
    return first


@dataclass(frozen=True)
class Frame:
    """One frame of the camera: the sensor in the tracker's frame.

    Attributes
    ----------
    number : counted from 1.
    captured, delivered : times, in s.
    position : of the sensor in the tracker's frame (3,), in m; NaN if it is not seen.
    quaternion : (4,), w first, of any sign.
    """

    number: int
    captured: float
    delivered: float
    position: Array
    quaternion: Array


class Camera:
    """Simulated tracking camera: captures the sensor at the tip and delivers frames late.

    `count`: frames captured so far, lost ones included.
    """

    def __init__(
        self, settings: SimulatedTrackerSettings, plant: Plant, rng: np.random.Generator
    ) -> None:
        self.settings = settings
        self.count = 0
        self._plant = plant
        self._rng = rng
        self._sent: deque[Frame] = deque(maxlen=_QUEUED)
        self._last: Frame | None = None
        self._seen: deque[Array] = deque(maxlen=_QUEUED)  # poses (4, 4), one per frame
        self._fault, self._began = "ok", 0.0  # the last fault, and when it began

    def next_step(self) -> int:
        """Return the plant's step in which the next frame is captured."""
        return round((self.count + 1) / self.settings.rate / self._plant.step)

    def skip(self) -> None:
        """Drop the frames of a time that was skipped."""
        self.count = max(self.count, int(self._plant.time * self.settings.rate))

    def delivered(self, now: float) -> list[Frame]:
        """Return the frames that have arrived by now and were not returned before."""
        ready = []
        while self._sent and self._sent[0].delivered <= now + 1e-9:
            ready.append(self._sent.popleft())
        return ready

    def capture(self, fault: str) -> None:
        """Capture a frame, or lose it."""
        self.count += 1
        settings = self.settings
        chances = self._rng.random(3)  # drawn in every frame, so that faults shift no random stream
        noise = self._rng.standard_normal(6)
        if fault == "off" or chances[0] < settings.missing:
            return
        T = self._creeping(fault, noise)
        position, q = T[:3, 3].copy(), np.asarray(lie.quaternion_from_rotation(T[:3, :3]))
        if fault == "missing" or chances[1] < settings.dropouts:
            position, q = np.full(3, np.nan), np.full(4, np.nan)
        elif fault == "wrong":
            position = position + FAULT_SIZES.tracker_offset
        elif fault == "garbage":
            position, q = position * 1e3 * noise[:3], np.full(4, np.nan)
        if chances[2] < settings.flips or (fault == "flip" and self.count % 2):
            q = -q
        now = self._plant.time
        arrival = now + settings.latency + (FAULT_SIZES.frame_delay if fault == "slow" else 0.0)
        if self._last is not None:
            arrival = max(arrival, self._last.delivered)  # frames stay in order
        if fault == "stuck" and self._last is not None:
            frame = replace(self._last, delivered=arrival)
        else:
            frame = Frame(self.count, now, arrival, position, q)
        self._last = frame
        self._sent.append(frame)

    def _creeping(self, fault: str, noise: Array) -> Array:
        """Return the sensor's measured pose (4, 4), with a fault that grows since it began."""
        now, sizes = self._plant.time, FAULT_SIZES
        if fault != self._fault:
            self._fault, self._began = fault, now
        elapsed = now - self._began
        if fault == "loose" and self._seen:  # the sensor lies where it fell
            return self._noisy(self._seen[-1], noise)
        self._seen.append(self.sensor_in_tracker())
        if fault == "lagging":  # an older pose, reported as new
            age = round(sizes.lag_growth * elapsed * self.settings.rate)
            return self._noisy(self._seen[max(-1 - age, -len(self._seen))], noise)
        T = self._noisy(self._seen[-1], noise)
        if fault == "drifting":
            T[:3, 3] += elapsed * np.array(sizes.drift)
        elif fault == "turning":
            T = lie.exp(np.array([0, 0, 0, *sizes.turn]) * elapsed) @ T
        elif fault == "shaking":
            T[:3, 3] += np.array(sizes.shake) * math.sin(2 * math.pi * sizes.shake_rate * elapsed)
        return T

    def sensor_in_tracker(self) -> Array:
        """Return the sensor's pose (4, 4) in the tracker's frame, without noise."""
        off = self._plant.mismatch.registration.inverse()
        return np.asarray(
            self.settings.registration.sensor_in_tracker(off @ self._plant.tip_pose())
        )

    def _noisy(self, pose: Array, noise: Array) -> Array:
        """Return a pose with noise (6,), in standard deviations."""
        settings, T = self.settings, pose.copy()
        T[:3, 3] += settings.noise * noise[:3]
        small = np.concatenate(([1.0], 0.5 * settings.angular_noise * noise[3:]))
        turn = lie.rotation_from_quaternion(small / np.linalg.norm(small))
        T[:3, :3] = T[:3, :3] @ turn
        return T


class SimulatedStage:
    """A stage that can be mounted along any direction, and the force sensor on it.

    Parameters
    ----------
    settings, plant, rng : settings of the probe, the arm that it pushes, and the source of the
        sensor's noise.
    faults : present fault of each device; that of ``probe`` counts.
    lock : held while the plant or the stage changes: any thread may call any method.

    Attributes
    ----------
    position : m, along its axis.
    speed : present speed, m/s; 0 at rest.
    """

    def __init__(
        self,
        settings: SimulatedProbeSettings,
        plant: Plant,
        rng: np.random.Generator,
        faults: dict[str, str],
        lock: RLock,
    ) -> None:
        self.settings = settings
        self.position = 0.0
        self.speed = 0.0
        self._plant = plant
        self._rng = rng
        self._faults = faults
        self._lock = lock
        self._axis: Array | None = None
        self._origin = 0.0
        self._target = 0.0

    def mount(self, direction: ArrayLike | None) -> None:
        """Mount the stage along a vector (3,) just clear of the tip; None: take it away."""
        with self._lock:
            self._axis = None
            if direction is not None:
                self._axis = np.array(direction, dtype=float)
                self._axis /= np.linalg.norm(self._axis)
                tip = self._plant.tip_pose()[:3, 3]
                self._origin = float(self._axis @ tip) - self.settings.clearance
            self.position = self._target = self.speed = 0.0
            self.place_plate(0)

    def move(self, position: float, speed: float) -> None:
        """Start to move to a position, m, at a speed, m/s."""
        with self._lock:
            speed = min(speed, self.settings.speed)
            if self._faults["probe"] == "slow":
                speed *= FAULT_SIZES.stage_speed
            self._target = position
            moves = position != self.position and self._faults["probe"] not in IMMOBILE
            self.speed = speed if moves else 0.0

    def stop(self) -> None:
        """Stop at once."""
        with self._lock:
            self.speed = 0.0

    def steps_left(self) -> int | None:
        """Return the plant's steps until the stage arrives, or None at rest."""
        if not self.speed:
            return None
        steps = abs(self._target - self.position) / self.speed / self._plant.step
        return max(1, math.ceil(steps - 1e-6))

    def place_plate(self, steps: int) -> None:
        """Set the plate of the plant, and its motion in the next steps."""
        if self._axis is None:
            surface = self._plant.settings.surface
            if surface is None:
                self._plant.set_plate(None)
            else:
                at = float(np.dot(surface.normal, surface.point))
                self._plant.set_plate(surface.normal, at, surface.stiffness)
            return
        duration = steps * self._plant.step
        speed = self._movement(duration) / duration if steps else 0.0
        at = self._origin + self.position
        self._plant.set_plate(self._axis, at, self.settings.stiffness, speed)

    def advance(self, steps: int) -> None:
        """Move the stage by some steps of the plant."""
        if self.speed:
            self.position += self._movement(steps * self._plant.step)
            if abs(self._target - self.position) < 1e-9:
                self.position, self.speed = self._target, 0.0
        self.place_plate(0)

    def _movement(self, duration: float) -> float:
        """Return how far the stage moves in a time, m, at most to its target."""
        far = self.speed * duration
        return float(np.clip(self._target - self.position, -far, far))

    def force(self) -> float:
        """Return the force that the sensor measures, N."""
        with self._lock:
            noise = float(self.settings.noise * self._rng.standard_normal())
            force = self._plant.contact_force() if self._axis is not None else 0.0
        if self._faults["probe"] == "garbage":
            return float("nan") if noise > 0 else 1e6 * noise
        if self._faults["probe"] == "wrong":
            force = FAULT_SIZES.force_gain * force + FAULT_SIZES.force_offset
        return force + noise
