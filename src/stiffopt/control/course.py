"""`Course`: the smooth interpolation of a trajectory, which gives a target at each time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.optimise.target import Target
from stiffopt.paths.trajectory import Trajectory, check_times

_OPPOSITE = -0.99  # cosine below which directions count as opposite: no unique way between them
_SHORT = 0.05  # length below which an interpolated direction is undefined
# The inverse of four lags without their delay, e^-4u (1 + u)^4 = 1 - 2 u^2 + 4/3 u^3 + u^4 + ...
# with u = s / a, by differences at these times, in delays 4 / a; weights of the positions there.
_AROUND = (-1.0, -0.5, 0.0, 0.5, 1.0)
_INVERSE = np.array([1.0, -36.0, 126.0, -52.0, 9.0]) / 48
_SAMPLES = 16  # between two waypoints, to find the greatest speed
_BETWEEN = np.arange(1, 8) / 8  # shares of the way between waypoints at which that is checked


class Course:
    """A trajectory under way: a target at each time.

    Positions, directions and quaternions follow cubic splines through the waypoints; directions and
    quaternions are normalised. The splines begin and end at rest, and stay at their ends.

    Raises `InputError`: successive waypoints have opposite directions, or no finite spline passes
    through them.

    Parameters
    ----------
    trajectory : the waypoints.
    begin : time at which it begins, in s.
    position, rotation : of the tip at that time, (3,) and (3, 3): the start if the first waypoint
        is later.
    """

    def __init__(
        self, trajectory: Trajectory, begin: float, position: Array, rotation: Array
    ) -> None:
        times = _numbers([waypoint.time for waypoint in trajectory.waypoints]).tolist()
        check_times(times)
        targets = [waypoint.target for waypoint in trajectory.waypoints]
        self._first = first = targets[0]
        later = times[0] > 0
        knots = np.array([0.0, *times] if later else times)
        self._position: Callable[..., Array] | None = None
        self._pointing: Callable[..., Array] | None = None
        self._orientation: Callable[..., Array] | None = None
        if first.position is not None:
            rows = [[0.0 if axis is None else axis for axis in t.position or ()] for t in targets]
            self._position = _spline(knots, [list(position), *rows] if later else rows)
        if first.pointing is not None:
            rows = [list(t.pointing or ()) for t in targets]
            rows = [list(rotation[:, 2]), *rows] if later else rows
            _refuse_opposites(rows)
            self._pointing = _checked(_spline(knots, rows), knots)
        if first.orientation is not None:
            rows = [list(t.orientation or ()) for t in targets]
            if later:
                rows.insert(0, lie.quaternion_from_rotation(rotation).tolist())
            self._orientation = _checked(_spline(knots, _nearer_signs(rows)), knots)
        self._knots = knots
        self.begin, self.end = begin, begin + times[-1]

    def sampled(self) -> tuple[Array, Array]:
        """Return times (k,) from its beginning, in s, and positions (k, 3) there; free axes are 0.

        They are so close together that the greatest speed is seen.
        """
        shares = np.arange(_SAMPLES) / _SAMPLES
        inner = self._knots[:-1, None] + np.diff(self._knots)[:, None] * shares
        times = np.append(inner, self._knots[-1])
        if self._position is None:
            return times, np.zeros((len(times), 3))
        return times, self._position(times)

    def at(self, now: float, delay: float = 0.0) -> Target:
        """Return the target at a time, in s, for a reference that smooths it.

        `delay` is that of the reference's four equal lags, in s. The smoothed positions are then,
        that much later, those of the course, except for its fifth and higher derivatives.
        """
        t, *around = (
            float(np.clip(now + share * delay - self.begin, self._knots[0], self._knots[-1]))
            for share in (0.0, *_AROUND)
        )
        update: dict[str, object] = {}
        if self._position is not None and self._first.position is not None:
            values = self._position(t)
            if delay:
                values = _INVERSE @ self._position(np.array(around))
            update["position"] = tuple(
                None if axis is None else float(value)
                for axis, value in zip(self._first.position, values, strict=True)
            )
        if self._pointing is not None:
            direction = self._pointing(t)
            update["pointing"] = tuple((direction / np.linalg.norm(direction)).tolist())
        if self._orientation is not None:
            q = self._orientation(t)
            q = q / (math.copysign(1.0, q[0]) * np.linalg.norm(q))
            update["orientation"] = tuple(q.tolist())
        return self._first.model_copy(update=update)


def _refuse_opposites(directions: list[list[float]]) -> None:
    for before, after in itertools.pairwise(np.array(directions)):
        if float(before @ after) < _OPPOSITE:
            raise InputError(
                "two waypoints after each other point in opposite directions; put one between them"
            )


def _nearer_signs(quaternions: list[list[float]]) -> list[list[float]]:
    """Choose the sign of each quaternion that is nearer to the last one."""
    rows = [np.array(quaternions[0])]
    for q in quaternions[1:]:
        closeness = float(rows[-1] @ np.array(q))
        if abs(closeness) < 1 + _OPPOSITE:
            raise InputError(
                "two waypoints after each other are turned by half a turn; put one between them"
            )
        rows.append(math.copysign(1.0, closeness) * np.array(q))
    return [row.tolist() for row in rows]


def _numbers(rows: object) -> Array:
    """Return lists of equally many numbers as an array; refuse anything else."""
    try:
        return np.array(rows, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise InputError("waypoints: expected finite numbers, as many in each") from None


def _spline(knots: Array, rows: list[list[float]]) -> Callable[..., Array]:
    """Return the spline through rows at knots, as a function of one or many times."""
    values = _numbers(rows)
    if not (np.isfinite(knots).all() and np.isfinite(values).all()):
        raise InputError("waypoints, and where the tip is at the beginning, must be finite")
    if len(knots) == 1:
        return lambda times: np.broadcast_to(values[0], (*np.shape(times), values.shape[1]))
    try:
        with np.errstate(all="ignore"):
            spline = CubicSpline(knots, values, bc_type="clamped")
    except ValueError as error:
        raise InputError(f"nothing smooth leads through the waypoints: {error}") from None
    if not np.isfinite(spline.c).all():
        raise InputError("nothing smooth leads through the waypoints; they are too close in time")
    return spline


def _checked(spline: Callable[..., Array], knots: Array) -> Callable[..., Array]:
    """Return a spline that will be normalised; refuse one that passes near zero."""
    gaps = np.diff(knots)[:, None] * _BETWEEN
    between = spline((knots[:-1, None] + gaps).ravel())
    if (np.linalg.norm(between, axis=-1) < _SHORT).any():
        raise InputError("the way between two waypoints is not clear; put one between them")
    return spline
