"""What may be asked of the loop: refused here is what no arm can be asked for."""

from __future__ import annotations

import numpy as np

from stiffopt.control.trajectory import Trajectory
from stiffopt.errors import CommandError
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.rig.interface import PressureLimits

__all__ = ["check_target", "check_task", "check_trajectory"]

_SLACK = 1e-9  # relative


def check_task(task: Task, limits: PressureLimits) -> None:
    """Refuse what is no task, or would go beyond the limits of the pressures.

    Raises
    ------
    CommandError
        It says which channel is to blame.
    """
    if not isinstance(task, Task):
        raise CommandError(f"expected a Task, not {type(task).__name__}")
    slack = _SLACK * (limits.high - limits.low)
    for key, bound, sign in (("max", limits.high, 1), ("min", limits.low, -1)):
        asked = getattr(task.pressure, key)
        if asked is None:
            continue
        values = np.array(asked, dtype=float)  # None, which is no limit, becomes NaN
        if values.shape not in ((), limits.low.shape):
            raise CommandError(
                f"pressure.{key} has {values.size} values; expected one, or {limits.n}"
            )
        values = np.broadcast_to(values, limits.n)
        for channel in np.flatnonzero(sign * (values - bound) > slack):
            raise CommandError(
                f"pressure.{key}: channel {channel + 1}: {values[channel] * 1e-5:.6g} bar is "
                f"beyond the limit of {bound[channel] * 1e-5:g} bar"
            )
    check_target(task.target)


def check_target(target: Target) -> None:
    """Refuse what is no target, or is not finite.

    Raises
    ------
    CommandError
        It says what was expected.
    """
    if not isinstance(target, Target):
        raise CommandError(f"expected a Target, not {type(target).__name__}")
    for key in ("position", "pointing", "orientation"):
        values = getattr(target, key)
        if values is None:
            continue
        if not all(x is None or np.isfinite(x) for x in values):
            raise CommandError(f"target.{key}: expected finite numbers")


def check_trajectory(trajectory: Trajectory) -> None:
    """Refuse what is no trajectory, or is not finite.

    Raises
    ------
    CommandError
        It says what was expected.
    """
    if not isinstance(trajectory, Trajectory):
        raise CommandError(f"expected a Trajectory, not {type(trajectory).__name__}")
    for waypoint in trajectory.waypoints:
        if not np.isfinite(waypoint.time):
            raise CommandError("waypoints: expected finite times")
        check_target(waypoint.target)
