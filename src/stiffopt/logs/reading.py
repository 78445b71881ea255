"""Reads a log from CSV (log v1)."""

from __future__ import annotations

import os

import numpy as np

from stiffopt.errors import FileError
from stiffopt.logs.layout import LogLayout
from stiffopt.logs.log import Array, Body, Log
from stiffopt.logs.table import read_table

__all__ = ["log_of_values", "read_log"]


def read_log(path: str | os.PathLike[str]) -> Log:
    """Read a log from CSV (log v1).

    Parameters
    ----------
    path :
        CSV in SI units with the columns ``time_s``, ``p1_pa`` ..., ``tip_x_m``, ``tip_y_m``,
        ``tip_z_m``, and if they were recorded ``pm1_pa`` ..., ``tip_qw`` ... ``tip_qz``, the same
        of other bodies, ``force_n`` and ``stage_m``. An empty field is a missing value.

    Raises
    ------
    FileError
        It cannot be read, a column is missing or unknown, a row has too few or too many fields, a
        field is no finite number, or time does not increase. It names the line.
    """
    table = read_table(path)
    layout = LogLayout.of_columns(table.path, table.columns)
    time = table["time_s"]
    for index in np.flatnonzero(np.isnan(time)):
        raise FileError(table.path, "time_s is missing", line=int(index) + 2)
    for index in np.flatnonzero(np.diff(time) <= 0):
        raise FileError(
            table.path,
            f"time_s is {time[index + 1]:g} after {time[index]:g}; it must increase",
            line=int(index) + 3,
        )
    order = [table.columns.index(name) for name in layout.columns]
    return log_of_values(table.values[:, order], layout)


def log_of_values(values: Array, layout: LogLayout) -> Log:
    """Return the log whose columns (N, m) are in the order of a layout."""
    taken = 0

    def take(count: int) -> Array:
        nonlocal taken
        taken += count
        return np.ascontiguousarray(values[:, taken - count : taken])

    time, commanded = take(1)[:, 0], take(layout.n)
    measured = take(layout.n) if layout.measured else None
    position, quaternion = take(3), take(4) if layout.tip_quaternion else None
    bodies = {
        name: Body(take(3), take(4) if turns else None) for name, turns in layout.bodies.items()
    }
    return Log(
        time=time,
        commanded=commanded,
        measured=measured,
        tip_position=position,
        tip_quaternion=quaternion,
        bodies=bodies,
        force=take(1)[:, 0] if layout.force else None,
        stage=take(1)[:, 0] if layout.stage else None,
    )
