"""Uncertainty of a calibrated arm's tip position and stiffness.

There are four independent sources: the parameters, whose covariance the calibration estimated; the
hysteresis, since at the same pressures the arm may rest anywhere between its loading and unloading
curves; the discrepancy between model and arm, which grows with the distance from recorded
pressures; and the residual that no parameter explained in the recordings.  All but the last are
propagated to the tip by their Jacobians, to first order; the discrepancy in its size alone, for it
may move the tip in any direction.  Together they follow a multivariate t-distribution.

Hysteresis is bounded: no play operator was ever dragged beyond the robot's pressure
limits, so less hysteresis is possible near the limits than between them.  Its mean square is
that of effective minus commanded pressures as recorded, and at most that of a uniform distribution
between the bounds, about the equilibrium, which is what `tip_pose` returns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import InputError
from stiffopt.model.arguments import checked_measure
from stiffopt.model.calibration import Calibration, even_variance, fading_mean, squared_moves
from stiffopt.model.compliance import Boundary, Frame, Kind
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import NO_HISTORY, History, part_of
from stiffopt.model.parameters import Parameter
from stiffopt.model.parametric import ParametricArm

Vector = NDArray[np.float64]
Part = Literal["parameters", "hysteresis", "discrepancy", "residual"]

_LEVEL = 0.95  # probability of the reported regions
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

    parameters: Vector
    hysteresis: Vector
    discrepancy: Vector
    residual: Vector
    inside: bool
    extrapolation: str
    _source: Uncertainty
    _pressures: Vector

    @property
    def covariance(self) -> Vector:
        """Mean square (3, 3) of the position's error in base axes, in m^2."""
        return np.asarray(self.parameters + self.hysteresis + self.discrepancy + self.residual)

    @cached_property
    def semi_axes(self) -> Vector:
        """Half lengths (3,) of the 95 % ellipsoid about `tip_pose` in m, the longest first."""
        return self.semi_axes_at(_LEVEL)

    def semi_axes_at(self, level: float) -> Vector:
        """Return half lengths (3,) in m of the ellipsoid that holds the tip with a probability."""
        if not 0 < level < 1:
            raise InputError(f"a probability lies between 0 and 1, both excluded; got {level!r}")
        values = np.linalg.eigvalsh(self.covariance)[::-1]
        factor = squared_radius(level, self._source.degrees_of_freedom)
        return np.asarray(np.sqrt(factor * np.maximum(values, 0.0)))

    @cached_property
    def axes(self) -> Vector:
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
    """Errors of predictions of the tip's position.

    Attributes
    ----------
    position : predicted (N, 3), in base axes and m.
    parameters, hysteresis, discrepancy, residual : mean squares (N, 3, 3) of its error by source,
        as in `TipUncertainty`; hysteresis includes that of the time at which the tip moves.
    """

    position: Vector
    parameters: Vector
    hysteresis: Vector
    discrepancy: Vector
    residual: Vector

    @property
    def covariance(self) -> Vector:
        """Sum of all sources (N, 3, 3)."""
        return np.asarray(self.parameters + self.hysteresis + self.discrepancy + self.residual)


class Uncertainty:
    """Uncertainties of a calibrated robot.

    Parameters
    ----------
    description : with a calibration.
    tip_load : load on the tip, as in `Manipulator.tip_load`.

    Raises
    ------
    InputError
        The robot was not calibrated.
    """

    def __init__(
        self, description: RobotDescription, tip_load: Sequence[float] = (0.0,) * 12
    ) -> None:
        if description.calibration is None:
            raise InputError(
                f"robot '{description.name}' was not calibrated, so that nothing is known of its "
                "errors; fit it to recordings with 'stiffopt calibrate'"
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

    @property
    def degrees_of_freedom(self) -> float:
        """Degrees of freedom of the errors' t-distribution; infinite if it is normal."""
        errors = self._calibration.errors
        return np.inf if errors is None else errors.degrees_of_freedom

    def at(self, pressures: Vector, *, moving: bool = False) -> TipUncertainty:
        """Return the uncertainty at commanded pressures (n,), held or `moving`; history unknown."""
        p = pressures[np.newaxis]
        found = self.errors(p, moving=np.array([moving]))
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
        )

    def errors(
        self,
        pressures: Vector,
        *,
        effective: Vector | None = None,
        rates: Vector | None = None,
        time: Vector | None = None,
        moving: NDArray[np.bool_] | None = None,
    ) -> PositionErrors:
        """Return the errors of predictions.

        Parameters
        ----------
        pressures : commanded (N, n), in Pa.
        effective, time : effective pressures (N, n) in Pa after a known history, and their times
            (N,) in s, increasing; without these the prediction is `tip_pose` at the commanded ones.
        rates : time derivatives (N, n) of the effective pressures, in Pa/s; zero by default.
        moving : which rows (N,) are not held; none by default.
        """
        u = pressures if effective is None else effective
        position, per_number, per_pressure = self._slopes.at(u)
        transposed = np.swapaxes(per_pressure, 1, 2)
        acting = np.zeros_like(pressures)
        if effective is None:
            still = moving if moving is not None else np.zeros(len(pressures), dtype=bool)
            acting = self._hysteresis(pressures, still)
        moves = squared_moves(per_pressure, self._discrepancy(u))
        before = self._typical_moves if time is None else fading_mean(time, moves)
        errors = self._calibration.errors
        residual = self._calibration.position_residual if errors is None else errors.residual
        hysteresis = (per_pressure * acting[:, np.newaxis]) @ transposed
        if rates is not None and errors is not None:
            way = errors.timing * per_pressure @ rates[..., np.newaxis]
            hysteresis = hysteresis + way @ np.swapaxes(way, 1, 2)
        return PositionErrors(
            position=position,
            parameters=per_number @ self._covariance @ np.swapaxes(per_number, 1, 2),
            hysteresis=hysteresis,
            discrepancy=even_variance(moves, before, self._memory)[:, np.newaxis, np.newaxis]
            * np.eye(3),
            residual=np.broadcast_to(np.eye(3) * residual**2, (len(u), 3, 3)),
        )

    def levels(self, errors: Vector, covariance: Vector) -> Vector:
        """Return the probability (N,) of the smallest regions that hold errors (N, 3)."""
        return levels(errors, covariance, self.degrees_of_freedom)

    def stiffness_interval(
        self, pressures: Vector, direction: ArrayLike, kind: Kind, boundary: Boundary, frame: Frame
    ) -> tuple[float, float]:
        """See `TipUncertainty.stiffness_interval`."""
        measure = checked_measure(direction, kind, boundary, frame)
        p = pressures[np.newaxis]
        k, per_pressure, per_coordinate = self._slopes.arm.stiffnesses(
            p, self._slopes.rest, measure
        )
        g, h = per_coordinate[0] / k[0], per_pressure[0] / k[0]
        size = len(g)
        acting = self._hysteresis(p, np.zeros(1, dtype=bool)) + self._discrepancy(p)
        variance = g @ self._covariance[:size, :size] @ g + h**2 @ acting[0]
        deviation = float(np.sqrt(max(variance, 0.0)))
        return float(k[0] * np.exp(-NORMAL_QUANTILE * deviation)), float(
            k[0] * np.exp(NORMAL_QUANTILE * deviation)
        )

    def _discrepancy(self, pressures: Vector) -> Vector:
        """Return variances (N, n) of the effective pressures due to the discrepancy, in Pa^2."""
        errors = self._calibration.errors
        if errors is None:
            return np.zeros_like(pressures)
        return errors.variances(self._channels, pressures)

    @cached_property
    def _memory(self) -> Vector:
        """Shares (n,) of the channels' pressures that act through hysteresis."""
        shares = [
            (segment.history or NO_HISTORY).remembered_shares(segment.n_channels)
            for segment in self._description.segments
        ]
        return np.concatenate(shares)

    @cached_property
    def _typical_moves(self) -> Vector:
        """Mean squares (n,) by which the discrepancy moves the tip within the limits, in m^2."""
        low, high = np.array([self._description.pressure_min, self._description.pressure_max])
        shares = np.array(list(product((0.25, 0.75), repeat=max(self._channels))))
        places = np.concatenate([np.arange(channels) for channels in self._channels])
        pressures = low + shares[:, places] * (high - low)
        _, _, per_pressure = self._slopes.at(pressures)
        moves = squared_moves(per_pressure, self._discrepancy(pressures))
        return np.asarray(moves.mean(axis=0))

    def _hysteresis(self, pressures: Vector, moving: NDArray[np.bool_]) -> Vector:
        """Return mean squares (N, n) of effective minus commanded pressures (N, n), in Pa^2."""
        bounds = np.array([self._even(row) for row in pressures])
        errors = self._calibration.errors
        if errors is None:
            return bounds
        if errors.settled:
            bounds = np.minimum(bounds, np.square(errors.settled))
        if errors.moving:
            bounds[moving] = np.maximum(bounds, np.square(errors.moving))[moving]
        return bounds

    def _even(self, pressures: Vector) -> Vector:
        """Return mean squares (n,) if all effective pressures are equally likely, in Pa^2."""
        robot, first, found = self._description, 0, []
        limits = np.array([robot.pressure_min, robot.pressure_max])
        for segment in robot.segments:
            own = slice(first, first := first + segment.n_channels)
            p = pressures[own]
            ends = settled_range(segment.history or NO_HISTORY, p, *limits[:, own])
            low, high = np.subtract(ends, p)
            found.append((low**2 + low * high + high**2) / 3)
        return np.concatenate(found)


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
        given = description.recordings
        self._sensor = np.zeros(3)
        if given is not None:
            self._sensor = given.registration.tip_in_sensor.inverse()[:3, 3]

    def at(self, pressures: Vector) -> tuple[Vector, Vector, Vector]:
        """Return tip positions (N, 3) at effective pressures (N, n), and slopes of the sensor's.

        The slopes are (N, 3, k + frames) by the numbers and (N, 3, n) per Pa; all in base axes and
        m.
        """
        found = self.arm.poses(pressures, self.rest)
        rotation, tip = found.transforms[:, :3, :3], found.transforms[:, :3, 3]

        def moved(twists: Vector) -> Vector:  # of the sensor, in base axes
            return np.asarray(rotation @ (twists[:, :3] - _skew(self._sensor) @ twists[:, 3:]))

        per_number = [moved(found.per_coordinate)]
        if self._frames:
            shifted = np.broadcast_to(np.eye(3), rotation.shape)
            per_number += [shifted, -_skew(tip + rotation @ self._sensor)]
        if self._frames == 12:
            per_number += [rotation, -rotation @ _skew(self._sensor)]
        return tip, np.concatenate(per_number, axis=2), moved(found.per_pressure)


def _skew(vectors: Vector) -> Vector:
    """Return matrices (..., 3, 3) of the cross products with vectors (..., 3)."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    o = np.zeros_like(x)
    rows = [np.stack(row, axis=-1) for row in ((o, -z, y), (z, o, -x), (-y, x, o))]
    return np.stack(rows, axis=-2)


def squared_radius(level: float, degrees_of_freedom: float) -> float:
    """Return the squared Mahalanobis radius of a region of this probability, in 3D.

    The covariance of a t-distribution with v degrees of freedom is v / (v - 2) times its scale
    matrix, so the squared distance by the covariance is (v - 2) / v times 3 F(3, v).
    """
    from scipy.special import chdtri, fdtri

    v = degrees_of_freedom
    if np.isinf(v):
        return float(chdtri(3, 1 - level))
    return float(3 * (v - 2) / v * fdtri(3, v, level))


def levels(errors: Vector, covariance: Vector, degrees_of_freedom: float) -> Vector:
    """Return the probability (N,) of the smallest regions that hold errors (N, 3).

    Regions are ellipsoids of the covariances (N, 3, 3).
    """
    from scipy.special import chdtr, fdtr

    v = degrees_of_freedom
    squares = np.einsum(
        "ni,ni->n", errors, np.linalg.solve(covariance, errors[..., np.newaxis])[..., 0]
    )
    if np.isinf(v):
        return np.asarray(chdtr(3, squares))
    return np.asarray(fdtr(3, v, squares * v / (3 * (v - 2))))


def settled_range(
    history: History, pressures: Vector, low: Vector, high: Vector, first: int = 0
) -> tuple[Vector, Vector]:
    """Return the least and largest possible effective pressures (c,) at rest, in Pa.

    The arm began at rest without pressure; commands since then are known only to lie within the
    limits.

    Parameters
    ----------
    history : of the channels' segment.
    pressures : of all of its channels (c,), in Pa.
    low, high : limits (c,), in Pa.
    first : index of the first of these channels in the segment.
    """
    low, high = np.minimum(low, np.minimum(pressures, 0)), np.maximum(high, pressures)
    high = np.maximum(high, 0)
    memory = np.array([history.memory_of(first + c) for c in range(len(pressures))])
    lowest, highest = pressures.astype(float), pressures.astype(float)
    for play in history.play:
        projection = part_of(np.eye(len(pressures)), play.of)
        forward, backward = np.maximum(projection, 0), np.minimum(projection, 0)
        x, farthest = projection @ pressures, forward @ high + backward @ low
        nearest = forward @ low + backward @ high
        # the operator is dragged down to low + width and up to high - width; it began at zero
        under = np.maximum(x - play.width, np.minimum(nearest + play.width, 0)) - x
        over = np.minimum(x + play.width, np.maximum(farthest - play.width, 0)) - x
        lowest = lowest + memory * play.share * (forward @ under + backward @ over)
        highest = highest + memory * play.share * (forward @ over + backward @ under)
    return lowest, highest
