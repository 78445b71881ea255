"""The commands calibrate and validate: what they print, write, refuse and return."""

from __future__ import annotations

import json
import re
import signal
import sys
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
from recordings import UCL, needs_ucl
from stiffopt.cli import calibrate_run, exits
from stiffopt.cli.calibrate_run import fixed_keys, log_names
from stiffopt.cli.calibration_report import models_compared
from stiffopt.cli.main import main
from stiffopt.errors import CancelledError, FileError, InputError
from stiffopt.files import save_file
from stiffopt.identify.calibration import CalibrationResult, calibrate
from stiffopt.identify.results import what_to_look_at
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.identify.structures import STRUCTURES
from stiffopt.logs import (
    Body,
    Log,
    StiffnessTable,
    read_log,
    write_log,
    write_stiffness_table,
)
from stiffopt.model.description import RobotDescription
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description

ROOT = Path(__file__).resolve().parent.parent
LAG = 0.4  # s
TRUTH = {
    "segments[0].material.youngs_modulus": 88e3,
    "segments[0].corrections.gain[0]": 1.05,
    "segments[0].corrections.gain[1]": 0.97,
}
FIGURES = {
    *("errors_over_time.png", "errors_over_pressure.png", "paths.png", "tip_over_time.png"),
}
KEYS = {"n", "position_error_mm", "position_error_percent_of_length", "angle_error_deg"}
FAST = ["--model", "lag", "--strain-law", "keep", "--rows", "120"]
QUICK = ["--model", "lag", "--rows", "60", "--quick"]


def truth() -> RobotDescription:
    """The arm that is recorded; the robot file is `stiff-flop-1`."""
    values = {Parameter(key): value for key, value in TRUTH.items()}
    return with_values(load_description("stiff-flop-1"), values)


def recorded(seed: int, rows: int = 240, highest: float = 1.2e5) -> Log:
    """Log of random pressures, each held for 2 s, that the arm follows with a lag."""
    rng = np.random.default_rng(seed)
    commanded = np.repeat(rng.uniform(0, highest, (rows // 20, 3)), 20, axis=0)
    commanded[:5] = 0.0
    fine, step = 50, 0.1  # steps from row to row, between which pressures are on a line; s
    followed, now = np.zeros_like(commanded), np.zeros(3)
    for i in range(1, rows):
        for k in range(fine):
            command = commanded[i - 1] + (commanded[i] - commanded[i - 1]) * (k + 0.5) / fine
            now = now + (1 - np.exp(-step / fine / LAG)) * (command - now)
        followed[i] = now
    tip = stiffopt.load_robot(truth()).tip_pose(followed)[:, :3, 3]
    tip += rng.normal(0, 1e-4, tip.shape)
    return Log(time=step * np.arange(rows), commanded=commanded, tip_position=tip)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two logs, one that goes beyond them, and what a calibration with a report makes of the two.

    Everything that reads only shares it.
    """
    path = tmp_path_factory.mktemp("calibrate")
    for name, log in (
        ("monday.csv", recorded(0)),
        ("tuesday.csv", recorded(1)),
        ("high.csv", recorded(2, highest=1.5e5)),
    ):
        write_log(path / name, log)
    code = main(
        ["calibrate", "--robot", "stiff-flop-1", str(path / "monday.csv"),
         str(path / "tuesday.csv"), "--out", str(path / "fitted.yaml"),
         "--report", str(path / "report"), "--quiet", *FAST]
    )  # fmt: skip
    assert code == 0
    return path


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


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""
    capsys.readouterr()
    code = main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return code, out, err


# -- calibrate ------------------------------------------------------------------------------------


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


# -- validate -------------------------------------------------------------------------------------


def test_validate_says_what_the_design_says(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = run(
        capsys, "validate", "--robot", folder / "fitted.yaml", folder / "monday.csv",
        folder / "high.csv", "--json",
    )  # fmt: skip
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert set(found) >= {*KEYS, "logs", "outside_training_percent"}
    assert set(found["position_error_mm"]) == {"mean", "median", "p95", "max"}
    monday, high = found["logs"]["monday.csv"], found["logs"]["high.csv"]
    assert set(monday) >= KEYS
    assert found["n"] == monday["n"] + high["n"] == 480
    means = [each["position_error_mm"]["mean"] for each in (monday, high)]
    assert found["position_error_mm"]["mean"] == pytest.approx(np.mean(means))
    length = load_description(folder / "fitted.yaml").length * 1e3
    assert monday["position_error_percent_of_length"] == pytest.approx(means[0] / length * 100)
    assert monday["angle_error_deg"] is None
    assert monday["outside_training_percent"] == 0
    assert monday["outside_training"] is None
    seen = np.concatenate([read_log(folder / f"{day}day.csv").commanded for day in ("mon", "tues")])
    there = read_log(folder / "high.csv").commanded
    apart = np.linalg.norm(there[:, np.newaxis] - seen, axis=2).min(axis=1)
    beyond = apart > 0.1 * np.ptp(seen, axis=0).max()
    assert high["outside_training_percent"] == pytest.approx(beyond.mean() * 100, abs=10)
    assert high["outside_training"]["n"] == round(high["outside_training_percent"] / 100 * 240)


def test_errors_are_those_of_a_model_that_is_run_by_hand(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A robot without history: the distance of its settled tip from the recorded one."""
    code, out, _ = run(
        capsys, "validate", "--robot", "stiff-flop-1", folder / "monday.csv", "--json"
    )
    assert code == 0
    found = json.loads(out)
    log = read_log(folder / "monday.csv")
    tip = stiffopt.load_robot("stiff-flop-1").tip_pose(log.commanded)[:, :3, 3]
    distance = np.linalg.norm(tip - log.tip_position, axis=1) * 1e3
    expected = [distance.mean(), np.median(distance), np.quantile(distance, 0.95), distance.max()]
    assert list(found["position_error_mm"].values()) == pytest.approx(expected, rel=1e-6)
    assert found["outside_training_percent"] is None
    assert found["outside_training"] is None


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


def test_validate_for_people_says_where_predictions_leave_the_training_range(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = folder / "fitted.yaml"
    code, out, _ = run(
        capsys, "validate", "--robot", file, folder / "monday.csv", folder / "high.csv"
    )
    assert code == 0
    assert re.search(r"^monday\.csv +240 .* 0 %$", out, re.M)
    text = " ".join(out.split())
    assert re.search(
        r"high\.csv: \d+ % of the rows lie outside what the calibration has seen", text
    )
    assert re.search(r"channel \d goes to 1\.\d+ bar, it was recorded to 1\.\d+ bar", text)
    _, out, _ = run(capsys, "validate", "--robot", file, folder / "tuesday.csv")
    assert "all pressures lie within what the calibration has seen" in out
    _, out, _ = run(capsys, "validate", "--robot", "stiff-flop-1", folder / "tuesday.csv")
    assert "was not calibrated" in " ".join(out.split())


def test_mcap_and_csv_are_read_alike(folder: Path, tmp_path: Path, capsys: Any) -> None:
    pytest.importorskip("mcap")
    from stiffopt.logs import McapLogWriter

    log = recorded(0)
    with McapLogWriter(tmp_path / "monday.mcap", log.layout) as writer:
        for row in log.rows():
            writer.append(row)
    robot = folder / "fitted.yaml"
    _, one, _ = run(capsys, "validate", "--robot", robot, folder / "monday.csv", "--json")
    code, other, _ = run(capsys, "validate", "--robot", robot, tmp_path / "monday.mcap", "--json")
    assert code == 0
    errors = [json.loads(text)["position_error_mm"]["mean"] for text in (one, other)]
    assert errors[0] == pytest.approx(errors[1], rel=1e-3)


# -- reading --------------------------------------------------------------------------------------


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


# -- reports --------------------------------------------------------------------------------------


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


def test_the_report_of_a_validation(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = run(
        capsys, "validate", "--robot", folder / "fitted.yaml", folder / "high.csv", "--report",
        tmp_path / "page", "--json",
    )  # fmt: skip
    assert code == 0
    assert {path.name for path in (tmp_path / "page").iterdir()} == {*FIGURES, "report.md"}
    page = (tmp_path / "page" / "report.md").read_text(encoding="utf-8")
    mean = json.loads(out)["position_error_mm"]["mean"]
    assert f"| high.csv | 240 | {mean:.2f} |" in page
    assert "outside what the calibration has seen" in page


def test_markdown_leaves_names_as_they_are(folder: Path, tmp_path: Path, capsys: Any) -> None:
    write_log(tmp_path / "a_log_b.csv", recorded(3))
    code, _, _ = run(
        capsys, "validate", "--robot", "stiff-flop-1", tmp_path / "a_log_b.csv", "--report",
        tmp_path / "page", "-q",
    )  # fmt: skip
    assert code == 0
    assert r"| a\_log\_b.csv |" in (tmp_path / "page" / "report.md").read_text(encoding="utf-8")


# -- what is refused ------------------------------------------------------------------------------

_CALIBRATE = ("calibrate", "--robot", "stiff-flop-1", "--out", "{tmp}/new.yaml")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (_CALIBRATE, "nothing to fit to; expected a LOG or a table of stiffness"),
        ((*_CALIBRATE, "{tmp}/no.csv"), "no.csv: there is no such file"),
        ((*_CALIBRATE, "{tmp}/no.mcap"), "no.mcap: there is no such file"),
        ((*_CALIBRATE, "{tmp}/bad.csv"), "the column 'p1_pa' is missing"),
        ((*_CALIBRATE, "{tmp}/k.csv"), "is a table of stiffness, not a log; give it as --stiff"),
        ((*_CALIBRATE, "{tmp}/six.csv"), "has 6 pressures.* --channels 1,2,3"),
        ((*_CALIBRATE, "{tmp}/six.csv", "--channels", "1,2"), "names 2 columns"),
        ((*_CALIBRATE, "{tmp}/six.csv", "--channels", "1,2,9"), "has no column p9_pa"),
        ((*_CALIBRATE, "{tmp}/six.csv", "--channels", "a"), "--channels: 'a' are no channels"),
        ((*_CALIBRATE, "{log}", "--frame", "mid"), "there is no body 'mid'"),
        ((*_CALIBRATE, "{log}", "{log}"), "is given twice"),
        ((*_CALIBRATE, "{log}", "--model", "best"), "no model 'best'; expected one of auto, st"),
        ((*_CALIBRATE, "{log}", "--strain-law", "mine"), "--strain-law: expected auto or keep"),
        ((*_CALIBRATE, "{log}", "--fix", "lenght"), "--fix: 'lenght' is no parameter of the robot"),
        ((*_CALIBRATE, "{log}", "--pressures", "both"), "expected commanded or measured"),
        ((*_CALIBRATE, "{log}", "--pressures", "measured"), "has no measured pressures"),
        ((*_CALIBRATE, "{log}", "--stiffness", "{log}"), "the column 'direction_x' is missing"),
        ((*_CALIBRATE, "{log}", "--report", "{tmp}"), "exists; give another folder"),
        ((*_CALIBRATE, "{log}", "--report", "{tmp}/a/b"), "cannot be made: there is no folder"),
        (("calibrate", "--robot", "nix", "{log}", "--out", "{tmp}/new.yaml"), "no robot 'nix'"),
        (
            ("calibrate", "--robot", "stiff-flop-1", "{log}", "--out", "{tmp}/k.csv"),
            "ends in .yaml",
        ),
        (
            ("calibrate", "--robot", "stiff-flop-1", "{log}", "--out", "{tmp}/old.yaml"),
            "old.yaml: exists; give another name",
        ),
        (("validate", "--robot", "stiff-flop-1", "{tmp}/no.csv"), "there is no such file"),
        (
            ("validate", "--robot", "stiff-flop-1", "{tmp}/six.csv"),
            "give the column of each channel with --channels",
        ),
        (("validate", "--robot", "stiff-flop-1", "{log}", "--report", "{tmp}"), "exists"),
    ],
)
def test_bad_input_is_one_message_and_nothing_is_written(
    arguments: tuple[str, ...], words: str, folder: Path, tmp_path: Path, capsys: Any
) -> None:
    six = Log(np.arange(30.0), np.zeros((30, 6)), np.zeros((30, 3)))
    write_log(tmp_path / "six.csv", six)
    (tmp_path / "bad.csv").write_text("time_s,q\n0,1\n", encoding="utf-8")
    table = StiffnessTable(np.zeros((1, 3)), np.eye(3)[:1], ("free",), np.ones(1), np.ones(1))
    write_stiffness_table(tmp_path / "k.csv", table)
    save_file(tmp_path / "old.yaml", "robot", truth())
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    places = {"{tmp}": str(tmp_path), "{log}": str(folder / "monday.csv")}
    given = []
    for argument in arguments:
        for mark, place in places.items():
            argument = argument.replace(mark, place)
        given.append(argument)
    code, out, err = run(capsys, *given)
    assert (code, out) == (2, "")
    assert err.count("error: ") == 1
    assert "Traceback" not in err
    assert re.search(words, " ".join(err.split()))
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_without_a_robot_or_a_place_the_usage_is_shown(capsys: Any) -> None:
    for arguments in (["calibrate", "x.csv"], ["validate", "--robot", "stiff-flop-1"]):
        code, _, err = run(capsys, *arguments)
        assert code == 2
        assert "Usage" in err


def test_a_report_needs_matplotlib_before_any_work(
    folder: Path, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    code, _, err = run(
        capsys, *(each.replace("{tmp}", str(tmp_path)) for each in _CALIBRATE), folder / "no.csv",
        "--report", tmp_path / "page",
    )  # fmt: skip
    assert code == 2
    assert "pip install 'stiffopt[plot]'" in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("where", ["fit_robot", "save_file"])
def test_an_interrupt_leaves_nothing_behind(
    where: str, folder: Path, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    """In the middle of the fit, and after the report was drawn but before anything has a name."""

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(calibrate_run, where, interrupted)
    code, out, _ = run(
        capsys, *(each.replace("{tmp}", str(tmp_path)) for each in _CALIBRATE),
        folder / "monday.csv", "--report", tmp_path / "page", *QUICK,
    )  # fmt: skip
    assert (code, out) == (130, "")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("models", [0, 1])
def test_ctrl_c_keeps_the_best_model_so_far(
    models: int, folder: Path, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    """While the second model is fitted; before the first is, there is nothing to keep."""
    fitted: list[str] = []

    def report(self: object, done: float, total: float, text: str) -> None:
        begins = text.startswith("fitting") and text not in fitted
        if begins:
            fitted.append(text)
        if begins and len(fitted) == models + 1:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(exits.ProgressBar, "report", report)
    out = tmp_path / "fitted.yaml"
    command = ["calibrate", "--robot", "stiff-flop-1", folder / "monday.csv", "--out", out]
    code, text, err = run(capsys, *command, "--rows", "60")
    assert (code, err.splitlines()[-1]) == (130, "interrupted")
    assert out.exists() == bool(models)
    if models:
        assert "the calibration was interrupted" in " ".join(text.split())
        assert "# Interrupted: not all models were compared" in out.read_text(encoding="utf-8")
        with pytest.warns(stiffopt.UnfitWarning):  # the simplest model of an arm that lags
            assert load_description(out).calibration is not None


def test_a_calibration_that_is_cancelled_has_the_best_so_far(folder: Path) -> None:
    """And its result is made in spite of what goes on asking to give up."""
    fitted: set[str] = set()

    def progress(done: float, total: float, words: str) -> None:
        if words.startswith("fitting"):
            fitted.add(words)

    settings = CalibrationSettings(rows=60, trial_rows=60)
    with pytest.raises(CancelledError) as stopped:
        calibrate(
            "stiff-flop-1", [folder / "monday.csv"], settings=settings, progress=progress,
            cancel=lambda: len(fitted) > 1,
        )  # fmt: skip
    assert isinstance(stopped.value.found, CalibrationResult)
    assert "was interrupted" in stopped.value.found.remarks[0]


def test_a_calibration_that_is_out_of_time(folder: Path, tmp_path: Path, capsys: Any) -> None:
    command = ["calibrate", "--robot", "stiff-flop-1", folder / "monday.csv", "--timeout", "1 ms"]
    code, out, err = run(capsys, *command, "--out", tmp_path / "fitted.yaml")
    assert (code, out) == (130, "")
    assert "no answer within the 0.001 s" in err
    assert not list(tmp_path.iterdir())


def test_ctrl_c_while_logs_are_read_is_an_interrupt(
    folder: Path, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    def read(path: str) -> Log:
        signal.raise_signal(signal.SIGINT)
        return read_log(path)

    monkeypatch.setattr(calibrate_run, "_read", read)
    logs = [folder / "monday.csv", folder / "tuesday.csv"]
    command = ["calibrate", "--robot", "stiff-flop-1", *logs, "--out", tmp_path / "fitted.yaml"]
    code, out, err = run(capsys, *command)
    assert (code, out, err.splitlines()) == (130, "", ["interrupted"])
    assert not list(tmp_path.iterdir())


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


# -- a real arm -----------------------------------------------------------------------------------


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


def test_each_compared_model_is_one_line_of_80_columns() -> None:
    folds = {"kinematics_poses_2.csv": SimpleNamespace(mean=13.2e-3)}
    models = [SimpleNamespace(structure=each, score=4e-3, folds=folds) for each in STRUCTURES]
    result = SimpleNamespace(structure=STRUCTURES[-1], candidates=models)
    page = StringIO()
    Console(width=80, file=page).print(models_compared(result).renderable())
    lines = page.getvalue().splitlines()
    assert len(lines) == 3 + len(STRUCTURES)
    assert f"{STRUCTURES[-1].name}  <- chosen" in lines[-2]
