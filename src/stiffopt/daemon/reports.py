"""What the daemon answers, as JSON: SI units in the names, null for what is not known."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, BeforeValidator, Field

from stiffopt.control.state import Alarm, Event, Severity, Snapshot, State, Timing
from stiffopt.daemon.messages import TargetMessage, TaskMessage
from stiffopt.errors import printable

__all__ = [
    "DoneReport",
    "ErrorReport",
    "EventReport",
    "EventsReport",
    "GrantReport",
    "LeaseReport",
    "RobotReport",
    "StateReport",
    "TaskReport",
]

Array = NDArray[np.float64]
Values = list[float | None]
Text = Annotated[str, BeforeValidator(printable)]  # a file's name, say, need not be valid Unicode


class AlarmReport(BaseModel):
    """Something that is wrong now."""

    kind: str
    text: Text
    since_s: float


class TimingReport(BaseModel):
    """How punctual the control loop is: counts of how late ticks begin, between edges."""

    ticks: int
    overruns: int
    tick_time_s: float | None
    lateness_edges_s: list[float]
    lateness_counts: list[int]


class LeaseReport(BaseModel):
    """Who has control."""

    client: Text
    expires_in_s: float


class StateReport(BaseModel):
    """How things stand; `Snapshot` says what the values mean.

    Times are on the rig's clock. Of the two stiffnesses the one that the task is about is given.
    """

    time_s: float
    state: State
    reason: Text
    task: Text
    commanded_pa: Values
    measured_pa: Values
    measured_time_s: float | None
    plan_pa: Values
    low_pa: Values
    high_pa: Values
    saturated: list[bool]
    tip_position_m: Values
    tip_quaternion_wxyz: Values
    seen_position_m: Values
    seen_age_s: float | None
    rejected_samples: int
    target_position_m: Values | None
    target_quaternion_wxyz: Values | None
    target_pointing: Values | None
    position_error_m: float | None
    angle_error_rad: float | None
    stiffness_n_per_m: float | None
    best_stiffness_n_per_m: float | None
    stiffness_nm_per_rad: float | None
    best_stiffness_nm_per_rad: float | None
    disturbance_m: Values
    wrench_force_n: Values
    wrench_moment_nm: Values
    alarms: list[AlarmReport]
    timing: TimingReport
    lease: LeaseReport | None

    @classmethod
    def of(cls, s: Snapshot, lease: LeaseReport | None) -> StateReport:
        """Return the report of a snapshot, and of who has control."""
        turns = s.stiffness_unit != "N/m"
        stiffness, best = _number(s.stiffness), _number(s.best_stiffness)
        edges, counts = s.timing.lateness
        return cls(
            time_s=s.time,
            state=s.state,
            reason=s.reason,
            task=s.task,
            commanded_pa=_values(s.commanded),
            measured_pa=_values(s.measured),
            measured_time_s=_number(s.measured_time),
            plan_pa=_values(s.plan),
            low_pa=_values(s.low),
            high_pa=_values(s.high),
            saturated=[bool(x) for x in s.saturated],
            tip_position_m=_values(s.tip_position),
            tip_quaternion_wxyz=_values(s.tip_quaternion),
            seen_position_m=_values(s.seen_position),
            seen_age_s=_number(s.seen_age),
            rejected_samples=s.rejected,
            target_position_m=_values_or_none(s.target_position),
            target_quaternion_wxyz=_values_or_none(s.target_quaternion),
            target_pointing=_values_or_none(s.target_pointing),
            position_error_m=_number(s.position_error),
            angle_error_rad=_number(s.angle_error),
            stiffness_n_per_m=None if turns else stiffness,
            best_stiffness_n_per_m=None if turns else best,
            stiffness_nm_per_rad=stiffness if turns else None,
            best_stiffness_nm_per_rad=best if turns else None,
            disturbance_m=_values(s.disturbance),
            wrench_force_n=_values(s.wrench[:3]),
            wrench_moment_nm=_values(s.wrench[3:]),
            alarms=[AlarmReport(kind=a.kind, text=a.text, since_s=a.since) for a in s.alarms],
            timing=TimingReport(
                ticks=s.timing.ticks,
                overruns=s.timing.overruns,
                tick_time_s=_number(s.timing.tick_time),
                lateness_edges_s=[float(x) for x in edges if math.isfinite(x)],
                lateness_counts=[int(x) for x in counts],
            ),
            lease=lease,
        )

    def snapshot(self) -> Snapshot:
        """Return the snapshot that this is a report of; NaN for what is not known."""
        turns = self.stiffness_nm_per_rad is not None or self.best_stiffness_nm_per_rad is not None
        timing = self.timing
        return Snapshot(
            time=self.time_s,
            state=self.state,
            reason=self.reason,
            task=self.task,
            commanded=_array(self.commanded_pa),
            measured=_array(self.measured_pa),
            measured_time=_known(self.measured_time_s),
            plan=_array(self.plan_pa),
            low=_array(self.low_pa),
            high=_array(self.high_pa),
            saturated=np.array(self.saturated, dtype=bool),
            tip_position=_array(self.tip_position_m),
            tip_quaternion=_array(self.tip_quaternion_wxyz),
            seen_position=_array(self.seen_position_m),
            seen_age=_known(self.seen_age_s),
            rejected=self.rejected_samples,
            target_position=_array_or_none(self.target_position_m),
            target_quaternion=_array_or_none(self.target_quaternion_wxyz),
            target_pointing=_array_or_none(self.target_pointing),
            position_error=_known(self.position_error_m),
            angle_error=_known(self.angle_error_rad),
            stiffness=_known(self.stiffness_nm_per_rad if turns else self.stiffness_n_per_m),
            best_stiffness=_known(
                self.best_stiffness_nm_per_rad if turns else self.best_stiffness_n_per_m
            ),
            stiffness_unit="N*m/rad" if turns else "N/m",
            disturbance=_array(self.disturbance_m),
            wrench=_array([*self.wrench_force_n, *self.wrench_moment_nm]),
            alarms=tuple(Alarm(a.kind, a.text, a.since_s) for a in self.alarms),
            timing=Timing(
                timing.ticks,
                timing.overruns,
                _known(timing.tick_time_s),
                (tuple(timing.lateness_edges_s), tuple(timing.lateness_counts)),
            ),
        )


class EventReport(BaseModel):
    """Something that happened."""

    time_s: float
    kind: str
    text: Text
    severity: Severity

    @classmethod
    def of(cls, event: Event) -> EventReport:
        """Return the report of an event."""
        return cls(time_s=event.time, kind=event.kind, text=event.text, severity=event.severity)

    def event(self) -> Event:
        """Return the event that this is a report of."""
        return Event(self.time_s, self.kind, self.text, self.severity)


class EventsReport(BaseModel):
    """Events, and what to ask for as `since` to get those after them."""

    events: list[EventReport]
    next: int


class RobotReport(BaseModel):
    """The arm, its channels and what may be commanded."""

    name: str
    n: int
    channels: list[str]
    low_pa: Values
    high_pa: Values
    length_m: float


class TaskReport(BaseModel):
    """What is being done in a word, what is asked of the tip now, and the last task given here.

    `task` is null where the arm is vented or no client gave one.
    """

    doing: Text
    target: TargetMessage | None
    task: TaskMessage | None


class GrantReport(BaseModel):
    """Control: what to show with each command, and how often to be heard."""

    lease: str
    heartbeat_s: Annotated[float, Field(description="control is lost after this time of silence")]
    renew_every_s: float


class DoneReport(BaseModel):
    """The command was carried out; the state after it."""

    state: State
    reason: Text


class Mistake(BaseModel):
    """A word for programs and a sentence for people."""

    code: str
    message: str


class ErrorReport(BaseModel):
    """Why a request was not done."""

    error: Mistake


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _values(array: ArrayLike) -> Values:
    return [x if math.isfinite(x) else None for x in np.asarray(array, dtype=float).tolist()]


def _values_or_none(array: Array | None) -> Values | None:
    return None if array is None else _values(array)


def _known(value: float | None) -> float:
    return math.nan if value is None else value


def _array(values: Values) -> Array:
    return np.array(values, dtype=float)


def _array_or_none(values: Values | None) -> Array | None:
    return None if values is None else _array(values)
