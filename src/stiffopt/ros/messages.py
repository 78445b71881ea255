"""The ROS 2 messages and services of the node, as types of cyclonedds.

Fields, order and types are those of the standard definitions, which are the same in Humble and
Jazzy, except for `Gid`. An empty message has one byte on the wire. A request and a reply begin with
the header of rmw_cyclonedds: the client, and the number of the request.
"""

import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, get_args

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import autoid, final
from cyclonedds.idl.types import (
    array,
    byte,
    float32,
    float64,
    int8,
    int32,
    int64,
    sequence,
    uint8,
    uint16,
    uint32,
    uint64,
)

_NOTHING = {"structure_needs_at_least_one_member": uint8}
_CALL = {"guid": uint64, "number": int64}


def _empty(hint: Any) -> Callable[[], Any]:
    """Return a factory of a type's default value: zero or empty."""
    kind, wire = get_args(hint) or (hint, None)
    if isinstance(wire, array):
        return lambda: [0] * wire.length
    return list if isinstance(wire, sequence) else kind


def _type(full: str, values: Mapping[str, Any] = {}, /, **fields: Any) -> Any:
    """Return a dataclass of these fields, empty except for `values`, in ROS 2's serialisation."""
    package, kind, name = full.split("/")

    def fill(space: dict[str, Any]) -> None:
        space.update({key: field(default_factory=_empty(hint)) for key, hint in fields.items()})
        space.update(values, __annotations__=fields, __module__=__name__)

    made = types.new_class(name, (IdlStruct,), {"typename": f"{package}.{kind}.dds_.{name}_"}, fill)
    return dataclass(final(autoid("sequential")(made)))


def ros_name(kind: type[Any]) -> str:
    """Return the name of a type as ROS 2 writes it, such as ``std_msgs/msg/String``."""
    package, folder, _, name = kind.__idl__.idl_transformed_typename.split("::")
    return f"{package}/{folder}/{name.removesuffix('_')}"


Time: Any = _type("builtin_interfaces/msg/Time", sec=int32, nanosec=uint32)
Duration: Any = _type("builtin_interfaces/msg/Duration", sec=int32, nanosec=uint32)

Header: Any = _type("std_msgs/msg/Header", stamp=Time, frame_id=str)
Empty: Any = _type("std_msgs/msg/Empty", **_NOTHING)
String: Any = _type("std_msgs/msg/String", data=str)
ColorRGBA: Any = _type("std_msgs/msg/ColorRGBA", r=float32, g=float32, b=float32, a=float32)

Point: Any = _type("geometry_msgs/msg/Point", x=float64, y=float64, z=float64)
Vector3: Any = _type("geometry_msgs/msg/Vector3", x=float64, y=float64, z=float64)
Quaternion: Any = _type(
    "geometry_msgs/msg/Quaternion", {"w": 1.0}, x=float64, y=float64, z=float64, w=float64
)
Pose: Any = _type("geometry_msgs/msg/Pose", position=Point, orientation=Quaternion)
PoseStamped: Any = _type("geometry_msgs/msg/PoseStamped", header=Header, pose=Pose)
PointStamped: Any = _type("geometry_msgs/msg/PointStamped", header=Header, point=Point)
Wrench: Any = _type("geometry_msgs/msg/Wrench", force=Vector3, torque=Vector3)
WrenchStamped: Any = _type("geometry_msgs/msg/WrenchStamped", header=Header, wrench=Wrench)
Transform: Any = _type("geometry_msgs/msg/Transform", translation=Vector3, rotation=Quaternion)
TransformStamped: Any = _type(
    "geometry_msgs/msg/TransformStamped", header=Header, child_frame_id=str, transform=Transform
)
TFMessage: Any = _type("tf2_msgs/msg/TFMessage", transforms=sequence[TransformStamped])

JointState: Any = _type(
    "sensor_msgs/msg/JointState", header=Header, name=sequence[str],
    position=sequence[float64], velocity=sequence[float64], effort=sequence[float64],
)  # fmt: skip
JointTrajectoryPoint: Any = _type(
    "trajectory_msgs/msg/JointTrajectoryPoint",
    positions=sequence[float64], velocities=sequence[float64], accelerations=sequence[float64],
    effort=sequence[float64], time_from_start=Duration,
)  # fmt: skip
JointTrajectory: Any = _type(
    "trajectory_msgs/msg/JointTrajectory", header=Header, joint_names=sequence[str],
    points=sequence[JointTrajectoryPoint],
)  # fmt: skip

KeyValue: Any = _type("diagnostic_msgs/msg/KeyValue", key=str, value=str)
DiagnosticStatus: Any = _type(
    "diagnostic_msgs/msg/DiagnosticStatus",
    level=byte, name=str, message=str, hardware_id=str, values=sequence[KeyValue],
)  # fmt: skip
DiagnosticArray: Any = _type(
    "diagnostic_msgs/msg/DiagnosticArray", header=Header, status=sequence[DiagnosticStatus]
)
Log: Any = _type(
    "rcl_interfaces/msg/Log",
    stamp=Time, level=uint8, name=str, msg=str, file=str, function=str, line=uint32,
)  # fmt: skip

CompressedImage: Any = _type(
    "sensor_msgs/msg/CompressedImage", header=Header, format=str, data=sequence[uint8]
)
UVCoordinate: Any = _type("visualization_msgs/msg/UVCoordinate", u=float32, v=float32)
MeshFile: Any = _type("visualization_msgs/msg/MeshFile", filename=str, data=sequence[uint8])
Marker: Any = _type(
    "visualization_msgs/msg/Marker",
    header=Header, ns=str, id=int32, type=int32, action=int32, pose=Pose, scale=Vector3,
    color=ColorRGBA, lifetime=Duration, frame_locked=bool, points=sequence[Point],
    colors=sequence[ColorRGBA], texture_resource=str, texture=CompressedImage,
    uv_coordinates=sequence[UVCoordinate], text=str, mesh_resource=str, mesh_file=MeshFile,
    mesh_use_embedded_materials=bool,
)  # fmt: skip
MarkerArray: Any = _type("visualization_msgs/msg/MarkerArray", markers=sequence[Marker])

TriggerRequest: Any = _type("std_srvs/srv/Trigger_Request", **_CALL, **_NOTHING)
TriggerResponse: Any = _type("std_srvs/srv/Trigger_Response", **_CALL, success=bool, message=str)
SolvePressureRequest: Any = _type(
    "stiffopt_msgs/srv/SolvePressure_Request", **_CALL, task=str, target=PoseStamped
)
SolvePressureResponse: Any = _type(
    "stiffopt_msgs/srv/SolvePressure_Response", **_CALL,
    status=str, message=str, pressures=JointState, tip=PoseStamped, position_error=float64,
    angle_error=float64, stiffness=float64, stiffness_unit=str,
)  # fmt: skip

UUID: Any = _type("unique_identifier_msgs/msg/UUID", uuid=array[uint8, 16])
GoalInfo: Any = _type("action_msgs/msg/GoalInfo", goal_id=UUID, stamp=Time)
GoalStatus: Any = _type("action_msgs/msg/GoalStatus", goal_info=GoalInfo, status=int8)
GoalStatusArray: Any = _type("action_msgs/msg/GoalStatusArray", status_list=sequence[GoalStatus])
CancelGoalRequest: Any = _type("action_msgs/srv/CancelGoal_Request", **_CALL, goal_info=GoalInfo)
CancelGoalResponse: Any = _type(
    "action_msgs/srv/CancelGoal_Response", **_CALL,
    return_code=int8, goals_canceling=sequence[GoalInfo],
)  # fmt: skip

Twist: Any = _type("geometry_msgs/msg/Twist", linear=Vector3, angular=Vector3)
MultiDOFJointTrajectoryPoint: Any = _type(
    "trajectory_msgs/msg/MultiDOFJointTrajectoryPoint", transforms=sequence[Transform],
    velocities=sequence[Twist], accelerations=sequence[Twist], time_from_start=Duration,
)  # fmt: skip
MultiDOFJointTrajectory: Any = _type(
    "trajectory_msgs/msg/MultiDOFJointTrajectory", header=Header, joint_names=sequence[str],
    points=sequence[MultiDOFJointTrajectoryPoint],
)  # fmt: skip
JointTolerance: Any = _type(
    "control_msgs/msg/JointTolerance",
    name=str, position=float64, velocity=float64, acceleration=float64,
)  # fmt: skip
JointComponentTolerance: Any = _type(
    "control_msgs/msg/JointComponentTolerance", joint_name=str, component=uint16,
    position=float64, velocity=float64, acceleration=float64,
)  # fmt: skip
_FOLLOW = "control_msgs/action/FollowJointTrajectory"
FollowGoal: Any = _type(
    f"{_FOLLOW}_Goal", trajectory=JointTrajectory, multi_dof_trajectory=MultiDOFJointTrajectory,
    path_tolerance=sequence[JointTolerance],
    component_path_tolerance=sequence[JointComponentTolerance],
    goal_tolerance=sequence[JointTolerance],
    component_goal_tolerance=sequence[JointComponentTolerance], goal_time_tolerance=Duration,
)  # fmt: skip
FollowResult: Any = _type(f"{_FOLLOW}_Result", error_code=int32, error_string=str)
FollowFeedback: Any = _type(
    f"{_FOLLOW}_Feedback", header=Header, joint_names=sequence[str],
    desired=JointTrajectoryPoint, actual=JointTrajectoryPoint, error=JointTrajectoryPoint,
    multi_dof_joint_names=sequence[str], multi_dof_desired=MultiDOFJointTrajectoryPoint,
    multi_dof_actual=MultiDOFJointTrajectoryPoint, multi_dof_error=MultiDOFJointTrajectoryPoint,
)  # fmt: skip
SendGoalRequest: Any = _type(f"{_FOLLOW}_SendGoal_Request", **_CALL, goal_id=UUID, goal=FollowGoal)
SendGoalResponse: Any = _type(f"{_FOLLOW}_SendGoal_Response", **_CALL, accepted=bool, stamp=Time)
GetResultRequest: Any = _type(f"{_FOLLOW}_GetResult_Request", **_CALL, goal_id=UUID)
GetResultResponse: Any = _type(
    f"{_FOLLOW}_GetResult_Response", **_CALL, status=int8, result=FollowResult
)
FeedbackMessage: Any = _type(f"{_FOLLOW}_FeedbackMessage", goal_id=UUID, feedback=FollowFeedback)

SERVICES: dict[Any, Any] = {
    TriggerRequest: TriggerResponse,
    SolvePressureRequest: SolvePressureResponse,
    SendGoalRequest: SendGoalResponse,
    CancelGoalRequest: CancelGoalResponse,
    GetResultRequest: GetResultResponse,
}
"""The response to each request."""


def _layout(size: int) -> tuple[Any, Any, Any]:
    gid = _type("rmw_dds_common/msg/Gid", data=array[uint8, size])
    node = _type(
        "rmw_dds_common/msg/NodeEntitiesInfo", node_namespace=str, node_name=str,
        reader_gid_seq=sequence[gid], writer_gid_seq=sequence[gid],
    )  # fmt: skip
    whole = _type(
        "rmw_dds_common/msg/ParticipantEntitiesInfo",
        gid=gid, node_entities_info_seq=sequence[node],
    )  # fmt: skip
    return gid, node, whole


LAYOUTS = {"humble": _layout(24), "jazzy": _layout(16)}
"""Discovery types of each distribution: of an identity, of a node, and of a process."""
