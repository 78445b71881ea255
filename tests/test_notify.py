"""What systemd is told."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from stiffopt.daemon.keeper import ServiceManager
from stiffopt.errors import MissingExtraError

VARIABLES = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")


class Time:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture(autouse=True)
def _no_manager(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.bind(str(tmp_path / "notify"))
        end.settimeout(2)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield end


def said(end: socket.socket) -> list[str]:
    """Everything that has come."""
    end.setblocking(False)
    texts = []
    while True:
        try:
            texts.append(end.recv(4096).decode())
        except BlockingIOError:
            return texts


def test_the_manager_is_told(manager: socket.socket) -> None:
    service = ServiceManager()
    service.ready()
    service.status("holding: tracker lost\n2 \N{GREEK SMALL LETTER MU}m, 3 \N{EN DASH} 4 bar")
    service.watchdog()
    service.stopping()
    service.close()
    service.ready()
    assert said(manager) == [
        "READY=1",
        "STATUS=holding: tracker lost 2 \N{GREEK SMALL LETTER MU}m, 3 \N{EN DASH} 4 bar",
        "STOPPING=1",
    ]


def test_signs_of_life_are_passed_on_when_they_are_due(
    manager: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "2000000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    clock = Time()
    service = ServiceManager(clock)
    assert service.watchdog_interval == 2.0
    heard = []
    for _ in range(400):  # 4 s at 100 Hz
        clock.now += 0.01
        service.watchdog()
        heard += [clock.now] * len(said(manager))
    service.close()
    assert heard == pytest.approx([100.01, 101.01, 102.01, 103.01], abs=0.011)


@pytest.mark.parametrize(
    "variables",
    [
        {},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "soon"},
        {"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"},
    ],
)
def test_nobody_looks(
    manager: socket.socket, monkeypatch: pytest.MonkeyPatch, variables: dict[str, str]
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    service = ServiceManager()
    assert service.watchdog_interval is None
    service.watchdog()
    service.close()
    assert said(manager) == []


def test_a_manager_that_takes_nothing_does_not_hold_up_the_loop(
    manager: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "2")
    clock = Time()
    service = ServiceManager(clock)
    for _ in range(5000):  # far more than a socket keeps
        clock.now += 1
        service.watchdog()
    service.close()
    assert 0 < len(said(manager)) < 5000


def test_without_a_manager_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "2000000")
    monkeypatch.setitem(sys.modules, "sdnotify", None)  # nor is it needed
    service = ServiceManager()
    assert service.watchdog_interval is None
    service.ready()
    service.status("well")
    service.watchdog()
    service.stopping()
    service.close()


def test_the_missing_library_is_named(
    manager: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "sdnotify", None)
    with pytest.raises(MissingExtraError, match="sdnotify"):
        ServiceManager()
