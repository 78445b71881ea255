"""A log as MCAP, the format of Foxglove and other viewers: written by experiments, and read back.

A row of the log is one message per topic, all with the same time, in one chunk of the file. A row
is on the disk when `append` returns, as in `LogWriter`. The message of ``/pressure`` is written
last, so a row that has it is complete.

| topic | content |
| --- | --- |
| /tip, /body/<name> | position_m [3], quaternion_wxyz [4] |
| /force | force_n, stage_m |
| /pressure | time_s, commanded_pa [n], measured_pa [n] |
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping
from typing import Any, Self

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import FileError, require_package
from stiffopt.logs.log import Log, LogLayout, LogRow, log_of_values, numbers_of
from stiffopt.logs.mcap_file import McapContents, McapWriter, read_mcap
from stiffopt.logs.table import writing

LOG_METADATA = "stiffopt-log"
"""Name of the metadata record of a log."""
_REPLACE = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
_SCALARS = ("time_s", "force_n", "stage_m")


class McapLogWriter:
    """Writes the rows of a log to an MCAP file, replacing an existing one.

    Raises `FileError`: it cannot be written, now or later; `MissingExtraError`: foxglove-sdk is not
    installed.

    Parameters
    ----------
    path, layout : the file, whose folder must exist, and its columns.
    about : metadata to keep in the file.
    now : present time of the log, in s.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        layout: LogLayout,
        about: Mapping[str, str] | None = None,
        now: float = 0.0,
    ) -> None:
        require_package("foxglove-sdk", "log", "foxglove")
        from foxglove import Channel, Context

        self.path = os.fspath(path)
        self.layout = layout
        self._start = time.time_ns() - round(1e9 * now)  # date of time 0, for viewers
        self._last_time: float | None = None
        self._topics = _topics(layout)
        context = Context()
        self._channels = {
            topic: Channel(topic, schema=_schema(topic, fields), context=context)
            for topic, fields in self._topics.items()
        }
        metadata = {
            LOG_METADATA: {
                "start_ns": str(self._start),
                "format": f"{LOG_METADATA}/1",
                "columns": ",".join(layout.columns),
            },
            **({"about": about} if about else {}),
        }
        with writing(self.path):
            self._file = McapWriter(os.open(self.path, _REPLACE, 0o666), context, metadata)

    def append(self, row: LogRow) -> None:
        """Write a row; raise `InputError` if it does not fit or is not after the last one."""
        values = row.values(self.layout, after=self._last_time)
        self._last_time = row.time
        parts = self.layout.split(values)
        moment = self._start + round(row.time * 1e9)
        for topic, fields in self._topics.items():
            message = {key: _json_of(key, parts.get(part)) for key, part in fields.items()}
            data = json.dumps(message, allow_nan=False).encode()
            self._channels[topic].log(data, log_time=moment)
        with writing(self.path):
            self._file.commit()

    def close(self) -> None:
        """Write the index and close; a second call does nothing."""
        with writing(self.path):
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_mcap_log(path: str | os.PathLike[str]) -> Log:
    """Read the complete rows of a `McapLogWriter`, even one that was killed.

    Raises
    ------
    FileError
        It cannot be read, or is no recording of this kind.
    MissingExtraError
        mcap is not installed.
    """
    return log_of_contents(path, read_mcap(path))


def log_of_contents(path: str | os.PathLike[str], found: McapContents) -> Log:
    """Return the log in the contents of an MCAP file; raises as `read_mcap_log`."""
    name = os.fspath(path)
    if LOG_METADATA not in found.metadata:
        raise FileError(
            name,
            "is no MCAP recording of an experiment; 'stiffopt log export' reads those of runs",
        )
    try:
        layout = LogLayout.of_columns(name, found.metadata[LOG_METADATA]["columns"].split(","))
        rows = list(_whole_rows(found, layout))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FileError(name, f"is damaged: {error}") from None
    values = np.array(rows) if rows else np.empty((0, len(layout.columns)))
    return log_of_values(values, layout)


def _whole_rows(found: McapContents, layout: LogLayout) -> Iterator[Array]:
    """Yield the values of the rows that have their last message, that of ``/pressure``."""
    place = {
        part: (topic, key)
        for topic, fields in _topics(layout).items()
        for key, part in fields.items()
    }
    messages: dict[str, Any] = {}
    for topic, message in found.messages:
        messages[topic] = message
        if topic == "/pressure":
            row = []
            for part, columns in layout.parts.items():
                where, key = place[part]
                value = messages.get(where, {}).get(key)
                row.append(numbers_of(part, value, len(columns)))
            if not np.isfinite(row[0]).all():
                raise ValueError("a row has no time")
            yield np.concatenate(row)
            messages = {}


def _topics(layout: LogLayout) -> dict[str, dict[str, str]]:
    """Return the fields of each topic's messages, and the row's part that each field holds."""
    bodies = {"/tip": "tip", **{f"/body/{name}": name for name in layout.bodies}}
    topics = {
        topic: {"position_m": f"{body} position", "quaternion_wxyz": f"{body} quaternion"}
        for topic, body in bodies.items()
    }
    if layout.force or layout.stage:
        topics["/force"] = {"force_n": "force", "stage_m": "stage"}
    topics["/pressure"] = {
        "time_s": "time",
        "commanded_pa": "commanded",
        "measured_pa": "measured",
    }
    return topics


def _schema(topic: str, fields: Mapping[str, str]) -> dict[str, Any]:
    """Return the JSON schema of a topic, without null, which Foxglove does not support."""
    number = {"type": "number"}
    name = "pose" if "position_m" in fields else topic[1:]
    return {
        "title": f"stiffopt.{name}",
        "type": "object",
        "properties": {
            key: number if key in _SCALARS else {"type": "array", "items": number} for key in fields
        },
    }


def _json_of(key: str, values: Array | None) -> Any:
    """Return a part of a row as JSON, with null for missing values."""
    if values is None or not np.isfinite(values).any():
        return None
    numbers = [value if np.isfinite(value) else None for value in values.tolist()]
    return numbers[0] if key in _SCALARS else numbers
