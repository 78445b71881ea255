"""The description of an arm: the schema of the robot file, and classes for Python code.

All values are in SI: m, rad, Pa, kg. `stiffopt.model.segment` describes the segments.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Discriminator, Field, Tag, model_validator

from stiffopt.arrays import Array
from stiffopt.errors import InputError, shown
from stiffopt.model.calibration import Calibration, ErrorModel
from stiffopt.model.history import NO_HISTORY
from stiffopt.model.segment import ChamberNumber, Segment
from stiffopt.registration import Placement, Registration
from stiffopt.schema import BadKeyError, Items, Schema, Vector
from stiffopt.units import (
    Acceleration,
    Angle,
    Duration,
    Length,
    Mass,
    Number,
    Pressure,
    PressureRate,
    Ratio,
)

_SLACK = 1e-9  # m, for rounding
_INDEX = re.compile(r"\[(\d{1,4})\]")


def one_or_list(value: Any) -> str:
    """Distinguish one value for all channels from a list of one per channel."""
    listed = isinstance(value, Sequence) or hasattr(value, "tolist")
    scalar = isinstance(value, str) or getattr(value, "ndim", None) == 0
    return "<list>" if listed and not scalar else "<one>"


PerChannelPressure = Annotated[
    Annotated[Pressure, Tag("<one>")] | Annotated[Items[Pressure], Tag("<list>")],
    Discriminator(one_or_list),
]
"""One pressure for all channels or one per channel, proximal segment first, in Pa."""
_PositiveRate = Annotated[PressureRate, Field(gt=0)]
PerChannelRate = Annotated[
    Annotated[_PositiveRate, Tag("<one>")] | Annotated[Items[_PositiveRate], Tag("<list>")],
    Discriminator(one_or_list),
]
"""One rate for all channels or one per channel, proximal segment first, in Pa/s."""


class RegulatorLimits(Schema):
    """Limits of the regulators: one value for all channels, or one per channel.

    Attributes
    ----------
    min, max : in Pa, gauge.
    slew : greatest rate of change, in Pa/s, or None where it is not known.
    """

    min: PerChannelPressure
    max: PerChannelPressure
    slew: PerChannelRate | None = None


class TrackedBody(Schema):
    """A tracked body other than the tip.

    Attributes
    ----------
    at : arc length of the point of the arm that it moves with, at rest, from the base, in m.
    point_in_sensor : that point's frame, in the frame of the tracked body.
    """

    at: Annotated[Length, Field(gt=0)]
    point_in_sensor: Placement = Placement()


class Recordings(Schema):
    """How logs of this arm are read.

    Attributes
    ----------
    channels : pressure column of a log for each channel of the robot, counted from 1.
    frame : tracked body in whose frame poses are expressed; None for the tracker's own frame.
    registration : pose of that frame in the base frame, and of the tip in the sensor's.
    bodies : other tracked bodies, by name.
    """

    channels: Items[Annotated[ChamberNumber, Field(ge=1)]] = ()
    frame: str | None = None
    registration: Registration = Registration()
    bodies: dict[str, TrackedBody] = Field(default={})

    @model_validator(mode="after")
    def _check(self) -> Recordings:
        for index, column in enumerate(self.channels):
            if column in self.channels[:index]:
                raise BadKeyError(
                    f"channels.{index}",
                    f"column {column} appears twice; expected a different one for each channel",
                )
        return self


class Tolerances(Schema):
    """Uncertainty of a robot file before calibration: one standard deviation of each number.

    Attributes
    ----------
    length : of a segment, relative.
    youngs_modulus, area, stiffness, gain : relative.
    modulus_per_pressure : in Pa/Pa.
    softening, lengthening : absolute.
    bending_radius, dead_band : relative.
    offset : of a channel, in Pa.
    azimuth : of a channel, in rad.
    base_position, base_tilt, base_turn : of the base in the tracker's frame; its position, its
        axis and its turn about that.
    sensor_position, sensor_angle : of the tracked sensor on the tip.
    body_position, body_angle : of other tracked bodies.
    zero : of the position's zero from log to log, where it is set anew for each, in m.
    lag, memory : of a history, relative; dead_time : in s; share, creep_share : of its operators.
    """

    length: Annotated[Ratio, Field(gt=0)] = 0.03
    youngs_modulus: Annotated[Ratio, Field(gt=0)] = 0.3
    modulus_per_pressure: Annotated[Number, Field(gt=0)] = 0.2
    area: Annotated[Ratio, Field(gt=0)] = 0.3
    stiffness: Annotated[Ratio, Field(gt=0)] = 0.2
    gain: Annotated[Ratio, Field(gt=0)] = 0.05
    offset: Annotated[Pressure, Field(gt=0)] = 1e3
    azimuth: Annotated[Angle, Field(gt=0)] = 0.05
    softening: Annotated[Number, Field(gt=0)] = 0.5
    bending_radius: Annotated[Ratio, Field(gt=0)] = 0.5
    lengthening: Annotated[Number, Field(gt=0)] = 1.0
    dead_band: Annotated[Ratio, Field(gt=0)] = 0.7
    lag: Annotated[Ratio, Field(gt=0)] = 1.0
    dead_time: Annotated[Duration, Field(gt=0)] = 0.3
    share: Annotated[Ratio, Field(gt=0)] = 0.2
    creep_share: Annotated[Ratio, Field(gt=0)] = 0.03
    memory: Annotated[Ratio, Field(gt=0)] = 0.3
    base_position: Annotated[Length, Field(gt=0)] = 0.005
    base_tilt: Annotated[Angle, Field(gt=0)] = 0.05
    base_turn: Annotated[Angle, Field(gt=0)] = 0.1
    sensor_position: Annotated[Length, Field(gt=0)] = 0.002
    sensor_angle: Annotated[Angle, Field(gt=0)] = 0.05
    body_position: Annotated[Length, Field(gt=0)] = 0.02
    body_angle: Annotated[Angle, Field(gt=0)] = 0.2
    zero: Annotated[Length, Field(gt=0)] = 0.001

    @property
    def has_known_turn(self) -> bool:
        """Whether the base's turn about the arm's axis is roughly known, to 0.5 rad."""
        return self.base_turn <= 0.5


class RobotDescription(Schema):
    """An arm: its segments from the base to the tip, what it carries and what drives it.

    Attributes
    ----------
    name : of the arm.
    segments : proximal segment first.
    tip_mass : mass fixed at the tip, in kg.
    gravity : acceleration in the base frame, in m/s^2; z runs along the straight arm.
    pressure : limits of the regulators.
    recordings : how logs of this arm are read.
    tolerances : uncertainty of the numbers before a calibration.
    calibration : results and uncertainty of a calibration, or None.
    """

    name: Annotated[str, Field(min_length=1)]
    segments: Annotated[Items[Segment], Field(min_length=1, max_length=20)]
    tip_mass: Annotated[Mass, Field(ge=0)] = 0.0
    gravity: Vector[Acceleration] = (0.0, 0.0, 0.0)
    pressure: RegulatorLimits
    recordings: Recordings | None = None
    tolerances: Tolerances | None = None
    calibration: Calibration | None = None

    @property
    def n_segments(self) -> int:
        """Number of segments."""
        return len(self.segments)

    @property
    def n_pressures(self) -> int:
        """Number of channels of all segments."""
        return sum(segment.n_channels for segment in self.segments)

    @property
    def channel_ranges(self) -> tuple[range, ...]:
        """Numbers of each segment's channels, counted from 0 along the arm."""
        ends = [0, *itertools.accumulate(segment.n_channels for segment in self.segments)]
        return tuple(map(range, ends, ends[1:]))

    @property
    def highest_norms(self) -> tuple[float, ...]:
        """Norm of each segment's pressures, in Pa, where all are at their upper limits."""
        high = self.pressure_max
        return tuple(math.hypot(*(high[k] for k in own)) for own in self.channel_ranges)

    @property
    def creeps(self) -> bool:
        """True if the history of any segment includes creep."""
        return any(segment.history and segment.history.creep for segment in self.segments)

    @property
    def remembers_strain(self) -> bool:
        """True if hysteresis and creep of any segment follow strain, not pressure."""
        histories = (segment.history or NO_HISTORY for segment in self.segments)
        return any(each.remembers == "strain" for each in histories)

    @property
    def length(self) -> float:
        """Length at rest with the connectors, in m."""
        return sum(segment.length + segment.connector for segment in self.segments)

    @property
    def has_known_vertical(self) -> bool:
        """Whether the direction of gravity in the tracker's frame is known.

        It is if the base's tilt there is known to 0.1 rad and, where gravity acts across the arm,
        its turn to 0.5 rad.
        """
        given, gravity = self.tolerances or Tolerances(), np.array(self.gravity)
        across = float(np.hypot(*gravity[:2])) > 0.02 * float(np.linalg.norm(gravity))
        return given.base_tilt <= 0.1 and (given.has_known_turn or not across)

    @property
    def pressure_min(self) -> tuple[float, ...]:
        """Lower limit of each channel, in Pa."""
        return self._per_channel(self.pressure.min)

    @property
    def pressure_max(self) -> tuple[float, ...]:
        """Upper limit of each channel, in Pa."""
        return self._per_channel(self.pressure.max)

    @property
    def pressure_slew(self) -> tuple[float, ...] | None:
        """Greatest rate of change of each channel, in Pa/s, or None."""
        return None if self.pressure.slew is None else self._per_channel(self.pressure.slew)

    def slew_limits(self, further: ArrayLike | None = None) -> Array | None:
        """Return the greatest rates of change (n,), in Pa/s, or None if there is no limit.

        They are the smaller of the robot's and further ones, (n,) or one for all.
        """
        known = [rates for rates in (self.pressure_slew, further) if rates is not None]
        if not known:
            return None
        rows = [np.broadcast_to(np.asarray(rates, float), self.n_pressures) for rates in known]
        return np.min(rows, axis=0)

    @property
    def channel_areas(self) -> tuple[float, ...]:
        """Area of the chambers that each channel feeds, in m^2: axial force per pressure."""
        return tuple(
            len(chambers) * math.pi * segment.chambers.radius**2
            for segment in self.segments
            for chambers in segment.channels
        )

    def extrapolation(self, pressures: Array) -> str:
        """Return a warning if pressures (n,) in Pa are far from the calibration's, otherwise ""."""
        if self.calibration is None:
            return ""
        return self.calibration.extrapolation([s.n_channels for s in self.segments], pressures)

    def channel_name(self, index: int) -> str:
        """Return the name of a channel (counted from 0) in messages: ``segment 2 channel 1``."""
        for number, own in enumerate(self.channel_ranges, start=1):
            if index in own:
                return f"segment {number} channel {index - own.start + 1}"
        raise InputError(f"there is no such channel; this robot has {self.n_pressures}")

    def check_per_channel(self, key: str, value: object) -> None:
        """Raise `BadKeyError` if a list does not have one value for each channel."""
        n = self.n_pressures
        if isinstance(value, tuple) and len(value) != n:
            raise BadKeyError(
                key,
                f"has {len(value)} values; expected one value or a list of {n}, one for each "
                "channel of the robot, proximal segment first",
            )

    def _per_channel(self, value: float | tuple[float, ...]) -> tuple[float, ...]:
        return value if isinstance(value, tuple) else (value,) * self.n_pressures

    @model_validator(mode="after")
    def _check(self) -> RobotDescription:
        for key, value in self.pressure:
            self.check_per_channel(f"pressure.{key}", value)
        for index, (low, high) in enumerate(zip(self.pressure_min, self.pressure_max, strict=True)):
            if low >= high:
                raise BadKeyError(
                    "pressure.max",
                    f"{high * 1e-5:g} bar must be greater than the min of {low * 1e-5:g} bar "
                    f"({self.channel_name(index)})",
                )
        self._check_dead_bands()
        self._check_softening()
        self._check_recordings()
        self._check_calibration()
        if any(self.gravity):
            for index, segment in enumerate(self.segments):
                if segment.material.density is None:
                    raise BadKeyError(
                        f"segments.{index}.material",
                        "there is gravity, so a density is needed; "
                        "add one such as 'density: 1070 kg/m^3' or remove gravity",
                    )
        return self

    def _check_dead_bands(self) -> None:
        """Reject a dead band where a pressure may be negative: it would hardly act there at all."""
        for index, own in enumerate(self.channel_ranges):
            segment = self.segments[index]
            low = min(self.pressure_min[k] for k in own)
            if low < 0 and segment.corrections is not None and segment.corrections.dead_band > 0:
                raise BadKeyError(
                    f"segments.{index}.corrections.dead_band",
                    "a dead band is for pressures from 0 on, but those of this segment may be down "
                    f"to {low * 1e-5:g} bar; remove it or raise pressure.min",
                )

    def _check_softening(self) -> None:
        """Reject a softening that leaves no modulus, or too little of it for what is remembered.

        Both are checked at the highest pressures.
        """
        for index, most in enumerate(self.highest_norms):
            history = self.segments[index].history or NO_HISTORY
            softening = history.softening
            if 1 + softening * most <= 0:
                raise BadKeyError(
                    f"segments.{index}.history.softening",
                    f"{softening:g} per Pa leaves no modulus at the highest pressures, with a "
                    f"norm of {most * 1e-5:g} bar; expected between {-1 / most:.3g} and 0",
                )
            if (total := history.memory_at(most)) >= 1:
                raise BadKeyError(
                    f"segments.{index}.history.remembers",
                    "with a memory of strain, shares of play and creep grow as the arm softens: "
                    f"at the highest pressures they add up to {total:.3g}; expected less than 1",
                )

    def _check_recordings(self) -> None:
        given = self.recordings or Recordings()
        if given.channels and len(given.channels) != self.n_pressures:
            raise BadKeyError(
                "recordings.channels",
                f"has {len(given.channels)} columns; expected {self.n_pressures}, one for each "
                "channel of the robot, proximal segment first",
            )
        for name, body in given.bodies.items():
            if body.at > self.length + _SLACK:
                raise BadKeyError(
                    f"recordings.bodies.{name}.at",
                    f"{body.at * 1e3:g} mm is beyond the tip; expected at most the length at rest "
                    f"with the connectors, {self.length * 1e3:g} mm",
                )

    def _check_calibration(self) -> None:
        if self.calibration is None:
            return
        for index, parameter in enumerate(self.calibration.parameters):
            if not self._has_number(parameter.key):
                raise BadKeyError(
                    f"calibration.parameters.{index}.key",
                    f"{shown(parameter.key)} is no number of a segment of this robot; expected a "
                    "key such as 'segments[0].material.youngs_modulus'",
                )
        for key, n, what in (
            ("pressure_min", self.n_pressures, "channel"),
            ("pressure_max", self.n_pressures, "channel"),
            ("pressure_norm", self.n_segments, "segment"),
        ):
            values = getattr(self.calibration, key)
            if values and len(values) != n:
                raise BadKeyError(
                    f"calibration.{key}",
                    f"has {len(values)} values; expected {n}, one for each {what} of the robot",
                )
        if (errors := self.calibration.errors) is not None:
            self._check_errors(errors)

    def _check_errors(self, errors: ErrorModel) -> None:
        rows = {f"recorded.{i}": row for i, row in enumerate(errors.recorded)}
        for key, values in {"settled": errors.settled, "moving": errors.moving, **rows}.items():
            if len(values) != self.n_pressures and (values or key in rows):
                raise BadKeyError(
                    f"calibration.errors.{key}",
                    f"has {len(values)} values; expected {self.n_pressures}, one for each channel "
                    "of the robot",
                )

    def _has_number(self, key: str) -> bool:
        """Return whether a key like ``segments[0].corrections.gain[2]`` is a segment's number."""
        found: Any = self
        for step in key.replace("[", ".[").split("."):
            index = _INDEX.fullmatch(step)
            if index is not None and isinstance(found, tuple) and int(index[1]) < len(found):
                found = found[int(index[1])]
            elif isinstance(found, Schema) and step in type(found).model_fields:
                found = getattr(found, step)
            else:
                return False
        return key.startswith("segments[") and isinstance(found, float)
