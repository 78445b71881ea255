"""Opening a rig so that whoever commands it does so through the gate."""

from __future__ import annotations

import os
from pathlib import Path

from stiffopt.model.description import RobotDescription
from stiffopt.model.robot_files import load_description
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription, load_rig_description
from stiffopt.rig.interface import Rig
from stiffopt.safety.gate import effective_slew, gate_before
from stiffopt.safety.goal import GoalFollower, GoalSupply, TickingClock
from stiffopt.safety.link import guarded_rig

__all__ = ["open_rig", "rig_for_programs"]


def open_rig(path: str | os.PathLike[str], *, real_time: bool = False) -> Rig:
    """Return the rig that a rig file describes; nothing is connected before `Rig.open`.

    Its supply takes goals, see `stiffopt.safety.goal.GoalSupply`: the limits of robot, rig, supply
    and channels hold whatever is commanded, and an arm that nobody commands any more is vented.

    Parameters
    ----------
    path :
        The rig file.
    real_time :
        Whether time passes by itself on a simulated rig; otherwise it passes while one sleeps on
        the rig's clock. Real devices always run in real time.

    Raises
    ------
    FileError
        A file is wrong.
    MissingExtraError
        The simulator is asked for and numba is not installed.
    """
    description = load_rig_description(path)
    robot = load_description(description.robot, base=Path(path).parent)
    return rig_for_programs(description, robot, real_time=real_time)


def rig_for_programs(
    description: RigDescription, robot: RobotDescription, *, real_time: bool = False
) -> Rig:
    """Return the rig of a description; see `open_rig`."""
    if real_time or description.supply.driver != "simulated":
        rig = guarded_rig(description, robot)[0]
        rig.slew = effective_slew(rig)
        return rig
    rig, period = make_rig(description, robot), 1 / description.rate
    gate = gate_before(rig, description.safety, period)
    follower = GoalFollower.before(gate, description.safety, period, rig.clock)
    clock = TickingClock(rig.clock, follower)
    for device in (rig.tracker, rig.probe):
        if device is not None:
            device.clock = clock
    rig.clock, rig.supply, rig.slew = clock, GoalSupply(follower, clock), effective_slew(rig)
    return rig
