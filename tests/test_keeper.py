"""The keeper of a running daemon, and the events that log records become."""

from __future__ import annotations

import logging
import re
from types import SimpleNamespace
from typing import Any

import pytest

from fake_loop import FakeLoop, ManualClock
from running import wait_for
from stiffopt.control.lifecycle import EventBuffer
from stiffopt.control.state import Severity, Snapshot, State
from stiffopt.daemon.keeper import Keeper, LogEvents, ServiceManager
from stiffopt.errors import DeviceError

pytestmark = pytest.mark.real_time


class KeptLoop(FakeLoop):
    def __init__(self) -> None:
        super().__init__()
        self.alarms: dict[str, str] = {}

    def add_alarm(self, kind: str, text: str) -> None:
        self.alarms[kind] = text

    def clear_alarm(self, kind: str) -> None:
        self.alarms.pop(kind, None)


class FakeLink:
    def __init__(self) -> None:
        self.alive = False
        self.opened = 0
        self.fails = False

    def open(self) -> None:
        self.opened += 1
        if self.fails:
            raise DeviceError("nobody answers")
        self.alive = True

    def close(self) -> None:
        raise DeviceError("the old one ended with code -9")


class FakeManager(ServiceManager):
    def __init__(self) -> None:
        super().__init__()
        self.told: list[str] = []

    def status(self, text: str) -> None:
        self.told.append(text)


def test_the_keeper_replaces_a_guard_again_and_again() -> None:
    loop, link, now = KeptLoop(), FakeLink(), [100.0]
    keeper = Keeper(loop, link, FakeManager(), clock=lambda: now[0])  # type: ignore[arg-type]
    link.fails = True
    keeper.look()
    keeper.look()
    assert link.opened == 1  # not at once again
    assert "no guard process can be started: nobody answers" in loop.alarms["guard"]
    now[0], link.fails = 103.0, False
    keeper.look()
    assert link.opened == 2
    assert not loop.alarms


def test_the_keeper_holds_the_arm_when_the_service_ends() -> None:
    loop, link, serves = KeptLoop(), FakeLink(), [True]
    link.alive = True
    keeper = Keeper(loop, link, FakeManager(), lambda: serves[0])  # type: ignore[arg-type]
    keeper.look()
    assert not loop.calls
    serves[0] = False
    keeper.look()
    keeper.look()
    assert loop.names == ["hold"]
    assert "service" in loop.alarms


def test_the_keeper_goes_on_and_tells_the_service_manager() -> None:
    loop, link, manager = KeptLoop(), FakeLink(), FakeManager()
    link.alive = True
    loop.now = Snapshot(**{**loop.now.__dict__, "state": State.FAULT, "reason": "a leak"})

    def serving() -> bool:
        raise ZeroDivisionError("no luck")

    keeper = Keeper(loop, link, manager, serving)  # type: ignore[arg-type]
    keeper.start()
    wait_for(lambda: "ZeroDivisionError" in loop.alarms.get("keeper", ""))
    keeper.stop()
    assert manager.told == ["fault: a leak"]


# what is logged ----------------------------------------------------------------------------------


def listening() -> tuple[EventBuffer, Any]:
    """Return the events of a loop, and the loop."""
    events = EventBuffer()
    return events, SimpleNamespace(events=events, rig=SimpleNamespace(clock=ManualClock()))


def test_what_libraries_log_becomes_events_and_never_a_flood() -> None:
    (events, loop), now = listening(), [0.0]
    handler = LogEvents(loop, lambda: now[0])
    handler.attach()
    try:
        ours, theirs = logging.getLogger("stiffopt.x"), logging.getLogger("uvicorn.error")
        for moment in range(300):
            now[0] = moment * 0.01
            theirs.warning("Invalid HTTP request received from %d.", moment)
        try:
            raise KeyError("oh")
        except KeyError:
            ours.exception("it failed\nat this")
        logging.getLogger("foxglove.websocket.server").error("handshake failed " + 9000 * "x")
        theirs.info("all is well")
    finally:
        handler.detach()
    theirs.critical("nobody hears")
    told = events.since(0)[0]
    assert [event.text for event in told[:3]] == [
        f"Invalid HTTP request received from {moment}." for moment in (0, 100, 200)
    ]
    assert re.fullmatch(r"it failed \(KeyError: 'oh', test_keeper\.py:\d+\)", told[3].text)
    assert (told[3].severity, told[3].time) == (Severity.ERROR, 100.0)
    assert (told[4].severity, len(told[4].text)) == (Severity.WARNING, 300)
    assert len(told) == 5


def test_what_cannot_be_put_into_words_does_not_hurt_who_logs_it() -> None:
    events, loop = listening()

    class OddError(Exception):
        def __str__(self) -> str:
            raise RuntimeError("no words")

    odd = logging.LogRecord("uvicorn.error", logging.ERROR, "a.py", 9, "it is", (), None)
    odd.exc_info = (OddError, OddError(), None)
    handler = LogEvents(loop)
    for record in (
        logging.LogRecord("uvicorn.error", logging.WARNING, "/b/a.py", 7, "%d", ("x",), None),
        logging.LogRecord("stiffopt.x", logging.ERROR, "/b/a.py", 8, "%d %d", (1,), None),
        odd,
    ):
        handler.handle(record)
    assert [event.text for event in events.since(0)[0]] == [
        "what was logged in a.py:7 cannot be shown (TypeError)",
        "what was logged in a.py:8 cannot be shown (TypeError)",
        "what was logged in a.py:9 cannot be shown (RuntimeError)",
    ]
    loop.events = None  # nor what else may be wrong
    handler.handle(logging.LogRecord("stiffopt.x", logging.ERROR, "a.py", 1, "late", (), None))
