"""The ROS 2 node on loopback with peers: topics, services, goals, discovery, Fast DDS."""

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
from cyclonedds.util import duration

import ros_types
from fake_loop import FakeLoop
from ros_messages import (
    SIX,
    points,
    pose,
    robot_fixture,  # noqa: F401
)
from ros_peer import LOOPBACK, Peer, own_domain
from running import RIGS, wait_for
from stiffopt.control.state import State
from stiffopt.daemon.server import Server
from stiffopt.daemon.service import create_app
from stiffopt.errors import CommandError, FileError, InputError, ServiceError
from stiffopt.model.manipulator import Manipulator
from stiffopt.rig.config import load_rig_description
from stiffopt.rig.settings import RosSettings
from stiffopt.ros import bridge as bridge_module
from stiffopt.ros import messages as m
from stiffopt.ros.bridge import MOTIONS, SIMPLE, Bridge
from stiffopt.ros.names import NodeNames
from stiffopt.ros.node import RosNode
from stiffopt.ros.published import PUBLISHED, channel_names, time_of

pytestmark = pytest.mark.real_time


TOKEN = "a-secret-of-the-tests"


RIG = RIGS / "sim-two-segment.yaml"


AT_REST = m.Header(m.Time(), "base")


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
import os, sys, ros_peer
from stiffopt.ros.messages import String
ros_peer.LOOPBACK = f"<CycloneDDS><Domain>{sys.argv[2]}</Domain></CycloneDDS>"
peer = ros_peer.Peer(int(sys.argv[1]), alone=True)
print(peer.reader("~/state", String).wait().data, flush=True)
os._exit(0)  # once in many runs, Cyclone DDS does not return when its objects are collected
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


def test_the_python_of_the_page_compiles() -> None:
    page = (RIGS.parent / "docs/ros.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.S)
    assert len(blocks) == 2
    for block in blocks:
        compile(block, "ros.md", "exec")


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
