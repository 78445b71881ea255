"""Check whether an arm's body stays clear of a scene along a motion, at all times.

Pressures change linearly between rows.  Poses in between are evaluated as densely as needed to
guarantee the clearance of all others (this is the method of native/motion.h in Python).  The
guarantee rests on two bounds on the body's motion, sampled for each arm and enlarged by a margin:
the largest motion of any point per change of a segment's pressures, and the largest curvature of
such a motion.  An arm under gravity must not snap from one equilibrium to another on the way.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError, PressureError
from stiffopt.model.arm_clearance import ArmClearance, Ranges
from stiffopt.model.clearance import range_ends
from stiffopt.model.distances import scene_library
from stiffopt.model.scene import Scene
from stiffopt.model.stations import Pieces
from stiffopt.model.stopping import checkpoint

if TYPE_CHECKING:
    from stiffopt.model.manipulator import Manipulator


MOTION_ERROR = 3e-5
"""Largest amount by which a clear motion may fall short of the clearance asked for, in m."""

_ALLOWED = 2e-5  # m, allowed violation of the clearance at evaluated poses
_SAG, _MAX_POSES, _STEEPEST = 1e-5, 512, 1.5  # as in motion.h, except the number of poses
_CLEAR, _BLOCKED, _NO_SHAPE = range(3)  # as in motion.h
_SAMPLES = {False: 256, True: 64}  # number for the bounds, by whether the arm is loaded
_STATIONS = 4  # on each part of the body, at which bounds are sampled
_INTERVALS = 2  # between coarse stations, of each part
_CORNERS = 512  # of the pressures' range, at most
_SPEED_MARGIN, _BEND_MARGIN = 1.1, 1.5
_EXPECTED = 500  # poses of a motion, estimated for deciding on machine code
_STEP = 0.02  # step of second differences, as a share of the pressures' range

_integer, _double, _pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class MotionBounds(NamedTuple):
    """Bounds on the motion of an arm's body over the range of its pressures."""

    ranges: Ranges  # parts of the body, to which these belong
    # (ranges, pieces), largest motion of a point of a range per (Euclidean) change of a piece's
    # pressures, in m/Pa
    speeds: Array
    # (ranges,), in m; on a straight line in pressures, second derivatives of positions are at most
    # the square of the speed, by `speeds`, over this
    bends: Array


@dataclass(frozen=True)
class MotionClearance:
    """Result of a check of a motion."""

    clear: bool  # whether the body keeps the clearance asked for, to `MOTION_ERROR`
    least: float  # least distance of the evaluated poses, in m
    poses: int  # their number
    blocked_at: Array | None = None  # pressures (n,) at which the motion is blocked, or None


class ClearMotions:
    """Check motions of one arm in one scene; for one thread at a time.

    `arm`: with its load. `scene`: its own `clearance` is ignored.
    """

    def __init__(self, arm: Manipulator, scene: Scene) -> None:
        self._arm = arm
        self._clearance = ArmClearance(arm, scene)
        key = "motion bounds", arm.tip_load
        self.bounds: MotionBounds = arm.kept(key, lambda: motion_bounds(arm))
        self.piece_of = Pieces(arm).piece_of
        self._found = np.empty(2 + arm.n_pressures)
        self._function: Callable[..., int] | None = None

    def along(self, p: Array, required: float) -> MotionClearance:
        """Check the motion along rows of pressures (N, n) in Pa, for a clearance in m."""
        p = np.ascontiguousarray(p, dtype=float)
        function = self._function or self._prepare(len(p))
        if function is None:
            checkpoint()
            return self._interpreted(p, required - _ALLOWED)
        outcome = function(self._given, p.ctypes.data, len(p), required - _ALLOWED, self._results)
        least, poses = self._found[:2].tolist()
        if outcome == _NO_SHAPE:
            least = -np.inf
        at = self._found[2:].copy() if outcome == _BLOCKED else None
        return MotionClearance(outcome == _CLEAR, least, int(poses), at)

    # -- in machine code --------------------------------------------------------------------

    def _prepare(self, rows: int) -> Callable[..., int] | None:
        """Return the function in C, after setting up its arguments; None without it, or not yet."""
        body = self._arm._body.machine_code(rows + _EXPECTED)
        code = scene_library() if body is not None else None
        if body is None or code is None:
            return None
        ranges, objects = self.bounds.ranges, self._clearance.scene.in_c(code)
        motions = _Motions(
            model=body.address,
            objects=ctypes.addressof(objects),
            n_objects=len(objects),
            ends=ranges.bounds.ctypes.data,
            counts=ranges.counts.ctypes.data,
            n_ranges=len(ranges.ends),
            speeds=self.bounds.speeds.ctypes.data,
            bends=self.bounds.bends.ctypes.data,
        )
        self._given, self._results = ctypes.addressof(motions), self._found.ctypes.data
        size = body.code.cdll.stiffopt_motion_memory
        size.argtypes, size.restype = [_pointer], _integer
        memory = np.empty(size(self._given))
        motions.memory = memory.ctypes.data
        self._keep = (body, objects, motions, memory)
        function = body.code.cdll.stiffopt_motions
        function.argtypes = [_pointer, _pointer, _integer, _double, _pointer]
        self._function = function
        return self._function

    # -- without machine code ---------------------------------------------------------------

    def _interpreted(self, p: Array, required: float) -> MotionClearance:
        least, poses = np.inf, 0
        for a, b in pairwise(p):
            found = self._stretch(a, b, required)
            least, poses = min(least, found.least), poses + found.poses
            if not found.clear:
                return MotionClearance(False, least, poses, found.blocked_at)
        return MotionClearance(True, least, poses)

    def _stretch(self, a: Array, b: Array, required: float) -> MotionClearance:
        """Check the motion between two rows by repeated halving."""
        steep = (
            _STEEPEST if any(item.is_interpolated for item in self._clearance.scene.items) else 1
        )
        change = np.bincount(self.piece_of, (b - a) ** 2, self.bounds.speeds.shape[1])
        path = steep * float((self.bounds.speeds @ np.sqrt(change)).max())
        shares, spare, least = np.empty(0), np.empty(0), np.inf
        new = np.array([0.0, 1.0])
        while len(new):
            values, tip_clear = self._look(a + new[:, None] * (b - a))
            least = min(least, float(values.min()))
            if (values < required).any():
                at = a + new[int(values.argmin())] * (b - a)
                return MotionClearance(False, least, len(shares) + len(new), at)
            order = np.argsort(np.concatenate([shares, new]))
            shares = np.concatenate([shares, new])[order]
            spare = np.concatenate([spare, np.minimum(values - required, tip_clear)])[order]
            open_ = spare[1:] + spare[:-1] - path * np.diff(shares) < -2 * _SAG
            new = ((shares[1:] + shares[:-1]) / 2)[open_]
            if len(shares) + len(new) > _MAX_POSES:
                return MotionClearance(False, least, len(shares), a + new[0] * (b - a))
        return MotionClearance(True, least, len(shares))

    def _look(self, p: Array) -> tuple[Array, Array]:
        """Return the least distances (N,), and the tip's distances (N,) from discs of rings."""
        try:
            values = self._clearance.least(p)
        except (PressureError, EquilibriumError):
            return np.full(len(p), -np.inf), np.zeros(len(p))
        far = np.full(len(p), np.inf)
        for item in self._clearance.scene.items:
            if item.is_ring:
                tips = self._arm.tip_pose(p)[:, :3, 3]
                far = np.minimum(far, item.passages(tips).from_disc)
        return values, far


class _Motions(ctypes.Structure):
    """Structure `Motions` of native/motion.h."""

    _fields_ = [
        *((name, _pointer) for name in ("model", "objects")),
        ("n_objects", _integer),
        *((name, _pointer) for name in ("ends", "counts")),
        ("n_ranges", _integer),
        ("speeds", _pointer),
        ("bends", _pointer),
        ("memory", _pointer),
    ]


# -- bounds ---------------------------------------------------------------------------------


def motion_bounds(arm: Manipulator) -> MotionBounds:
    """Return the bounds of an arm, sampled at corners of its pressures' range and inside it."""
    pieces, ranges = Pieces(arm), _parts(arm)
    low, high = ranges.bounds.T
    at = np.linspace(low, high, _STATIONS, axis=1).ravel()  # part by part
    p = _that_settle(arm, _spread(arm))
    moves = _moves(arm, p, at)  # (N, k, 4, n)
    speeds = np.zeros((len(at), len(pieces.ends)))
    for piece in np.unique(pieces.piece_of):
        block = moves[..., pieces.piece_of == piece]
        speeds[:, piece] = np.linalg.svd(block, compute_uv=False)[..., 0].max(axis=0)
    speeds = _SPEED_MARGIN * speeds.reshape(-1, _STATIONS, len(pieces.ends)).max(axis=1)
    return MotionBounds(ranges, speeds, _bends(arm, p, at, speeds, pieces.piece_of))


def _parts(arm: Manipulator) -> Ranges:
    """Return the ranges of an arm's body, divided: parts near the base move less."""
    parts: list[tuple[float, float, int]] = []
    for start, end, count in range_ends(arm.description):
        number = -(-(count - 1) // _INTERVALS)
        marks = np.linspace(start, end, number + 1).tolist()
        coarse = 1 + -(-(count - 1) // number)
        parts += [(low, high, coarse) for low, high in pairwise(marks)]
    return Ranges.of(tuple(parts))


def _spread(arm: Manipulator) -> Array:
    """Return pressures (N, n) at corners of the range, and inside it."""
    rng = np.random.default_rng(0)
    n, low, high = arm.n_pressures, arm.pressure_min, arm.pressure_max
    count = _SAMPLES[arm.is_loaded]
    if 2**n <= (_CORNERS if not arm.is_loaded else count):
        corners = np.array(list(product((0.0, 1.0), repeat=n)))
    else:
        corners = rng.integers(0, 2, (count, n)).astype(float)
        corners[:2] = [[0.0], [1.0]]
    shares = np.concatenate([corners, rng.random((count, n))])
    return np.asarray(low + shares * (high - low))


def _that_settle(arm: Manipulator, p: Array) -> Array:
    """Return the pressures, of (N, n), at which the arm has an equilibrium."""
    if not arm.is_loaded:
        return p
    kept = []
    for row in p:
        try:
            arm._body.poses(row[None], np.array([arm.length]))
        except EquilibriumError:
            continue
        kept.append(row)
    if not kept:
        raise EquilibriumError("the arm has no stable equilibrium that is reached from rest")
    return np.array(kept)


def _moves(arm: Manipulator, p: Array, at: Array) -> Array:
    """Return derivatives of positions and radii (N, k, 4, n) by the pressures, in m/Pa."""
    moves = arm._body.jacobians(p, at)[:, :, :3]  # their length is the same in all axes
    step = 1e-4 * (arm.pressure_max - arm.pressure_min)
    slopes = [
        (arm._body.radii(p, at) - arm._body.radii(p - aside, at)) / step[k]
        for k, aside in enumerate(np.diag(step))
    ]
    return np.concatenate([moves, np.stack(slopes, axis=-1)[:, :, None]], axis=2)


def _bends(
    arm: Manipulator, p: Array, at: Array, speeds: Array, piece_of: NDArray[np.int64]
) -> Array:
    """Return the least ratio of squared speeds to second derivatives, from second differences."""
    rng = np.random.default_rng(1)
    low, high = arm.pressure_min, arm.pressure_max
    shares = rng.choice([-1.0, 0.0, 1.0], p.shape) * rng.random(p.shape)
    shares[np.arange(len(p)), rng.integers(0, p.shape[1], len(p))] = 1.0
    step = _STEP * (high - low) * shares
    middle = np.clip(p, low + np.abs(step), high - np.abs(step))
    try:
        before, here, after = (
            arm._body.line(q, at)[..., :3] for q in (middle - step, middle, middle + step)
        )
    except EquilibriumError:  # near where it buckles
        return np.full(len(speeds), arm.length / 10)
    second = np.linalg.norm(before - 2 * here + after, axis=-1)
    second = second.reshape(len(p), -1, _STATIONS).max(axis=2)  # (N, ranges)
    squares = [step[:, piece_of == piece] ** 2 for piece in range(speeds.shape[1])]
    change = np.sqrt(np.stack([each.sum(axis=1) for each in squares], axis=-1))
    ways = change @ speeds.T
    moving = ways > 1e-9  # a part may not move at all
    bends = np.where(moving, ways**2 / np.maximum(second, 1e-12), np.inf).min(axis=0)
    return np.asarray(bends / _BEND_MARGIN)
