"""What of a tracker's readings is no reading of where a body was."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["MEDIAN_NORM", "dropouts", "jumps", "norms", "repeats", "roughness", "whole"]

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

MEDIAN_NORM = 1.538
"""Median of the length of a standard normal vector in space."""

_FAR = 100.0  # lengths of the arm from the median, where no arm gets
_NEAR = 0.05  # lengths of the arm from the origin; a tracker may have been zeroed there
_SOME = 3  # rows near the origin that say so
_RUN = 5  # rows in a row that a jump may last
_PAUSE = 5.0  # usual steps of time per row, over which nothing can be said
_FACTOR = 3.0  # times the ordinary step
_SIGMAS = 10.0
_LEAST = 0.01  # lengths of the arm; less is left to a robust loss


def whole(values: Array) -> Rows:
    """Say in which rows (N,) of (N, m) no number is missing; fast where there are few columns."""
    return np.asarray(np.isfinite(np.einsum("ij->i", values)))


def norms(values: Array) -> Array:
    """Lengths (N,) of rows (N, m); faster than ``numpy.linalg.norm``, with the same result."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", values, values)))


def repeats(tracked: Sequence[Array]) -> Rows:
    """Say in which rows (N,) all arrays (N, m) repeat the row before, number for number."""
    same = np.ones(len(tracked[0]) - 1, dtype=bool)
    known = np.zeros_like(same)
    for values in tracked:
        before, now = values[:-1], values[1:]
        finite = np.isfinite(now)
        same &= np.all((before == now) | ~(finite | np.isfinite(before)), axis=1)
        known |= finite.any(axis=1)
    return np.concatenate(([False], same & known))


def dropouts(position: Array, length: float) -> Rows:
    """Say which positions (N, 3) are zeros that stand for none, or farther than any arm gets.

    Parameters
    ----------
    position :
        In m; NaN where it is missing.
    length :
        Of the arm, in m.
    """
    zero = np.all(position == 0, axis=1)
    seen = whole(position) & ~zero
    if not seen.any():
        return np.zeros(len(position), dtype=bool)
    if np.sum(norms(position[seen]) < _NEAR * length) >= _SOME:
        zero[:] = False
    off = norms(position - np.median(position[seen], axis=0))
    with np.errstate(invalid="ignore"):
        return np.asarray(zero | (off > _FAR * length))


def roughness(time: Array, position: Array) -> Array:
    """Distance (N - 2,) of each position (N, 3) from the straight line between its neighbours."""
    share = ((time[1:-1] - time[:-2]) / (time[2:] - time[:-2]))[:, None]
    line = (1 - share) * position[:-2] + share * position[2:]
    return np.asarray(norms(position[1:-1] - line))


def jumps(time: Array, position: Array, reach: Array, length: float) -> Rows:
    """Say in which rows (N,) a position is away for a moment from where the body was.

    It must be away from the straight lines that the rows before, the rows after and both of them
    together lay through it, by several ordinary steps of that time of the recording, and by more
    than the pressures may have moved it. So the answer to a step of pressure is none, and the
    first and the last row never are.

    Parameters
    ----------
    time :
        (N,), in s.
    position :
        (N, 3), in m; NaN where it is not to be used.
    reach :
        (N,), how far changes of pressure until then may have moved the tip altogether, in m.
    length :
        Of the arm, in m.
    """
    bad = np.zeros(len(time), dtype=bool)
    seen = np.flatnonzero(whole(position))
    if len(seen) < 3:
        return bad
    usual = _SIGMAS * float(np.median(roughness(time[seen], position[seen]))) / MEDIAN_NORM
    least = max(usual, _LEAST * length)
    pause = _PAUSE * float(np.median(np.diff(time[seen])))
    for count in 2 * (*range(1, _RUN + 1),):  # twice, as one jump may hide another near it
        rows = np.flatnonzero(whole(position) & ~bad)
        if len(rows) < count + 2:
            break
        found = _away(time[rows], position[rows], reach[rows], count, least, pause)
        for k in range(count):
            bad[rows[found + k]] = True
    return bad


def _away(
    time: Array, position: Array, reach: Array, count: int, least: float, pause: float
) -> NDArray[np.int_]:
    """Return the first row of each run of `count` rows that is away from both its neighbours."""
    last = len(time) - 1
    step = norms(np.diff(position, axis=0))
    some = 1 - 1 / _FACTOR  # of `least`: no run that is found starts or ends with less
    large = step > some * least
    before = np.flatnonzero(large[: len(step) - count] & large[count:])
    after = before + count + 1
    soon = time[after] - time[before] <= pause * (count + 1)
    before, after = before[soon], after[soon]
    around = np.concatenate([before + k for k in (-3, -2, -1)] + [after + k for k in (0, 1, 2)])
    there = (around >= 0) & (around < len(step))
    steps = np.where(there, step[np.clip(around, 0, len(step) - 1)], 0.0).reshape(6, -1)
    across = norms(position[after] - position[before])
    ordinary = np.maximum(np.median(steps, axis=0), across)
    moved = reach[after - 1] - reach[np.maximum(before - 1, 0)]
    limit = np.maximum(least, _FACTOR * ordinary) + moved

    earlier, later = np.maximum(before - 1, 0), np.minimum(after + 1, last)
    lines = (
        (before, _slope(time, position, earlier, before)),
        (before, _slope(time, position, before, after)),
        (after, _slope(time, position, after, later)),
    )
    away = np.ones(len(before), dtype=bool)
    for k in range(1, count + 1):
        for origin, slope in lines:
            expected = position[origin] + slope * (time[before + k] - time[origin])[:, None]
            away &= norms(position[before + k] - expected) > limit
    return np.asarray(before[away] + 1)


def _slope(time: Array, position: Array, a: NDArray[np.int_], b: NDArray[np.int_]) -> Array:
    """Velocities (K, 3) between rows; none where they are the same row."""
    between = time[b] - time[a]
    safe = np.where(between > 0, between, 1.0)
    return np.asarray((position[b] - position[a]) / safe[:, None])
