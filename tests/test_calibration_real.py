"""Calibrations of real arms from their recordings, and what they predict of others."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from recordings import ASU, UCL, needs_asu, needs_ucl
from stiffopt.identify.calibration import CalibrationResult, calibrate
from stiffopt.identify.results import Errors, together
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.identify.validation import validate
from stiffopt.logs import Log, read_log
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.robot_files import load_description

Array = NDArray[np.float64]

MM = 1e-3
TRAINING = "run_2022-09-29_14-38-33.csv"
BARS = {  # mean and 95 % of the errors on other runs of the day, in m
    "run_2022-09-29_15-07-52.csv": (0.9 * MM, 1.8 * MM),
    "run_2022-09-29_11-26-13.csv": (1.3 * MM, 2.3 * MM),
}


@cache
def ucl_log(name: str) -> Log:
    (path,) = (path for path in UCL if path.name == name)
    return read_log(path)


@cache
def ucl_result(structure: str) -> CalibrationResult:
    told = CalibrationSettings(structure=structure, rows=600, trial_rows=100, strain_law="keep")
    if structure == "auto":
        told = CalibrationSettings()
    robot = load_description("ucl-stiff-flop")
    return calibrate(robot, [(TRAINING, ucl_log(TRAINING))], settings=told)


def check_ucl(result: CalibrationResult) -> None:
    logs = [(name, ucl_log(name)) for name in BARS]
    for found, (mean, p95) in zip(validate(result.robot, logs), BARS.values(), strict=True):
        assert found.errors.n > 1000
        assert found.errors.mean < mean, found.name
        assert found.errors.p95 < p95, found.name
    assert result.calibrated[0].errors.mean < 0.7 * MM
    assert result.nominal[0].errors.mean > 10 * MM


@needs_ucl
def test_one_run_predicts_the_others_of_the_day() -> None:
    check_ucl(ucl_result("progressive"))


@needs_ucl
@pytest.mark.long
def test_one_run_predicts_the_others_of_the_day_with_the_model_of_its_choice() -> None:
    check_ucl(ucl_result("auto"))


@needs_ucl
def test_rows_beyond_what_was_recorded_are_told() -> None:
    robot = ucl_result("progressive").robot
    inside, log = (ucl_log(name) for name in (TRAINING, "run_2022-09-29_15-07-52.csv"))
    (found,) = validate(robot, [("itself", inside)])
    assert found.inside.all()
    beyond = Log(log.time, 1.3 * log.commanded, log.tip_position)
    (found,) = validate(robot, [("beyond", beyond)])
    assert 0.1 < np.mean(~found.inside) < 1
    assert found.outside.n == (~found.inside).sum()


@needs_ucl
@pytest.mark.parametrize("structure", ["progressive", pytest.param("auto", marks=pytest.mark.long)])
def test_beyond_what_was_recorded_predictions_stay_physical(structure: str) -> None:
    p = ucl_log(TRAINING).commanded[200::40]
    arms = [Manipulator(ucl_result(each).robot) for each in (structure, "lag")]
    radii = np.array(
        [
            [np.linalg.norm(arm.tip_pose(share * p)[:, :2, 3], axis=1) for arm in arms]
            for share in (0.9, 1.0, 1.1, 1.2, 1.3)
        ]
    )  # by share, arm and row
    grows = np.diff(radii[:, 0], axis=0)
    assert grows.min() > 0
    own, plain = radii[:, 0].mean(axis=1), radii[:, 1].mean(axis=1)
    assert own[1] == pytest.approx(plain[1], rel=0.1)
    assert own[-1] == pytest.approx(plain[-1], rel=0.25)
    assert np.abs(radii[-1, 0] / radii[-1, 1] - 1).max() < 0.4
    heights = [arm.tip_pose(1.3 * p)[:, 2, 3] for arm in arms]
    assert np.abs(heights[0] - heights[1]).max() < 0.15 * 58 * MM


@cache
def asu_result(short: bool) -> CalibrationResult:
    told = CalibrationSettings(structure="channel-hysteresis", sequence=True, strain_law="keep")
    if short:
        told = told.model_copy(update={"rows": 100, "trial_rows": 50})
    logs = [(path.name, read_log(path)) for path in ASU]
    return calibrate(load_description("asu-two-segment"), logs, settings=told)


def held_back(result: CalibrationResult) -> float:
    return float(np.mean([errors.mean for errors in result.held_back.values()]))


def errors_of(result: CalibrationResult) -> Errors:
    found = together(result.calibrated)
    assert found.angle is not None
    return found


@needs_asu
def test_two_segments_from_logs_that_follow_each_other() -> None:
    result = asu_result(short=True)
    assert len(result.held_back) == 7
    assert held_back(result) < 13 * MM
    assert errors_of(result).mean < 8 * MM
    assert max(np.degrees(c.errors.angle or 90) for c in result.calibrated) < 10
    assert together(result.nominal).mean > 25 * MM
    unturned = [remark for remark in result.remarks if "flips" in remark]
    assert unturned  # of the nearly symmetric bodies


@needs_asu
@pytest.mark.long
def test_two_segments_from_all_rows_of_logs_that_follow_each_other() -> None:
    result = asu_result(short=False)
    assert held_back(result) < 11 * MM
    assert errors_of(result).mean < 6.5 * MM
    assert max(np.degrees(c.errors.angle or 90) for c in result.calibrated) < 10
