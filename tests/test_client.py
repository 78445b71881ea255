"""The client against a real server on loopback: commands, heartbeat, stream, and what it raises."""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from fake_loop import FakeLoop
from running import wait_for
from stiffopt.control.state import Alarm, Severity, Snapshot, State, Timing
from stiffopt.daemon import server as server_module
from stiffopt.daemon.client import Client, ClientStream
from stiffopt.daemon.messages import MAX_MESSAGE
from stiffopt.daemon.server import (
    MAX_CONNECTIONS,
    MAX_STREAMS,
    ConnectionLimiter,
    LimitedConnection,
    Server,
)
from stiffopt.daemon.service import create_app
from stiffopt.daemon.state_json import record_of
from stiffopt.errors import CommandError, InputError, MissingExtraError, ServiceError
from stiffopt.model.robot_files import load_description
from stiffopt.optimise.goal import StiffnessGoal, StiffnessMeasure
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.paths.trajectory import Trajectory, Waypoint

pytestmark = pytest.mark.real_time

TOKEN = "a-secret-of-the-tests"
HEARTBEAT = 1.0
ROBOT = load_description("stiff-flop-2")


@pytest.fixture
def loop() -> FakeLoop:
    return FakeLoop()


@pytest.fixture
def server(loop: FakeLoop) -> Iterator[Server]:
    app = create_app(loop, robot=ROBOT, token=TOKEN, heartbeat=HEARTBEAT, patience=20.0)
    server = Server(app)
    server.start()
    yield server
    server.stop()
    assert not server.alive


@pytest.fixture
def client(server: Server) -> Iterator[Client]:
    with Client(server.url, TOKEN, name="planner") as client:
        yield client


# Connections --------------------------------------------------------------------------------------


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_connections_that_idle_or_dribble_keep_nobody_away_and_use_up_nothing(
    loop: FakeLoop, server: Server
) -> None:
    asks = b"POST /v1/vent HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer " + TOKEN.encode()
    says = [b"", b"GET /v1/sta", asks + b"\r\nContent-Length: 9\r\n\r\n{"]
    before = open_files()
    with Client(server.url, TOKEN, name="planner") as client, ExitStack() as idle:
        client.take_control()
        for k in range(3 * MAX_CONNECTIONS):
            other = idle.enter_context(socket.create_connection(("127.0.0.1", server.port), 10))
            other.sendall(says[k % len(says)])
        with Client(server.url, TOKEN) as late:
            late.vent()
        ends_of_ours = 3 * MAX_CONNECTIONS + 2
        wait_for(lambda: open_files() - before <= ends_of_ours + 2 * MAX_CONNECTIONS + 2)
        assert "vent" in loop.names
        other.sendall(b"       }")
        last = other.recv(100)
        assert last.startswith(b"HTTP/1.1 200")  # the newest were not dropped
    wait_for(lambda: open_files() <= before + 3)


def test_streams_outlive_many_connections(server: Server) -> None:
    with ExitStack() as stack, Client(server.url, TOKEN) as client:
        client.take_control()
        stream = stack.enter_context(client.stream(rate=50))
        first = stream.state()
        for _ in range(2 * MAX_CONNECTIONS):
            stack.enter_context(socket.create_connection(("127.0.0.1", server.port), 10))
        for _ in range(20):
            assert stream.state().time == first.time


def test_a_connection_on_which_nothing_is_answered_is_closed(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "PATIENCE", 0.2)
    for said in (b"", b"GET /v1/sta"):
        with socket.create_connection(("127.0.0.1", server.port), 10) as silent:
            silent.sendall(said)
            with suppress(ConnectionResetError):
                assert silent.recv(100) == b""


def test_where_all_with_the_token_are_being_answered_the_newest_has_to_go(
    loop: FakeLoop, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "MAX_CONNECTIONS", 2)
    free = threading.Event()
    waiting: list[str] = []

    def gate(name: str) -> None:
        waiting.append(name)
        free.wait(20)

    loop.gate = gate
    asks = b"POST /v1/vent HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer " + TOKEN.encode()
    with ExitStack() as stack:
        busy = []
        address = "127.0.0.1", server.port
        for _ in range(2):
            busy.append(stack.enter_context(socket.create_connection(address, 20)))
            busy[-1].sendall(asks + b"\r\n\r\n")
        wait_for(lambda: len(waiting) == 2)
        late = stack.enter_context(socket.create_connection(address, 10))
        late.sendall(asks + b"\r\n\r\n")
        with suppress(ConnectionResetError):
            assert late.recv(100) == b""
        free.set()
        for each in busy:
            assert each.recv(100).startswith(b"HTTP/1.1 200")


def dropping(member: LimitedConnection, dropped: list[LimitedConnection]) -> LimitedConnection:
    member.drop = lambda: dropped.append(member)
    return member


def test_strangers_give_way_to_strangers_and_who_is_trusted_to_nobody() -> None:
    limiter, dropped = ConnectionLimiter(), list[LimitedConnection]()
    trusted = dropping(LimitedConnection(), dropped)
    limiter.add(trusted)
    assert limiter.trust(trusted)
    strangers = [dropping(LimitedConnection(), dropped) for _ in range(MAX_CONNECTIONS + 3)]
    for stranger in strangers:
        limiter.add(stranger)
    assert dropped == strangers[:3]
    limiter.distrust(trusted)
    assert dropped == strangers[:4]
    assert not trusted.trusted


def test_streams_with_and_without_the_token_have_limits_of_their_own() -> None:
    limiter = ConnectionLimiter()
    members = [LimitedConnection() for _ in range(2 * MAX_STREAMS + 2)]
    for k, member in enumerate(members):
        member.is_stream = True
        limiter.add(member)
        assert limiter.admit_stream(member) is (k < MAX_STREAMS)
    for k, member in enumerate(members[MAX_STREAMS:]):
        limiter.trust(member)
        assert limiter.admit_stream(member) is (k < MAX_STREAMS)
    assert not limiter.trust(members[0])  # that would be one too many, and it stays as it is
    assert members[0].served
    limiter.remove(members[-3])
    assert limiter.admit_stream(members[-1])
    limiter.remove(members[-2])
    limiter.remove(members[-4])
    assert limiter.trust(members[0])


def test_handshakes_of_strangers_come_at_a_limited_rate() -> None:
    now = [0.0]
    limiter = ConnectionLimiter(clock=lambda: now[0])
    assert sum(limiter.permits_handshake() for _ in range(200)) == 50
    now[0] = 0.5
    assert sum(limiter.permits_handshake() for _ in range(200)) == 25


UPGRADE = (
    b"GET /v1/stream HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\n"
    b"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)


class Strangers:
    """Threads that connect without a token, say something, and come again when they are closed."""

    def __init__(self, server: Server, count: int, says: bytes) -> None:
        self._server, self._says = server, says
        self.opened, self.end = 0, time.monotonic() + 20
        self._enough = threading.Event()
        threads = [threading.Thread(target=self._run, daemon=True) for _ in range(count)]
        self._threads = threads

    def __enter__(self) -> Strangers:
        for thread in self._threads:
            thread.start()
        wait_for(lambda: self.opened > len(self._threads))
        return self

    def __exit__(self, *_: object) -> None:
        self._enough.set()
        for thread in self._threads:
            thread.join(10)

    def _run(self) -> None:
        while not self._enough.is_set() and time.monotonic() < self.end:
            with (
                suppress(OSError),
                socket.create_connection(("127.0.0.1", self._server.port), 5) as other,
            ):
                self.opened += 1
                other.sendall(self._says)
                other.settimeout(0.2)
                with suppress(TimeoutError):
                    while other.recv(4096) and not self._enough.is_set():
                        pass
                self._enough.wait(0.2)


@pytest.mark.parametrize("says", [UPGRADE, b"", b"GET /v1/sta"], ids=["stream", "silent", "slow"])
def test_strangers_who_come_again_and_again_keep_the_tokens_holder_from_nothing(
    loop: FakeLoop, says: bytes
) -> None:
    server = Server(create_app(loop, robot=ROBOT, token=TOKEN, heartbeat=30.0, patience=20.0))
    server.start()

    def soon(do: Callable[[], object]) -> None:
        begin = time.monotonic()
        do()
        assert time.monotonic() - begin < 10  # half of the time that a stranger may take

    with Strangers(server, 100 if says == UPGRADE else 200, says):
        for _ in range(3):
            with Client(server.url, TOKEN, name="planner", heartbeat="manual") as client:
                soon(client.take_control)
                stream = client.stream(rate=20)
                soon(stream.__enter__)
                for _ in range(5):
                    soon(stream.state)
                soon(client.vent)
                stream.__exit__(None, None, None)
                soon(client.release)
    server.stop()
    assert loop.names.count("vent") == 3


def test_a_stream_for_which_there_is_no_room_may_show_the_token(server: Server) -> None:
    with ExitStack() as stack:
        for _ in range(MAX_STREAMS):
            told(stack.enter_context(opened(server)), {})
        with opened(server, "?rate=50") as one_more:
            assert told(one_more, {"token": TOKEN}) == {"type": "access", "trusted": True}
            assert json.loads(one_more.recv(timeout=20))["type"] == "state"
        with opened(server, "?rate=50", Authorization=f"Bearer {TOKEN}") as trusted:
            assert json.loads(trusted.recv(timeout=20))["type"] == "state"
        with opened(server, "?rate=50") as stranger:  # no state before it is refused
            assert json.loads(stranger.recv(timeout=20))["error"]["code"] == "busy"


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
    with pytest.raises(CommandError, match="needs control"):
        client.arm()
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


# The stream's wire --------------------------------------------------------------------------------


def drain(stream: ClientStream) -> None:
    """Read states until that raises."""
    for _ in range(1000):
        stream.state()


def opened(server: Server, query: str = "?rate=0", **headers: str) -> ClientConnection:
    sent = {name.replace("_", "-"): value for name, value in headers.items()}
    url = server.url.replace("http", "ws") + "/v1/stream" + query
    return connect(url, additional_headers=sent, proxy=None)


def told(socket: ClientConnection, message: Any) -> dict[str, Any]:
    socket.send(message if isinstance(message, str | bytes) else json.dumps(message))
    return dict(json.loads(socket.recv(timeout=20)))


MALFORMED: list[Any] = [
    "",
    "{",
    "[]",
    "null",
    "NaN",
    "[" * 10_000,
    b"\x00\xff",
    {"seq": 1},
    {"target": {"position_m": [0, 0, 0.2]}},
    {"target": {"position_m": [0, 0]}, "seq": 1},
    '{"target": {"position_m": [0, 0, NaN]}, "seq": 1}',
    {"target": {"position_m": [0, 0, 0.2]}, "seq": -1},
    {"target": {"position_m": [0, 0, 0.2]}, "seq": 1, "arm": True},
    {"token": 3},
    {"password": "x"},
    '{"target": "' + "x" * MAX_MESSAGE + '"}',
    '{"target": ' + "1" * 5000 + ', "seq": 1}',
]


def test_malformed_messages_are_answered_and_change_nothing(
    loop: FakeLoop, client: Client, server: Server
) -> None:
    client.take_control()
    lease = str(client._lease)
    with opened(server, Authorization=f"Bearer {TOKEN}", Stiffopt_Lease=lease) as socket:
        for message in MALFORMED:
            answer = told(socket, message)
            assert answer["type"] == "error", message
            assert answer["error"]["message"]
        assert loop.calls == []
        good = {"target": {"position_m": [0, 0, 0.2]}, "seq": 5}
        assert told(socket, good) == {"type": "answer", "seq": 5, "accepted": True}


def test_a_message_that_is_far_too_long_ends_the_connection(loop: FakeLoop, server: Server) -> None:
    with opened(server) as socket, pytest.raises(ConnectionClosed):
        told(socket, "x" * 1_000_000)
    assert loop.calls == []


def test_token_and_lease_may_come_in_a_message(
    loop: FakeLoop, client: Client, server: Server
) -> None:
    client.take_control()
    good = {"target": {"position_m": [0, 0, 0.2]}, "seq": 1}
    with opened(server) as socket:
        answer = told(socket, good)
        assert (answer["seq"], answer["error"]["code"]) == (1, "no-token")
        assert told(socket, {"token": "x"})["error"]["code"] == "wrong-token"
        assert told(socket, {"token": TOKEN}) == {"type": "access", "trusted": True}
        assert told(socket, good)["error"]["code"] == "lease"
        told(socket, {"lease": client._lease})
        assert told(socket, good)["accepted"]
        assert told(socket, {"token": "x"})["error"]["code"] == "wrong-token"
        assert told(socket, good)["error"]["code"] == "no-token"  # a wrong one undoes a right one
    assert loop.names == ["set_target"]


@pytest.mark.parametrize(
    "headers",
    [{"Origin": "http://evil.example"}, {"Authorization": "Bearer wrong"}, {"Origin": "null"}],
)
def test_strangers_get_no_stream(server: Server, headers: dict[str, str]) -> None:
    with pytest.raises(InvalidStatus) as refused, opened(server, **headers):
        pass
    assert refused.value.response.status_code == 403


def test_another_host_name_gets_no_stream(server: Server) -> None:
    sock = socket.create_connection(("127.0.0.1", server.port))
    with (
        pytest.raises(InvalidStatus),
        connect("ws://evil.example/v1/stream", sock=sock, proxy=None) as socket_,
    ):
        socket_.recv(timeout=20)


@pytest.mark.parametrize("rate", ["-1", "nan", "fast", ""])
def test_rates_that_are_none_are_refused(server: Server, rate: str) -> None:
    with opened(server, f"?rate={rate}") as socket:
        assert "rate" in json.loads(socket.recv(timeout=20))["error"]["message"]
        with pytest.raises(ConnectionClosed):
            socket.recv(timeout=20)


def test_there_is_an_end_to_streams(server: Server) -> None:
    with ExitStack() as stack:
        for _ in range(MAX_STREAMS):
            told(stack.enter_context(opened(server)), {})
        with opened(server) as one_more:
            assert json.loads(one_more.recv(timeout=20))["error"]["code"] == "busy"
    with opened(server, "") as again:
        wait_for(lambda: json.loads(again.recv(timeout=20))["type"] == "state")


def test_the_stream_sends_states_without_a_token_at_a_limited_rate(server: Server) -> None:
    with opened(server, "?rate=1e9") as socket:
        begin = time.monotonic()
        for _ in range(30):
            message = json.loads(socket.recv(timeout=20))
            assert message["type"] == "state"
            assert record_of(Snapshot, message["state"]).state is State.INACTIVE
        assert time.monotonic() - begin > 0.2  # 100 Hz at most
