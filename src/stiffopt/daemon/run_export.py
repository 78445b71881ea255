"""From a run to log v1, from which an arm can be calibrated.

A row is what the tracker saw, at the time at which it captured it, with the pressures of that
moment: the command that held, and the measured one on the line between the readings around it.
Nothing that was estimated is in there. While the tracker sees nothing there are rows without a
tip, since a calibration follows the pressures all the time.
"""

from __future__ import annotations

import numpy as np

from stiffopt.daemon.run_log import RecordedRun
from stiffopt.logs.log import Array, Log

__all__ = ["log_of_run"]

_GAP = 0.1  # s without a frame, which rows without a tip fill ...
_STEP = 0.05  # ... s apart
_NEAR = 0.1  # s between a frame and a reading that belongs to it
_DIGITS = 6  # of a time in s, as log v1 writes it


def log_of_run(run: RecordedRun) -> Log:
    """Return the log of a run. Time 0 is when the recording began; N rows may be none.

    A frame that no arm could have moved to, or in which the tip was not seen, gives a row without
    a tip. Two frames of the same time give one row; of frames that were captured before the first
    command it is not known what the pressures were, and they are left out.
    """
    within = (run.captured >= run.time[0]) & (run.captured <= run.time[-1] + _NEAR)
    captured = np.round(run.captured[within], _DIGITS)
    position = run.seen_position[within].copy()
    quaternion = run.seen_quaternion[within].copy()
    unknown = run.doubted[within] | ~np.isfinite(position).all(axis=1)
    position[unknown] = quaternion[unknown] = np.nan

    order = np.lexsort((unknown, captured))  # of the same time, those that saw something first
    captured, first = np.unique(captured[order], return_index=True)
    position, quaternion = position[order][first], quaternion[order][first]

    between = _fillers(run.time, captured)
    time = np.concatenate([captured, between])
    nothing = np.full((len(between), 1), np.nan)
    order = np.argsort(time, kind="stable")
    time = time[order]
    position = np.concatenate([position, nothing.repeat(3, axis=1)])[order]
    quaternion = np.concatenate([quaternion, nothing.repeat(4, axis=1)])[order]
    turns = bool(np.isfinite(quaternion).any())
    measured = _between(run, time)
    return Log(
        time=time,
        commanded=_held(run, time),
        measured=measured if np.isfinite(measured).any() else None,
        tip_position=position,
        tip_quaternion=quaternion if turns else None,
    )


def _fillers(ticks: Array, captured: Array) -> Array:
    """Return times of ticks, some way apart, in which no frame was captured."""
    after = np.searchsorted(captured, ticks, side="right")
    edges = np.concatenate([[-np.inf], captured, [np.inf]])
    before, next_one = edges[after], edges[after + 1]
    alone = (next_one - before > _GAP) & (ticks - before >= _STEP) & (next_one - ticks >= _STEP)
    chosen: list[float] = []
    for tick in np.round(ticks[alone], _DIGITS):
        if not chosen or tick >= chosen[-1] + _STEP - 1e-9:
            chosen.append(float(tick))
    return np.array(chosen)


def _held(run: RecordedRun, time: Array) -> Array:
    """Return the commands (N, n) that held at times (N,); NaN where ticks are missing."""
    slack = 10.0**-_DIGITS  # times were rounded
    tick = np.maximum(np.searchsorted(run.time, time + slack, side="right") - 1, 0)
    period = float(np.median(np.diff(run.time))) if len(run) > 1 else 0.0
    commanded = run.commanded[tick]
    commanded[time - run.time[tick] > max(_NEAR, 3 * period)] = np.nan
    return commanded


def _between(run: RecordedRun, time: Array) -> Array:
    """Return measured pressures (N, n) at times (N,), NaN where no reading is near."""
    read = np.where(np.isfinite(run.measured_time), run.measured_time, run.time)
    read, first = np.unique(read, return_index=True)
    values = run.measured[first]
    measured = np.full((len(time), run.n), np.nan)
    for channel in range(run.n):
        known = np.isfinite(values[:, channel])
        if known.any():
            at = read[known]
            line = np.interp(time, at, values[known, channel])
            after = np.searchsorted(at, time).clip(1, max(len(at) - 1, 1))
            nearest = np.minimum(
                np.abs(time - at[after - 1]), np.abs(time - at[np.minimum(after, len(at) - 1)])
            )
            measured[:, channel] = np.where(nearest <= _NEAR, line, np.nan)
    return measured
