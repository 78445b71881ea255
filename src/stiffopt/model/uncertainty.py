"""How well the tip of a calibrated arm is known, and its stiffness.

Three things leave the tip uncertain, and are independent of each other: the parameters, whose
covariance the calibration found; the hysteresis, because the same pressures hold the arm anywhere
between where loading and unloading take it; and what no parameter explained in the recordings.
Each is carried to the tip by its Jacobian, to first order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

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

__all__ = ["TipUncertainty", "Uncertainty"]

Vector = NDArray[np.float64]

_CHI_SQUARED = 7.814727903251179  # 95 % quantile, three degrees of freedom
_NORMAL = 1.959963984540054  # 97.5 % quantile


@dataclass(frozen=True, eq=False)
class TipUncertainty:
    """How well the tip's position and stiffness are known at some pressures.

    Attributes
    ----------
    parameters, hysteresis, residual : ndarray
        Covariances (3, 3) of the position in base axes, in m^2, that come from the parameters'
        errors, from hysteresis, and from what the calibration left unexplained.
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
        """Covariance (3, 3) of the position in base axes, in m^2."""
        return np.asarray(self.parameters + self.hysteresis + self.residual)

    @cached_property
    def semi_axes(self) -> Vector:
        """Half lengths (3,) of the 95 % ellipsoid in m, the longest first."""
        values = np.linalg.eigvalsh(self.covariance)[::-1]
        return np.asarray(np.sqrt(_CHI_SQUARED * np.maximum(values, 0.0)))

    @cached_property
    def axes(self) -> Vector:
        """Unit vectors (3, 3) of the ellipsoid as columns, in base axes, as in `semi_axes`."""
        return np.asarray(np.linalg.eigh(self.covariance)[1][:, ::-1])

    def stiffness_interval(
        self,
        direction: ArrayLike,
        kind: Kind = "translation",
        boundary: Boundary = "free",
        frame: Frame = "base",
    ) -> tuple[float, float]:
        """95 % interval of a directional stiffness, in N/m or N m/rad; see `Manipulator.stiffness`.

        From the parameters' errors and hysteresis, on a logarithmic scale.
        """
        return self._source.stiffness_interval(self._pressures, direction, kind, boundary, frame)


class Uncertainty:
    """Uncertainties of a calibrated robot.

    Parameters
    ----------
    description : RobotDescription
        With a calibration.
    tip_load : sequence of float
        Load on the tip, as in `Manipulator.tip_load`.

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
        self._channels = [segment.n_channels for segment in description.segments]
        self._calibration: Calibration = description.calibration
        parameters = [Parameter(fitted.key) for fitted in self._calibration.parameters]
        self._arm = ParametricArm(description, parameters, tip_load)
        self._covariance = self._calibration.covariance
        self._hysteresis = np.concatenate(
            [_hysteresis(segment.history, segment.n_channels) for segment in description.segments]
        )

    def at(self, pressures: Vector) -> TipUncertainty:
        """Uncertainty at pressures (n,)."""
        found = self._arm.poses(pressures[np.newaxis], self._rest)
        rotation = found.transforms[0, :3, :3]
        per_coordinate = rotation @ found.per_coordinate[0, :3]
        per_pressure = rotation @ found.per_pressure[0, :3]
        return TipUncertainty(
            parameters=per_coordinate @ self._covariance @ per_coordinate.T,
            hysteresis=(per_pressure * self._hysteresis**2) @ per_pressure.T,
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
        deviation = float(np.sqrt(g @ self._covariance @ g + ((h * self._hysteresis) ** 2).sum()))
        return float(k[0] * np.exp(-_NORMAL * deviation)), float(k[0] * np.exp(_NORMAL * deviation))

    @property
    def _rest(self) -> Vector:
        return np.zeros(len(self._calibration.parameters))


def _hysteresis(history: History | None, channels: int) -> Vector:
    """Standard deviations (c,) of the effective pressures, each anywhere between its ends."""
    return np.full(channels, (history or NO_HISTORY).largest_memory / np.sqrt(3))
