"""Logs as CSV (log v1): a reader, and a writer that goes row by row, so a crash loses one row."""

from __future__ import annotations

import os
from typing import Self

import numpy as np

from stiffopt.errors import FileError
from stiffopt.logs.log import Log, LogLayout, LogRow, log_of_values
from stiffopt.logs.table import cut_torn_end, read_bytes, read_table, replacing, writing


class LogWriter:
    """Appends rows to a log (log v1); each is handed to the system before `append` returns.

    An existing file with the same columns is continued after `last_time`.

    Raises `FileError`: it cannot be written, now or later, or it exists and has other columns.

    Parameters
    ----------
    path, layout : the file, whose folder must exist, and its columns.

    Attributes
    ----------
    last_time : time of the last row, in s; None before the first.
    was_torn : whether an incomplete last line was found and cut off.
    """

    def __init__(self, path: str | os.PathLike[str], layout: LogLayout) -> None:
        self.path = os.fspath(path)
        self.layout = layout
        self.last_time: float | None = None
        self.was_torn = False
        self._formats = [_format(name) for name in layout.columns]
        header = f"{','.join(layout.columns)}\n".encode()
        if os.path.exists(self.path):
            self._take_up(header)
        with writing(self.path):
            self._stream = open(self.path, "ab", buffering=0)  # noqa: SIM115 - kept open
        if not self._stream.tell():
            self._write(header)

    def _take_up(self, header: bytes) -> None:
        """Find the end of an existing file."""
        text = read_bytes(self.path)
        if text and not text.startswith(header) and not header.startswith(text):
            raise FileError(self.path, "exists and has other columns; give another name", line=1)
        self.was_torn = cut_torn_end(self.path)
        lines = text[: text.rfind(b"\n") + 1].splitlines()
        if len(lines) > 1:
            fields = lines[-1].split(b",")
            if len(fields) != len(self._formats):
                raise FileError(self.path, "the last row is incomplete; remove it", line=len(lines))
            try:
                self.last_time = float(fields[0])
            except ValueError:
                raise FileError(self.path, "has no time", line=len(lines)) from None

    def append(self, row: LogRow) -> None:
        """Write a row; raise `InputError` if it does not fit or is not after the last one."""
        values = row.values(self.layout, after=self.last_time)
        fields = [
            "" if np.isnan(value) else form % value
            for form, value in zip(self._formats, values.tolist(), strict=True)
        ]
        self._write(f"{','.join(fields)}\n".encode())
        self.last_time = round(row.time, 6)

    def _write(self, data: bytes) -> None:
        with writing(self.path):
            while data:
                data = data[self._stream.write(data) :]

    def close(self) -> None:
        """Write all rows to the disk and close; a second call does nothing."""
        if self._stream.closed:
            return
        with writing(self.path), self._stream:
            os.fsync(self._stream.fileno())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def write_log(path: str | os.PathLike[str], log: Log) -> None:
    """Write a whole log (log v1), replacing an existing file."""
    with replacing(path) as part, LogWriter(part, log.layout) as writer:
        for row in log.rows():
            writer.append(row)


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
        field is no finite number, or time does not increase; with the line.
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


def _format(column: str) -> str:
    """Return the format of a column's numbers: finer than any sensor, in fixed steps."""
    if column.endswith("_pa"):
        return "%.1f"  # Pa
    if column.endswith("_m"):
        return "%.7f"  # 0.1 um
    return "%.6f"  # us, uN, quaternions
