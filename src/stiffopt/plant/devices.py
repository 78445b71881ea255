"""The simulated rig: supply, tracker and probe that act on a simulated world and measure it."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import CommandError, DeviceError
from stiffopt.model.description import RobotDescription
from stiffopt.plant.plant import SimulationError
from stiffopt.plant.settings import plant_of
from stiffopt.plant.world import World, WorldClock
from stiffopt.registration import Registration
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

_TICK = 0.005  # s between checks of a moving stage


class SimulatedSupply(PressureSupply):
    """Regulators of a simulated arm."""

    is_simulated = True

    def __init__(self, world: World, limits: PressureLimits, clock: Clock) -> None:
        super().__init__(limits, clock)
        self._world = world
        self.has_watchdog = world.supply.watchdog is not None
        self.has_dump_valve = world.supply.dump_valve

    def _open(self) -> None:
        self._answer()

    def _close(self) -> None:
        pass

    def _answer(self) -> None:
        self._world.catch_up()
        if self._world.faults["supply"] == "off":
            raise DeviceError("the simulated supply does not answer (its fault is 'off')")

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Empty: every rig has a world of its own."""
        return ()

    def _write(self, pressures: Array) -> None:
        if pressures.any():
            self._answer()
            self._world.command(pressures)
        else:  # vents even if the simulation has failed
            with suppress(SimulationError):
                self._world.catch_up()
            self._world.command(pressures)
            self._answer()

    def _read(self) -> ArrayLike:
        self._answer()
        return self._world.measured()

    def _exchange(self, pressures: Array) -> ArrayLike:
        self._write(pressures)
        return self._world.measured()

    def _dump(self, *, open_valve: bool) -> None:
        if self.has_dump_valve:  # the valve works even if the supply is off
            with suppress(SimulationError):
                self._world.catch_up()
            self._world.dump(open_valve=open_valve)


class SimulatedTracker(PoseTracker):
    """A tracker of a simulated arm."""

    def __init__(self, world: World, registration: Registration, clock: Clock) -> None:
        super().__init__(registration, clock)
        self._world = world
        self._last_number = 0

    def _open(self) -> None:
        self._world.catch_up()
        self._world.frames()  # drop earlier frames

    def _close(self) -> None:
        pass

    def _poll(self) -> None:
        self._world.catch_up()
        for frame in self._world.frames():
            if frame.number <= self._last_number:
                continue  # a frozen frame is not a new one
            self._last_number = frame.number
            self._deliver(
                RawPose(
                    frame.captured, frame.number, frame.position, frame.quaternion, frame.delivered
                )
            )


class SimulatedProbe(ForceProbe):
    """A plate on a stage that pushes a simulated arm's tip."""

    def __init__(self, world: World, clock: Clock) -> None:
        super().__init__(clock)
        self._world = world

    def _open(self) -> None:
        self._answer()

    def _close(self) -> None:
        self._world.stage.mount(None)

    def _answer(self) -> None:
        self._world.catch_up()
        if self._world.faults["probe"] == "off":
            raise DeviceError("the simulated probe does not answer (its fault is 'off')")

    def align(self, direction: Iterable[float]) -> None:
        """Put the plate just clear of the tip, facing along a unit vector (3,) in the base."""
        self._must_be_open()
        self._answer()
        axis = np.array(tuple(direction), dtype=float)
        if axis.shape != (3,) or not np.isfinite(axis).all() or not axis.any():
            raise CommandError("expected a direction [x, y, z] to align the probe with")
        self._world.stage.mount(axis)

    def withdraw(self) -> None:
        """Take the plate away."""
        self._must_be_open()
        self._answer()
        self._world.stage.mount(None)

    def move_to(self, position: float, speed: float) -> None:
        """Move the plate; return on arrival. See `ForceProbe.move_to`."""
        self._must_be_open()
        self._answer()
        if not (np.isfinite(position) and np.isfinite(speed) and speed > 0):
            raise CommandError("expected a finite position and a speed above 0")
        self._world.stage.move(position, speed)
        while self._world.stage.speed:
            self.clock.sleep(_TICK)
            self._answer()

    def stop(self) -> None:
        """Stop the plate."""
        self._world.stage.stop()

    def sample(self) -> ForceSample:
        """Read force and position."""
        self._must_be_open()
        self._answer()
        stage = self._world.stage
        return ForceSample(self.clock.now(), stage.force(), stage.position)


class SimulatedRig(Rig):
    """A rig whose arm is simulated.

    `world`: the simulated truth, which no controller may read, and the place to inject faults.
    """

    world: World


def simulated_rig(
    description: Any,
    robot: RobotDescription,
    limits: PressureLimits,
    slew: Array | None = None,
    *,
    real_time: bool = False,
) -> SimulatedRig:
    """Make the world of a `RigDescription` with simulated devices, and the devices."""
    plant = plant_of(description)
    supply, tracker, probe = description.supply, description.tracker, description.probe
    world = World(robot, limits, plant, supply, tracker, probe, real_time=real_time)
    clock = WorldClock(world, real_time=real_time)
    rig = SimulatedRig(
        robot,
        SimulatedSupply(world, limits, clock),
        None if tracker is None else SimulatedTracker(world, tracker.registration, clock),
        None if probe is None else SimulatedProbe(world, clock),
        clock=clock,
        slew=slew,
        max_force=description.safety.max_force,
        settings=description,
    )
    rig.world = world
    return rig
