"""How many connections and streams a server has, and who must give way."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from fake_loop import FakeLoop
from running import wait_for
from serving import (
    ROBOT,
    TOKEN,
    loop_fixture,  # noqa: F401
    opened,
    server_fixture,  # noqa: F401
    told,
)
from stiffopt.daemon import server as server_module
from stiffopt.daemon.client import Client
from stiffopt.daemon.server import (
    MAX_CONNECTIONS,
    MAX_STREAMS,
    ConnectionLimiter,
    LimitedConnection,
    Server,
)
from stiffopt.daemon.service import create_app

pytestmark = pytest.mark.real_time


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
