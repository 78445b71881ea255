"""The studio's view of a daemon, against a real server on loopback: what is read and commanded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from fake_loop import FakeLoop
from running import wait_for
from stiffopt.control.state import Alarm, HeldContact, State
from stiffopt.daemon.server import Server
from stiffopt.daemon.service import create_app
from stiffopt.errors import DeviceError, InputError
from stiffopt.model.manipulator import load_robot
from stiffopt.model.robot_files import load_description
from stiffopt.optimise.task import load_task
from stiffopt.studio import rig_watch, texts
from stiffopt.studio.rig_watch import RigWatch
from stiffopt.studio.workbench import Workbench

pytestmark = pytest.mark.real_time

ROOT = Path(__file__).resolve().parent.parent
TOKEN = "a-secret-of-the-tests"
HEARTBEAT = 1.5


@pytest.fixture
def loop() -> FakeLoop:
    return FakeLoop()


@pytest.fixture
def server(loop: FakeLoop) -> Iterator[Server]:
    robot = load_description("stiff-flop-2")
    server = Server(create_app(loop, robot=robot, token=TOKEN, heartbeat=HEARTBEAT, patience=20.0))
    server.start()
    yield server
    server.stop()


@pytest.fixture
def rig(server: Server, tmp_path: Path) -> Path:
    content = yaml.safe_load((ROOT / "rig" / "sim.yaml").read_text(encoding="utf-8"))
    content.update(robot="stiff-flop-2", service={"port": server.port})
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


@pytest.fixture
def watching(rig: Path) -> Iterator[Callable[..., RigWatch]]:
    opened: list[RigWatch] = []

    def watch(*arguments: Any) -> RigWatch:
        opened.append(RigWatch(rig, *arguments))
        return opened[-1]

    yield watch
    for each in opened:
        each.close()


def test_without_the_token_it_only_reads(
    watching: Callable[..., RigWatch], loop: FakeLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STIFFOPT_TOKEN", TOKEN)  # which only the command looks at
    watch = watching()
    loop.now = replace(loop.now, alarms=(Alarm("x", "<b>too warm</b>", 1.0),))
    watch.poll()
    assert watch.state is not None
    assert not watch.trouble
    html = texts.rig_html(watch)
    assert "inactive" in html
    assert "(0.0, 10.0, 200.0) mm" in html
    assert " s ago: the arm is armed" in html
    assert "read only" in html
    assert "<b>too warm" not in html
    for command in (watch.take_control, watch.arm, watch.hold, watch.disarm, watch.vent):
        command()
        assert "needs the token" in watch.outcome
    watch.go(Workbench(watch.design))
    assert not watch.in_control
    assert loop.names == []


def test_a_braced_arm_is_drawn_as_it_leans(
    rig: Path, watching: Callable[..., RigWatch], loop: FakeLoop
) -> None:
    task = load_task(ROOT / "problems" / "braced" / "post.yaml")
    content = yaml.safe_load(rig.read_text(encoding="utf-8"))
    content["scene"] = yaml.safe_load((ROOT / "rig" / "brace.yaml").read_text())["scene"]
    rig.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    watch, robot = watching(), load_robot("stiff-flop-2")
    pressures = np.array([1.1, 0, 0.1, 0, 0.2, 0]) * 1e5
    contact = HeldContact("<post>", 0.101, "uncertain", 0.2, 0.05)
    loop.now = replace(loop.now, measured=pressures, brace="held", leans_on=(contact,))
    watch.poll()
    leaning = watch.leaning(robot)
    assert leaning is not None
    expected = robot.contact_equilibrium(pressures, task.scene)
    assert [each.object for each in leaning.contacts] == ["post"]
    assert leaning.tip_pose == pytest.approx(expected.tip_pose)
    html = texts.rig_html(watch)
    assert "held" in html
    assert "&lt;post&gt;&#x27; at 101 mm: uncertain, 200 mN (deviation 50 mN)" in html
    loop.now = replace(loop.now, brace="released", leans_on=())
    watch.poll()
    assert watch.leaning(robot) is None


def test_a_preview_begins_where_the_arm_is(
    watching: Callable[..., RigWatch], loop: FakeLoop
) -> None:
    watch, robot = watching(TOKEN), load_robot("stiff-flop-2")
    assert watch.present_design(robot) == watch.design  # nobody has answered yet
    pressures = np.array([0.2, 0, 0, 0.4, 0, 0]) * 1e5
    loop.now = replace(loop.now, measured=pressures, target_position=None)
    watch.poll()
    begun = watch.present_design(robot).task.target.position
    np.testing.assert_allclose(begun, robot.tip_pose(pressures)[:3, 3], atol=5.1e-6)
    loop.now = replace(loop.now, target_position=np.array([-0.02, np.nan, 0.19]))
    watch.poll()
    assert watch.present_design(robot).task.target.position == (-0.02, None, 0.19)


def test_with_token_and_control_a_preview_is_sent(
    watching: Callable[..., RigWatch], loop: FakeLoop, compiled: Path
) -> None:
    watch = watching(TOKEN)
    watch.poll()
    watch.arm()
    assert "take it" in watch.outcome
    bench = Workbench(watch.design)
    watch.go(bench)
    assert watch.outcome == "not sent: wait until the preview is solved"
    assert bench.answer_best(lambda: False)
    watch.take_control()
    assert watch.in_control
    watch.arm()
    watch.go(bench)
    assert watch.outcome == "going to the target"
    bench.change("target", lambda d: d.with_target(position=(-0.15, 0.0, 0.19)))
    watch.go(bench)
    assert "wait until" in watch.outcome
    bench.answer_best(lambda: False)
    watch.go(bench)
    assert watch.outcome == "not sent: the preview is unreachable"
    bench.change("gravity", lambda d: d.with_gravity((0, 0, 0), 0.01))
    watch.go(bench)
    assert "not those of the rig" in watch.outcome
    assert [name for name in loop.names if name != "hold"] == ["arm", "set_task"]
    sent = dict(loop.calls)["set_task"]
    assert sent.target == watch.design.task.target
    watch.poll()
    watch.take_control()
    watch.disarm()
    assert watch.outcome == "let down"
    watch.release()
    assert not watch.in_control


def test_control_is_lost_and_the_arm_held_when_nobody_looks(
    watching: Callable[..., RigWatch], loop: FakeLoop
) -> None:
    looks = [True]
    watch = watching(TOKEN, lambda: looks[0])
    watch.take_control()
    watch.arm()
    looks[0] = False
    wait_for(lambda: watch.poll() or "hold" in loop.names, 20.0)
    looks[0] = True
    watch.poll()
    assert not watch.in_control


def test_a_wrong_token_commands_nothing(
    watching: Callable[..., RigWatch], loop: FakeLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rig_watch, "vent_rig", lambda file: "vented by the guard")
    watch = watching("not-the-token-of-this-daemon")
    watch.take_control()
    assert "not this daemon's token" in watch.outcome
    watch.vent()
    assert watch.outcome == "vented by the guard"  # as `stiffopt vent`, which needs no token
    assert loop.names == []


def test_it_vents_without_control_and_without_the_daemon(
    watching: Callable[..., RigWatch],
    server: Server,
    loop: FakeLoop,
    rig: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    watch = watching(TOKEN)
    watch.vent()
    assert (watch.outcome, loop.names) == ("vented", ["vent"])
    server.stop()
    asked: list[Any] = []
    monkeypatch.setattr(rig_watch, "vent_rig", lambda file: asked.append(file) or "vented: guard")
    watch.vent()
    assert (watch.outcome, asked) == ("vented: guard", [rig])

    def failing(file: Any) -> str:
        raise DeviceError("no guard answers")

    monkeypatch.setattr(rig_watch, "vent_rig", failing)
    watch.vent()
    assert watch.outcome == "THE ARM MAY BE UNDER PRESSURE: no guard answers"
    watch.poll()
    assert watch.state is None
    assert "cannot be reached" in texts.rig_html(watch)


def test_another_robot_is_told(rig: Path, watching: Callable[..., RigWatch]) -> None:
    rig.write_text(rig.read_text().replace("stiff-flop-2", "stiff-flop-3"), encoding="utf-8")
    watch = watching()
    watch.poll()
    assert watch.trouble == "the daemon has the robot 'stiff-flop-2', not 'stiff-flop-3'"


def test_pressures_are_those_measured_or_else_commanded(loop: FakeLoop) -> None:
    np.testing.assert_array_equal(loop.now.pressures, [1.0, 2.0, 0.0, 4.0, 5.0, 6.0])
    unknown = np.full(6, np.nan)
    assert replace(loop.now, measured=unknown, commanded=unknown).pressures is None


def test_a_studio_that_commands_is_for_this_machine_alone(rig: Path) -> None:
    opening = pytest.importorskip("stiffopt.studio.opening")
    with pytest.raises(InputError, match="listens on 127"):
        opening.open_studio(str(rig), token=TOKEN, host="0.0.0.0")


def test_the_page_of_a_rig_opens_and_closes(rig: Path, loop: FakeLoop) -> None:
    opening = pytest.importorskip("stiffopt.studio.opening")
    loop.now = replace(loop.now, state=State.HOLDING)
    with_token, without = (opening.open_studio(str(rig), token=each) for each in (TOKEN, None))
    try:
        for studio in (with_token, without):
            wait_for(lambda studio=studio: studio.view.watch.state is not None)
            assert studio.view.watch.state.state is State.HOLDING
    finally:
        with_token.close()
        without.close()
