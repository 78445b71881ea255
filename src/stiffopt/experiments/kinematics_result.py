"""Evaluate the kinematics experiment: errors of the model's tip, and doubts about recordings.

`evaluate_kinematics` compares the paper's sequence with a model, `evaluate_coverage` the combined
poses; `doubts` finds suspicious properties of the recordings.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.experiments.coverage import round_name
from stiffopt.experiments.kinematics import KinematicsSettings, recording_name
from stiffopt.logs import Log, read_log
from stiffopt.model.manipulator import Manipulator

_GRID = 0.05  # s, spacing
_EVERY = 2  # a loaded arm is evaluated at every second point of the grid


@dataclass(frozen=True)
class EvaluationRules:
    """Criteria for poses, gaps and doubts in recordings."""

    gap: float = 0.3  # longest time between samples across which the tip is interpolated, in s
    held: float = 0.9  # shortest time of a constant command that counts as a pose, in s
    window: float = 1.0  # time at the end of a pose over which tip and pressures are averaged, in s
    regulator_time: float = 0.5  # time within which a regulator should follow a command, in s
    pressure_error: float = 5e3  # pressure error after that time that raises a doubt, in Pa
    worse_share: float = 0.01  # share of samples that may exceed it
    hidden: float = 0.5  # longest time for which the tip may be out of sight, in s
    lost_share: float = 0.1  # share of the tracker's frames that may be missing


RULES = EvaluationRules()


class DistanceStatistics:
    """Statistics of `errors`: distances between measured and modelled tip, in m."""

    errors: Array

    @property
    def mean(self) -> float:
        """Mean error, in m."""
        return float(self.errors.mean())

    @property
    def p95(self) -> float:
        """Error that 95 % of the samples or poses do not exceed, in m."""
        return float(np.quantile(self.errors, 0.95))

    @property
    def worst(self) -> float:
        """Largest error, in m."""
        return float(self.errors.max())


@dataclass(frozen=True, eq=False)
class KinematicsResult(DistanceStatistics):
    """Comparison of recordings with the model, on a common grid of times (K,).

    Attributes
    ----------
    repetitions : number of recordings.
    time : grid, in s.
    pressures : mean over the repetitions (K, n), in Pa; commanded where not measured.
    low, high : extremes of the measured tip over the repetitions (K, 3), in m.
    model : the model's tip, mean over the repetitions (K, 3), in m.
    error : largest distance between measured and modelled tip over the repetitions (K,), in m.
    component_error : mean of modelled minus measured tip over the repetitions (K, 3), in m.
    errors : distances at all samples of all recordings (M,), in m.
    length : of the arm at rest, in m.
    doubts : about the recordings, as sentences.
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
    def repeatability(self) -> float:
        """Mean over time of the width of the band of all repetitions, in m."""
        return float(np.nanmean(np.linalg.norm(self.high - self.low, axis=1)))


def read_recordings(folder: Path, settings: KinematicsSettings) -> list[Log]:
    """Return the complete recordings of the paper's sequence in a folder, each from 0 s on."""
    paths = [folder / f"{recording_name(k + 1)}.csv" for k in range(settings.repetitions)]
    logs = [read_log(path) for path in paths if path.exists()]
    return [replace(log, time=log.time - math.floor(log.time[0])) for log in logs]


def evaluate_kinematics(logs: Sequence[Log], model: Manipulator) -> KinematicsResult:
    """Compare recordings of the same pressures with a model.

    The model is evaluated at the measured pressures, if there are any, so that errors are those of
    the arm's model and not of the regulators. For an arm under gravity, whose poses take
    milliseconds each, their mean over the repetitions is used.

    Raises `InputError`: there is nothing to compare, or the model has another number of channels.
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
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # times at which the tip was not seen
        distances = np.linalg.norm(models - tips, axis=2)
        component_error = np.nanmean(models - tips, axis=0)
    return KinematicsResult(
        repetitions=len(logs),
        time=grid,
        pressures=pressures,
        low=np.fmin.reduce(tips),
        high=np.fmax.reduce(tips),
        model=models.mean(axis=0),
        error=np.fmax.reduce(distances),
        component_error=component_error,
        errors=np.concatenate([one.errors for one in each]),
        length=model.length,
        doubts=doubts(logs),
    )


@dataclass(frozen=True, eq=False)
class _Compared:
    """One recording on the grid, with the errors at its own samples."""

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
        tip=_on_grid(grid, time, tip, RULES.gap),
        model=_on_grid(grid, time, expected, np.inf),
        errors=np.linalg.norm(expected - tip, axis=1),
    )


def _tip_of_all(model: Manipulator, grid: Array, pressures: Array) -> Array:
    """Return the model's tip (K, 3) at the mean pressures of all repetitions."""
    at = np.unique(np.append(np.arange(0, len(grid), _EVERY), len(grid) - 1))
    return _on_grid(grid, grid[at], model.tip_pose(pressures[at])[:, :3, 3], np.inf)


def _on_grid(grid: Array, time: Array, values: Array, gap: float) -> Array:
    """Interpolate values (N, m) to the grid; NaN where samples are too far apart."""
    found = np.stack([np.interp(grid, time, column) for column in values.T], axis=1)
    after = np.clip(np.searchsorted(time, grid), 1, len(time) - 1) if len(time) > 1 else None
    if after is not None:
        found[time[after] - time[after - 1] > gap] = np.nan
    return found


# combined poses ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CoverageResult(DistanceStatistics):
    """Comparison of M combined poses with the model, by means over the last second of each.

    Attributes
    ----------
    pressures : (M, n), in Pa; commanded where not measured.
    tip : measured tip (M, 3), in m.
    model : tip of the model (M, 3), in m.
    speed : remaining speed of the tip (M,), in m/s, including noise.
    length : of the arm at rest, in m.
    doubts : about the recordings, as sentences.
    errors : distances (M,) between measured and modelled tip, in m.
    """

    pressures: Array
    tip: Array
    model: Array
    speed: Array
    length: float
    doubts: tuple[str, ...] = ()
    errors: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "errors", np.linalg.norm(self.model - self.tip, axis=1))


def read_rounds(folder: Path, count: int) -> list[Log]:
    """Return the complete recordings among the first `count` rounds of a folder."""
    paths = [folder / f"{round_name(k + 1)}.csv" for k in range(count)]
    return [read_log(path) for path in paths if path.exists()]


def evaluate_coverage(logs: Sequence[Log], model: Manipulator) -> CoverageResult | None:
    """Compare the poses in which the arm was held with a model, at the measured pressures.

    Returns None if there is no pose in which the tip was seen. Raises `InputError`: the model has
    another number of channels.
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
    """Yield pressures (n,), tip (3,) and its speed in each pose except the last of a round."""
    steps = np.any(log.commanded[1:] != log.commanded[:-1], axis=1)
    seen = np.asarray(np.isfinite(log.tip_position).all(axis=1))
    for rows in np.split(np.arange(len(log)), np.flatnonzero(steps) + 1):
        if not len(rows) or np.array_equal(log.commanded[rows[0]], log.commanded[-1]):
            continue
        time = log.time[rows]
        last = rows[(time > time[-1] - RULES.window) & seen[rows]]
        if time[-1] - time[0] >= RULES.held and len(last) > 1:
            tip = log.tip_position[last]
            yield log.pressures[last].mean(axis=0), tip.mean(axis=0), _speed(log.time[last], tip)


def _speed(time: Array, tip: Array) -> float:
    """Return the speed of a straight motion fitted to positions (N, 3), in m/s."""
    t = time - time.mean()
    return float(np.linalg.norm(t @ tip) / (t @ t))


# doubts ------------------------------------------------------------------------------------------


def doubts(logs: Sequence[Log]) -> tuple[str, ...]:
    """Return sentences on pressures that did not follow commands and on missing frames."""
    found = [*_disobedient(logs)]
    gap = max((_longest_gap(log) for log in logs), default=0.0)
    if gap > RULES.hidden:
        found.append(f"the tip was out of sight for up to {gap:.1f} s")
    lost = max((_lost(log) for log in logs), default=0.0)
    if lost > RULES.lost_share:
        found.append(f"up to {100 * lost:.0f} % of a recording's frames are missing or without tip")
    return tuple(found)


def _disobedient(logs: Sequence[Log]) -> list[str]:
    """Return a sentence for each channel whose pressure did not follow its commands."""
    worst: dict[int, float] = {}
    for log in logs:
        if log.measured is None or len(log.time) < 2:
            continue
        low, high = _recent_extremes(log.time, log.commanded)
        with np.errstate(invalid="ignore"):
            off = np.fmax(np.fmax(log.measured - high, low - log.measured), 0.0)  # (N, n)
        for channel in range(log.n):
            known = off[np.isfinite(off[:, channel]), channel]
            if len(known) and np.mean(known > RULES.pressure_error) > RULES.worse_share:
                worst[channel] = max(worst.get(channel, 0.0), float(known.max()))
    return [
        f"the measured pressure of channel {channel + 1} was up to {off * 1e-5:.2f} bar away from "
        f"what had been commanded in the {RULES.regulator_time:g} s before"
        for channel, off in sorted(worst.items())
    ]


def _recent_extremes(time: Array, commanded: Array) -> tuple[Array, Array]:
    """Return the lowest and highest command (N, n) within the time that a regulator may take."""
    low, high = commanded.copy(), commanded.copy()
    rows = int(np.ceil(RULES.regulator_time / max(float(np.median(np.diff(time))), 1e-3)))
    for back in range(1, min(rows, len(time) - 1) + 1):
        low[back:] = np.minimum(low[back:], commanded[:-back])
        high[back:] = np.maximum(high[back:], commanded[:-back])
    return low, high


def _seen(log: Log) -> Array:
    return log.time[np.isfinite(log.tip_position).all(axis=1)]


def _longest_gap(log: Log) -> float:
    seen = _seen(log)
    ends = np.concatenate(([log.time[0]], seen, [log.time[-1]])) if len(log.time) else np.zeros(1)
    return float(np.diff(ends).max()) if len(ends) > 1 else 0.0


def _lost(log: Log) -> float:
    """Return the share of frames without tip, from the median time between frames."""
    if len(log.time) < 3:
        return 0.0
    usual = float(np.median(np.diff(log.time)))
    expected = float(log.time[-1] - log.time[0]) / usual + 1
    return max(0.0, 1 - len(_seen(log)) / expected)
