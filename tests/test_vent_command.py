"""`stiffopt vent`: whoever commands a rig, and whatever became of that, the arm is vented."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from running import COMMAND, wait_for
from stiffopt.errors import DeviceError, GuardTripped
from stiffopt.files import save_file
from stiffopt.lab.virtual import VirtualLab
from stiffopt.model.robot_files import load_description
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import load_rig, load_rig_description
from stiffopt.rig.interface import PressureCommand, PressureSupply
from stiffopt.safety import vent as vent_module
from stiffopt.safety.claim import Claim
from stiffopt.safety.guard_client import GuardLink
from stiffopt.safety.rigs import guarded_rig
from stiffopt.safety.vent import vent_rig
from stiffopt.safety.vent_line import Reply, SocketPeer

pytestmark = pytest.mark.real_time

RIGS = Path(__file__).parent.parent / "rig"
BOUND = 45.0  # s, with the start of a Python on a machine that is busy
GUARD = b"python\0-P\0-m\0stiffopt.safety.guard\x0042\0"
UNDER_PRESSURE = "THE ARM MAY BE UNDER PRESSURE"


def vent(rig: Path, *options: str, timeout: float = BOUND) -> tuple[int, str, str]:
    """Run the command; return exit code, and what it says on stdout and stderr."""
    done = subprocess.run(
        [*COMMAND, "vent", str(rig), *options],
        capture_output=True,
        text=True,
        timeout=timeout,
    )
    assert "Traceback" not in done.stderr
    return done.returncode, done.stdout, " ".join(done.stderr.split())


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[VirtualLab, Path]]:
    """An arm behind a Modbus peer, and its rig file."""
    description = load_rig_description(RIGS / "sim.yaml")
    safety = description.safety.model_copy(update={"unprotected_supply": "accepted"})
    update = {"probe": None, "tracker": None, "safety": safety}
    description = description.model_copy(update=update)
    path = tmp_path_factory.mktemp("lab") / "rig.yaml"
    with VirtualLab(description, load_description("stiff-flop-1"), "modbus") as lab:
        supply: Any = lab.description.supply
        supply = supply.model_copy(
            update={
                "tcp": supply.tcp.model_copy(update={"port": 0, "timeout": 1.0}),
                "watchdog": None,
            }
        )
        lab.description = lab.description.model_copy(update={"supply": supply, "tracker": None})
        save_file(path, "rig", lab.start())
        yield lab, path


def press(lab: VirtualLab, path: Path) -> None:
    """Leave the arm under pressure, as a program does whose computer is cut off."""
    supply = bare_supply(path)
    supply.open()
    supply.arm()
    supply.command(np.full(3, 3e4))
    supply._close()
    wait_for(lambda: (lab.world.pressures > 1e4).all())


def bare_supply(path: Path) -> PressureSupply:
    supply = make_rig(load_rig_description(path), load_description("stiff-flop-1")).supply
    assert isinstance(supply, PressureSupply)
    return supply


@pytest.fixture
def commanded(lab: tuple[VirtualLab, Path]) -> Iterator[GuardLink]:
    """The rig in the hands of a guard, under pressure by a goal."""
    rig, link = guarded_rig(*load_rig(lab[1]))
    with rig:
        rig.supply.arm()
        rig.supply.command(PressureCommand(np.full(3, 3e4), rig.clock.now(), 60.0))
        wait_for(lambda: (lab[0].world.pressures > 1e4).all())
        yield link


def vented(lab: VirtualLab) -> bool:
    return not lab.world.set_point.any()


# nobody commands it ------------------------------------------------------------------------------


def test_a_rig_that_nobody_commands_is_vented_directly(lab: tuple[VirtualLab, Path]) -> None:
    press(*lab)
    code, out, err = vent(lab[1])
    assert (code, out.strip(), err) == (0, "vented directly: no program commands this supply", "")
    assert vented(lab[0])
    wait_for(lambda: (lab[0].world.pressures < 2e3).all())


def test_it_says_so_in_json(lab: tuple[VirtualLab, Path]) -> None:
    press(*lab)
    code, out, err = vent(lab[1], "--json")
    assert code == 0
    assert json.loads(out) == {
        "vented": True,
        "text": "vented directly: no program commands this supply",
    }
    assert err == ""
    assert vented(lab[0])


def test_a_simulated_rig_that_nobody_runs(tmp_path: Path) -> None:
    description = load_rig_description(RIGS / "sim.yaml")
    path = tmp_path / "rig.yaml"
    save_file(path, "rig", description.model_copy(update={"name": f"arm of {tmp_path.name}"}))
    said = vent_rig(path)
    assert said == f"nothing to vent: nobody runs the simulated rig 'arm of {tmp_path.name}'"


# a guard has it ----------------------------------------------------------------------------------


def test_the_guard_of_whoever_commands_vents_and_takes_no_command(
    lab: tuple[VirtualLab, Path], commanded: GuardLink
) -> None:
    code, out, _ = vent(lab[1], "--json")
    said = json.loads(out)
    assert (code, said["vented"]) == (0, True)
    assert said["text"].startswith(f"vented by its guard, process {commanded.pid} (user ")
    assert vented(lab[0])
    goal = PressureCommand(np.full(3, 3e4), time.monotonic(), 1.0)
    with pytest.raises(GuardTripped, match="called 'stiffopt vent'"):
        commanded.pursue(goal)
    assert vented(lab[0])
    assert commanded.alive


def test_a_guard_that_hangs_is_ended_and_the_supply_vented_directly(
    lab: tuple[VirtualLab, Path], commanded: GuardLink
) -> None:
    """Its client is stopped too, as if the whole session were: nobody but the command helps."""
    pid = commanded.pid
    assert pid is not None
    watch = commanded._watch
    assert watch is not None
    watch.stop()
    os.kill(pid, signal.SIGSTOP)
    before = time.monotonic()
    code, out, err = vent(lab[1])
    assert time.monotonic() - before < BOUND
    assert (code, err) == (0, "")
    assert out.startswith("vented directly")
    assert vented(lab[0])
    wait_for(lambda: not commanded.alive)
    commanded.close()  # which vents once more
    assert vented(lab[0])


def test_the_client_of_a_guard_that_was_ended_is_told(
    lab: tuple[VirtualLab, Path], commanded: GuardLink
) -> None:
    pid = commanded.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    assert vent(lab[1])[0] == 0
    assert vented(lab[0])
    wait_for(lambda: not commanded.alive)
    with pytest.raises(DeviceError):
        commanded.read()
    assert vented(lab[0])


def test_a_simulated_rig_is_vented_by_its_guards(tmp_path: Path) -> None:
    description = load_rig_description(RIGS / "sim.yaml")
    path = tmp_path / "rig.yaml"
    save_file(path, "rig", description.model_copy(update={"name": f"arm of {tmp_path.name}"}))
    rig, link = guarded_rig(*load_rig(path))
    with rig:
        rig.supply.arm()
        rig.supply.command(PressureCommand(np.full(3, 3e4), rig.clock.now(), 60.0))
        wait_for(lambda: (rig.supply.commanded > 1e4).all())
        assert vent_rig(path).startswith(f"vented by its guard, process {link.pid} (user ")
        assert not rig.supply.commanded.any()
        assert not rig.supply.armed


# it cannot ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_a_file_that_is_wrong_is_bad_input(options: tuple[str, ...], tmp_path: Path) -> None:
    missing = tmp_path / "no-such-rig.yaml"
    code, out, err = vent(missing, *options)
    assert code == 2
    assert "no-such-rig.yaml" in err
    if options:
        said = json.loads(out)
        assert said["vented"] is False
        assert "no-such-rig.yaml" in said["text"]
    else:
        assert out == ""


def test_a_supply_that_does_not_answer_is_told_loudly(tmp_path: Path) -> None:
    path = unreachable(tmp_path)
    code, out, err = vent(path, "--json")
    assert code == 5
    said = json.loads(out)
    assert said["vented"] is False
    assert said["text"].startswith(UNDER_PRESSURE)
    assert UNDER_PRESSURE in err


def unreachable(tmp_path: Path) -> Path:
    """A rig file whose supply is a port where nobody listens."""
    description = load_rig_description(RIGS / "modbus-aurora.yaml")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    supply: Any = description.supply
    tcp = {"host": "127.0.0.1", "port": port}
    values = supply.model_dump(exclude_unset=True) | {"tcp": tcp}
    values.pop("serial", None)
    supply = type(supply).model_validate(values)
    path = tmp_path / "rig.yaml"
    save_file(path, "rig", description.model_copy(update={"supply": supply, "tracker": None}))
    return path


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Somebody else has claimed the supply of a rig."""
    claim = Claim(lambda: bare_supply(path).endpoints)
    claim.take()
    try:
        yield
    finally:
        claim.release()


def test_what_another_program_has_without_a_guard_is_told(
    lab: tuple[VirtualLab, Path],
) -> None:
    with held(lab[1]), pytest.raises(DeviceError, match="vented directly, but another program"):
        vent_rig(lab[1])


def test_who_is_no_guard_is_not_ended(
    lab: tuple[VirtualLab, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if the process of this test had taken the address of a guard."""
    killed: list[int] = []
    monkeypatch.setattr(vent_module.os, "kill", lambda pid, _: killed.append(pid))
    silent = Reply(SocketPeer(os.getpid(), 0), answered=False, error="no answer")
    monkeypatch.setattr(vent_module, "ask_to_vent", lambda *_: [silent])
    assert vent_rig(lab[1]) == "vented directly: no program commands this supply"
    assert not killed


def test_a_guard_that_cannot_be_ended_is_told(
    lab: tuple[VirtualLab, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vent_module, "_GONE", 0.05)
    monkeypatch.setattr(vent_module, "_command_line", lambda pid: GUARD)

    def forbidden(pid: int, number: int) -> None:
        raise PermissionError

    monkeypatch.setattr(vent_module.os, "kill", forbidden)
    silent = Reply(SocketPeer(7, 54321), answered=False, error="it hangs up")
    monkeypatch.setattr(vent_module, "ask_to_vent", lambda *_: [silent])
    assert vent_rig(lab[1]).startswith("vented directly")  # nobody has claimed it
    with held(lab[1]), pytest.raises(DeviceError, match=r"process 7 \(user 54321\): it hangs up"):
        vent_rig(lab[1])


@pytest.mark.parametrize("zombie", [False, True])
def test_a_guard_that_ended_while_it_was_asked_needs_not_be_ended(zombie: bool) -> None:
    """As where its client has found that it hangs, too."""
    process = subprocess.Popen([sys.executable, "-c", "pass"], stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.read()
    if zombie:
        wait_for(lambda: not Path(f"/proc/{process.pid}/cmdline").read_bytes())
    else:
        process.wait()
    assert vent_module._ended(SocketPeer(process.pid, os.getuid()))
    assert not vent_module._ended(SocketPeer(0, 0))  # of whom the kernel does not tell
    process.wait()
    process.stdout.close()


def test_simulated_guards_that_fail_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    good = Reply(SocketPeer(7, 54321), answered=True)
    bad = Reply(SocketPeer(8, 54321), answered=True, error="no answer")
    monkeypatch.setattr(vent_module, "ask_to_vent", lambda *_: [good, bad])
    said = r"process 8 \(user 54321\) says that it could not vent.*no answer$"
    with pytest.raises(DeviceError, match=said):
        vent_rig(RIGS / "sim.yaml")
