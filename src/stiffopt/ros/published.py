"""The state of the loop as ROS 2 messages."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.control.state import Event, Severity, Snapshot, State
from stiffopt.daemon.state_json import json_of
from stiffopt.daemon.topics import BASE, TARGET, TIP, target_place, target_turn
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.plots.shapes import StiffnessEllipsoid, segment_poses, surface_mesh
from stiffopt.ros.messages import (
    ColorRGBA,
    DiagnosticArray,
    DiagnosticStatus,
    Duration,
    Header,
    JointState,
    KeyValue,
    Log,
    Marker,
    MarkerArray,
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    String,
    TFMessage,
    Time,
    Transform,
    TransformStamped,
    Vector3,
    Wrench,
    WrenchStamped,
)

Message = tuple[str, Any]
"""A topic and a message for it."""

PUBLISHED: dict[str, tuple[type[Any], int, bool]] = {
    "~/state": (String, 1, True),
    "~/pressure": (JointState, 10, False),
    "~/pressure_command": (JointState, 10, False),
    "~/tip": (PoseStamped, 10, False),
    "~/target": (PoseStamped, 10, False),
    "~/wrench": (WrenchStamped, 10, False),
    "~/markers": (MarkerArray, 10, False),
    "~/scene": (MarkerArray, 1, True),
    "/tf": (TFMessage, 100, False),
    "/diagnostics": (DiagnosticArray, 10, False),
    "/rosout": (Log, 1000, True),
}
"""Topics: the type, the depth of the history, and whether later readers get the last message."""

_STATIONS = 6  # of each segment, including both ends
_SOON = 1  # s after which a marker disappears unless it is published again
_ELLIPSOID_SHARE = 0.25  # of the arm's length, along the stiffest axis
_TARGET_SIZE = 0.008  # m
_CYLINDER, _SPHERE, _TRIANGLES = 3, 2, 11  # types of markers
_BODY, _STIFF = ColorRGBA(0.31, 0.47, 0.65, 0.7), ColorRGBA(0.95, 0.55, 0.15, 0.35)
_GOAL, _OBJECT = ColorRGBA(0.84, 0.15, 0.16, 0.8), ColorRGBA(0.5, 0.5, 0.5, 0.5)
_OK, _WARN, _ERROR = 0, 1, 2  # levels of diagnostics
_LEVELS = {Severity.INFO: 20, Severity.WARNING: 30, Severity.ERROR: 40}  # of a log


def channel_names(robot: RobotDescription) -> list[str]:
    """Return the names of the channels in messages, such as ``segment_2_channel_1``."""
    return [robot.channel_name(k).replace(" ", "_") for k in range(robot.n_pressures)]


def time_of(seconds: float) -> Time:
    """Return a date in s since 1970 as a message; `seconds_of` is the inverse."""
    moment = round(seconds * 1e9)
    return Time(moment // 10**9, moment % 10**9)


def seconds_of(time: Time | Duration) -> float:
    """Return a date or a duration in s."""
    return float(time.sec + time.nanosec * 1e-9)


class StateMessages:
    """Makes messages of the state.

    Parameters
    ----------
    robot : the model of the arm.
    rig : the name of the rig.
    node : name of the node in logs.
    epoch : date of time 0 on the rig's clock, in s since 1970.
    prefix : prefix of the names of frames.
    """

    def __init__(
        self, robot: Manipulator, rig: str, node: str, epoch: float, prefix: str = ""
    ) -> None:
        self._robot, self._rig, self._node = robot, rig, node
        self._epoch, self._prefix = epoch, prefix
        self._channels = channel_names(robot.description)
        self.base = prefix + BASE
        """Name of the frame of the arm's base."""

    def often(self, now: Snapshot) -> Iterator[Message]:
        """Yield the messages for a controller: pressures, tip, target, force and their frames.

        Unknown values are left out, except for single pressures, which are NaN.
        """
        header = self.header(now.time)
        yield "~/pressure", JointState(header, self._channels, now.measured.tolist())
        yield "~/pressure_command", JointState(header, self._channels, now.commanded.tolist())
        place, turn = target_place(now), target_turn(now)
        poses = {"~/tip": (TIP, now.tip_position, now.tip_quaternion)}
        if place is not None:
            poses["~/target"] = (TARGET, place, np.array([1.0, 0, 0, 0]) if turn is None else turn)
        frames = []
        for topic, (name, position, quaternion) in poses.items():
            if np.isfinite([*position, *quaternion]).all():
                yield topic, PoseStamped(header, _pose(position, quaternion))
                frames.append(self._frame(header, name, position, quaternion))
        if frames:
            yield "/tf", TFMessage(frames)
        if np.isfinite([*now.wrench[:3], *now.tip_quaternion]).all():
            turned = lie.rotation_from_quaternion(now.tip_quaternion).T @ now.wrench[:3]
            force = Vector3(*turned.tolist())  # in the tip's axes, as its frame is named
            yield (
                "~/wrench",
                WrenchStamped(self.header(now.time, TIP), Wrench(force, Vector3())),
            )

    def shape(self, now: Snapshot) -> Iterator[Message]:
        """Yield the model's shape at the present pressures: frames of stations, and markers.

        Nothing is yielded if a pressure is unknown. `StiffoptError`: the model has no equilibrium
        at these pressures.
        """
        pressures = now.pressures
        if pressures is None:
            return
        header = self.header(now.time)
        poses = segment_poses(self._robot, pressures, _STATIONS)  # (segments, stations, 4, 4)
        stations = poses[:, 1:].reshape(-1, 4, 4)
        turns = [np.asarray(lie.quaternion_from_rotation(pose[:3, :3])) for pose in stations]
        yield (
            "/tf",
            TFMessage(
                [
                    self._frame(header, f"station_{number}", pose[:3, 3], turn)
                    for number, (pose, turn) in enumerate(
                        zip(stations, turns, strict=True), start=1
                    )
                ]
            ),
        )
        markers = []
        for segment, along in zip(self._robot.description.segments, poses, strict=True):
            width = 2 * segment.outer_radius
            for first, second in pairwise(along):
                markers.append(_rod(first, second, width))
        found = StiffnessEllipsoid.of(self._robot.tip_compliance(pressures), stations[-1][:3, :3])
        axes = np.asarray(lie.quaternion_from_rotation(found.axes))
        sizes = 2 * found.radii(_ELLIPSOID_SHARE * self._robot.length)
        markers.append(_ball("ellipsoid", stations[-1][:3, 3], axes, sizes, _STIFF))
        place = target_place(now)
        if place is not None:
            straight = np.array([1.0, 0, 0, 0])
            markers.append(_ball("target", place, straight, np.full(3, _TARGET_SIZE), _GOAL))
        for number, marker in enumerate(markers):
            marker.header, marker.id, marker.lifetime = header, number, Duration(_SOON)
        yield "~/markers", MarkerArray(markers)

    def scene(self, scene: Scene | None, time: float) -> MarkerArray:
        """Return the objects of a scene as markers that stay."""
        markers = []
        for number, item in enumerate(() if scene is None else scene.objects):
            vertices, faces = surface_mesh(item.shape, self._robot.length)
            points = [Point(*map(float, corner)) for corner in vertices[faces.ravel()]]
            markers.append(
                Marker(
                    header=self.header(time), ns=item.name, id=number, type=_TRIANGLES,
                    scale=Vector3(1.0, 1.0, 1.0), color=_OBJECT, points=points,
                )
            )  # fmt: skip
        return MarkerArray(markers)

    def state(self, now: Snapshot) -> String:
        """Return the state and its reason."""
        return String(f"{now.state}: {now.reason}" if now.reason else str(now.state))

    def diagnostics(self, now: Snapshot, control: str) -> DiagnosticArray:
        """Return a diagnosis, with all single values of the state.

        `control` names the process on the graph that has control of the arm.
        """
        values = [
            KeyValue(key, value if isinstance(value, str) else json.dumps(value))
            for key, value in {**json_of(now, rounded=True), "control": control}.items()
            if not isinstance(value, (dict, list))
        ]
        waiting = now.state is State.HOLDING or bool(now.alarms)
        level = _ERROR if now.state is State.FAULT else _WARN if waiting else _OK
        name, reason = f"{self._node}: {self._rig}", self.state(now).data
        status = [DiagnosticStatus(level, name, reason, self._rig, values)]
        for alarm in now.alarms:
            named = f"{name}: {alarm.kind}"
            status.append(DiagnosticStatus(_WARN, named, alarm.text, self._rig, []))
        return DiagnosticArray(self.header(now.time, None), status)

    def log(self, event: Event) -> Log:
        """Return an event as a line of the log."""
        return Log(
            time_of(self._epoch + event.time), _LEVELS[event.severity], self._node,
            f"{event.kind}: {event.text}",
        )  # fmt: skip

    def answer(self, pressures: Array, time: float) -> JointState:
        """Return the pressures (n,), in Pa, of a solution."""
        return JointState(self.header(time), self._channels, pressures.tolist())

    def pose(self, pose: Array, time: float) -> PoseStamped:
        """Return a pose (4, 4) in the base."""
        turn = np.asarray(lie.quaternion_from_rotation(pose[:3, :3]))
        return PoseStamped(self.header(time), _pose(pose[:3, 3], turn))

    def header(self, time: float, frame: str | None = BASE) -> Header:
        """Return the header of a message at a time on the rig's clock."""
        name = "" if frame is None else self._prefix + frame
        return Header(time_of(self._epoch + time), name)

    def _frame(
        self, header: Header, name: str, position: Array, quaternion: Array
    ) -> TransformStamped:
        pose = _pose(position, quaternion)
        place = Vector3(pose.position.x, pose.position.y, pose.position.z)
        return TransformStamped(header, self._prefix + name, Transform(place, pose.orientation))


def _pose(position: Array, quaternion: Array) -> Pose:
    """Return a pose; `quaternion` (4,) has w first, the message last."""
    w, x, y, z = map(float, quaternion)
    return Pose(Point(*map(float, position)), Quaternion(x, y, z, w))


def _ball(name: str, place: Array, turn: Array, sizes: Sequence[float] | Array, colour: Any) -> Any:
    scale = Vector3(*map(float, sizes))
    return Marker(ns=name, type=_SPHERE, pose=_pose(place, turn), scale=scale, color=colour)


def _rod(first: Array, second: Array, width: float) -> Any:
    """Return the body between two stations (4, 4) as a cylinder about the line between them."""
    way = second[:3, 3] - first[:3, 3]
    length = float(np.linalg.norm(way))
    across = np.cross(first[:3, 1], way)
    axes = np.stack([across, np.cross(way, across), way], axis=1)
    axes /= np.linalg.norm(axes, axis=0)
    turn = np.asarray(lie.quaternion_from_rotation(axes))
    return Marker(
        ns="body", type=_CYLINDER, pose=_pose((first[:3, 3] + second[:3, 3]) / 2, turn),
        scale=Vector3(width, width, length), color=_BODY,
    )  # fmt: skip
