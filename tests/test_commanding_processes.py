"""What holds for real processes: scripts, experiments, daemons, and guards that are lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import stiffopt
from fake_bench import FakeBench
from stiffopt.cli.main import main
from stiffopt.errors import CommandError, DeviceError, GuardTripped
from stiffopt.lab.modbus_peer import ModbusPeer
from stiffopt.logs import read_log
from stiffopt.model.robot_files import load_description
from stiffopt.rig.drivers.modbus import ModbusSettings

pytestmark = pytest.mark.real_time

AREAS = np.array(load_description("stiff-flop-1").channel_areas)
SIM = """\
format: stiffopt-rig/1
robot: stiff-flop-1
supply: {driver: simulated}
tracker: {driver: simulated}
safety: {max_force: 0.5 N, max_slew: 0.1 bar/s}
plant: {dynamics: quasi-static}
"""
MODBUS = """\
format: stiffopt-rig/1
name: wire
robot: stiff-flop-1
supply:
  driver: modbus
  tcp: {{host: {host}, port: {port}}}
  timeout: 500 ms
  scale: {{counts: [0, 32767], pressure: [0 bar, 10 bar]}}
  channels: [{{setpoint: 1, reading: 1}}, {{setpoint: 2, reading: 2}}, {{setpoint: 3, reading: 3}}]
tracker: {{driver: openigtlink, host: 127.0.0.1, port: 9, name: Tip}}
safety: {{max_slew: 5 bar/s, {safety}}}
"""
SCRIPT = """
import os, sys, time
import numpy as np
import stiffopt
from stiffopt.rig.interface import Rig

rig = stiffopt.open_rig(sys.argv[1])
rig.tracker = None  # nobody sees the tip here
with rig:
    rig.supply.arm()
    rig.command([5e4, 4e4, 3e4], valid_for=60)
    time.sleep(0.5)
    print("pressed", flush=True)
    if "fork" in sys.argv and os.fork() == 0:
        time.sleep(20)
        os._exit(0)
    time.sleep(60)
"""


@pytest.fixture
def sim(tmp_path: Path) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text(SIM)
    return path


class Wire:
    """A Modbus device without watchdog and valve, and rig files that name it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.bench = folder, FakeBench()
        settings = ModbusSettings(
            driver="modbus",
            tcp={"host": "127.0.0.1", "port": 0},
            scale={"counts": [0, 32767], "pressure": ["0 bar", "10 bar"]},
            channels=[{"setpoint": i, "reading": i} for i in (1, 2, 3)],
        )
        self.peer = ModbusPeer(settings, self.bench)
        started = self.peer.start()
        assert started.tcp is not None
        self.port = started.tcp.port

    def file(self, host: str = "127.0.0.1", safety: str = "unprotected_supply: accepted") -> Path:
        path = self.folder / f"{host}.yaml"
        path.write_text(MODBUS.format(host=host, port=self.port, safety=safety))
        return path

    def rig(self, host: str = "127.0.0.1", **more: str) -> stiffopt.Rig:
        rig = stiffopt.open_rig(self.file(host, **more))
        rig.tracker = None  # nobody sees the tip here
        return rig

    @property
    def pressures(self) -> np.ndarray:
        return self.bench.pressures

    def vented_within(self, seconds: float) -> float:
        return until(lambda: not self.pressures.any(), seconds)


def until(condition: Callable[[], object], seconds: float) -> float:
    """Wait until something is so; return how long that took, in s."""
    begin = time.monotonic()
    while not condition():
        assert time.monotonic() - begin < seconds, f"not within {seconds} s"
        time.sleep(0.001)
    return time.monotonic() - begin


@pytest.fixture
def wire(tmp_path: Path) -> Iterator[Wire]:
    made = Wire(tmp_path)
    yield made
    made.peer.close()


@pytest.fixture
def script(wire: Wire) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    running: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", SCRIPT, str(wire.file()), *arguments]
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        assert running[-1].stdout is not None
        assert running[-1].stdout.readline() == "pressed\n"
        assert wire.pressures.all()
        return running[-1]

    yield start
    for process in running:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()
    wire.vented_within(5)


# limits of the rig file, for experiments and scripts ---------------------------------------------


def test_a_script_keeps_force_and_slew(sim: Path) -> None:
    with stiffopt.open_rig(sim) as rig:
        rig.supply.arm()
        before = rig.supply.commanded
        for _ in range(500):
            rig.command([1.5e5, 1.5e5, 1.5e5])
            rig.clock.sleep(0.01)
            now = rig.supply.commanded
            assert rig.force(now) <= 0.5 + 1e-9
            assert (np.abs(now - before) <= 1e4 * 0.01 + 1e-6).all()
            before = now
        assert rig.force(before) == pytest.approx(0.5)


def test_an_experiment_refuses_what_the_force_forbids(
    sim: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    code = main(["experiment", "kinematics", str(sim), "--out", str(tmp_path / "a"), "--no-plot"])
    assert code == 2
    assert "safety.max_force is 0.5 N" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "a").exists()


def test_an_experiment_keeps_force_and_slew(sim: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    short = ["--pressures", "0.15 bar", "--repetitions", "1", "--poses", "3", "--settle", "1 s"]
    command = ["experiment", "kinematics", str(sim), "--out", str(out), "--no-plot", "--quiet"]
    assert main([*command, *short]) == 0
    logs = [read_log(path) for path in out.glob("*.csv")]
    assert len(logs) == 2
    highest = 0.0
    for log in logs:
        force = np.maximum(log.commanded, 0) @ AREAS
        assert force.max() <= 0.5 + 1e-4  # the log rounds
        steps = np.abs(np.diff(log.commanded, axis=0)) / np.diff(log.time)[:, None]
        assert steps.max() <= 1e4 * 1.5  # frames and ticks are not at the same moments
        highest = max(highest, float(force.max()))
    assert highest > 0.4


# one supply, one program -------------------------------------------------------------------------


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_a_second_program_is_refused(wire: Wire, host: str) -> None:
    with wire.rig() as rig:
        rig.supply.arm()
        rig.command([5e4, 4e4, 3e4], valid_for=60)
        until(lambda: wire.pressures.max() > 4.9e4, 5)
        with pytest.raises(DeviceError, match=r"is commanded by process \d+ .*only one program"):
            wire.rig(host).open()
        assert wire.pressures.max() > 4.9e4  # nothing has happened to the first one
        assert rig.supply.armed
    wire.vented_within(1)
    with wire.rig(host):
        pass


def test_a_foreign_set_point_vents(wire: Wire) -> None:
    from pymodbus.client import ModbusTcpClient

    with wire.rig() as rig:
        rig.supply.arm()
        rig.command([5e4, 4e4, 3e4], valid_for=60)
        until(lambda: wire.pressures.max() > 4.9e4, 5)
        other = ModbusTcpClient("127.0.0.1", port=wire.port)  # from a machine without stiffopt
        assert other.connect()
        end = time.monotonic() + 5
        while rig.supply.armed and time.monotonic() < end:
            other.write_registers(1, [3000, 0, 0])
        other.close()
        with pytest.raises(GuardTripped, match="does another program write to it"):
            rig.command([5e4, 4e4, 3e4])
    wire.vented_within(1)


def test_a_supply_that_nothing_protects_is_not_armed(wire: Wire) -> None:
    with wire.rig(safety="ramp_time: 1 s") as rig:
        with pytest.raises((CommandError, DeviceError), match="unprotected_supply: accepted"):
            rig.supply.arm()
        with pytest.raises(CommandError, match="arm it first"):
            rig.command([1e4, 1e4, 1e4])
        with pytest.raises(CommandError, match="unprotected_supply: accepted"):
            rig.supply.check_arming()
    assert not wire.pressures.any()


# processes that are lost -------------------------------------------------------------------------


@pytest.mark.parametrize("fork", [(), ("fork",)])
def test_a_killed_script_is_vented_at_once(
    wire: Wire, script: Callable[..., subprocess.Popen[str]], fork: tuple[str, ...]
) -> None:
    process = script(*fork)
    process.kill()
    wire.vented_within(1.0)


def test_a_script_that_was_stopped_finds_its_guard_as_it_was(
    wire: Wire, script: Callable[..., subprocess.Popen[str]]
) -> None:
    process = script()
    process.send_signal(signal.SIGSTOP)  # Ctrl-Z
    time.sleep(8.0)  # longer than a guard may be silent
    process.send_signal(signal.SIGCONT)
    end = time.monotonic() + 1.5
    while time.monotonic() < end:
        assert wire.pressures.all()
        time.sleep(0.01)


def test_a_goal_holds_for_as_long_as_it_is_valid_and_no_longer(wire: Wire) -> None:
    rig = wire.rig()
    with rig:
        rig.supply.arm()
        rig.command([5e4, 4e4, 3e4], valid_for=1.5)
        until(lambda: wire.pressures.max() > 4.9e4, 10)
        assert until(lambda: not rig.supply.armed, 10) > 0.5  # let down, not dropped
        assert not wire.pressures.any()
        with pytest.raises(CommandError, match="longer valid_for"):
            rig.command([1e4, 1e4, 1e4])


_NAMES = ("SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGALRM", "SIGABRT", "SIGXCPU", "SIGSYS")
_SIGNALS = {name: getattr(signal, name) for name in _NAMES} | {"SIGRTMIN+3": signal.SIGRTMIN + 3}


_MANY = [name for name in _SIGNALS if name not in ("SIGTERM", "SIGHUP", "SIGRTMIN+3")]


@pytest.mark.parametrize(
    "name",
    [
        *("SIGTERM", "SIGHUP", "SIGRTMIN+3", "SIGKILL", "SIGSEGV"),
        *(pytest.param(name, marks=pytest.mark.long) for name in _MANY),
    ],
)
def test_a_lost_guard_leaves_nothing_under_pressure(wire: Wire, name: str) -> None:
    """The supply has neither watchdog nor valve: the guard vents, or else its client does."""
    with wire.rig() as rig:
        rig.supply.arm()
        rig.command([5e4, 4e4, 3e4], valid_for=60)
        until(lambda: wire.pressures.max() > 4.9e4, 5)
        link = rig.supply._outlet  # type: ignore[attr-defined]
        os.kill(link.pid, _SIGNALS.get(name) or getattr(signal, name))
        wire.vented_within(1.0)
        until(lambda: not link.alive, 5)
        with pytest.raises(DeviceError, match="the guard process has ended"):
            rig.command([5e4, 4e4, 3e4])


def test_signals_that_stop_or_interrupt_do_nothing_to_a_guard(wire: Wire) -> None:
    with wire.rig() as rig:
        rig.supply.arm()
        rig.command([5e4, 4e4, 3e4], valid_for=60)
        until(lambda: wire.pressures.max() > 4.9e4, 5)
        link = rig.supply._outlet  # type: ignore[attr-defined]
        for number in (signal.SIGINT, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU):
            os.kill(link.pid, number)
        time.sleep(0.3)
        assert rig.supply.armed
        assert wire.pressures.max() > 4.9e4


def test_a_stopped_guard_is_ended_and_the_supply_vented(wire: Wire) -> None:
    with wire.rig() as rig:
        rig.supply.arm()
        rig.command([5e4, 4e4, 3e4], valid_for=60)
        until(lambda: wire.pressures.max() > 4.9e4, 5)
        link = rig.supply._outlet  # type: ignore[attr-defined]
        os.kill(link.pid, signal.SIGSTOP)
        wire.vented_within(12.0)  # a second, and as long as the driver may take
        assert not link.alive
