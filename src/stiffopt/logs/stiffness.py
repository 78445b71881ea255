"""Tables of measured stiffness (CSV): results of the stiffness experiment, input of calibration."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from io import StringIO
from itertools import count
from math import isfinite, nan

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import FileError, InputError, shown
from stiffopt.logs.log import check_shapes
from stiffopt.logs.table import read_bytes, replacing

BOUNDARIES = ("free", "guided", "clamped")
_DIRECTION = ("direction_x", "direction_y", "direction_z")
_VALUES = ("stiffness_n_per_m", "sigma_n_per_m")


@dataclass(frozen=True, eq=False)
class StiffnessTable:
    """Measured stiffnesses of the tip, each along a direction.

    Attributes
    ----------
    pressures : commanded gauge pressures (N, n), in Pa.
    directions : unit vectors (N, 3) in the base frame.
    boundaries : ``free``, ``guided`` or ``clamped``, for each row.
    stiffness : (N,), in N/m; NaN where the measurement failed.
    sigma : standard uncertainty (N,) of `stiffness`, in N/m.
    others : further columns (N,), by name.
    """

    pressures: Array
    directions: Array
    boundaries: tuple[str, ...]
    stiffness: Array
    sigma: Array
    others: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(self.stiffness)
        if self.pressures.ndim != 2 or not self.pressures.shape[1]:
            raise InputError("a table of stiffness needs pressures (N, n)")
        check_shapes(
            {
                "boundaries": (np.array(self.boundaries), (count,)),
                "pressures": (self.pressures, (count, self.n)),
                "directions": (self.directions, (count, 3)),
                "sigma": (self.sigma, (count,)),
                **{name: (values, (count,)) for name, values in self.others.items()},
            }
        )

    def __len__(self) -> int:
        return len(self.stiffness)

    @property
    def n(self) -> int:
        """Number of channels."""
        return int(self.pressures.shape[1])


def write_stiffness_table(path: str | os.PathLike[str], table: StiffnessTable) -> None:
    """Write a table as CSV, replacing an existing file."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    pressures = [f"p{k + 1}_pa" for k in range(table.n)]
    writer.writerow([*pressures, *_DIRECTION, "boundary", *_VALUES, *table.others])
    columns = [*table.pressures.T, *table.directions.T, table.boundaries]
    columns += [table.stiffness, table.sigma, *table.others.values()]
    writer.writerows(map(_text, row) for row in zip(*columns, strict=True))
    with replacing(path) as part, open(part, "w", encoding="utf-8", newline="") as stream:
        stream.write(text.getvalue())


def read_stiffness_table(path: str | os.PathLike[str]) -> StiffnessTable:
    """Read a table of stiffness.

    Parameters
    ----------
    path :
        CSV with the columns ``p1_pa`` ..., ``direction_x``, ``direction_y``, ``direction_z``,
        ``boundary``, ``stiffness_n_per_m``, ``sigma_n_per_m`` and any further numeric columns.

    Raises
    ------
    FileError
        It cannot be read, a column is missing, or a field is wrong; with the line.
    """
    name = os.fspath(path)
    try:
        text = read_bytes(name).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FileError(name, "is not UTF-8 text") from None
    lines = list(csv.reader(StringIO(text, newline="")))
    if not lines:
        raise FileError(name, "is empty; expected a row of names", line=1)
    columns = [column.strip() for column in lines[0]]
    n = max(1, next(k for k in count() if f"p{k + 1}_pa" not in columns))
    pressures = [f"p{k + 1}_pa" for k in range(n)]
    needed = [*pressures, *_DIRECTION, "boundary", *_VALUES]
    for column in needed:
        if columns.count(column) != 1:
            how = "there twice" if column in columns else "missing"
            raise FileError(name, f"the column '{column}' is {how}", line=1)
    rows = []
    for line, fields in enumerate(lines[1:], start=2):
        try:
            rows.append(_checked_row(columns, fields))
        except ValueError as error:
            raise FileError(name, str(error), line=line) from None
    numbers = {
        column: np.array([row[column] for row in rows], dtype=float)
        for column in columns
        if column != "boundary"
    }

    def stacked(names: Sequence[str]) -> Array:
        return np.stack([numbers[each] for each in names], axis=1)

    return StiffnessTable(
        pressures=stacked(pressures),
        directions=stacked(_DIRECTION),
        boundaries=tuple(str(row["boundary"]) for row in rows),
        stiffness=numbers[_VALUES[0]],
        sigma=numbers[_VALUES[1]],
        others={key: value for key, value in numbers.items() if key not in needed},
    )


def _checked_row(columns: list[str], fields: list[str]) -> dict[str, float | str]:
    """Return a row of a table by its columns; raise `ValueError` if it is wrong."""
    if len(fields) != len(columns):
        raise ValueError(f"expected {len(columns)} fields, found {len(fields)}")
    row: dict[str, float | str] = {}
    for column, text in zip(columns, map(str.strip, fields), strict=True):
        needed = column.endswith("_pa") or column in _DIRECTION
        if column != "boundary":
            row[column] = _number(column, text) if text or needed else nan
        elif text in BOUNDARIES:
            row[column] = text
        else:
            raise ValueError(f"{shown(text)} is not one of {', '.join(BOUNDARIES)}")
    norm = float(np.linalg.norm([float(row[column]) for column in _DIRECTION]))
    if abs(norm - 1) > 1e-3:
        raise ValueError(f"the direction has length {norm:.4g}; expected 1")
    if float(row["sigma_n_per_m"]) < 0:
        raise ValueError("sigma_n_per_m is negative")
    return row


def _number(column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = nan
    if not isfinite(value):
        raise ValueError(f"{column}: {shown(text)} is not a finite number")
    return value


def _text(value: float | str) -> str:
    if isinstance(value, str):
        return value
    return f"{value:.9g}" if isfinite(value) else ""
