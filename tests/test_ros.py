"""The ROS 2 node: its bytes, names and graph, what it publishes, and what it takes from whom."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import Policy
from cyclonedds.idl import IdlStruct
from cyclonedds.util import duration

import ros_types
from fake_loop import FakeLoop
from ros_peer import LOOPBACK, Peer, own_domain
from running import RIGS, wait_for
from stiffopt.control.state import Alarm, Event, Severity, State
from stiffopt.daemon.server import Server
from stiffopt.daemon.service import create_app
from stiffopt.errors import CommandError, FileError, InputError, ServiceError
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.rig.config import load_rig_description
from stiffopt.rig.settings import RosSettings
from stiffopt.ros import bridge as bridge_module
from stiffopt.ros import messages as m
from stiffopt.ros.bridge import MOTIONS, SIMPLE, Bridge
from stiffopt.ros.hashes import TYPE_HASHES
from stiffopt.ros.lease import GraphLease
from stiffopt.ros.names import NodeNames, remap_rules
from stiffopt.ros.node import RosNode, Writer
from stiffopt.ros.published import PUBLISHED, StateMessages, channel_names, time_of
from stiffopt.ros.requests import MAX_AGE, target_of, task_in, trajectory_of

pytestmark = pytest.mark.real_time

TOKEN = "a-secret-of-the-tests"
RIG = RIGS / "sim-two-segment.yaml"
SERVICE = Path(m.__file__).parent / "stiffopt_msgs/srv/SolvePressure.srv"
TYPES = {
    m.ros_name(kind): kind
    for kind in vars(m).values()
    if isinstance(kind, type) and issubclass(kind, IdlStruct) and kind is not IdlStruct
}
NOW = 1.8e9
AT_REST = m.Header(m.Time(), "base")


@pytest.fixture(scope="module")
def robot() -> Manipulator:
    return load_robot("stiff-flop-2")


# bytes --------------------------------------------------------------------------------------------


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


# names --------------------------------------------------------------------------------------------


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


# requests -----------------------------------------------------------------------------------------


def pose(position: Any = (0, 0, 0.2), turn: Any = (0, 0, 0, 1), **header: Any) -> m.PoseStamped:
    head = m.Header(header.get("stamp", m.Time()), header.get("frame", "base"))
    place = m.Pose(m.Point(*map(float, position)), m.Quaternion(*map(float, turn)))
    return m.PoseStamped(head, place)


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


SIX = (1e4,) * 6


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


# messages of the state ----------------------------------------------------------------------------


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


# who has control ----------------------------------------------------------------------------------


class FakeClient:
    def __init__(self) -> None:
        self.calls: list[str] = []
        self.in_control = False

    def take_control(self) -> None:
        self.calls.append("take")
        self.in_control = True

    def release(self) -> None:
        self.calls.append("release")
        self.in_control = False

    def renew(self) -> None:
        self.calls.append("renew")

    def hold(self, reason: str) -> None:
        self.calls.append("hold")


class FakeSource:
    alive = True

    def lives(self, writer: Writer) -> bool:
        return self.alive


class Leased:
    """A lease, with a clock and a client that a test looks at."""

    def __init__(self) -> None:
        self.time, self.client, self.source = 0.0, FakeClient(), FakeSource()
        self.told: list[str] = []
        self.lease = GraphLease(self.client, 1.0, self.told.append, clock=lambda: self.time)

    def look(self, time: float) -> list[str]:
        self.time = time
        self.client.calls.clear()
        self.lease.look()
        return self.client.calls


QUICK, FOREVER = Writer(1, "a", 0.5), Writer(1, "a", np.inf)
SISTER, OTHER = Writer(2, "a", np.inf), Writer(3, "b", np.inf)


def nothing() -> None:
    pass


def test_control_lasts_as_long_as_its_writer_lives() -> None:
    it = Leased()
    it.lease.move(it.source, QUICK, nothing)
    assert it.client.calls == ["take"]
    assert it.look(60) == ["renew"]  # DDS says that it lives
    it.source.alive = False
    assert it.look(61) == ["hold", "release"]
    assert "is gone" in it.told[-1]
    assert it.look(62) == []


def test_a_writer_that_offers_no_liveliness_has_to_write() -> None:
    it = Leased()
    it.lease.move(it.source, FOREVER, nothing)
    assert it.look(0.9) == ["renew"]
    it.lease.hear(OTHER)
    it.lease.hear(SISTER)  # of the same process
    assert it.look(1.8) == ["renew"]
    it.lease.hear(OTHER)
    assert it.look(2.0) == ["hold", "release"]
    slow = replace(QUICK, lease=5.0)  # longer than the heartbeat: none
    it.lease.move(it.source, slow, nothing)
    assert it.look(3.1) == ["hold", "release"]


def test_one_process_at_a_time_has_control() -> None:
    it = Leased()
    it.lease.move(it.source, QUICK, nothing)
    with pytest.raises(CommandError, match="another writer has control"):
        it.lease.move(it.source, OTHER, nothing)
    with pytest.raises(CommandError, match="another writer has control"):
        it.lease.once(OTHER, nothing)
    it.client.calls.clear()
    it.lease.once(SISTER, nothing)
    assert "release" not in it.client.calls
    it.lease.move(it.source, SISTER, nothing)
    it.lease.end("that is enough")
    assert it.client.calls[-2:] == ["hold", "release"]
    it.lease.once(OTHER, nothing)
    assert it.client.calls[-2:] == ["take", "release"]
    assert it.lease.holder == ""


def test_a_refused_command_gives_control_to_nobody() -> None:
    it = Leased()

    def refused() -> None:
        raise CommandError("not now")

    with pytest.raises(CommandError, match="not now"):
        it.lease.move(it.source, QUICK, refused)
    assert it.client.calls == ["take", "release"]
    it.lease.move(it.source, OTHER, nothing)
    with pytest.raises(CommandError, match="not now"):
        it.lease.move(it.source, OTHER, refused)
    assert it.lease.holder
    it.client.in_control = False  # the daemon has taken it back
    assert it.look(1) == []
    assert it.lease.holder == ""


# on the graph -------------------------------------------------------------------------------------


@dataclass
class Graph:
    loop: FakeLoop
    peer: Peer
    node: RosNode
    server: Server
    bridge: Bridge


@contextmanager
def graph(robot: Manipulator, **ros: Any) -> Iterator[Graph]:
    loop, domain = FakeLoop(), own_domain()
    app = create_app(loop, robot=robot.description, token=TOKEN, heartbeat=1.0, patience=20.0)
    server = Server(app)
    server.start()
    settings = RosSettings(**ros)
    description = load_rig_description(RIG).model_copy(update={"ros": settings})
    node = RosNode(
        NodeNames("stiffopt"), domain=domain, interface=settings.interface, distro=settings.distro
    )
    bridge = Bridge(str(RIG), description, robot, server.url, TOKEN, node)
    over = threading.Event()
    ended: list[BaseException | None] = []

    def run() -> None:
        try:
            bridge.run(over)
        except ServiceError as error:
            ended.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield Graph(loop, Peer(domain), node, server, bridge)
    finally:
        over.set()
        thread.join(30)
        bridge.close()
        server.stop()


COMMANDS = {"commands": True, "interface": "lo"}


def test_what_is_published(robot: Manipulator) -> None:
    with graph(robot) as it:
        readers = {
            topic: it.peer.reader(topic, kind)
            for topic, (kind, _, _) in PUBLISHED.items()
            if topic not in ("~/target", "~/wrench")  # there is none now
        }
        heard = {topic: reader.wait() for topic, reader in readers.items()}
        assert heard["~/state"].data == "inactive"
        assert heard["~/tip"].pose.position == m.Point(0, 0.01, 0.2)
        texts = [heard["/rosout"].msg]
        texts.append(readers["/rosout"].wait(lambda line: "tracker-missing" in line.msg).msg)
        it.loop.vent()
        it.loop.now = replace(it.loop.now, state=State.HOLDING, reason="asked to")
        assert readers["~/state"].wait(lambda s: s.data.startswith("holding")).data.endswith("to")


def test_nothing_but_venting_is_taken_unless_the_rig_file_says_so(robot: Manipulator) -> None:
    with graph(robot) as it:
        vent = it.peer.writer("~/vent", m.Empty)
        others = [it.peer.writer(f"~/{name}", m.Empty, wait=False) for name in SIMPLE]
        others += [it.peer.writer(f"~/{n}", k, wait=False) for n, k in MOTIONS.items()]
        others.append(it.peer.writer("rq~/arm", m.Empty, wait=False))
        vent.write(m.Empty())
        wait_for(lambda: "vent" in it.loop.names)
        assert not any(writer.get_matched_subscriptions() for writer in others)
        it.peer.client("~/vent", m.TriggerRequest)(m.TriggerRequest())  # the first is done by now
        quick, count = it.peer.writer("~/vent", m.Empty, reliable=False), len(it.loop.names)
        quick.write(m.Empty())
        wait_for(lambda: len(it.loop.names) > count)
        done = it.peer.client("~/vent", m.TriggerRequest)(m.TriggerRequest())
        assert (done.success, done.message) == (True, "vented")
        assert set(it.loop.names) == {"vent"}


def test_commands_by_topics(robot: Manipulator) -> None:
    with graph(robot, **COMMANDS) as it:
        log = it.peer.reader("/rosout", m.Log)
        for name in SIMPLE:
            writer = it.peer.writer(f"~/{name}", m.Empty)
            writer.write(m.Empty())
            wait_for(lambda name=name: name in it.loop.names)
        sent = {
            "set_target": pose((0.01, 0, 0.2)),
            "set_target_point": m.PointStamped(AT_REST, m.Point(0.02, 0, 0.2)),
            "set_task": m.String("format: stiffopt-task/1\ntarget: {pointing: [0, 0, 1]}\n"),
            "follow_trajectory": points(SIX),
        }
        given_by = ("set_target", "set_task", "follow_trajectory")
        for name, message in sent.items():
            writer, count = it.peer.writer(f"~/{name}", MOTIONS[name]), len(it.loop.calls)
            writer.write(message)
            wait_for(lambda count=count: set(it.loop.names[count:]) & set(given_by))
        given = dict(it.loop.calls)
        assert [t.position[0] for name, t in it.loop.calls if name == "set_target"] == [0.01, 0.02]
        assert given["set_task"].target.pointing == (0, 0, 1)
        assert given["follow_trajectory"].waypoints[0].pressures == SIX
        count = len(it.loop.calls)
        writer = it.peer.writer("~/set_target", m.PoseStamped)
        writer.write(pose(frame="world"))
        line = log.wait(lambda line: "refused" in line.msg)
        assert line.level == 40
        assert "set_target: frame_id is 'world'" in line.msg
        assert not [name for name in it.loop.names[count:] if name != "hold"]


def test_commands_by_services(robot: Manipulator) -> None:
    with graph(robot, **COMMANDS) as it:
        for name in SIMPLE:
            done = it.peer.client(f"~/{name}", m.TriggerRequest)(m.TriggerRequest())
            assert (done.success, done.message) == (True, "")
            assert it.loop.names[-1] == name
        it.loop.refusal = CommandError("not in this state")
        done = it.peer.client("~/arm", m.TriggerRequest)(m.TriggerRequest())
        assert (done.success, done.message) == (False, "not in this state")


FOLLOW = "~/follow_joint_trajectory/_action"


class Goals:
    """A client of the action."""

    def __init__(self, it: Graph) -> None:
        self.loop, peer = it.loop, it.peer
        latched = Policy.Durability.TransientLocal
        alive = Policy.Liveliness.Automatic(duration(seconds=1))
        self.send_goal = peer.client(f"{FOLLOW}/send_goal", m.SendGoalRequest, alive)
        self.get_result = peer.client(f"{FOLLOW}/get_result", m.GetResultRequest)
        self.cancel_goal = peer.client(f"{FOLLOW}/cancel_goal", m.CancelGoalRequest)
        self.feedback = peer.reader(f"{FOLLOW}/feedback", m.FeedbackMessage)
        self.status = peer.reader(f"{FOLLOW}/status", m.GoalStatusArray, latched)

    def send(self, number: int, *rows: Any, times: Any = None, **more: Any) -> bool:
        goal = m.FollowGoal(trajectory=points(*rows, times=times), **more)
        return bool(self.send_goal(m.SendGoalRequest(goal_id=identity(number), goal=goal)).accepted)

    def pass_time(self, seconds: float, **changes: Any) -> None:
        """Let the state be that of a later moment."""
        self.loop.now = replace(self.loop.now, time=time.monotonic() + seconds, **changes)

    def cancel(self, number: int, stamp: Any = None) -> tuple[int, list[int]]:
        info = m.GoalInfo(identity(number), m.Time() if stamp is None else stamp)
        told = self.cancel_goal(m.CancelGoalRequest(goal_info=info))
        return told.return_code, [each.goal_id.uuid[0] for each in told.goals_canceling]

    def result(self, number: int) -> tuple[int, str]:
        found = self.get_result(m.GetResultRequest(goal_id=identity(number)))
        return found.status, found.result.error_string


def identity(number: int) -> Any:
    return m.UUID(bytes([number]) * 16)


def test_a_goal_is_followed_to_its_end(robot: Manipulator) -> None:
    with graph(robot, **COMMANDS) as it:
        goals = Goals(it)
        assert goals.send(1, SIX, (3e4,) * 6, times=(0, 10))
        assert it.loop.names[-1] == "follow_trajectory"
        goals.pass_time(5.0, measured=np.full(6, 1.5e4))
        told = goals.feedback.wait(lambda f: f.feedback.desired.time_from_start.sec == 5)
        assert told.goal_id == identity(1)
        told = told.feedback
        assert told.joint_names == channel_names(robot.description)
        np.testing.assert_allclose(told.desired.positions, np.full(6, 2e4), rtol=0.05)
        assert told.actual.positions == [1.5e4] * 6
        np.testing.assert_allclose(told.error.positions, np.full(6, 5e3), rtol=0.2)
        goals.pass_time(10.1)
        assert goals.result(1) == (4, "")
        goals.status.wait(lambda s: [(g.goal_info.goal_id, g.status) for g in s.status_list] == [
            (identity(1), 4)
        ])  # fmt: skip
        assert goals.result(1) == (4, "")  # asked again
        assert "hold" not in it.loop.names


def test_a_goal_ends_when_it_is_cancelled_replaced_or_the_arm_is_held(robot: Manipulator) -> None:
    with graph(robot, **COMMANDS) as it:
        goals = Goals(it)
        assert goals.send(1, SIX)
        assert goals.cancel(9) == (2, [])  # unknown
        assert goals.cancel(0, time_of(time.time() - 60)) == (0, [])  # older ones: none
        assert goals.cancel(1) == (0, [1])
        assert it.loop.calls[-1] == ("hold", "the goal was canceled")
        assert goals.result(1) == (5, "it was canceled")
        assert goals.cancel(1) == (3, [])  # over
        assert goals.cancel(0) == (0, [])  # all, of which there are none
        assert not goals.send(1, SIX)  # the same identity
        assert goals.send(2, SIX)
        assert goals.send(3, SIX)
        assert goals.result(2) == (6, "another motion was asked for")
        target = it.peer.writer("~/set_target", m.PoseStamped)
        target.write(pose())
        assert goals.result(3) == (6, "another motion was asked for")
        assert goals.send(4, SIX, times=(30,))
        goals.pass_time(1.0, state=State.HOLDING, reason="no tip is seen")
        assert goals.result(4) == (6, "the arm is holding: no tip is seen")
        wait_for(lambda: it.loop.calls[-1] == ("hold", "the goal was aborted"))
        assert goals.result(7) == (0, "")


def test_goals_that_make_no_sense_are_refused(robot: Manipulator) -> None:
    with graph(robot, **COMMANDS) as it:
        log, goals = it.peer.reader("/rosout", m.Log), Goals(it)
        assert not goals.send(1, SIX[:5])
        assert "positions for 6 joint names" in log.wait(lambda line: "refused" in line.msg).msg
        assert not goals.send(1, SIX, goal_tolerance=[m.JointTolerance("segment_1_channel_1", 1.0)])
        it.loop.refusal = CommandError("it is not armed")
        assert not goals.send(1, SIX)
        log.wait(lambda line: "follow_joint_trajectory: it is not armed" in line.msg)
        assert "follow_trajectory" not in it.loop.names


def test_the_solver_answers(robot: Manipulator) -> None:
    with graph(robot) as it:  # it moves nothing, so it needs no permission
        ask = it.peer.client("~/solve_pressure", m.SolvePressureRequest)
        where = robot.tip_pose([5e4, 0, 0, 0, 3e4, 0])[:3, 3]
        text = "format: stiffopt-task/1\ntarget: {position: [0 mm, 0 mm, 200 mm]}\n"
        text += "stiffness: {maximise: {direction: [1, 0, 0]}}\n"
        target = pose(where)
        found = ask(m.SolvePressureRequest(task=text))
        assert found.status == "solved"
        assert found.stiffness > 0
        assert found.stiffness_unit == "N/m"
        tip = robot.tip_pose(found.pressures.position)[:3, 3]
        np.testing.assert_allclose(tip, [0, 0, 0.2], atol=1.1e-4)
        found = ask(m.SolvePressureRequest(target=pose((0, 0, 9.0))))
        assert found.status == "unreachable"
        for bad in (m.SolvePressureRequest(), m.SolvePressureRequest(task="nonsense: 1")):
            found = ask(bad)
            assert found.status == "refused"
            assert found.message
        rig = it.bridge._description
        safety = rig.safety.model_copy(update={"max_pressure": 6e4})
        it.bridge._description = rig.model_copy(update={"safety": safety})
        for limits in ("", "pressure: {min: 0.05 bar}\n", "pressure: {max: 1.5 bar}\n"):
            found = ask(m.SolvePressureRequest(task=text + limits))
            assert found.pressures.position
            assert max(found.pressures.position) <= 6e4 + 1  # the rig's limit
        it.bridge._description = rig
        answers = it.peer.reader("~/solution", m.JointState)
        wait_for(lambda: answers.has_writer)
        asker = it.peer.writer("~/solve", m.PoseStamped)
        asker.write(pose((0, 0, 0.2)))
        solution = answers.wait()
        np.testing.assert_allclose(
            robot.tip_pose(solution.position)[:3, 3], [0, 0, 0.2], atol=1.1e-4
        )
        assert target.header.frame_id == "base"


MANUAL = Policy.Liveliness.ManualByTopic(duration(milliseconds=400))


def test_control_ends_with_the_liveliness_of_its_writer(robot: Manipulator) -> None:
    with graph(robot, **COMMANDS) as it:
        writer = it.peer.writer("~/set_target_point", m.PointStamped, MANUAL)
        for k in range(20):  # for a second, longer than the lease and the heartbeat
            writer.write(m.PointStamped(AT_REST, m.Point(0.001 * k, 0, 0.2)))
            time.sleep(0.05)
        assert "hold" not in it.loop.names
        held = wait_for(lambda: [text for name, text in it.loop.calls if name == "hold"])
        assert "does not say that it lives" in held[0]
        writer.write(m.PointStamped(AT_REST, m.Point(0, 0, 0.2)))  # it lives again
        wait_for(lambda: it.loop.names[-1] == "set_target")
        it.loop.calls.clear()
        writer.__del__()  # it is gone
        wait_for(lambda: "hold" in it.loop.names)


def test_another_process_has_to_wait_and_may_vent(robot: Manipulator) -> None:
    with graph(robot, **COMMANDS) as it:
        other = Peer(own_domain())
        log = other.reader("/rosout", m.Log)
        wait_for(lambda: log.has_writer)
        alive = Policy.Liveliness.Automatic(duration(seconds=1))
        writer = it.peer.writer("~/set_target_point", m.PointStamped, alive)
        writer.write(m.PointStamped(AT_REST, m.Point(0, 0, 0.2)))
        wait_for(lambda: "set_target" in it.loop.names)
        rival = other.writer("~/set_target", m.PoseStamped)
        rival.write(pose())
        log.wait(lambda line: "set_target: another writer has control" in line.msg)
        done = other.client("~/hold", m.TriggerRequest)(m.TriggerRequest())
        assert not done.success
        assert it.loop.names.count("set_target") == 1
        assert "hold" not in it.loop.names
        assert other.client("~/vent", m.TriggerRequest)(m.TriggerRequest()).success
        assert it.loop.names[-1] == "vent"
        other.close()


def test_venting_waits_for_nothing_and_what_waited_is_dropped(robot: Manipulator) -> None:
    with graph(robot, **COMMANDS) as it:
        free = threading.Event()
        began = threading.Event()

        def gate(name: str) -> None:
            if name == "arm":
                began.set()
                assert free.wait(30)

        it.loop.gate = gate
        arm, vent = it.peer.writer("~/arm", m.Empty), it.peer.writer("~/vent", m.Empty)
        reset = it.peer.writer("~/reset", m.Empty)
        arm.write(m.Empty())
        assert began.wait(30)
        reset.write(m.Empty())
        wait_for(lambda: it.bridge._jobs)
        vent.write(m.Empty())
        wait_for(lambda: "vent" in it.loop.names)
        free.set()
        wait_for(lambda: "arm" in it.loop.names)
        disarm = it.peer.client("~/disarm", m.TriggerRequest)
        wait_for(lambda: disarm(m.TriggerRequest()).success)
        assert list(dict.fromkeys(it.loop.names)) == ["vent", "arm", "disarm"]


def test_the_guard_vents_if_the_daemon_does_not(
    robot: Manipulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def vent(rig: str) -> str:
        asked.append(rig)
        return "vented by its guard"

    monkeypatch.setattr(bridge_module, "vent_rig", vent)
    with graph(robot) as it:
        it.loop.refusal = CommandError("it hangs")
        done = it.peer.client("~/vent", m.TriggerRequest)(m.TriggerRequest())
        assert (done.success, done.message) == (True, "vented by its guard")
        assert asked == [str(RIG)]


def test_another_domain_hears_and_commands_nothing(robot: Manipulator) -> None:
    with graph(robot, **COMMANDS) as it:
        other = Peer(own_domain(1), alone=True)
        reader = other.reader("~/state", m.String)
        vent = other.writer("~/vent", m.Empty, wait=False)
        state = it.peer.reader("~/state", m.String)
        for _ in range(3):
            state.wait()
        assert not reader.has_writer
        assert not vent.get_matched_subscriptions()
        other.close()


ON_THIS_MACHINE = {  # what rmw_cyclonedds makes of "this machine only"
    "humble": '<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces></General>',
    "jazzy": """<General><AllowMulticast>false</AllowMulticast></General><Discovery>
        <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
        <Peers><Peer address="localhost"/></Peers></Discovery>""",
}
LISTENER = """
import sys, ros_peer
from stiffopt.ros.messages import String
ros_peer.LOOPBACK = f"<CycloneDDS><Domain>{sys.argv[2]}</Domain></CycloneDDS>"
peer = ros_peer.Peer(int(sys.argv[1]), alone=True)
print(peer.reader("~/state", String).wait().data)
"""


@pytest.mark.parametrize("distro", ON_THIS_MACHINE)
def test_nodes_that_keep_to_this_machine_find_it(distro: str, robot: Manipulator) -> None:
    with graph(robot):
        done = subprocess.run(
            [sys.executable, "-c", LISTENER, str(own_domain()), ON_THIS_MACHINE[distro]],
            cwd=Path(__file__).parent, capture_output=True, text=True, timeout=100, check=False,
        )  # fmt: skip
        assert done.stdout == "inactive\n", done.stderr


@pytest.mark.parametrize("distro", ["humble", "jazzy"])
def test_the_graph_lists_the_node(distro: str, robot: Manipulator) -> None:
    with graph(robot, distro=distro, **COMMANDS) as it:
        info = m.LAYOUTS[distro][2]
        latched = Policy.Durability.TransientLocal
        topic_reader = it.peer.reader("~/state", m.String)  # so that something is matched
        wait_for(lambda: topic_reader.has_writer)
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        from ros_peer import Reader, qos

        topic = Topic(it.peer.participant, "ros_discovery_info", info)
        told = Reader(DataReader(it.peer.participant, topic, qos=qos(latched))).wait()
        size = {"humble": 24, "jazzy": 16}[distro]
        (node,) = told.node_entities_info_seq
        assert (node.node_namespace, node.node_name) == ("/", "stiffopt")

        def identities(entities: Any) -> set[bytes]:
            return {bytes(each.data).removesuffix(b"\0" * (size - 16)) for each in entities}

        def found(kind: Any) -> list[Any]:
            reader = BuiltinDataReader(it.peer.participant, kind)
            return [each for each in reader.take(1000) if each.sample_info.valid_data]

        (gid,) = identities([told.gid])
        (own,) = [p for p in found(BuiltinTopicDcpsParticipant) if p.key.bytes == gid]
        assert own.qos[Policy.Userdata].data == b"enclave=/;"
        for kind, listed in (
            (BuiltinTopicDcpsPublication, node.writer_gid_seq),
            (BuiltinTopicDcpsSubscription, node.reader_gid_seq),
        ):
            there = {e.key.bytes: e for e in found(kind) if e.participant_key.bytes == gid}
            assert identities(listed) <= there.keys()
            assert len(there) - len(listed) in (0, 1)  # the graph's own topic is not listed
            for key in identities(listed):
                about = there[key].qos[Policy.Userdata]
                text = "" if about is None else about.data.decode()
                assert there[key].topic_name[:3] in ("rt/", "rq/", "rr/")
                assert ("typehash=RIHS01_" in text) == (distro == "jazzy")
                if there[key].topic_name[:3] != "rt/":
                    assert "serviceid=" in text


# Fast DDS -----------------------------------------------------------------------------------------

FAST = ("fastddsgen", "libfastrtps-dev", "default-jre-headless", "g++")


def built_peer(folder: Path) -> Path:
    """Build the peer on Fast DDS; skip where it cannot be."""
    header = Path("/usr/include/fastdds/dds/domain/DomainParticipant.hpp")
    if not (shutil.which("fastddsgen") and shutil.which("g++") and header.exists()):
        pytest.skip(f"apt install {' '.join(FAST)}")
    store = ros_types.typestore("jazzy")
    names = ["sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseStamped"]
    names += ["geometry_msgs/msg/PointStamped", "trajectory_msgs/msg/JointTrajectory"]
    (folder / "ros.idl").write_text(ros_types.idl_of(store, names), encoding="ascii")
    source = Path(__file__).with_name("ros_fastdds_peer.cpp")
    made, libraries = ("ros.cxx", "rosPubSubTypes.cxx"), ("-lfastrtps", "-lfastcdr", "-lpthread")
    steps = [
        ["fastddsgen", "-cs", "-typeros2", "ros.idl"],
        ["g++", "-std=c++17", "-O0", "-w", "-I.", "-o", "peer", str(source), *made, *libraries],
    ]
    for step in steps:
        done = subprocess.run(step, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    return folder / "peer"


def test_topics_both_ways_with_fast_dds(robot: Manipulator, tmp_path: Path) -> None:
    program = built_peer(tmp_path)
    with graph(robot, **COMMANDS) as it:
        it.loop.now = replace(it.loop.now, measured=1e3 * np.arange(6))
        with subprocess.Popen(
            [program, str(own_domain())], stdout=subprocess.PIPE, text=True
        ) as fast:
            try:
                wait_for(lambda: len(it.loop.calls) >= 2)
            finally:
                fast.kill()
            assert fast.stdout is not None
            heard = dict(line.rstrip().split(" ", 1) for line in fast.stdout if " " in line)
        channels = channel_names(robot.description)
        expected = " ".join(f"{name}={1000 * k}" for k, name in enumerate(channels))
        assert heard["pressure"] == f"base {expected}"
        assert [float(x) for x in heard["tip"].split()] == [0, 0.01, 0.2, 1]
        given = dict(it.loop.calls)
        assert given["set_target"].position == (0.01, -0.02, 0.19)
        pressures = given["follow_trajectory"].pressures
        np.testing.assert_allclose(pressures, np.outer([1e3, 2e3], np.arange(1, 7)))


# the page ----------------------------------------------------------------------------------------


def test_the_python_of_the_page_compiles() -> None:
    page = (RIGS.parent / "docs/ros.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.S)
    assert len(blocks) == 2
    for block in blocks:
        compile(block, "ros.md", "exec")


# settings -----------------------------------------------------------------------------------------


def test_commands_need_an_interface(tmp_path: Path) -> None:
    text = RIG.read_text(encoding="utf-8")
    path = tmp_path / "rig.yaml"
    path.write_text(f"{text}\nros: {{commands: true}}\n", encoding="utf-8")
    with pytest.raises(FileError, match=r"ros.commands: needs 'interface': DDS has no token"):
        load_rig_description(path)
    path.write_text(f"{text}\nros: {{commands: true, interface: lo}}\n", encoding="utf-8")
    assert load_rig_description(path).ros.commands


def test_an_interface_that_is_not_there_is_told() -> None:
    with pytest.raises(InputError, match=r"no network interface 'nonsense'; this machine has .*lo"):
        RosNode(NodeNames("arm"), domain=own_domain(), interface="nonsense")
    assert "lo" in LOOPBACK
