"""Which poses a calibration suggests to record next, and the files that it writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stiffopt.errors import InputError
from stiffopt.experiments.poses import load_poses, save_poses
from stiffopt.identify.suggestion import suggest_poses
from stiffopt.model.calibration import Calibration, ErrorModel, FittedParameter, RelativeErrors
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description

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

    def changed(key: str, step: float) -> Manipulator:
        parameter = Parameter(key)
        value = parameter.at(parameter.value(robot), step)
        return Manipulator(with_values(robot, {parameter: value}))

    pairs = [[changed(key, step) for step in (1e-4, -1e-4)] for key in KEYS]

    def slopes(p: np.ndarray) -> np.ndarray:
        columns = []
        for pair in pairs:
            ends = [each.tip_pose(p)[:3, 3] for each in pair]
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
        told = RelativeErrors(np.vstack([errors.recorded, pose]), errors.range)
        variance = errors.discrepancy**2 * growth + errors.gain**2 * told.variances(everywhere)
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
    with pytest.raises(InputError, match="has no model of its prediction errors"):
        suggest_poses(load_description("stiff-flop-1"))


# -- the file ---------------------------------------------------------------------------------


def test_a_file_of_poses_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "next.yaml"
    save_poses(path, str(RIG), [[1e4, 2e4, 0.0], [0.0, 0.0, 5e4]])
    read = load_poses(path)
    assert read.pressures == ((1e4, 2e4, 0.0), (0.0, 0.0, 5e4))
    assert (tmp_path / read.rig).resolve() == RIG
