"""The WebSocket `/v1/stream`, message by message."""

from __future__ import annotations

import json
import socket
import time
from contextlib import ExitStack
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from fake_loop import FakeLoop
from running import wait_for
from serving import (
    TOKEN,
    client_fixture,  # noqa: F401
    loop_fixture,  # noqa: F401
    opened,
    server_fixture,  # noqa: F401
    told,
)
from stiffopt.control.state import Snapshot, State
from stiffopt.daemon.client import Client
from stiffopt.daemon.messages import MAX_MESSAGE
from stiffopt.daemon.server import (
    MAX_STREAMS,
    Server,
)
from stiffopt.daemon.state_json import record_of

pytestmark = pytest.mark.real_time


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
