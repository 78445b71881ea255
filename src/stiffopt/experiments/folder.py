"""The folder of an experiment: its settings and its recordings, complete or not."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import Field

from stiffopt.errors import FileError, InputError, os_reason
from stiffopt.experiments.conductor import Conductor, TrackedFrame
from stiffopt.files import read_file, save_file
from stiffopt.logs import LogLayout, LogWriter, McapLogWriter
from stiffopt.schema import Schema

SETTINGS = "experiment.yaml"

SchemaT = TypeVar("SchemaT", bound=Schema)
_PAUSE = 1.0  # s between two runs in one file

Progress = Callable[[float, float, str], None]
"""Called with the work done, the total and a description."""


class ExperimentSettings(Schema):
    """Settings that all experiments have.

    Attributes
    ----------
    rig, robot : their names, for reports.
    channels : number of channels.
    repetitions : of the whole protocol.
    """

    rig: str = "rig"
    robot: str = "robot"
    channels: Annotated[int, Field(ge=1)]
    repetitions: Annotated[int, Field(ge=1, le=1000)] = 5


def empty_folder(path: Path) -> Path:
    """Make a folder, and return it; it may exist if it is empty."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        if any(path.iterdir()):
            raise FileError(path, "is not empty; give another folder")
    except OSError as error:
        raise FileError(path, f"cannot be made: {os_reason(error)}") from None
    return path


def create_folder(path: Path, settings: Schema) -> None:
    """Create the folder of a new experiment and write its settings there."""
    if (path / SETTINGS).exists():
        raise FileError(path, f"holds an experiment; continue it with --resume {path}")
    empty_folder(path)
    save_file(path / SETTINGS, "experiment", settings)


def open_folder(path: Path, schema: type[SchemaT]) -> SchemaT:
    """Return the settings of the experiment in a folder."""
    if not (path / SETTINGS).is_file():
        raise FileError(path, f"holds no experiment; expected a folder with {SETTINGS} in it")
    return read_file(path / SETTINGS, "experiment", schema)


@contextmanager
def alone_in(path: Path) -> Iterator[None]:
    """Context with exclusive access to the folder; `InputError` if another process has it."""
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
    """Remove the folder of an experiment if nothing was recorded in it."""
    with suppress(OSError):
        if [each.name for each in path.iterdir()] == [SETTINGS]:
            (path / SETTINGS).unlink()
            path.rmdir()


def check_same(name: str, now: object, then: object) -> None:
    """Raise `InputError` if something has changed since the experiment was begun."""
    if now != then:
        raise InputError(f"the experiment was begun with {name} {then}, not {now}")


@contextmanager
def recorded(
    conductor: Conductor,
    folder: Path,
    name: str,
    about: Mapping[str, str],
    longest: float = math.inf,
) -> Iterator[float]:
    """Context in which all frames are recorded, as CSV and MCAP.

    The files' names contain ``.part`` until the context ends without an exception. All logs of a
    conductor have one clock, so that the pauses between them are known, to a second: each begins at
    a whole second of it.

    Parameters
    ----------
    conductor : Conductor
        Source of the frames; it has seen the tip.
    folder, name : folder, and name of the files without ending.
    about : metadata for the MCAP file.
    longest : time in s after which frames are left out.

    Yields
    ------
    float
        Beginning of the recording, on the rig's clock, in s.
    """
    turns = any(row.quaternion is not None for row in conductor.rows)
    layout = LogLayout(n=conductor.n, measured=True, tip_quaternion=turns)
    begin = conductor.clock.now()
    if conductor.origin is None:
        conductor.origin = begin
    zero = begin - math.ceil(begin - conductor.origin)
    mcap, csv = (folder / f"{name}.part.{ending}" for ending in ("mcap", "csv"))
    for part in (mcap, csv):
        part.unlink(missing_ok=True)  # left by an interrupted run
    with (
        LogWriter(csv, layout) as to_csv,
        McapLogWriter(mcap, layout, about, begin - zero) as to_mcap,
    ):

        def keep(row: TrackedFrame) -> None:
            if 0 <= row.time - begin <= longest:
                to_csv.append(row.logged(zero))
                to_mcap.append(row.logged(zero))

        conductor.sink = keep
        try:
            yield begin
        finally:
            conductor.sink = None
    for part in (mcap, csv):  # the CSV file last: its name marks the recording as complete
        os.replace(part, folder / f"{name}{part.suffix}")


class RawRecording:
    """Records all frames from now on; a resumed run continues the CSV file.

    Parameters
    ----------
    repetition : counted from 1; part of the file names.
    conductor : source of the frames; it has seen the tip.
    rig : name of the rig, for the MCAP file.
    """

    def __init__(self, folder: Path, repetition: int, conductor: Conductor, rig: str) -> None:
        self.repetition = repetition
        self._conductor = conductor
        turns = any(row.quaternion is not None for row in conductor.rows)
        layout = LogLayout(
            n=conductor.n, measured=True, tip_quaternion=turns, force=True, stage=True
        )
        name = f"stiffness_{repetition}"
        self._csv = LogWriter(folder / f"{name}.csv", layout)
        part, mcap = 1, folder / f"{name}.mcap"
        while mcap.exists():
            part += 1
            mcap = folder / f"{name}_{part}.mcap"
        about = {"experiment": "stiffness", "repetition": str(repetition), "rig": rig}
        last = self._csv.last_time
        now = conductor.clock.now()
        begin = now if last is None else now - last - _PAUSE
        self._mcap = McapLogWriter(mcap, layout, about, now - begin)

        def keep(row: TrackedFrame) -> None:
            if row.time >= now:
                self._csv.append(row.logged(begin))
                self._mcap.append(row.logged(begin))

        conductor.sink = keep

    def close(self) -> None:
        """Close both files."""
        self._conductor.sink = None
        try:
            self._csv.close()
        finally:
            self._mcap.close()
