"""What tests of calibrate and validate share: an arm with a lag, logs and a calibration of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import stiffopt
from stiffopt.cli.main import main
from stiffopt.logs import Log, write_log
from stiffopt.model.description import RobotDescription
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description

LAG = 0.4  # s
TRUTH = {
    "segments[0].material.youngs_modulus": 88e3,
    "segments[0].corrections.gain[0]": 1.05,
    "segments[0].corrections.gain[1]": 0.97,
}
FIGURES = {
    *("errors_over_time.png", "errors_over_pressure.png", "paths.png", "tip_over_time.png"),
}
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


def logs_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two logs, and one that goes beyond them."""
    path = tmp_path_factory.mktemp("logs")
    for name, log in (
        ("monday.csv", recorded(0)),
        ("tuesday.csv", recorded(1)),
        ("high.csv", recorded(2, highest=1.5e5)),
    ):
        write_log(path / name, log)
    return path


@pytest.fixture(scope="module", name="folder")
def folder_fixture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`logs_folder`, and what a calibration with a report makes of the two.

    Everything that reads only shares it.
    """
    path = logs_folder(tmp_path_factory)
    code = main(
        ["calibrate", "--robot", "stiff-flop-1", str(path / "monday.csv"),
         str(path / "tuesday.csv"), "--out", str(path / "fitted.yaml"),
         "--report", str(path / "report"), "--quiet", *FAST]
    )  # fmt: skip
    assert code == 0
    return path


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""
    capsys.readouterr()
    code = main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return code, out, err
