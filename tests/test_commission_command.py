"""The command commission on a simulated rig: what it tells, writes, corrects, and when it stops."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stiffopt.cli import commission_run
from stiffopt.cli.main import main
from stiffopt.commissioning import procedure, settings
from stiffopt.commissioning.record import fingerprints, load_record
from stiffopt.model.robot_files import load_description
from stiffopt.rig.config import load_rig_description

PROCEDURE = replace(
    settings.PROCEDURE, rest=1.0, first_hold=0.3, up=1.3, down=1.0, long=9.5, long_down=1.0
)


@pytest.fixture(autouse=True)
def short_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(procedure, "PROCEDURE", PROCEDURE)


RIG = """\
format: stiffopt-rig/1
name: short
robot: stiff-flop-1
rate: 50 Hz
supply: {{driver: simulated}}
tracker: {{driver: simulated, noise: 0.03 mm}}
log: {{folder: {folder}}}
plant:
  dynamics: quasi-static
  faults: true
  discretisation: {{bending_degree: 1, shear_degree: 0, sub_intervals: 3, step: 10 ms}}
{more}"""


def rig_file(folder: Path, more: str = "") -> Path:
    path = folder / "rig.yaml"
    path.write_text(RIG.format(folder=folder / "runs", more=more), encoding="utf-8")
    return path


def commissioned(path: Path, *options: str) -> int:
    return main(["commission", str(path), "--quick", "-q", *options])


@pytest.fixture
def touched(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Change the rig of the next command by a function."""

    def by(change: Any) -> None:
        plain = commission_run.rig_of

        def changed(path: str) -> Any:
            rig, *rest = plain(path)
            change(rig)
            return (rig, *rest)

        monkeypatch.setattr(commission_run, "rig_of", changed)

    return by


def swapped(rig: Any) -> None:
    """Exchange the tubes of channels 1 and 2; the gauges are those of the regulators."""
    world = rig.tracker._world
    command, measured = world.command, world.measured
    world.command = lambda p: command(np.asarray(p)[[1, 0, 2]])
    world.measured = lambda: measured()[[1, 0, 2]]


def test_a_rig_that_fits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = rig_file(tmp_path)
    assert commissioned(path, "--json", "--folder", str(tmp_path / "first")) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["fits"]
    assert told["findings"] == []
    assert told["channels"][0]["lag_up_s"] == pytest.approx(0.06, abs=0.01)
    assert told["channels"][0]["displacement_m"][0] == pytest.approx(-3.2e-3, rel=0.1)
    assert told["tracker"]["tip_delay_s"] == pytest.approx(0.01, abs=0.02)
    assert told["tracker"]["noise_m"] == pytest.approx(3e-5, rel=0.2)
    files = {each.name for each in (tmp_path / "first").iterdir()}
    assert files >= {"record.yaml", "report.md", "commissioning.csv", "commissioning.png"}
    assert main(["check", str(tmp_path / "rig.commissioning.yaml"), "-q"]) == 0
    record = load_record(tmp_path / "rig.commissioning.yaml")
    assert record.fits
    assert record.age() < 600
    description = load_rig_description(path)
    robot = load_description("stiff-flop-1")
    assert (record.rig_hash, record.robot_hash) == fingerprints(robot, description)


def test_a_full_one_sees_slow_leaks(tmp_path: Path) -> None:
    path = rig_file(tmp_path)
    assert main(["commission", str(path), "--no-plot", "-q"]) == 0
    record = load_record(tmp_path / "rig.commissioning.yaml")
    assert not record.quick
    drifts = [channel.drift for channel in record.channels]
    assert all(drift is not None and -0.2 < drift < 0.02 for drift in drifts)  # it creeps on


def test_a_swap_on_the_rig(
    tmp_path: Path, touched: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    path = rig_file(tmp_path)
    touched(swapped)
    assert main(["commission", str(path), "--quick", "--no-plot"]) == 6
    told = capsys.readouterr().out
    assert "channels 1 and 2 seem swapped" in told
    assert "does NOT fit" in told
    assert not load_record(tmp_path / "rig.commissioning.yaml").fits


def test_set_points_that_are_swapped_are_no_leak(
    tmp_path: Path, touched: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each gauge reads its own chamber, which has shown the other channel's step."""

    def crossed(rig: Any) -> None:
        command = rig.tracker._world.command
        rig.tracker._world.command = lambda p: command(np.asarray(p)[[1, 0, 2]])

    touched(crossed)
    path = rig_file(tmp_path)
    assert main(["commission", str(path), "--no-plot"]) == 6
    told = capsys.readouterr().out
    assert "channels 1 and 2 seem swapped" in told
    assert "the gauge of channel 2 follows the command of channel 1" in told


def test_the_corrected_rig_file_fits(
    tmp_path: Path, touched: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """The whole first day: a turned frame is found, corrected, and then nothing is wrong."""
    more = (
        "  mismatch: {registration: {orientation: [0.996194698, 0, 0, 0.087155743]}}\n"
        "control: {tracker_noise: 0.01 mm}\n"
    )
    path, better = rig_file(tmp_path, more), tmp_path / "better.yaml"
    assert commissioned(path, "--no-plot", "--out", str(better)) == 6
    assert "tracker.registration.tracker_in_base, control.tracker_noise" in better.read_text()
    # a simulated sensor is placed by the file, and would move with it
    there = load_rig_description(path).tracker
    touched(lambda rig: setattr(rig.tracker._world.camera, "settings", there))
    folder = str(tmp_path / "again")
    code = main(["commission", str(better), "--quick", "--no-plot", "--folder", folder])
    assert code == 0, capsys.readouterr().out


def test_danger_ends_it(tmp_path: Path, touched: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """An arm that moves much farther than any model of it, and one whose tracker jumps."""
    path = rig_file(tmp_path, "  mismatch: {gain: [5, 5, 5]}\n")
    assert commissioned(path, "--no-plot") == 5
    told = capsys.readouterr().err
    assert "the tip has moved by" in told
    assert "the arm is vented" in told
    (finding,) = load_record(tmp_path / "rig.commissioning.yaml").findings
    assert "was stopped: the tip has moved" in finding.text

    def jumping(rig: Any) -> None:
        capture, camera = rig.tracker._world.camera.capture, rig.tracker._world.camera
        camera.capture = lambda fault: capture("wrong" if camera.count > 100 else fault)

    path = rig_file(tmp_path)
    touched(jumping)
    assert commissioned(path, "--no-plot", "--folder", str(tmp_path / "second")) == 5
    assert "jumped by" in capsys.readouterr().err


def test_a_shaken_arm_is_not_moved(tmp_path: Path, touched: Any) -> None:
    touched(lambda rig: rig.tracker._world.inject("tracker", "shaking"))
    assert commissioned(rig_file(tmp_path), "--no-plot") == 5
    finding = load_record(tmp_path / "rig.commissioning.yaml").findings[0]
    assert "though the arm is vented" in finding.text


def test_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = rig_file(tmp_path)
    assert commissioned(path, "--out", str(path)) == 2
    (tmp_path / "elsewhere").mkdir()
    assert commissioned(path, "--out", str(tmp_path / "elsewhere" / "better.yaml")) == 2
    assert "expected a place beside" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()  # nothing has moved
    nowhere = f"commissioning: {{record: {tmp_path / 'nowhere' / 'record.yaml'}}}\n"
    path.write_text(path.read_text() + nowhere, encoding="utf-8")
    assert commissioned(path) == 2
    assert "the record cannot be written" in capsys.readouterr().err
    path = rig_file(tmp_path)
    (tmp_path / "experiment.yaml").touch()  # 'stiffopt commission' cannot continue one
    assert commissioned(path, "--folder", str(tmp_path)) == 2
    assert "is not empty" in capsys.readouterr().err
    path.write_text(path.read_text().replace("tracker:", "# tracker:"), encoding="utf-8")
    assert commissioned(path) == 2
    assert "no tracker" in capsys.readouterr().err
    bad = tmp_path / "bad.yaml"
    bad.write_text("format: stiffopt-commissioning/1\ndate: today\n", encoding="utf-8")
    assert main(["check", str(bad)]) == 2
    assert "time zone" in capsys.readouterr().out
