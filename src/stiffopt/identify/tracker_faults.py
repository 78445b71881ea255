"""Find a tracker's faulty readings: gaps, repeats, jumps and flipped orientations.

A tracker may lose a body for some rows, repeat its last reading, or report a body elsewhere for a
moment. Where the markers of a body look alike after quarter turns, it may also report the body
turned by one of the 24 proper rotations of the cube about the body's own axes,
``R_reported = R g``. Rotations of an arm are continuous, so that such flips can be undone along a
recording, up to one rotation g that the whole recording may share.

Quaternions are w first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.identify.settings import TRACKER

Rows = NDArray[np.bool_]

MEDIAN_NORM = 1.538
"""Median of the length of a standard normal vector in space."""
_CHUNK = 1 << 16  # rows whose flips are looked for at a time, to save memory


def whole(values: Array) -> Rows:
    """Return which rows (N,) of (N, m) have no missing number; fast if m is small."""
    return np.asarray(np.isfinite(np.einsum("ij->i", values)))


def norms(values: Array) -> Array:
    """Lengths (N,) of rows (N, m); faster than ``numpy.linalg.norm``, with the same result."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", values, values)))


def repeats(tracked: Sequence[Array]) -> Rows:
    """Return in which rows (N,) all arrays (N, m) repeat the row before exactly."""
    same = np.ones(len(tracked[0]) - 1, dtype=bool)
    known = np.zeros_like(same)
    for values in tracked:
        before, now = values[:-1], values[1:]
        finite = np.isfinite(now)
        same &= np.all((before == now) | ~(finite | np.isfinite(before)), axis=1)
        known |= finite.any(axis=1)
    return np.concatenate(([False], same & known))


def dropouts(position: Array, length: float) -> Rows:
    """Return which positions (N, 3) are zeros that mean "missing", or impossibly far away.

    Parameters
    ----------
    position : in m; NaN where it is missing.
    length : of the arm, in m.
    """
    zero = np.all(position == 0, axis=1)
    seen = whole(position) & ~zero
    if not seen.any():
        return np.zeros(len(position), dtype=bool)
    if np.sum(norms(position[seen]) < TRACKER.origin * length) >= TRACKER.origin_rows:
        zero[:] = False
    off = norms(position - np.median(position[seen], axis=0))
    with np.errstate(invalid="ignore"):
        return np.asarray(zero | (off > TRACKER.farthest * length))


def roughness(time: Array, position: Array) -> Array:
    """Return distances (N - 2,) of positions (N, 3) from the line between their neighbours."""
    share = ((time[1:-1] - time[:-2]) / (time[2:] - time[:-2]))[:, None]
    line = (1 - share) * position[:-2] + share * position[2:]
    return np.asarray(norms(position[1:-1] - line))


def jumps(time: Array, position: Array, reach: Array, length: float) -> Rows:
    """Return in which rows (N,) a position jumps away for a moment and comes back.

    A jump lies off three straight lines: those extrapolated from the rows before and from the rows
    after, and that between them. It is several times the usual step at that time, and more than
    the pressures can have moved the tip. So neither the response to a step of pressure nor the
    first or last row counts as a jump.

    Parameters
    ----------
    time : (N,), in s.
    position : (N, 3), in m; NaN in rows that must not be used.
    reach : (N,), longest way in m that the pressures so far can have moved the tip; increasing.
    length : of the arm, in m.
    """
    bad = np.zeros(len(time), dtype=bool)
    seen = np.flatnonzero(whole(position))
    if len(seen) < 3:
        return bad
    usual = (
        TRACKER.jump_sigmas * float(np.median(roughness(time[seen], position[seen]))) / MEDIAN_NORM
    )
    threshold = max(usual, TRACKER.jump_least * length)
    pause = TRACKER.jump_pause * float(np.median(np.diff(time[seen])))
    for count in 2 * (
        *range(1, TRACKER.jump_rows + 1),
    ):  # twice, as one jump may hide another near it
        rows = np.flatnonzero(whole(position) & ~bad)
        if len(rows) < count + 2:
            break
        found = _away(time[rows], position[rows], reach[rows], count, threshold, pause)
        for k in range(count):
            bad[rows[found + k]] = True
    return bad


def _away(
    time: Array, position: Array, reach: Array, count: int, threshold: float, pause: float
) -> NDArray[np.int_]:
    """Return the first row of each run of `count` rows that jumps away from both neighbours."""
    last = len(time) - 1
    step = norms(np.diff(position, axis=0))
    share = 1 - 1 / TRACKER.jump_factor  # smallest step at an end of a jump, of `threshold`
    large = step > share * threshold
    before = np.flatnonzero(large[: len(step) - count] & large[count:])
    after = before + count + 1
    soon = time[after] - time[before] <= pause * (count + 1)
    before, after = before[soon], after[soon]
    around = np.concatenate([before + k for k in (-3, -2, -1)] + [after + k for k in (0, 1, 2)])
    inside = (around >= 0) & (around < len(step))
    steps = np.where(inside, step[np.clip(around, 0, len(step) - 1)], 0.0).reshape(6, -1)
    across = norms(position[after] - position[before])
    ordinary = np.maximum(np.median(steps, axis=0), across)
    moved = reach[after - 1] - reach[np.maximum(before - 1, 0)]
    limit = np.maximum(threshold, TRACKER.jump_factor * ordinary) + moved

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
    """Return velocities (K, 3) between rows a and b; zero where they are the same row."""
    between = time[b] - time[a]
    safe = np.where(between > 0, between, 1.0)
    return np.asarray((position[b] - position[a]) / safe[:, None])


# orientations -------------------------------------------------------------------------------------


def _cube() -> Array:
    """Return quaternions (24, 4) of the proper rotations of the cube; the identity comes first."""
    directions = np.array(list(product((-1.0, 0.0, 1.0), repeat=4)))
    directions = directions[np.isin(np.sum(directions != 0, axis=1), (1, 2, 4))]
    found = directions / norms(directions)[:, None]
    first = found[np.arange(len(found)), np.argmax(found != 0, axis=1)]
    half = found[first > 0]  # q and -q are one rotation
    return np.asarray(half[np.argsort(-half[:, 0], kind="stable")])


CUBE = _cube()
CUBE_ROTATIONS = np.array([lie.rotation_from_quaternion(q) for q in CUBE])
_PRODUCT = np.array(
    [[np.argmax(np.abs(CUBE @ lie.quaternion_product(a, b))) for b in CUBE] for a in CUBE]
)  # (24, 24), which of them is g_a g_b
_INVERSE = np.argmax(_PRODUCT == 0, axis=1)


@dataclass(frozen=True, eq=False)
class Unflipped:
    """Orientations without jumps.

    Attributes
    ----------
    quaternion : (N, 4); NaN in rows that must not be used.
    flips : indices of the rows at which the reported orientation jumps.
    stray : (N,), rows that agree with no neighbour under any of the 24 rotations.
    """

    quaternion: Array
    flips: NDArray[np.int_]
    stray: NDArray[np.bool_]


def unflipped(quaternion: Array, position: Array, length: float) -> Unflipped:
    """Undo flips of orientation about a body's own axes.

    Each row gets the rotation of the cube that brings it nearest to the row before, unless the
    body's motion can explain the difference. One rotation common to all rows stays undetermined;
    the result is the one that changes the fewest rows. Short runs that no rotation fits are strays.

    Parameters
    ----------
    quaternion : (N, 4), of length 1; NaN where it is missing.
    position : (N, 3), of the body, in m; NaN where it is missing.
    length : of the arm, in m.
    """
    rows = np.flatnonzero(whole(quaternion))
    stray = np.zeros(len(quaternion), dtype=bool)
    if not len(rows):
        return Unflipped(quaternion.copy(), rows, stray)
    alone = _alone(quaternion[rows], position[rows], length)
    stray[rows[alone]] = True
    rows = rows[~alone]
    q, p = quaternion[rows], position[rows]
    turn, off = _links(q[:-1], q[1:], _allowance(p[:-1], p[1:], length))
    bounds = np.concatenate(([0], np.flatnonzero(off) + 1, [len(rows)]))
    version = np.zeros(len(rows), dtype=int)
    for start, end in pairwise(bounds.tolist()):
        version[start:end] = _accumulated(turn[start : end - 1])
    lost = _join(q, p, version, bounds, length)
    version = _PRODUCT[version, _INVERSE[np.bincount(version[~lost], minlength=24).argmax()]]
    kept = rows[~lost]
    stray[rows[lost]] = True
    result = np.full_like(quaternion, np.nan)
    result[kept] = _turned(q[~lost], version[~lost])
    return Unflipped(result, kept[1:][np.diff(version[~lost]) != 0], stray)


def aligned(track_rotation: Array, reference: Array) -> Array:
    """Return that one of a track's 24 versions ``track_rotation @ g`` nearest to a reference.

    Parameters
    ----------
    track_rotation : (N, 3, 3), NaN where there is none.
    reference : (3, 3), for example the mean of another recording of the same body.

    Returns
    -------
    ndarray
        (N, 3, 3), ``track_rotation @ g``.
    """
    usable = np.isfinite(track_rotation).all(axis=(1, 2))
    near = reference.T @ track_rotation[usable].sum(axis=0)
    best = np.argmax(np.einsum("ij,gji->g", near, CUBE_ROTATIONS))
    return np.asarray(track_rotation @ CUBE_ROTATIONS[best])


def unit_quaternions(quaternion: Array) -> Array:
    """Normalise quaternions (N, 4); NaN where missing or far from unit length, such as zeros."""
    size = norms(quaternion)
    with np.errstate(invalid="ignore"):
        size = np.where((size > 0.5) & (size < 2.0), size, np.nan)
    return np.asarray(quaternion / size[:, None])


def rotations(quaternion: Array) -> Array:
    """Return rotation matrices (N, 3, 3) of unit quaternions (N, 4)."""
    w, x, y, z = quaternion.T
    xx, yy, zz = 2 * x * x, 2 * y * y, 2 * z * z
    xy, xz, yz, wx, wy, wz = 2 * x * y, 2 * x * z, 2 * y * z, 2 * w * x, 2 * w * y, 2 * w * z
    rows = (
        *(1 - yy - zz, xy - wz, xz + wy),
        *(xy + wz, 1 - xx - zz, yz - wx),
        *(xz - wy, yz + wx, 1 - xx - yy),
    )
    return np.stack(rows, axis=1).reshape(-1, 3, 3)


def mean_rotation(rotation: Array) -> Array:
    """Return the chordal mean (3, 3) of rotations (N, 3, 3), which are all finite."""
    u, _, vt = np.linalg.svd(rotation.sum(axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _allowance(before: Array, after: Array, length: float) -> Array:
    """Return the angles (N,), in rad, that bodies can have turned while moving between rows."""
    way = norms(after - before)
    return np.asarray(TRACKER.turn_agrees + TRACKER.turn_moving * np.nan_to_num(way) / length)


def _links(
    before: Array, after: Array, allowed: Array
) -> tuple[NDArray[np.int_], NDArray[np.bool_]]:
    """Return which rotation (N,) of the cube brings `after` nearest to `before`.

    The second result is true where even then the angle exceeds the allowed one.
    """
    turn = np.zeros(len(before), dtype=int)
    off = np.zeros(len(before), dtype=bool)
    alike = np.cos(np.minimum(allowed, np.pi) / 2)
    jump = np.flatnonzero(np.abs(np.einsum("ij,ij->i", before, after)) < alike)
    for start in range(0, len(jump), _CHUNK):
        part = jump[start : start + _CHUNK]
        between = _product(before[part] * [1, -1, -1, -1], after[part])
        # the real part of `between g` is cos(angle / 2) between `after g` and `before`
        like = np.abs(between @ (CUBE * [1, -1, -1, -1]).T)  # (chunk, 24)
        turn[part] = np.argmax(like, axis=1)
        off[part] = np.max(like, axis=1) < alike[part]
    return turn, off


def _alone(q: Array, p: Array, length: float) -> NDArray[np.bool_]:
    """Return which rows (N,) fit neither neighbour although the neighbours fit each other."""
    _, off = _links(q[:-1], q[1:], _allowance(p[:-1], p[1:], length))
    alone = np.zeros(len(q), dtype=bool)
    between = np.flatnonzero(off[:-1] & off[1:]) + 1
    before, after = between - 1, between + 1
    _, apart = _links(q[before], q[after], _allowance(p[before], p[after], length))
    alone[between[~apart]] = True
    return alone


def _accumulated(turn: NDArray[np.int_]) -> NDArray[np.int_]:
    """Accumulate rotations (N,) between rows into versions (N + 1,); the first row is unchanged."""
    version = np.zeros(len(turn) + 1, dtype=int)
    changes = np.flatnonzero(turn).tolist()
    now = 0
    for change, following in pairwise([*changes, len(turn)]):
        now = _PRODUCT[turn[change], now]
        version[change + 1 : following + 1] = now
    return version


def _join(
    q: Array, p: Array, version: NDArray[np.int_], bounds: NDArray[np.int_], length: float
) -> NDArray[np.bool_]:
    """Rotate each piece of a track as a whole to fit its neighbour, from the longest outwards.

    It changes `version` and returns the rows of short pieces that fit nowhere.
    """
    lost = np.zeros(len(q), dtype=bool)
    pieces = list(pairwise(bounds.tolist()))
    longest = int(np.argmax(np.diff(bounds)))
    outwards = (
        (pieces[longest + 1 :], pieces[longest][1] - 1, 0),
        (pieces[:longest][::-1], pieces[longest][0], -1),
    )
    for way, row, side in outwards:
        last = row
        for start, end in way:
            near, far = (start, end - 1) if side == 0 else (end - 1, start)
            known = _turned(q[[last, near]], version[[last, near]])
            allowed = _allowance(p[[last]], p[[near]], length)
            turn, off = _links(known[:1], known[1:], allowed)
            if off[0] and end - start < TRACKER.turn_rows:
                lost[start:end] = True
                continue
            # q g_version g_turn for all rows of the piece
            version[start:end] = _PRODUCT[version[start:end], turn[0]]
            last = far
    return lost


def _turned(q: Array, version: NDArray[np.int_]) -> Array:
    turned = q.copy()
    rows = np.flatnonzero(version)
    turned[rows] = _product(q[rows], CUBE[version[rows]])
    return turned


def _product(a: Array, b: Array) -> Array:
    """Return the Hamilton products (N, 4) of rows."""
    return np.stack(lie.quaternion_product(a.T, b.T), axis=1)
