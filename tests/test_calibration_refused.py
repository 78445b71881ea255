"""Calibrations and validations that are refused, interrupted, cancelled or out of time."""

from __future__ import annotations

import re
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stiffopt
from calibrated_arm import QUICK, logs_folder, run, truth
from stiffopt.cli import calibrate_run, exits
from stiffopt.errors import CancelledError
from stiffopt.files import save_file
from stiffopt.identify.calibration import CalibrationResult, calibrate
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.logs import Log, StiffnessTable, read_log, write_log, write_stiffness_table
from stiffopt.model.robot_files import load_description

_CALIBRATE = ("calibrate", "--robot", "stiff-flop-1", "--out", "{tmp}/new.yaml")

# -- refused --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return logs_folder(tmp_path_factory)


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


# -- not finished ---------------------------------------------------------------------------------


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
