"""Makes the devices that a rig file describes, without the safety gate before the supply.

Programs that command an arm use `stiffopt.open_rig`, whose supply is behind the gate. Only
`stiffopt.safety` and tests make bare devices.
"""

from __future__ import annotations

from stiffopt.errors import InputError
from stiffopt.model.description import RobotDescription
from stiffopt.rig.config import RigDescription, limits_of, registration_of, slew_of
from stiffopt.rig.interface import Rig, SystemClock
from stiffopt.rig.registry import load


def make_rig(
    description: RigDescription, robot: RobotDescription, *, real_time: bool = False
) -> Rig:
    """Return the rig of a description; see `open_rig`."""
    limits, slew = limits_of(description, robot), slew_of(description, robot)
    supply, tracker, probe = description.supply, description.tracker, description.probe
    registration = None if tracker is None else registration_of(tracker, robot)
    if any(device.simulated != supply.simulated for device in (tracker, probe) if device):
        raise InputError("a real supply cannot be combined with simulated devices, nor vice versa")
    if supply.simulated:
        simulated_rig = load(supply.simulator)
        rig: Rig = simulated_rig(description, robot, limits, slew, real_time=real_time)
    else:
        clock = SystemClock()
        device = supply.device(limits, clock)
        device.restrict(supply.limits_within(limits))  # even if its driver ignores them
        rig = Rig(
            robot,
            device,
            None if tracker is None else tracker.device(clock),
            None if probe is None else probe.device(clock),
            clock=clock,
            slew=slew,
            max_force=description.safety.max_force,
            settings=description,
        )
    if rig.tracker is not None and registration is not None:
        rig.tracker.registration = registration
    return rig
