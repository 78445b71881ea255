"""What the control loop says of itself: its state, what happened, and how things stand."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from stiffopt.rig.interface import PoseSample

__all__ = ["Alarm", "Event", "Severity", "Snapshot", "State", "Timing"]

Array = NDArray[np.float64]


class State(StrEnum):
    """Where in its life a control loop is.

    ``unconfigured``: nothing was checked yet. ``inactive``: vented, ready to be armed. ``active``:
    steers. ``holding``: pressures stay, or are let down, until what was wrong is well again.
    ``fault``: vented; only an explicit reset leaves it.
    """

    UNCONFIGURED = "unconfigured"
    INACTIVE = "inactive"
    ACTIVE = "active"
    HOLDING = "holding"
    FAULT = "fault"


class Severity(StrEnum):
    """How bad an event is."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True)
class Event:
    """Something that happened.

    Attributes
    ----------
    time : on the rig's clock, in s.
    kind : a word for programs, such as ``tracker-missing``.
    text : a sentence for people.
    severity : how bad it is.
    """

    time: float
    kind: str
    text: str
    severity: Severity = Severity.INFO


@dataclass(frozen=True)
class Alarm:
    """Something that is wrong now, though control goes on.

    Attributes
    ----------
    kind : a word for programs.
    text : a sentence for people.
    since : on the rig's clock, in s.
    """

    kind: str
    text: str
    since: float


@dataclass(frozen=True)
class Timing:
    """How punctual the loop is.

    Attributes
    ----------
    ticks : so far.
    overruns : ticks that ended after the next one was due.
    tick_time : of the last tick, in s.
    lateness : upper edges (k,) of a histogram of how late ticks begin, in s, and counts (k + 1,).
    """

    ticks: int = 0
    overruns: int = 0
    tick_time: float = 0.0
    lateness: tuple[tuple[float, ...], tuple[int, ...]] = ((), (0,))


@dataclass(frozen=True)
class Snapshot:
    """How things stand at the end of a tick. SI units; poses in the base frame.

    Attributes
    ----------
    time : on the rig's clock, in s.
    state, reason : and why, where it is not as asked.
    commanded, measured, plan : pressures (n,), in Pa; NaN where unknown.
    measured_time : when `measured` was read, in s; NaN where unknown.
    low, high : what may be commanded (n,), in Pa.
    saturated : channels (n,) that are at a limit which keeps them from doing what they should.
    tip_position, tip_quaternion : as estimated now, (3,) and (4,) w first.
    seen_position, seen_age : latest sample of the tracker that was used, and its age in s.
    samples : all that the tracker has delivered since the last tick, in order of arrival, used or
        not.
    rejected : how many of them no arm could have moved to.
    target_position, target_quaternion, target_pointing : what is asked for now; NaN for a free
        axis, None where nothing is asked.
    position_error, angle_error : of the estimate, in m and rad; NaN where nothing is asked.
    stiffness, best_stiffness : along the task's direction at the pressures now, and that of the
        plan; NaN where the task names none.
    stiffness_unit : ``N/m``, or ``N*m/rad`` where the task is about rotation.
    disturbance : offset of the tip from the model (3,), in m.
    wrench : force and moment (6,) at the tip that would explain it, in the base frame.
    alarms : what is wrong now.
    task : what is being done, in a word or two.
    timing : of the loop.
    """

    time: float
    state: State
    reason: str
    commanded: Array
    measured: Array
    plan: Array
    low: Array
    high: Array
    saturated: NDArray[np.bool_]
    tip_position: Array
    tip_quaternion: Array
    seen_position: Array
    seen_age: float
    target_position: Array | None = None
    target_quaternion: Array | None = None
    target_pointing: Array | None = None
    position_error: float = float("nan")
    angle_error: float = float("nan")
    stiffness: float = float("nan")
    best_stiffness: float = float("nan")
    disturbance: Array = field(default_factory=lambda: np.zeros(3))
    wrench: Array = field(default_factory=lambda: np.zeros(6))
    alarms: tuple[Alarm, ...] = ()
    task: str = ""
    timing: Timing = Timing()
    measured_time: float = float("nan")
    samples: tuple[PoseSample, ...] = ()
    rejected: int = 0
    stiffness_unit: str = "N/m"
