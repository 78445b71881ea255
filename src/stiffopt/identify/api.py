"""Calibrate and validate by the names of robots and the paths of recordings."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from stiffopt.errors import InputError
from stiffopt.identify import calibration, validation
from stiffopt.identify.calibration import CalibrationResult
from stiffopt.identify.comparison import Comparison
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.logs import Log, StiffnessTable, read_log, read_mcap_log, read_stiffness_table
from stiffopt.model.arm import Arm
from stiffopt.model.description import RobotDescription
from stiffopt.model.robot_files import load_description

__all__ = ["LogSource", "RobotSource", "TableSource", "calibrate", "validate"]

_Path = str | os.PathLike[str]
RobotSource = _Path | RobotDescription | Arm
"""A built-in robot's name, the path of a robot file, a description or a `Manipulator`."""
LogSource = _Path | Log | tuple[str, Log]
"""The path of a log (CSV or ``.mcap``), a log, or a log and what to call it."""
TableSource = _Path | StiffnessTable
"""The path of a table of measured stiffness, or the table."""


def calibrate(
    robot: RobotSource,
    logs: Sequence[LogSource] = (),
    tables: Sequence[TableSource] = (),
    settings: CalibrationSettings | None = None,
    progress: Callable[[float, float, str], None] | None = None,
) -> CalibrationResult:
    """Fit a robot to recordings.

    Parameters
    ----------
    robot : str, path, RobotDescription or Manipulator
        Where the fit begins; its tolerances say how far it may be expected to go.
    logs : sequence of path, Log or (name, Log)
        In the order in which they were recorded.
    tables : sequence of path or StiffnessTable
        Measured stiffness, fitted together with the logs.
    settings : CalibrationSettings, optional
    progress : callable, optional
        Is told what is done, of how much, and in words.

    Returns
    -------
    The result; `stiffopt.save_robot` writes its `robot` to a file, `stiffopt.load_robot` makes it a
    `Manipulator`.

    Raises
    ------
    InputError
        There is nothing to fit, or a log is not usable; it names the log.
    FileError
        A file cannot be read or is wrong.
    EquilibriumError
        An arm under gravity buckles on the way.
    """
    read = [
        table if isinstance(table, StiffnessTable) else read_stiffness_table(table)
        for table in tables
    ]
    return calibration.calibrate(_description(robot), _named(logs), read, settings, progress)


def validate(
    robot: RobotSource,
    logs: Sequence[LogSource],
    settings: CalibrationSettings | None = None,
    progress: Callable[[float, float, str], None] | None = None,
) -> tuple[Comparison, ...]:
    """Run a robot along recordings and compare; nothing of the robot is fitted.

    Parameters
    ----------
    robot : str, path, RobotDescription or Manipulator
    logs : sequence of path, Log or (name, Log)
        In the order in which they were recorded.
    settings : CalibrationSettings, optional
        How logs are read; what is fitted has no effect here.
    progress : callable, optional
        Is told what is done, of how much, and in words.

    Raises
    ------
    InputError
        A log is not usable; it names the log.
    FileError
        A file cannot be read or is wrong.
    """
    return validation.validate(_description(robot), _named(logs), settings, progress)


def _description(robot: RobotSource) -> RobotDescription:
    if isinstance(robot, RobotDescription):
        return robot
    return robot.description if isinstance(robot, Arm) else load_description(robot)


def _named(logs: Sequence[LogSource]) -> list[tuple[str, Log]]:
    """Logs with their names: those of the files, with their folders where files share a name."""
    if isinstance(logs, str):
        raise InputError("expected a list of logs, not one path")
    files = Counter(Path(log).name for log in logs if isinstance(log, str | os.PathLike))
    found = []
    for number, log in enumerate(logs, start=1):
        if isinstance(log, Log):
            found.append((f"log {number}", log))
        elif isinstance(log, tuple):
            found.append(log)
        else:
            path = Path(log)
            read = read_mcap_log if path.suffix == ".mcap" else read_log
            found.append((path.name if files[path.name] == 1 else str(path), read(path)))
    return found
