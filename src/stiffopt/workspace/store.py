"""Store a workspace map on disk: a Zarr group (format 3) that can be resumed until it is complete.

While a map is unfinished, ``checkpoint.npz`` in its folder holds the results of its first blocks.
It is replaced atomically, so a process may be killed at any time. At the end the arrays are
written, the attributes of the group are set to ``complete`` (also atomically) and the checkpoint
is removed. The running process holds a lock on the folder.
"""

import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.errors import FileError, os_reason, require_package, shown
from stiffopt.workspace.map import FILL, WorkspaceMap
from stiffopt.workspace.table import CellTable, MapPart, cell_keys, merged

FORMAT = "stiffopt-map/1"
_METADATA = "zarr.json"
_CHECKPOINT = "checkpoint.npz"
_PART = ".part"
_CHUNK = 32  # cells along each axis

_WHAT = {
    "count": "number of samples in the cell",
    "best": "greatest stiffness of a sample in the cell",
    "worst": "least stiffness of a sample in the cell",
    "best_sample": "lowest number of a sample with the greatest stiffness",
    "worst_sample": "lowest number of a sample with the least stiffness",
}


class MapStore:
    """The folder of a map; `FileError` if the path has something else, or nothing."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.attributes = _read_attributes(self.path)

    @classmethod
    def create(
        cls, path: str | os.PathLike[str], record: dict[str, Any], *, overwrite: bool
    ) -> "MapStore":
        """Create a new, empty map atomically; with `overwrite` it replaces another one."""
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
            raise FileError(path, f"cannot be written: {os_reason(error)}") from None
        return cls(target)

    @property
    def is_complete(self) -> bool:
        """Whether the map is complete."""
        return bool(self.attributes["status"] == "complete")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from working on this map; `FileError` if one already does."""
        try:
            import fcntl
        except ImportError:  # Windows
            yield
            return
        try:
            handle = os.open(self.path, os.O_RDONLY)
        except OSError as error:
            raise FileError(self.path, f"cannot be opened: {os_reason(error)}") from None
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
        """Raise `FileError` with the differences if this map has another plan."""
        differing = [key for key in record if self.attributes.get(key) != record[key]]
        if not differing:
            return
        differences = [
            f"{key} is {_said(self.attributes.get(key))} there and {_said(record[key])} here"
            for key in differing
            if not isinstance(record[key], dict)
        ] or ["the robot's description differs"]
        raise FileError(
            self.path,
            f"holds a map with other settings: {'; '.join(differences[:4])}. Take another name, "
            "the same settings, or overwrite it (--overwrite)",
        )

    # -- unfinished maps --------------------------------------------------------------------

    def save(self, progress: MapPart) -> None:
        """Replace the checkpoint."""
        columns: dict[str, Any] = {**progress._asdict(), **progress.table.arrays}
        del columns["table"]
        try:
            part = self.path / f"{_CHECKPOINT}{_PART}"
            with part.open("wb") as stream:
                np.savez(stream, **columns)
                stream.flush()
                os.fsync(stream.fileno())
            part.replace(self.path / _CHECKPOINT)
        except OSError as error:
            raise FileError(self.path, f"cannot be written: {os_reason(error)}") from None

    def load(self) -> MapPart | None:
        """Return the checkpoint, or None if there is none yet."""
        path = self.path / _CHECKPOINT
        try:
            with np.load(path, allow_pickle=False) as saved:
                data = {name: saved[name] for name in saved.files}
            blocks, lost = int(data.pop("blocks")), int(data.pop("lost"))
            return MapPart(blocks, lost, data.pop("low"), data.pop("high"), CellTable(**data))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            raise FileError(
                path, "is damaged, so the map cannot be resumed; start again with --overwrite"
            ) from None

    # -- complete maps ----------------------------------------------------------------------

    def finish(self, done: WorkspaceMap) -> None:
        """Write the arrays and mark the map as complete."""
        require_package("zarr", "map")
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
            raise FileError(self.path, f"cannot be written: {os_reason(error)}") from None

    def tidy(self) -> None:
        """Remove the files that a complete map does not need."""
        for name in (_CHECKPOINT, f"{_CHECKPOINT}{_PART}", f"{_METADATA}{_PART}"):
            with suppress(FileNotFoundError):
                (self.path / name).unlink()

    def read(self) -> MapPart:
        """Read a complete map."""
        require_package("zarr", "map")
        try:
            table = read_table(self.path, np.array(self.attributes["first_cell"]))
            low, high = (
                np.array(self.attributes[key], dtype=float) for key in ("tip_low_m", "tip_high_m")
            )
            lost = int(self.attributes["samples_without_equilibrium"])
        except Exception as error:  # a damaged file may raise anything in zarr's decoders
            raise FileError(
                self.path,
                f"is damaged: {type(error).__name__}: {error}; start again with --overwrite",
            ) from None
        return MapPart(0, lost, low, high, table)


# arrays ------------------------------------------------------------------------------------------


def write_arrays(path: Path, done: WorkspaceMap) -> None:
    """Write the cells that were reached; the whole box need not fit into memory."""
    import zarr

    for entry in path.iterdir():  # left by a run that was killed here
        if entry.is_dir():
            shutil.rmtree(entry)
    group = zarr.open_group(str(path), mode="r+", zarr_format=3)
    shape, m = done.shape, len(done.plan.measures)
    cells = done.cells - done.first_cell
    units = {"best": done.plan.unit, "worst": done.plan.unit}
    for name, fill in FILL.items():
        values = getattr(done.table, name)
        lead = values.ndim - 1
        array: Any = group.create_array(
            name,
            shape=(m,) * lead + shape,
            chunks=(1,) * lead + tuple(max(1, min(_CHUNK, side)) for side in shape),
            dtype=values.dtype,
            fill_value=fill,
            dimension_names=("direction",) * lead + ("x", "y", "z"),
            attributes={"long_name": _WHAT[name], "units": units.get(name, "1")},
        )
        for direction in np.ndindex(values.shape[:-1] if len(cells) else (0,)):
            place = (*(np.full(len(cells), index) for index in direction), *cells.T)
            array.vindex[place] = values[direction]
    _write_coordinates(group, done)


def _write_coordinates(group: Any, done: WorkspaceMap) -> None:
    for axis, name in enumerate("xyz"):
        centres = (done.first_cell[axis] + np.arange(done.shape[axis])) * done.plan.cell
        group.create_array(
            name,
            data=centres,
            dimension_names=(name,),
            attributes={"long_name": f"{name} of the cell's centre, base frame", "units": "m"},
        )
    group.create_array(
        "direction",
        data=np.array(done.direction_names, dtype=np.dtypes.StringDType()),
        dimension_names=("direction",),
        attributes={"long_name": "direction of the stiffness"},
    )


def read_table(path: Path, first: NDArray[np.int64]) -> CellTable:
    """Read the cells that were reached, slab by slab."""
    import zarr

    group = zarr.open_group(str(path), mode="r", zarr_format=3)
    arrays: dict[str, Any] = {name: group[name] for name in FILL}
    count, m = arrays["count"], arrays["best"].shape[0]
    parts = [CellTable.empty(m)]
    for start in range(0, count.shape[0], _CHUNK):
        slab = {
            name: np.asarray(array[..., start : start + _CHUNK, :, :])
            for name, array in arrays.items()
        }
        where = np.nonzero(slab["count"])
        inside: Any = (..., *where)
        key = cell_keys(np.stack(where, axis=1) + first + np.array([start, 0, 0]))
        parts.append(CellTable(key, **{name: box[inside] for name, box in slab.items()}))
    return merged(parts)


# metadata ----------------------------------------------------------------------------------------


def _read_attributes(path: Path) -> dict[str, Any]:
    """Read the attributes of a map."""
    no_map = "is not a map of a workspace that stiffopt made; nothing was changed"
    try:
        data = json.loads((path / _METADATA).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        reason = no_map if os.path.lexists(path) else "there is no such map"
        raise FileError(path, reason) from None
    except OSError as error:
        raise FileError(path, f"cannot be read: {os_reason(error)}") from None
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
    """Return whether there is nothing at a path, or an empty folder."""
    place = Path(path)
    if not os.path.lexists(place):
        return True
    try:
        return place.is_dir() and not place.is_symlink() and not any(place.iterdir())
    except OSError as error:
        raise FileError(path, f"cannot be read: {os_reason(error)}") from None


def _group(attributes: dict[str, Any]) -> dict[str, Any]:
    """Return the metadata of a Zarr group."""
    return {"zarr_format": 3, "node_type": "group", "attributes": attributes}


def _write_json(path: Path, data: dict[str, Any]) -> None:
    part = path.with_name(f"{path.name}{_PART}")
    with part.open("w", encoding="utf-8") as stream:
        json.dump(data, stream, indent=2, allow_nan=False)
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(path)


def _plain(values: Array) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]


def _said(value: Any) -> str:
    return f"'{value}'" if isinstance(value, str) else f"{value}"
