"""What the tests of client and server share: a server of a made-up loop, and its stream by hand."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from fake_loop import FakeLoop
from stiffopt.daemon.client import Client
from stiffopt.daemon.server import Server
from stiffopt.daemon.service import create_app
from stiffopt.model.robot_files import load_description

TOKEN = "a-secret-of-the-tests"
HEARTBEAT = 1.0
ROBOT = load_description("stiff-flop-2")


@pytest.fixture(name="loop")
def loop_fixture() -> FakeLoop:
    return FakeLoop()


@pytest.fixture(name="server")
def server_fixture(loop: FakeLoop) -> Iterator[Server]:
    app = create_app(loop, robot=ROBOT, token=TOKEN, heartbeat=HEARTBEAT, patience=20.0)
    server = Server(app)
    server.start()
    yield server
    server.stop()
    assert not server.alive


@pytest.fixture(name="client")
def client_fixture(server: Server) -> Iterator[Client]:
    with Client(server.url, TOKEN, name="planner") as client:
        yield client


def opened(server: Server, query: str = "?rate=0", **headers: str) -> ClientConnection:
    sent = {name.replace("_", "-"): value for name, value in headers.items()}
    url = server.url.replace("http", "ws") + "/v1/stream" + query
    return connect(url, additional_headers=sent, proxy=None)


def told(socket: ClientConnection, message: Any) -> dict[str, Any]:
    socket.send(message if isinstance(message, str | bytes) else json.dumps(message))
    return dict(json.loads(socket.recv(timeout=20)))
