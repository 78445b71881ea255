"""The state of the control loop: the one definition of each of its fields.

A field is defined by its line in one of the dataclasses below: its type, and a `Shown` with its
meaning, its unit and the places that show it. All interfaces follow from these definitions: HTTP,
WebSocket and client, recordings and live telemetry, metrics, the status on the terminal, the lines
for programs and the table in docs/daemon-api.md. To add a field, add a line here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import Annotated

import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.control.state_fields import Shown
from stiffopt.rig.interface import PoseSample

# `Shown` for fields that share a topic or a unit
_event, _tracker, _timing, _tip, _state = (
    partial(Shown, topic=topic) for topic in ("/event", "/tracker", "/timing", "/tip", "/state")
)
_pressure = partial(Shown, unit="Pa", metric="pressure_pascals")
_stiffness = partial(_tip, unit=("N/m", "N*m/rad"), unit_field="stiffness_unit")


class State(StrEnum):
    """The state of a control loop.

    ``unconfigured``: not checked yet. ``inactive``: vented, ready to be armed. ``active``:
    controls the tip. ``holding``: pressures stay, or are let down, while something prevents
    control. ``fault``: vented; only an explicit reset leaves it.
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
    """Something that happened."""

    time: Annotated[float, Shown("when, on the rig's clock", "s")]
    kind: Annotated[str, _event("a word for programs, such as `tracker-missing`")]
    text: Annotated[str, _event("a sentence for people")]
    severity: Annotated[Severity, _event("how bad it is")] = Severity.INFO


@dataclass(frozen=True)
class Alarm:
    """Something that is wrong now, though control continues."""

    kind: Annotated[str, Shown("a word for programs")]
    text: Annotated[str, Shown("a sentence for people")]
    since: Annotated[float, Shown("since when, on the rig's clock", "s")]


@dataclass(frozen=True)
class SeenPose:
    """A sample of the tracker, used or not, as it is logged."""

    time: Annotated[float, Shown("when it was captured, on the rig's clock", "s")]
    received: Annotated[float, _tracker("when it arrived, on the rig's clock", "s")]
    frame: Annotated[int, _tracker("the tracker's number of it")]
    position: Annotated[Array, _tracker("of the tip, in the base frame", "m", size=3)]
    quaternion: Annotated[
        Array | None, _tracker("of the tip, w first", size=4, json="quaternion_wxyz")
    ]
    doubted: Annotated[
        bool, _tracker("too far for any motion of the arm, or it came with such a one")
    ]


@dataclass(frozen=True)
class AdaptedNumber:
    """A number of the model as estimated during operation."""

    key: Annotated[
        str,
        Shown(
            "its key in the robot file; `base.`: tilts in rad; `regulator_lag`: of the rig file; "
            "`frequency_factor`: vibration's frequency over the model's"
        ),
    ]
    value: Annotated[float, Shown("its value, in SI")]
    deviation: Annotated[float, Shown("its standard deviation, in SI")]


@dataclass(frozen=True)
class HeldContact:
    """A contact of a brace."""

    object: Annotated[str, Shown("object that the arm leans on")]
    at: Annotated[float, Shown("where along the arm, from its base", "m")]
    state: Annotated[str, Shown("`held`, `uncertain` or `lost`")]
    force: Annotated[float, Shown("its normal force, as estimated", "N")] = math.nan
    deviation: Annotated[float, Shown("standard deviation of that force", "N")] = math.nan

    def __str__(self) -> str:
        force = f", {1e3 * self.force:.0f} mN (deviation {1e3 * self.deviation:.0f} mN)"
        known = force if math.isfinite(self.force) else ""
        return f"'{self.object}' at {1e3 * self.at:.0f} mm: {self.state}{known}"


@dataclass(frozen=True)
class Timing:
    """How punctual the loop is.

    The histogram of how late ticks begin has k upper edges and k + 1 counts.
    """

    ticks: Annotated[int, _timing("ticks of the loop so far", metric="ticks")] = 0
    overruns: Annotated[
        int, _timing("ticks that ended after the next one was due", metric="overruns")
    ] = 0
    tick_time: Annotated[
        float, _timing("duration of the last tick", "s", decimals=7, metric="tick_time_seconds")
    ] = 0.0
    lateness_edges: Annotated[
        tuple[float, ...],
        _timing("upper edges (k,) of a histogram of how late ticks begin", "s", decimals=9),
    ] = ()
    lateness_counts: Annotated[
        tuple[int, ...], _timing("counts (k + 1,) of that histogram; the last counts later ticks")
    ] = (0,)

    @property
    def lateness(self) -> tuple[tuple[float, ...], tuple[int, ...]]:
        """Edges and counts of the histogram."""
        return self.lateness_edges, self.lateness_counts


_nan3, _nan4, _nan6 = (partial(np.full, count, np.nan) for count in (3, 4, 6))


@dataclass(frozen=True, kw_only=True)
class ControllerStatus:
    """The controller's part of the state. SI units; poses in the base frame; NaN is unknown."""

    plan: Annotated[
        Array,
        _pressure(
            "pressures that the optimiser found for the target", topic="/pressure", label="plan"
        ),
    ]
    tip_position: Annotated[
        Array,
        _tip(
            "estimate of the tip's position",
            "m",
            size=3,
            key="position_m",
            row="tip",
            armed_only=False,
        ),
    ] = field(default_factory=_nan3)
    tip_quaternion: Annotated[
        Array,
        _tip(
            "estimate of the tip's orientation, w first",
            size=4,
            json="tip_quaternion_wxyz",
            key="quaternion_wxyz",
        ),
    ] = field(default_factory=_nan4)
    seen_position: Annotated[
        Array, Shown("the tip's position in the tracker's latest sample that was used", "m", size=3)
    ] = field(default_factory=_nan3)
    seen_age: Annotated[
        float, _tip("age of the latest sample that was used", "s", metric="tracker_age_seconds")
    ] = math.inf
    target_position: Annotated[
        Array | None,
        _tip(
            "target now; null for a free axis",
            "m",
            size=3,
            row="target",
            unknown="free",
        ),
    ] = None
    target_quaternion: Annotated[
        Array | None, _tip("target orientation, w first", size=4, json="target_quaternion_wxyz")
    ] = None
    target_pointing: Annotated[
        Array | None, _tip("direction in which the tip is to point", size=3, row="pointing")
    ] = None
    position_error: Annotated[
        float,
        _tip(
            "distance of the estimate from the target",
            "m",
            metric="position_error_meters",
            row="error",
        ),
    ] = math.nan
    angle_error: Annotated[
        float,
        _tip(
            "angle between the estimate and the target",
            "rad",
            metric="angle_error_radians",
            row="error",
        ),
    ] = math.nan
    stiffness: Annotated[
        float,
        _stiffness(
            "stiffness along the task's direction, at the pressures now",
            key="stiffness",
            metric="stiffness",
        ),
    ] = math.nan
    stiffness_low: Annotated[
        float,
        _stiffness(
            "lower end of the 95 % interval of that stiffness",
            metric="stiffness_low",
        ),
    ] = math.nan
    stiffness_high: Annotated[
        float,
        _stiffness("upper end of that interval", metric="stiffness_high"),
    ] = math.nan
    best_stiffness: Annotated[
        float,
        _stiffness(
            "stiffness to which the plans lead, in the same direction",
            key="best_stiffness",
            metric="best_stiffness",
        ),
    ] = math.nan
    stiffness_unit: Annotated[str, _tip("N/m, or N*m/rad for a rotation", json=())] = "N/m"
    disturbance: Annotated[Array, _tip("offset of the tip from the model", "m", size=3)] = field(
        default_factory=_nan3
    )
    touches: Annotated[bool, _tip("whether a force on the tip is felt", key="touches")] = False
    wrench: Annotated[
        Array,
        _tip(
            "force on the tip that is felt, where the tip is soft, and its moment about the tip, "
            "which is zero",
            "N",
            size=6,
            json=("wrench_force_n", "wrench_moment_nm"),
            key="wrench",
        ),
    ] = field(default_factory=_nan6)
    wrench_covariance: Annotated[
        Array,
        _tip(
            "covariance of that force, row by row",
            size=9,
            json=("wrench_covariance_n2",),
            key="wrench_covariance",
            decimals=9,
        ),
    ] = field(default_factory=partial(np.full, 9, np.nan))
    press_force: Annotated[
        float,
        _tip("force with which the tip presses along the task's direction", "N", decimals=5),
    ] = math.nan
    press_goal: Annotated[float, _tip("the force that the task asks for", "N", decimals=5)] = (
        math.nan
    )
    brace: Annotated[
        str,
        _tip(
            "phase of a brace: `planning`, `going to rest`, `approaching`, `held`, `releasing` or "
            "`released`; empty without one"
        ),
    ] = ""
    brace_contacts: Annotated[
        str,
        _tip(
            "state of its contacts: `held`, `uncertain` or `lost`; empty if the arm does not lean"
        ),
    ] = ""
    brace_force: Annotated[
        float, _tip("normal force of its least certain contact, as estimated", "N", decimals=5)
    ] = math.nan
    brace_force_deviation: Annotated[
        float, _tip("standard deviation of that force", "N", decimals=5)
    ] = math.nan
    brace_margin: Annotated[
        float, _tip("further push, as it is felt, by which a contact is lost", "N", decimals=5)
    ] = math.nan
    leans_on: Annotated[
        tuple[HeldContact, ...],
        _tip(
            "each contact of a brace that is held, with its `state`, `force_n` and `deviation_n`; "
            "after a loss, those that were lost"
        ),
    ] = ()
    adapted: Annotated[
        tuple[AdaptedNumber, ...],
        Shown("numbers of the model as estimated during operation"),
    ] = ()
    lost: Annotated[
        Flags,
        Shown(
            "channels that are stuck, have no more pressure or were taken out, which the plan does "
            "without",
            topic="/pressure",
        ),
    ] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    shortfall: Annotated[
        Array,
        _pressure("pressures below their commands at rest", topic="/pressure", label="shortfall"),
    ] = field(default_factory=lambda: np.zeros(0))
    task: Annotated[str, _state("what is being done, in a word or two")] = ""
    model_position: Annotated[
        Array | None, Shown("where the model alone has the tip", "m", size=3, json=())
    ] = None


@dataclass(frozen=True, kw_only=True)
class Snapshot(ControllerStatus):
    """The state of the control loop at the end of a tick.

    SI units; poses in the base frame; gauge pressures. Unknown values are NaN, targets that are not
    prescribed None. The last field is not shown: all `samples` that the tracker has delivered since
    the last tick, used or not, in order of arrival.
    """

    time: Annotated[float, Shown("on the rig's clock", "s")]
    state: Annotated[State, _state("state of the loop", line=True)]
    reason: Annotated[str, _state("why, where the state is not as requested", line=True)]
    commanded: Annotated[
        Array, _pressure("set-points of the channels", topic="/pressure", label="commanded")
    ]
    measured: Annotated[Array, _pressure("measured pressures", topic="/pressure", label="measured")]
    measured_time: Annotated[
        float, Shown("when the pressures were read, on the rig's clock", "s", topic="/pressure")
    ] = math.nan
    low: Annotated[Array, Shown("lowest permitted command", "Pa", topic="/limits")]
    high: Annotated[Array, _pressure("highest permitted command", topic="/limits", label="limit")]
    saturated: Annotated[
        Flags, Shown("channels at a limit that keeps the tip from its target", topic="/pressure")
    ]
    rejected: Annotated[
        int,
        Shown(
            "samples of the last tick too far for any motion of the arm", json="rejected_samples"
        ),
    ] = 0
    alarms: Annotated[tuple[Alarm, ...], _state("what is wrong now")] = ()
    timing: Annotated[Timing, Shown("how punctual the loop is")] = Timing()
    samples: tuple[PoseSample, ...] = ()

    @property
    def pressures(self) -> Array | None:
        """Measured pressures (n,) in Pa, commanded where not measured; None if neither is known."""
        found = np.where(np.isfinite(self.measured), self.measured, self.commanded)
        return found if np.isfinite(found).all() else None
