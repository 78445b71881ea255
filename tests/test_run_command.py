"""`stiffopt run`, as its users meet it: started, driven by a client, ended, killed."""

from __future__ import annotations

import io
import json
import os
import pty
import re
import shlex
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
import urllib.request
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rich.console import Console

from fake_loop import FakeLoop
from running import (
    COMMAND,
    ONE,
    RIGS,
    TWO,
    guard_of,
    patient_rig,
    running,
    virtual_lab,
    wait_for,
)
from stiffopt.cli import run_daemon
from stiffopt.cli.main import main
from stiffopt.cli.path_records import csv_text
from stiffopt.cli.run_daemon import Screen
from stiffopt.cli.run_display import Lines, LiveStatus, status
from stiffopt.control.controller import TipController
from stiffopt.control.state import Alarm, Event, HeldContact, Severity, State, Timing
from stiffopt.daemon import daemon as daemon_module
from stiffopt.daemon.client import Client
from stiffopt.daemon.daemon import TIMES
from stiffopt.daemon.run_log import read_run
from stiffopt.model.manipulator import load_robot
from stiffopt.paths.solution import PathSolution

pytestmark = pytest.mark.real_time

ROOT = Path(__file__).resolve().parent.parent
EDGES, COUNTS = (1e-4, 1e-3, 1e-2), (90, 8, 2, 0)


@pytest.fixture
def task(tmp_path: Path) -> str:
    path = tmp_path / "task.yaml"
    path.write_text(ONE, encoding="utf-8")
    return str(path)


# bad input ---------------------------------------------------------------------------------------


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Return what is said, on one line, of a run that must not even begin."""
    assert main(["run", *arguments]) == 2
    told = capsys.readouterr()
    assert "Traceback" not in told.err
    return " ".join(told.err.split())


def test_what_cannot_be_run_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = str(patient_rig(tmp_path))
    (tmp_path / "bad.yaml").write_text("format: stiffopt-rig/1\nrobot: stiff-flop-1\n")
    (tmp_path / "two.yaml").write_text(TWO)
    alone = ("--no-service", "--arm", "--task")
    assert "no such file" in refused(capsys, str(tmp_path / "none.yaml"))
    assert "supply" in refused(capsys, str(tmp_path / "bad.yaml"))
    assert "--task needs --arm" in refused(capsys, rig, "--task", task)
    assert "nobody else could" in refused(capsys, rig, "--no-service")
    assert "nobody else could" in refused(capsys, rig, "--no-service", "--arm")
    assert "--play needs --arm" in refused(capsys, rig, "--play", "m.csv")
    assert "no --task" in refused(capsys, rig, "--arm", "--play", "m.csv", "--task", task)
    assert "no such file" in refused(capsys, rig, *alone[:2], "--play", str(tmp_path / "none.csv"))
    assert "above 0 s" in refused(capsys, rig, "--duration", "0 s")
    assert "--duration" in refused(capsys, rig, "--duration", "soon")
    assert "not both" in refused(capsys, rig, "--plain", "--json-lines")
    # before anything starts: no line of a state
    assert main(["run", rig, *alone, str(tmp_path / "none.yaml")]) == 2
    told = capsys.readouterr()
    assert (told.out, "no such file" in told.err) == ("", True)
    other = refused(capsys, rig, *alone, str(tmp_path / "two.yaml"))
    assert "robot 'stiff-flop-2-hanging'; this rig has 'stiff-flop-1'" in other
    rib = str(ROOT / "problems" / "leaning_on_a_rib.yaml")
    other = refused(capsys, str(ROOT / "rig" / "brace.yaml"), *alone, rib)
    assert "brace.objects[0]: there is no object 'rib' in the scene; it has 'post'" in other
    monkeypatch.setenv("NOTIFY_SOCKET", "/nowhere")
    assert "must not arm by itself" in refused(capsys, rig, "--arm", "--task", task)


def test_a_port_in_use_is_told_and_the_others_token_stays(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    runs.mkdir()
    (runs / "sim.token").write_text("of the other daemon\n")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        error = refused(capsys, str(patient_rig(tmp_path, service={"port": port})))
    assert f"port {port}" in error
    assert "service.port" in error
    assert (runs / "sim.token").read_text() == "of the other daemon\n"


def test_without_the_extra_it_says_what_to_install(tmp_path: Path) -> None:
    script = f"import sys; sys.modules['fastapi'] = None; {COMMAND[2].removeprefix('import sys; ')}"
    done = subprocess.run(
        [sys.executable, "-c", script, "run", str(patient_rig(tmp_path))],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert "pip install 'stiffopt[daemon]'" in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr


def test_its_page_names_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    main(["run", "--help"])
    options = set(re.findall(r"^  (?:-\w, )?(--[\w-]+)", capsys.readouterr().out, re.M))
    assert {"--task", "--arm", "--duration", "--no-service"} <= options
    page = (ROOT / "docs" / "daemon.md").read_text(encoding="utf-8")
    assert not {option for option in options if f"`{option}" not in page}


# runs --------------------------------------------------------------------------------------------


def test_a_client_drives_it_and_a_closed_terminal_ends_it_vented(
    tmp_path: Path, compiled: Path
) -> None:
    with running("run", str(patient_rig(tmp_path))) as run:
        started = run.line("started")
        token = Path(started["token_file"])
        assert stat.S_IMODE(token.stat().st_mode) == 0o600
        with Client(started["url"], token, name="test") as client:
            assert client.state().state is State.INACTIVE
            client.take_control()
            arm(client)
            client.set_task(position=[-0.02, 0.005, None])
            settled = client.wait_until_settled(1e-3, timeout=100)
            assert settled.commanded.max() > 1e4
            client.release()
        begin = time.monotonic()
        assert run.end(signal.SIGHUP) == 0
        assert time.monotonic() - begin < 8
        last = [line for line in run.lines if line["kind"] == "state"][-1]
        assert last["state"] == "inactive"
        assert {"armed", "disarming", "vented"} <= {line["kind"] for line in run.lines}
        assert all({"time", "level", "kind", "text"} <= set(line) for line in run.lines)
        assert not token.exists()
        assert Path(started["recording"]).stat().st_size > 10_000


def arm(client: Client, timeout: float = 60.0) -> None:
    """Arm as soon as that is possible: the tracker must have been seen for a while."""
    end = time.monotonic() + timeout
    while True:
        try:
            return client.arm()
        except ValueError:
            if time.monotonic() > end:
                raise
        time.sleep(0.2)


def test_two_segments_hold_a_task_without_the_extra_and_for_a_time(
    tmp_path: Path, compiled: Path
) -> None:
    (tmp_path / "two.yaml").write_text(TWO, encoding="utf-8")
    missing = (
        "fastapi",
        "starlette",
        "uvicorn",
        "websockets",
        "httpx",
        "foxglove",
        "prometheus_client",
    )
    hidden = f"import sys; sys.modules.update(dict.fromkeys({missing})); "
    rig = str(patient_rig(tmp_path, "sim-two-segment"))
    task = str(tmp_path / "two.yaml")
    with running(
        "run", rig, "--task", task, "--arm", "--no-service", "--duration", "2 s", prefix=hidden
    ) as run:
        assert run.wait(120) == 0, run.err
        kinds = [line["kind"] for line in run.lines]
        assert "url" not in run.line("started")
    assert {"armed", "task", "vented", "log"} <= set(kinds)  # `log`: nothing is recorded


def test_a_motion_is_played_from_its_file(tmp_path: Path, compiled: Path) -> None:
    rig = str(patient_rig(tmp_path))
    arm = load_robot("stiff-flop-1")
    pressures = np.linspace([0.3e5, 0, 0], [0.8e5, 0.2e5, 0], 4)
    times = np.linspace(0, 1.5, 4)
    motion = PathSolution("solved", "", arm, times, pressures, arm.tip_pose(pressures))
    (tmp_path / "motion.csv").write_text(csv_text(motion))
    options = (
        "--play",
        str(tmp_path / "motion.csv"),
        "--arm",
        "--no-service",
        "--duration",
        "12 s",
    )
    with running("run", rig, *options) as run:
        assert run.wait(180) == 0, run.err
    (recording,) = (tmp_path / "runs").glob("*.mcap")
    recorded = read_run(recording)
    targets = recorded.target_position[np.isfinite(recorded.target_position).all(axis=1)]
    np.testing.assert_allclose(targets[-1], motion.tip_poses[-1, :3, 3], atol=1e-4)
    assert np.abs(recorded.commanded - pressures[-1]).max(axis=1).min() < 0.15e5


@pytest.mark.long
def test_the_commands_of_ten_minutes_that_need_real_time(
    tmp_path: Path, compiled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the page shows but does not run, with a rig that is patient with a busy machine."""
    page = (ROOT / "docs" / "ten-minutes.md").read_text(encoding="utf-8").replace("\\\n", "")
    shown = [shlex.split(line) for line in re.findall(r"^\$ stiffopt (.*?) *(?:#.*)?$", page, re.M)]
    holds, draws, plays = shown
    assert (holds[:2], draws[:2]) == (["run", "my-rig.yaml"], ["log", "plot"])
    monkeypatch.chdir(tmp_path)
    for line in re.findall(r"^stiffopt (?:init|path) .*$", page, re.M):
        assert main(shlex.split(line)[1:]) == 0, line
    robot = str(tmp_path / "my-arm.yaml")
    rig = patient_rig(tmp_path)
    content = yaml.safe_load(rig.read_text()) | {"robot": robot}
    content.pop("probe", None)
    Path("my-rig.yaml").write_text(yaml.safe_dump(content))
    for command in (holds, plays):
        with running(*command, "--no-service", "--duration", "15 s") as run:
            assert run.wait(400) == 0, run.err
    for recording in (tmp_path / "runs").glob("*.mcap"):
        assert main([*draws[:2], str(recording)]) == 0
    assert len([*(tmp_path / "runs").glob("*.png")]) == 2


def test_a_second_ctrl_c_vents_at_once(tmp_path: Path, compiled: Path, task: str) -> None:
    rig = str(patient_rig(tmp_path, safety={"ramp_time": "10 s"}))
    with running("run", rig, "--task", task, "--arm", "--plain") as run:
        wait_for(lambda: any("[task]" in line for line in run.out), 60)
        run.popen.send_signal(signal.SIGINT)
        wait_for(lambda: any("[disarming]" in line for line in run.out))
        begin = time.monotonic()
        assert run.end(signal.SIGINT) == 0
        assert time.monotonic() - begin < 5  # not 10
        assert any("Ctrl-C, twice" in line for line in run.out)


def test_a_killed_guard_is_a_fault_and_the_exit_code_says_so(
    tmp_path: Path, compiled: Path, task: str
) -> None:
    rig = str(patient_rig(tmp_path))
    with running("run", rig, "--task", task, "--arm", "--no-service") as run:
        run.line("task")
        os.kill(guard_of(run.popen.pid), signal.SIGKILL)
        assert run.wait(30) == 5
        assert any(line.get("state") == "fault" for line in run.lines)
        assert "ended in the state fault" in " ".join(" ".join(run.err).split())


def test_the_lab_is_driven_over_its_protocols_and_vented_whatever_happens(
    tmp_path: Path, compiled: Path, task: str
) -> None:
    """Modbus and Aurora, a lab process and a run process: SIGTERM ramps down, SIGKILL vents."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    shipped = patient_rig(
        tmp_path,
        "virtual-lab",
        supply={"timeout": "3 s", "watchdog": {"address": 0x1120, "timeout": "10 s"}},
    )
    text = shipped.read_text().replace("port: 0\n  scale", f"port: {port}\n  scale")
    assert str(port) in text
    shipped.write_text(text)
    out = tmp_path / "lab.yaml"
    with virtual_lab(shipped, out) as (_, pressures):
        with running("run", str(out)) as run:
            started = run.line("started")
            with Client(started["url"], started["token_file"]) as client:
                client.take_control()
                arm(client)
                client.set_task(position=[-0.02, 0.005, None])
                client.wait_until_settled(1e-3, timeout=100)
                client.release()
            assert pressures().max() > 0.1
            assert run.end(signal.SIGTERM) == 0
            wait_for(lambda: pressures().max() < 0.02)
        with running("run", str(out), "--task", task, "--arm") as run:
            run.line("task")
            wait_for(lambda: pressures().max() > 0.2)
            run.popen.kill()
            run.wait()
            wait_for(lambda: pressures().max() < 0.05, 8)  # before its watchdog does it
            told = [json.loads(line) for line in run.err]  # also what the guard says
            assert [line["kind"] for line in told] == ["guard"]
            assert "the process that commands has ended" in told[0]["text"]


# the end, whatever hangs --------------------------------------------------------------------------


def test_a_terminal_that_takes_nothing_does_not_keep_it_from_ending(
    tmp_path: Path, compiled: Path
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    rig = str(patient_rig(tmp_path, service={"port": port}))
    master, slave = pty.openpty()  # nobody reads what is written there
    os.set_blocking(slave, False)
    with suppress(BlockingIOError):
        while True:
            os.write(slave, b"x" * 100)
    os.set_blocking(slave, True)
    run = subprocess.Popen([*COMMAND, "run", rig], stdin=slave, stdout=slave, stderr=slave)
    try:

        def inactive() -> bool:
            with (
                suppress(OSError),
                urllib.request.urlopen(f"http://127.0.0.1:{port}/v1/state") as a,
            ):
                return bool(json.load(a)["state"] == "inactive")
            return False

        wait_for(inactive, 60)
        time.sleep(0.5)
        run.send_signal(signal.SIGTERM)
        assert run.wait(1 + TIMES.stop) == 0
    finally:
        run.kill()
        run.wait()
        os.close(master)
        os.close(slave)


def test_the_screen_shows_in_order_and_is_not_waited_for_if_it_hangs() -> None:
    screen, seen = Screen(), list[int]()
    for k in range(3):
        screen.post(lambda k=k: seen.append(k))  # type: ignore[misc]
    screen.post(lambda: 1 / 0)
    screen.post(lambda: seen.append(3))
    assert screen.finish(10)
    assert seen == [0, 1, 2, 3]
    hangs, stuck = threading.Event(), Screen()
    stuck.post(lambda: hangs.wait(20))
    stuck.post(lambda: seen.append(4))
    begin = time.monotonic()
    assert stuck.is_behind
    assert not stuck.finish(0.1)
    assert time.monotonic() - begin < 5
    hangs.set()


ENDS = """
import sys, threading, time
from stiffopt.cli.run_daemon import Backstop, _Signals
with _Signals().handled() as signals, Backstop(0.5, lambda: signals.count > 0):
    print("ready", flush=True)
    threading.Thread(target=time.sleep, args=(60,)).start()  # keeps an interpreter from ending
    if sys.argv[1] == "hangs":
        while True:
            time.sleep(1)
"""


def test_the_backstop_ends_a_process_that_hangs() -> None:
    run = subprocess.Popen(
        [sys.executable, "-c", ENDS, "hangs"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    with run:
        try:
            assert run.stdout is not None
            assert run.stdout.readline() == b"ready\n"
            time.sleep(1)  # without a signal it ends nothing
            assert run.poll() is None
            run.send_signal(signal.SIGHUP)
            assert run.wait(10) == 5
            assert run.stderr is not None
            assert b"did not end in time" in run.stderr.read()
        finally:
            run.kill()


def test_what_hangs_when_all_is_over_is_left(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A daemon of which a part hangs: the process is ended with the code that it would have had."""
    codes: list[int] = []
    monkeypatch.setattr(run_daemon, "leave", codes.append)
    rig = str(
        patient_rig(
            tmp_path,
            "modbus-aurora",
            supply={"tcp": {"host": "127.0.0.1", "port": 1}},
            tracker={"port": str(tmp_path / "no-aurora")},
        )
    )
    monkeypatch.setattr(daemon_module, "TIMES", replace(TIMES, rest=0.2))
    hangs = threading.Event()
    end = TipController.close

    def hang(controller: TipController) -> None:
        hangs.wait(20)
        end(controller)

    monkeypatch.setattr(TipController, "close", hang)
    try:
        assert main(["run", rig]) == 2
        assert codes == [2]
    finally:
        hangs.set()


# what is shown -----------------------------------------------------------------------------------


class Places:
    url = "http://127.0.0.1:8470"
    token_file = Path("runs/sim.token")
    recording = "runs/sim.mcap"
    foxglove_port = 8765


def shown(width: int = 100, **state: Any) -> str:
    loop = FakeLoop()
    now = replace(
        loop.now,
        state=State.HOLDING,
        reason="the tracker does not see the tip",
        commanded=np.linspace(0, 1.5e5, 6),
        saturated=np.arange(6) == 5,
        target_position=np.array([0.0, 0.011, np.nan]),
        position_error=1.25e-3,
        stiffness=1.2,
        best_stiffness=1.5,
        wrench=np.arange(6) * 1e-3,
        alarms=(Alarm("tracker-missing", "the tracker [bold]does not see the tip", 1.0),),
        timing=Timing(100, 3, 2e-3, EDGES, COUNTS),
        **state,
    )
    events = [Event(1.0, "armed", "armed"), Event(2.0, "leak", "channel 2 leaks", Severity.ERROR)]
    console = Console(file=io.StringIO(), width=width, markup=False)
    names = [f"channel {k + 1}" for k in range(6)]
    console.print(status(now, "my-rig", names, 99.9, events, Places()))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_the_status_says_how_things_stand() -> None:
    text = shown()
    for words in (
        "HOLDING  my-rig  the tracker does not see the tip",
        "target  (0.0, 11.0, free) mm",
        "1.25 mm",
        "channel 6",
        "saturated",
        "not measured",
        "1.2 N/m of 1.5 (80%)",
        "99.9 Hz",
        "3 overruns of 100",
        "99 % begin within 10 ms",
        "the tracker [bold]does not see the tip [tracker-missing]",
        "channel 2 leaks [leak]",
        "http://127.0.0.1:8470, token in runs/sim.token",
        "runs/sim.mcap",
    ):
        assert words in text, f"{words!r} is not in\n{text}"
    bars = [line.count("█") for line in text.splitlines() if "bar" in line]
    assert len(bars) == 6
    assert max(len(line) for line in shown(60).splitlines()) <= 60


def test_the_status_shows_the_contacts_of_a_brace() -> None:
    held = HeldContact("post", 0.1009, "held", 0.2134, 0.0305)
    unsure = HeldContact("rib [red]", 0.15, "uncertain", 0.004, 0.02)
    text = shown(brace="held", leans_on=(held, unsure))
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert "brace held" in lines
    assert "contact 'post' at 101 mm: held, 213 mN (deviation 30 mN)" in lines
    assert "contact 'rib [red]' at 150 mm: uncertain, 4 mN (deviation 20 mN)" in lines
    text = shown(brace="releasing", leans_on=(HeldContact("post", 0.1, "lost"),))
    assert "'post' at 100 mm: lost\n" in "\n".join(map(str.rstrip, text.splitlines()))
    assert "contact" not in shown()
    assert "brace" not in shown()


def test_a_terminal_that_is_gone_does_no_harm() -> None:
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(5, "Input/output error")

    loop = FakeLoop()
    names = [f"channel {k + 1}" for k in range(6)]
    live = LiveStatus("rig", names, console=Console(file=Gone(), force_terminal=True))
    live.say("starting", "connecting")
    live.begin(Places())
    live.update(loop.now, loop.events.all)
    live.end()


def test_lines_are_left_out_where_nobody_takes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    receive, send = os.pipe()
    monkeypatch.setattr(sys, "stdout", os.fdopen(send, "w"))
    lines, loop = Lines(as_json=True, now=lambda: 12.5), FakeLoop()
    for _ in range(2000):  # far more than a pipe holds
        lines.say("x", "y" * 1000)
    assert len(os.read(receive, 10_000)) > 1000
    os.close(receive)
    lines.update(loop.now, loop.events.all)  # nobody is there any more
    sys.stdout.close()
    lines.say("x", "closed")


def test_every_shipped_simulated_rig_is_run_somewhere_here() -> None:
    text = Path(__file__).read_text(encoding="utf-8")
    for path in RIGS.glob("sim*.yaml"):
        assert path.stem == "sim" or f'"{path.stem}"' in text
