"""The record of a commissioning, ``format: stiffopt-commissioning/1``.

Before it arms, the daemon checks that the record is recent, that it belongs to this rig and this
robot file, that the rig fitted, and that the vented arm is still where it was.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from stiffopt.directions import Quaternion
from stiffopt.errors import InputError
from stiffopt.files import read_file, save_file
from stiffopt.model.description import RobotDescription, Tolerances
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.rig.settings import ControlSettings
from stiffopt.schema import Items, Schema, Vector
from stiffopt.units import Angle, Duration, Frequency, Length, Number, Pressure, PressureRate, Ratio

KIND = "commissioning"

_MODULUS_ERROR = 0.1  # relative, of a modulus from the steps
_LEAST_STEP = 1e-4  # m; a smaller expected displacement of the tip says nothing about a channel

Count = Annotated[int, Field(ge=1)]
Text = Annotated[str, Field(min_length=1)]


def _date(value: Any) -> str:
    try:
        moment = datetime.fromisoformat(value)
    except (TypeError, ValueError):
        moment = None
    if moment is None or moment.tzinfo is None:
        raise InputError("expected a date with its time zone, such as 2026-01-31T12:00:00+00:00")
    return str(value)


class RecordedFinding(Schema):
    """One finding.

    Attributes
    ----------
    text : as a sentence.
    fits : whether the rig may be armed nevertheless.
    advice : what to do about it, or how to distinguish its possible causes; may be empty.
    keys : keys of the rig file that it concerns.
    """

    text: Text
    fits: bool
    advice: str = ""
    keys: Items[Text] = ()


class RecordedNumber(Schema):
    """A number of the set-up: its deviation from the files, in SI.

    Attributes
    ----------
    name, unit : the unit is empty for a relative number.
    value, deviation : the most probable value and its standard deviation.
    """

    name: Text
    unit: str = ""
    value: Number
    deviation: Number


class RecordedChannel(Schema):
    """The arm's response to the step of one channel; fields that were not measured are absent.

    Attributes
    ----------
    drives : channels (from 1) whose chambers it seems to fill.
    displacement, expected : of the tip in the base frame, measured and predicted.
    deviation : standard deviation of each measured component.
    gauge : rise of its gauge, as a share of the step.
    gauge_offset, gauge_noise : of its gauge at rest.
    dead_time, lag_up, lag_down, rate_up, rate_down : of its regulator.
    drift : share of the displacement that the tip lost while the pressure was held.
    """

    drives: Items[Count] = ()
    displacement: Vector[Length]
    expected: Vector[Length]
    deviation: Length
    gauge: Ratio | None = None
    gauge_offset: Pressure | None = None
    gauge_noise: Pressure | None = None
    dead_time: Duration | None = None
    lag_up: Duration | None = None
    lag_down: Duration | None = None
    rate_up: PressureRate | None = None
    rate_down: PressureRate | None = None
    drift: Ratio | None = None


class RecordedTracker(Schema):
    """The tracker's readings of the vented arm, and its quality.

    Attributes
    ----------
    position, orientation : of the tip in the base frame; orientation is absent if not tracked.
    noise, angular_noise : standard deviation of a sample in each axis.
    rate : samples per second.
    latency : median age of a sample on arrival.
    tip_delay : of the tip behind the gauges, by the tracker's times; absent without gauges.
    missing : share of the samples that did not see the tip.
    """

    position: Vector[Length]
    orientation: Quaternion | None = None
    noise: Length
    angular_noise: Angle | None = None
    rate: Frequency
    latency: Duration
    tip_delay: Duration | None = None
    missing: Ratio


class RecordedSwing(Schema):
    """The swing that the steps excited.

    Attributes
    ----------
    frequency, damping : the damping is a share of critical damping.
    frequency_deviation, damping_deviation : standard deviations of these.
    amplitude : the largest, just after a step.
    """

    frequency: Frequency
    frequency_deviation: Frequency
    damping: Ratio
    damping_deviation: Ratio
    amplitude: Length


class CommissioningRecord(Schema):
    """The record of a commissioning.

    Attributes
    ----------
    date : when it ended, with the time zone.
    rig, robot : their names.
    rig_hash, robot_hash : see `fingerprints`.
    quick : whether the steps were held only briefly.
    fits : whether the rig may be armed.
    findings : those that prevent arming first.
    step : size of the steps; absent if danger ended them.
    tracker, channels, swing : measurements.
    numbers : estimated numbers of the set-up.
    unexplained : root mean square of the unexplained displacements.
    log : path of the recording, relative to this file.
    """

    date: Annotated[str, BeforeValidator(_date)]
    rig: Text
    robot: Text
    rig_hash: Text
    robot_hash: Text
    quick: bool = False
    fits: bool
    findings: Items[RecordedFinding] = ()
    step: Pressure | None = None
    tracker: RecordedTracker | None = None
    channels: Items[RecordedChannel] = ()
    swing: RecordedSwing | None = None
    numbers: Items[RecordedNumber] = ()
    unexplained: Length | None = None
    log: str | None = None

    def age(self, now: datetime | None = None) -> float:
        """Return the seconds since the commissioning ended."""
        return ((now or datetime.now(UTC)) - datetime.fromisoformat(self.date)).total_seconds()


def load_record(path: str | os.PathLike[str]) -> CommissioningRecord:
    """Read a record; raise `FileError` with line and key of the first mistake."""
    return read_file(path, KIND, CommissioningRecord)


def save_record(path: str | os.PathLike[str], record: CommissioningRecord) -> None:
    """Write a record atomically."""
    save_file(path, KIND, record, ("Written by 'stiffopt commission'; the daemon reads it.",))


def fingerprints(robot: RobotDescription, rig: Any) -> tuple[str, str]:
    """Return hashes of a rig (its supply, tracker and registration) and of its robot.

    `rig`: None for a rig that was not made from a file.
    """
    parts = None if rig is None else [_content(rig.supply), _content(rig.tracker)]
    return _hash(parts), _hash(_content(robot))


def _content(schema: Schema | None) -> Any:
    return None if schema is None else schema.model_dump(mode="json", exclude={"source"})


def _hash(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def is_record_of(record: CommissioningRecord, robot: RobotDescription, rig: Any) -> bool:
    """Whether a record belongs to exactly this robot, supply, tracker and registration."""
    return (record.rig_hash, record.robot_hash) == fingerprints(robot, rig)


def commissioned_control(rig: Any, robot: RobotDescription) -> ControlSettings:
    """Return a rig's control settings, with frequency and damping of the swing from its record.

    Values given in the rig file take precedence. Without a record of exactly this rig that fits,
    the settings are unchanged.
    """
    control: ControlSettings = rig.control
    record = _usable_record(rig, robot)
    if record is None or record.swing is None:
        return control
    found = {"frequency": record.swing.frequency, "damping": record.swing.damping}
    own = control.model_fields_set
    return control.model_copy(update={k: v for k, v in found.items() if k not in own})


def is_commissioned(rig: Any, robot: RobotDescription) -> bool:
    """Return True if there is a record of exactly this rig that fits."""
    return _usable_record(rig, robot) is not None


def commissioned_robot(rig: Any, robot: RobotDescription) -> RobotDescription:
    """Return a robot with the moduli and gains that the steps of its commissioning imply.

    A calibrated robot is unchanged, and so is one without a record of exactly this rig that fits.
    """
    record = None if robot.calibration is not None else _usable_record(rig, robot)
    return robot if record is None else with_measured_steps(robot, record)


def with_measured_steps(robot: RobotDescription, record: CommissioningRecord) -> RobotDescription:
    """Return a robot whose tip moves sideways as the recorded steps did.

    The mean of a segment's channels gives its modulus, what is left the channels' gains. Elongation
    is left out: silicone is stiffer in it at small steps than in bending. The moduli are then known
    to a tenth, so that adaptation changes them less.
    """
    moved, expected = (
        np.array([getattr(channel, key)[:2] for channel in record.channels]).reshape(-1, 2)
        for key in ("displacement", "expected")
    )
    if len(moved) != robot.n_pressures or (np.linalg.norm(expected, axis=1) < _LEAST_STEP).any():
        return robot
    ratios = (moved * expected).sum(axis=1) / (expected**2).sum(axis=1)
    if (ratios <= 0).any():  # no gain or modulus moves the tip the other way
        return robot
    values, first = {}, 0
    for place, segment in enumerate(robot.segments):
        own = ratios[first : first + segment.n_channels]
        first += segment.n_channels
        factors = {"material.youngs_modulus": 1 / own.mean()}
        factors |= {f"corrections.gain[{c}]": own[c] / own.mean() for c in range(len(own))}
        for key, factor in factors.items():
            parameter = Parameter(f"segments[{place}].{key}")
            values[parameter] = float(factor * parameter.value(robot))
    tolerances = robot.tolerances or Tolerances()
    error = min(tolerances.youngs_modulus, _MODULUS_ERROR)
    tolerances = tolerances.model_copy(update={"youngs_modulus": error})
    return with_values(robot, values).model_copy(update={"tolerances": tolerances})


def _usable_record(rig: Any, robot: RobotDescription) -> CommissioningRecord | None:
    """Return the record of exactly this rig; None if there is none that fits."""
    path = rig.commissioning.record
    if path is None or not os.path.exists(path):
        return None
    try:
        record = load_record(path)
    except InputError:  # the check before arming reports it
        return None
    return record if record.fits and is_record_of(record, robot, rig) else None


def problems_of_record(
    record: CommissioningRecord, robot: RobotDescription, rig: Any, max_age: float
) -> Iterator[str]:
    """Yield the reasons why a record does not permit arming a rig; `max_age` is in s."""
    rig_hash, robot_hash = fingerprints(robot, rig)
    if record.robot_hash != robot_hash:
        yield f"its record is of another robot file ('{record.robot}')"
    if record.rig_hash != rig_hash:
        yield f"its record is of another supply, tracker or registration (rig '{record.rig}')"
    if not record.fits:
        wrong = [each.text for each in record.findings if not each.fits]
        yield f"it did not fit: {'; '.join(wrong) or 'see its record'}"
    age = record.age()
    if not -3600 <= age <= max_age:
        yield f"its record is {_age(age)} old; at most {_age(max_age)} is asked for"


def _age(seconds: float) -> str:
    hours = seconds / 3600
    if abs(hours) < 1:
        return f"{seconds / 60:.3g} min"
    return f"{hours:.3g} h" if abs(hours) < 48 else f"{hours / 24:.3g} days"
