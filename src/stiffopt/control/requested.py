"""What may be asked of the loop: refused here is what no arm can be asked for.

Whoever asks, a program in Python, a client of the daemon or the command line, is answered by these
checks, and nothing has changed when they refuse.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from stiffopt.control.contents import understood
from stiffopt.control.trajectory import Trajectory, Waypoint
from stiffopt.errors import CommandError, InputError, StiffoptError
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.rig.interface import PressureLimits

__all__ = [
    "check_target",
    "check_task",
    "check_trajectory",
    "highest_of",
    "preparing",
    "tightened",
]

Array = NDArray[np.float64]


@contextmanager
def preparing(what: str) -> Iterator[None]:
    """Raise whatever goes wrong in the body as `InputError`: a refusal, nothing has changed.

    Parameters
    ----------
    what :
        What is checked or prepared in the body, for the message.
    """
    try:
        yield
    except InputError:
        raise
    except StiffoptError as error:
        raise CommandError(str(error)) from error
    except Exception as error:
        raise CommandError(
            f"the {what} is refused and nothing has changed: unexpected "
            f"{type(error).__name__} while it was prepared: {error}"
        ) from error


def highest_of(task: Task, limits: PressureLimits) -> Array:
    """Return the highest pressures (n,) that a task allows on a rig, in Pa."""
    return np.array(tightened(task.pressure, limits).max, dtype=float)


def check_task(task: Task, limits: PressureLimits) -> None:
    """Refuse what is no task, or would go beyond the limits of the pressures.

    Raises
    ------
    InputError
        It names the key and, for a pressure, the channel.
    """
    with preparing("task"):
        tightened(understood(task, Task).pressure, limits)


def check_target(target: Target) -> None:
    """Refuse what is no target.

    Raises
    ------
    InputError
        It names the key.
    """
    with preparing("target"):
        understood(target, Target)


def check_trajectory(trajectory: Trajectory) -> None:
    """Refuse what is no trajectory.

    Raises
    ------
    InputError
        It names the key.
    """
    with preparing("trajectory"):
        if not isinstance(trajectory, Trajectory):
            raise InputError(f"expected a Trajectory, not {type(trajectory).__name__}")
        # one by one: all at once would keep the control thread from its ticks
        waypoints = tuple(understood(waypoint, Waypoint) for waypoint in trajectory.waypoints)
        understood(trajectory.model_copy(update={"waypoints": waypoints[:1]}), Trajectory)
        Trajectory(waypoints=waypoints)


def tightened(asked: PressureRange, limits: PressureLimits) -> PressureRange:
    """Return the limits that a task asks for, for each channel, none of them beyond a rig's.

    They may be beyond the rig's by `PressureLimits.slack`, for rounding, and are moved back then.

    Raises
    ------
    InputError
        A limit is beyond the rig's, or a channel is left no pressure; it names the channel.
    """
    lower = _bound("min", asked.min, limits.low, limits)
    upper = _bound("max", asked.max, limits.high, limits)
    for index in np.flatnonzero(lower > upper):
        raise InputError(
            f"pressure: channel {index + 1} is left no pressure: its min is "
            f"{lower[index] * 1e-5:g} bar, its max {upper[index] * 1e-5:g} bar"
        )
    return PressureRange(min=tuple(lower.tolist()), max=tuple(upper.tolist()))


def _bound(
    key: str, asked: float | tuple[float | None, ...] | None, default: Array, limits: PressureLimits
) -> Array:
    """Return one of a task's limits for each channel (n,), within those of the rig."""
    values = np.array(asked, dtype=float)  # None, which is no limit, becomes NaN
    if values.shape not in ((), (limits.n,)):
        raise InputError(
            f"pressure.{key}: expected one value or a list of {limits.n}, not {values.size}"
        )
    values = np.where(np.isnan(values), default, values)
    beyond = (values < limits.low - limits.slack) | (values > limits.high + limits.slack)
    for index in np.flatnonzero(beyond):
        raise InputError(
            f"pressure.{key}: {values[index] * 1e-5:g} bar is beyond the limits of channel "
            f"{index + 1}, {limits.low[index] * 1e-5:g} to {limits.high[index] * 1e-5:g} bar"
        )
    clipped: Array = np.clip(values, limits.low, limits.high)
    return clipped
