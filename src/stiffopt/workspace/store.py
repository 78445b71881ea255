"""A map on disk: a Zarr group (format 3) that any Zarr reader opens, and a run that can go on.

A group is complete or not. As long as it is not, ``checkpoint.npz`` in it holds what was found in
the first so many blocks; it is replaced as a whole, so that a process may be killed at any time.
When all is done the arrays are written, the group's attributes say ``complete`` (again in one
step), and the checkpoint goes. The process at work holds a lock on the folder.
"""

import json
import os
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import FileError, MissingExtraError, shown
from stiffopt.workspace.arrays import read_table, write_arrays
from stiffopt.workspace.map import WorkspaceMap
from stiffopt.workspace.table import CellTable

Vector = NDArray[np.float64]

FORMAT = "stiffopt-map/1"
_METADATA = "zarr.json"
_CHECKPOINT = "checkpoint.npz"
_PART = ".part"


class Progress(NamedTuple):
    """What was found in the first blocks.

    Attributes
    ----------
    blocks : number of blocks done.
    lost : samples without an equilibrium.
    low, high : (3,) least and greatest coordinates of the tip.
    table : the cells.
    """

    blocks: int
    lost: int
    low: Vector
    high: Vector
    table: CellTable


def require_zarr() -> None:
    """Say how to get Zarr if it is missing.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    """
    try:
        missing = find_spec("zarr") is None
    except ValueError:  # a placeholder in sys.modules
        missing = True
    if missing:
        raise MissingExtraError("zarr", "map")


class MapStore:
    """The folder of a map.

    Parameters
    ----------
    path :
        The folder; by custom its name ends in ``.zarr``.
    attributes :
        What the folder says of itself, or None to read it.

    Raises
    ------
    FileError
        There is something else at the path, or nothing.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.attributes = _read_attributes(self.path)

    @classmethod
    def create(
        cls, path: str | os.PathLike[str], record: dict[str, Any], *, overwrite: bool
    ) -> "MapStore":
        """New, empty map; it appears at its path as a whole, another map goes if it may."""
        target = Path(path)
        attributes = {"format": FORMAT, "status": "unfinished", **record}
        try:
            with tempfile.TemporaryDirectory(
                prefix=f".{target.name}.", dir=target.resolve().parent
            ) as folder:
                new, old = Path(folder) / "new", Path(folder) / "old"
                new.mkdir()
                _write_json(new / _METADATA, _group(attributes))
                if overwrite and os.path.lexists(target):
                    target.replace(old)
                new.replace(target)
        except OSError as error:
            raise FileError(path, f"cannot be written: {_reason(error)}") from None
        return cls(target)

    @property
    def is_complete(self) -> bool:
        """Whether all samples are in it."""
        return bool(self.attributes["status"] == "complete")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from working on this map.

        Raises
        ------
        FileError
            Another process does.
        """
        try:
            import fcntl
        except ImportError:  # Windows
            yield
            return
        try:
            handle = os.open(self.path, os.O_RDONLY)
        except OSError as error:
            raise FileError(self.path, f"cannot be opened: {_reason(error)}") from None
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise FileError(
                    self.path, "another process is working on this map; wait, or stop it"
                ) from None
            except OSError:  # a file system without locks
                pass
            yield
        finally:
            os.close(handle)

    def check(self, record: dict[str, Any]) -> None:
        """Raise if this is a map of something else, naming what differs."""
        differing = [key for key in record if self.attributes.get(key) != record[key]]
        if not differing:
            return
        told = [
            f"{key} is {_said(self.attributes.get(key))} there and {_said(record[key])} here"
            for key in differing
            if not isinstance(record[key], dict)
        ] or ["the robot's description differs"]
        raise FileError(
            self.path,
            f"holds a map with other settings: {'; '.join(told[:4])}. Take another name, the same "
            "settings, or overwrite it (--overwrite)",
        )

    # -- while it is made -------------------------------------------------------------------

    def save(self, progress: Progress) -> None:
        """Replace the checkpoint."""
        columns: dict[str, Any] = dict(progress.table.arrays)
        try:
            part = self.path / f"{_CHECKPOINT}{_PART}"
            with part.open("wb") as stream:
                np.savez(
                    stream, blocks=progress.blocks, lost=progress.lost, low=progress.low,
                    high=progress.high, **columns,
                )  # fmt: skip
                stream.flush()
                os.fsync(stream.fileno())
            part.replace(self.path / _CHECKPOINT)
        except OSError as error:
            raise FileError(self.path, f"cannot be written: {_reason(error)}") from None

    def load(self) -> Progress | None:
        """Checkpoint, or None if there is none yet."""
        path = self.path / _CHECKPOINT
        try:
            with np.load(path, allow_pickle=False) as saved:
                data = {name: saved[name] for name in saved.files}
            blocks, lost = int(data.pop("blocks")), int(data.pop("lost"))
            return Progress(blocks, lost, data.pop("low"), data.pop("high"), CellTable(**data))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            raise FileError(
                path, "is damaged, so the map cannot be resumed; begin anew with --overwrite"
            ) from None

    # -- when all is known ------------------------------------------------------------------

    def finish(self, done: WorkspaceMap) -> None:
        """Write the arrays and say that the map is complete."""
        require_zarr()
        attributes = {
            **self.attributes,
            "status": "complete",
            "cells": len(done.table),
            "samples_without_equilibrium": done.lost,
            "tip_low_m": _plain(done.low),
            "tip_high_m": _plain(done.high),
            "first_cell": done.first_cell.tolist(),
            "origin_m": (done.first_cell * done.plan.cell).tolist(),
        }
        try:
            write_arrays(self.path, done)
            _write_json(self.path / _METADATA, _group(attributes))
            self.attributes = attributes
            self.tidy()
        except OSError as error:
            raise FileError(self.path, f"cannot be written: {_reason(error)}") from None

    def tidy(self) -> None:
        """Remove what a complete map does not need."""
        for name in (_CHECKPOINT, f"{_CHECKPOINT}{_PART}", f"{_METADATA}{_PART}"):
            with suppress(FileNotFoundError):
                (self.path / name).unlink()

    def read(self) -> Progress:
        """All that a complete map says.

        Raises
        ------
        FileError
            Its arrays are damaged.
        """
        require_zarr()
        try:
            table = read_table(self.path, np.array(self.attributes["first_cell"]))
            low, high = (
                np.array(self.attributes[key], dtype=float) for key in ("tip_low_m", "tip_high_m")
            )
            lost = int(self.attributes["samples_without_equilibrium"])
        except Exception as error:  # whatever a damaged file does to whichever decoder
            raise FileError(
                self.path, f"is damaged: {type(error).__name__}: {error}; begin anew (--overwrite)"
            ) from None
        return Progress(0, lost, low, high, table)


# Parts -------------------------------------------------------------------------------------------


def _read_attributes(path: Path) -> dict[str, Any]:
    """Attributes of a map."""
    no_map = "is not a map of a workspace that stiffopt made; nothing was changed"
    try:
        data = json.loads((path / _METADATA).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        reason = no_map if os.path.lexists(path) else "there is no such map"
        raise FileError(path, reason) from None
    except OSError as error:
        raise FileError(path, f"cannot be read: {_reason(error)}") from None
    except ValueError:
        raise FileError(path, no_map) from None
    attributes = data.get("attributes") if isinstance(data, dict) else None
    given = attributes.get("format") if isinstance(attributes, dict) else None
    if not isinstance(attributes, dict) or not isinstance(given, str):
        raise FileError(path, no_map)
    kind = FORMAT.partition("/")[0]
    if given.partition("/")[0] != kind or attributes.get("status") not in (
        "unfinished",
        "complete",
    ):
        raise FileError(path, no_map)
    if given != FORMAT:
        raise FileError(path, f"has the format {shown(given)}; this version reads '{FORMAT}'")
    return attributes


def is_vacant(path: str | os.PathLike[str]) -> bool:
    """Whether there is nothing at a path, or an empty folder."""
    place = Path(path)
    if not os.path.lexists(place):
        return True
    try:
        return place.is_dir() and not place.is_symlink() and not any(place.iterdir())
    except OSError as error:
        raise FileError(path, f"cannot be read: {_reason(error)}") from None


def _group(attributes: dict[str, Any]) -> dict[str, Any]:
    """Metadata of a Zarr group."""
    return {"zarr_format": 3, "node_type": "group", "attributes": attributes}


def _write_json(path: Path, data: dict[str, Any]) -> None:
    part = path.with_name(f"{path.name}{_PART}")
    with part.open("w", encoding="utf-8") as stream:
        json.dump(data, stream, indent=2, allow_nan=False)
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(path)


def _plain(values: Vector) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]


def _said(value: Any) -> str:
    return f"'{value}'" if isinstance(value, str) else f"{value}"


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
