"""The least-squares problem of a calibration: residuals of logs and tables, and their Jacobian.

A tracker's reading of a point of the arm follows from the commanded pressures in three steps, each
with its derivatives: the history of every segment (`stiffopt.identify.past`), the equilibrium at
the effective pressures (`stiffopt.model.parametric`) and the tracker (`stiffopt.identify.sensing`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from stiffopt.identify.past import Effective, Past, Start
from stiffopt.identify.recording import Recording
from stiffopt.identify.sensing import Readings, readings
from stiffopt.identify.settings import FIT
from stiffopt.identify.unknowns import Unknowns
from stiffopt.logs import StiffnessTable
from stiffopt.model.arguments import checked_measure
from stiffopt.model.compliance import Boundary
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import NO_HISTORY, History
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.parametric import ParametricArm

__all__ = ["Begin", "CalibrationProblem", "Noise", "Predicted", "Sample", "TrackedPoint"]

Array = NDArray[np.float64]


Begin = Literal["rest", "previous", "unknown"]
"""State in which a log begins: after a rise from no pressure, as the last one ended, or unknown."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Rows of a recording that are compared with the model.

    Attributes
    ----------
    recording : Recording
    rows : ndarray
        (M,), increasing.
    weight : ndarray
        Factor (M,) on the residuals of each row.
    begin : str
        State of the arm when the recording begins.
    """

    recording: Recording
    rows: NDArray[np.intp]
    weight: Array
    begin: Begin = "rest"


@dataclass(frozen=True, eq=False)
class TrackedPoint:
    """A point of the arm that is tracked.

    Attributes
    ----------
    name : name of its track in the recordings.
    at : arc length at rest, in m; None is the tip.
    sensor : pose (4, 4) of the sensor in the point's frame, where its unknown twist is zero.
    turns : whether its orientation is compared too.
    """

    name: str
    at: float | None
    sensor: Array
    turns: bool


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the residuals: of each axis of a position in m, of an angle in rad."""

    position: float
    angle: float


@dataclass(frozen=True, eq=False)
class Predicted:
    """What the model predicts for the rows of all samples.

    Attributes
    ----------
    effective : ndarray
        Pressures (M, n) of the equilibria, in Pa.
    poses : tuple of ndarray
        Of each point in the base frame (M, 4, 4).
    read : tuple of Readings
        Of each point, in the frame of the recordings.
    errors : tuple of ndarray
        Measured less read (M, 3), of each point; NaN where nothing was measured.
    """

    effective: Array
    poses: tuple[Array, ...]
    read: tuple[Readings, ...]
    errors: tuple[Array, ...]


class CalibrationProblem:
    """Residuals of samples and of tables of stiffness.

    Parameters
    ----------
    description : RobotDescription
        Where all unknowns are zero.
    unknowns : Unknowns
        What may change.
    samples : sequence of Sample
        In the order in which they were recorded.
    points : sequence of TrackedPoint
        The tip first.
    base_in_tracker : ndarray
        Pose (4, 4) of the base where its unknown twist is zero.
    tables : sequence of StiffnessTable
        Fitted together with the samples.
    noise : Noise
        What the residuals are divided by.
    """

    def __init__(
        self,
        description: RobotDescription,
        unknowns: Unknowns,
        samples: Sequence[Sample],
        points: Sequence[TrackedPoint],
        base_in_tracker: Array,
        noise: Noise,
        tables: Sequence[StiffnessTable] = (),
    ) -> None:
        self.description = description
        self.unknowns = unknowns
        self.samples = tuple(samples)
        self.points = tuple(points)
        self.base_in_tracker = base_in_tracker
        self.noise = noise
        self.tables = tuple(tables)
        self.scale = np.array([unknown.deviation for unknown in unknowns.all])
        self.low = np.array([unknown.low for unknown in unknowns.all]) / self.scale
        self.high = np.array([unknown.high for unknown in unknowns.all]) / self.scale
        self._parameters = [u.parameter for u in unknowns.parameters if u.parameter is not None]
        self._arm = ParametricArm(description, self._parameters)
        self._pasts = [Past(s.history, s.n_channels) for s in description.segments]
        self._index = {parameter.key: i for i, parameter in enumerate(self._parameters)}
        self._measured = [self._measurements(point) for point in self.points]
        self._weights = np.concatenate([sample.weight for sample in self.samples] or [np.zeros(0)])

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.scale)

    @property
    def starts(self) -> list[int]:
        """Where each sample begins among the rows of all, and their end."""
        return [0, *np.cumsum([len(sample.rows) for sample in self.samples]).tolist()]

    def start(self, near: Mapping[str, float]) -> Array:
        """Scaled coordinates (d,) of unknowns that are known by name, zero for the others."""
        x = np.array([near.get(unknown.name, 0.0) for unknown in self.unknowns.all])
        return np.asarray(np.clip(x, self.low, self.high))

    def named(self, x: Array) -> dict[str, float]:
        """Scaled coordinates (d,) by the names of their unknowns."""
        pairs = zip(self.unknowns.all, x, strict=True)
        return {unknown.name: float(value) for unknown, value in pairs}

    def without(self, held_back: Sequence[NDArray[np.bool_]]) -> CalibrationProblem:
        """The same problem, in which some rows of its samples do not count."""
        samples = [
            replace(each, weight=np.where(away, 0.0, each.weight))
            for each, away in zip(self.samples, held_back, strict=True)
        ]
        return self.with_samples(samples, self.noise)

    def with_samples(self, samples: Sequence[Sample], noise: Noise) -> CalibrationProblem:
        """The same problem with samples of other weights, and another noise."""
        other = copy(self)
        other.samples, other.noise = tuple(samples), noise
        other._weights = np.concatenate([sample.weight for sample in samples])
        return other

    def robot(self, x: Array) -> RobotDescription:
        """Robot with the parameters of scaled coordinates x (d,), to seven digits."""
        coordinates = x * self.scale
        return with_values(
            self.description,
            {
                parameter: _rounded(parameter.at(parameter.value(self.description), coordinates[i]))
                for i, parameter in enumerate(self._parameters)
            },
        )

    def residuals(self, x: Array) -> tuple[Array, Array]:
        """Residuals (m,) of samples and tables at scaled coordinates, and their Jacobian (m, d).

        Rows without a measurement are zero.  The prior is not among them.
        """
        predicted, slopes = self._predict(x)
        values: list[Array] = []
        jacobians: list[Array] = []
        for error, read, (moved, turned) in zip(
            predicted.errors, predicted.read, slopes, strict=True
        ):
            self._append(values, jacobians, error, -moved, self.noise.position)
            turn = read.turn
            if turn is not None and turned is not None:
                self._append(values, jacobians, -turn, -turned, self.noise.angle)
        for table in self.tables:
            value, jacobian = self.of_table(table, x)
            values.append(value)
            jacobians.append(jacobian)
        for value, jacobian in (self._too_much_memory(x), self._too_soft(x)):
            values.append(value)
            jacobians.append(jacobian)
        return np.concatenate(values), np.concatenate(jacobians) * self.scale

    def _too_much_memory(self, x: Array) -> tuple[Array, Array]:
        """By how much the shares of each channel's history exceed what is sensible, (n,)."""
        n = self.description.n_pressures
        value, slope = np.zeros(n), np.zeros((n, self.size))
        row = 0
        for s, segment in enumerate(self.description.segments):
            history = self._history(s, x * self.scale)
            prefix = f"segments[{s}].history"
            total = sum(part.share for part in history.parts)
            for c in range(segment.n_channels):
                memory = history.memory_of(c)
                if memory * total > FIT.most_memory:
                    value[row] = (memory * total - FIT.most_memory) / FIT.memory_slack
                    for key, i in self._index.items():
                        if key.startswith(prefix) and key.endswith("share"):
                            slope[row, i] = memory / FIT.memory_slack
                        elif key == f"{prefix}.memory[{c}]":
                            slope[row, i] = memory * total / FIT.memory_slack
                row += 1
        return value, slope

    def _too_soft(self, x: Array) -> tuple[Array, Array]:
        """By how much pressure softens each segment more than within its limits it may, (s,)."""
        segments = self.description.segments
        value, slope = np.zeros(len(segments)), np.zeros((len(segments), self.size))
        first = 0
        for s, segment in enumerate(segments):
            channels = range(first, first + segment.n_channels)
            first += segment.n_channels
            compensation = segment.compensation
            if compensation is None:
                continue
            prefix = f"segments[{s}]"
            keys = (
                f"{prefix}.material.youngs_modulus",
                f"{prefix}.compensation.modulus_per_pressure",
            )
            modulus, per_pressure = (self._value(key, x) for key in keys)
            norm, per_unknown = self._farthest(prefix, channels, x)
            change = per_pressure * norm / modulus  # of the modulus, relative, at the most
            slopes = {self._index.get(key): each for key, each in per_unknown.items()}
            slopes = {i: each * per_pressure / modulus for i, each in slopes.items()}
            slopes[self._index.get(keys[0])] = -change
            slopes[self._index.get(keys[1])] = norm / modulus
            if compensation.modulus_law == "linear":
                sign, excess = -1.0, FIT.least_modulus - (1 + change)
            else:  # beyond, more pressure would bend less
                sign, excess = 1.0, change - FIT.most_stiffening
            if excess > 0:
                value[s] = excess / FIT.modulus_slack
                for i, each in slopes.items():
                    if i is not None:
                        slope[s, i] = sign * each / FIT.modulus_slack
        return value, slope

    def _value(self, key: str, x: Array) -> float:
        """Value of a number of the robot file at scaled coordinates (d,)."""
        parameter, i = Parameter(key), self._index.get(key)
        nominal = parameter.value(self.description)
        return nominal if i is None else float(parameter.at(nominal, x[i] * self.scale[i]))

    def _farthest(self, prefix: str, channels: range, x: Array) -> tuple[float, dict[str, float]]:
        """Largest norm of a segment's acting pressures within the robot's limits, in Pa.

        And its slopes by the coordinates of gains and offsets, by their keys.
        """
        limits = np.maximum(
            np.abs(self.description.pressure_min), np.abs(self.description.pressure_max)
        )
        acting, slopes = [], {}
        for c, channel in enumerate(channels):
            gain, offset = (f"{prefix}.corrections.{name}[{c}]" for name in ("gain", "offset"))
            own, added = self._value(gain, x) * limits[channel], self._value(offset, x)
            acting.append(own + abs(added))
            slopes[gain], slopes[offset] = acting[-1] * own, acting[-1] * np.sign(added)
        norm = float(np.linalg.norm(acting))
        return norm, {key: float(each) / norm for key, each in slopes.items()}

    def predict(self, x: Array) -> Predicted:
        """What the model says at scaled coordinates (d,)."""
        return self._predict(x)[0]

    def _append(
        self, values: list[Array], jacobians: list[Array], error: Array, slope: Array, scale: float
    ) -> None:
        """Add weighted residuals (M, 3) and their slopes (M, 3, d) by unscaled coordinates."""
        known = ~np.isnan(error.sum(axis=1))
        weight = (np.where(known, self._weights, 0.0) / scale)[:, np.newaxis]
        values.append((np.where(known[:, np.newaxis], error, 0.0) * weight).ravel())
        slope = np.where(known[:, np.newaxis, np.newaxis], slope, 0.0)
        jacobians.append((slope * weight[..., np.newaxis]).reshape(-1, self.size))

    def _predict(self, x: Array) -> tuple[Predicted, list[tuple[Array, Array | None]]]:
        """Prediction, and the slopes (M, 3, d) of each point's position and turn."""
        coordinates = x * self.scale
        base, sensors, zeros, sides = self.unknowns.slices()
        effective, by_history = self._effective(coordinates, sides)
        k = len(self._parameters)
        starts = self.starts
        poses, read, errors, slopes = [], [], [], []
        for point, sensor, (position, rotation) in zip(
            self.points, sensors, self._measured, strict=True
        ):
            found = self._arm.poses(effective, coordinates[:k], point.at)
            sensor_twist = np.zeros(6)
            sensor_twist[: sensor.stop - sensor.start] = coordinates[sensor]
            base_twist = np.zeros(6)
            base_twist[: base.stop - base.start] = coordinates[base]
            seen = readings(
                found.transforms, self.base_in_tracker, base_twist,
                point.sensor, sensor_twist, rotation,
            )  # fmt: skip
            twist = np.zeros((len(effective), 6, self.size))  # of the point, in its axes
            twist[:, :, :k] = found.per_coordinate
            twist += found.per_pressure @ by_history

            def slope(per: Array, twist: Array = twist, sensor: slice = sensor) -> Array:
                total: Array = per[:, :, :6] @ twist
                total[:, :, base] += per[:, :, 6 : 6 + base.stop - base.start]
                total[:, :, sensor] += per[:, :, 12 : 12 + sensor.stop - sensor.start]
                return total

            moved = slope(seen.per_twist)
            place = seen.position.copy()
            for own, begin, end in zip(zeros, starts[:-1], starts[1:], strict=False):
                if own.stop > own.start:
                    place[begin:end] += coordinates[own]
                    moved[begin:end, :, own] += np.eye(3)
            turned = None if seen.turn_per_twist is None else slope(seen.turn_per_twist)
            poses.append(found.transforms)
            read.append(replace(seen, position=place))
            errors.append(position - place)
            slopes.append((moved, turned))
        return Predicted(effective, tuple(poses), tuple(read), tuple(errors)), slopes

    def _effective(self, coordinates: Array, sides: Sequence[slice]) -> tuple[Array, Array]:
        """Effective pressures (M, n) of all samples and their slopes (M, n, d)."""
        starts, n = self.starts, self.description.n_pressures
        effective = np.zeros((starts[-1], n))
        slopes = np.zeros((starts[-1], n, self.size))
        first = 0
        for s, (segment, past) in enumerate(
            zip(self.description.segments, self._pasts, strict=True)
        ):
            channels = slice(first, first + segment.n_channels)
            first += segment.n_channels
            history = self._history(s, coordinates)
            end: Start | None = None
            owner = slice(0, 0)  # the sides on which this and the logs before it depend
            for i, sample in enumerate(self.samples):
                pressures = sample.recording.pressures[:, channels]
                before = sample.recording.before[channels]
                if sample.begin == "previous" and end is not None:
                    start = end
                elif sample.begin == "unknown" and sides[i].stop > sides[i].start:
                    owner = sides[i]
                    own = coordinates[owner][channels]
                    start = Start.settled(history, before, own)
                else:
                    owner = slice(0, 0)
                    start = Start.from_rest(history, before)
                found = past.effective(
                    sample.recording.time, pressures, sample.rows, start, history
                )
                end = found.end
                rows = slice(starts[i], starts[i + 1])
                effective[rows, channels] = found.pressures
                self._enter(slopes[rows, channels], s, history, found)
                if owner.stop > owner.start:
                    for c in range(channels.start, channels.stop):
                        local = c - channels.start
                        slopes[rows, c, owner.start + c] = found.per_side[:, local]
        return effective, slopes

    def _enter(self, slopes: Array, s: int, history: History, found: Effective) -> None:
        """Write the slopes (M, c, d) by a segment's history."""
        prefix = f"segments[{s}].history"
        lag = self._index.get(f"{prefix}.lag")
        if lag is not None:
            slopes[:, :, lag] = found.per_lag * history.lag
        falling = self._index.get(f"{prefix}.lag_falling")
        if falling is not None:
            slopes[:, :, falling] = found.per_lag_falling * history.lag_falling
        for c in range(slopes.shape[1]):
            memory = self._index.get(f"{prefix}.memory[{c}]")
            if memory is not None:
                slopes[:, c, memory] = found.per_memory[:, c] * history.memory_of(c)
        dead_time = self._index.get(f"{prefix}.dead_time")
        if dead_time is not None:
            slopes[:, :, dead_time] = found.per_dead_time
        names = [f"play[{j}]" for j in range(len(history.play))]
        names += [f"creep[{j}]" for j in range(len(history.creep))]
        for j, name in enumerate(names):
            share = self._index.get(f"{prefix}.{name}.share")
            if share is not None:
                slopes[:, :, share] = found.per_share[:, :, j]

    def _history(self, s: int, coordinates: Array) -> History:
        """History of a segment with the values of these coordinates."""
        history = self.description.segments[s].history or NO_HISTORY
        prefix = f"segments[{s}].history"

        def value(name: str, nominal: float) -> float:
            i = self._index.get(f"{prefix}.{name}")
            if i is None:
                return nominal
            return float(self._parameters[i].at(nominal, coordinates[i]))

        return history.model_copy(
            update={
                "dead_time": value("dead_time", history.dead_time),
                "lag": value("lag", history.lag),
                "lag_falling": value("lag_falling", history.lag_falling),
                "memory": tuple(
                    value(f"memory[{c}]", factor) for c, factor in enumerate(history.memory)
                ),
                "play": tuple(
                    play.model_copy(update={"share": value(f"play[{j}].share", play.share)})
                    for j, play in enumerate(history.play)
                ),
                "creep": tuple(
                    creep.model_copy(update={"share": value(f"creep[{j}].share", creep.share)})
                    for j, creep in enumerate(history.creep)
                ),
            }
        )

    def _measurements(self, point: TrackedPoint) -> tuple[Array, Array | None]:
        """Positions (M, 3) and rotations (M, 3, 3) of a point in the rows of all samples."""
        positions, rotations = [np.zeros((0, 3))], [np.zeros((0, 3, 3))]
        for sample in self.samples:
            track = sample.recording.track(point.name)
            positions.append(track.position[sample.rows])
            if track.rotation is None or not point.turns:
                rotations.append(np.full((len(sample.rows), 3, 3), np.nan))
            else:
                rotations.append(track.rotation[sample.rows])
        return np.concatenate(positions), np.concatenate(rotations) if point.turns else None

    def _quick(self, coordinates: Array) -> tuple[Array, Array]:
        """Coordinates (k,) of the parameters as a quick push meets them, and their slopes (k, k).

        What the histories hold on to adds to the factor on the stiffness: a table is measured
        with quick small pushes.  Under gravity that factor would move the arm too; there a table
        is compared with the stiffness of equilibrium.
        """
        k = len(self._parameters)
        found, slopes = coordinates[:k].copy(), np.eye(k)
        if any(self.description.gravity):
            return found, slopes
        for s in range(len(self.description.segments)):
            stiffness = self._index.get(f"segments[{s}].compensation.stiffness")
            history = self._history(s, coordinates)
            if stiffness is None or not history.parts:
                continue
            quick = history.quick_share
            found[stiffness] -= np.log(quick)
            total = sum(part.share for part in history.parts)
            channels = len(history.memory)
            memory = sum(history.memory) / channels if channels else 1.0
            for key, i in self._index.items():
                if key.startswith(f"segments[{s}].history") and key.endswith("share"):
                    slopes[stiffness, i] = memory / quick
                elif key.startswith(f"segments[{s}].history.memory"):
                    own = history.memory_of(int(key[:-1].rpartition("[")[2]))
                    slopes[stiffness, i] = own / channels * total / quick
        return found, slopes

    def of_table(self, table: StiffnessTable, x: Array) -> tuple[Array, Array]:
        """Residuals (r,) of a table over its sigmas, and their slopes (r, d)."""
        coordinates, by_history = self._quick(x * self.scale)
        value, slope = np.zeros(len(table)), np.zeros((len(table), self.size))
        known = np.isfinite(table.stiffness) & np.isfinite(table.sigma) & (table.sigma > 0)
        kinds = list(zip(map(tuple, table.directions.tolist()), table.boundaries, strict=True))
        for direction, boundary in sorted({kinds[row] for row in np.flatnonzero(known)}):
            rows = known & np.array([kind == (direction, boundary) for kind in kinds])
            measure = checked_measure(direction, "translation", cast(Boundary, boundary), "base")
            k, _, per_coordinate = self._arm.stiffnesses(
                table.pressures[rows], coordinates, measure
            )
            value[rows] = (table.stiffness[rows] - k) / table.sigma[rows]
            change = per_coordinate @ by_history
            slope[rows, : len(coordinates)] = -change / table.sigma[rows, np.newaxis]
        return value, slope


def _rounded(value: float) -> float:
    """A value with as many digits as a robot file needs."""
    return float(f"{value:.7g}")
