"""Trajectories: where the tip shall be, and when."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.interpolate import CubicSpline

from stiffopt import lie
from stiffopt.errors import InputError
from stiffopt.optimise.target import Target
from stiffopt.schema import Items, Schema
from stiffopt.units import Duration

__all__ = ["Course", "Trajectory", "Waypoint"]

Array = NDArray[np.float64]

_OPPOSITE = -0.99  # cosine between directions, beyond which the way is not clear


class Waypoint(Schema):
    """A target and when to be there.

    Attributes
    ----------
    time : since the beginning of the trajectory, in s.
    target : the pose.
    """

    time: Annotated[Duration, Field(ge=0)]
    target: Target


class Trajectory(Schema):
    """Waypoints, through which the tip goes smoothly.

    Attributes
    ----------
    waypoints : in order of time; all ask for the same kinds of things (the same axes).
    """

    waypoints: Items[Waypoint]

    @model_validator(mode="after")
    def _check(self) -> Trajectory:
        if not self.waypoints:
            raise ValueError("has no waypoints")
        times = [w.time for w in self.waypoints]
        for before, after in itertools.pairwise(times):
            if after <= before:
                raise ValueError(
                    f"waypoints must be in order of time; {after:g} s follows {before:g} s"
                )
        kinds = {_kind(w.target) for w in self.waypoints}
        if len(kinds) > 1:
            raise ValueError("all waypoints must ask for the same axes of the pose")
        return self

    @property
    def duration(self) -> float:
        """Time of the last waypoint, in s."""
        return self.waypoints[-1].time


def _kind(target: Target) -> tuple[object, ...]:
    axes = None if target.position is None else tuple(v is None for v in target.position)
    return axes, target.pointing is None, target.orientation is None


class Course:
    """A trajectory under way: a target for each moment.

    Positions, directions and quaternions run along cubic splines through the waypoints, the latter
    two made unit vectors again; at rest at both ends, which are held.

    Parameters
    ----------
    trajectory :
        The waypoints.
    begin :
        When it begins, in s.
    position, rotation :
        Of the tip then, (3,) and (3, 3): where it begins if the first waypoint is later.

    Raises
    ------
    InputError
        Waypoints point in opposite directions.
    """

    def __init__(
        self, trajectory: Trajectory, begin: float, position: Array, rotation: Array
    ) -> None:
        self.begin, self.end = begin, begin + trajectory.duration
        first = trajectory.waypoints[0].target
        self._first = first
        times = [waypoint.time for waypoint in trajectory.waypoints]
        targets = [waypoint.target for waypoint in trajectory.waypoints]
        later = times[0] > 0
        knots = np.array([0.0, *times] if later else times)
        self._position = self._pointing = self._orientation = None
        if first.position is not None:
            rows = [[0.0 if axis is None else axis for axis in t.position or ()] for t in targets]
            self._position = _spline(knots, [list(position), *rows] if later else rows)
        if first.pointing is not None:
            rows = [list(t.pointing or ()) for t in targets]
            rows = [list(rotation[:, 2]), *rows] if later else rows
            _refuse_opposites(rows)
            self._pointing = _spline(knots, rows)
        if first.orientation is not None:
            rows = [list(t.orientation or ()) for t in targets]
            if later:
                rows.insert(0, lie.quaternion_from_rotation(rotation).tolist())
            self._orientation = _spline(knots, _the_short_way(rows))
        self._knots = knots

    def at(self, now: float) -> Target:
        """Target at a moment, in s."""
        t = float(np.clip(now - self.begin, self._knots[0], self._knots[-1]))
        update: dict[str, object] = {}
        if self._position is not None and self._first.position is not None:
            values = self._position(t)
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


def _the_short_way(quaternions: list[list[float]]) -> list[list[float]]:
    """Quaternions, each with the sign that is nearer to the one before."""
    rows = [np.array(quaternions[0])]
    for q in quaternions[1:]:
        closeness = float(rows[-1] @ np.array(q))
        if abs(closeness) < 1 + _OPPOSITE:
            raise InputError(
                "two waypoints after each other are turned by half a turn; put one between them"
            )
        rows.append(math.copysign(1.0, closeness) * np.array(q))
    return [row.tolist() for row in rows]


def _spline(knots: Array, rows: list[list[float]]) -> Callable[[float], Array]:
    values = np.array(rows, dtype=float)
    if len(knots) == 1:
        return lambda _: values[0]
    spline: Callable[[float], Array] = CubicSpline(knots, values, bc_type="clamped")
    return spline
