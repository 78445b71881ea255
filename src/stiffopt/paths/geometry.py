"""Lines in space by their arc length, and the points of a path on one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.optimise.goal import StiffnessGoal
from stiffopt.optimise.target import Target

Vector = NDArray[np.float64]

_SAMPLES = 20_000  # of a spline, for its arc length
_STRAIGHT = 1e-6  # sine of the angle between two chords up to which three points are on one line
_ALONG_Z = 1e-6  # sine of a tangent's angle to the base's z axis below which x stands in for it


class Curve(ABC):
    """A line in space, by its arc length from its start.

    Attributes
    ----------
    length : float
        In m.
    """

    length: float

    @abstractmethod
    def at(self, lengths: ArrayLike) -> Vector:
        """Positions (..., 3) in m at arc lengths (...) in m."""

    @abstractmethod
    def tangents(self, lengths: ArrayLike) -> Vector:
        """Unit vectors (..., 3) along it there; zero on a polyline that never leaves its start."""


class Polyline(Curve):
    """Straight lines from point to point.

    At a point its tangent halves the angle between the two lines, or is that of the second where
    it turns right back.

    Parameters
    ----------
    points : (k, 3)
        In m; some may be the same.
    closed : bool
        Whether it ends where it begins, and goes on there.
    """

    def __init__(self, points: Vector, closed: bool = False) -> None:
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

    def at(self, lengths: ArrayLike) -> Vector:
        """See `Curve.at`."""
        return _interpolated(lengths, self.knots, self.points)

    def tangents(self, lengths: ArrayLike) -> Vector:
        """See `Curve.tangents`."""
        return _unit(_interpolated(lengths, self.knots, self._tangents))


class ArcCurve(Curve):
    """A part of a circle, or all of it.

    Parameters
    ----------
    centre, start : (3,)
        In m.
    axis : (3,)
        Unit vector across its plane, about which it turns to the left.
    angle : float
        By which it turns, in rad.
    """

    def __init__(self, centre: Vector, start: Vector, axis: Vector, angle: float) -> None:
        self._centre, self._x = centre, start - centre
        self._y = np.cross(axis, self._x)
        self._radius = float(np.linalg.norm(self._x))
        self.length = angle * self._radius

    def at(self, lengths: ArrayLike) -> Vector:
        """See `Curve.at`."""
        angle = np.asarray(lengths, dtype=float)[..., None] / self._radius
        return self._centre + np.cos(angle) * self._x + np.sin(angle) * self._y

    def tangents(self, lengths: ArrayLike) -> Vector:
        """See `Curve.tangents`."""
        angle = np.asarray(lengths, dtype=float)[..., None] / self._radius
        return _unit(np.cos(angle) * self._y - np.sin(angle) * self._x)


class SplineCurve(Curve):
    """The cubic spline through points, in the lengths of the chords between them.

    Its arc length is integrated by Simpson's rule between many points.

    Parameters
    ----------
    points : (k, 3)
        In m, k >= 2, no two in a row the same.
    closed : bool
        Whether the last point is the first, and the spline is periodic; else it is straight at both
        ends (natural).
    """

    def __init__(self, points: Vector, closed: bool = False) -> None:
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

    def at(self, lengths: ArrayLike) -> Vector:
        """See `Curve.at`."""
        found: Vector = self._spline(self._parameters(lengths))
        return found

    def tangents(self, lengths: ArrayLike) -> Vector:
        """See `Curve.tangents`."""
        return _unit(self._slope(self._parameters(lengths)))

    def _parameters(self, lengths: ArrayLike) -> Vector:
        found: Vector = np.interp(np.asarray(lengths, float), self._lengths, self._dense)
        return found


def arc_through(start: Vector, via: Vector, end: Vector) -> ArcCurve | None:
    """Return the arc from a point over a second to a third one; None if they are on one line.

    Its centre is ``start + (|u|^2 v x n + |v|^2 n x u) / (2 |n|^2)`` with ``u = via - start``,
    ``v = end - start`` and ``n = u x v``, about which it turns.
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


def path_axes(tangents: Vector) -> Vector:
    """Return the axes of a path in the base frame.

    x is along the tangent, z is the base's z axis made perpendicular to it (where the tangent is
    along that, the base's x axis), and y = z x x.

    Parameters
    ----------
    tangents : (N, 3)
        Unit vectors.

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
    """The points of a path, and the line that they are on.

    Attributes
    ----------
    targets : tuple of Target (N,)
        What is asked at each point; all of the same parts.
    goals : tuple of StiffnessGoal or None (N,)
        With directions in base or tip axes.
    positions : ndarray (N, 3)
        In m, base frame.
    tangents : ndarray (N, 3)
        Unit vectors.
    lengths : ndarray (N,)
        Arc length from the first point, in m.
    times : ndarray (N,) or None
        In s, from 0; None where the rates decide.
    curve : Curve
        The line, for what is between the points.
    """

    targets: tuple[Target, ...]
    goals: tuple[StiffnessGoal | None, ...]
    positions: Vector
    tangents: Vector
    lengths: Vector
    times: Vector | None
    curve: Curve

    def __len__(self) -> int:
        return len(self.targets)

    def at(self, length: ArrayLike) -> Vector:
        """Position (..., 3) in m of the line at an arc length (...) in m."""
        return self.curve.at(length)


def _interpolated(lengths: ArrayLike, knots: Vector, rows: Vector) -> Vector:
    """Rows (k, 3) at knots (k,), interpolated linearly at arc lengths (...)."""
    x = np.asarray(lengths, float)
    return np.stack([np.interp(x, knots, column) for column in rows.T], axis=-1)


def _unit(vectors: Vector) -> Vector:
    """Vectors (..., 3) at length 1; zeros stay zeros."""
    sizes = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(sizes > 0, sizes, 1.0)
