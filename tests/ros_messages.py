"""What the tests of the ROS 2 node share: a robot, and messages of targets and trajectories."""

from __future__ import annotations

from typing import Any

import pytest

from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.ros import messages as m


@pytest.fixture(name="robot", scope="module")
def robot_fixture() -> Manipulator:
    return load_robot("stiff-flop-2")


def pose(position: Any = (0, 0, 0.2), turn: Any = (0, 0, 0, 1), **header: Any) -> m.PoseStamped:
    head = m.Header(header.get("stamp", m.Time()), header.get("frame", "base"))
    place = m.Pose(m.Point(*map(float, position)), m.Quaternion(*map(float, turn)))
    return m.PoseStamped(head, place)


def points(*rows: Any, names: Any = None, times: Any = None) -> m.JointTrajectory:
    channels = [f"segment_{s}_channel_{c}" for s in (1, 2) for c in (1, 2, 3)]
    times = range(1, len(rows) + 1) if times is None else times
    return m.JointTrajectory(
        joint_names=channels if names is None else names,
        points=[
            m.JointTrajectoryPoint(
                positions=list(map(float, row)), time_from_start=m.Duration(int(t), 0)
            )
            for row, t in zip(rows, times, strict=True)
        ],
    )


SIX = (1e4,) * 6


def nothing() -> None:
    pass
