"""What the combined poses have found: how far the model's tip is from where each one ended."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stiffopt.errors import InputError
from stiffopt.experiments.conductor import Array
from stiffopt.experiments.coverage import round_name
from stiffopt.experiments.doubts import doubts
from stiffopt.logs import Log, read_log
from stiffopt.model.manipulator import Manipulator

__all__ = ["CoverageResult", "evaluate_coverage", "read_rounds"]

_HELD = 0.9  # s for which a command must not change to be a pose
_WINDOW = 1.0  # s at the end of a pose over which tip and pressures are averaged


@dataclass(frozen=True, eq=False)
class CoverageResult:
    """The ends of poses (M,) against the model; means over the last second of each.

    Attributes
    ----------
    pressures : (M, n), in Pa; measured, or commanded where not.
    tip : measured (M, 3), in m.
    model : tip that the model says (M, 3), in m.
    speed : with which the tip still moved then (M,), in m/s; noise counts.
    length : of the arm at rest, in m.
    doubts : sentences on what makes one doubt the recordings.
    """

    pressures: Array
    tip: Array
    model: Array
    speed: Array
    length: float
    doubts: tuple[str, ...] = ()

    @property
    def errors(self) -> Array:
        """Distances (M,) between measured and modelled tip, in m."""
        found: Array = np.linalg.norm(self.model - self.tip, axis=1)
        return found

    @property
    def mean(self) -> float:
        """Mean error, in m."""
        return float(self.errors.mean())

    @property
    def p95(self) -> float:
        """Error that 95 % of the poses do not exceed, in m."""
        return float(np.quantile(self.errors, 0.95))

    @property
    def worst(self) -> float:
        """Largest error, in m."""
        return float(self.errors.max())


def read_rounds(folder: Path, count: int) -> list[Log]:
    """Return the complete recordings among so many rounds of a folder."""
    paths = [folder / f"{round_name(k + 1)}.csv" for k in range(count)]
    return [read_log(path) for path in paths if path.exists()]


def evaluate_coverage(logs: Sequence[Log], model: Manipulator) -> CoverageResult | None:
    """Compare the poses in which the arm was held with a model, at the measured pressures.

    Returns
    -------
    CoverageResult or None
        None if the tip was seen in none of them.

    Raises
    ------
    InputError
        The model has another number of channels.
    """
    if any(log.n != model.n_pressures for log in logs):
        raise InputError(
            f"the model has {model.n_pressures} channels, the recordings have {logs[0].n}"
        )
    held = [pose for log in logs for pose in _held(log)]
    if not held:
        return None
    pressures, tips, speed = (np.array(values) for values in zip(*held, strict=True))
    return CoverageResult(
        pressures=pressures,
        tip=tips,
        model=model.tip_pose(pressures)[:, :3, 3],
        speed=speed,
        length=model.length,
        doubts=doubts(logs),
    )


def _held(log: Log) -> Iterator[tuple[Array, Array, float]]:
    """Yield pressures (n,), tip (3,) and its speed for each pose but that at the end of a round."""
    steps = np.any(log.commanded[1:] != log.commanded[:-1], axis=1)
    seen = np.asarray(np.isfinite(log.tip_position).all(axis=1))
    for rows in np.split(np.arange(len(log)), np.flatnonzero(steps) + 1):
        if not len(rows) or np.array_equal(log.commanded[rows[0]], log.commanded[-1]):
            continue
        time = log.time[rows]
        last = rows[(time > time[-1] - _WINDOW) & seen[rows]]
        if time[-1] - time[0] >= _HELD and len(last) > 1:
            tip = log.tip_position[last]
            yield log.pressures[last].mean(axis=0), tip.mean(axis=0), _speed(log.time[last], tip)


def _speed(time: Array, tip: Array) -> float:
    """Of a straight movement through the places (N, 3), in m/s."""
    t = time - time.mean()
    return float(np.linalg.norm(t @ tip) / (t @ t))
