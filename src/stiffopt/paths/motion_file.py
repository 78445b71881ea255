"""Read motions from files that ``--out`` of `stiffopt path` and `stiffopt plan` wrote."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.documents import read_document
from stiffopt.errors import FileError, InputError
from stiffopt.logs.table import read_bytes, read_table
from stiffopt.model.description import RobotDescription
from stiffopt.paths.solution import LEANS
from stiffopt.paths.trajectory import Trajectory, trajectory_through
from stiffopt.units import parse_quantity

RESULT_FORMAT = "stiffopt-path-result/1"
"""Format of a result file of paths and motions."""

_NO_MOTION = "is not a motion; expected what 'stiffopt path --out' or 'plan --out' wrote"

LEANING = "leaning"
"""Column or key that says at which points the arm is in contact."""

POSITION_ERROR = "position_error_m"
"""A column that no log has; it identifies a solution."""


@dataclass(frozen=True, eq=False)
class MotionTable:
    """A motion: pressures over time."""

    file: str  # from which it was read
    times: Array  # (N,), in s, increasing
    pressures: Array  # (N, n), in Pa; linear between two times
    tips: Array  # (N, 3), positions of the tip in the base frame, in m

    def trajectory(self, ranges: Array, begin: float) -> Trajectory:
        """Return the trajectory for a control loop.

        `ranges`: (n,), ranges of the pressures, in Pa; see `trajectory_through`. `begin`: time of
        the first point, in s. Raises `FileError`: it has too many points.
        """
        try:
            return trajectory_through(self.times, self.pressures, self.tips, ranges, begin)
        except InputError as error:
            raise FileError(self.file, f"cannot be played: {error}") from None


def is_motion_csv(file: str | os.PathLike[str]) -> bool:
    """Return whether a file is the CSV of a solution, rather than a log."""
    return POSITION_ERROR.encode() in read_bytes(file).partition(b"\n")[0].split(b",")


def read_motion(file: str | os.PathLike[str], description: RobotDescription) -> MotionTable:
    """Read a motion of a robot: CSV, or a result file with one result.

    Raises `FileError`: the file cannot be read, holds no complete motion, one of another robot, or
    one that leans on objects.
    """
    name = os.fspath(file)
    if name.lower().endswith(".csv"):
        motion = _of_csv(name, description)
    else:
        motion = _of_result(name, description)
    if len(motion.times) < 2:
        raise FileError(name, "has too few points with pressures to play; expected two or more")
    columns = np.column_stack([motion.times, motion.pressures, motion.tips])
    if not np.isfinite(columns).all() or not (np.diff(motion.times) > 0).all():
        raise FileError(name, "has numbers that are missing, or times that do not increase")
    return motion


def _of_csv(name: str, description: RobotDescription) -> MotionTable:
    table = read_table(name)
    n = description.n_pressures
    wanted = ["time_s", *(f"p{k + 1}_pa" for k in range(n)), *(f"tip_{a}_m" for a in "xyz")]
    missing = [each for each in wanted if each not in table.columns]
    if missing:
        raise FileError(
            name,
            f"is not a motion of '{description.name}', which has {n} channels: there is no column "
            f"{missing[0]}",
        )
    if f"p{n + 1}_pa" in table.columns:
        raise FileError(name, f"has more channels than '{description.name}'")
    if POSITION_ERROR not in table.columns:
        raise FileError(name, _NO_MOTION)
    if LEANING in table.columns and table[LEANING].any():
        raise FileError(name, LEANS)
    values = np.column_stack([table[each] for each in wanted])
    return MotionTable(name, values[:, 0] - values[0, 0], values[:, 1 : n + 1], values[:, n + 1 :])


def _of_result(name: str, description: RobotDescription) -> MotionTable:
    data = read_document(name).data
    results = data.get("results")
    if not isinstance(results, list) or data.get("format") != RESULT_FORMAT:
        raise FileError(name, _NO_MOTION)
    if len(results) != 1:
        raise FileError(name, f"has {len(results)} results; expected one")
    result: dict[str, Any] = results[0]
    if result.get("status") != "solved":
        raise FileError(name, f"is not solved: {result.get('message', result.get('status'))}")
    if result.get("robot") != description.name:
        raise FileError(name, f"is for the robot '{result.get('robot')}'; this is another one")
    if any(result.get(LEANING) or ()):
        raise FileError(name, LEANS)
    try:
        times = _si(result["times"], "s", "time")
        pressures = [_si(each, "Pa", "pressure") for each in result["pressures"].values()]
        tips = [_si(result["tip"][axis], "m", "length") for axis in "xyz"]
        motion = MotionTable(name, times, np.stack(pressures, axis=1), np.stack(tips, axis=1))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FileError(name, f"is no whole result: {error}") from None
    if motion.pressures.shape[1] != description.n_pressures:
        raise FileError(name, f"has other channels than '{description.name}'")
    return motion


def _si(values: list[str], unit: str, what: str) -> Array:
    return np.array([parse_quantity(value, unit, what) for value in values])
