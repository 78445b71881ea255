"""Shorten and round ways in the space of pressures; every change is checked for clearance."""

from __future__ import annotations

import numpy as np

from stiffopt.arrays import Array
from stiffopt.paths.geometry import interpolated
from stiffopt.paths.tree_search import IsClear

_SHORTCUTS = 60  # largest number tried
_IN_VAIN = 12  # consecutive failed shortcuts after which to stop
_GAIN = 1e-3  # smallest saving of a shortcut, as a share of the length
_REACHES = (0.5, 0.25, 0.12, 0.05)  # extents of a rounded corner, as shares of the shorter edge
_CHORDS = 8  # in a rounded corner
_FLAT = 0.999  # cosine above which a corner counts as straight


def shortened(way: Array, is_clear: IsClear, scale: Array, seed: int) -> Array:
    """Return a shorter way (k, n), by skipping corners and by random shortcuts.

    Parameters
    ----------
    way : (m, n), in Pa.
    is_clear : checks motions.
    scale : (n,), divisors of the channels in a length.
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
        a, b = interpolated([first, second], marks, way)
        saved = (second - first) - float(np.linalg.norm((b - a) / scale))
        if saved > _GAIN * marks[-1] and is_clear(np.stack([a, b])):
            way, failed = np.concatenate([way[: i + 1], [a, b], way[j + 1 :]]), 0
    return _without_corners(way, is_clear)


def _without_corners(way: Array, is_clear: IsClear) -> Array:
    """Skip corners: connect each point with the last one to which the straight way is clear."""
    kept, here = [0], 0
    while here < len(way) - 1:
        ahead = len(way) - 1
        while ahead > here + 1 and not is_clear(way[[here, ahead]]):
            ahead -= 1
        here = ahead
        kept.append(here)
    return way[kept]


def _marks(way: Array, scale: Array) -> Array:
    """Return the length (m,) from the start to each point."""
    steps = np.linalg.norm(np.diff(way, axis=0) / scale, axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def rounded(way: Array, is_clear: IsClear, scale: Array) -> Array:
    """Replace corners by parabolic arcs (in chords), the widest that are clear.

    If all corners can be as wide as possible, the result is a quadratic B-spline.
    """
    lengths = np.diff(_marks(way, scale))
    parts = [way[:1]]
    for k in range(1, len(way) - 1):
        parts.append(_corner(way[k - 1 : k + 2], lengths[k - 1 : k + 1], is_clear, scale))
    found = np.concatenate([*parts, way[-1:]])
    moves = np.abs(np.diff(found, axis=0)).max(axis=1) > 0
    return np.asarray(found[np.concatenate([[True], moves])])


def _corner(corner: Array, lengths: Array, is_clear: IsClear, scale: Array) -> Array:
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
