"""Results of a calibration in a robot file: covariance of its numbers, and model of its errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from stiffopt.arrays import Array, Flags
from stiffopt.errors import shown
from stiffopt.schema import BadKeyError, Items, Schema
from stiffopt.units import Angle, Duration, Length, Number, Pressure, Ratio

_POSITIVE = Field(ge=0)
_ROUNDING = 1e-3  # of correlations, which are written with few digits
_NEAR = 0.1  # distance within which a pressure counts as recorded, over the recorded range
_KNOWN = 0.07  # error of what a recorded pressure tells of relative errors, in recorded ranges
_SLACK = 0.02  # allowed excess over recorded pressures, as a share of the highest


SIUnit = Literal["", "m", "rad", "Pa", "s"]


@dataclass(frozen=True)
class FittedNumber:
    """Properties of a kind of number in robot files that calibration needs to fit it.

    The fit varies a *coordinate* that is zero at the robot file's value: the logarithm of the
    ratio for a positive number, otherwise the difference.

    Attributes
    ----------
    words : readable name.
    unit : of the value, in SI; empty for a plain number.
    tolerance : standard deviation of the coordinate before the fit: relative for a positive number,
        otherwise in the unit of the value. Text is a key of the robot file's `tolerances`.
    positive : whether the coordinate is a logarithm; the fit must then start above zero.
    low, high : bounds of the value; ignored if `positive`.
    experiment : recordings that would determine the number, as the end of a sentence.
    """

    words: str
    unit: SIUnit
    tolerance: float | str
    positive: bool = False
    low: float = -math.inf
    high: float = math.inf
    experiment: str = ""


class FittedParameter(Schema):
    """A fitted number of the robot file, and its uncertainty.

    Attributes
    ----------
    key : its place in the file, for example ``segments[0].material.youngs_modulus``.
    deviation : standard deviation of its coordinate: relative for a positive number
        (modulus, length, gain, area, ...), otherwise in SI units.
    prior : the same before the calibration.
    """

    key: str
    deviation: Annotated[Number, _POSITIVE]
    prior: Annotated[Number, _POSITIVE]


class ErrorModel(Schema):
    """Model of the tip's prediction errors, near recorded pressures and far from them.

    The arm behaves as if its effective pressures were off by a discrepancy, a Gaussian process in
    the pressures of each segment, which moves the tip equally in all directions
    (`RememberedErrors`).  It has two independent parts.

    A rough part has the standard deviation `discrepancy` far from recorded pressures, and at a
    distance d from the nearest the variance ``discrepancy^2 (1 - exp(-2 d / reach))``.  A smooth
    part is a relative error that depends on the direction of the pressures: p and q have errors of
    covariance ``gain^2 |p| |q| cos(p, q)^4``.  It is conditioned on the recorded pressures, each of
    which tells it up to 0.07 `gain` R with the recorded range R; so it remains in directions that
    were not recorded.

    Attributes
    ----------
    residual : standard deviation of each axis of the tip at recorded pressures, in m.
    discrepancy : standard deviation of an effective pressure far from recorded ones, in Pa.
    reach : distance over which the discrepancy grows, in Pa.
    gain : relative error of the effect of pressures in directions that were not recorded.
    timing : standard deviation of the time at which the tip moves, in s; where it moves fast, the
        prediction with history is wrong along its way.
    degrees_of_freedom : of the multivariate t-distribution of the errors.
    settled, moving : root mean square of effective minus commanded pressure of each channel, in Pa,
        while pressures were held and while they changed; empty if that was not recorded.
    recorded : representative recorded pressures, in Pa, a row for each.
    spacing : largest distance of a recorded pressure from the nearest of these, in Pa.
    """

    residual: Annotated[Length, _POSITIVE]
    discrepancy: Annotated[Pressure, _POSITIVE]
    reach: Annotated[Pressure, Field(gt=0)]
    gain: Annotated[Ratio, _POSITIVE]
    timing: Annotated[Duration, _POSITIVE] = 0.0
    degrees_of_freedom: Annotated[Number, Field(gt=2)]
    settled: Items[Pressure] = ()
    moving: Items[Pressure] = ()
    recorded: Items[Items[Pressure]] = Field(min_length=1)
    spacing: Annotated[Pressure, _POSITIVE] = 0.0

    def distances(self, channels: Sequence[int], pressures: Array) -> Array:
        """Return the distance (N, segments) of pressures from the nearest recorded ones, in Pa.

        `channels`: number of channels of each segment. `pressures`: (N, n), in Pa.
        """
        found = distances_from(channels, pressures, np.array(self.recorded))
        return np.asarray(np.maximum(found - self.spacing, 0.0))

    def variances(self, channels: Sequence[int], pressures: Array) -> Array:
        """Return the discrepancy's variance (N, n) by channel at pressures (N, n), in Pa^2."""
        recorded = np.array(self.recorded)
        distances = self.distances(channels, pressures)
        rough = self.discrepancy**2 * growth(distances, self.reach)
        parts = []
        for segment, (begin, end) in enumerate(pairwise(np.cumsum([0, *channels]))):
            smooth = RelativeErrors(recorded[:, begin:end], self.range)
            variance = self.gain**2 * smooth.variances(pressures[:, begin:end])
            parts.append(rough[:, segment] + variance)
        return np.repeat(np.stack(parts, axis=1), channels, axis=1)

    @property
    def range(self) -> float:
        """Largest recorded range of a channel's pressure, in Pa."""
        return recorded_range(np.array(self.recorded))

    @property
    def near(self) -> float:
        """Distance in Pa up to which a pressure counts as recorded."""
        return _NEAR * self.range


class RelativeErrors:
    """Relative errors of pressures that depend on their direction, and are known at recorded ones.

    Before the recording their covariance is ``|p| |q| cos(p, q)^4``.

    `recorded`: pressures (K, c), in Pa. `scale`: R, in Pa, see `ErrorModel`.
    """

    def __init__(self, recorded: Array, scale: float) -> None:
        self._recorded = recorded
        self._noise = (_KNOWN * scale) ** 2
        noise = self._noise * np.eye(len(recorded))
        self._root = np.linalg.cholesky(_prior(recorded, recorded) + noise)

    def covariance(self, pressures: Array) -> Array:
        """Return the covariance (N, N) at pressures (N, c), in Pa^2."""
        known = np.linalg.solve(self._root, _prior(self._recorded, pressures))
        return np.asarray(_prior(pressures, pressures) - known.T @ known)

    def recorded(self, covariance: Array, index: int) -> Array:
        """Return a `covariance` (N, N) after one of its pressures was recorded too."""
        own = covariance[index]
        return np.asarray(covariance - np.outer(own, own) / (own[index] + self._noise))

    def variances(self, pressures: Array) -> Array:
        """Return the variances (N,) at pressures (N, c), in Pa^2."""
        known = np.linalg.solve(self._root, _prior(self._recorded, pressures))
        return np.asarray(np.maximum((pressures**2).sum(axis=1) - (known**2).sum(axis=0), 0.0))


def _prior(one: Array, other: Array) -> Array:
    """Return the prior covariance (N, M) of `RelativeErrors` at pressures (N, c) and (M, c)."""
    norms = np.linalg.norm(one, axis=1)[:, np.newaxis] * np.linalg.norm(other, axis=1)
    return np.asarray((one @ other.T) ** 4 / np.maximum(norms, 1.0) ** 3)


def recorded_range(pressures: Array) -> float:
    """Return the largest range of a channel's pressures (N, n), in Pa; at least 1 Pa."""
    return max(float(np.ptp(pressures, axis=0).max()), 1.0)


def growth(distances: Array, reach: float | Array) -> Array:
    """Return the share of the discrepancy's variance at distances from recorded pressures."""
    return np.asarray(-np.expm1(-2 * distances / reach))


def squared_moves(per_pressure: Array, variances: Array) -> Array:
    """Return mean squares (..., N, n), in m^2, by which discrepancies of pressures move the tip.

    `per_pressure`: derivatives (N, 3, n) of the tip's position, in m/Pa. `variances`: of the
    channels' discrepancies (..., N, n), in Pa^2.
    """
    return np.asarray(variances * (per_pressure**2).sum(axis=1))


def distances_from(channels: Sequence[int], pressures: Array, recorded: Array) -> Array:
    """Return the distances (N, segments) in Pa of each segment; see `nearest_recorded`."""
    _, ways = nearest_recorded(channels, pressures, recorded)
    return np.stack([np.linalg.norm(way, axis=1) for way in ways], axis=1)


def nearest_recorded(
    channels: Sequence[int], pressures: Array, recorded: Array
) -> tuple[NDArray[np.intp], list[Array]]:
    """Return each segment's nearest recorded pressures, and the displacements from them, in Pa.

    `channels`: number of channels of each segment. `pressures`, `recorded`: (N, n) and (K, n).
    Returns indices (N, segments) of recorded rows, and for each segment displacements (N, c).
    """
    ends = np.cumsum([0, *channels])
    nearest = np.zeros((len(pressures), len(channels)), dtype=np.intp)
    ways = []
    for segment, (begin, end) in enumerate(pairwise(ends)):
        own = pressures[:, begin:end]
        least = np.full(len(own), np.inf)
        for index, other in enumerate(recorded[:, begin:end]):
            squares = ((own - other) ** 2).sum(axis=1)
            nearest[squares < least, segment] = index
            np.minimum(least, squares, out=least)
        ways.append(own - recorded[nearest[:, segment], begin:end])
    return nearest, ways


class Calibration(Schema):
    """Results of a calibration and their uncertainty.

    Attributes
    ----------
    logs : names of the recordings it was fitted to.
    parameters : the numbers that were fitted.
    frames : standard deviations of the twist of the base in the tracker's frame (in base axes, m
        and rad), then of the sensor on the tip (in the tip's axes), as far as they were fitted.
    correlation : of the errors of parameters and frames, one row for each.
    position_residual, angle_residual : root mean square of the difference between the recorded
        positions (each axis) and angles and those of the model.
    pressure_min, pressure_max : lowest and highest recorded pressure of each channel, in Pa.
    pressure_norm : largest recorded norm of each segment's pressures, in Pa.
        Where these three and `errors` are missing, all pressures count as recorded.
    errors : model of the tip's prediction errors; None in files from before it existed.
    unfit : whether the fit missed its own recordings by so much that nothing that is computed with
        the robot can be relied on. Reading such a file gives a warning.
    """

    logs: Items[str] = ()
    parameters: Items[FittedParameter] = ()
    frames: Items[Annotated[Number, _POSITIVE]] = ()
    correlation: Items[Items[Number]] = ()
    position_residual: Annotated[Length, _POSITIVE] = 0.0
    angle_residual: Annotated[Angle, _POSITIVE] | None = None
    pressure_min: Items[Pressure] = ()
    pressure_max: Items[Pressure] = ()
    pressure_norm: Items[Pressure] = ()
    errors: ErrorModel | None = None
    unfit: bool = False

    @property
    def covariance(self) -> Array:
        """Covariance (k, k) of the coordinates of parameters and frames; positive semidefinite."""
        deviations = np.array([*(each.deviation for each in self.parameters), *self.frames])
        matrix = np.array(self.correlation, dtype=float).reshape(len(deviations), len(deviations))
        # rounding in the file may make the variance of a well-known number negative
        values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
        root = deviations[:, np.newaxis] * vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(root @ root.T)

    def covers(self, channels: Sequence[int], pressures: Array) -> Flags:
        """Return which pressures (N, n) count as recorded.

        `channels`: number of channels of each segment. `pressures`: (N, n), in Pa.
        """
        if self.errors is not None:
            distances = self.errors.distances(channels, pressures)
            return np.asarray((distances <= self.errors.near).all(axis=1))
        everything = (np.inf,) * pressures.shape[1]
        low = np.array(self.pressure_min or np.negative(everything))
        high = np.array(self.pressure_max or everything)
        norms = self.pressure_norm or (np.inf,) * len(channels)
        recorded = [*self.pressure_min, *self.pressure_max]
        slack = _SLACK * np.max(np.abs(recorded), initial=0.0)
        inside = ((pressures >= low - slack) & (pressures <= high + slack)).all(axis=1)
        ends = np.cumsum([0, *channels])
        for begin, end, norm in zip(ends, ends[1:], norms, strict=False):
            inside &= np.linalg.norm(pressures[:, begin:end], axis=1) <= norm + slack
        return np.asarray(inside)

    def extrapolation(self, channels: Sequence[int], pressures: Array) -> str:
        """Return a warning if the model extrapolates at pressures (n,) in Pa, otherwise ""."""
        p = pressures[np.newaxis]
        if self.covers(channels, p)[0]:
            return ""
        text = "the calibration saw no such pressures"
        if self.errors is not None:
            away = float(self.errors.distances(channels, p).max())
            text += f", the nearest are {away * 1e-3:.0f} kPa away"
        return f"{text}: the model extrapolates"

    @model_validator(mode="after")
    def _check(self) -> Calibration:
        if len(self.frames) not in (0, 6, 12):
            raise BadKeyError(
                "frames", "expected 6 numbers, 12 with the sensor on the tip, or none"
            )
        k = len(self.parameters) + len(self.frames)
        keys = [parameter.key for parameter in self.parameters]
        for index, key in enumerate(keys):
            if key in keys[:index]:
                raise BadKeyError(
                    f"parameters.{index}.key", f"{shown(key)} appears twice; expected once"
                )
        rows = [len(row) for row in self.correlation]
        if rows != [k] * k:
            raise BadKeyError("correlation", f"expected {k} rows of {k} numbers, one per parameter")
        matrix = np.array(self.correlation, dtype=float).reshape(k, k)
        if k and not (
            np.allclose(matrix, matrix.T, atol=_ROUNDING)
            and np.allclose(np.diag(matrix), 1, atol=_ROUNDING)
            and np.linalg.eigvalsh(matrix).min() > -k * _ROUNDING
        ):
            raise BadKeyError(
                "correlation", "is not a matrix of correlations: symmetric, ones on the diagonal"
            )
        return self
