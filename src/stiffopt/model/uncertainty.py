"""Uncertainty of the tip's position and stiffness of a calibrated arm.

There are three independent sources: the parameters, whose covariance the calibration found; the
hysteresis, since the same pressures hold the arm anywhere between where loading and unloading take
it; and the residual that no parameter explained in the recordings.  The first two are propagated to
the tip by their Jacobians, to first order.

Hysteresis is taken long after the pressures were reached, when lag and creep are over.  No play
operator was ever dragged beyond the robot's pressure limits, so that less hysteresis is possible
near the limits than between them.  Each channel's effective pressure is taken to be distributed
evenly between the least and the largest possible value.  Its mean square is taken about the
equilibrium, which is what `tip_pose` returns; near the limits that is not the middle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import InputError
from stiffopt.model.arguments import checked_measure
from stiffopt.model.calibration import Calibration
from stiffopt.model.compliance import Boundary, Frame, Kind
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import NO_HISTORY, History
from stiffopt.model.parameters import Parameter
from stiffopt.model.parametric import ParametricArm

Vector = NDArray[np.float64]
Part = Literal["parameters", "hysteresis", "residual"]

_CHI_SQUARED = 7.814727903251179  # 95 % quantile, three degrees of freedom
_NORMAL = 1.959963984540054  # 97.5 % quantile


@dataclass(frozen=True, eq=False)
class TipUncertainty:
    """How well the tip's position and stiffness are known at some pressures.

    Attributes
    ----------
    parameters, hysteresis, residual : ndarray
        Mean squares (3, 3) of the error of `Manipulator.tip_pose`'s position in base axes, in m^2,
        that come from the parameters' errors, from hysteresis, and from what the calibration left
        unexplained.
    inside : bool
        Whether the calibration saw such pressures; outside, the model extrapolates and the real
        errors may be larger.
    """

    parameters: Vector
    hysteresis: Vector
    residual: Vector
    inside: bool
    _source: Uncertainty
    _pressures: Vector

    @property
    def covariance(self) -> Vector:
        """Mean square (3, 3) of the position's error in base axes, in m^2."""
        return np.asarray(self.parameters + self.hysteresis + self.residual)

    @cached_property
    def semi_axes(self) -> Vector:
        """Half lengths (3,) of the 95 % ellipsoid about `tip_pose` in m, the longest first."""
        values = np.linalg.eigvalsh(self.covariance)[::-1]
        return np.asarray(np.sqrt(_CHI_SQUARED * np.maximum(values, 0.0)))

    @cached_property
    def axes(self) -> Vector:
        """Unit vectors (3, 3) of the ellipsoid as columns, in base axes, as in `semi_axes`."""
        return np.asarray(np.linalg.eigh(self.covariance)[1][:, ::-1])

    @property
    def largest_part(self) -> Part:
        """What most of the error's mean square comes from."""
        parts: dict[Part, float] = {
            "parameters": float(np.trace(self.parameters)),
            "hysteresis": float(np.trace(self.hysteresis)),
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
        """95 % interval of a directional stiffness, in N/m or N m/rad; see `Manipulator.stiffness`.

        From the parameters' errors and hysteresis, on a logarithmic scale, to first order. It
        contains `Manipulator.stiffness`.
        """
        return self._source.stiffness_interval(self._pressures, direction, kind, boundary, frame)


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

    def __init__(self, description: RobotDescription, tip_load: Sequence[float]) -> None:
        if description.calibration is None:
            raise InputError(
                f"robot '{description.name}' was not calibrated, so that nothing is known of its "
                "errors; fit it to recordings with 'stiffopt calibrate'"
            )
        self._description = description
        self._channels = [segment.n_channels for segment in description.segments]
        self._calibration: Calibration = description.calibration
        parameters = [Parameter(fitted.key) for fitted in self._calibration.parameters]
        self._arm = ParametricArm(description, parameters, tip_load)
        self._covariance = self._calibration.covariance

    def at(self, pressures: Vector) -> TipUncertainty:
        """Uncertainty at pressures (n,)."""
        found = self._arm.poses(pressures[np.newaxis], self._rest)
        rotation = found.transforms[0, :3, :3]
        per_coordinate = rotation @ found.per_coordinate[0, :3]
        per_pressure = rotation @ found.per_pressure[0, :3]
        return TipUncertainty(
            parameters=per_coordinate @ self._covariance @ per_coordinate.T,
            hysteresis=(per_pressure * self._hysteresis(pressures)) @ per_pressure.T,
            residual=np.eye(3) * self._calibration.position_residual**2,
            inside=bool(self._calibration.covers(self._channels, pressures[np.newaxis])[0]),
            _source=self,
            _pressures=pressures,
        )

    def stiffness_interval(
        self, pressures: Vector, direction: ArrayLike, kind: Kind, boundary: Boundary, frame: Frame
    ) -> tuple[float, float]:
        """See `TipUncertainty.stiffness_interval`."""
        measure = checked_measure(direction, kind, boundary, frame)
        k, per_pressure, per_coordinate = self._arm.stiffnesses(
            pressures[np.newaxis], self._rest, measure
        )
        g, h = per_coordinate[0] / k[0], per_pressure[0] / k[0]
        variance = g @ self._covariance @ g + h**2 @ self._hysteresis(pressures)
        deviation = float(np.sqrt(max(variance, 0.0)))
        return float(k[0] * np.exp(-_NORMAL * deviation)), float(k[0] * np.exp(_NORMAL * deviation))

    def _hysteresis(self, pressures: Vector) -> Vector:
        """Mean squares (n,) of effective minus commanded pressures (n,), in Pa^2."""
        robot = self._description
        places = [
            (segment.history or NO_HISTORY, channel)
            for segment in robot.segments
            for channel in range(segment.n_channels)
        ]
        found = []
        for (history, channel), *values in zip(
            places, pressures.tolist(), robot.pressure_min, robot.pressure_max, strict=True
        ):
            least, most = np.subtract(settled_range(history, channel, *values), values[0])
            found.append((least**2 + least * most + most**2) / 3)
        return np.array(found)

    @property
    def _rest(self) -> Vector:
        return np.zeros(len(self._calibration.parameters))


def settled_range(
    history: History, channel: int, pressure: float, low: float, high: float
) -> tuple[float, float]:
    """Least and largest effective pressure of a channel that settled at a pressure, in Pa.

    The arm began at rest without pressure; of what was commanded since then only the limits are
    known.

    Parameters
    ----------
    history : of the channel's segment.
    channel : of the segment, from 0.
    pressure : in Pa.
    low, high : limits, in Pa.
    """
    low, high = min(low, 0.0, pressure), max(high, 0.0, pressure)
    ends = np.array([pressure, pressure])
    for play in history.play:
        # the operator is dragged down to low + width and up to high - width; it began at zero
        least = max(pressure - play.width, min(low + play.width, 0.0))
        most = min(pressure + play.width, max(high - play.width, 0.0))
        ends += history.memory_of(channel) * play.share * (np.array([least, most]) - pressure)
    return float(ends[0]), float(ends[1])
