"""Convert the solution of a path to data: JSON, CSV, or an entry of a result file."""

from __future__ import annotations

from math import degrees
from typing import Any, NamedTuple

import numpy as np

from stiffopt.arrays import Array
from stiffopt.cli.console import plain_data
from stiffopt.paths.motion_file import LEANING, POSITION_ERROR
from stiffopt.paths.path import Path
from stiffopt.paths.rates import step_limits
from stiffopt.paths.solution import PathSolution
from stiffopt.units import unit_suffix


class SolvedPath(NamedTuple):
    """A path file as the user named it, the path, and its solution."""

    file: str
    path: Path
    solution: PathSolution


def rate_margins(solution: PathSolution) -> Array | None:
    """Return the unused share of the rate of the fastest channel on the way to each point.

    Returns
    -------
    (N,) array or None
        1 where nothing moves (and at the first point), 0 at the limit, negative beyond it; None
        if no rates are known.
    """
    if solution.slew is None or not len(solution.times):
        return None
    used = np.abs(np.diff(solution.pressures, axis=0)) / step_limits(solution.times, solution.slew)
    return np.concatenate([[1.0], 1.0 - used.max(axis=1)])


def json_record(solved: SolvedPath) -> dict[str, Any]:
    """Return a solution for JSON, in SI units."""
    return {"path": solved.file, **solution_values(solved.solution)}


def solution_values(solution: PathSolution) -> dict[str, Any]:
    """Return the values of a solution, in SI units."""
    return {
        "status": solution.status,
        "found": solution.found,
        "times_s": solution.times,
        "pressures_pa": solution.pressures,
        "tip_position_m": solution.tip_poses[:, :3, 3],
        "position_error_m": solution.position_errors,
        "angle_error_rad": solution.angle_errors,
        "stiffness": solution.stiffness,
        "stiffness_alone": solution.alone,
        "stiffness_unit": solution.stiffness_unit,
        "clearance_m": solution.clearance,
        "slew_pa_per_s": solution.slew,
        "worst_index": solution.worst_index,
        "first_failure": solution.first_failure,
        "confidence": solution.confidence,
        "solve_time_s": solution.timings.get("total"),
        "message": solution.message,
    }


def csv_text(solution: PathSolution) -> str:
    """Return a solution as CSV in SI units, a row for each point, without absent quantities."""
    channels = range(solution.pressures.shape[1]) if len(solution.times) else ()
    stiffness = f"stiffness{unit_suffix(solution.stiffness_unit or '')}"
    missing = np.full(len(solution.times), np.nan)
    columns: dict[str, Any] = {
        "time_s": solution.times,
        **{f"p{k + 1}_pa": solution.pressures[:, k] for k in channels},
        **{f"tip_{axis}_m": solution.tip_poses[:, k, 3] for k, axis in enumerate("xyz")},
        POSITION_ERROR: missing if solution.position_errors is None else solution.position_errors,
        "angle_error_rad": solution.angle_errors,
        stiffness: solution.stiffness,
        "clearance_m": solution.clearance,
        LEANING: solution.leans.astype(float) if solution.equilibria else None,
    }
    columns = {name: values for name, values in columns.items() if values is not None}
    rows = np.column_stack(list(columns.values())).tolist()
    lines = [",".join("" if value != value else f"{value:.9g}" for value in row) for row in rows]
    return "\n".join([",".join(columns), *lines, ""])


def result_record(solved: SolvedPath) -> dict[str, Any]:
    """Return a solution as the entry of a result file."""
    return {"path": solved.file, **solution_quantities(solved.solution)}


def solution_quantities(solution: PathSolution) -> dict[str, Any]:
    """Return the values of a solution as text with units, to seven digits."""
    description = solution.robot.description
    unit = solution.stiffness_unit or ""
    channels = range(solution.pressures.shape[1]) if len(solution.times) else ()
    record: dict[str, Any] = {
        "robot": description.name,
        "status": solution.status,
        "message": solution.message or None,
        "confidence": solution.confidence or None,
        "worst_index": solution.worst_index,
        "first_failure": solution.first_failure,
        "slew": _quantities(solution.slew, "bar/s", 1e-5),
        "times": _quantities(solution.times, "s"),
        "pressures": {
            description.channel_name(k): _quantities(solution.pressures[:, k], "bar", 1e-5)
            for k in channels
        },
        "tip": {
            axis: _quantities(solution.tip_poses[:, k, 3], "mm", 1e3)
            for k, axis in enumerate("xyz")
        },
        "position_error": _quantities(solution.position_errors, "mm", 1e3),
        "angle_error": _quantities(solution.angle_errors, "deg", degrees(1)),
        "stiffness": _quantities(solution.stiffness, unit),
        "stiffness_alone": _quantities(solution.alone, unit),
        "clearance": _quantities(solution.clearance, "mm", 1e3),
        LEANING: solution.leans.tolist() if solution.equilibria else None,
        "solve_time": f"{solution.timings.get('total', 0.0):.4g} s",
    }
    return {key: value for key, value in record.items() if value not in (None, [], {})}


def _quantities(values: Array | None, unit: str, per_si: float = 1.0) -> list[str | None] | None:
    """Return quantities as text in a unit; an SI unit has `per_si` of it. None: no number."""
    if values is None:
        return None
    return [
        None if value is None else f"{value * per_si + 0.0:.7g} {unit}"
        for value in plain_data(values)
    ]
