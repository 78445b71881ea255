"""The simulated tracker's hardware: it captures frames and sends them late."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import SimulatedTrackerSettings

__all__ = ["Camera", "Frame"]

Array = NDArray[np.float64]

_LATE = 0.5  # s, by which the frames of a slow tracker come later
_AWAY = np.array([0.02, -0.015, 0.01])  # m, by which a wrong tracker is off
_KEPT = 4096  # frames that wait to be read


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


class Camera:
    """Sees the tip of a plant.

    Attributes
    ----------
    count : frames captured so far, lost ones included.
    """

    def __init__(
        self, settings: SimulatedTrackerSettings, plant: Plant, rng: np.random.Generator
    ) -> None:
        self.settings = settings
        self.count = 0
        self._plant = plant
        self._rng = rng
        self._sent: deque[Frame] = deque(maxlen=_KEPT)
        self._last: Frame | None = None

    def next_step(self) -> int:
        """Step of the plant in which the next frame is captured."""
        return round((self.count + 1) / self.settings.rate / self._plant.step)

    def skip(self) -> None:
        """Lose the frames of a time that was skipped."""
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
        chances = self._rng.random(3)  # drawn in every frame, so that faults shift no stream
        noise = self._rng.standard_normal(6)
        if fault == "off" or chances[0] < settings.missing:
            return
        T = self.sensor_in_tracker(noise)
        position, q = T[:3, 3].copy(), np.asarray(lie.quaternion_from_rotation(T[:3, :3]))
        if fault == "missing" or chances[1] < settings.dropouts:
            position, q = np.full(3, np.nan), np.full(4, np.nan)
        elif fault == "wrong":
            position = position + _AWAY
        elif fault == "garbage":
            position, q = position * 1e3 * noise[:3], np.full(4, np.nan)
        if chances[2] < settings.flips or (fault == "flip" and self.count % 2):
            q = -q
        now = self._plant.time
        arrival = now + settings.latency + (_LATE if fault == "slow" else 0.0)
        if self._last is not None:
            arrival = max(arrival, self._last.delivered)  # none overtakes another
        if fault == "stuck" and self._last is not None:
            frame = replace(self._last, delivered=arrival)
        else:
            frame = Frame(self.count, now, arrival, position, q)
        self._last = frame
        self._sent.append(frame)

    def sensor_in_tracker(self, noise: Array) -> Array:
        """Pose (4, 4) of the sensor in the tracker's frame; `noise` (6,) in standard deviations."""
        settings = self.settings
        off = self._plant.mismatch.registration.inverse()
        T = settings.registration.sensor_in_tracker(off @ self._plant.tip_pose())
        T[:3, 3] += settings.noise * noise[:3]
        small = np.concatenate(([1.0], 0.5 * settings.angular_noise * noise[3:]))
        turn = lie.rotation_from_quaternion(small / np.linalg.norm(small))
        T[:3, :3] = T[:3, :3] @ turn
        return T
