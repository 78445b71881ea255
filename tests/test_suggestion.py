"""Experiments of given poses, and which poses a calibration suggests."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from stiffopt.cli.main import app
from stiffopt.errors import FileError, InputError
from stiffopt.experiments.poses import PosesSettings, load_poses, poses_for, save_poses
from stiffopt.identify.suggestion import suggest_poses
from stiffopt.logs import read_log
from stiffopt.model.calibration import Calibration, ErrorModel, FittedParameter
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description
from stiffopt.rig.config import load_rig_description
from stiffopt.safety.rigs import rig_for_programs

RIG = Path(__file__).resolve().parent.parent / "rig" / "sim.yaml"
KEYS = ("segments[0].material.youngs_modulus", "segments[0].corrections.gain[1]")


def known_robot(deviations: tuple[float, float] = (0.1, 0.05)) -> RobotDescription:
    """An arm whose first channel alone was recorded."""
    errors = ErrorModel(
        residual=5e-4, discrepancy=2e3, reach=3e4, gain=0.1, degrees_of_freedom=8.0,
        recorded=((0.0, 0.0, 0.0), (4e4, 0.0, 0.0), (8e4, 0.0, 0.0)), spacing=2e4,
    )  # fmt: skip
    parameters = [
        FittedParameter(key=key, deviation=each, prior=0.1)
        for key, each in zip(KEYS, deviations, strict=True)
    ]
    calibration = Calibration(parameters=parameters, correlation=[[1, 0], [0, 1]], errors=errors)
    return load_description("stiff-flop-1").model_copy(update={"calibration": calibration})


# -- what is suggested ------------------------------------------------------------------------


def test_the_next_pose_tells_most() -> None:
    """Against the variance that is left, from the information of a pose and from differences."""
    robot = known_robot()
    suggestion = suggest_poses(robot, 1)
    assert suggestion.after < suggestion.before
    errors = robot.calibration.errors  # type: ignore[union-attr]
    assert errors is not None
    rng = np.random.default_rng(0)
    everywhere = rng.uniform(robot.pressure_min, robot.pressure_max, (150, 3))
    arm = Manipulator(robot)

    def slopes(p: np.ndarray) -> np.ndarray:
        columns = []
        for key in KEYS:
            parameter = Parameter(key)
            ends = [
                Manipulator(with_values(robot, {parameter: parameter.at(
                    parameter.value(robot), step)})).tip_pose(p)[:3, 3]
                for step in (1e-4, -1e-4)
            ]  # fmt: skip
            columns.append((ends[0] - ends[1]) / 2e-4)
        return np.stack(columns, axis=1)

    slopes_everywhere = [slopes(p) for p in everywhere]
    acting = [arm.tip_pose(p)[:3, :3] @ arm.tip_jacobian(p)[:3] for p in everywhere]

    def left(pose: np.ndarray) -> float:
        own = arm.tip_pose(pose)[:3, :3] @ arm.tip_jacobian(pose)[:3]
        reading = errors.residual**2 * np.eye(3) + errors.discrepancy**2 * own @ own.T
        slope = slopes(pose)
        information = np.diag([1 / 0.1**2, 1 / 0.05**2]) + slope.T @ np.linalg.inv(reading) @ slope
        covariance = np.linalg.inv(information)
        total = sum(np.trace(j @ covariance @ j.T) for j in slopes_everywhere)
        away = np.minimum(
            errors.distances([3], everywhere)[:, 0], np.linalg.norm(everywhere - pose, axis=1)
        )
        growth = 1 - np.exp(-2 * away / errors.reach)
        variance = errors.discrepancy**2 * growth + (errors.gain * away) ** 2
        total += sum(v * np.trace(j @ j.T) for v, j in zip(variance, acting, strict=True))
        return float(total)

    others = [left(p) for p in everywhere[:40]]
    assert left(suggestion.pressures[0]) < np.quantile(others, 0.1)


def test_suggestions_keep_to_what_a_rig_allows() -> None:
    high = np.array([0.5e5, 1e5, 0.2e5])
    found = suggest_poses(
        known_robot(), 8, low=np.zeros(3), high=high, is_allowed=lambda p: float(p.sum()) < 1.2e5
    )
    assert found.pressures.shape == (8, 3)
    assert (found.pressures <= high).all()
    assert (found.pressures.sum(axis=1) < 1.2e5).all()
    assert len(np.unique(found.pressures, axis=0)) == 8
    with pytest.raises(InputError, match="there are only 0 poses that the rig allows"):
        suggest_poses(known_robot(), is_allowed=lambda p: False)
    with pytest.raises(InputError, match="does not tell the errors of its predictions"):
        suggest_poses(load_description("stiff-flop-1"))


# -- the file ---------------------------------------------------------------------------------


def test_a_file_of_poses_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "next.yaml"
    save_poses(path, str(RIG), [[1e4, 2e4, 0.0], [0.0, 0.0, 5e4]])
    read = load_poses(path)
    assert read.pressures == ((1e4, 2e4, 0.0), (0.0, 0.0, 5e4))
    assert (tmp_path / read.rig).resolve() == RIG
    assert read.hold == 10.0


@pytest.mark.parametrize(
    ("pressures", "words"),
    [
        ("[[1 bar, 0 bar], [1 bar]]", r"pressures\[1\]: has 1 values; expected 2, as the first"),
        ("[[1, 0, 0]]", r"pressures\[0\]\[0\]"),
        ("[]", "pressures: "),
    ],
)
def test_bad_files_of_poses_are_told(tmp_path: Path, pressures: str, words: str) -> None:
    path = tmp_path / "next.yaml"
    path.write_text(f"format: stiffopt-experiment/1\nrig: r.yaml\npressures: {pressures}\n")
    with pytest.raises(FileError, match=words):
        load_poses(path)


# -- on a rig ---------------------------------------------------------------------------------


def test_poses_beyond_the_rig_are_refused_before_anything_moves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    description = load_rig_description(RIG)
    with rig_for_programs(description, load_description("stiff-flop-1")) as rig:
        high = rig.supply.limits.high

        def refused(*pose: float) -> str:
            settings = PosesSettings(channels=3, pressures=[pose])
            with pytest.raises(InputError) as raised:
                poses_for(rig, settings)
            return str(raised.value)

        assert refused(1e4, 1e4).startswith("the poses have 2 pressures; expected 3")
        assert refused(0.0, high[1] + 1e3, 0.0).startswith("pose 1: channel 2 has 0 to ")
        monkeypatch.setattr(rig, "max_force", 1e-3)
        assert "pose 1 would push with " in (text := refused(5e4, 0.0, 0.0))
        assert text.endswith("safety.max_force of the rig is 0.001 N")


def test_each_pose_is_held_and_recorded(tmp_path: Path) -> None:
    wanted = [[3e4, 0.0, 1e4], [0.0, 2e4, 2e4]]
    path, out = tmp_path / "next.yaml", tmp_path / "second"
    save_poses(path, str(RIG), wanted)
    path.write_text(path.read_text().replace("hold: 10 s", "hold: 3 s"))
    result = CliRunner().invoke(
        app, ["experiment", "poses", str(path), "--out", str(out), "--no-plot", "--json"]
    )
    assert result.exit_code == 0, result.output
    record = json.loads(result.stdout)
    assert record["poses"] == 2
    assert np.array(record["pressures_pa"]) == pytest.approx(np.array(wanted), abs=2e3)
    log = read_log(out / "kinematics_poses_1.csv")
    for pose in wanted:
        at = np.abs(log.commanded - pose).max(axis=1) < 1.0
        assert np.ptp(log.time[at]) == pytest.approx(3.0, abs=0.2)
    assert np.abs(log.commanded[-1]).max() < 1.0
    again = CliRunner().invoke(
        app, ["experiment", "poses", str(path), "--resume", str(out), "--no-plot"]
    )
    assert again.exit_code == 0
    assert "is complete; nothing was left to do" in again.stderr
