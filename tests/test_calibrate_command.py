"""The command calibrate: what it fits, prints and writes."""

from __future__ import annotations

import json
import re
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import stiffopt
from calibrated_arm import (
    FAST,
    FIGURES,
    LAG,
    QUICK,
    TRUTH,
    folder_fixture,  # noqa: F401
    recorded,
    run,
    truth,
)
from recordings import UCL, needs_ucl
from stiffopt.cli.calibrate_run import fixed_keys, log_names
from stiffopt.cli.calibration_report import models_compared
from stiffopt.cli.main import main
from stiffopt.errors import FileError, InputError
from stiffopt.identify.calibration import calibrate
from stiffopt.identify.results import what_to_look_at
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.identify.structures import STRUCTURES
from stiffopt.logs import Body, StiffnessTable, write_log, write_stiffness_table
from stiffopt.model.robot_files import load_description

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def again(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """The same calibration once more, for programs: its folder, stdout and stderr."""
    path, out, err = tmp_path_factory.mktemp("again"), StringIO(), StringIO()
    logs = [str(folder / "monday.csv"), str(folder / "tuesday.csv")]
    with redirect_stdout(out), redirect_stderr(err):
        code = main(
            ["calibrate", "--robot", "stiff-flop-1", *logs, "--out", str(path / "again.yaml"),
             "--json", *FAST]
        )  # fmt: skip
    assert code == 0
    return path, out.getvalue(), err.getvalue()


# -- the file -------------------------------------------------------------------------------------


def test_the_calibrated_file_has_the_arm_that_was_recorded(folder: Path) -> None:
    robot = load_description(folder / "fitted.yaml")
    history = robot.segments[0].history
    assert history is not None
    assert history.lag == pytest.approx(LAG, rel=0.1)
    p = np.random.default_rng(9).uniform(0, 1.2e5, (50, 3))
    fitted = stiffopt.load_robot(robot).tip_pose(p)[:, :3, 3]
    true = stiffopt.load_robot(truth()).tip_pose(p)[:, :3, 3]
    assert np.linalg.norm(fitted - true, axis=1).max() < 8e-4  # of few rows, near the robot file
    nominal = stiffopt.load_robot("stiff-flop-1").tip_pose(p)[:, :3, 3]
    assert np.linalg.norm(nominal - true, axis=1).max() > 2e-3  # so that there was something to do


def test_the_calibrated_file_says_what_it_came_from(folder: Path) -> None:
    text = (folder / "fitted.yaml").read_text(encoding="utf-8")
    comment = [line for line in text.splitlines() if line.startswith("# ")]
    assert "from stiff-flop-1." in comment[0]
    assert comment[1] == "# Logs: monday.csv, tuesday.csv."
    assert comment[2].startswith("# Model: lag")
    assert not re.search(r"\d{4}-\d\d-\d\d", "".join(comment))
    robot = load_description(folder / "fitted.yaml")
    assert robot.calibration is not None
    assert robot.calibration.logs == ("monday.csv", "tuesday.csv")


def test_a_calibration_says_what_a_validation_of_its_file_finds(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, out, _ = run(
        capsys, "validate", "--robot", folder / "fitted.yaml", folder / "monday.csv",
        folder / "tuesday.csv", "--json",
    )  # fmt: skip
    mean = json.loads(out)["position_error_mm"]["mean"]
    text = (folder / "fitted.yaml").read_text(encoding="utf-8")
    (said,) = re.findall(r"^# Error of the tip on these logs: mean ([\d.]+) mm", text, re.M)
    assert float(said) == pytest.approx(mean, abs=0.006)


def test_the_same_command_writes_the_same_file(folder: Path, again: tuple[Path, str, str]) -> None:
    path, out, err = again
    assert err == ""
    assert (path / "again.yaml").read_bytes() == (folder / "fitted.yaml").read_bytes()
    assert [each.name for each in path.iterdir()] == ["again.yaml"]
    found = json.loads(out)
    assert found["model"] == "lag"
    assert found["report"] is None
    assert set(found["before"]["logs"]) == {"monday.csv", "tuesday.csv"}
    before, after = (found[k]["position_error_mm"]["mean"] for k in ("before", "after"))
    assert after < 0.3 < 1.0 < before
    assert found["held_back"]
    (modulus,) = (e for e in found["parameters"] if e["key"] == next(iter(TRUTH)))
    assert modulus["unit"] == "Pa"
    assert modulus["before"] == 100e3
    assert modulus["interval_95"][0] < modulus["value"] < modulus["interval_95"][1]


def test_logs_of_a_fit_that_misses_them_may_be_of_several_arms() -> None:
    log = stiffopt.validate("stiff-flop-1", [recorded(0)])[0]
    for logs, told in ([log], False), ([log, log], True):
        assert ("of the same arm" in what_to_look_at(logs, 0.1)) == told


def test_a_fit_that_misses_its_own_logs_is_unfit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = recorded(0)
    write_log(tmp_path / "wrong.csv", replace(log, tip_position=log.tip_position[::-1].copy()))
    fitted = tmp_path / "fitted.yaml"
    calibrating = ("calibrate", "--robot", "stiff-flop-1", tmp_path / "wrong.csv", *QUICK)
    code, out, err = run(capsys, *calibrating, "--out", fitted, "--json")
    assert code == 4
    assert json.loads(out)["unfit"] is True
    assert "look at the order of the channels" in json.loads(out)["remarks"][0]
    assert "marked as unfit" in err
    assert "# UNFIT" in fitted.read_text(encoding="utf-8")
    with pytest.warns(stiffopt.UnfitWarning, match="marked as unfit"):
        robot = load_description(fitted)
    assert robot.calibration is not None
    assert robot.calibration.unfit
    task = tmp_path / "task.yaml"
    task.write_text(
        "format: stiffopt-task/1\nrobot: fitted.yaml\ntarget: {position: [0 mm, 0 mm, free]}\n",
        encoding="utf-8",
    )
    rig = tmp_path / "rig.yaml"
    rig.write_text(
        "format: stiffopt-rig/1\nname: a rig\nrobot: fitted.yaml\nrate: 50 Hz\n"
        "supply: {driver: simulated}\ntracker: {driver: simulated}\n",
        encoding="utf-8",
    )
    for command in (("solve", task), ("check", rig)):
        err = run(capsys, *command)[2]
        assert err.count("is marked as unfit") == 1, err


# -- what is fitted -------------------------------------------------------------------------------


def test_a_table_of_stiffness_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    p = np.zeros((6, 3))
    p[3:, 0] = 1e5
    directions = np.tile(np.eye(3), (2, 1))
    arm = stiffopt.load_robot("stiff-flop-1")
    k = np.array([arm.stiffness(*each) for each in zip(p, directions, strict=True)])
    table = StiffnessTable(p, directions, ("free",) * 6, 1.3 * k, 0.02 * k)
    write_stiffness_table(tmp_path / "k.csv", table)
    code, out, _ = run(
        capsys, "calibrate", "--robot", "stiff-flop-1", "--stiffness", tmp_path / "k.csv", "--out",
        tmp_path / "stiff.yaml", "--report", tmp_path / "report",
    )  # fmt: skip
    assert code == 0
    fitted = stiffopt.load_robot(tmp_path / "stiff.yaml")
    for pressures, direction, wanted in zip(p, directions, 1.3 * k, strict=True):
        assert fitted.stiffness(pressures, direction) == pytest.approx(wanted, rel=0.02)
    np.testing.assert_allclose(fitted.tip_pose(p), arm.tip_pose(p), atol=1e-9)
    assert re.search(r"^\(1, 0, 0\) +z, free +[\d.]+ \+- ", out, re.M)
    assert {path.name for path in (tmp_path / "report").iterdir()} == {"report.md", "stiffness.png"}
    page = (tmp_path / "report" / "report.md").read_text(encoding="utf-8")
    assert "| (0, 0, 0) | x, free | 18.2" in page


def test_several_models_are_compared_on_what_is_held_back(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    some = tuple(each for each in STRUCTURES if each.name in ("static", "lag"))
    monkeypatch.setattr("stiffopt.identify.calibration.STRUCTURES", some)
    code, out, _ = run(
        capsys, "calibrate", "--robot", "stiff-flop-1", folder / "monday.csv", "--out",
        tmp_path / "r.yaml", "--strain-law", "keep", "--rows", "60", "--report",
        tmp_path / "report",
    )  # fmt: skip
    assert code == 0
    static, lag = re.findall(r"^(?:static|lag)\b.*$", out, re.M)[:2]
    assert "<- chosen" in lag
    assert "<- chosen" not in static
    page = (tmp_path / "report" / "report.md").read_text(encoding="utf-8")
    assert "## Models" in page
    assert (tmp_path / "report" / "models.png").read_bytes().startswith(b"\x89PNG")


def test_channels_and_frame_are_kept_in_the_file(tmp_path: Path, capsys: Any) -> None:
    """Columns in another order and everything in the frame of a body that stands somewhere."""
    log = recorded(0)
    place = np.array([0.5, -0.2, 1.0])
    standing = Body(np.tile(place, (len(log), 1)))
    moved = replace(
        log,
        commanded=log.commanded[:, [2, 0, 1]],
        tip_position=log.tip_position + place,
        bodies={"stand": standing},
    )
    write_log(tmp_path / "moved.csv", moved)
    code, _, err = run(
        capsys, "calibrate", "--robot", "stiff-flop-1", tmp_path / "moved.csv", "--channels",
        "2,3,1", "--frame", "stand", "--out", tmp_path / "r.yaml", "--quiet", *QUICK,
    )  # fmt: skip
    assert (code, err) == (0, "")
    recordings = load_description(tmp_path / "r.yaml").recordings
    assert recordings is not None
    assert recordings.channels == (2, 3, 1)
    assert recordings.frame == "stand"
    _, out, _ = run(
        capsys, "validate", "--robot", tmp_path / "r.yaml", tmp_path / "moved.csv", "--json"
    )
    assert json.loads(out)["position_error_mm"]["mean"] < 0.3


def test_names_of_logs_tell_them_apart(tmp_path: Path) -> None:
    paths = [str(tmp_path / each) for each in ("a/1/x.csv", "b/1/x.csv", "b/2/x.csv", "y.csv")]
    assert log_names(paths) == ["a/1/x.csv", "b/1/x.csv", "2/x.csv", "y.csv"]
    with pytest.raises(FileError, match="given twice"):
        log_names(["x.csv", "y.csv", "./x.csv"])


def test_keys_that_are_not_fitted() -> None:
    robot = load_description("stiff-flop-2")
    assert fixed_keys(["segments[1].length"], robot) == ("segments[1].length",)
    assert fixed_keys(["length"], robot) == ("segments[0].length", "segments[1].length")
    gains = fixed_keys(["corrections.gain"], robot)
    assert len(gains) == 6
    assert gains[4] == "segments[1].corrections.gain[1]"
    assert "segments[0].history.lag" in fixed_keys(["history.lag"], robot)


def test_quick_fits_one_model_to_few_rows() -> None:
    quick = CalibrationSettings().quick(is_loaded=False)
    assert (quick.structure, quick.strain_law, quick.rows) == ("hysteresis", "keep", 400)
    chosen = CalibrationSettings(structure="lag", rows=100, trial_rows=80).quick(is_loaded=False)
    assert (chosen.structure, chosen.rows, chosen.trial_rows) == ("lag", 100, 80)
    assert CalibrationSettings().quick(is_loaded=True).rows < quick.rows
    with pytest.raises(InputError, match="name one"):
        calibrate("stiff-flop-1", [Path("log.csv")], settings=CalibrationSettings(holds_back=False))


def test_the_command_is_quick(folder: Path, tmp_path: Path, capsys: Any) -> None:
    command = ["calibrate", "--robot", "stiff-flop-1", folder / "monday.csv"]
    code, text, _ = run(capsys, *command, "--out", tmp_path / "q.yaml", "--json", *QUICK)
    found = json.loads(text)
    assert (code, found["models"], found["model"]) == (0, [], "lag")
    assert found["after"] is not None


@needs_ucl
def test_a_day_of_a_real_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One lag, fitted to the training run, is about as good as others found it to be by hand."""
    morning, training, slow = UCL
    robot = tmp_path / "ucl.yaml"
    robot.write_text(
        """\
format: stiffopt-robot/1
name: ucl
segments:
  - length: 58 mm
    outer_radius: 15 mm
    inner_radius: 4.5 mm
    chambers: {radius: 2.25 mm, offset: 10.1 mm,
      angles: [-30 deg, 30 deg, 90 deg, 150 deg, 210 deg, 270 deg]}
    channels: [[1, 2], [3, 4], [5, 6]]
    material: {youngs_modulus: 30 kPa, poisson_ratio: 0.45}
pressure: {min: 0 bar, max: 1.5 bar}
tolerances: {base_turn: 180 deg, youngs_modulus: 70 %, area: 150 %, length: 5 %}
""",
        encoding="utf-8",
    )
    code, _, err = run(
        capsys, "calibrate", "--robot", robot, training, "--out", tmp_path / "fitted.yaml", "-q",
        *FAST,
    )  # fmt: skip
    assert (code, err) == (0, "")
    _, out, _ = run(
        capsys, "validate", "--robot", tmp_path / "fitted.yaml", morning, slow, "--json"
    )
    logs = json.loads(out)["logs"]
    assert list(logs) == [morning.name, slow.name]
    assert logs[slow.name]["position_error_mm"]["mean"] < 1.3
    assert logs[morning.name]["position_error_mm"]["mean"] < 1.8


# -- what is printed ------------------------------------------------------------------------------


def test_what_is_printed(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(
        capsys, "calibrate", "--robot", "stiff-flop-1", folder / "monday.csv", "--out",
        tmp_path / "r.yaml", "--fix", "length", "--fix", "segments[0].corrections.azimuth", *FAST,
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80 + len(str(tmp_path))
    row = re.search(r"^monday\.csv +([\d.]+) +([\d.]+) +([\d.]+) +([\d.]+)", out, re.M)
    assert row is not None
    assert float(row[1]) > float(row[3])
    assert re.search(r"^Young's modulus +100 +\d\d\.\d+ +[\d.]+ to [\d.]+ +kPa +\d+ %$", out, re.M)
    assert re.search(r"^gain, channel 2 ", out, re.M)
    assert "highest pressures" in out  # held back
    assert "not learnt from these data: factor on the stiffness" in out
    assert "rest length" not in out
    assert "azimuth" not in out
    assert "r.yaml" in out


def test_each_compared_model_is_one_line_of_80_columns() -> None:
    folds = {"kinematics_poses_2.csv": SimpleNamespace(mean=13.2e-3)}
    models = [SimpleNamespace(structure=each, score=4e-3, folds=folds) for each in STRUCTURES]
    result = SimpleNamespace(structure=STRUCTURES[-1], candidates=models)
    page = StringIO()
    Console(width=80, file=page).print(models_compared(result).renderable())
    lines = page.getvalue().splitlines()
    assert len(lines) == 3 + len(STRUCTURES)
    assert f"{STRUCTURES[-1].name}  <- chosen" in lines[-2]


def test_the_report_of_a_calibration(folder: Path) -> None:
    report = folder / "report"
    assert {path.name for path in report.iterdir()} == {*FIGURES, "report.md"}
    page = (report / "report.md").read_text(encoding="utf-8")
    for name in FIGURES:
        assert (report / name).read_bytes().startswith(b"\x89PNG")
        assert f"]({name})" in page
    assert "# stiff-flop-1: calibration" in page
    assert re.search(r"^\| monday\.csv \| [\d.]+ \|", page, re.M)
    assert re.search(
        r"^\| Young's modulus \| 100 \| 8\d\.\d+ \| .* to .* \| kPa \| \d+ % \|", page, re.M
    )
    assert "not learnt from these data" in page
    assert "stiffopt validate --robot fitted.yaml" in page
    columns = {line.count(" | ") for line in page.splitlines() if line.startswith("| monday")}
    assert len(columns) <= 2  # errors, and what was held back


def test_help_names_every_model(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "calibrate", "--help")
    assert code == 0
    text = re.sub(r"-\s+", "-", " ".join(out.split()))
    missing = [each.name for each in STRUCTURES if not re.search(rf"[ ,]{each.name}[,.]", text)]
    assert not missing


def test_command_page_names_every_option_and_key(
    folder: Path, again: tuple[Path, str, str], capsys: Any
) -> None:
    page = (ROOT / "docs" / "command.md").read_text(encoding="utf-8")
    page = page[page.index("## Calibrate and validate") :]
    for command in ("calibrate", "validate"):
        _, out, _ = run(capsys, command, "--help")
        options = set(re.findall(r"^  (?:-\w, )?(--[\w-]+)", out, re.M)) - {"--help"}
        assert {"--robot", "--json", "--report"} <= options
        assert not {option for option in options if f"`{option}" not in page}
    found = json.loads(again[1])
    keys = {*found, *found["models"][0], *found["parameters"][0]}
    _, out, _ = run(capsys, "validate", "--robot", "stiff-flop-1", folder / "monday.csv", "--json")
    found = json.loads(out)
    keys |= {*found, *found["position_error_mm"]}
    assert not {key for key in keys if f"`{key}`" not in page}
