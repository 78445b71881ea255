"""What `calibrate` and `validate` read: the robot, recordings of it and tables of stiffness."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stiffopt.cli import quantities
from stiffopt.errors import FileError, InputError, require_package, shown
from stiffopt.identify.settings import CalibrationSettings
from stiffopt.identify.structures import STRUCTURES
from stiffopt.identify.unknowns import history_unknowns, shape_unknowns
from stiffopt.logs import (
    Log,
    StiffnessTable,
    read_log,
    read_mcap_log,
    read_stiffness_table,
)
from stiffopt.model.description import Recordings, RobotDescription, Tolerances
from stiffopt.model.robot_files import load_description

_MCAP = ".mcap"
_SEGMENT = re.compile(r"segments\[\d+\]\.")


@dataclass(frozen=True)
class RecordingOptions:
    """Options of both commands: which robot, which recordings of it, and how these are read."""

    robot: str
    logs: tuple[str, ...]
    sequence: bool
    rezero: bool
    pressures: str
    channels: str | None
    frame: str | None

    def settings(self, **others: Any) -> CalibrationSettings:
        """Return the settings of a calibration that these options and others make.

        Raises
        ------
        InputError
            The option --pressures is neither ``commanded`` nor ``measured``.
        """
        quantities.choice("--pressures", self.pressures, ("commanded", "measured"))
        given = {"sequence": self.sequence, "rezero": self.rezero, "pressures": self.pressures}
        return CalibrationSettings(**given, **others)

    def description(self) -> RobotDescription:
        """Return the robot, with the channels and the frame that the options name.

        Raises
        ------
        InputError
            There is no such robot, or its file or --channels is wrong.
        """
        robot = load_description(self.robot)
        change: dict[str, Any] = {}
        if self.channels is not None:
            change["channels"] = quantities.channels("--channels", self.channels)
            if len(change["channels"]) != robot.n_pressures:
                raise InputError(
                    f"--channels: {shown(self.channels)} names {len(change['channels'])} columns, "
                    f"the robot '{robot.name}' has {robot.n_pressures} channels; expected one for "
                    "each"
                )
        if self.frame is not None:
            change["frame"] = self.frame
        if not change:
            return robot
        recordings = (robot.recordings or Recordings()).model_copy(update=change)
        return robot.model_copy(update={"recordings": recordings})

    def read(
        self, robot: RobotDescription, progress: Callable[[float, float, str], None]
    ) -> list[tuple[str, Log]]:
        """Return the logs and their names: those of the files, with folders where they need them.

        Raises
        ------
        InputError
            A log cannot be read, or has other channels than the robot.
        """
        names = log_names(self.logs)
        if any(_is_mcap(path) for path in self.logs):
            require_package("mcap", "log")
        found = []
        for i, (name, path) in enumerate(zip(names, self.logs, strict=True)):
            progress(i, len(names), f"reading {name}")
            log = _read(path)
            _check_channels(path, log, robot)
            found.append((name, log))
        return found


def log_names(paths: Sequence[str]) -> list[str]:
    """Return a name for each file: its own, with as many folders as tell it from the others.

    Raises
    ------
    FileError
        A file is given twice.
    """
    parts = [Path(path).resolve().parts for path in paths]
    for i, each in enumerate(parts):
        if each in parts[:i]:
            raise FileError(paths[i], "is given twice; expected each log once")
    depth = [1] * len(parts)
    while True:
        names = ["/".join(each[-n:]) for each, n in zip(parts, depth, strict=True)]
        same = [i for i, name in enumerate(names) if names.count(name) > 1]
        if not same:
            return names
        for i in same:
            depth[i] += 1


def read_tables(paths: Sequence[str], robot: RobotDescription) -> list[StiffnessTable]:
    """Return tables of stiffness.

    Raises
    ------
    FileError
        One cannot be read, or is of another robot.
    """
    tables = []
    for path in paths:
        table = read_stiffness_table(path)
        if table.pressures.shape[1] != robot.n_pressures:
            raise FileError(
                path,
                f"has {table.pressures.shape[1]} pressures, the robot '{robot.name}' has "
                f"{robot.n_pressures} channels",
            )
        tables.append(table)
    return tables


def check_model(name: str) -> None:
    """Raise `InputError` if there is no model of this name."""
    names = ["auto", *(structure.name for structure in STRUCTURES)]
    if name not in names:
        raise InputError(
            f"--model: there is no model {shown(name)}; expected one of {', '.join(names)}"
        )


def fixed_keys(given: Sequence[str], robot: RobotDescription) -> tuple[str, ...]:
    """Return the parameters that --fix names: by whole keys, without an index, or by their ends.

    Raises
    ------
    InputError
        One of them names no parameter that is fitted.
    """
    known = _fitted_keys(robot)
    found: list[str] = []
    for text in given:
        wanted = text.strip()
        meant = [
            key
            for key in known
            for candidate in (key, _SEGMENT.sub("", key))
            if candidate == wanted or candidate.startswith((f"{wanted}[", f"{wanted}."))
        ]
        if not meant:
            ends = dict.fromkeys(re.sub(r"\[\d+\]", "", _SEGMENT.sub("", key)) for key in known)
            raise InputError(
                f"--fix: {shown(text)} is no parameter of the robot '{robot.name}' that is fitted; "
                f"expected a key such as {known[0]}, or one of {', '.join(ends)} for all of them"
            )
        found += meant
    return tuple(dict.fromkeys(found))


def _fitted_keys(robot: RobotDescription) -> list[str]:
    """Keys of all parameters that some model fits."""
    tolerances = robot.tolerances or Tolerances()
    keys: dict[str, None] = {}
    for structure in STRUCTURES:
        begun = structure.applied(robot, float(max(robot.pressure_max)))
        unknowns = shape_unknowns(begun, structure.shape, tolerances)
        for each in (*unknowns, *history_unknowns(begun, tolerances)):
            if each.parameter is not None:
                keys[each.parameter.key] = None
    return list(keys)


def _is_mcap(path: str) -> bool:
    return path.lower().endswith(_MCAP)


def _read(path: str) -> Log:
    if _is_mcap(path):
        return read_mcap_log(path)
    try:
        return read_log(path)
    except FileError as error:
        try:
            read_stiffness_table(path)
        except FileError:
            raise error from None
        raise FileError(
            path, f"is a table of stiffness, not a log; give it as --stiffness {path}"
        ) from None


def _check_channels(path: str, log: Log, robot: RobotDescription) -> None:
    columns = robot.recordings.channels if robot.recordings is not None else ()
    if columns:
        if max(columns) > log.n:
            raise FileError(
                path,
                f"has no column p{max(columns)}_pa, which --channels or the robot file names; "
                f"there are {log.n} pressures",
            )
    elif log.n != robot.n_pressures:
        example = ",".join(str(c + 1) for c in range(robot.n_pressures))
        raise FileError(
            path,
            f"has {log.n} pressures, the robot '{robot.name}' has {robot.n_pressures} channels; "
            f"say with --channels which column each channel has, such as --channels {example}",
        )
