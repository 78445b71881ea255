"""`Trajectory`: targets over time, with or without pressures, as a controller accepts them."""

from __future__ import annotations

import itertools
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.optimise.target import Target
from stiffopt.schema import Items, Schema
from stiffopt.units import Duration, Pressure

MAX_WAYPOINTS = 2_000
"""Largest number in a trajectory: its splines are built between two ticks of the control loop."""
_LONGEST = 86_400.0  # s, longest duration of a trajectory
CLOSEST = 1e-3
"""Shortest time between waypoints, in s."""
_ROUNDING = 1e-6  # relative tolerance of that time
_ON_THE_LINE = 1e-3  # of a pressure's range; points nearer to a straight line may be left out


class Waypoint(Schema):
    """A target with its time.

    Attributes
    ----------
    time : since the beginning of the trajectory, in s; at most a day.
    target : the pose.
    pressures : the posture in which to reach it, one for each channel, in Pa; None for the
        stiffest.
    """

    time: Annotated[Duration, Field(ge=0, le=_LONGEST)]
    target: Target
    pressures: Items[Pressure] | None = None


class Trajectory(Schema):
    """Waypoints through which the tip passes.

    Without pressures, the tip passes them smoothly and the controller chooses the posture. With
    pressures, the posture is interpolated linearly between waypoints.

    Attributes
    ----------
    waypoints : in order of time, at least 1 ms apart, the first at 0 or at least 1 ms later. All
        prescribe the same components of the pose, and all have pressures or none has.
    """

    waypoints: Items[Waypoint]

    @model_validator(mode="after")
    def _check(self) -> Trajectory:
        if len(self.waypoints) > MAX_WAYPOINTS:
            raise ValueError(
                f"{len(self.waypoints)} waypoints are too many; at most {MAX_WAYPOINTS}"
            )
        check_times([w.time for w in self.waypoints])
        kinds = {_kind(w.target) for w in self.waypoints}
        if len(kinds) > 1:
            raise ValueError("all waypoints must ask for the same axes of the pose")
        _check_counts([w.pressures for w in self.waypoints])
        return self

    @property
    def duration(self) -> float:
        """Time of the last waypoint, in s."""
        return self.waypoints[-1].time

    @property
    def pressures(self) -> Array | None:
        """Pressures of all waypoints (k, n), in Pa; None if they have none."""
        if self.waypoints[0].pressures is None:
            return None
        return np.array([waypoint.pressures for waypoint in self.waypoints])


def trajectory_through(
    times: Array,
    pressures: Array,
    tips: Array,
    ranges: Array,
    begin: float = 0.0,
) -> Trajectory:
    """Return a trajectory from pressures and the resulting tip positions.

    If there are more points than a trajectory may have, or points closer in time, those are left
    out whose pressures linear interpolation reproduces to a thousandth of their range.

    Raises `InputError`: too many points remain.

    Parameters
    ----------
    times : (N,), in s, increasing from 0.
    pressures : (N, n), in Pa.
    tips : (N, 3), in m, in the base frame.
    ranges : (n,), ranges of the pressures, in Pa.
    begin : time of the first point, in s; it leaves the arm time to go there.
    """
    kept = np.arange(len(times))
    if len(kept) > MAX_WAYPOINTS or (np.diff(times) < CLOSEST).any():
        kept = without_straight(times, pressures / ranges, _ON_THE_LINE)
    return Trajectory(
        waypoints=tuple(
            Waypoint(
                time=begin + float(times[index]),
                target=Target(position=tuple(tips[index].tolist())),
                pressures=tuple(pressures[index].tolist()),
            )
            for index in kept
        )
    )


def check_times(times: list[float]) -> None:
    """Raise `InputError` for times that are out of range, not ascending or too close."""
    if not times:
        raise InputError("has no waypoints")
    for time in (times[0], times[-1]):
        if not 0 <= time <= _LONGEST:
            raise InputError(f"waypoints must be between 0 s and {_LONGEST:g} s, not at {time:g} s")
    for before, after in itertools.pairwise(times):
        if not after > before:
            raise InputError(
                f"waypoints must be in order of time; {after:g} s follows {before:g} s"
            )
    begun = times if times[0] == 0 else [0.0, *times]  # the trajectory begins where the tip is
    for before, after in itertools.pairwise(begun):
        if after - before < CLOSEST * (1 - _ROUNDING):
            raise InputError(
                f"waypoints must be at least {CLOSEST:g} s apart, and the first at 0 s or as "
                f"much later; {after:g} s follows {before:g} s"
            )


def without_straight(times: Array, values: Array, tolerance: float) -> NDArray[np.intp]:
    """Return indices (k,) of the points needed to interpolate values (N, n) linearly in time (N,).

    The first and the last point are kept; then, wherever the error exceeds the tolerance in any
    value, the point with the largest error (the algorithm of Ramer, Douglas and Peucker).
    """
    kept, open_ = {0, len(times) - 1}, [(0, len(times) - 1)]
    while open_:
        first, last = open_.pop()
        if last - first < 2:
            continue
        inner = slice(first + 1, last)
        share = ((times[inner] - times[first]) / (times[last] - times[first]))[:, None]
        line = values[first] + share * (values[last] - values[first])
        away = np.abs(values[inner] - line).max(axis=1)
        farthest = int(np.argmax(away))
        if away[farthest] > tolerance:
            index = first + 1 + farthest
            kept.add(index)
            open_ += [(first, index), (index, last)]
    return np.array(sorted(kept))


def _check_counts(pressures: list[tuple[float, ...] | None]) -> None:
    """Refuse waypoints that differ in their number of pressures, or in whether they have any."""
    counts = [None if each is None else len(each) for each in pressures]
    for number, count in enumerate(counts, start=1):
        if count == counts[0]:
            continue
        if count is None or counts[0] is None:
            have, lack = (1, number) if count is None else (number, 1)
            raise ValueError(
                f"waypoint {have} has pressures and waypoint {lack} has none; all have, or none has"
            )
        raise ValueError(
            f"waypoint {number} has {count} pressures, waypoint 1 has {counts[0]}; expected as many"
        )


def _kind(target: Target) -> tuple[object, ...]:
    axes = None if target.position is None else tuple(v is None for v in target.position)
    return axes, target.pointing is None, target.orientation is None
