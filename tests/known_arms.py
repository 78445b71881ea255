"""Arms whose numbers are known, and logs made of them."""

from __future__ import annotations

from functools import cache

import numpy as np

from made_logs import course, made_log
from stiffopt import lie
from stiffopt.identify.calibration import CalibrationResult, calibrate
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.identify.structures import STRUCTURES
from stiffopt.logs import Log
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import History, Play
from stiffopt.model.parameters import Parameter, with_values
from stiffopt.model.robot_files import load_description

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
    usual: dict[str, object] = {
        "rows": 250,
        "trial_rows": 100,
        "strain_law": "keep",
        "holds_back": False,
    }
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
