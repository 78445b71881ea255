"""The simulated rig: the world behind the interface."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.description import RobotDescription
from stiffopt.plant.devices import SimulatedProbe, SimulatedSupply, SimulatedTracker
from stiffopt.plant.settings import PlantSettings
from stiffopt.plant.world import World, WorldClock
from stiffopt.rig.interface import PressureLimits, Rig

__all__ = ["SimulatedRig", "simulated_rig"]


class SimulatedRig(Rig):
    """A rig whose arm is simulated.

    Attributes
    ----------
    world :
        What is true, which no controller may look at, and where faults are injected.
    """

    def __init__(self, world: World, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.world = world


def simulated_rig(
    description: Any,
    robot: RobotDescription,
    limits: PressureLimits,
    slew: NDArray[np.float64] | None = None,
    *,
    real_time: bool = False,
) -> SimulatedRig:
    """Make the world that a `RigDescription` with simulated devices speaks of, and its devices."""
    plant = description.plant or PlantSettings()
    supply, tracker, probe = description.supply, description.tracker, description.probe
    world = World(robot, limits, plant, supply, tracker, probe, real_time=real_time)
    clock = WorldClock(world, real_time=real_time)
    return SimulatedRig(
        world,
        robot,
        SimulatedSupply(world, limits, clock),
        None if tracker is None else SimulatedTracker(world, tracker.registration, clock),
        None if probe is None else SimulatedProbe(world, clock),
        clock=clock,
        slew=slew,
        max_force=description.safety.max_force,
        settings=description,
    )
