"""A log beside what the model says of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

__all__ = ["Comparison", "Errors", "together"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Errors:
    """Errors of the tip over some rows.

    Attributes
    ----------
    n : number of rows that were compared.
    mean, median, p95, max : of the distance between measured and predicted position, in m; NaN
        where there is no row.
    angle : mean angle between measured and predicted axis of the tip, in rad, or None where no
        orientation was recorded.
    """

    n: int
    mean: float
    median: float
    p95: float
    max: float
    angle: float | None

    @classmethod
    def of(cls, distances: Array, angles: Array | None) -> Errors:
        """Summarise distances (N,) in m and angles (N,) in rad; what is NaN is left out."""
        known = distances[np.isfinite(distances)]
        turned = None if angles is None else angles[np.isfinite(angles)]
        angle = float(turned.mean()) if turned is not None and len(turned) else None
        if not len(known):
            return cls(0, np.nan, np.nan, np.nan, np.nan, angle)
        return cls(
            len(known),
            float(known.mean()),
            float(np.median(known)),
            float(np.quantile(known, 0.95)),
            float(known.max()),
            angle,
        )


@dataclass(frozen=True, eq=False)
class Comparison:
    """A log beside what the model says of it, in the frame of the recording.

    Attributes
    ----------
    name : of the log.
    time : (N,), in s.
    pressures : (N, n), commanded, in Pa.
    effective : (N, n), for which the model's equilibrium was taken, in Pa.
    measured, predicted : (N, 3), positions of the tip's sensor, in m; NaN where not measured.
    angle : (N,), between the measured and the predicted axis of the tip, in rad; None where no
        orientation was recorded.
    inside : (N,), whether the calibration had seen such pressures; all true without one.
    remarks : what was found in the log, one sentence each.
    """

    name: str
    time: Array
    pressures: Array
    effective: Array
    measured: Array
    predicted: Array
    angle: Array | None
    inside: NDArray[np.bool_]
    remarks: tuple[str, ...]

    @property
    def distance(self) -> Array:
        """Error (N,) of the position in m; NaN where it was not measured."""
        return np.asarray(np.linalg.norm(self.measured - self.predicted, axis=1))

    @property
    def errors(self) -> Errors:
        """Errors of all rows."""
        return Errors.of(self.distance, self.angle)

    @property
    def outside(self) -> Errors:
        """Errors of the rows whose pressures the calibration had not seen."""
        return self.rows(~self.inside).errors

    def rows(self, wanted: NDArray[np.bool_]) -> Comparison:
        """Some rows (N,) of it."""
        return replace(
            self,
            time=self.time[wanted],
            pressures=self.pressures[wanted],
            effective=self.effective[wanted],
            measured=self.measured[wanted],
            predicted=self.predicted[wanted],
            angle=None if self.angle is None else self.angle[wanted],
            inside=self.inside[wanted],
        )


def together(comparisons: Sequence[Comparison]) -> Errors:
    """Errors of the rows of all logs."""
    distances = np.concatenate([np.zeros(0), *(each.distance for each in comparisons)])
    angles = [each.angle for each in comparisons if each.angle is not None]
    return Errors.of(distances, np.concatenate(angles) if angles else None)
