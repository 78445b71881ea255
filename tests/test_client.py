"""The client against a real server on loopback: commands, heartbeat, stream, and what it raises."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fake_loop import FakeLoop
from running import wait_for
from serving import (
    HEARTBEAT,
    ROBOT,
    TOKEN,
    client_fixture,  # noqa: F401
    loop_fixture,  # noqa: F401
    server_fixture,  # noqa: F401
)
from stiffopt.control.state import Alarm, Severity, State, Timing
from stiffopt.daemon.client import Client, ClientStream
from stiffopt.daemon.server import (
    Server,
)
from stiffopt.errors import CommandError, InputError, MissingExtraError, ServiceError
from stiffopt.optimise.goal import StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.paths.trajectory import Trajectory, Waypoint

pytestmark = pytest.mark.real_time


def drain(stream: ClientStream) -> None:
    """Read states until that raises."""
    for _ in range(1000):
        stream.state()


# Reading and commands -----------------------------------------------------------------------------


def test_a_state_comes_back_as_it_was(loop: FakeLoop, server: Server) -> None:
    loop.now = replace(
        loop.now,
        reason="a \u00fc",
        target_position=np.array([0.01, np.nan, 0.2]),
        position_error=3e-4,
        stiffness=0.2,
        best_stiffness=0.3,
        stiffness_unit="N*m/rad",
        seen_age=0.03,
        wrench=np.arange(6.0),
        alarms=(Alarm("disk", "full", 3.0),),
        timing=Timing(7, 1, 0.002, (0.001, 0.01), (5, 1, 1)),
    )
    with Client(server.url) as reader:  # without a token
        state = reader.state()
        assert reader.robot().n == 6
        events, after = reader.events()
    assert (events[1].kind, events[1].severity, after) == ("tracker-missing", Severity.WARNING, 2)
    for name, value in vars(loop.now).items():
        np.testing.assert_equal(getattr(state, name), value, err_msg=name)


def test_commands_reach_the_loop(loop: FakeLoop, client: Client) -> None:
    client.take_control()
    client.arm()
    task = Task(
        robot="stiff-flop-2",
        target=Target(position=(0, 0, 0.18)),
        stiffness=StiffnessGoal(maximise=StiffnessMeasure(direction=(1, 0, 0))),
    )
    client.set_task(task)
    client.set_task(position=[0, 0, 0.18], stiffness=task.stiffness)
    target = Target(position=(0.01, None, 0.2), pointing=(0, 0, 1))
    client.set_target(target)
    client.set_target(position=np.array([0, 0, 0.2]), orientation=[1, 0, 0, 0])
    line = Trajectory(waypoints=[Waypoint(time=t, target=target) for t in (0, 2)])
    client.follow_trajectory(line)
    client.follow_trajectory(times=[0.5, 1], positions=np.array([[0, 0, 0.2], [0, 0.01, 0.2]]))
    client.set_channels(without=[2, 5])
    client.hold("lunch")
    client.vent()
    client.reset()
    client.disarm()
    names, given = zip(*loop.calls, strict=True)
    assert names == (
        *("arm", "set_task", "set_task", "set_target", "set_target"),
        *("follow_trajectory", "follow_trajectory", "set_channels", "hold", "vent", "reset"),
        "disarm",
    )
    assert given[1] == given[2] == task.model_copy(update={"robot": ROBOT.name})
    assert given[3] == target
    assert given[4].orientation == (1, 0, 0, 0)
    assert given[5] == line
    assert given[6].waypoints[1].target.position == (0, 0.01, 0.2)
    assert given[7] == [1, 4]
    assert given[8] == "lunch"


def test_a_task_file_of_this_machine_may_be_given(
    loop: FakeLoop, client: Client, tmp_path: Path
) -> None:
    path = tmp_path / "task.yaml"
    path.write_text(
        "format: stiffopt-task/1\nrobot: stiff-flop-3\ntarget: {position: [0 mm, 0 mm, 190 mm]}\n"
    )
    client.take_control()
    with pytest.raises(InputError, match="'stiff-flop-3' is not the robot here"):
        client.set_task(path)
    path.write_text(path.read_text().replace("flop-3", "flop-2"))
    client.set_task(str(path))
    assert loop.calls[0][1].target.position == (0, 0, 0.19)


def test_what_the_daemon_refuses_is_raised(loop: FakeLoop, client: Client, server: Server) -> None:
    with pytest.raises(CommandError, match="needs control: take it first"):
        client.arm()
    with client.stream(rate=0) as stream:
        stream.send(position=[0, 0, 0.2])
        with pytest.raises(CommandError, match="needs control: take it first"):
            drain(stream)
    with (
        Client(server.url) as reader,
        pytest.raises(CommandError, match=r"daemon's token: give 'token' to .* STIFFOPT_TOKEN"),
    ):
        reader.take_control()
    client.take_control()
    client.take_control()  # it has it already
    with Client(server.url, TOKEN) as other, pytest.raises(CommandError, match="'planner' has"):
        other.take_control()
    with Client(server.url, "wrong") as other, pytest.raises(CommandError, match="not this daemon"):
        other.vent()
    loop.refusal = CommandError("the arm is in fault; reset it first")
    with pytest.raises(CommandError, match="in fault; reset it first"):
        client.arm()
    loop.refusal = InputError("12 mm out of reach")
    with pytest.raises(InputError, match="12 mm out of reach"):
        client.set_target(position=[0, 0, 1])
    loop.refusal = ZeroDivisionError("oops")
    with pytest.raises(ServiceError, match="its log says more"):
        client.arm()
    with pytest.raises(InputError):
        client.follow_trajectory(times=[1], positions=[])
    assert loop.calls == []


def test_a_daemon_that_is_not_there_is_a_connection_error(server: Server) -> None:
    server.stop()
    with Client(server.url) as client, pytest.raises(ConnectionError, match="cannot be reached"):
        client.state()
    with Client(server.url) as client, pytest.raises(ServiceError, match="no stream"):
        client.stream().__enter__()


def test_what_is_no_daemon_is_said_to_be_none() -> None:
    async def another(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "lifespan":
            while True:
                step = (await receive())["type"]
                await send({"type": f"{step}.complete"})
                if step == "lifespan.shutdown":
                    return
        await send({"type": "http.response.start", "status": 500, "headers": []})
        await send({"type": "http.response.body", "body": b"<html>"})

    server = Server(another)
    server.start()
    try:
        with Client(server.url) as client, pytest.raises(ServiceError, match="no stiffopt daemon"):
            client.state()
    finally:
        server.stop()


@pytest.mark.parametrize("url", ["", "127.0.0.1:8470", "ftp://x", "http://", "http://x:99999"])
def test_urls_that_are_none_are_refused(url: str) -> None:
    with pytest.raises(InputError, match="URL"):
        Client(url)


def test_the_token_comes_from_a_file_or_the_environment(
    loop: FakeLoop, server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "token"
    path.write_text(f"{TOKEN}\n")
    with Client(server.url, path) as client:
        client.vent()
    monkeypatch.setenv("STIFFOPT_TOKEN", TOKEN)
    with Client(server.url) as client:
        client.vent()
    monkeypatch.setenv("STIFFOPT_TOKEN", str(path))
    with Client(server.url) as client:
        client.vent()
    assert loop.names == ["vent"] * 3
    with pytest.raises(InputError, match="cannot be read"):
        Client(server.url, tmp_path / "nothing")


def test_no_proxy_of_the_environment_sees_the_token(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:1")
    with Client(client.url, TOKEN) as another:
        another.vent()
        with another.stream() as stream:
            stream.state()


def test_a_port_that_is_taken_is_refused(server: Server) -> None:
    with pytest.raises(InputError, match=f"cannot listen on 127.0.0.1 port {server.port}"):
        Server(lambda: None, port=server.port).start()
    with pytest.raises(InputError, match="cannot listen on no such host"):
        Server(lambda: None, "no such host").start()


def test_a_missing_library_is_named(
    client: Client, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "websockets.sync.client", None)
    with pytest.raises(MissingExtraError, match=r"stiffopt\[daemon\]"):
        client.stream().__enter__()
    monkeypatch.setitem(sys.modules, "httpx", None)
    with pytest.raises(MissingExtraError, match="httpx"):
        Client(server.url)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    monkeypatch.delitem(sys.modules, "stiffopt.daemon.server")
    with pytest.raises(MissingExtraError, match="uvicorn"):
        import_module("stiffopt.daemon.server")


# Settling -----------------------------------------------------------------------------------------


def settling(loop: FakeLoop, errors: Iterator[float]) -> None:
    steady = loop.now

    def snapshot() -> Any:
        return replace(steady, state=State.ACTIVE, position_error=next(errors))

    loop.snapshot = snapshot  # type: ignore[method-assign]


def test_settled_is_what_stays_near(loop: FakeLoop, client: Client) -> None:
    seen: list[float] = []

    def errors() -> Iterator[float]:
        for error in (9e-3, 1e-4, 9e-3):  # it only swings through
            seen.append(error)
            yield error
        while True:
            seen.append(2e-4)
            yield 2e-4

    settling(loop, errors())
    assert client.wait_until_settled(1e-3, timeout=20).position_error == 2e-4
    assert len(seen) > 4


def test_waiting_ends_where_it_is_in_vain(loop: FakeLoop, client: Client) -> None:
    loop.now = replace(loop.now, reason="tracker lost")
    with pytest.raises(CommandError, match="it is inactive: tracker lost"):
        client.wait_until_settled(1e-3, timeout=20)
    loop.now = replace(loop.now, state=State.ACTIVE)
    with pytest.raises(CommandError, match="the tip has no target"):
        client.wait_until_settled(1e-3, timeout=20)
    loop.now = replace(loop.now, position_error=3e-3)
    with pytest.raises(ServiceError, match=r"not settle within 0\.1 s; its error is 3 mm"):
        client.wait_until_settled(1e-3, timeout=0.1)


# Heartbeat ----------------------------------------------------------------------------------------


def test_the_automatic_heartbeat_keeps_control(loop: FakeLoop, client: Client) -> None:
    client.take_control()
    end = time.monotonic() + 2.5 * HEARTBEAT
    while time.monotonic() < end:
        time.sleep(0.05)
    client.arm()
    client.release()
    assert client.state().state is State.ACTIVE  # who gives control back does not stop the arm
    assert loop.names == ["arm"]


def test_without_heartbeat_the_arm_is_held(loop: FakeLoop, server: Server) -> None:
    with Client(server.url, TOKEN, name="hung", heartbeat="manual") as client:
        client.take_control()
        client.arm()
        for _ in range(4):
            time.sleep(HEARTBEAT / 3)
            client.renew()
        assert loop.names == ["arm"]
        wait_for(lambda: loop.names == ["arm", "hold"])
        assert "'hung'" in loop.calls[1][1]
        with pytest.raises(CommandError, match="control"):
            client.set_target(position=[0, 0, 0.2])


def test_the_heartbeat_ends_with_the_thread_that_took_control(
    loop: FakeLoop, client: Client
) -> None:
    thread = threading.Thread(target=client.take_control)
    thread.start()
    thread.join()
    assert client.in_control
    wait_for(lambda: loop.names == ["hold"])


def test_a_program_that_fails_leaves_the_arm_held(loop: FakeLoop, server: Server) -> None:
    def program() -> None:
        with Client(server.url, TOKEN) as client:
            client.take_control()
            client.arm()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        program()
    assert loop.calls[1] == ("hold", "the client ended by ZeroDivisionError")
    assert loop.calls[2][0] == "hold"  # one that ends, since nobody is left who would end it
    assert "has given control back" in loop.calls[2][1]
    with Client(server.url, TOKEN) as other:
        other.take_control()  # it is free


def test_a_heartbeat_must_be_one_that_there_is(server: Server) -> None:
    with pytest.raises(InputError, match="heartbeat"):
        Client(server.url, heartbeat="never")  # type: ignore[arg-type]


# Stream -------------------------------------------------------------------------------------------


def test_targets_are_streamed_and_states_come_back(loop: FakeLoop, server: Server) -> None:
    with Client(server.url, TOKEN, heartbeat="manual") as client:
        with client.stream(rate=50) as stream:
            client.take_control()  # also after the stream began
            end = time.monotonic() + 1.6 * HEARTBEAT
            while time.monotonic() < end:  # streaming is heard
                stream.send(position=[0, 0, 0.2])
                assert stream.state().time == 12.5
            wait_for(lambda: stream.accepted + stream.superseded >= 10)
        assert set(loop.names) == {"set_target"}
        assert loop.calls[-1][1].position == (0, 0, 0.2)
        client.release()


def test_a_refused_target_is_raised_at_the_next_call(loop: FakeLoop, client: Client) -> None:
    with client.stream() as stream:
        stream.send(Target(pointing=(0, 0, 1)))  # without control
        with pytest.raises(CommandError, match="needs control"):
            drain(stream)
        client.take_control()
        loop.refusal = InputError("out of reach")
        stream.send(position=[0, 0, 9])
        with pytest.raises(InputError, match="out of reach"):
            drain(stream)
        loop.refusal = None
        stream.send(position=[0, 0, 0.2])
        wait_for(lambda: stream.accepted == 1)


def test_a_stream_says_when_it_has_ended(client: Client, server: Server) -> None:
    with client.stream() as stream:
        stream.state()
        server.stop()
        with pytest.raises(ServiceError, match="ended"):
            drain(stream)
        with pytest.raises(ServiceError, match="ended"):
            stream.send(position=[0, 0, 0.2])


def test_only_the_newest_of_many_targets_is_passed_on(loop: FakeLoop, client: Client) -> None:
    gate, under_way = threading.Event(), threading.Event()

    def wait(name: str) -> None:
        under_way.set()
        gate.wait(20)

    loop.gate = wait
    client.take_control()
    with client.stream(rate=0) as stream:
        stream.send(position=[0, 0, 0.1])
        assert under_way.wait(20)
        for k in range(1, 20):
            stream.send(position=[0, 0, 0.1 + k / 1000])
        wait_for(lambda: stream.superseded == 18)  # the last one waits
        gate.set()
        wait_for(lambda: stream.accepted == 2)
    heights = [target.position[2] for _, target in loop.calls]
    assert heights == pytest.approx([0.1, 0.119])
