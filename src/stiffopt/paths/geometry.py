"""Curves in space, parametrised by arc length, and the points of a path."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.optimise.goal import StiffnessGoal
from stiffopt.optimise.target import Target

_SAMPLES = 20_000  # of a spline, to integrate its arc length
_STRAIGHT = 1e-6  # sine of the angle between two chords up to which three points are collinear
_ALONG_Z = 1e-6  # sine of a tangent's angle to the base's z axis below which x replaces z


class Curve(ABC):
    """A curve in space, parametrised by the arc length from its start. `length`: in m."""

    length: float

    @abstractmethod
    def at(self, lengths: ArrayLike) -> Array:
        """Return positions (..., 3) in m at arc lengths (...) in m."""

    @abstractmethod
    def tangents(self, lengths: ArrayLike) -> Array:
        """Return unit tangents (..., 3) at arc lengths (...); zero if the curve is a point."""


class Polyline(Curve):
    """Straight lines from point to point.

    At a point, the tangent bisects the directions of the two lines; if the line turns straight
    back, it is that of the second. Between points, tangents are interpolated.

    `points`: (k, 3), in m; some may coincide. `closed`: whether it ends where it begins.
    """

    def __init__(self, points: Array, closed: bool = False) -> None:
        self.points = points
        steps = np.diff(points, axis=0)  # (k - 1, 3)
        sizes = np.linalg.norm(steps, axis=1)
        self.knots = np.concatenate([[0.0], np.cumsum(sizes)])  # (k,)
        self.length = float(self.knots[-1])
        moved = sizes > 0
        ways = steps[moved] / sizes[moved, None]
        self._tangents = np.zeros_like(points)
        if len(ways):
            before = np.vstack([ways[-1:] if closed else ways[:1], ways])
            after = np.vstack([ways, ways[:1] if closed else ways[-1:]])
            turns_back = np.linalg.norm(before + after, axis=1) < 1e-9
            halves = _unit(np.where(turns_back[:, None], after, before + after))
            self._tangents = halves[np.concatenate([[0], np.cumsum(moved)])]

    def at(self, lengths: ArrayLike) -> Array:
        """See `Curve.at`."""
        return interpolated(lengths, self.knots, self.points)

    def tangents(self, lengths: ArrayLike) -> Array:
        """See `Curve.tangents`."""
        return _unit(interpolated(lengths, self.knots, self._tangents))


class ArcCurve(Curve):
    """An arc of a circle, or a whole circle.

    Parameters
    ----------
    centre, start : (3,), in m.
    axis : (3,), unit normal of its plane; the arc turns about it by the right-hand rule.
    angle : angle of the arc, in rad.
    """

    def __init__(self, centre: Array, start: Array, axis: Array, angle: float) -> None:
        self._centre, self._x = centre, start - centre
        self._y = np.cross(axis, self._x)
        self._radius = float(np.linalg.norm(self._x))
        self.length = angle * self._radius

    def at(self, lengths: ArrayLike) -> Array:
        """See `Curve.at`."""
        angle = np.asarray(lengths, dtype=float)[..., None] / self._radius
        return self._centre + np.cos(angle) * self._x + np.sin(angle) * self._y

    def tangents(self, lengths: ArrayLike) -> Array:
        """See `Curve.tangents`."""
        angle = np.asarray(lengths, dtype=float)[..., None] / self._radius
        return _unit(np.cos(angle) * self._y - np.sin(angle) * self._x)


class SplineCurve(Curve):
    """The cubic spline through points, parametrised by chord lengths.

    Simpson's rule on a fine grid gives the arc length.

    `points`: (k, 3), in m, k >= 2, neighbours distinct. `closed`: whether the last point equals the
    first and the spline is periodic; else it is natural.
    """

    def __init__(self, points: Array, closed: bool = False) -> None:
        from scipy.interpolate import CubicSpline  # takes 0.2 s

        chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
        knots = np.concatenate([[0.0], np.cumsum(chords)])
        self._spline = CubicSpline(knots, points, bc_type="periodic" if closed else "natural")
        self._slope = self._spline.derivative()
        each = max(16, _SAMPLES // len(chords))
        shares = np.arange(each) / each
        dense = np.append((knots[:-1, None] + chords[:, None] * shares).ravel(), knots[-1])
        ends = np.linalg.norm(self._slope(dense), axis=1)
        middle = np.linalg.norm(self._slope((dense[:-1] + dense[1:]) / 2), axis=1)
        pieces = np.diff(dense) * (ends[:-1] + 4 * middle + ends[1:]) / 6
        self._dense, self._lengths = dense, np.concatenate([[0.0], np.cumsum(pieces)])
        self.length = float(self._lengths[-1])

    def at(self, lengths: ArrayLike) -> Array:
        """See `Curve.at`."""
        return self._spline(self._parameters(lengths))

    def tangents(self, lengths: ArrayLike) -> Array:
        """See `Curve.tangents`."""
        return _unit(self._slope(self._parameters(lengths)))

    def _parameters(self, lengths: ArrayLike) -> Array:
        return np.interp(np.asarray(lengths, float), self._lengths, self._dense)


def arc_through(start: Array, via: Array, end: Array) -> ArcCurve | None:
    """Return the arc from `start` through `via` to `end`; None if they are collinear.

    Its centre is ``start + (|u|^2 v x n + |v|^2 n x u) / (2 |n|^2)`` with ``u = via - start``,
    ``v = end - start`` and the axis ``n = u x v``.
    """
    u, v = via - start, end - start
    normal = np.cross(u, v)
    square = float(normal @ normal)
    if square <= _STRAIGHT**2 * float(u @ u) * float(v @ v):
        return None
    centre = start + np.cross((u @ u) * v - (v @ v) * u, normal) / (2 * square)
    axis = normal / np.sqrt(square)
    x, y = start - centre, np.cross(axis, start - centre)
    angle = float(np.arctan2((end - centre) @ y, (end - centre) @ x)) % (2 * np.pi)
    return ArcCurve(centre, start, axis, angle)


def path_axes(tangents: Array) -> Array:
    """Return the axes of a path in the base frame.

    x is the tangent, z is the base's z axis made perpendicular to it (the base's x axis where the
    tangent is along z), and y is the cross product of z and x.

    `tangents`: (N, 3), unit vectors.

    Returns
    -------
    (N, 3, 3) array
        Columns x, y, z.
    """
    ups = np.zeros_like(tangents)
    along_z = np.hypot(tangents[:, 0], tangents[:, 1]) < _ALONG_Z
    ups[along_z, 0] = ups[~along_z, 2] = 1.0
    z = _unit(ups - np.sum(ups * tangents, axis=1, keepdims=True) * tangents)
    return np.stack([tangents, np.cross(z, tangents), z], axis=2)


@dataclass(frozen=True, eq=False)
class PathPoints:
    """The points of a path, and its curve."""

    targets: tuple[Target, ...]  # (N,), all prescribe the same components of the pose
    goals: tuple[StiffnessGoal | None, ...]  # (N,), with directions in base or tip axes
    positions: Array  # (N, 3), in m, base frame
    tangents: Array  # (N, 3), unit vectors
    lengths: Array  # (N,), arc length from the first point, in m
    times: Array | None  # (N,), in s, from 0; None if the rates decide
    curve: Curve  # the curve through the points

    def __len__(self) -> int:
        return len(self.targets)

    def at(self, length: ArrayLike) -> Array:
        """Return positions (..., 3) on the curve, in m, at arc lengths (...) in m."""
        return self.curve.at(length)


def interpolated(lengths: ArrayLike, knots: Array, rows: Array) -> Array:
    """Interpolate rows (k, 3) at knots (k,) linearly at arc lengths (...)."""
    x = np.asarray(lengths, float)
    return np.stack([np.interp(x, knots, column) for column in rows.T], axis=-1)


def _unit(vectors: Array) -> Array:
    """Normalise vectors (..., 3); zeros stay zeros."""
    sizes = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(sizes > 0, sizes, 1.0)
