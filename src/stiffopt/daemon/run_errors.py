"""Errors of the tip in a recorded run: on its way to targets, and at them."""

from __future__ import annotations

from collections.abc import Iterator
from math import radians
from typing import NamedTuple

import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.daemon.run_log import RecordedRun

ARRIVED = 1e-3
"""A target is held from when the tip first comes this near to it, in m, ..."""
ARRIVED_ANGLE = radians(1.0)
"""... and this near in angle, in rad. A target that moves by more in one tick is a new one."""


class ErrorStatistics(NamedTuple):
    """Statistics of errors in some ticks of a run, in the unit of the errors.

    `mean`, `p95`, `largest`: the mean, the 95th percentile and the largest error. `ticks`: number
    of errors.
    """

    mean: float
    p95: float
    largest: float
    ticks: int

    @classmethod
    def of(cls, errors: Array) -> ErrorStatistics | None:
        """Return the statistics of the finite ones of errors (N,); None if there are none."""
        known = errors[np.isfinite(errors)]
        if not len(known):
            return None
        p95 = float(np.quantile(known, 0.95))
        return cls(float(known.mean()), p95, float(known.max()), len(known))


class RunStages(NamedTuple):
    """Flags of the ticks (N,) of a run: on the way to a target, and at it.

    A target is approached from when it is set, or the loop becomes active again, until the tip is
    within `ARRIVED` of it. It is held from then on, even if it moves slowly, as in a trajectory.
    Ticks without control, or without a target, are neither.
    """

    approach: Flags
    hold: Flags

    @classmethod
    def of(cls, run: RecordedRun) -> RunStages:
        """Return the stages of a run."""
        steers = _steers(run)
        near = _within(run.position_error, ARRIVED) & _within(run.angle_error, ARRIVED_ANGLE)
        hold = np.zeros(len(run), dtype=bool)
        for ticks in _targets(run, steers):
            arrived = np.flatnonzero(near[ticks])
            if len(arrived):
                hold[ticks.start + arrived[0] : ticks.stop] = True
        return cls(steers & ~hold, hold)


def _steers(run: RecordedRun) -> Flags:
    """Return flags of the ticks in which the loop is active and has a target."""
    active = np.zeros(len(run), dtype=bool)
    for span in run.states:
        if span.kind == "active":
            active |= (run.time >= span.begin) & (run.time < span.end)
    return active & (np.isfinite(run.position_error) | np.isfinite(run.angle_error))


def _within(error: Array, limit: float) -> Flags:
    return np.isnan(error) | (error <= limit)


def _targets(run: RecordedRun, steers: Flags) -> Iterator[slice]:
    """Yield the ticks of each target in turn."""
    begins = np.flatnonzero(steers & ~np.concatenate([[False], steers[:-1] & ~_jumps(run)]))
    breaks = np.union1d(np.append(begins, len(run)), np.flatnonzero(~steers))
    for begin, end in zip(begins, breaks[np.searchsorted(breaks, begins) + 1], strict=True):
        yield slice(int(begin), int(end))


def _jumps(run: RecordedRun) -> Flags:
    """Return whether the next tick has a new target (N - 1,)."""
    moved = _change(run.target_position) > ARRIVED
    for name in ("target_pointing", "target_quaternion"):
        moved |= _change(getattr(run, name)) > ARRIVED_ANGLE
    return moved


def _change(values: Array) -> Array:
    """Return how far vectors (N, k) move per tick (N - 1,); infinite if other parts are known."""
    same = (np.isnan(values[1:]) == np.isnan(values[:-1])).all(axis=1)
    distance = np.linalg.norm(np.nan_to_num(np.diff(values, axis=0)), axis=1)
    return np.where(same, distance, np.inf)
