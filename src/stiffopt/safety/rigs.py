"""Functions that open a rig so that every command to its supply passes the safety gate."""

from __future__ import annotations

import os

from stiffopt.model.description import RobotDescription
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription, limits_of, load_rig, slew_of
from stiffopt.rig.interface import (
    Clock,
    ForceProbe,
    PoseTracker,
    PressureSupply,
    Rig,
    SystemClock,
)
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import effective_slew, gate_before
from stiffopt.safety.goal import GoalFollower, GoalSupply, TickingClock
from stiffopt.safety.guard_client import GuardLink
from stiffopt.safety.hosted import ForwardedProbe, ForwardedTracker


def open_rig(path: str | os.PathLike[str], *, real_time: bool = False) -> Rig:
    """Return the rig that a rig file describes; nothing is connected before `Rig.open`.

    Its supply accepts goals, see `stiffopt.safety.goal.GoalSupply`: the limits of robot, rig,
    supply and channels apply to all commands, and an arm without further commands is vented.

    Parameters
    ----------
    path :
        The rig file.
    real_time :
        Whether time passes by itself on a simulated rig; otherwise it passes while the program
        sleeps on the rig's clock. Real devices always run in real time.

    Raises
    ------
    FileError
        A file is wrong.
    MissingExtraError
        The rig is simulated and numba is not installed.
    """
    return rig_for_programs(*load_rig(path), real_time=real_time)


def rig_for_programs(
    description: RigDescription, robot: RobotDescription, *, real_time: bool = False
) -> Rig:
    """Return the rig of a description; see `open_rig`."""
    if real_time or not description.supply.simulated:
        rig = guarded_rig(description, robot)[0]
        rig.slew = effective_slew(rig)
        return rig
    return gated_rig(make_rig(description, robot), description.safety, 1 / description.rate)


def gated_rig(rig: Rig, safety: Safety, period: float) -> Rig:
    """Put gate and goal follower in front of the supply of a rig of bare devices, in place.

    For rigs on a simulated clock, all in this process: the rig's clock ticks the follower.

    Parameters
    ----------
    rig : rig of devices that have no gate in front of them.
    safety : limits of pressure, force and age.
    period : time between commands, in s.
    """
    gate = gate_before(rig, safety, period)
    follower = GoalFollower.before(gate, safety, period, rig.clock)
    clock = TickingClock(rig.clock, follower)
    for device in (rig.tracker, rig.probe):
        if device is not None:
            device.clock = clock
    rig.clock, rig.supply, rig.slew = clock, GoalSupply(follower, clock), effective_slew(rig)
    return rig


def guarded_rig(
    description: RigDescription, robot: RobotDescription, *, json_lines: bool = False
) -> tuple[Rig, GuardLink]:
    """Return a rig in real time whose supply a guard process owns, and the link to the guard.

    Nothing starts before the rig or the link is opened. Opening or closing the rig opens or closes
    the link too.

    `description`, `robot`: content of a rig file, and its robot. `json_lines`: whether the guard
    writes JSON lines on stderr. Raises `InputError`: a setting does not fit the robot;
    `MissingExtraError`: a library is not installed.
    """
    limits, slew = limits_of(description, robot), slew_of(description, robot)
    clock: Clock = SystemClock()
    tracker: PoseTracker | None
    probe: ForceProbe | None
    if description.supply.simulated:
        link = GuardLink(description, robot, limits, json_lines=json_lines)
        link.has_dump_valve = bool(getattr(description.supply, "dump_valve", False))
        tracker = None if description.tracker is None else ForwardedTracker(link)
        probe = None if description.probe is None else ForwardedProbe(link)
    else:
        real = make_rig(description, robot)
        spare = real.supply
        assert isinstance(spare, PressureSupply)
        link = GuardLink(description, robot, spare.limits, spare, json_lines=json_lines)
        tracker, probe, clock = real.tracker, real.probe, real.clock
    guarded = Rig(
        robot,
        GoalSupply(link, clock),
        tracker,
        probe,
        clock=clock,
        slew=slew,
        max_force=description.safety.max_force,
        settings=description,
    )
    return guarded, link
