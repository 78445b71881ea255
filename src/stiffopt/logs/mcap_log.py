"""A log as MCAP, the format of Foxglove and other viewers: written by experiments, and read back.

A row of the log is one message per topic, all with the same time. The message of ``/pressure`` is
written last, so a row that has it is whole. There are no chunks: each row has been handed to the
system when `append` returns, as in `LogWriter`.

| topic | is |
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
from contextlib import suppress
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np

from stiffopt.errors import FileError, InputError
from stiffopt.logs.layout import LogLayout
from stiffopt.logs.log import Array, Log, LogRow, log_of_values
from stiffopt.logs.mcap_reading import McapContents, read_mcap, require_mcap

__all__ = ["LOG_METADATA", "McapLogWriter", "read_mcap_log"]

LOG_METADATA = "stiffopt-log"
"""Name of the metadata record of a log."""
_NUMBER = {"type": "number"}  # or null; but Foxglove refuses a topic whose schema says so
_LIST = {"type": "array", "items": _NUMBER}
_SCHEMAS: dict[str, dict[str, Any]] = {
    "pressure": {"time_s": {"type": "number"}, "commanded_pa": _LIST, "measured_pa": _LIST},
    "pose": {"position_m": _LIST, "quaternion_wxyz": _LIST},
    "force": {"force_n": _NUMBER, "stage_m": _NUMBER},
}


class McapLogWriter:
    """Writes the rows of a log to an MCAP file, which replaces what is there.

    Parameters
    ----------
    path :
        The file; its folder must exist.
    layout :
        What is recorded.
    about :
        Kept in the file as metadata.

    Raises
    ------
    FileError
        It cannot be written.
    MissingExtraError
        mcap is not installed.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        layout: LogLayout,
        about: Mapping[str, str] | None = None,
    ) -> None:
        require_mcap()
        from mcap.writer import Writer

        self.path = os.fspath(path)
        self.layout = layout
        self._start = time.time_ns()  # of the log: viewers want a date
        self._last = -np.inf
        try:
            # an unbuffered file would be given a buffer by the writer, which nobody could flush
            self._stream: BinaryIO = open(self.path, "wb")  # noqa: SIM115 - kept open
        except OSError as error:
            raise self._cannot(error) from None
        self._writer: Any = Writer(self._stream, use_chunking=False)
        self._writer.start(library="stiffopt")
        self._writer.add_metadata(LOG_METADATA, {"start_ns": str(self._start), **_as_text(layout)})
        if about:
            self._writer.add_metadata("about", dict(about))
        self._channels = self._registered()
        self._flush()

    def _registered(self) -> dict[str, int]:
        schemas = {
            name: self._writer.register_schema(
                f"stiffopt.{name}",
                "jsonschema",
                json.dumps({"type": "object", "properties": properties}).encode(),
            )
            for name, properties in _SCHEMAS.items()
        }
        topics = {"/tip": "pose", **{f"/body/{name}": "pose" for name in self.layout.bodies}}
        if self.layout.force or self.layout.stage:
            topics["/force"] = "force"
        topics["/pressure"] = "pressure"
        return {
            topic: self._writer.register_channel(topic, "json", schemas[schema])
            for topic, schema in topics.items()
        }

    def append(self, row: LogRow) -> None:
        """Write a row.

        Raises
        ------
        InputError
            It does not fit the layout, or is not after the last one.
        FileError
            It cannot be written.
        """
        row.values(self.layout)  # checked whole before any part is written
        if not np.isfinite(row.time) or row.time <= self._last:
            raise InputError(f"a row at {row.time:g} s cannot follow one at {self._last:g} s")
        moment = self._start + round(row.time * 1e9)
        for topic, message in self._messages(row):
            data = json.dumps(message, allow_nan=False).encode()
            try:
                self._writer.add_message(self._channels[topic], moment, data, moment)
            except OSError as error:
                raise self._cannot(error) from None
        self._flush()
        self._last = row.time

    def _messages(self, row: LogRow) -> Iterator[tuple[str, dict[str, Any]]]:
        yield "/tip", _pose(row.position, row.quaternion)
        for name in self.layout.bodies:
            yield f"/body/{name}", _pose(*row.bodies.get(name, (None, None)))
        if "/force" in self._channels:
            yield "/force", {"force_n": _plain(row.force), "stage_m": _plain(row.stage)}
        yield (
            "/pressure",
            {
                "time_s": row.time,
                "commanded_pa": _plain(row.commanded),
                "measured_pa": _plain(row.measured),
            },
        )

    def close(self) -> None:
        """Write the summary and close; to close twice does nothing.

        Raises
        ------
        FileError
            The disk does not take it.
        """
        if self._stream.closed:
            return
        try:
            self._writer.finish()
            self._stream.flush()
            os.fsync(self._stream.fileno())
        except OSError as error:
            raise self._cannot(error) from None
        finally:
            with suppress(OSError):  # it tries once more to write what it could not
                self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            raise self._cannot(error) from None

    def _cannot(self, error: OSError) -> FileError:
        return FileError(self.path, f"cannot be written: {(error.strerror or '').lower()}")


def read_mcap_log(path: str | os.PathLike[str]) -> Log:
    """Read what a `McapLogWriter` has written, also if it was killed: all rows that are whole.

    Raises
    ------
    FileError
        It cannot be read, or is no recording of this kind.
    MissingExtraError
        mcap is not installed.
    """
    name = os.fspath(path)
    found = read_mcap(name)
    if LOG_METADATA not in found.metadata:
        raise FileError(name, "is no MCAP recording of stiffopt")
    try:
        layout = LogLayout.of_columns(name, found.metadata[LOG_METADATA]["columns"].split(","))
        rows = list(_whole_rows(found, layout))
    except (ValueError, KeyError, TypeError) as error:
        raise FileError(name, f"is damaged: {error}") from None
    values = np.array(rows) if rows else np.empty((0, len(layout.columns)))
    return log_of_values(values, layout)


def _whole_rows(found: McapContents, layout: LogLayout) -> Iterator[Array]:
    parts: dict[str, Any] = {}
    for topic, message in found.messages:
        parts[topic] = message
        if topic == "/pressure":  # the last of its row
            yield _row(parts).values(layout)
            parts = {}


def _row(parts: Mapping[str, Any]) -> LogRow:
    pressure, tip = parts["/pressure"], parts.get("/tip", {})
    force = parts.get("/force", {})
    return LogRow(
        time=float(pressure["time_s"]),
        commanded=_numbers(pressure["commanded_pa"], 0),
        measured=_optional(pressure.get("measured_pa")),
        position=_optional(tip.get("position_m")),
        quaternion=_optional(tip.get("quaternion_wxyz")),
        bodies={
            topic.removeprefix("/body/"): (
                _numbers(message["position_m"], 3),
                _optional(message["quaternion_wxyz"]),
            )
            for topic, message in parts.items()
            if topic.startswith("/body/")
        },
        force=_number(force.get("force_n")),
        stage=_number(force.get("stage_m")),
    )


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)


def _numbers(values: list[float | None] | None, count: int) -> Array:
    if values is None:
        return np.full(count, np.nan)
    return np.array([_number(value) for value in values])


def _optional(values: list[float | None] | None) -> Array | None:
    return None if values is None else _numbers(values, 0)


def _pose(position: Any, quaternion: Any) -> dict[str, Any]:
    return {"position_m": _plain(position), "quaternion_wxyz": _plain(quaternion)}


def _plain(values: Any) -> Any:
    """Return numbers for JSON: None for those that are not finite."""
    if values is None:
        return None
    numbers = np.asarray(values, dtype=float)
    if numbers.ndim == 0:
        return float(numbers) if np.isfinite(numbers) else None
    return [value if np.isfinite(value) else None for value in numbers.tolist()]


def _as_text(layout: LogLayout) -> dict[str, str]:
    return {"format": f"{LOG_METADATA}/1", "columns": ",".join(layout.columns)}
