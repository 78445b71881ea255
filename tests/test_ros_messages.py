"""Messages, names and services of ROS 2 against the standard definitions, without a network."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cyclonedds.idl import IdlStruct

import ros_types
from fake_loop import FakeLoop
from ros_messages import (
    SIX,
    points,
    pose,
    robot_fixture,  # noqa: F401
)
from stiffopt.control.state import Alarm, Event, Severity, State
from stiffopt.errors import InputError
from stiffopt.model.manipulator import Manipulator
from stiffopt.ros import messages as m
from stiffopt.ros.hashes import TYPE_HASHES
from stiffopt.ros.names import NodeNames, remap_rules
from stiffopt.ros.published import StateMessages, channel_names, time_of
from stiffopt.ros.requests import MAX_AGE, target_of, task_in, trajectory_of

SERVICE = Path(m.__file__).parent / "stiffopt_msgs/srv/SolvePressure.srv"


TYPES = {
    m.ros_name(kind): kind
    for kind in vars(m).values()
    if isinstance(kind, type) and issubclass(kind, IdlStruct) and kind is not IdlStruct
}


NOW = 1.8e9


def ours(distro: str) -> dict[str, type[Any]]:
    return TYPES | {m.ros_name(kind): kind for kind in m.LAYOUTS[distro]}


@pytest.mark.parametrize("distro", ["humble", "jazzy"])
def test_each_message_has_the_bytes_of_the_standard_definition(distro: str) -> None:
    store, types = ros_types.typestore(distro), ours(distro)
    names = [name for name in types if "/srv/" not in name and name in store.fielddefs]
    assert len(names) > 40
    for name in names:
        for seed in range(3):
            rng = np.random.default_rng(seed)
            mine, theirs = ros_types.random_pair(store, name, types, rng)
            data = bytes(store.serialize_cdr(theirs, name))
            assert bytes(mine.serialize()) == data, name
            assert bytes(types[name].deserialize(data).serialize()) == data, name


def test_the_header_of_a_service_is_sixteen_bytes() -> None:
    data = bytes(m.TriggerResponse(7, -2, True, "ok").serialize())
    assert data[4:20] == (7).to_bytes(8, "little") + (-2).to_bytes(8, "little", signed=True)
    assert data[20:] == b"\x01\0\0\0" + b"\x03\0\0\0ok\0"
    assert bytes(m.TriggerRequest(7, 9).serialize())[20:] == b"\0"


def calls() -> dict[str, tuple[str, str]]:
    """Definitions of all services."""
    request, response = SERVICE.read_text(encoding="utf-8").split("---")
    own = {"stiffopt_msgs/srv/SolvePressure": (request, response)}
    return ros_types.CALLS | own | {"std_srvs/srv/Trigger": ("", "bool success\nstring message")}


PUBLISHED_HASHES = {  # of services that are in no file here, and of one that is
    "example_interfaces/srv/AddTwoInts": (
        ("int64 a\nint64 b", "int64 sum"),
        "e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
    ),
    "example_interfaces/action/Fibonacci_SendGoal": (
        (f"{ros_types.ID}\nexample_interfaces/action/Fibonacci_Goal goal",
         f"bool accepted\n{ros_types.TIME}"),
        "d1a57fb2a4afe8c21e34fb10db206f16ce6729b28531141472df92277c55b557",
    ),
    "action_msgs/srv/CancelGoal": (
        ros_types.CALLS["action_msgs/srv/CancelGoal"],
        "573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a",
    ),
}  # fmt: skip


def test_the_hashes_are_those_of_the_definitions() -> None:
    store = ros_types.typestore("jazzy")
    ros_types.add_message(store, "example_interfaces/action/Fibonacci_Goal", "int32 order")
    for name, (parts, known) in PUBLISHED_HASHES.items():
        assert ros_types.service_hash(name, *parts, store) == known
    store = ros_types.typestore("jazzy")
    found = {name: ros_types.service_hash(name, *parts, store) for name, parts in calls().items()}
    for name in TYPE_HASHES.keys() - found.keys():
        found[name] = store.hash_rihs01(name).removeprefix("RIHS01_")
    assert found == TYPE_HASHES


def test_services_have_the_fields_of_their_definitions() -> None:
    store = ros_types.typestore("jazzy")
    kinds = dict(m.SERVICES.items())
    for name, parts in calls().items():
        for part, text in zip(("Request", "Response"), parts, strict=True):
            full = f"{name}_{part}"
            ros_types.add_message(store, full, text)
            mine, theirs = ros_types.random_pair(store, full, TYPES, np.random.default_rng(1))
            assert type(mine) in (kinds if part == "Request" else kinds.values())
            expected = bytes(store.serialize_cdr(theirs, full))[4:]
            assert bytes(mine.serialize())[20:] == expected  # both begin at a multiple of eight


def test_names_are_expanded_and_remapped_as_in_ros_2() -> None:
    rules = remap_rules(["~/tip:=/arm/tip", "pose:=goal", "/tf:=tf"])
    names = NodeNames("stiffopt", "lab/left", rules)
    assert names.full("~/tip") == "/arm/tip"
    assert names.full("~/target") == "/lab/left/stiffopt/target"
    assert names.full("pose") == "/lab/left/goal"
    assert names.full("/tf") == "/lab/left/tf"
    assert NodeNames("stiffopt").full("~/tip") == "/stiffopt/tip"
    assert names.unused(["~/tip", "/tf"]) == ["/lab/left/pose"]


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: NodeNames("my-arm"), "is no name of ROS 2"),
        (lambda: NodeNames("lab/arm"), "has a '/'"),
        (lambda: NodeNames("arm", "1lab"), "the namespace"),
        (lambda: NodeNames("arm", "/", {"~/tip": "a__b"}), "the new name"),
        (lambda: NodeNames("arm", "/", {"~/tip": "a", "/arm/tip": "b"}), "two names"),
        (lambda: remap_rules(["~/tip=/a"]), "is no remapping"),
    ],
)
def test_bad_names_are_told(make: Any, told: str) -> None:
    with pytest.raises(InputError, match=told):
        make()


def test_targets_are_read() -> None:
    half = np.sqrt(0.5)
    target = target_of(pose((0.01, 0, 0.2), (0, half, 0, half)), "base", NOW)
    assert target.position == (0.01, 0, 0.2)
    assert target.orientation == pytest.approx((half, 0, half, 0))
    point = m.PointStamped(m.Header(time_of(NOW - 0.5), "arm/base"), m.Point(0, 0.01, 0.19))
    assert target_of(point, "arm/base", NOW).position == (0, 0.01, 0.19)
    assert target_of(point, "arm/base", NOW).orientation is None


@pytest.mark.parametrize(
    ("message", "told"),
    [
        (pose((0, np.nan, 0.2)), "the position must be finite"),
        (pose((0, np.inf, 0.2)), "the position must be finite"),
        (pose(turn=(0, 0, 0, 0)), "quaternion of length 0, not 1; for a position alone"),
        (pose(turn=(0, 0, 0, 1.2)), "length 1.2"),
        (pose(turn=(np.nan, 0, 0, 1)), "the orientation must be finite"),
        (pose(frame="world"), "frame_id is 'world'; expected 'base'"),
        (pose(frame=""), "frame_id is ''"),
        (pose(stamp=time_of(NOW - MAX_AGE - 1)), r"2\.0 s old"),
        (pose(stamp=time_of(NOW + MAX_AGE + 1)), r"2\.0 s in the future"),
    ],
)
def test_bad_targets_are_refused(message: Any, told: str) -> None:
    with pytest.raises(InputError, match=told):
        target_of(message, "base", NOW)


def test_trajectories_are_read_by_the_names_of_channels(robot: Manipulator) -> None:
    given = np.array([[1e4, 2e4, 3e4, 4e4, 5e4, 6e4], [2e4, 1e4, 3e4, 4e4, 5e4, 0]])
    order = [3, 0, 5, 1, 4, 2]
    channels = channel_names(robot.description)
    message = points(*given[:, order], names=[channels[k] for k in order])
    found = trajectory_of(message, robot, NOW)
    np.testing.assert_allclose(found.pressures, given)
    assert [each.time for each in found.waypoints] == [1, 2]
    np.testing.assert_allclose(
        [each.target.position for each in found.waypoints], robot.tip_pose(given)[:, :3, 3]
    )


@pytest.mark.parametrize(
    ("message", "told"),
    [
        (points(SIX, names=["elbow", *"abcde"]), "'elbow' is no channel of this arm; expected"),
        (points(SIX[:5], names=[f"segment_1_channel_{k}" for k in (1, 2, 3)]), "3 joint names"),
        (points(SIX, names=["segment_1_channel_1"] * 6), "one of them twice"),
        (points(SIX[:5]), "point 1 has 5 positions for 6 joint names"),
        (points((*SIX[:5], np.nan)), "the positions must be finite"),
        (points(), "there are 0 points; expected 1 to 20000"),
        (points(SIX, SIX, times=(2, 2)), "must increase"),
        (points(SIX, times=(-1,)), "not be negative"),
        (replace(points(SIX), header=m.Header(time_of(NOW - 60), "")), "60.0 s old"),
    ],
)
def test_bad_trajectories_are_refused(message: Any, told: str, robot: Manipulator) -> None:
    with pytest.raises(InputError, match=told):
        trajectory_of(message, robot, NOW)


def test_a_task_names_no_other_robot_and_no_file() -> None:
    text = "format: stiffopt-task/1\ntarget: {position: [0 mm, 0 mm, 200 mm]}\n"
    assert task_in(text, "stiff-flop-2").target.position == (0, 0, 0.2)
    with pytest.raises(InputError, match="is not the robot here"):
        task_in(f"{text}robot: stiff-flop-1\n", "stiff-flop-2")
    with pytest.raises(InputError, match="no file is read here"):
        task_in(f"{text}scene: /etc/passwd\n", "stiff-flop-2")
    with pytest.raises(InputError):
        task_in("target: [", "stiff-flop-2")


def state_messages(robot: Manipulator) -> StateMessages:
    return StateMessages(robot, "my-rig", "stiffopt", epoch=NOW, prefix="arm/")


def test_the_state_as_messages(robot: Manipulator) -> None:
    now = replace(
        FakeLoop().now,
        tip_quaternion=np.array([np.sqrt(0.5), np.sqrt(0.5), 0, 0]),  # z of the tip is -y
        target_position=np.array([0.01, np.nan, 0.19]),  # y is free
        wrench=np.array([0.1, 0.2, 0.3, 0, 0, 0]),
        commanded=np.arange(6.0),
    )
    found = dict(state_messages(robot).often(now))
    assert found["~/pressure"].header == m.Header(time_of(NOW + now.time), "arm/base")
    assert found["~/pressure"].name[4] == "segment_2_channel_2"
    np.testing.assert_array_equal(found["~/pressure"].position, now.measured)
    assert found["~/pressure_command"].position == [0, 1, 2, 3, 4, 5]
    tip, target = found["~/tip"].pose, found["~/target"].pose
    assert tip.position == m.Point(0, 0.01, 0.2)
    assert tip.orientation == m.Quaternion(np.sqrt(0.5), 0, 0, np.sqrt(0.5))
    assert target.position == m.Point(0.01, 0.01, 0.19)  # as the tip, along the free axis
    assert [each.child_frame_id for each in found["/tf"].transforms] == ["arm/tip", "arm/target"]
    wrench = found["~/wrench"]
    assert wrench.header.frame_id == "arm/tip"
    force = wrench.wrench.force
    np.testing.assert_allclose([force.x, force.y, force.z], [0.1, 0.3, -0.2], atol=1e-12)


def test_what_is_not_known_is_left_out(robot: Manipulator) -> None:
    nothing = np.full(6, np.nan)
    unknown = replace(
        FakeLoop().now,
        tip_position=np.full(3, np.nan),
        measured=nothing,
        commanded=nothing,
    )
    assert set(dict(state_messages(robot).often(unknown))) == {"~/pressure", "~/pressure_command"}
    assert not list(state_messages(robot).shape(unknown))


def test_the_shape_is_that_of_the_model(robot: Manipulator) -> None:
    pressures = np.array([5e4, 0, 0, 0, 3e4, 0])
    now = replace(FakeLoop().now, measured=pressures, target_position=np.array([0, 0, 0.2]))
    found = dict(state_messages(robot).shape(now))
    frames = found["/tf"].transforms
    tip = robot.tip_pose(pressures)
    last = frames[-1].transform
    np.testing.assert_allclose(
        [last.translation.x, last.translation.y, last.translation.z], tip[:3, 3], atol=1e-12
    )
    assert [f.child_frame_id for f in frames[:2]] == ["arm/station_1", "arm/station_2"]
    markers = found["~/markers"].markers
    assert len({each.id for each in markers}) == len(markers)
    rods = [each for each in markers if each.ns == "body"]
    assert sum(rod.scale.z for rod in rods) == pytest.approx(robot.length, rel=0.1)
    ends = []
    for rod in rods:
        q, p = rod.pose.orientation, rod.pose.position
        axis = [2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x)]
        axis = np.array([*axis, 1 - 2 * (q.x**2 + q.y**2)])
        middle = np.array([p.x, p.y, p.z])
        ends.append((middle - axis * rod.scale.z / 2, middle + axis * rod.scale.z / 2))
    for before, after in pairwise(ends):
        np.testing.assert_allclose(before[1], after[0], atol=1e-9)  # they are joined
    assert {each.ns for each in markers} == {"body", "ellipsoid", "target"}


def test_diagnostics_have_what_the_state_has(robot: Manipulator) -> None:
    now = replace(
        FakeLoop().now,
        state=State.FAULT,
        reason="it burst",
        alarms=(Alarm("lost", "a channel is lost", 1.0),),
    )
    first, alarm = state_messages(robot).diagnostics(now, "somebody").status
    told = {each.key: each.value for each in first.values}
    assert (first.level, first.message, first.hardware_id) == (2, "fault: it burst", "my-rig")
    assert told["control"] == "somebody"
    assert told["position_error_m"] == "null"
    assert (alarm.level, alarm.name) == (1, "stiffopt: my-rig: lost")
    line = state_messages(robot).log(Event(2.0, "armed", "it is", Severity.WARNING))
    assert (line.level, line.msg, line.stamp) == (30, "armed: it is", time_of(NOW + 2))


def test_a_scene_is_drawn_as_triangles(robot: Manipulator) -> None:
    from stiffopt.model.scene import Scene

    objects = [
        {"name": "post", "sphere": {"centre": ["0 mm", "40 mm", "120 mm"], "radius": "5 mm"}},
        {"name": "table", "half_space": {"point": ["0 m", "0 m", "0.26 m"], "normal": [0, 0, -1]}},
    ]
    found = state_messages(robot).scene(Scene(objects=objects), 0.0).markers
    assert [each.ns for each in found] == ["post", "table"]
    corners = np.array([[p.x, p.y, p.z] for p in found[0].points])
    assert len(corners) % 3 == 0
    np.testing.assert_allclose(np.linalg.norm(corners - [0, 0.04, 0.12], axis=1), 0.005, rtol=1e-5)
