"""How a daemon ends, whatever hangs or fails."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from running import patient_rig
from stiffopt.daemon import daemon as daemon_module
from stiffopt.daemon.daemon import TIMES, Daemon
from stiffopt.errors import DeviceError

pytestmark = pytest.mark.real_time


class Standstill:
    """Everything that a daemon ends: parts that hang wait for `go_on`, and all are in a diary."""

    def __init__(self, made: Daemon, hangs: set[str]) -> None:
        self.calls: list[str] = []
        self.go_on = threading.Event()
        self._hangs = hangs
        made.link = SimpleNamespace(close=self("supply"), vent=self("vent"))  # type: ignore[assignment]
        made.loop.vent = self("loop")  # type: ignore[method-assign, assignment]
        made.loop.rig.tracker = SimpleNamespace(close=self("tracker"))  # type: ignore[assignment]
        made._controller.close = self("planner")  # type: ignore[method-assign]
        made._telemetry = SimpleNamespace(stop=self("telemetry"))  # type: ignore[assignment]
        made._server = SimpleNamespace(stop=self("service"))  # type: ignore[assignment]
        made._recorded = True
        control = self("control")
        made._control = threading.Thread(
            target=lambda: (made._stopping.wait(60), control()), daemon=True
        )
        made._control.failure = None  # type: ignore[attr-defined]
        made._control.start()

    def __call__(self, name: str) -> Any:
        def part(*_: Any) -> None:
            self.calls.append(name)
            if name in self._hangs:
                self.go_on.wait(60)

        return part


@pytest.fixture
def idle(tmp_path: Path, compiled: Path) -> Iterator[Daemon]:
    """A daemon that is not started, of devices that are not there."""
    made = Daemon(patient_rig(tmp_path, "modbus-aurora", safety={"ramp_time": "0.1 s"}))
    end_planner = made._controller.close
    yield made
    end_planner()


def stopped(made: Daemon, hangs: set[str]) -> list[str]:
    """Stop a daemon of which some parts hang, and return what it has ended, in order."""
    still = Standstill(made, hangs)
    try:
        begin = time.monotonic()
        made.stop()
        taken = time.monotonic() - begin
    finally:
        still.go_on.set()
    assert taken < made.description.safety.ramp_time + TIMES.stop - 1, hangs
    return still.calls


REST = {"planner", "tracker", "telemetry", "service"}


@pytest.mark.parametrize(
    "hangs",
    [set(), {"tracker"}, {"telemetry"}, {"service"}, REST],
    ids=("nothing", "tracker", "telemetry", "service", "all"),
)
def test_what_hangs_keeps_neither_the_supply_from_being_closed_nor_the_end(
    idle: Daemon, monkeypatch: pytest.MonkeyPatch, hangs: set[str]
) -> None:
    monkeypatch.setattr(daemon_module, "TIMES", replace(TIMES, rest=0.3))
    calls = stopped(idle, hangs)
    assert calls[:2] == ["control", "supply"]  # vented first, and this waits for nothing
    assert set(calls[2:]) == REST
    assert set(idle.hung) == hangs
    assert idle.trouble == ""
    told = [e.text for e in idle.loop.events.since(0)[0] if e.kind == "stop"]
    assert len(told) == len(hangs)


def test_a_supply_that_hangs_is_told_and_the_rest_ends(
    idle: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(daemon_module, "TIMES", replace(TIMES, control=0.3))
    assert set(stopped(idle, {"supply"})) >= REST
    assert idle.hung == ("supply",)
    assert "whether the supply is vented is not known" in idle.trouble


def test_it_ends_in_time_though_everything_hangs(idle: Daemon) -> None:
    calls = stopped(idle, {"control", "loop", "vent", "supply", *REST})
    assert calls.index("vent") < calls.index("supply") < min(calls.index(name) for name in REST)
    assert set(idle.hung) == {"control", "supply", *REST}
    assert isinstance(idle.failure, TimeoutError)


def test_what_fails_at_the_end_keeps_nothing_from_ending(idle: Daemon) -> None:
    still = Standstill(idle, set())

    def fail() -> None:
        raise DeviceError("no luck")

    idle.loop.rig.tracker.close = fail  # type: ignore[union-attr, method-assign]
    idle.link.close = fail  # type: ignore[method-assign]
    idle.stop()
    assert {"planner", "telemetry", "service"} <= set(still.calls)
    assert idle.trouble == "no luck"
    told = [e.text for e in idle.loop.events.since(0)[0] if e.kind == "stop"]
    assert told == ["the tracker did not end well: no luck"]


def test_telemetry_that_does_not_start_is_an_alarm_and_control_goes_on(
    idle: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(daemon_module, "TIMES", replace(TIMES, telemetry=0.2))
    hangs = threading.Event()
    idle._telemetry = SimpleNamespace(start=lambda: hangs.wait(20), port=None)  # type: ignore[assignment]
    idle._start_telemetry()
    hangs.set()
    events, _ = idle.loop.events.since(0)
    assert any(e.kind == "telemetry" and "has not started" in e.text for e in events)
