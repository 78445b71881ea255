"""Covariance of the numbers of a calibrated robot file, and what a calibration may fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from stiffopt.errors import shown
from stiffopt.schema import BadKeyError, Items, Schema
from stiffopt.units import Angle, Length, Number, Pressure

Array = NDArray[np.float64]
_POSITIVE = Field(ge=0)
_ROUNDING = 1e-3  # of correlations, which are written with few digits
_SLACK = 0.02  # of the highest recorded pressure, by which others may exceed what was recorded


SIUnit = Literal["", "m", "rad", "Pa", "s"]


@dataclass(frozen=True)
class FittedNumber:
    """What calibration must know of a kind of number in robot files to fit it.

    The fit moves a *coordinate* that is zero at the value of the robot file: the logarithm of the
    ratio for what must stay positive, else the difference.

    Attributes
    ----------
    words : what people call it.
    unit : of the value, in SI; empty for a plain number.
    tolerance : standard deviation of the coordinate before the fit: relative for what is positive,
        else in the unit of the value. Text is the key of a robot file's `tolerances` that has it.
    positive : whether the coordinate is a logarithm; the fit must then begin above zero.
    low, high : bounds of the value; of what is positive they have no effect.
    experiment : what recordings would tell the number, as the end of a sentence.
    """

    words: str
    unit: SIUnit
    tolerance: float | str
    positive: bool = False
    low: float = -math.inf
    high: float = math.inf
    experiment: str = ""


class FittedParameter(Schema):
    """A number of the robot file that was fitted, and how well it is known.

    Attributes
    ----------
    key : where it is in the file, for example ``segments[0].material.youngs_modulus``.
    deviation : standard deviation of its coordinate: relative for what must be positive
        (modulus, length, gain, area, ...), else in SI units.
    prior : the same before the calibration.
    """

    key: str
    deviation: Annotated[Number, _POSITIVE]
    prior: Annotated[Number, _POSITIVE]


class Calibration(Schema):
    """How well a calibration knows the arm.

    Attributes
    ----------
    logs : names of the recordings it was fitted to.
    parameters : the numbers that were fitted.
    correlation : of their errors, one row for each.
    position_residual, angle_residual : root mean square of the difference between the recorded
        positions (each axis) and angles and those of the model.
    pressure_min, pressure_max : lowest and highest recorded pressure of each channel, in Pa.
    pressure_norm : largest recorded norm of each segment's pressures, in Pa.
        Where these three are missing, all pressures count as recorded.
    unfit : whether the fit missed its own recordings by so much that nothing that is computed with
        the robot can be relied on. Whoever reads such a file is warned.
    """

    logs: Items[str] = ()
    parameters: Items[FittedParameter] = ()
    correlation: Items[Items[Number]] = ()
    position_residual: Annotated[Length, _POSITIVE] = 0.0
    angle_residual: Annotated[Angle, _POSITIVE] | None = None
    pressure_min: Items[Pressure] = ()
    pressure_max: Items[Pressure] = ()
    pressure_norm: Items[Pressure] = ()
    unfit: bool = False

    @property
    def covariance(self) -> Array:
        """Covariance (k, k) of the parameters' coordinates, without negative variances."""
        deviations = np.array([parameter.deviation for parameter in self.parameters])
        matrix = np.array(self.correlation, dtype=float).reshape(len(deviations), len(deviations))
        # the file's few digits may leave what is as good as known slightly below zero
        values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
        root = deviations[:, np.newaxis] * vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(root @ root.T)

    def covers(self, channels: Sequence[int], pressures: Array) -> NDArray[np.bool_]:
        """Say which pressures (N, n) lie within what was recorded.

        Parameters
        ----------
        channels : number of channels of each segment.
        pressures : (N, n)
            In Pa.
        """
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

    @model_validator(mode="after")
    def _check(self) -> Calibration:
        k = len(self.parameters)
        keys = [parameter.key for parameter in self.parameters]
        for index, key in enumerate(keys):
            if key in keys[:index]:
                raise BadKeyError(
                    f"parameters.{index}.key", f"{shown(key)} is there twice; expected once"
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
