"""The ROS 2 messages and services that the node speaks, as types of cyclonedds.

Fields, order and types are those of the standard definitions, which are the same in Humble and in
Jazzy, but for `Gid`. An empty message has one byte on the wire. A request and a reply begin with
the header of rmw_cyclonedds: who asks, and the number of the question.
"""

# no `from __future__ import annotations`: cyclonedds reads the types when a class is made
from dataclasses import dataclass, field
from typing import Any, TypeVar, dataclass_transform

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import autoid, final
from cyclonedds.idl.types import (
    array,
    byte,
    float32,
    float64,
    int32,
    int64,
    sequence,
    uint8,
    uint32,
    uint64,
)

_T = TypeVar("_T")


@dataclass_transform()
def _wire(cls: type[_T]) -> type[_T]:
    """Make a class a struct without extensions, as ROS 2 serialises it."""
    made: type[_T] = dataclass(final(autoid("sequential")(cls)))
    return made


def _name(package: str, name: str, kind: str = "msg") -> str:
    return f"{package}.{kind}.dds_.{name}_"


def ros_name(kind: type[Any]) -> str:
    """Return the name of a type as ROS 2 writes it, such as ``std_msgs/msg/String``."""
    package, folder, _, name = kind.__idl__.idl_transformed_typename.split("::")
    return f"{package}/{folder}/{name.removesuffix('_')}"


@_wire
class Time(IdlStruct, typename=_name("builtin_interfaces", "Time")):
    sec: int32 = 0
    nanosec: uint32 = 0


@_wire
class Duration(IdlStruct, typename=_name("builtin_interfaces", "Duration")):
    sec: int32 = 0
    nanosec: uint32 = 0


@_wire
class Header(IdlStruct, typename=_name("std_msgs", "Header")):
    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@_wire
class Empty(IdlStruct, typename=_name("std_msgs", "Empty")):
    structure_needs_at_least_one_member: uint8 = 0


@_wire
class String(IdlStruct, typename=_name("std_msgs", "String")):
    data: str = ""


@_wire
class ColorRGBA(IdlStruct, typename=_name("std_msgs", "ColorRGBA")):
    r: float32 = 0.0
    g: float32 = 0.0
    b: float32 = 0.0
    a: float32 = 0.0


@_wire
class Point(IdlStruct, typename=_name("geometry_msgs", "Point")):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@_wire
class Vector3(IdlStruct, typename=_name("geometry_msgs", "Vector3")):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@_wire
class Quaternion(IdlStruct, typename=_name("geometry_msgs", "Quaternion")):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@_wire
class Pose(IdlStruct, typename=_name("geometry_msgs", "Pose")):
    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@_wire
class PoseStamped(IdlStruct, typename=_name("geometry_msgs", "PoseStamped")):
    header: Header = field(default_factory=Header)
    pose: Pose = field(default_factory=Pose)


@_wire
class PointStamped(IdlStruct, typename=_name("geometry_msgs", "PointStamped")):
    header: Header = field(default_factory=Header)
    point: Point = field(default_factory=Point)


@_wire
class WrenchMessage(IdlStruct, typename=_name("geometry_msgs", "Wrench")):
    force: Vector3 = field(default_factory=Vector3)
    torque: Vector3 = field(default_factory=Vector3)


@_wire
class WrenchStamped(IdlStruct, typename=_name("geometry_msgs", "WrenchStamped")):
    header: Header = field(default_factory=Header)
    wrench: WrenchMessage = field(default_factory=WrenchMessage)


@_wire
class Transform(IdlStruct, typename=_name("geometry_msgs", "Transform")):
    translation: Vector3 = field(default_factory=Vector3)
    rotation: Quaternion = field(default_factory=Quaternion)


@_wire
class TransformStamped(IdlStruct, typename=_name("geometry_msgs", "TransformStamped")):
    header: Header = field(default_factory=Header)
    child_frame_id: str = ""
    transform: Transform = field(default_factory=Transform)


@_wire
class TFMessage(IdlStruct, typename=_name("tf2_msgs", "TFMessage")):
    transforms: sequence[TransformStamped] = field(default_factory=list)


@_wire
class JointState(IdlStruct, typename=_name("sensor_msgs", "JointState")):
    header: Header = field(default_factory=Header)
    name: sequence[str] = field(default_factory=list)
    position: sequence[float64] = field(default_factory=list)
    velocity: sequence[float64] = field(default_factory=list)
    effort: sequence[float64] = field(default_factory=list)


@_wire
class JointTrajectoryPoint(IdlStruct, typename=_name("trajectory_msgs", "JointTrajectoryPoint")):
    positions: sequence[float64] = field(default_factory=list)
    velocities: sequence[float64] = field(default_factory=list)
    accelerations: sequence[float64] = field(default_factory=list)
    effort: sequence[float64] = field(default_factory=list)
    time_from_start: Duration = field(default_factory=Duration)


@_wire
class JointTrajectory(IdlStruct, typename=_name("trajectory_msgs", "JointTrajectory")):
    header: Header = field(default_factory=Header)
    joint_names: sequence[str] = field(default_factory=list)
    points: sequence[JointTrajectoryPoint] = field(default_factory=list)


@_wire
class KeyValue(IdlStruct, typename=_name("diagnostic_msgs", "KeyValue")):
    key: str = ""
    value: str = ""


@_wire
class DiagnosticStatus(IdlStruct, typename=_name("diagnostic_msgs", "DiagnosticStatus")):
    level: byte = 0
    name: str = ""
    message: str = ""
    hardware_id: str = ""
    values: sequence[KeyValue] = field(default_factory=list)


@_wire
class DiagnosticArray(IdlStruct, typename=_name("diagnostic_msgs", "DiagnosticArray")):
    header: Header = field(default_factory=Header)
    status: sequence[DiagnosticStatus] = field(default_factory=list)


@_wire
class LogMessage(IdlStruct, typename=_name("rcl_interfaces", "Log")):
    stamp: Time = field(default_factory=Time)
    level: uint8 = 0
    name: str = ""
    msg: str = ""
    file: str = ""
    function: str = ""
    line: uint32 = 0


@_wire
class CompressedImage(IdlStruct, typename=_name("sensor_msgs", "CompressedImage")):
    header: Header = field(default_factory=Header)
    format: str = ""
    data: sequence[uint8] = field(default_factory=list)


@_wire
class UVCoordinate(IdlStruct, typename=_name("visualization_msgs", "UVCoordinate")):
    u: float32 = 0.0
    v: float32 = 0.0


@_wire
class MeshFile(IdlStruct, typename=_name("visualization_msgs", "MeshFile")):
    filename: str = ""
    data: sequence[uint8] = field(default_factory=list)


@_wire
class Marker(IdlStruct, typename=_name("visualization_msgs", "Marker")):
    header: Header = field(default_factory=Header)
    ns: str = ""
    id: int32 = 0
    type: int32 = 0
    action: int32 = 0
    pose: Pose = field(default_factory=Pose)
    scale: Vector3 = field(default_factory=Vector3)
    color: ColorRGBA = field(default_factory=ColorRGBA)
    lifetime: Duration = field(default_factory=Duration)
    frame_locked: bool = False
    points: sequence[Point] = field(default_factory=list)
    colors: sequence[ColorRGBA] = field(default_factory=list)
    texture_resource: str = ""
    texture: CompressedImage = field(default_factory=CompressedImage)
    uv_coordinates: sequence[UVCoordinate] = field(default_factory=list)
    text: str = ""
    mesh_resource: str = ""
    mesh_file: MeshFile = field(default_factory=MeshFile)
    mesh_use_embedded_materials: bool = False


@_wire
class MarkerArray(IdlStruct, typename=_name("visualization_msgs", "MarkerArray")):
    markers: sequence[Marker] = field(default_factory=list)


# Services ----------------------------------------------------------------------------------------


@_wire
class TriggerRequest(IdlStruct, typename=_name("std_srvs", "Trigger_Request", "srv")):
    guid: uint64 = 0
    number: int64 = 0
    structure_needs_at_least_one_member: uint8 = 0


@_wire
class TriggerResponse(IdlStruct, typename=_name("std_srvs", "Trigger_Response", "srv")):
    guid: uint64 = 0
    number: int64 = 0
    success: bool = False
    message: str = ""


@_wire
class SolvePressureRequest(
    IdlStruct, typename=_name("stiffopt_msgs", "SolvePressure_Request", "srv")
):
    guid: uint64 = 0
    number: int64 = 0
    task: str = ""
    target: PoseStamped = field(default_factory=PoseStamped)


@_wire
class SolvePressureResponse(
    IdlStruct, typename=_name("stiffopt_msgs", "SolvePressure_Response", "srv")
):
    guid: uint64 = 0
    number: int64 = 0
    status: str = ""
    message: str = ""
    pressures: JointState = field(default_factory=JointState)
    tip: PoseStamped = field(default_factory=PoseStamped)
    position_error: float64 = 0.0
    angle_error: float64 = 0.0
    stiffness: float64 = 0.0
    stiffness_unit: str = ""


SERVICES: dict[type[Any], type[Any]] = {
    TriggerRequest: TriggerResponse,
    SolvePressureRequest: SolvePressureResponse,
}
"""The response to each request."""


# What makes nodes visible ------------------------------------------------------------------------


@_wire
class Gid16(IdlStruct, typename=_name("rmw_dds_common", "Gid")):
    data: array[uint8, 16] = field(default_factory=lambda: [0] * 16)


@_wire
class Gid24(IdlStruct, typename=_name("rmw_dds_common", "Gid")):
    data: array[uint8, 24] = field(default_factory=lambda: [0] * 24)


@_wire
class NodeEntitiesInfo16(IdlStruct, typename=_name("rmw_dds_common", "NodeEntitiesInfo")):
    node_namespace: str = ""
    node_name: str = ""
    reader_gid_seq: sequence[Gid16] = field(default_factory=list)
    writer_gid_seq: sequence[Gid16] = field(default_factory=list)


@_wire
class NodeEntitiesInfo24(IdlStruct, typename=_name("rmw_dds_common", "NodeEntitiesInfo")):
    node_namespace: str = ""
    node_name: str = ""
    reader_gid_seq: sequence[Gid24] = field(default_factory=list)
    writer_gid_seq: sequence[Gid24] = field(default_factory=list)


@_wire
class ParticipantEntitiesInfo16(
    IdlStruct, typename=_name("rmw_dds_common", "ParticipantEntitiesInfo")
):
    gid: Gid16 = field(default_factory=Gid16)
    node_entities_info_seq: sequence[NodeEntitiesInfo16] = field(default_factory=list)


@_wire
class ParticipantEntitiesInfo24(
    IdlStruct, typename=_name("rmw_dds_common", "ParticipantEntitiesInfo")
):
    gid: Gid24 = field(default_factory=Gid24)
    node_entities_info_seq: sequence[NodeEntitiesInfo24] = field(default_factory=list)


LAYOUTS: dict[str, tuple[Any, Any, Any]] = {
    "humble": (Gid24, NodeEntitiesInfo24, ParticipantEntitiesInfo24),
    "jazzy": (Gid16, NodeEntitiesInfo16, ParticipantEntitiesInfo16),
}
"""How a distribution tells what a process has: types of an identity, of a node and of all that."""
