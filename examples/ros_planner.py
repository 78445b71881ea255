"""A planner on a ROS 2 graph, without MoveIt and without ROS: it plans pressures and sends them.

In one terminal, with `ros: {commands: true, interface: lo}` in the rig file:

    stiffopt ros my-rig.yaml

In another:

    python examples/ros_planner.py stiff-flop-1 "20, 5, 95" "-10, 15, 93"

It reads the present pressures, finds the stiffest pressures for each target in mm (or the lowest
ones if the target leaves no choice), and sends them as one JointTrajectory of pressures. It offers
a lease of liveliness: when it is killed, the arm is held, lowered and vented.
docs/ros.md has the same writer for a node of rclpy.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

import stiffopt
from stiffopt.ros.messages import (
    Duration,
    Empty,
    JointState,
    JointTrajectory,
    JointTrajectoryPoint,
    PoseStamped,
    String,
)

LOOPBACK = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo" multicast="true"/>'
    "</Interfaces></General></Domain></CycloneDDS>"
)
STEP = 2.0  # s from one target to the next
NEAR = 2e-3  # m


def quality(*more: object) -> Qos:
    """Return the default of ROS 2."""
    return Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.History.KeepLast(10),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        *more,
    )


def newest(reader: DataReader, seconds: float = 30.0) -> object:
    """Return the newest message, waiting for one if need be."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        messages = [each for each in reader.take(100) if each.sample_info.valid_data]
        if messages:
            return messages[-1]
        time.sleep(0.01)
    raise SystemExit("nothing was heard; does 'stiffopt ros' run, on the same domain?")


def main() -> None:
    """Plan, arm, send, and stay until the tip is at the last target."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robot", help="name or file of the robot of the rig")
    parser.add_argument("targets", nargs="+", help="x, y, z of the tip, in mm")
    parser.add_argument("--node", default="/stiffopt")
    parser.add_argument("--domain", type=int, default=0)
    given = parser.parse_args()

    domain = Domain(given.domain, LOOPBACK)
    participant = DomainParticipant(given.domain)

    def topic(name: str, kind: type) -> Topic:
        return Topic(participant, f"rt{given.node}/{name}", kind)

    pressures = DataReader(participant, topic("pressure_command", JointState), qos=quality())
    tips = DataReader(participant, topic("tip", PoseStamped), qos=quality())
    states = DataReader(participant, topic("state", String), qos=quality())
    arms = DataWriter(participant, topic("arm", Empty), qos=quality())
    lively = Policy.Liveliness.Automatic(duration(milliseconds=500))
    motions = DataWriter(
        participant, topic("follow_trajectory", JointTrajectory), qos=quality(lively)
    )

    robot = stiffopt.load_robot(given.robot)
    now = newest(pressures)
    guess, points = np.array(now.position), [JointTrajectoryPoint(positions=list(now.position))]
    for number, text in enumerate(given.targets, start=1):
        position = tuple(float(part) * 1e-3 for part in text.split(","))
        task = stiffopt.Task(
            target=stiffopt.Target(position=position, tolerance={"position": 1e-3}),
            stiffness={"maximise": {"direction": (1, 0, 0)}},
        )
        found = stiffopt.solve_pressure(robot, task, guess=guess)
        if not found.found:
            raise SystemExit(f"target {number}: {found.message}")
        guess = found.pressures
        point = JointTrajectoryPoint(
            positions=guess.tolist(), time_from_start=Duration(int(STEP * number), 0)
        )
        points.append(point)
        print(f"target {number}: {found.stiffness:.2f} N/m, {(guess / 1e5).round(2)} bar")

    while not newest(states).data.startswith("active"):
        arms.write(Empty())  # refused until gauges and tracker have been known for a while
        time.sleep(0.5)
    motions.write(JointTrajectory(joint_names=now.name, points=points))
    end = robot.tip_pose(guess)[:3, 3]
    deadline = time.monotonic() + STEP * len(points) + 30
    while time.monotonic() < deadline:
        tip = newest(tips).pose.position
        if np.linalg.norm([tip.x, tip.y, tip.z] - end) < NEAR:
            print("there")
            break
    else:
        raise SystemExit("the tip did not get there; /rosout says why")
    del domain  # it is kept until here


if __name__ == "__main__":
    main()
