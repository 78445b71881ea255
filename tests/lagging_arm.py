"""An arm that lags a little, and logs of it: as they should be, or of a turned tracker."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from made_logs import course, made_log
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.logs import Log
from stiffopt.model.calibration import Calibration
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import History
from stiffopt.model.robot_files import load_description

Array = NDArray[np.float64]

AS_RECORDED = CalibrationSettings()


def arm(name: str = "stiff-flop-1") -> RobotDescription:
    """An arm that lags a little."""
    robot = load_description(name)
    segments = [each.model_copy(update={"history": History(lag=0.2)}) for each in robot.segments]
    return robot.model_copy(update={"segments": tuple(segments)})


def calibrated(robot: RobotDescription) -> RobotDescription:
    return robot.model_copy(update={"calibration": Calibration(logs=("before.csv",))})


def driven(pressures: Array, time: Array, name: str = "stiff-flop-1") -> Log:
    return made_log(arm(name), time, pressures)


@cache
def log_of(name: str = "stiff-flop-1", n: int = 3, duration: float = 60.0, seed: int = 0) -> Log:
    time, pressures = course(n, duration, seed, rate=5.0)
    return driven(pressures, time, name)


def turned(log: Log, rotation: Array) -> Log:
    """The log of a tracker whose axes are turned."""
    return replace(log, tip_position=log.tip_position @ rotation)
