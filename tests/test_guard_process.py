"""The guard as a process: the loop's process is killed, stopped and hung, and the arm is vented."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from statistics import median
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest

from stiffopt.errors import CommandError, DeviceError, MissingExtraError, SlowWarning
from stiffopt.files import save_file
from stiffopt.lab.virtual import VirtualLab
from stiffopt.model.robot_files import load_description
from stiffopt.plant.settings import PlantSettings
from stiffopt.rig.config import load_rig, load_rig_description
from stiffopt.rig.interface import PressureCommand, Rig
from stiffopt.safety import guard_client
from stiffopt.safety.gate import Applied
from stiffopt.safety.guard_client import GuardLink
from stiffopt.safety.rigs import guarded_rig
from stiffopt.safety.settings import CLIENT

pytestmark = pytest.mark.real_time

HERE = Path(__file__).parent
RIGS = HERE.parent / "rig"
ROBOT = load_description("stiff-flop-1")
RUNS = int(os.environ.get("STIFFOPT_GUARD_RUNS", "0"))  # 0: few
TYPICAL, WORST = 0.15, 0.4  # s; at the default timeout of 50 ms


class Feeder:
    """A process that runs `guard_feeder.py`; what it and its guard say is timed."""

    def __init__(self, rig: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(HERE / "guard_feeder.py"), str(rig)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.heard: list[tuple[float, str]] = []
        self._read = 0
        streams = (self.process.stdout, self.process.stderr)
        self._threads = [Thread(target=self._listen, args=(s,), daemon=True) for s in streams]
        for thread in self._threads:
            thread.start()

    def _listen(self, stream: Any) -> None:
        for line in stream:
            self.heard.append((time.monotonic(), line))

    def hear(self, text: str, timeout: float = 30.0) -> float:
        """Wait for a line with a text, after the one that was waited for last; return when."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            while self._read < len(self.heard):
                moment, line = self.heard[self._read]
                self._read += 1
                if text in line:
                    return moment
            time.sleep(0.001)
        raise AssertionError(f"'{text}' was not heard, but {self.heard}")

    def ready(self) -> None:
        """Wait until it feeds and has done so for a little while, however busy the machine is."""
        while True:
            since = self.hear("feeding")
            time.sleep(0.05)
            if not any("vented" in line for moment, line in self.heard if moment > since):
                return

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        for thread in self._threads:  # the guard holds the ends until it has vented, and gone
            thread.join(10)
            assert not thread.is_alive()
        for stream in (self.process.stdout, self.process.stderr):
            assert stream is not None
            stream.close()


@pytest.fixture(scope="module")
def patient_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated rig with a guard that is not impatient with a busy machine."""
    description = load_rig_description(RIGS / "sim.yaml")
    plant = (description.plant or PlantSettings()).model_copy(update={"faults": True})
    safety = description.safety.model_copy(update={"guard_timeout": 1.0})
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    update = {"plant": plant, "safety": safety, "probe": None}
    save_file(path, "rig", description.model_copy(update=update))
    return path


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[VirtualLab, Path]]:
    description = load_rig_description(RIGS / "sim.yaml")
    description = description.model_copy(update={"probe": None, "tracker": None})
    path = tmp_path_factory.mktemp("lab") / "rig.yaml"
    with VirtualLab(description, ROBOT, "modbus") as lab:
        with socket.create_server(("127.0.0.1", 0)) as server:
            port = server.getsockname()[1]
        supply = lab.description.supply
        tcp = supply.tcp.model_copy(update={"port": port})  # type: ignore[union-attr]
        supply = supply.model_copy(update={"tcp": tcp, "watchdog": None})
        lab.description = lab.description.model_copy(update={"supply": supply, "tracker": None})
        save_file(path, "rig", lab.start())
        yield lab, path


def wait_for(condition: Callable[[], Any], timeout: float = 10.0) -> float:
    """Wait until something is so, closely; return when it was."""
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "that did not happen in time"
        time.sleep(0.001)
    return time.monotonic()


# how soon ----------------------------------------------------------------------------------------


def end_it(feeder: Feeder, how: str) -> float:
    """Kill, stop or hang a feeder; return when."""
    moment = time.monotonic()
    feeder.process.send_signal(
        {"killed": signal.SIGKILL, "stopped": signal.SIGSTOP, "hung": signal.SIGUSR1}[how]
    )
    return moment


def delays(path: Path, vented: Callable[[Feeder], float]) -> dict[str, list[float]]:
    """How long it took to vent after the loop was stopped, hung and killed, in s."""
    found: dict[str, list[float]] = {"stopped": [], "hung": [], "killed": []}
    while len(found["killed"]) < (RUNS or 2):
        feeder = Feeder(path)
        try:
            for how in ("stopped", "hung") if not found["killed"] else ():
                for _ in range(RUNS or 3):
                    feeder.ready()
                    found[how].append(-end_it(feeder, how) + vented(feeder))
                    if how == "stopped":
                        time.sleep(0.1)
                        feeder.process.send_signal(signal.SIGCONT)
                    feeder.hear("told: the guard has vented: no command had come for 50 ms")
            feeder.ready()
            found["killed"].append(-end_it(feeder, "killed") + vented(feeder))
        finally:
            feeder.close()
    for how, values in found.items():
        print(f"vented ms after the loop was {how}: {np.round(1e3 * np.array(values), 1)}")
    return found


def are_short(found: dict[str, list[float]]) -> None:
    for values in found.values():
        assert median(values) < TYPICAL
        assert max(values) < WORST


def test_a_lost_loop_is_noticed() -> None:
    found = delays(RIGS / "sim.yaml", lambda feeder: feeder.hear("guard: vented"))
    are_short(found)
    assert min(found["stopped"] + found["hung"]) > 0.03  # no sooner than it should


def test_the_pressures_fall_when_the_loop_is_lost(lab: tuple[VirtualLab, Path]) -> None:
    """Set-points in the world, behind the real driver and a real protocol, fall in time."""
    world = lab[0].world

    def vented(feeder: Feeder) -> float:
        moment = wait_for(lambda: not world.set_point.any())
        wait_for(lambda: (world.pressures < 2e3).all(), 3.0)
        return moment

    are_short(delays(lab[1], vented))


# the link ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def kept_rig(patient_file: Path) -> Iterator[tuple[Rig, GuardLink]]:
    rig, link = guarded_rig(*load_rig(patient_file))
    with rig:
        yield rig, link


@pytest.fixture
def guarded(kept_rig: tuple[Rig, GuardLink]) -> Iterator[tuple[Rig, GuardLink]]:
    """A vented rig that has no fault, for tests that leave it alive."""
    yield kept_rig
    link = kept_rig[1]
    link.inject("supply", "ok")
    link.inject("tracker", "ok")
    link.vent()
    wait_for(lambda: (np.array(link.ask_world("pressures")) < 1e3).all(), 3.0)
    link.arm()  # forgets a trip
    link.vent()


@pytest.fixture
def doomed(patient_file: Path) -> Iterator[tuple[Rig, GuardLink]]:
    """A rig whose guard may be killed."""
    rig, link = guarded_rig(*load_rig(patient_file))
    rig.open()
    pid = link.pid
    assert pid is not None
    yield rig, link
    with suppress(DeviceError):
        rig.close()
    assert not link.alive
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def feed(rig: Rig, link: GuardLink, seconds: float, pressure: float = 3e4) -> Applied:
    """Command a pressure for a while."""
    end = time.monotonic() + seconds
    while True:
        p = np.full(rig.supply.n, pressure)
        applied = link.apply(PressureCommand(p, rig.clock.now(), 0.1))
        if time.monotonic() > end:
            return applied
        time.sleep(0.01)


def test_a_rig_behind_a_guard(guarded: tuple[Rig, GuardLink]) -> None:
    """All times are on one clock; the truth is there for tests; faults can be injected."""
    rig, link = guarded
    tracker = rig.tracker
    assert tracker is not None
    assert link.real_time
    refused = feed(rig, link, 0.1)
    assert "arm" in refused.refused
    assert not refused.pressures.any()
    link.arm()
    before = rig.clock.now()
    first = feed(rig, link, 0.02)
    assert first.limited
    assert (first.pressures < 3e4).all()
    tracker.read()
    applied = feed(rig, link, 1.0)
    now = rig.clock.now()
    np.testing.assert_allclose(applied.pressures, 3e4)
    np.testing.assert_allclose(applied.reading.pressures, 3e4, atol=2e3)
    assert before < applied.reading.time < now
    assert now - applied.reading.time < 1.0  # one tick, on a machine that is busy
    samples = tracker.read()
    assert len(samples) > 20
    times = np.array([sample.time for sample in samples])
    assert (np.diff(times) > 0).all()
    assert before - 2.0 < times[0]
    assert times[-1] < samples[-1].received <= rig.clock.now()
    assert tracker.age() < 0.5
    np.testing.assert_allclose(samples[-1].position, link.truth()[:3, 3], atol=5e-3)

    feed(rig, link, 0.05)
    too_much = feed(rig, link, 0.1, pressure=9e5)
    assert "limits" in too_much.refused
    np.testing.assert_allclose(too_much.pressures, 3e4)
    link.inject("tracker", "missing")
    feed(rig, link, 0.5)
    assert not tracker.read()[-1].visible
    with pytest.raises(DeviceError, match="there is no fault 'rain'"):
        link.inject("tracker", "rain")
    link.vent()
    wait_for(lambda: (np.array(link.ask_world("pressures")) < 1e3).all(), 3.0)
    wait_for(lambda: "arm" in feed(rig, link, 0.0).refused)  # its answer may come a moment later


def test_a_supply_that_fails_is_told_and_can_be_armed_again(
    guarded: tuple[Rig, GuardLink],
) -> None:
    rig, link = guarded
    link.arm()
    feed(rig, link, 0.3)
    link.inject("supply", "off")
    with pytest.raises(DeviceError, match="does not answer"):
        feed(rig, link, 2.0)
    with pytest.raises(DeviceError, match="does not answer"):
        link.vent()
    with pytest.raises(DeviceError, match="does not answer"):
        link.read()
    with pytest.raises(DeviceError, match="could not be vented yet"):
        link.arm()
    link.inject("supply", "ok")
    # the guard tries on by itself
    wait_for(lambda: (np.array(link.ask_world("pressures")) < 1e3).all(), 3.0)
    link.arm()
    assert feed(rig, link, 0.1).pressures.all()


def test_a_trip_is_told_before_it_is_armed_again(guarded: tuple[Rig, GuardLink]) -> None:
    rig, link = guarded
    for told_by in ("apply", "arm", "vent"):
        link.arm()
        feed(rig, link, 0.1)
        time.sleep(1.3)
        link.read()  # needs not know
        if told_by == "vent":  # a loop that has vented itself is not misled
            link.vent()
        else:
            with pytest.raises(DeviceError, match="no command had come for 1000 ms"):
                feed(rig, link, 0.0) if told_by == "apply" else link.arm()
    link.arm()


def test_the_stand_in_for_the_supply(guarded: tuple[Rig, GuardLink]) -> None:
    rig, link = guarded
    link.arm()
    feed(rig, link, 0.3)
    with pytest.raises(CommandError, match="commands of another kind"):
        rig.command(np.full(rig.supply.n, 1e4))  # a stream has been begun
    rig.vent()
    wait_for(lambda: (rig.observe().pressure.pressures < 5e3).all(), 3.0)


def test_any_thread_may_call(guarded: tuple[Rig, GuardLink]) -> None:
    rig, link = guarded
    link.arm()
    stop, failures, counts = Event(), list[BaseException](), [0, 0, 0]

    def keep(index: int, act: Callable[[], object]) -> None:
        try:
            while not stop.is_set():
                act()
                counts[index] += 1
        except BaseException as error:
            failures.append(error)

    tracker = rig.tracker
    assert tracker is not None
    acts = (link.read, link.truth, tracker.read)
    threads = [Thread(target=keep, args=item) for item in enumerate(acts)]
    for thread in threads:
        thread.start()
    slowest = 0.0
    for _ in range(100):
        before = time.monotonic()
        feed(rig, link, 0.0)
        slowest = max(slowest, time.monotonic() - before)
        time.sleep(0.005)
    before = time.monotonic()
    link.vent()
    assert time.monotonic() - before < 0.5
    stop.set()
    for thread in threads:
        thread.join(10)
    # a vent waits for nothing, not even for requests that came before it
    assert all("overtaken" in str(failure) for failure in failures)
    assert min(counts) > 10
    assert slowest < 0.3


# the guard itself is lost ------------------------------------------------------------------------


def test_a_killed_guard_is_noticed(doomed: tuple[Rig, GuardLink]) -> None:
    rig, link = doomed
    link.arm()
    feed(rig, link, 0.05)
    assert link.pid is not None
    os.kill(link.pid, signal.SIGKILL)
    with pytest.raises(DeviceError, match="the guard process has ended"):
        feed(rig, link, 2.0)
    for act in (link.read, link.arm):
        with pytest.raises(DeviceError, match="the guard process has ended"):
            act()
    link.vent()  # a simulated arm is gone with its guard
    link.close()
    with pytest.raises(DeviceError, match="open the link"):
        link.vent()
    link.close()  # once is enough


def test_a_guard_that_is_just_ending_is_waited_for(
    doomed: tuple[Rig, GuardLink], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guard_client, "CLIENT", replace(CLIENT, exit=30.0))
    _, link = doomed
    exchange = link._exchange
    assert exchange is not None
    exchange.close()  # the guard vents and ends, but its process is still there for a moment
    assert link.alive
    link.vent()
    assert not link.alive


def test_a_stopped_guard_is_noticed(guarded: tuple[Rig, GuardLink]) -> None:
    rig, link = guarded
    link.arm()
    feed(rig, link, 0.05)
    assert link.pid is not None
    os.kill(link.pid, signal.SIGSTOP)
    before = time.monotonic()
    try:
        with pytest.raises(DeviceError, match="has not answered"):
            feed(rig, link, 5.0)
        assert time.monotonic() - before < 1.0
    finally:
        os.kill(link.pid, signal.SIGCONT)


def test_signals_to_the_guard(doomed: tuple[Rig, GuardLink]) -> None:
    rig, link = doomed
    link.arm()
    assert link.pid is not None
    os.kill(link.pid, signal.SIGINT)  # a terminal's Ctrl-C: the loop sees to it
    feed(rig, link, 0.3)
    os.kill(link.pid, signal.SIGTERM)
    with pytest.raises(DeviceError, match="the guard process has ended"):
        feed(rig, link, 2.0)


def test_a_guard_that_can_not_connect_says_why(lab: tuple[VirtualLab, Path]) -> None:
    description = load_rig_description(lab[1])
    supply: Any = description.supply
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]  # where nobody listens
        tcp = supply.tcp.model_copy(update={"port": port})
        supply = supply.model_copy(update={"tcp": tcp})
        rig, link = guarded_rig(description.model_copy(update={"supply": supply}), ROBOT)
        with pytest.raises(DeviceError, match=str(port)):
            link.open()
    assert not link.alive
    assert rig.supply.n == 3
    with pytest.raises(DeviceError, match="open the link"):
        link.read()


def test_a_real_rig_opens_its_own_tracker() -> None:
    rig, _ = guarded_rig(*load_rig(RIGS / "modbus-aurora.yaml"))
    assert type(rig.tracker).__name__ == "AuroraTracker"
    assert rig.clock is rig.tracker.clock  # type: ignore[union-attr]


# the start ---------------------------------------------------------------------------------------

STUB = """
import socket, sys, time
from stiffopt.safety.messages import GuardNotice
end = socket.socket(fileno=int(sys.argv[1]))
{}
"""


def stubbed(folder: Path, monkeypatch: pytest.MonkeyPatch, body: str) -> GuardLink:
    """A link to a guard that does something else."""
    (folder / "stub.py").write_text(STUB.format(body))
    python = folder / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} {folder}/stub.py "$4"\n')
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    return guarded_rig(*load_rig(RIGS / "sim.yaml"))[1]


@pytest.mark.parametrize(
    ("body", "error", "text"),
    [
        ("", DeviceError, "ended before it was ready"),
        ("time.sleep(60)", DeviceError, "was not ready within 0.2 s"),
        (
            "end.send(GuardNotice('notice', {'text': 'the simulator is compiled'}).pack())\n"
            "time.sleep(60)",
            DeviceError,
            "was not ready within 0.3 s",
        ),
        (
            "about = {'kind': 'MissingExtraError', 'args': ['a', 'b']}\n"
            "end.send(GuardNotice('failed', about).pack())",
            MissingExtraError,
            "needs a",
        ),
    ],
)
def test_a_guard_that_does_not_start(
    body: str,
    error: type[Exception],
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start = 0.2 if body.startswith("time") else CLIENT.start
    monkeypatch.setattr(guard_client, "CLIENT", replace(CLIENT, start=start, slow=0.3, end=0.2))
    link = stubbed(tmp_path, monkeypatch, body)
    with pytest.raises(error, match=text):
        link.open()
    assert not link.alive


def test_what_takes_its_time_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The guard's notice comes while it is not ready; then this one says no more."""
    body = (
        "end.send(GuardNotice('notice', {'text': 'the simulator is being made'}).pack())\n"
        "end.send(GuardNotice('ready', {'real_time': 'no'}).pack())\n"
        "time.sleep(60)"
    )
    monkeypatch.setattr(guard_client, "CLIENT", replace(CLIENT, answer=0.2, end=0.2))
    link = stubbed(tmp_path, monkeypatch, body)
    with (
        pytest.warns(SlowWarning, match="is being made"),
        pytest.raises(DeviceError, match="did not answer to 'read'"),
    ):
        link.open()
    assert link.real_time == "no"
