"""Orientations of tracked bodies whose markers look alike after quarter turns.

A tracker that mistakes the markers of a body reports it turned by one of the 24 proper rotations of
the cube about the body's own axes: ``R_reported = R g``. Rotations of the arm are continuous, so
that these jumps can be undone along a recording, all but one such rotation of the whole of it.

Quaternions are w first.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.identify.screening import norms, whole

__all__ = ["Unflipped", "aligned", "mean_rotation", "rotations", "unflipped", "unit_quaternions"]

Array = NDArray[np.float64]

_AGREE = np.radians(20.0)  # by which rows that follow each other may differ at one place
_TURN = 4.0  # rad that a body may turn while it moves by the length of the arm
_LONG = 5  # rows in a row that are no chance
_CHUNK = 1 << 16  # rows at a time


def _cube() -> Array:
    """Quaternions (24, 4) of the proper rotations of the cube; the identity is the first."""
    directions = np.array(list(product((-1.0, 0.0, 1.0), repeat=4)))
    directions = directions[np.isin(np.sum(directions != 0, axis=1), (1, 2, 4))]
    found = directions / norms(directions)[:, None]
    first = found[np.arange(len(found)), np.argmax(found != 0, axis=1)]
    half = found[first > 0]  # q and -q are one rotation
    return np.asarray(half[np.argsort(-half[:, 0], kind="stable")])


CUBE = _cube()
_CUBE_ROTATIONS = np.array([lie.rotation_from_quaternion(q) for q in CUBE])
_PRODUCT = np.array(
    [[np.argmax(np.abs(CUBE @ lie.quaternion_product(a, b))) for b in CUBE] for a in CUBE]
)  # (24, 24), which of them is g_a g_b
_INVERSE = np.argmax(_PRODUCT == 0, axis=1)


@dataclass(frozen=True, eq=False)
class Unflipped:
    """Orientations without jumps.

    Attributes
    ----------
    quaternion : (N, 4); NaN where there is none to be used.
    flips : rows in which the reported orientation jumps, counted from 0.
    stray : rows (N,) that agree with none of their neighbours, however they are turned.
    """

    quaternion: Array
    flips: NDArray[np.int_]
    stray: NDArray[np.bool_]


def unflipped(quaternion: Array, position: Array, length: float) -> Unflipped:
    """Undo jumps about a body's own axes.

    Each row is turned so that it is nearest to the one before; no row is turned as far as the
    body's motion may explain the difference. Of the 24 results the one is taken that changes the
    fewest rows. Some rows between two jumps to which no turn fits are strays.

    Parameters
    ----------
    quaternion :
        (N, 4), of length 1; NaN where it is missing.
    position :
        (N, 3), of the body, in m; NaN where it is missing.
    length :
        Of the arm, in m.
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
    """Return the one of the 24 versions of a whole track that is nearest to a reference.

    Parameters
    ----------
    track_rotation :
        (N, 3, 3), NaN where there is none.
    reference :
        (3, 3), for example the mean of another recording of the same body.

    Returns
    -------
    ndarray
        (N, 3, 3), ``track_rotation @ g``.
    """
    usable = np.isfinite(track_rotation).all(axis=(1, 2))
    near = reference.T @ track_rotation[usable].sum(axis=0)
    best = np.argmax(np.einsum("ij,gji->g", near, _CUBE_ROTATIONS))
    return np.asarray(track_rotation @ _CUBE_ROTATIONS[best])


def unit_quaternions(quaternion: Array) -> Array:
    """Return quaternions (N, 4) at length 1; NaN where they are missing or none, such as zeros."""
    size = norms(quaternion)
    with np.errstate(invalid="ignore"):
        size = np.where((size > 0.5) & (size < 2.0), size, np.nan)
    return np.asarray(quaternion / size[:, None])


def rotations(quaternion: Array) -> Array:
    """Return rotations (N, 3, 3) of unit quaternions (N, 4)."""
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
    """Angle (N,) in rad by which bodies may have turned that have moved from here to there."""
    way = norms(after - before)
    return np.asarray(_AGREE + _TURN * np.nan_to_num(way) / length)


def _links(
    before: Array, after: Array, allowed: Array
) -> tuple[NDArray[np.int_], NDArray[np.bool_]]:
    """Return which turn (N,) of `after` is nearest to `before`, and where even that is too far."""
    turn = np.zeros(len(before), dtype=int)
    off = np.zeros(len(before), dtype=bool)
    alike = np.cos(np.minimum(allowed, np.pi) / 2)
    jump = np.flatnonzero(np.abs(np.einsum("ij,ij->i", before, after)) < alike)
    for start in range(0, len(jump), _CHUNK):
        part = jump[start : start + _CHUNK]
        between = _product(before[part] * [1, -1, -1, -1], after[part])
        # the real part of `between g` says how far `after g` is like `before`
        like = np.abs(between @ (CUBE * [1, -1, -1, -1]).T)  # (chunk, 24)
        turn[part] = np.argmax(like, axis=1)
        off[part] = np.max(like, axis=1) < alike[part]
    return turn, off


def _alone(q: Array, p: Array, length: float) -> NDArray[np.bool_]:
    """Say which rows (N,) fit neither neighbour, though these fit each other."""
    _, off = _links(q[:-1], q[1:], _allowance(p[:-1], p[1:], length))
    alone = np.zeros(len(q), dtype=bool)
    between = np.flatnonzero(off[:-1] & off[1:]) + 1
    before, after = between - 1, between + 1
    _, apart = _links(q[before], q[after], _allowance(p[before], p[after], length))
    alone[between[~apart]] = True
    return alone


def _accumulated(turn: NDArray[np.int_]) -> NDArray[np.int_]:
    """Versions (N + 1,) of rows, of which the first is as it is, by the turns (N,) between them."""
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
    """Turn each piece of a track as a whole to fit its neighbour, from the longest one outwards.

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
            if off[0] and end - start < _LONG:
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
    """Hamilton products (N, 4) of rows."""
    return np.stack(lie.quaternion_product(a.T, b.T), axis=1)
