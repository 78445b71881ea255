"""What a kinematics experiment has found: how far the model's tip is from the measured one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stiffopt.errors import InputError
from stiffopt.experiments.conductor import Array
from stiffopt.experiments.doubts import doubts
from stiffopt.experiments.kinematics import KinematicsSettings, recording_name
from stiffopt.logs import Log, read_log
from stiffopt.model.manipulator import Manipulator

__all__ = ["KinematicsResult", "evaluate_kinematics"]

_GRID = 0.05  # s
_GAP = 0.3  # s; nothing is drawn across a gap that is longer
_EVERY = 2  # points of the grid at which a loaded arm is evaluated


@dataclass(frozen=True, eq=False)
class KinematicsResult:
    """Recordings against the model, on a common grid of times (K,).

    Attributes
    ----------
    repetitions : how many recordings there are.
    time : grid, in s.
    pressures : mean over the repetitions (K, n), in Pa; measured, or commanded where not.
    low, high : extremes of the measured tip over the repetitions (K, 3), in m.
    model : tip that the model says, mean over the repetitions (K, 3), in m.
    error : largest distance between measured and modelled tip over the repetitions (K,), in m.
    component_error : the mean of modelled less measured tip over the repetitions (K, 3), in m.
    errors : distances at all samples of all recordings (M,), in m.
    length : of the arm at rest, in m.
    doubts : sentences on what makes one doubt the recordings.
    """

    repetitions: int
    time: Array
    pressures: Array
    low: Array
    high: Array
    model: Array
    error: Array
    component_error: Array
    errors: Array
    length: float
    doubts: tuple[str, ...] = ()

    @property
    def mean(self) -> float:
        """Mean error, in m."""
        return float(self.errors.mean())

    @property
    def p95(self) -> float:
        """Error that 95 % of the samples do not exceed, in m."""
        return float(np.quantile(self.errors, 0.95))

    @property
    def worst(self) -> float:
        """Largest error, in m."""
        return float(self.errors.max())

    @property
    def repeatability(self) -> float:
        """Width of the band that the repetitions fill, its mean over time, in m."""
        return float(np.nanmean(np.linalg.norm(self.high - self.low, axis=1)))


def read_recordings(folder: Path, settings: KinematicsSettings) -> list[Log]:
    """Return the complete recordings of a folder."""
    paths = [folder / f"{recording_name(k + 1)}.csv" for k in range(settings.repetitions)]
    return [read_log(path) for path in paths if path.exists()]


def evaluate_kinematics(logs: Sequence[Log], model: Manipulator) -> KinematicsResult:
    """Compare recordings of the same pressures with a model.

    The model is given the measured pressures, where they were measured: what is judged is the
    arm's model and not the regulators. An arm under gravity is given their mean over the
    repetitions.

    Raises
    ------
    InputError
        There is nothing to compare, or the model has another number of channels.
    """
    logs = [log for log in logs if np.isfinite(log.tip_position).all(axis=1).any()]
    if not logs:
        raise InputError("there is no recording in which the tip was seen")
    if any(log.n != model.n_pressures for log in logs):
        raise InputError(
            f"the model has {model.n_pressures} channels, the recordings have {logs[0].n}"
        )
    end = min(float(log.time[-1]) for log in logs)
    grid = np.arange(0.0, end + _GRID / 2, _GRID)
    pressures = np.mean([_on_grid(grid, log.time, log.pressures, np.inf) for log in logs], axis=0)
    tip = _tip_of_all(model, grid, pressures) if model.is_loaded else None
    each = [_compared(log, model, grid, tip) for log in logs]
    tips = np.stack([one.tip for one in each])
    models = np.stack([one.model for one in each])
    with np.errstate(invalid="ignore"):
        distances = np.linalg.norm(models - tips, axis=2)
    return KinematicsResult(
        repetitions=len(logs),
        time=grid,
        pressures=pressures,
        low=np.fmin.reduce(tips),
        high=np.fmax.reduce(tips),
        model=models.mean(axis=0),
        error=np.fmax.reduce(distances),
        component_error=_mean_of_known(models - tips),
        errors=np.concatenate([one.errors for one in each]),
        length=model.length,
        doubts=doubts(logs),
    )


@dataclass(frozen=True, eq=False)
class _Compared:
    """One recording: on the grid, and the errors at its own samples."""

    tip: Array
    model: Array
    errors: Array


def _compared(log: Log, model: Manipulator, grid: Array, of_all: Array | None) -> _Compared:
    seen = np.isfinite(log.tip_position).all(axis=1)
    time, tip = log.time[seen], log.tip_position[seen]
    if of_all is None:
        expected = model.tip_pose(log.pressures[seen])[:, :3, 3]
    else:
        expected = _on_grid(time, grid, of_all, np.inf)
    return _Compared(
        tip=_on_grid(grid, time, tip, _GAP),
        model=_on_grid(grid, time, expected, np.inf),
        errors=np.linalg.norm(expected - tip, axis=1),
    )


def _tip_of_all(model: Manipulator, grid: Array, pressures: Array) -> Array:
    """The model's tip (K, 3) for all repetitions: each pose of a loaded arm takes milliseconds."""
    at = np.unique(np.append(np.arange(0, len(grid), _EVERY), len(grid) - 1))
    return _on_grid(grid, grid[at], model.tip_pose(pressures[at])[:, :3, 3], np.inf)


def _on_grid(grid: Array, time: Array, values: Array, gap: float) -> Array:
    """Interpolate values (N, m) to the grid; NaN where samples are too far apart."""
    found = np.stack([np.interp(grid, time, column) for column in values.T], axis=1)
    after = np.clip(np.searchsorted(time, grid), 1, len(time) - 1) if len(time) > 1 else None
    if after is not None:
        found[time[after] - time[after - 1] > gap] = np.nan
    return found


def _mean_of_known(values: Array) -> Array:
    """Mean over the first axis of what is not NaN."""
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    count = known.sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
