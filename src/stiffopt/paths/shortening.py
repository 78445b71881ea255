"""Ways in the space of pressures made shorter and rounder; each change is judged."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stiffopt.paths.tree_search import IsClear

Vector = NDArray[np.float64]

_SHORTCUTS = 60  # tried, at most
_IN_VAIN = 12  # shortcuts in a row that are not clear or bring nothing
_GAIN = 1e-3  # of the length, that a shortcut saves at least
_REACHES = (0.5, 0.25, 0.12, 0.05)  # of a corner, as shares of the shorter edge
_CHORDS = 8  # of a rounded corner
_FLAT = 0.999  # cosine, above which a corner is none


def shortened(way: Vector, is_clear: IsClear, scale: Vector, seed: int) -> Vector:
    """A shorter way (k, n), by dropping corners and by shortcuts between random points.

    Parameters
    ----------
    way : (m, n), in Pa.
    is_clear : judges motions.
    scale : (n,), pressures that count as equally long.
    seed : of the shortcuts.
    """
    way = _without_corners(way, is_clear)
    rng = np.random.default_rng(seed)
    failed = 0
    for _ in range(_SHORTCUTS):
        if len(way) < 3 or failed >= _IN_VAIN:
            break
        marks = _marks(way, scale)
        first, second = np.sort(rng.random(2)) * marks[-1]
        i, j = (int(np.searchsorted(marks, x, "right")) - 1 for x in (first, second))
        failed += 1
        if i == j:
            continue
        a, b = _at(way, marks, first), _at(way, marks, second)
        saved = (second - first) - float(np.linalg.norm((b - a) / scale))
        if saved > _GAIN * marks[-1] and is_clear(np.stack([a, b])):
            way, failed = np.concatenate([way[: i + 1], [a, b], way[j + 1 :]]), 0
    return _without_corners(way, is_clear)


def _without_corners(way: Vector, is_clear: IsClear) -> Vector:
    """From each point go on to the last one that can be seen from there."""
    kept, here = [0], 0
    while here < len(way) - 1:
        ahead = len(way) - 1
        while ahead > here + 1 and not is_clear(way[[here, ahead]]):
            ahead -= 1
        here = ahead
        kept.append(here)
    found: Vector = way[kept]
    return found


def _marks(way: Vector, scale: Vector) -> Vector:
    """Lengths (m,) from the start."""
    steps = np.linalg.norm(np.diff(way, axis=0) / scale, axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _at(way: Vector, marks: Vector, length: float) -> Vector:
    return np.array([np.interp(length, marks, column) for column in way.T])


def rounded(way: Vector, is_clear: IsClear, scale: Vector) -> Vector:
    """The way with its corners replaced by parabolas in chords, as wide as they are clear.

    Where all corners are as wide as can be it is a quadratic B-spline about the way's corners.
    """
    lengths = np.diff(_marks(way, scale))
    parts = [way[:1]]
    for k in range(1, len(way) - 1):
        parts.append(_corner(way[k - 1 : k + 2], lengths[k - 1 : k + 1], is_clear, scale))
    found = np.concatenate([*parts, way[-1:]])
    moves = np.abs(np.diff(found, axis=0)).max(axis=1) > 0
    return np.asarray(found[np.concatenate([[True], moves])])


def _corner(corner: Vector, lengths: Vector, is_clear: IsClear, scale: Vector) -> Vector:
    before, at, after = corner
    into, out = (at - before) / lengths[0], (after - at) / lengths[1]
    if float((into / scale) @ (out / scale)) > _FLAT:
        return corner[1:2]
    t = np.linspace(0.0, 1.0, _CHORDS + 1)[:, None]
    for reach in _REACHES:
        wide = reach * lengths.min()
        a, b = at - wide * into, at + wide * out
        bow = (1 - t) ** 2 * a + 2 * t * (1 - t) * at + t**2 * b
        if is_clear(bow):
            return np.asarray(bow)
    return corner[1:2]
