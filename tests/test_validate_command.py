"""The command validate: errors of logs, by hand and from the file, and its report."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stiffopt
from calibrated_arm import (
    FIGURES,
    folder_fixture,  # noqa: F401
    recorded,
    run,
)
from stiffopt.logs import read_log, write_log
from stiffopt.model.robot_files import load_description

KEYS = {"n", "position_error_mm", "position_error_percent_of_length", "angle_error_deg"}


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


def test_a_shift_that_rest_does_not_show_is_found_from_a_longer_beginning(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = read_log(folder / "tuesday.csv")
    shifted = log.tip_position + np.where(log.time < 3, 0, [[2e-3], [-1e-3], [1e-3]]).T
    write_log(tmp_path / "wednesday.csv", replace(log, tip_position=shifted))

    def mean_error(*options: str) -> float:
        code, out, _ = run(
            capsys, "validate", "--robot", folder / "fitted.yaml", tmp_path / "wednesday.csv",
            *options, "--json",
        )  # fmt: skip
        assert code == 0
        return float(json.loads(out)["position_error_mm"]["mean"])

    least = mean_error("--rezero")
    assert mean_error("--rezero", "--beginning", "20 s") < 0.5 * least
    code, _, err = run(
        capsys, "validate", "--robot", folder / "fitted.yaml", folder / "tuesday.csv",
        "--beginning", "0 s",
    )  # fmt: skip
    assert code == 2
    assert "--beginning: expected more than 0 s" in err
