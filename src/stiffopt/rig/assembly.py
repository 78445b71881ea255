"""The bare devices of a rig file: nothing here limits what is commanded.

Whoever commands an arm takes `stiffopt.open_rig`, whose supply has the safety gate in front of it;
only `stiffopt.safety`, the virtual lab and tests make devices themselves.
"""

from __future__ import annotations

from typing import Any

from stiffopt.errors import InputError
from stiffopt.model.description import RobotDescription
from stiffopt.plant.settings import SimulatedSupplySettings
from stiffopt.rig.config import RigDescription, limits_of, registration_of, slew_of
from stiffopt.rig.interface import Rig, SystemClock

__all__ = ["make_rig"]


def make_rig(
    description: RigDescription, robot: RobotDescription, *, real_time: bool = False
) -> Rig:
    """Return the rig of a description; see `open_rig`."""
    limits, slew = limits_of(description, robot), slew_of(description, robot)
    supply, tracker, probe = description.supply, description.tracker, description.probe
    registration = None if tracker is None else registration_of(tracker, robot)
    if isinstance(supply, SimulatedSupplySettings):
        from stiffopt.plant.rig import simulated_rig  # here: numba takes its time

        rig: Rig = simulated_rig(description, robot, limits, slew, real_time=real_time)
    else:
        clock = SystemClock()
        real = supply.device(limits, clock)
        real.restrict(supply.limits_within(limits))  # whatever its driver makes of them
        rig = Rig(
            robot,
            real,
            None if tracker is None else _real(tracker).device(clock),
            None if probe is None else _real(probe).device(clock),
            clock=clock,
            slew=slew,
            max_force=description.safety.max_force,
            settings=description,
        )
    if rig.tracker is not None and registration is not None:
        rig.tracker.registration = registration
    return rig


def _real(settings: Any) -> Any:
    if settings.driver == "simulated":
        raise InputError("a real supply cannot be combined with simulated devices")
    return settings
