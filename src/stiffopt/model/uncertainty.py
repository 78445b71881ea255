"""Uncertainty of a calibrated arm's tip position and stiffness.

There are four independent sources: the parameters, whose covariance the calibration estimated; the
hysteresis, since at the same pressures the arm may rest anywhere between its loading and unloading
curves; the discrepancy between model and arm, which grows with the distance from recorded
pressures; and the residual that no parameter explained in the recordings.  All but the last are
propagated to the tip by their Jacobians, to first order; the discrepancy in its size alone, for it
may move the tip in any direction.  Together they follow a multivariate t-distribution.

Hysteresis depends on how the arm came to its pressures.  Its mean square, about the equilibrium,
which is what `tip_pose` returns, is that over ways from rest to pressures drawn from the recorded
range, and from there; but at most that of effective minus commanded pressures as recorded.
While pressures change, a lag is added.  It is along the ways to the pressures, in each channel as
large as these are long, and at least such that both are as recorded.  Near rest all chambers fill
or empty together, which moves the tip along the arm; amid the range they lag independently.
Plays lead through two drawn pressures.  Creep goes on while pressures are held: a way stays for
6 s at each of three drawn ones, and at its end for 1.5 to 6 s, or for as long as is known.  It
begins at the mean of the drawn pressures and of rest, which takes a seventh of the time, as in the
rounds of an experiment: slow creep remembers longer than the way lasts.  The tip moves by the
slopes half the mean of all ways further: at the pressures themselves, a chamber may be in its dead
band.

With creep in the model, what it remembers moves the tip by a tenth more or less than it says, in
any direction; so it does where the history is known, by a twentieth if strain is remembered.

A model without creep knows less of the memory.  Silicone remembers its stretch rather than
pressures: the tip is about as far from the equilibrium where the arm is soft as where it is stiff.
And what such a fit calls hysteresis is partly creep, which is over where a pose is held.

Most of these ways leave the arm away from the equilibrium, most play operators at an end of their
width.  Therefore the squared distance of the tip, in deviations of the region, is distributed
as 3 F(k, v) with k > 3 degrees of freedom, such that its variance is right (F. E. Satterthwaite, An
approximate distribution of estimates of variance components, 1946); without hysteresis, k = 3.
The ways are bounded: where the model has creep, v is larger than that of the other errors, such
that the mean fourth power of the tail is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array, Flags
from stiffopt.errors import InputError
from stiffopt.model.arguments import checked_measure
from stiffopt.model.calibration import Calibration, squared_moves
from stiffopt.model.compliance import Boundary, Frame, Kind
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import NO_HISTORY, part_of
from stiffopt.model.parameters import Parameter
from stiffopt.model.parametric import ParametricArm
from stiffopt.model.remembered_errors import RememberedErrors

Part = Literal["parameters", "hysteresis", "discrepancy", "residual"]

_LEVEL = 0.95  # probability of the reported regions
_WAYS = 256  # ways to given pressures
_VISITS = 3  # pressures that each of them visits
_STAY = 6.0  # s from one of them to the next
_AT_REST = 1 / 7  # share of the time before a way that the arm was at rest
_AGES = (1.5, 6.0)  # s for which the given pressures have been held, from the middle of the motion
_MOTION = 0.8  # s from the middle of a motion to its end
_HELD = 0.9  # share of these variances that held poses show; the rest was creep and motion
_MISREMEMBERED = 0.1  # error of what a model with creep remembers, over how far it moves the tip
_MISREMEMBERED_STRAIN = 0.05  # the same where the history is known and strain is remembered
_STIFFEST = 0.25  # least softness, over that at recorded pressures: a dead band has none
_LEAST_SPAN = 0.1  # least recorded range of a channel that scales its ways, over the largest
_SINGULAR = 1e-9  # smallest variance of a direction, over that of all
NORMAL_QUANTILE = 1.959963984540054  # of 97.5 %, for two-sided intervals of 95 %


@dataclass(frozen=True, eq=False)
class TipUncertainty:
    """Uncertainty of the tip's position and stiffness at some pressures.

    Attributes
    ----------
    parameters, hysteresis, discrepancy, residual : ndarray
        Mean squares (3, 3) of the error of `Manipulator.tip_pose`'s position in base axes, in m^2,
        due to the parameters' errors, to hysteresis, to model errors far from recorded pressures,
        and to what the calibration left unexplained.
    inside : bool
        Whether the calibration saw such pressures; outside, the model extrapolates.
    extrapolation : str
        A sentence about that, with the distance to the nearest recorded pressures, or "".
    """

    parameters: Array
    hysteresis: Array
    discrepancy: Array
    residual: Array
    inside: bool
    extrapolation: str
    _source: Uncertainty
    _pressures: Array
    _shape: float
    _tail: float

    @property
    def covariance(self) -> Array:
        """Mean square (3, 3) of the position's error in base axes, in m^2."""
        return np.asarray(self.parameters + self.hysteresis + self.discrepancy + self.residual)

    @cached_property
    def semi_axes(self) -> Array:
        """Half lengths (3,) of the 95 % ellipsoid about `tip_pose` in m, the longest first."""
        return self.semi_axes_at(_LEVEL)

    def semi_axes_at(self, level: float) -> Array:
        """Return half lengths (3,) in m of the ellipsoid that holds the tip with a probability."""
        if not 0 < level < 1:
            raise InputError(f"a probability lies between 0 and 1, both excluded; got {level!r}")
        values = np.linalg.eigvalsh(self.covariance)[::-1]
        factor = squared_radius(level, self._tail, self._shape)
        return np.asarray(np.sqrt(factor * np.maximum(values, 0.0)))

    @cached_property
    def axes(self) -> Array:
        """Unit vectors (3, 3) of the ellipsoid as columns, in base axes, as in `semi_axes`."""
        return np.asarray(np.linalg.eigh(self.covariance)[1][:, ::-1])

    @property
    def largest_part(self) -> Part:
        """The source of most of the error's mean square."""
        parts: dict[Part, float] = {
            "parameters": float(np.trace(self.parameters)),
            "hysteresis": float(np.trace(self.hysteresis)),
            "discrepancy": float(np.trace(self.discrepancy)),
            "residual": float(np.trace(self.residual)),
        }
        return max(parts, key=lambda part: parts[part])

    def stiffness_interval(
        self,
        direction: ArrayLike,
        kind: Kind = "translation",
        boundary: Boundary = "free",
        frame: Frame = "base",
    ) -> tuple[float, float]:
        """Return the 95 % interval of a directional stiffness, in N/m or N m/rad.

        It is due to errors of the parameters and of the effective pressures, on a logarithmic
        scale, to first order. It contains `Manipulator.stiffness`, which explains the arguments.
        """
        return self._source.stiffness_interval(self._pressures, direction, kind, boundary, frame)


@dataclass(frozen=True, eq=False)
class PositionErrors:
    """Errors of predictions of the tip's position."""

    position: Array  # predicted (N, 3), in base axes and m
    # parameters, hysteresis, discrepancy, residual: mean squares (N, 3, 3) of its error by source,
    # as in `TipUncertainty`; hysteresis includes that of the time at which the tip moves. After a
    # known history it is this, and with creep in the model the error of what is remembered
    parameters: Array
    hysteresis: Array
    discrepancy: Array
    residual: Array
    # shape, tail: degrees of freedom k and v (N,) of the error's squared distance. Unless the
    # history is unknown, k is 3 and v that of the calibration, which is infinite without a tail
    shape: Array
    tail: Array

    @property
    def covariance(self) -> Array:
        """Sum of all sources (N, 3, 3)."""
        return np.asarray(self.parameters + self.hysteresis + self.discrepancy + self.residual)


class Uncertainty:
    """Uncertainties of a calibrated robot.

    `description`: with a calibration. `tip_load`: load on the tip, as in `Manipulator.tip_load`.
    Raises `InputError`: the robot was not calibrated.
    """

    def __init__(
        self, description: RobotDescription, tip_load: Sequence[float] = (0.0,) * 12
    ) -> None:
        if description.calibration is None:
            raise InputError(
                f"robot '{description.name}' was not calibrated, so its errors are unknown; fit it "
                "to recordings with 'stiffopt calibrate'"
            )
        self._description = description
        self._channels = [segment.n_channels for segment in description.segments]
        self._calibration: Calibration = description.calibration
        self._slopes = ReadingSlopes(
            description,
            [Parameter(fitted.key) for fitted in self._calibration.parameters],
            len(self._calibration.frames),
            tip_load,
        )
        self._covariance = self._calibration.covariance

    def at(
        self, pressures: Array, *, moving: bool = False, held: float | None = None
    ) -> TipUncertainty:
        """Return the uncertainty at commanded pressures (n,), history unknown.

        They are `moving`, or have been `held` for a time in s, where that is known.
        """
        if held is not None and (moving or not held >= 0):
            raise InputError(
                f"pressures that are held have been so for 0 s or longer; got {held!r}"
                + (", and that they move" if moving else "")
            )
        p = pressures[np.newaxis]
        times = np.array([np.nan if held is None else held])
        found = self.errors(p, moving=np.array([moving]), held=times)
        extrapolation = self._description.extrapolation(pressures)
        return TipUncertainty(
            parameters=found.parameters[0],
            hysteresis=found.hysteresis[0],
            discrepancy=found.discrepancy[0],
            residual=found.residual[0],
            inside=not extrapolation,
            extrapolation=extrapolation,
            _source=self,
            _pressures=pressures,
            _shape=float(found.shape[0]),
            _tail=float(found.tail[0]),
        )

    def errors(
        self,
        pressures: Array,
        *,
        effective: Array | None = None,
        rates: Array | None = None,
        time: Array | None = None,
        moving: Flags | None = None,
        held: Array | None = None,
    ) -> PositionErrors:
        """Return the errors of predictions.

        Parameters
        ----------
        pressures : commanded (N, n), in Pa.
        effective, time : effective pressures (N, n) in Pa after a known history, and their times
            (N,) in s, increasing; without these the prediction is `tip_pose` at the commanded ones.
        rates : time derivatives (N, n) of the effective pressures, in Pa/s; zero by default.
        moving : which rows (N,) are not held; none by default.
        held : times (N,) in s for which pressures have been held; NaN, as by default, if unknown.
        """
        u = pressures if effective is None else effective
        position, per_number, per_pressure = self._slopes.at(u)
        moves = squared_moves(per_pressure, self._discrepancy(u))
        before = self._memory.before(time, moves) if time is not None else self._before_unknown
        errors = self._calibration.errors
        residual = self._calibration.position_residual if errors is None else errors.residual
        discrepancy = self._memory.even_variance(moves, before)
        if effective is None:
            moved = moving if moving is not None else np.zeros(len(pressures), dtype=bool)
            ways = self._remembered(pressures, per_pressure, held)
            acting = per_pressure
            if self._knows_creep:
                _, _, acting = self._slopes.at(pressures + ways.mean(axis=1) / 2)
            transposed = np.swapaxes(acting, 1, 2)
            squares = np.swapaxes(ways, 1, 2) @ ways / _WAYS
            squares[moved] += self._lag(pressures[moved], squares[moved])
            hysteresis = acting @ squares @ transposed
            ways = ways @ transposed
            discrepancy *= np.where(moved, 1.0, _HELD)
        else:
            late = 0.0 if rates is None else self._delays * rates
            ways = (effective - pressures + late)[:, np.newaxis] @ np.swapaxes(per_pressure, 1, 2)
            hysteresis = np.zeros((len(u), 3, 3))
        if self._description.creeps:
            known = effective is not None and self._description.remembers_strain
            share = _MISREMEMBERED_STRAIN if known else _MISREMEMBERED
            missed = share**2 * (ways**2).sum(axis=2).mean(axis=1) / 3
            hysteresis = hysteresis + missed[:, np.newaxis, np.newaxis] * np.eye(3)
        if rates is not None and errors is not None:
            way = errors.timing * per_pressure @ rates[..., np.newaxis]
            hysteresis = hysteresis + way @ np.swapaxes(way, 1, 2)
        found = PositionErrors(
            position=position,
            parameters=per_number @ self._covariance @ np.swapaxes(per_number, 1, 2),
            hysteresis=hysteresis,
            discrepancy=discrepancy[:, np.newaxis, np.newaxis] * np.eye(3),
            residual=np.broadcast_to(np.eye(3) * residual**2, (len(u), 3, 3)),
            shape=np.full(len(u), 3.0),
            tail=np.full(len(u), np.inf if errors is None else errors.degrees_of_freedom),
        )
        if effective is not None:
            return found
        shape, unbounded = _shape(ways, found.covariance)
        tail = found.tail
        if self._knows_creep:
            tail = tail + np.maximum(tail - 4, 0.0) * (1 / np.maximum(unbounded, 1e-3) - 1)
        return replace(found, shape=shape, tail=tail)

    def levels(self, errors: Array, known: PositionErrors) -> Array:
        """Return the probability (N,) of the smallest regions that hold errors (N, 3)."""
        return levels(errors, known.covariance, known.tail, known.shape)

    def stiffness_interval(
        self, pressures: Array, direction: ArrayLike, kind: Kind, boundary: Boundary, frame: Frame
    ) -> tuple[float, float]:
        """See `TipUncertainty.stiffness_interval`."""
        measure = checked_measure(direction, kind, boundary, frame)
        p = pressures[np.newaxis]
        k, per_pressure, per_coordinate, _ = self._slopes.arm.stiffnesses(
            p, self._slopes.rest, measure
        )
        g, h = per_coordinate[0] / k[0], per_pressure[0] / k[0]
        size = len(g)
        ways = self._remembered(p, self._slopes.at(p)[2])
        acting = ways[0].T @ ways[0] / _WAYS
        variance = g @ self._covariance[:size, :size] @ g
        variance += h @ acting @ h + h**2 @ self._discrepancy(p)[0]
        deviation = float(np.sqrt(max(variance, 0.0)))
        return float(k[0] * np.exp(-NORMAL_QUANTILE * deviation)), float(
            k[0] * np.exp(NORMAL_QUANTILE * deviation)
        )

    def _discrepancy(self, pressures: Array) -> Array:
        """Return variances (N, n) of the effective pressures due to the discrepancy, in Pa^2."""
        errors = self._calibration.errors
        if errors is None:
            return np.zeros_like(pressures)
        return errors.variances(self._channels, pressures)

    @cached_property
    def _memory(self) -> RememberedErrors:
        """How far the arm answers to the discrepancy at former pressures."""
        errors = self._calibration.errors
        return RememberedErrors.of(self._description, 0.0 if errors is None else errors.range)

    @cached_property
    def _delays(self) -> Array:
        """Times (n,) in s by which the channels' pressures act late, at an even speed."""
        histories = [segment.history or NO_HISTORY for segment in self._description.segments]
        return np.repeat([each.dead_time + each.lag for each in histories], self._channels)

    @cached_property
    def _before_unknown(self) -> Array:
        """Mean squares (n,), in m^2, by which the discrepancy at former pressures moves the tip.

        These are anywhere within the limits.
        """
        low, high = np.array([self._description.pressure_min, self._description.pressure_max])
        shares = np.array(list(product((0.25, 0.75), repeat=max(self._channels))))
        places = np.concatenate([np.arange(channels) for channels in self._channels])
        pressures = low + shares[:, places] * (high - low)
        _, _, per_pressure = self._slopes.at(pressures)
        moves = squared_moves(per_pressure, self._discrepancy(pressures))
        return self._memory.before_unknown(moves.mean(axis=0))

    def _lag(self, pressures: Array, squares: Array) -> Array:
        """Return mean squares (N, n, n), in Pa^2, of the lag behind pressures (N, n) that change.

        Those of effective minus commanded pressures are `squares` (N, n, n) without it. It is along
        the ways to the pressures from others, drawn from the recorded range; their mean square
        within that range is a sixth of its square. Where the ways of a channel are shorter, the
        rest of what was recorded is independent of the other channels.
        """
        errors = self._calibration.errors
        if errors is None or not errors.moving:
            return np.zeros_like(squares)
        more = np.square(errors.moving) - np.einsum("nii->ni", squares)
        lag = np.sqrt(np.maximum(more, 0.0))
        low, high = self._range
        span = high - low
        unit = np.maximum(span, _LEAST_SPAN * span.max())
        mean = (pressures - (low + high) / 2) / unit
        along = 6 * mean[:, :, np.newaxis] * mean[:, np.newaxis]
        channels = np.arange(len(span))
        spread = np.maximum((span / unit) ** 2 / 2, 1 - along[:, channels, channels])
        along[:, channels, channels] += spread
        return np.asarray(lag[:, :, np.newaxis] * lag[:, np.newaxis] * along)

    def _remembered(
        self, pressures: Array, per_pressure: Array, held: Array | None = None
    ) -> Array:
        """Return effective minus commanded pressures (N, W, n) in Pa after W ways to (N, n).

        `per_pressure` are the tip's slopes (N, 3, n) there. Without creep in the model, the ways
        leave the tip about as far away at all pressures, though a pressure moves it further where
        the arm is soft. At the median of the recorded pressures they are those of the plays.
        """
        found, crept = self._ways(pressures, held)
        if self._calibration.errors is None:
            return found
        if self._knows_creep:
            return found + crept * self._creep_left
        softness = self._softness(per_pressure) / self._recorded_softness
        found *= np.sqrt(_HELD / np.maximum(softness, _STIFFEST))[:, np.newaxis]
        return found

    def _ways(self, pressures: Array, held: Array | None = None) -> tuple[Array, Array]:
        """Return what plays and what creep leave after W ways to pressures (N, n): (N, W, n).

        They have been held for the given times (N,) in s; for drawn ones where that is NaN.
        """
        robot, first = self._description, 0
        ages = self._ages
        if held is not None:
            held = held[:, np.newaxis]
            ages = np.where(np.isnan(held), ages, _MOTION + held)
        found = np.zeros((len(pressures), _WAYS, robot.n_pressures))
        crept = np.zeros_like(found)
        for segment in robot.segments:
            own = slice(first, first := first + segment.n_channels)
            history, x = segment.history or NO_HISTORY, pressures[:, np.newaxis, own]
            memory = np.array([history.memory_of(c) for c in range(segment.n_channels)])
            ways, here = history.followed(self._visited[..., own]), history.followed(x)
            for play in history.play:
                end, held = part_of(here, play.of), np.zeros(1)
                for visited in (*part_of(ways[-2:], play.of), end):
                    held = np.clip(held, visited - play.width, visited + play.width)
                found[..., own] += memory * play.share * part_of(held - end, play.of)
            for creep in history.creep:
                poses = part_of(ways, creep.of)
                slow = (1 - _AT_REST) * poses.mean(axis=(0, 1))
                for visited in poses:
                    slow = visited + (slow - visited) * np.exp(-_STAY / creep.time)
                left = np.exp(-ages / creep.time)[..., np.newaxis]
                slow = part_of(slow - part_of(here, creep.of), creep.of)
                crept[..., own] += memory * creep.share * left * slow
            for each in (found, crept):
                each[..., own] = history.with_memory(here, each[..., own]) - x
        errors = self._calibration.errors
        if errors is not None and errors.settled:
            size = np.sqrt(np.mean(found**2, axis=1, keepdims=True))
            found *= np.minimum(1.0, errors.settled / np.maximum(size, 1e-9))
        return found, crept

    @cached_property
    def _creep_left(self) -> Array:
        """Share (n,) of the ways' creep that was left at held pressures, as recorded; at most 1.

        With it, plays and creep have the mean square of `ErrorModel.settled` at recorded pressures:
        pressures may have been held for longer than on the ways.
        """
        errors = self._calibration.errors
        assert errors is not None  # a caller's condition
        found, crept = self._ways(np.array(errors.recorded))
        a, b, c = (np.mean(each, axis=(0, 1)) for each in (crept**2, found * crept, found**2))
        missing = np.maximum(np.square(errors.settled) - c, 0.0)
        share = (np.sqrt(b**2 + a * missing) - b) / np.maximum(a, 1e-9)
        return np.asarray(np.clip(share, 0.0, 1.0))

    def _softness(self, per_pressure: Array) -> Array:
        """Return the squared slopes (N, n) of the tip by all pressures of a channel's segment."""
        ends = np.cumsum([0, *self._channels])
        squares = [(per_pressure[..., a:b] ** 2).sum(axis=(1, 2)) for a, b in pairwise(ends)]
        return np.repeat(np.stack(squares, axis=1), self._channels, axis=1)

    @cached_property
    def _recorded_softness(self) -> Array:
        """Median (n,) of `_softness` over the recorded pressures."""
        errors = self._calibration.errors
        assert errors is not None  # a caller's condition
        _, _, per_pressure = self._slopes.at(np.array(errors.recorded))
        return np.asarray(np.median(self._softness(per_pressure), axis=0))

    @cached_property
    def _knows_creep(self) -> bool:
        """Whether the model describes creep and the recordings contain held pressures."""
        errors = self._calibration.errors
        return errors is not None and bool(errors.settled) and self._description.creeps

    @cached_property
    def _ages(self) -> Array:
        """Times (W,) in s for which pressures are held at the ends of the ways, if unknown."""
        strata = (np.arange(_WAYS) + 0.5) / _WAYS
        return np.asarray(np.interp(np.random.default_rng(1).permuted(strata), (0, 1), _AGES))

    @cached_property
    def _range(self) -> tuple[Array, Array]:
        """Lowest and highest pressures (n,) in Pa between which the ways begin: those recorded."""
        known, robot = self._calibration, self._description
        low = known.pressure_min or robot.pressure_min
        high = known.pressure_max or robot.pressure_max
        return np.array(low), np.array(high)

    @cached_property
    def _visited(self) -> Array:
        """Pressures (_VISITS, W, n) in Pa that the ways visit in turn."""
        low, high = self._range
        strata = np.tile((np.arange(_WAYS) + 0.5) / _WAYS, (_VISITS, len(low), 1))
        shares = np.random.default_rng(0).permuted(strata, axis=2)  # a Latin hypercube
        return np.asarray(low + np.swapaxes(shares, 1, 2) * (high - low))


class ReadingSlopes:
    """Tip position and the derivatives of the tracker's reading by a calibration's numbers.

    Parameters
    ----------
    description : RobotDescription
    parameters : of the robot file, k in number.
    frames : 0, 6 (twist of the base in the tracker's frame) or 12 (and of the sensor on the tip).
    tip_load : as in `ParametricArm`.
    """

    def __init__(
        self,
        description: RobotDescription,
        parameters: Sequence[Parameter],
        frames: int = 0,
        tip_load: Sequence[float] = (0.0,) * 12,
    ) -> None:
        self.arm = ParametricArm(description, parameters, tip_load)
        self.rest = np.zeros(len(parameters))
        self._frames = frames
        self._gravity = np.array(description.gravity) * description.has_known_vertical
        given = description.recordings
        self._sensor = np.zeros(3)
        if given is not None:
            self._sensor = given.registration.tip_in_sensor.inverse()[:3, 3]

    def at(self, pressures: Array) -> tuple[Array, Array, Array]:
        """Return tip positions (N, 3) at effective pressures (N, n), and slopes of the sensor's.

        The slopes are (N, 3, k + frames) by the numbers and (N, 3, n) per Pa; all in base axes and
        m.
        """
        found = self.arm.poses(pressures, self.rest)
        rotation, tip = found.transforms[:, :3, :3], found.transforms[:, :3, 3]

        def moved(twists: Array) -> Array:  # of the sensor, in base axes
            return np.asarray(rotation @ (twists[:, :3] - _skew(self._sensor) @ twists[:, 3:]))

        per_number = [moved(found.per_coordinate)]
        if self._frames:
            shifted = np.broadcast_to(np.eye(3), rotation.shape)
            turned = -_skew(tip + rotation @ self._sensor)
            # the weight keeps its direction in the tracker's frame
            turned = turned + moved(found.per_gravity @ _skew(self._gravity))
            per_number += [shifted, turned]
        if self._frames == 12:
            per_number += [rotation, -rotation @ _skew(self._sensor)]
        return tip, np.concatenate(per_number, axis=2), moved(found.per_pressure)


def _skew(vectors: Array) -> Array:
    """Return matrices (..., 3, 3) of the cross products with vectors (..., 3)."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    o = np.zeros_like(x)
    rows = [np.stack(row, axis=-1) for row in ((o, -z, y), (z, o, -x), (-y, x, o))]
    return np.stack(rows, axis=-2)


def _shape(moves: Array, covariance: Array) -> tuple[Array, Array]:
    """Return k (N,) for which 3 chi^2(k) / k has the variance of the squared distances of errors.

    An error is one of the moves (N, W, 3), equally likely, and an independent normal error; both
    together have the mean squares `covariance` (N, 3, 3). Return also the share (N,) of the mean
    fourth power of a normal error that the latter contributes: a tail of it counts by that.
    """
    least = _SINGULAR * np.trace(covariance, axis1=1, axis2=2) + np.finfo(float).tiny
    squared, axes = np.linalg.eigh(covariance)
    deviations = np.sqrt(np.maximum(squared, least[:, np.newaxis]))
    moves = moves @ axes / deviations[:, np.newaxis]
    squares = (moves**2).sum(axis=2)
    bounded = np.swapaxes(moves, 1, 2) @ moves / moves.shape[1]
    rest = np.eye(3) - bounded
    variance = squares.var(axis=1) + np.einsum("nij,nji->n", 4 * bounded + 2 * rest, rest)
    trace, square = np.einsum("nii->n", rest), np.einsum("nij,nji->n", rest, rest)
    return np.asarray(18 / variance), np.asarray((trace**2 + 2 * square) / 15)


def squared_radius(level: float, degrees_of_freedom: float, shape: float = 3.0) -> float:
    """Return the squared Mahalanobis radius of a region of this probability, in 3D.

    The covariance of a t-distribution with v degrees of freedom is v / (v - 2) times its scale
    matrix, so the squared distance by the covariance is (v - 2) / v times 3 F(3, v), or 3 F(k, v)
    with the `shape` k of the errors.
    """
    from scipy.special import chdtri, fdtri

    v = degrees_of_freedom
    if np.isinf(v):
        return float(3 / shape * chdtri(shape, 1 - level))
    return float(3 * (v - 2) / v * fdtri(shape, v, level))


def levels(
    errors: Array,
    covariance: Array,
    degrees_of_freedom: float | Array,
    shape: float | Array = 3.0,
) -> Array:
    """Return the probability (N,) of the smallest regions that hold errors (N, 3).

    Regions are ellipsoids of the covariances (N, 3, 3); for the others see `squared_radius`.
    """
    from scipy.special import chdtr, fdtr

    v = degrees_of_freedom
    squares = np.einsum(
        "ni,ni->n", errors, np.linalg.solve(covariance, errors[..., np.newaxis])[..., 0]
    )
    if np.isinf(v).all():
        return np.asarray(chdtr(shape, squares * shape / 3))
    return np.asarray(fdtr(shape, v, squares * v / (3 * (v - 2))))
