"""The simulated probe's hardware: a plate on a linear stage, and a force sensor behind it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import SimulatedProbeSettings

__all__ = ["Stage"]

Array = NDArray[np.float64]

_IMMOBILE = ("off", "stuck")  # faults of a stage that does not move


class Stage:
    """A stage that can be mounted along any direction.

    Attributes
    ----------
    position : m, along its axis.
    speed : at which it moves now, m/s; 0 while it rests.
    """

    def __init__(
        self, settings: SimulatedProbeSettings, plant: Plant, rng: np.random.Generator
    ) -> None:
        self.settings = settings
        self.position = 0.0
        self.speed = 0.0
        self._plant = plant
        self._rng = rng
        self._axis: Array | None = None
        self._origin = 0.0
        self._target = 0.0

    def mount(self, direction: ArrayLike | None) -> None:
        """Mount the stage along a vector (3,) just clear of the tip, or take it away."""
        self._axis = None
        if direction is not None:
            self._axis = np.array(direction, dtype=float)
            self._axis /= np.linalg.norm(self._axis)
            tip = self._plant.tip_pose()[:3, 3]
            self._origin = float(self._axis @ tip) - self.settings.clearance
        self.position = self._target = self.speed = 0.0
        self.place_plate(0)

    def move(self, position: float, speed: float, fault: str) -> None:
        """Start to move to a place, m, at a speed, m/s."""
        speed = min(speed, self.settings.speed) / (10 if fault == "slow" else 1)
        self._target = position
        moves = position != self.position and fault not in _IMMOBILE
        self.speed = speed if moves else 0.0

    def stop_if(self, fault: str) -> None:
        """Stop if this fault holds the stage."""
        if fault in _IMMOBILE:
            self.speed = 0.0

    def steps_left(self) -> int | None:
        """Steps of the plant until the stage is there, or None while it rests."""
        if not self.speed:
            return None
        steps = abs(self._target - self.position) / self.speed / self._plant.step
        return max(1, math.ceil(steps - 1e-6))

    def place_plate(self, steps: int) -> None:
        """Tell the plant where the plate is, and how it moves in the steps to come."""
        if self._axis is None:
            self._plant.set_plate(None)
            return
        duration = steps * self._plant.step
        speed = self._movement(duration) / duration if steps else 0.0
        at = self._origin + self.position
        self._plant.set_plate(self._axis, at, self.settings.stiffness, speed)

    def advance(self, steps: int) -> None:
        """Be where the stage is after some steps of the plant."""
        if self.speed:
            self.position += self._movement(steps * self._plant.step)
            if abs(self._target - self.position) < 1e-9:
                self.position, self.speed = self._target, 0.0
        self.place_plate(0)

    def _movement(self, duration: float) -> float:
        """How far the stage goes in some time, m; not beyond its target."""
        far = self.speed * duration
        return float(np.clip(self._target - self.position, -far, far))

    def force(self, fault: str) -> float:
        """Force that the sensor feels, N."""
        noise = float(self.settings.noise * self._rng.standard_normal())
        force = self._plant.contact_force() if self._axis is not None else 0.0
        if fault == "garbage":
            return float("nan") if noise > 0 else 1e6 * noise
        return (0.5 * force + 0.1 if fault == "wrong" else force) + noise
