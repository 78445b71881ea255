"""The arrays of a map in a Zarr group, written and read chunk by chunk."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.workspace.map import FILL, WorkspaceMap
from stiffopt.workspace.table import CellTable, cell_keys

_CHUNK = 32  # cells along each axis

_WHAT = {
    "count": "number of samples in the cell",
    "best": "greatest stiffness of a sample in the cell",
    "worst": "least stiffness of a sample in the cell",
    "best_sample": "lowest number of a sample with the greatest stiffness",
    "worst_sample": "lowest number of a sample with the least stiffness",
}


def write_arrays(path: Path, done: WorkspaceMap) -> None:
    """Write all arrays chunk by chunk: the whole box need not fit into memory."""
    import zarr

    for entry in path.iterdir():  # of a run that was killed here
        if entry.is_dir():
            shutil.rmtree(entry)
    group = zarr.open_group(str(path), mode="r+", zarr_format=3)
    shape, m = done.shape, len(done.plan.measures)
    cells = done.cells - done.first_cell
    order, starts, chunks = _by_chunk(cells)
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
        for begin, end, corner in zip(starts[:-1], starts[1:], chunks, strict=True):
            rows = order[begin:end]
            size = np.minimum(_CHUNK, np.array(shape) - corner)
            box = np.full((m,) * lead + tuple(size), fill, dtype=values.dtype)
            box[..., *(cells[rows] - corner).T] = values[..., rows]
            array[..., *(slice(a, a + b) for a, b in zip(corner, size, strict=True))] = box
    _write_coordinates(group, done)


def _by_chunk(cells: NDArray[np.int64]) -> tuple[NDArray[np.intp], Any, NDArray[np.int64]]:
    """Order of rows by chunk, where each chunk's rows start (and end), the chunks' corners."""
    if not len(cells):
        return np.empty(0, np.intp), np.zeros(1, np.int64), np.empty((0, 3), np.int64)
    corners = cells // _CHUNK * _CHUNK
    key = cell_keys(corners)
    order = np.argsort(key, kind="stable")
    firsts = np.flatnonzero(np.diff(key[order], prepend=-1))
    return order, np.append(firsts, len(order)), corners[order[firsts]]


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
    """Rows of the cells that were reached, slab by slab."""
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
    names = list(parts[0].arrays)
    # slabs follow each other along x, so keys ascend
    return CellTable(*(np.concatenate([getattr(p, n) for p in parts], axis=-1) for n in names))
