"""The daemon in one piece: what it starts, what it looks after, and how it ends."""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import re
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from conftest import use_compiler
from examples import blocks
from fake_loop import FakeLoop, ManualClock
from running import patient_rig, wait_for
from stiffopt.control.lifecycle import EventBuffer
from stiffopt.control.state import Severity, Snapshot, State
from stiffopt.daemon import daemon as daemon_module
from stiffopt.daemon import secret as secret_module
from stiffopt.daemon.address import is_loopback
from stiffopt.daemon.client import Client
from stiffopt.daemon.daemon import TIMES, Daemon
from stiffopt.daemon.keeper import Keeper, LogEvents, ServiceManager
from stiffopt.daemon.secret import Secret, check_exposure
from stiffopt.daemon.server import MAX_CONNECTIONS
from stiffopt.errors import CommandError, DeviceError, FileError, InputError
from stiffopt.rig.settings import Safety, ServiceSettings

pytestmark = pytest.mark.real_time

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def daemon(
    tmp_path_factory: pytest.TempPathFactory, code_cache: Path
) -> Iterator[tuple[Daemon, Client]]:
    """A running daemon of a simulated arm without inertia, and a client that has control."""
    with pytest.MonkeyPatch.context() as patch:
        use_compiler(patch, code_cache)
        folder = tmp_path_factory.mktemp("daemon")
        rig = patient_rig(folder, plant={"dynamics": "quasi-static"})
        with Daemon(rig) as made:
            assert made.url is not None
            with Client(made.url, made.token, name="test") as client:
                client.take_control()
                yield made, client
        assert made.trouble == ""
        assert made.failure is None
        assert made.loop.snapshot().state in (State.INACTIVE, State.FAULT)
        assert made.stop() is made.loop.snapshot().state  # again: nothing happens


def armed(client: Client) -> None:
    """Arm the arm, wherever it is in its life."""
    with suppress(InputError):
        client.vent()
    with suppress(InputError):
        client.reset()

    def done() -> bool:
        try:
            client.arm()
        except InputError:
            time.sleep(0.2)  # each attempt checks everything; the tracker must see the tip between
            return False
        return True

    wait_for(done)


def test_it_settles_where_a_client_says_and_tells_of_it(daemon: tuple[Daemon, Client]) -> None:
    made, client = daemon
    armed(client)
    client.set_task(position=[-0.02, 0.005, None])
    settled = client.wait_until_settled(1e-3, timeout=30)
    assert settled.state is State.ACTIVE
    truth = made.link.truth()[:3, 3]
    assert abs(truth[:2] - [-0.02, 0.005]).max() < 2e-3
    with urllib.request.urlopen(f"{made.url}/metrics") as answer:
        assert b'stiffopt_state{rig="sim",state="active"} 1.0' in answer.read()
    assert made.foxglove_port
    (served,) = [e for e in made.loop.events.since(0)[0] if e.kind == "foxglove"]
    assert served.severity is Severity.WARNING
    assert f"ws://127.0.0.1:{made.foxglove_port}" in served.text
    assert "web page" in served.text
    assert made.recording is not None
    wait_for(lambda: os.path.getsize(made.recording or "") > 5_000)
    told = [event.text for event in made.loop.events.since(0)[0] if event.kind == "real-time"]
    assert [text.split(":")[0] for text in told] == ["control", "guard"]


def test_the_example_for_planners_streams_a_circle(
    daemon: tuple[Daemon, Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The code of docs/daemon.md, as it stands there but for the address."""
    made, client = daemon
    armed(client)
    client.disarm()
    wait_for(lambda: made.loop.snapshot().state is State.INACTIVE)
    time.sleep(1.0)  # the example arms: the tip must have been seen for a moment
    (code,) = [b for b in blocks(_page(), "python") if "stream(" in b]
    address = re.search(r"http://127\.0\.0\.1:8470", code)
    assert address, "the example names the address"
    client.release()
    monkeypatch.setenv("STIFFOPT_TOKEN", made.token)
    seen: list[Any] = []
    made.loop.listen(lambda now: seen.append(now.target_position))
    try:
        exec(compile(code.replace(address[0], str(made.url)), "daemon.md", "exec"), {})
    finally:
        made.loop._listeners.clear()
        made.loop.listen(made._control.ticked)
        client.take_control()
    xy = {tuple(p[:2].round(4)) for p in seen if p is not None}
    assert len(xy) > 40  # it went round
    wait_for(lambda: made.loop.snapshot().state is State.INACTIVE)


def _page() -> str:
    return (ROOT / "docs" / "daemon.md").read_text(encoding="utf-8")


def test_what_listens_to_ticks_cannot_hurt_them(daemon: tuple[Daemon, Client]) -> None:
    made, _ = daemon
    before = made.loop.snapshot().timing.ticks

    def fail(now: Snapshot) -> None:
        raise ZeroDivisionError("no luck")

    made.loop.listen(fail)
    try:
        wait_for(lambda: any(a.kind == "listener" for a in made.loop.snapshot().alarms))
        wait_for(lambda: made.loop.snapshot().timing.ticks > before + 20)
        assert not made.ended
    finally:
        made.loop._listeners.remove(fail)
        made.loop.clear_alarm("listener")


def test_a_hanging_control_thread_does_not_keep_it_from_venting(
    daemon: tuple[Daemon, Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, _ = daemon
    hangs, vented = threading.Event(), []
    monkeypatch.setattr(made.loop, "vent", lambda reason: hangs.wait(20))
    monkeypatch.setattr(made.link, "vent", lambda: vented.append(True))
    made.vent(patience=0.05)
    hangs.set()
    assert vented


def test_another_guard_replaces_one_that_was_killed(daemon: tuple[Daemon, Client]) -> None:
    made, client = daemon
    armed(client)
    first = made.link.pid
    assert first is not None
    os.kill(first, signal.SIGKILL)
    wait_for(lambda: client.state().state is State.FAULT)
    wait_for(lambda: made.link.alive and made.link.pid != first, 60)

    def reset() -> bool:
        try:
            client.reset()
        except InputError:
            return False
        return True

    wait_for(reset)
    wait_for(lambda: not any(a.kind == "guard" for a in client.state().alarms))
    armed(client)
    assert client.state().state is State.ACTIVE
    client.disarm()


def test_a_crowd_that_connects_and_says_nothing_does_not_touch_control(
    daemon: tuple[Daemon, Client],
) -> None:
    made, client = daemon
    armed(client)
    port = int(str(made.url).rpartition(":")[2])
    before, files = made.loop.snapshot(), len(os.listdir("/proc/self/fd"))
    with ExitStack() as crowd:
        for _ in range(200):
            crowd.enter_context(socket.create_connection(("127.0.0.1", port), 10))
        wait_for(lambda: made.loop.snapshot().timing.ticks > before.timing.ticks + 100)
        assert client.state().state is before.state is State.ACTIVE
        wait_for(lambda: len(os.listdir("/proc/self/fd")) < files + 200 + MAX_CONNECTIONS + 10)
        assert not made.ended
    wait_for(lambda: len(os.listdir("/proc/self/fd")) < files + 10)


def test_it_is_started_once(daemon: tuple[Daemon, Client]) -> None:
    with pytest.raises(InputError, match="started only once"):
        daemon[0].start()


def test_a_rig_that_does_not_answer_is_told_and_nothing_stays(
    tmp_path: Path, compiled: Path
) -> None:
    """Nobody listens where the Modbus coupler should be."""
    rig = patient_rig(
        tmp_path,
        "modbus-aurora",
        supply={"tcp": {"host": "127.0.0.1", "port": 1}},
        tracker={"port": str(tmp_path / "no-aurora")},
    )
    before = {thread.ident for thread in threading.enumerate()}
    made = Daemon(rig)
    with pytest.raises(CommandError, match="devices: ") as error:
        made.start()
    assert "no-aurora" in str(error.value) or "127.0.0.1" in str(error.value)
    assert made.ended
    assert made.token_file is not None
    assert not made.token_file.exists()
    wait_for(lambda: {thread.ident for thread in threading.enumerate()} <= before)


# the keeper --------------------------------------------------------------------------------------


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


# the unit ----------------------------------------------------------------------------------------


def test_the_unit_restarts_vented_and_lets_the_pressures_down() -> None:
    """What in the unit must agree with the code."""
    lines = (ROOT / "rig" / "stiffopt-daemon.service").read_text(encoding="utf-8").splitlines()
    pairs = [line.split("=", 1) for line in lines if "=" in line and not line.startswith("#")]
    unit = dict(pairs)
    assert " run " in unit["ExecStart"]
    assert "--arm" not in unit["ExecStart"]  # it would be refused, too
    assert unit["Type"] == "notify"
    assert unit["KillMode"] == "process"  # the guard is neither signalled nor killed
    assert unit["ExecStopPost"] == "-/opt/stiffopt/bin/stiffopt vent /etc/stiffopt/rig.yaml"
    assert "15 s" in _page()
    assert TIMES.stop == 15
    longest = next(m.le for m in Safety.model_fields["ramp_time"].metadata if hasattr(m, "le"))
    assert float(unit["TimeoutStopSec"]) > longest + TIMES.stop
    assert unit["Restart"] == "on-failure"
    assert "5" not in unit["RestartPreventExitStatus"].split()
    assert "RestrictRealtime" not in unit


# what is logged ----------------------------------------------------------------------------------


def test_what_libraries_log_becomes_events_and_never_a_flood() -> None:
    events, now = EventBuffer(), [0.0]
    loop: Any = SimpleNamespace(events=events, rig=SimpleNamespace(clock=ManualClock()))
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
    assert re.fullmatch(r"it failed \(KeyError: 'oh', test_daemon\.py:\d+\)", told[3].text)
    assert (told[3].severity, told[3].time) == (Severity.ERROR, 100.0)
    assert (told[4].severity, len(told[4].text)) == (Severity.WARNING, 300)
    assert len(told) == 5


def test_what_cannot_be_put_into_words_does_not_hurt_who_logs_it() -> None:
    events = EventBuffer()
    loop: Any = SimpleNamespace(events=events, rig=SimpleNamespace(clock=ManualClock()))

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


# the token ---------------------------------------------------------------------------------------


def test_a_drawn_token_is_for_this_user_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STIFFOPT_TOKEN", raising=False)
    (tmp_path / "runs").mkdir()
    path = tmp_path / "runs" / "my-rig.token"
    path.write_text("old")
    path.chmod(0o666)
    secret = Secret(ServiceSettings(), tmp_path / "runs", "my-rig")
    secret.write()
    assert secret.path == path
    assert path.read_text().strip() == secret.token
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert sorted(os.listdir(path.parent)) == [".my-rig.token.lock", path.name]
    other = Secret(ServiceSettings(), tmp_path / "runs", "my-rig")
    assert other.token != secret.token
    other.remove()  # not its own
    assert path.exists()
    secret.remove()
    assert os.listdir(path.parent) == [".my-rig.token.lock"]


def test_a_second_daemon_leaves_the_token_of_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STIFFOPT_TOKEN", raising=False)
    first, second = (Secret(ServiceSettings(), tmp_path, "my-rig") for _ in range(2))
    first.write()
    assert first.path is not None
    with pytest.raises(FileError, match=r"another daemon .* log\.folder or service\.token_file"):
        second.write()
    second.remove()
    assert first.path.read_text().strip() == first.token
    elsewhere = Secret(ServiceSettings(token_file=str(tmp_path / "b.token")), tmp_path, "my-rig")
    elsewhere.write()
    elsewhere.remove()
    first.remove()
    second.write()
    assert first.path.read_text().strip() == second.token
    second.remove()


def test_whoever_opened_the_lock_before_it_was_released_keeps_others_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STIFFOPT_TOKEN", raising=False)
    first, third = (Secret(ServiceSettings(), tmp_path, "my-rig") for _ in range(2))
    first.write()
    with (tmp_path / ".my-rig.token.lock").open("r+") as second:  # as one does that starts just now
        first.remove()
        fcntl.flock(second, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with pytest.raises(FileError, match="another daemon"):
            third.write()
    third.write()
    third.remove()


def test_a_lock_of_another_user_is_named_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STIFFOPT_TOKEN", raising=False)
    lock, opened = tmp_path / ".my-rig.token.lock", os.open

    def denied(path: Any, *rest: Any) -> int:  # as for another user: root may open everything
        if Path(path) == lock:
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(path, *rest)

    monkeypatch.setattr(os, "open", denied)
    secret = Secret(ServiceSettings(), tmp_path, "my-rig")
    with pytest.raises(FileError, match=r"token cannot be kept there: permission denied"):
        secret.write()  # a folder in which nothing can be written
    lock.write_text("")
    with pytest.raises(FileError, match=r"another user, .* remove this file, .*token_file") as told:
        secret.write()
    assert told.value.path == str(lock)


def test_the_token_of_a_killed_daemon_is_in_nobody_s_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STIFFOPT_TOKEN", raising=False)
    code = (
        "import os, sys; from stiffopt.daemon.secret import Secret\n"
        "from stiffopt.rig.settings import ServiceSettings\n"
        "secret = Secret(ServiceSettings(), sys.argv[1], 'my-rig'); secret.write(); os._exit(9)"
    )
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)]).returncode == 9
    assert (tmp_path / "my-rig.token").exists()
    secret = Secret(ServiceSettings(), tmp_path, "my-rig")
    secret.write()
    assert (tmp_path / "my-rig.token").read_text().strip() == secret.token
    secret.remove()


def test_where_nothing_can_be_locked_the_token_is_written_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.delenv("STIFFOPT_TOKEN", raising=False)
    monkeypatch.setattr(fcntl, "flock", fail)
    secret = Secret(ServiceSettings(), tmp_path, "my-rig")
    secret.write()
    assert secret.path is not None
    assert secret.path.read_text().strip() == secret.token
    secret.remove()


def test_a_token_may_come_from_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MY_TOKEN", "abc")
    secret = Secret(ServiceSettings(token="MY_TOKEN"), tmp_path, "rig")
    secret.write()
    assert (secret.token, secret.path) == ("abc", None)
    assert not os.listdir(tmp_path)


def test_a_token_that_cannot_be_kept_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    settings = ServiceSettings(token="NOWHERE_SET", token_file=str(tmp_path / "file" / "token"))
    with pytest.raises(FileError, match=r"service\.token_file"):
        Secret(settings, tmp_path, "rig").write()


def test_a_lock_or_token_that_others_put_there_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STIFFOPT_TOKEN", raising=False)
    victim = tmp_path / "victim"
    victim.write_text("precious")
    for name in (".my-rig.token.lock", "my-rig.token"):
        place = tmp_path / name
        place.symlink_to(victim)
        with pytest.raises(FileError, match="is a symbolic link") as told:
            _write(tmp_path)
        assert told.value.path == str(place)
        place.unlink()
        place.symlink_to(tmp_path / "new")
        with pytest.raises(FileError, match="is a symbolic link"):
            _write(tmp_path)
        place.unlink()
        os.mkfifo(place)
        with pytest.raises(FileError, match="is no regular file"):
            _write(tmp_path)
        place.unlink()
    assert victim.read_text() == "precious"
    assert not (tmp_path / "new").exists()
    _write(tmp_path)


def test_a_link_that_comes_while_the_lock_is_opened_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STIFFOPT_TOKEN", raising=False)
    monkeypatch.setattr(secret_module, "_check_mine", lambda *_: None)
    (tmp_path / ".my-rig.token.lock").symlink_to(tmp_path / "new")
    with pytest.raises(FileError, match="symbolic links"):
        _write(tmp_path)
    assert not (tmp_path / "new").exists()


def test_files_of_other_users_are_refused_and_so_are_their_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STIFFOPT_TOKEN", raising=False)
    folder = tmp_path / "runs"
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(FileError, match="writable for all"):
        _write(folder)
    folder.chmod(0o1777)  # as /tmp: others cannot exchange what is mine
    _write(folder)
    (folder / "my-rig.token").write_text("")
    me = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: me + 1)
    with pytest.raises(FileError, match="belongs to another user") as told:
        _write(folder)
    assert told.value.path in (str(folder), str(folder / ".my-rig.token.lock"))


def test_folders_that_are_made_are_for_this_user_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STIFFOPT_TOKEN", raising=False)
    _write(tmp_path / "a" / "b")
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("a", "a/b")]
    assert modes == [0o700, 0o700]


def _write(folder: Path) -> None:
    secret = Secret(ServiceSettings(), folder, "my-rig")
    try:
        secret.write()
    finally:
        secret.remove()


# the end, whatever hangs --------------------------------------------------------------------------


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


# who can reach it --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        *((h, True) for h in ("127.0.0.1", "127.9.9.9", "::1", "localhost")),
        *((h, False) for h in ("0.0.0.0", "::", "192.0.2.1", "no-such-host.invalid")),
    ],
)
def test_loopback_is_told_from_what_others_can_reach(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback


def test_what_listens_beyond_this_machine_is_told_and_needs_a_long_token() -> None:
    short, long = "x" * 15, "x" * 16
    with pytest.raises(InputError, match=r"15 characters, too few .* at least 16, leave the envir"):
        check_exposure("0.0.0.0", short, given=True)
    for token, given in ((long, True), (short, False)):
        ((kind, text),) = check_exposure("0.0.0.0", token, given=given)
        assert kind == "exposed"
        assert "unencrypted" in text
    ((kind, _),) = check_exposure("127.0.0.1", "x", given=True)
    assert kind == "token"
    assert check_exposure("127.0.0.1", long, given=True) == []
    assert check_exposure("127.0.0.1", "x", given=False) == []


def _starting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, token: str, service: dict[str, Any]
) -> Daemon:
    """Start a daemon that gets no further than to its devices, of which none is there."""
    monkeypatch.setenv("STIFFOPT_TOKEN", token)
    rig = patient_rig(
        tmp_path,
        "modbus-aurora",
        supply={"tcp": {"host": "127.0.0.1", "port": 1}},
        tracker={"port": str(tmp_path / "no-aurora")},
        service=service,
    )
    made = Daemon(rig)
    with pytest.raises(InputError) as error:
        made.start()
    made.error = str(error.value)  # type: ignore[attr-defined]
    return made


def _warnings(made: Daemon) -> dict[str, str]:
    events, _ = made.loop.events.since(0)
    return {e.kind: e.text for e in events if e.severity is Severity.WARNING}


def test_a_daemon_that_others_can_reach_warns_or_does_not_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compiled: Path
) -> None:
    made = _starting(tmp_path, monkeypatch, "x", {"host": "0.0.0.0"})
    assert "too few for the host 0.0.0.0" in made.error  # type: ignore[attr-defined]
    made = _starting(tmp_path, monkeypatch, "x" * 20, {"host": "0.0.0.0"})
    assert "devices: " in made.error  # type: ignore[attr-defined]
    assert "beyond this machine and unencrypted" in _warnings(made)["exposed"]
    made = _starting(tmp_path, monkeypatch, "x", {"host": "127.0.0.1"})
    assert "shorter than 16 characters" in _warnings(made)["token"]


def test_bounded_stop(daemon: tuple[Daemon, Client]) -> None:
    """The last test of the running one: from under pressure to vented in bounded time."""
    made, client = daemon
    armed(client)
    client.set_task(position=[-0.02, 0.005, None])
    wait_for(lambda: client.state().commanded.max() > 1e4)
    client.release()
    begin = time.monotonic()
    assert made.stop() is State.INACTIVE
    assert time.monotonic() - begin < made.description.safety.ramp_time + 6
    assert made.link.pid is None
    events, _ = made.loop.events.since(0)
    assert events[-1].kind == "vented"
