"""`PostureCourse`: a trajectory of pressures that the arm follows as its posture."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.optimise.target import Target
from stiffopt.paths.trajectory import Trajectory


class PostureCourse:
    """A trajectory of pressures under way, on straight lines from waypoint to waypoint.

    At a waypoint, the tip is to be at the waypoint's target. The target differs from the model's
    tip at the waypoint's pressures. Between waypoints this difference is interpolated, and the tip
    goes where the pressures take it plus the difference.

    Parameters
    ----------
    trajectory : the waypoints, with n pressures each.
    begin : time at which it begins, in s.
    start : start (n + 6,) if the first waypoint is later, as `goal` returns it.
    pose_at : returns the model's tip pose (4, 4) at pressures (n,).
    """

    def __init__(
        self, trajectory: Trajectory, begin: float, start: Array, pose_at: Callable[[Array], Array]
    ) -> None:
        pressures = trajectory.pressures
        if pressures is None:
            raise InputError("the waypoints have no pressures")
        times = np.array([waypoint.time for waypoint in trajectory.waypoints])
        n = pressures.shape[1]
        self._targets: list[Target | None] = [each.target for each in trajectory.waypoints]
        self._known: dict[int, Array] = {}
        if times[0] > 0:
            times, pressures = np.append(0.0, times), np.vstack([start[:n], pressures])
            self._targets.insert(0, None)
            self._known[0] = start[n:]
        self._times, self._pressures, self._pose_at = times, pressures, pose_at
        self._first = trajectory.waypoints[0].target
        self.begin = begin

    def wait(self, duration: float) -> None:
        """Delay the rest of the trajectory by a duration, in s."""
        self.begin += duration

    def goal(self, now: float) -> Array:
        """Return pressures at a time, and the tip's intended offset from the model (n + 6,).

        The offset is a displacement, in m, and a rotation vector, both in base axes.
        """
        times = self._times
        t = min(max(now - self.begin, times[0]), times[-1])
        after = min(max(int(np.searchsorted(times, t)), 1), len(times) - 1)
        before = max(after - 1, 0)
        if before == after:  # a single waypoint
            return np.concatenate([self._pressures[0], self._difference(0)])
        share = (t - times[before]) / (times[after] - times[before])
        ends = [
            np.concatenate([self._pressures[each], self._difference(each)])
            for each in (before, after)
        ]
        return (1 - share) * ends[0] + share * ends[1]

    def at(self, now: float) -> Target:
        """Return the first waypoint's target; all waypoints have targets of its kind."""
        return self._first

    def target(self, pose: Array, difference: Array) -> Target:
        """Return the target for a model's tip pose (4, 4) and a difference (6,), see `goal`."""
        update: dict[str, object] = {}
        rotation = lie.exp(np.append(np.zeros(3), difference[3:]))[:3, :3] @ pose[:3, :3]
        if self._first.position is not None:
            update["position"] = tuple(
                None if axis is None else float(value)
                for axis, value in zip(
                    self._first.position, pose[:3, 3] + difference[:3], strict=True
                )
            )
        if self._first.pointing is not None:
            update["pointing"] = tuple(rotation[:, 2].tolist())
        if self._first.orientation is not None:
            update["orientation"] = tuple(lie.quaternion_from_rotation(rotation).tolist())
        return self._first.model_copy(update=update)

    def _difference(self, waypoint: int) -> Array:
        """Return the difference (6,) at a waypoint, computed when it is first needed."""
        if waypoint not in self._known:
            target = self._targets[waypoint]
            assert target is not None  # the start is known
            pose = self._pose_at(self._pressures[waypoint])
            self._known = {k: v for k, v in self._known.items() if k >= waypoint - 1}
            self._known[waypoint] = difference(target, pose)
        return self._known[waypoint]


def difference(target: Target, pose: Array) -> Array:
    """Return the motion (6,) from a pose (4, 4) to a target; 0 in components left free."""
    found, rotation = np.zeros(6), pose[:3, :3]
    if target.position is not None:
        pairs = zip(target.position, pose[:3, 3], strict=True)
        found[:3] = [0.0 if axis is None else axis - here for axis, here in pairs]
    if target.orientation is not None:
        wanted = np.asarray(lie.rotation_from_quaternion(np.array(target.orientation)))
        turn = lie.quaternion_from_rotation(wanted @ rotation.T)
        found[3:] = lie.rotation_vector_from_quaternion(turn)
    elif target.pointing is not None:
        axis = np.cross(rotation[:, 2], target.pointing)
        sine = float(np.linalg.norm(axis))
        if sine > 0:
            angle = math.atan2(sine, float(rotation[:, 2] @ np.array(target.pointing)))
            found[3:] = angle / sine * axis
    return found
