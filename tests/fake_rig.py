"""A rig for tests: regulators with a lag, a tip that is where it is told, a probe with a spring.

It knows nothing of the experiments and little of the model: where the free tip is and how stiff it
is are functions that a test hands over.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import DeviceError
from stiffopt.model.robot_files import load_description
from stiffopt.rig.interface import (
    Clock,
    ForceProbe,
    ForceSample,
    PoseTracker,
    PressureLimits,
    PressureSupply,
    RawPose,
    Rig,
)
from stiffopt.rig.settings import Safety
from stiffopt.safety.rigs import gated_rig

Array = NDArray[np.float64]

LAG = 0.05  # s
FRAME = 0.025  # s
LATENCY = 0.03  # s
CLEARANCE = 0.001  # m
CONTACT = 5000.0  # N/m
PERIOD = 0.02  # s between commands, for which the gate is made


class FakeWorld(Clock):
    """Time, pressures and the tip."""

    def __init__(
        self,
        n: int,
        tip: Callable[[Array], Array],
        stiffness: Callable[[Array, Array], float] = lambda p, d: 20.0,
        noise: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.t = 100.0
        self.written = self.t
        self.tip, self.stiffness, self.noise = tip, stiffness, noise
        self.random = np.random.default_rng(seed)
        self.commanded, self.pressures = np.zeros(n), np.zeros(n)
        self.writes: list[tuple[float, Array]] = []
        self.chambers: list[Array] = []
        """True pressures when something was written."""
        self.watchdog = math.inf
        """Seconds after which the supply vents if nothing is written."""
        self.gauge: Callable[[Array], Array] = lambda p: p
        self.frames: list[tuple[float, int, Array]] = []
        self.axis: Array | None = None
        self.stage = 0.0
        self.plate = 0.0
        self.alignments: list[tuple[Array, Array]] = []
        self.seen = True
        self.swept = 0
        """How often the pressure changed while the probe was in the arm's way."""
        self.at: list[tuple[float, Callable[[], None]]] = []
        """What happens when: moments, in s from the start, and what to call then."""

    def now(self) -> float:
        return self.t

    def sleep_until(self, moment: float) -> None:
        while self.t < moment:
            frame = (math.floor(self.t / FRAME + 1e-9) + 1) * FRAME
            step = min(moment, frame)
            expiry = self.written + self.watchdog
            if self.t < expiry:
                step = min(step, expiry)
            held = self.commanded if self.t < expiry else np.zeros_like(self.commanded)
            self.pressures = held + (self.pressures - held) * math.exp(-(step - self.t) / LAG)
            self.t = step
            if step == frame and self.seen:
                self.frames.append((frame, round(frame / FRAME), self.position()))
            while self.at and self.t - 100.0 >= self.at[0][0]:
                self.at.pop(0)[1]()

    def force(self) -> float:
        if self.axis is None:
            return 0.0
        pushed = self.plate + self.stage - float(self.axis @ self.tip(self.pressures))
        give = 1 / self.stiffness(self.pressures, self.axis) + 1 / CONTACT
        return max(0.0, pushed) / give

    def position(self) -> Array:
        free = self.tip(self.pressures)
        if self.axis is not None:
            free = free + self.axis * self.force() / self.stiffness(self.pressures, self.axis)
        return free + self.noise * self.random.normal(size=3)


class FakeSupply(PressureSupply):
    endpoints = ()
    is_simulated = True

    def __init__(self, world: FakeWorld, limits: PressureLimits) -> None:
        super().__init__(limits, world)
        self.world = world
        self.dead = False
        self.on_write: Callable[[], None] = lambda: None

    def _open(self) -> None:
        pass

    def _close(self) -> None:
        pass

    def _write(self, pressures: Array) -> None:
        self.on_write()
        if self.dead:
            raise DeviceError("the supply does not answer")
        if self.world.axis is not None and not np.array_equal(pressures, self.world.commanded):
            self.world.swept += 1
        self.world.commanded = pressures.copy()
        self.world.written = self.world.t
        self.world.chambers.append(self.world.pressures.copy())
        self.world.writes.append((self.world.t, pressures.copy()))

    def _read(self) -> ArrayLike:
        return self.world.gauge(self.world.pressures)


class FakeTracker(PoseTracker):
    def __init__(self, world: FakeWorld) -> None:
        super().__init__(None, world)
        self.world = world

    def _open(self) -> None:
        self.world.frames.clear()

    def _close(self) -> None:
        pass

    def _poll(self) -> None:
        while self.world.frames and self.world.frames[0][0] + LATENCY <= self.world.t:
            time, number, position = self.world.frames.pop(0)
            self._deliver(RawPose(time, number, position, (1.0, 0.0, 0.0, 0.0)))


class FakeProbe(ForceProbe):
    def __init__(self, world: FakeWorld, noise: float = 0.0) -> None:
        super().__init__(world)
        self.world, self.noise = world, noise
        self.offset = 0.03  # N; a sensor is never at zero

    def _open(self) -> None:
        pass

    def _close(self) -> None:
        self.world.axis = None

    def align(self, direction: Iterable[float]) -> None:
        self.world.axis = axis = np.array(list(direction))
        self.world.stage = 0.0
        self.world.plate = float(axis @ self.world.tip(self.world.pressures)) - CLEARANCE
        self.world.alignments.append((axis, self.world.pressures.copy()))

    def withdraw(self) -> None:
        self.world.axis = None

    def move_to(self, position: float, speed: float) -> None:
        begin, start = self.world.stage, self.world.t
        duration = abs(position - begin) / speed
        while self.world.t < start + duration - 1e-12:
            self.clock.sleep_until(min(self.world.t + 0.01, start + duration))
            share = (self.world.t - start) / duration
            self.world.stage = begin + share * (position - begin)
        self.world.stage = position

    def stop(self) -> None:
        pass

    def sample(self) -> ForceSample:
        noise = self.noise * float(self.world.random.normal())
        return ForceSample(self.world.t, self.world.force() + self.offset + noise, self.world.stage)


def straight(p: Array) -> Array:
    """A tip that moves linearly with three pressures, 20 mm per bar in x, y and z."""
    return np.array([0.0, 0.0, 0.09]) + 2e-7 * p[:3]


def fake_rig(
    tip: Callable[[Array], Array] = straight,
    stiffness: Callable[[Array, Array], float] = lambda p, d: 20.0,
    *,
    robot: str = "stiff-flop-1",
    slew: float | None = 1e5,
    low: ArrayLike = 0.0,
    high: ArrayLike = 1.5e5,
    probe: bool = True,
    tracker: bool = True,
    noise: float = 0.0,
    force_noise: float = 0.0,
    seed: int = 0,
    safety: Safety | None = None,
) -> Rig:
    """Return a rig with the safety gate in front of its supply; `world_of` has its world."""
    description = load_description(robot)
    n = description.n_pressures
    world = FakeWorld(n, tip, stiffness, noise, seed)
    limits = PressureLimits(np.full(n, low), np.full(n, high))
    rig = Rig(
        description,
        FakeSupply(world, limits),
        FakeTracker(world) if tracker else None,
        FakeProbe(world, force_noise) if probe else None,
        clock=world,
        slew=slew,
    )
    rig.bare = rig.supply  # type: ignore[attr-defined]
    return gated_rig(rig, safety or Safety(), PERIOD)


def world_of(rig: Rig) -> FakeWorld:
    return rig.bare.world  # type: ignore[attr-defined, no-any-return]
