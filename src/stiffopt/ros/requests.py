"""Conversion of ROS 2 messages to targets, trajectories and tasks; invalid ones are refused."""

from __future__ import annotations

from typing import Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.daemon.messages import task_of
from stiffopt.errors import InputError, shown
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.paths.trajectory import Trajectory, trajectory_through
from stiffopt.ros.messages import Header, JointTrajectory, PointStamped, PoseStamped
from stiffopt.ros.published import channel_names, seconds_of

MAX_AGE = 1.0
"""Greatest difference between the stamp of a request and now, in s: no recording moves the arm."""
MAX_POINTS = 20_000
"""Of a trajectory; points on straight lines are left out, see `trajectory_through`."""
_UNIT = 0.01  # by which the length of a quaternion may differ from 1


def check_stamp(header: Header, now: float) -> None:
    """Raise `InputError` unless a message has a present stamp (`now` in s since 1970), or none."""
    stamp = seconds_of(header.stamp)
    if stamp and abs(now - stamp) > MAX_AGE:
        which = "old" if stamp < now else "in the future"
        raise InputError(
            f"the stamp is {abs(now - stamp):.1f} s {which}, more than {MAX_AGE:g} s; do not play "
            "recordings of commands, synchronise the clocks, or leave the stamp at zero"
        )


def check_frame(header: Header, base: str) -> None:
    """Raise `InputError` unless a message is in the frame of the base."""
    if header.frame_id != base:
        raise InputError(
            f"frame_id is {shown(header.frame_id)}; expected '{base}', the arm's base: nothing is "
            "transformed here"
        )


def target_of(message: PoseStamped | PointStamped, base: str, now: float) -> Target:
    """Return the target of a pose, or of a point, in the base frame.

    Raises `InputError`: it is old, in another frame or not finite, or its quaternion does not have
    length 1.
    """
    check_stamp(message.header, now)
    check_frame(message.header, base)
    point = message.point if isinstance(message, PointStamped) else message.pose.position
    position = _finite([point.x, point.y, point.z], "the position")
    if isinstance(message, PointStamped):
        return Target(position=tuple(position.tolist()))
    q = message.pose.orientation
    turn = _finite([q.w, q.x, q.y, q.z], "the orientation")
    length = float(np.linalg.norm(turn))
    if abs(length - 1) > _UNIT:
        raise InputError(
            f"the orientation is a quaternion of length {length:.3g}, not 1; for a position alone, "
            "send a point"
        )
    orientation = tuple((turn / length).tolist())
    return Target(position=tuple(position.tolist()), orientation=orientation)


def trajectory_of(message: JointTrajectory, robot: Manipulator, now: float) -> Trajectory:
    """Return a trajectory of pressures, given in Pa as positions of channels in any order.

    The model determines the tip's targets. Velocities, accelerations and effort are not used:
    between two points the pressures change linearly.

    Raises `InputError`: it is old, does not name each channel once, or its points are no pressures
    over time.
    """
    check_stamp(message.header, now)
    channels = channel_names(robot.description)
    names = list(message.joint_names)
    unknown = [name for name in names if name not in channels]
    if unknown or len(set(names)) != len(names) or len(names) != len(channels):
        wrong = f"{shown(unknown[0])} is no channel of this arm" if unknown else (
            f"{len(names)} joint names are given, or one of them twice"
        )  # fmt: skip
        raise InputError(f"{wrong}; expected each of {', '.join(channels)} once")
    for number, point in enumerate(message.points, start=1):
        if len(point.positions) != len(names):
            raise InputError(
                f"point {number} has {len(point.positions)} positions for {len(names)} joint names"
            )
    if not 0 < len(message.points) <= MAX_POINTS:
        raise InputError(f"there are {len(message.points)} points; expected 1 to {MAX_POINTS}")
    order = [names.index(channel) for channel in channels]
    rows = [[point.positions[k] for k in order] for point in message.points]
    pressures = _finite(rows, "the positions")
    times = np.array([seconds_of(point.time_from_start) for point in message.points])
    if times[0] < 0 or not (np.diff(times) > 0).all():
        raise InputError("time_from_start must increase from point to point, and not be negative")
    tips = robot.tip_pose(pressures)[:, :3, 3]
    ranges = robot.pressure_max - robot.pressure_min
    return trajectory_through(times - times[0], pressures, tips, ranges, float(times[0]))


def task_in(text: str, robot: str) -> Task:
    """Return the task in the text of a task file, which may name no other robot and no file."""
    return task_of({"text": text}, robot).model_copy(update={"robot": None})


def _finite(values: Any, what: str) -> Array:
    numbers = np.array(values, dtype=float)
    if not np.isfinite(numbers).all():
        raise InputError(f"{what} must be finite numbers")
    return numbers
