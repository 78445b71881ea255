"""File of all points of a stiffness experiment: series are appended whole, so it can be resumed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import FileError
from stiffopt.experiments.conductor import Array
from stiffopt.experiments.probing import Point
from stiffopt.logs.table import cut_torn_end, read_table

__all__ = ["PointsFile", "SeriesKey", "SeriesPoints"]

NAME = "points.csv"
_DIRECTION = ("direction_x", "direction_y", "direction_z")
_KEY = ("repetition", "pressure_pa", *_DIRECTION)
_VALUES = ("time_s", "force_n", "displacement_m", "stage_m", "tip_x_m", "tip_y_m", "tip_z_m")
_FLAGS = ("touching", "settled")


@dataclass(frozen=True)
class SeriesKey:
    """Which series: the repetition (from 1), the pressure in Pa, the direction."""

    repetition: int
    pressure: float
    direction: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class SeriesPoints:
    """The points (N,) of a series; see `Point`."""

    key: SeriesKey
    time: Array
    force: Array
    displacement: Array
    stage: Array
    touching: NDArray[np.bool_]
    settled: NDArray[np.bool_]
    measured: Array


class PointsFile:
    """Points of all series, in a folder.

    Parameters
    ----------
    folder : Path
    n : int
        Number of channels.
    """

    def __init__(self, folder: Path, n: int) -> None:
        self.path = folder / NAME
        self.n = n

    @property
    def _columns(self) -> tuple[str, ...]:
        measured = tuple(f"pm{k + 1}_pa" for k in range(self.n))
        return (*_KEY, "point", "points", *_VALUES, *measured, *_FLAGS)

    def read(self) -> list[SeriesPoints]:
        """Return the series that are whole, in order.

        Raises
        ------
        FileError
            The file cannot be read, or is of another experiment.
        """
        if not self.path.exists():
            return []
        cut_torn_end(os.fspath(self.path))
        if not self.path.stat().st_size:
            return []
        table = read_table(self.path)
        if table.columns != self._columns:
            raise FileError(self.path, "has other columns than this experiment", line=1)
        series = []
        start = 0
        while start < len(table.values):
            count = int(table["points"][start])
            rows = table.values[start : start + count]
            place = table.columns.index("point")
            if count < 1 or rows[:, place].tolist() != list(range(1, count + 1)):
                later = np.flatnonzero(table["point"][start + 1 :] == 1)
                start = start + 1 + int(later[0]) if len(later) else len(table.values)
                continue  # the end of a run that was killed
            series.append(self._series(dict(zip(table.columns, rows.T, strict=True))))
            start += count
        return series

    def _series(self, columns: dict[str, Array]) -> SeriesPoints:
        x, y, z = (float(columns[name][0]) for name in _DIRECTION)
        key = SeriesKey(int(columns["repetition"][0]), float(columns["pressure_pa"][0]), (x, y, z))
        return SeriesPoints(
            key=key,
            time=columns["time_s"],
            force=columns["force_n"],
            displacement=columns["displacement_m"],
            stage=columns["stage_m"],
            touching=columns["touching"] > 0,
            settled=columns["settled"] > 0,
            measured=np.stack([columns[f"pm{k + 1}_pa"] for k in range(self.n)], axis=1),
        )

    def append(self, key: SeriesKey, points: Sequence[Point]) -> None:
        """Write a series, with the disk when this returns.

        Raises
        ------
        FileError
            It cannot be written.
        """
        lines = []
        for number, point in enumerate(points, start=1):
            values = [
                key.repetition, key.pressure, *key.direction, number, len(points),
                point.time - points[0].time, point.force, point.displacement, point.stage,
                *point.position, *point.measured, point.touching, point.settled,
            ]  # fmt: skip
            fields = [f"{value:.9g}" if np.isfinite(value) else "" for value in map(float, values)]
            lines.append(",".join(fields))
        try:
            fresh = not self.path.exists() or not self.path.stat().st_size
            header = [",".join(self._columns)] if fresh else []
            with open(self.path, "ab") as stream:
                stream.write("".join(f"{line}\n" for line in [*header, *lines]).encode())
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise FileError(
                self.path, f"cannot be written: {(error.strerror or '').lower()}"
            ) from None
