"""The daemon in one piece: what it starts, what it looks after, and who can reach it."""

from __future__ import annotations

import os
import re
import signal
import socket
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest

from conftest import use_compiler
from examples import blocks
from running import patient_rig, wait_for
from stiffopt.control.state import Severity, Snapshot, State
from stiffopt.daemon.address import is_loopback
from stiffopt.daemon.client import Client
from stiffopt.daemon.daemon import TIMES, Daemon
from stiffopt.daemon.secret import check_exposure
from stiffopt.daemon.server import MAX_CONNECTIONS
from stiffopt.errors import CommandError, InputError
from stiffopt.rig.settings import Safety

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


def _of_absent_devices(folder: Path, **more: Any) -> Path:
    """Return a rig file whose devices are not there."""
    return patient_rig(
        folder,
        "modbus-aurora",
        supply={"tcp": {"host": "127.0.0.1", "port": 1}},
        tracker={"port": str(folder / "no-aurora")},
        **more,
    )


def succeeds(do: Callable[[], None], pause: float = 0.0) -> bool:
    """Return whether a request is accepted; pause for some s after a refusal."""
    try:
        do()
    except InputError:
        time.sleep(pause)
        return False
    return True


def armed(client: Client) -> None:
    """Arm the arm, wherever it is in its life."""
    with suppress(InputError):
        client.vent()
    with suppress(InputError):
        client.reset()

    # each attempt checks everything; the tracker must see the tip between
    wait_for(lambda: succeeds(client.arm, 0.2))


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

    wait_for(lambda: succeeds(client.reset))
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
    rig = _of_absent_devices(tmp_path)
    before = {thread.ident for thread in threading.enumerate()}
    made = Daemon(rig)
    with pytest.raises(CommandError, match="devices: ") as error:
        made.start()
    assert "no-aurora" in str(error.value) or "127.0.0.1" in str(error.value)
    assert made.ended
    assert made.token_file is not None
    assert not made.token_file.exists()
    wait_for(lambda: {thread.ident for thread in threading.enumerate()} <= before)


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
    made = Daemon(_of_absent_devices(tmp_path, service=service))
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
