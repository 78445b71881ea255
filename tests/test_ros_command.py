"""`stiffopt ros` as a process, with a peer on the wire: it starts the daemon, or finds it."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fake_loop import FakeLoop
from ros_peer import Peer, own_domain
from running import patient_rig, running
from stiffopt.cli.main import main
from stiffopt.daemon.server import Server
from stiffopt.daemon.service import create_app
from stiffopt.model.robot_files import load_description
from stiffopt.ros import messages as m

pytestmark = pytest.mark.real_time

PLANNER = Path(__file__).resolve().parent.parent / "examples/ros_planner.py"
TOKEN = "a-secret-of-the-tests"
COMMANDS = {"commands": True, "interface": "lo"}


@pytest.fixture
def peer() -> Iterator[Peer]:
    peer = Peer(own_domain(), "/lab/arm", alone=True)
    yield peer
    peer.close()


def ros(rig: Path, *more: str) -> list[str]:
    where = ["--domain", str(own_domain()), "--namespace", "lab", "--node", "arm"]
    return ["ros", str(rig), *where, *more]


def test_it_starts_the_daemon_takes_a_planner_and_ends_vented(
    tmp_path: Path, compiled: Path, peer: Peer
) -> None:
    rig = patient_rig(tmp_path, ros=COMMANDS)
    with running(*ros(rig, "--remap", "~/markers:=/markers")) as process:
        process.line("started")
        peer.reader("/markers", m.MarkerArray).wait()
        state = peer.reader("~/state", m.String)
        state.wait(lambda s: s.data == "inactive")
        pressure = peer.reader("~/pressure", m.JointState)
        plan = [sys.executable, str(PLANNER), "stiff-flop-1", "-20, 5, 95", "10, 15, 93"]
        where = ["--node", "/lab/arm", "--domain", str(own_domain())]
        planner = subprocess.run(
            [*plan, *where], capture_output=True, text=True, timeout=120, check=False
        )
        assert "there\n" in planner.stdout, planner.stderr
        state.wait(lambda s: s.data.startswith("holding: the writer that had control is gone"))
        pressure.take()
        assert max(pressure.all[-1].position) > 1e4
        assert process.end(signal.SIGTERM, 60) == 0
        pressure.wait(lambda p: max(p.position) < 1e4)  # it is shown while it is let down


def test_it_finds_a_daemon_and_leaves_it_running(
    tmp_path: Path, peer: Peer, capfd: pytest.CaptureFixture[str]
) -> None:
    loop, robot = FakeLoop(), load_description("stiff-flop-2-hanging")
    app = create_app(loop, robot=robot, token=TOKEN, heartbeat=1.0, patience=20.0)
    server = Server(app)
    server.start()
    rig = patient_rig(tmp_path, "sim-two-segment", service={"port": server.port})
    token = tmp_path / "token"
    token.write_text(TOKEN, encoding="ascii")
    try:
        assert main(ros(rig)) == 2
        assert "without it not even venting is possible" in capfd.readouterr().err
        with running(*ros(rig, "--token-file", str(token))) as process:
            vent = peer.client("~/vent", m.TriggerRequest)
            assert vent(m.TriggerRequest()).success
            assert loop.names == ["vent"]
            assert process.end() == 0
            assert "takes no command but to vent" in " ".join(" ".join(process.err).split())
        with running(*ros(rig, "--token-file", str(token))) as process:
            peer.reader("~/state", m.String).wait()
            server.stop()
            assert process.wait() == 2
            told = " ".join(process.err)
            assert re.search("the stream has ended|cannot be reached", told), told
    finally:
        server.stop()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--domain", "233"], "--domain"),
        (["--distro", "foxy"], "--distro"),
        (["--node", "my-arm"], "no name of ROS 2"),
        (["--remap", "tip"], "is no remapping"),
        (["--remap", "~/top:=/a"], "there is no topic or service '/stiffopt/top'"),
    ],
)
def test_bad_options_are_told(
    options: list[str], told: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["ros", str(patient_rig(tmp_path)), *options]) == 2
    assert told in capfd.readouterr().err


def test_a_bad_domain_of_the_environment_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "lab")
    assert main(["ros", str(patient_rig(tmp_path))]) == 2
    assert "ROS_DOMAIN_ID is 'lab'; expected a number" in capfd.readouterr().err


def test_the_extra_is_named_where_it_is_missing(tmp_path: Path) -> None:
    code = "import sys; sys.modules['cyclonedds'] = None; from stiffopt.cli.main import main; "
    code += f"sys.exit(main(['ros', {str(patient_rig(tmp_path))!r}]))"
    done: Any = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "stiffopt[ros]" in done.stderr
