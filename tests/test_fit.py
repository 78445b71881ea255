"""Calibrations of arms that are known: what is found, how well, and what is said about it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from made_logs import course, made_log, reddened
from stiffopt import lie
from stiffopt.errors import EquilibriumError, InputError
from stiffopt.identify.calibration import CalibrationResult, calibrate
from stiffopt.identify.fit import Fit, fit
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.identify.setup import Setup
from stiffopt.identify.structure import STRUCTURES
from stiffopt.identify.validation import recordings_of, validate
from stiffopt.logs import Log, StiffnessTable
from stiffopt.model.description import RobotDescription, Tolerances
from stiffopt.model.history import History, Play
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description

Array = NDArray[np.float64]

KPA = 1e3
ONE = load_description("stiff-flop-1")
HANGING = load_description("stiff-flop-2-hanging")
TRUE_VALUES = {
    "segments[0].length": 0.0925,
    "segments[0].material.youngs_modulus": 1.15e5,
    "segments[0].compensation.area": 1.1,
    "segments[0].corrections.gain[0]": 1.05,
    "segments[0].corrections.gain[2]": 0.96,
    "segments[0].corrections.azimuth[1]": 0.06,
}
HISTORIES = {
    "static": None,
    "lag": History(lag=0.5),
    "hysteresis": History(
        lag=0.5, play=(Play(width=5 * KPA, share=0.1), Play(width=20 * KPA, share=0.2))
    ),
}
BASE = np.asarray(lie.exp(np.array([2e-3, -3e-3, 4e-3, 0.03, -0.02, 0.08])))
BY_NAME = {structure.name: structure for structure in STRUCTURES}


def with_history(robot: RobotDescription, history: History | None) -> RobotDescription:
    segments = tuple(s.model_copy(update={"history": history}) for s in robot.segments)
    return robot.model_copy(update={"segments": segments})


def true_robot(kind: str) -> RobotDescription:
    values = {Parameter(key): value for key, value in TRUE_VALUES.items()}
    return with_history(with_values(ONE, values), HISTORIES[kind])


def settings(structure: str, **others: object) -> CalibrationSettings:
    usual: dict[str, object] = {"rows": 400, "trial_rows": 150, "strain_law": "keep"}
    return CalibrationSettings(structure=structure, **{**usual, **others})  # type: ignore[arg-type]


@cache
def log_of(kind: str, seed: int = 1, duration: float = 90.0, **others: object) -> Log:
    time, pressures = course(3, duration, seed)
    given = {"base": BASE, "noise": 3e-4, **others}
    return made_log(true_robot(kind), time, pressures, seed=seed, **given)  # type: ignore[arg-type]


@cache
def result_of(kind: str, structure: str) -> CalibrationResult:
    return calibrate(ONE, [("a.csv", log_of(kind))], settings=settings(structure))


def true_value(key: str, kind: str) -> float:
    return Parameter(key).value(true_robot(kind))


# -- what is found --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", HISTORIES)
def test_a_known_robot_is_found(kind: str) -> None:
    result = result_of(kind, kind)
    noise = 3e-4 * np.sqrt(8 / np.pi)  # mean norm of three normal errors
    assert result.nominal[0].errors.mean > 5e-3
    assert result.calibrated[0].errors.mean < 1.15 * noise
    listed = [e for e in result.estimates if e.key and ".play" not in e.key]
    inside = [e.low <= true_value(e.key, kind) <= e.high for e in listed]
    assert np.mean(inside) > 0.85
    for key in ("length", "material.youngs_modulus", "compensation.area"):
        (found,) = (e for e in listed if e.key == f"segments[0].{key}")
        assert found.value == pytest.approx(TRUE_VALUES[found.key], rel=0.03)
        assert found.value == pytest.approx(Parameter(found.key).value(result.robot), rel=1e-6)
        assert found.before == Parameter(found.key).value(ONE)


@pytest.mark.parametrize("kind", HISTORIES)
def test_it_predicts_another_day(kind: str) -> None:
    robot = result_of(kind, kind).robot
    (found,) = validate(robot, [("b.csv", log_of(kind, seed=2, duration=40.0))])
    assert found.errors.mean < 0.8e-3
    assert found.errors.n == 400
    (before,) = validate(ONE, [("b.csv", log_of(kind, seed=2, duration=40.0))])
    assert before.errors.mean > 5e-3


def test_registration_is_found_with_orientations() -> None:
    sensor = np.asarray(lie.exp(np.array([2e-3, -1e-3, 1e-3, 0.04, -0.05, 0.03])))
    time, pressures = course(3, 60.0, 1)
    log = made_log(true_robot("lag"), time, pressures, base=BASE, sensor=sensor, turns=True)
    result = calibrate(ONE, [("a.csv", log)], settings=settings("lag"))
    assert result.robot.recordings is not None
    registration = result.robot.recordings.registration
    T = Manipulator(true_robot("lag")).tip_pose([0.0, 5e4, 2e4])
    read = BASE @ T @ sensor
    own = Manipulator(result.robot).tip_pose([0.0, 5e4, 2e4])
    back = registration.tracker_in_base.transform() @ read @ registration.tip_in_sensor.transform()
    assert back[:3, 3] == pytest.approx(own[:3, 3], abs=3e-4)
    assert back[:3, :3] == pytest.approx(own[:3, :3], abs=0.01)
    assert result.calibrated[0].errors.angle is not None
    assert result.nominal[0].errors.angle is not None
    assert result.calibrated[0].errors.angle < 0.2 * result.nominal[0].errors.angle
