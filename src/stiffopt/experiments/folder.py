"""Folder of an experiment: its settings, its recordings, and which of them are complete."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from stiffopt.errors import FileError, InputError
from stiffopt.files import read_file, save_file
from stiffopt.logs import LogLayout, LogRow, LogWriter, McapLogWriter
from stiffopt.schema import Schema

__all__ = ["SETTINGS", "Recording", "alone_in", "create_folder", "open_folder"]

SETTINGS = "experiment.yaml"

SchemaT = TypeVar("SchemaT", bound=Schema)


def create_folder(path: Path, settings: Schema) -> None:
    """Make the folder of a new experiment and write its settings there.

    Raises
    ------
    FileError
        It cannot be made, or is there and not empty.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        if (path / SETTINGS).exists():
            raise FileError(path, f"holds an experiment; continue it with --resume {path}")
        if any(path.iterdir()):
            raise FileError(path, "is not empty; give another folder")
    except OSError as error:
        raise FileError(path, f"cannot be made: {(error.strerror or '').lower()}") from None
    save_file(path / SETTINGS, "experiment", settings)


def open_folder(path: Path, schema: type[SchemaT]) -> SchemaT:
    """Return the settings of an experiment that was begun.

    Raises
    ------
    FileError
        There is none, or one of another kind.
    """
    if not (path / SETTINGS).is_file():
        raise FileError(path, f"holds no experiment; expected a folder with {SETTINGS} in it")
    return read_file(path / SETTINGS, "experiment", schema)


@contextmanager
def alone_in(path: Path) -> Iterator[None]:
    """Context in which no other process works in the folder of an experiment.

    Raises
    ------
    InputError
        One does.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    with (path / SETTINGS).open("rb") as held:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"another process is at work in {path}; wait for its end") from None
        yield


def remove_folder(path: Path) -> None:
    """Remove the folder of an experiment in which nothing was recorded."""
    with suppress(OSError):
        if [each.name for each in path.iterdir()] == [SETTINGS]:
            (path / SETTINGS).unlink()
            path.rmdir()


class Recording:
    """One recording as CSV and MCAP, under other names until it is complete.

    Parameters
    ----------
    folder, name :
        Where, and under which name without ending.
    layout :
        What is recorded.
    begin :
        Time 0, on the rig's clock.
    about :
        Kept in the MCAP file.
    """

    def __init__(
        self, folder: Path, name: str, layout: LogLayout, begin: float, about: Mapping[str, str]
    ) -> None:
        self._begin = begin
        self._paths = [
            (folder / f"{name}.part.{ending}", folder / f"{name}.{ending}")
            for ending in ("mcap", "csv")  # the CSV file last: it says that all is complete
        ]
        (part_mcap, _), (part_csv, _) = self._paths
        for part in (part_mcap, part_csv):
            part.unlink(missing_ok=True)  # of a run that was interrupted: it is repeated
        with ExitStack() as opened:
            csv = opened.enter_context(LogWriter(part_csv, layout))
            mcap = opened.enter_context(McapLogWriter(part_mcap, layout, about))
            self._open = opened.pop_all()
        self._writers: tuple[LogWriter | McapLogWriter, ...] = (csv, mcap)

    def append(self, row: LogRow) -> None:
        """Write a row."""
        for writer in self._writers:
            writer.append(row)

    def complete(self) -> None:
        """Close the files and give them their names."""
        self._open.close()
        for part, whole in self._paths:
            os.replace(part, whole)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._open.close()


def check_same(name: str, now: object, then: object) -> None:
    """Refuse to resume with something that has changed.

    Raises
    ------
    InputError
        It has.
    """
    if now != then:
        raise InputError(f"the experiment was begun with {name} {then}, not {now}")
