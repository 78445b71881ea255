"""The least-squares problem of a calibration: residuals of logs and tables, with their Jacobian.

Three steps, each with derivatives, predict a tracker's reading from the commanded pressures:
the history of each segment gives the effective pressures (`stiffopt.identify.past`), the
equilibrium there gives the arm's poses (`stiffopt.model.parametric`), and the measurement model
gives the reading (`stiffopt.identify.sensing`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from typing import Literal, cast

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.identify.discrepancy import Systematic, smooth_functions
from stiffopt.identify.past import Past, Start, pause_between
from stiffopt.identify.recording import FRAME, Recording
from stiffopt.identify.sensing import (
    Readings,
    gravity_in_base,
    in_frame_anew,
    of_body_anew,
    readings,
)
from stiffopt.identify.settings import FIT
from stiffopt.identify.unknowns import Unknowns
from stiffopt.logs import StiffnessTable
from stiffopt.model.arguments import checked_measure
from stiffopt.model.batch import InterpretedFunction
from stiffopt.model.codegen import dense
from stiffopt.model.compliance import Boundary
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import NO_HISTORY
from stiffopt.model.parameters import Parameter, varied, with_values
from stiffopt.model.parametric import ParametricArm

Begin = Literal["rest", "previous", "unknown"]
"""State at a log's beginning: after a rise from zero, as the previous log ended, or unknown."""
Kind = Literal["position", "angle"]
"""Kind of a residual."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Rows of a recording that are compared with the model.

    Attributes
    ----------
    recording : Recording
    rows : (M,), indices of rows, increasing.
    weight : factor (M,) on the residuals of each row.
    spread : deviation (M,) of each row's noise over `Noise.position`; `weight` accounts for it.
    begin : state of the arm when the recording begins.
    """

    recording: Recording
    rows: NDArray[np.intp]
    weight: Array
    begin: Begin = "rest"
    spread: Array | float = 1.0


@dataclass(frozen=True, eq=False)
class TrackedPoint:
    """A point of the arm that is tracked.

    Attributes
    ----------
    name : of its track in the recordings.
    at : arc length at rest, in m; None is the tip.
    sensor : pose (4, 4) of the sensor in the point's frame if its unknown twist is zero.
    turns : whether orientations are compared too.
    """

    name: str
    at: float | None
    sensor: Array
    turns: bool


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the errors.

    Attributes
    ----------
    position : of each axis of a row's position, in m.
    angle : of each axis of a row's rotation, in rad.
    systematic : of the errors that rows at nearby pressures share, as a share of the arm's length.
        For angles it is twice that number, in rad: an arm that bends too far by an angle a misses
        the position by a / 2 of its length.
    """

    position: float
    angle: float
    systematic: float = 0.0


@dataclass(frozen=True, eq=False)
class Predicted:
    """The model's predictions for the rows of all samples; one array for each tracked point.

    Attributes
    ----------
    effective : effective pressures (M, n), in Pa; not by point.
    rates : their time derivatives (M, n), in Pa/s, without those of their memory.
    poses : (M, 4, 4), in the base frame.
    read : predicted readings, in the frame of the recordings.
    errors : (M, 3), measured minus predicted position, in m; NaN where nothing was measured.
    per_pressure : derivatives (M, 3, n) of the predicted positions by effective pressures, in m/Pa.
    """

    effective: Array
    rates: Array
    poses: tuple[Array, ...]
    read: tuple[Readings, ...]
    errors: tuple[Array, ...]
    per_pressure: tuple[Array, ...]


class CalibrationProblem:
    """Residuals of samples and of tables of stiffness.

    Parameters
    ----------
    description : the robot at which all unknowns are zero.
    unknowns : numbers that the fit may change.
    samples : in the order in which they were recorded.
    points : the tip first.
    base_in_tracker : pose (4, 4) of the base if its unknown twist is zero.
    noise : standard deviations by which the errors are divided.
    tables : measured stiffness, fitted together with the samples.
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
        self._of_rows: dict[tuple[Kind, bytes], Systematic] = {}

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.scale)

    @property
    def starts(self) -> list[int]:
        """Index of each sample's first row among all rows, and the number of rows."""
        return [0, *np.cumsum([len(sample.rows) for sample in self.samples]).tolist()]

    def start(self, near: Mapping[str, float]) -> Array:
        """Return scaled coordinates (d,) from values by name; zero for the other unknowns."""
        x = np.array([near.get(unknown.name, 0.0) for unknown in self.unknowns.all])
        return np.asarray(np.clip(x, self.low, self.high))

    def named(self, x: Array) -> dict[str, float]:
        """Return scaled coordinates (d,) by the names of their unknowns."""
        pairs = zip(self.unknowns.all, x, strict=True)
        return {unknown.name: float(value) for unknown, value in pairs}

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Which rows (M,) are not held back."""
        return np.asarray(self._weights > 0)

    @property
    def n_shared(self) -> int:
        """How many of the residuals, at the end, are coefficients of systematic errors."""
        if not (self.noise.systematic and self.samples):
            return 0
        kinds = sum(1 + (rotation is not None) for _, rotation in self._measured)
        return int(3 * kinds * self._functions.shape[1])

    def without(self, held_back: Sequence[NDArray[np.bool_]]) -> CalibrationProblem:
        """Return the problem with zero weight for held-back rows (a mask for each sample)."""
        samples = [
            replace(each, weight=np.where(away, 0.0, each.weight))
            for each, away in zip(self.samples, held_back, strict=True)
        ]
        return self.with_samples(samples, self.noise)

    def with_samples(self, samples: Sequence[Sample], noise: Noise) -> CalibrationProblem:
        """Return the problem with the same samples in other weights, and with another noise."""
        other = copy(self)
        other.samples, other.noise = tuple(samples), noise
        other._weights = np.concatenate([sample.weight for sample in samples])
        other._of_rows = {}
        other.__dict__.pop("_functions", None)
        return other

    def robot(self, x: Array) -> RobotDescription:
        """Return the robot at scaled coordinates x (d,), its numbers rounded to seven digits."""
        coordinates = x * self.scale
        robot = with_values(
            self.description,
            {
                parameter: _rounded(parameter.at(parameter.value(self.description), coordinates[i]))
                for i, parameter in enumerate(self._parameters)
            },
        )
        found = self._gravity(coordinates)
        if found is None:
            return robot
        return robot.model_copy(update={"gravity": tuple(map(_rounded, found[0].tolist()))})

    def _gravity(self, coordinates: Array) -> tuple[Array, Array] | None:
        """Return gravity (3,) in the axes of the turned base, and its derivatives (3, d).

        None if it does not vary: there is none, the base is known, or the vertical is not.
        """
        base, *_ = self.unknowns.slices()
        given = np.array(self.description.gravity)
        if not (self.unknowns.base and given.any() and self.description.has_known_vertical):
            return None
        turn, slopes = slice(base.start + 3, base.stop), np.zeros((3, self.size))
        found, slopes[:, turn] = gravity_in_base(given, coordinates[turn])
        return found, slopes

    def _turn_gravity(self, coordinates: Array) -> Array | None:
        """Set the arm's gravity; return its derivatives (3, d), or None if it does not vary."""
        found = self._gravity(coordinates)
        if found is None:
            return None
        self._arm.set_gravity(found[0])
        return found[1]

    def residuals(self, x: Array) -> tuple[Array, Array]:
        """Return residuals (m,) of samples and tables at scaled coordinates, and Jacobian (m, d).

        Rows without a measurement are zero.  The prior is not included.  Systematic errors are
        subtracted from the rows; their coefficients come last.
        """
        predicted, slopes = self._predict(x)
        values: list[Array] = []
        jacobians: list[Array] = []
        shared: list[tuple[Array, Array]] = []
        for error, read, (moved, turned) in zip(
            predicted.errors, predicted.read, slopes, strict=True
        ):
            found = [self._divided(error, -moved, "position")]
            turn = read.turn
            if turn is not None and turned is not None:
                found.append(self._divided(-turn, -turned, "angle"))
            rows = 3 * len(error)
            for value, slope in found:
                values.append(value[:rows])
                jacobians.append(slope[:rows])
                shared.append((value[rows:], slope[rows:]))
        for table in self.tables:
            value, jacobian = self.of_table(table, x)
            values.append(value)
            jacobians.append(jacobian)
        excess, per_parameter, *_ = self._of_parameters(x)
        jacobian = np.zeros((len(excess), self.size))
        jacobian[:, : len(self._parameters)] = per_parameter
        values += [excess[:, 0], *(value for value, _ in shared)]
        jacobians += [jacobian, *(slope for _, slope in shared)]
        return np.concatenate(values), np.concatenate(jacobians) * self.scale

    def _of_parameters(self, x: Array) -> list[Array]:
        """Evaluate `_excess` and `_met_by_a_quick_push` at coordinates (d,), with Jacobians."""
        return self._parameter_function((x * self.scale)[: len(self._parameters)])

    @cached_property
    def _parameter_function(self) -> InterpretedFunction:
        coordinates = ca.SX.sym("coordinates", len(self._parameters))
        robot = varied(self.description, self._parameters, coordinates)
        outputs: list[ca.SX] = []
        excess = _excess(robot, self.description)
        for value in (excess, self._met_by_a_quick_push(robot, coordinates)):
            outputs += [value, ca.jacobian(value, coordinates)]
        return InterpretedFunction(dense(ca.Function("parameters", [coordinates], outputs)))

    def _met_by_a_quick_push(self, robot: RobotDescription, coordinates: ca.SX) -> ca.SX:
        """Return coordinates (k,) of the parameters that apply to a quick small push.

        Stiffness tables are measured with such pushes, too quick for creep and too small to
        overcome hysteresis, which makes the arm stiffer: the factor on the stiffness grows.  Under
        gravity that factor would also move the arm, so there the table is compared with the
        stiffness at equilibrium.
        """
        met = ca.SX(coordinates)
        for s, segment in enumerate(robot.segments):
            stiffness = self._index.get(f"segments[{s}].compensation.stiffness")
            if stiffness is not None and segment.history and not any(robot.gravity):
                met[stiffness] -= ca.log(segment.history.quick_share)
        return met

    def predict(self, x: Array) -> Predicted:
        """Return the model's predictions at scaled coordinates (d,)."""
        return self._predict(x)[0]

    def with_slopes(self, x: Array) -> tuple[Predicted, Array]:
        """Return `predict` and derivatives (M, 3, d) of the tip's reading by scaled coordinates."""
        predicted, slopes = self._predict(x)
        return predicted, slopes[0][0] * self.scale

    def _divided(self, error: Array, slope: Array, kind: Kind) -> tuple[Array, Array]:
        """Return residuals (3 M + 3 m,) of errors (M, 3), and their derivatives by coordinates.

        They are the errors without their systematic part, then its m coefficients for each axis.
        """
        known = ~np.isnan(error.sum(axis=1))
        systematic, weight = self._systematic(known, kind)
        value = np.where(known[:, np.newaxis], error, 0.0) * weight
        slope = np.where(known[:, np.newaxis, np.newaxis], slope, 0.0) * weight[..., np.newaxis]
        if systematic is not None:
            value = systematic.residuals(value)
            slope = systematic.residuals(slope.reshape(len(slope), -1))
        return value.ravel(), slope.reshape(-1, self.size)

    def unshared(self, error: Array, kind: Kind) -> tuple[Array, Array]:
        """Return errors (M, 3) minus the part that rows at nearby pressures share, and U (M, m).

        ``U U'`` is the covariance of what that part may be wrong by, between rows, for each axis.
        """
        known = ~np.isnan(error.sum(axis=1))
        systematic, weight = self._systematic(known, kind)
        if systematic is None:
            return error, np.zeros((len(error), 0))
        part = systematic.part(np.where(known[:, np.newaxis], error, 0.0) * weight)
        found = np.hstack([part, systematic.root])
        found = np.divide(found, weight, out=np.zeros_like(found), where=weight > 0)
        return np.asarray(error - found[:, :3]), found[:, 3:]

    def _systematic(self, known: NDArray[np.bool_], kind: Kind) -> tuple[Systematic | None, Array]:
        """Return the systematic errors' model for known rows (M,), and all weights (M, 1)."""
        noise = self.noise
        own = noise.position if kind == "position" else noise.angle
        shared = noise.systematic * (self.description.length if kind == "position" else 2.0)
        weight = (np.where(known, self._weights, 0.0) / own)[:, np.newaxis]
        if not (shared and len(known)):
            return None, weight
        key = (kind, known.tobytes())
        if key not in self._of_rows:
            self._of_rows[key] = Systematic.of(self._functions * (shared * weight))
        return self._of_rows[key], weight

    @cached_property
    def _functions(self) -> Array:
        """Functions (M, m) of the errors that rows share.

        What noisier rows have wrong beyond the others, as while pressures change, returns whenever
        these commands are repeated: that part is shared too.
        """
        rows = [np.broadcast_to(each.spread, each.rows.shape) for each in self.samples]
        spread = np.concatenate(rows)
        if not np.ptp(spread):
            return self._smooth
        shared = self.noise.systematic * self.description.length
        excess = (
            np.sqrt(np.maximum(spread**2 - spread.min() ** 2, 0)) * self.noise.position / shared
        )
        return np.hstack([self._smooth, self._smooth * excess[:, np.newaxis]])

    @cached_property
    def _smooth(self) -> Array:
        rows = [sample.recording.pressures[sample.rows] for sample in self.samples]
        return smooth_functions(np.concatenate(rows))

    def _predict(self, x: Array) -> tuple[Predicted, list[tuple[Array, Array | None]]]:
        """Return predictions, and derivatives (M, 3, d) of each point's position and turn."""
        coordinates = x * self.scale
        base, sensors, zeros, sides = self.unknowns.slices()
        effective, rates, by_history = self._effective(coordinates, sides)
        by_gravity = self._turn_gravity(coordinates)
        k = len(self._parameters)
        starts = self.starts
        poses, read, errors, acting, slopes = [], [], [], [], []
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
            if by_gravity is not None:
                twist += found.per_gravity @ by_gravity

            def slope(per: Array, twist: Array = twist, sensor: slice = sensor) -> Array:
                total: Array = per[:, :, :6] @ twist
                total[:, :, base] += per[:, :, 6 : 6 + base.stop - base.start]
                total[:, :, sensor] += per[:, :, 12 : 12 + sensor.stop - sensor.start]
                return total

            moved = slope(seen.per_twist)
            turned = None if seen.turn_per_twist is None else slope(seen.turn_per_twist)
            place = seen.position.copy()
            turn = None if seen.turn is None else seen.turn.copy()
            for i, own in enumerate(zeros):
                rows, values = slice(starts[i], starts[i + 1]), coordinates[own]
                if not values.size:
                    continue
                known = None if rotation is None else rotation[rows]
                by, by_turn = self._by_zero(i, point.name, place[rows], known)
                if self.samples[i].recording.anew == FRAME:
                    moved[rows] += lie.hat(values[3:]) @ moved[rows]
                place[rows] += by @ values
                moved[rows, :, own] += by
                if turn is not None and turned is not None:
                    turn[rows] += by_turn @ values
                    turned[rows, :, own] += by_turn
            poses.append(found.transforms)
            read.append(replace(seen, position=place, turn=turn))
            errors.append(position - place)
            acting.append(seen.per_twist[:, :, :6] @ found.per_pressure)
            slopes.append((moved, turned))
        predicted = Predicted(
            effective, rates, tuple(poses), tuple(read), tuple(errors), tuple(acting)
        )
        return predicted, slopes

    def _by_zero(
        self, sample: int, point: str, position: Array, rotation: Array | None
    ) -> tuple[Array, Array]:
        """Return derivatives (N, 3, m) of a point's position and turn by the zero of a sample."""
        anew = self.samples[sample].recording.anew
        if anew == FRAME:
            return in_frame_anew(position - self.base_in_tracker[:3, 3], rotation)
        if anew == point and rotation is not None:
            return of_body_anew(rotation)
        zero = np.eye(3) if anew is None else np.zeros((3, 6))
        return np.broadcast_to(zero, (len(position), *zero.shape)), np.zeros(
            (len(position), *zero.shape)
        )

    def _effective(self, coordinates: Array, sides: Sequence[slice]) -> tuple[Array, Array, Array]:
        """Return effective pressures (M, n), their rates (M, n), and derivatives (M, n, d)."""
        starts, n = self.starts, self.description.n_pressures
        effective, rates = np.zeros((starts[-1], n)), np.zeros((starts[-1], n))
        slopes = np.zeros((starts[-1], n, self.size))
        robot = varied(self.description, self._parameters, coordinates)
        first = 0
        for s, (segment, past) in enumerate(zip(robot.segments, self._pasts, strict=True)):
            channels = slice(first, first + segment.n_channels)
            first += segment.n_channels
            history, prefix = segment.history or NO_HISTORY, f"segments[{s}].history."
            varying = [
                (i, each.key.removeprefix(prefix), each.per_coordinate(each.value(robot)))
                for i, each in enumerate(self._parameters)
                if each.key.startswith(prefix)
            ]
            end: Start | None = None
            owner = slice(0, 0)  # the unknown sides on which this log depends, if any
            for i, sample in enumerate(self.samples):
                pressures = sample.recording.pressures[:, channels]
                before = sample.recording.before[channels]
                if sample.begin == "previous" and end is not None:
                    pause = pause_between(self.samples[i - 1].recording.time, sample.recording.time)
                    start = past.rested(end, pause, history)
                elif sample.begin == "unknown" and sides[i].stop > sides[i].start:
                    owner = sides[i]
                    own = coordinates[owner][channels]
                    start = Start.settled(history, before, own, pressures)
                else:
                    owner = slice(0, 0)
                    start = Start.from_rest(history, before)
                found = past.effective(
                    sample.recording.time, pressures, sample.rows, start, history
                )
                end = found.end
                rows = slice(starts[i], starts[i + 1])
                effective[rows, channels] = found.pressures
                rates[rows, channels] = -found.per_number["dead_time"]  # later means as before
                for place, name, per_coordinate in varying:
                    slopes[rows, channels, place] = found.per_number[name] * per_coordinate
                if owner.stop > owner.start:
                    places = slice(owner.start + channels.start, owner.start + channels.stop)
                    slopes[rows, channels, places] = found.per_side
        return effective, rates, slopes

    def _measurements(self, point: TrackedPoint) -> tuple[Array, Array | None]:
        """Return measured positions (M, 3) and rotations (M, 3, 3) of a point in all rows."""
        positions, rotations = [np.zeros((0, 3))], [np.zeros((0, 3, 3))]
        for sample in self.samples:
            track = sample.recording.track(point.name)
            positions.append(track.position[sample.rows])
            if track.rotation is None or not point.turns:
                rotations.append(np.full((len(sample.rows), 3, 3), np.nan))
            else:
                rotations.append(track.rotation[sample.rows])
        return np.concatenate(positions), np.concatenate(rotations) if point.turns else None

    def of_table(self, table: StiffnessTable, x: Array) -> tuple[Array, Array]:
        """Return a table's residuals (r,), divided by its sigmas, and their derivatives (r, d)."""
        _, _, coordinates, by_history = self._of_parameters(x)
        by_gravity = self._turn_gravity(x * self.scale)
        value, slope = np.zeros(len(table)), np.zeros((len(table), self.size))
        known = np.isfinite(table.stiffness) & np.isfinite(table.sigma) & (table.sigma > 0)
        kinds = list(zip(map(tuple, table.directions.tolist()), table.boundaries, strict=True))
        for direction, boundary in sorted({kinds[row] for row in np.flatnonzero(known)}):
            rows = known & np.array([kind == (direction, boundary) for kind in kinds])
            measure = checked_measure(direction, "translation", cast(Boundary, boundary), "base")
            k, _, per_coordinate, per_gravity = self._arm.stiffnesses(
                table.pressures[rows], coordinates[:, 0], measure
            )
            value[rows] = (table.stiffness[rows] - k) / table.sigma[rows]
            change = per_coordinate @ by_history
            slope[rows, : len(coordinates)] = -change / table.sigma[rows, np.newaxis]
            if by_gravity is not None:
                slope[rows] -= per_gravity @ by_gravity / table.sigma[rows, np.newaxis]
        return value, slope


def _excess(robot: RobotDescription, before: RobotDescription) -> ca.SX:
    """Return penalties (n + s,) on a symbolic robot outside sensible bounds, in deviations.

    There are two bounds. The shares of each channel's history may not add up to the whole pressure.
    Pressures within the robot's limits may neither take nearly all of a segment's modulus nor, with
    an exponential law, raise it so far that more pressure would bend the arm less. No gain counts
    as smaller than `before`: that of a channel that was never driven would give way.
    """
    limits = iter(np.maximum(np.abs(robot.pressure_min), np.abs(robot.pressure_max)).tolist())
    memory, modulus = [], []
    for s, segment in enumerate(robot.segments):
        history, compensation = segment.history or NO_HISTORY, segment.compensation
        corrections = segment.corrections
        assert compensation is not None
        assert corrections is not None
        most = list(islice(limits, segment.n_channels))
        shares = ca.fmax(*history.shares) / history.left(math.hypot(*most))
        acting = []
        for c in range(segment.n_channels):
            memory.append((history.memory_of(c) * shares - FIT.most_memory) / FIT.memory_slack)
            known = Parameter(f"segments[{s}].corrections.gain[{c}]").value(before)
            gain = ca.fmax(known, corrections.gain[c])
            acting.append(gain * most[c] + ca.fabs(corrections.offset[c]))
        change = compensation.modulus_per_pressure * ca.norm_2(ca.vertcat(*acting))
        change = change / segment.material.youngs_modulus  # largest relative change of the modulus
        if compensation.modulus_law == "linear":
            excess = FIT.least_modulus - (1 + change)
        else:
            excess = ca.fmax(change - FIT.most_stiffening, -change - FIT.most_softening)
        modulus.append(excess / FIT.modulus_slack)
    return ca.fmax(ca.vertcat(*memory, *modulus), 0)


def _rounded(value: float) -> float:
    """Round to the digits of a robot file."""
    return float(f"{value:.7g}")
