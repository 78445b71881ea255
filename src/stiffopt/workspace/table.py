"""`CellTable`: cells that samples fell into, with the range of stiffness in each.

Cell (i, j, k) of size c is centred at (i, j, k) c in the base frame. Merging tables adds the
numbers of samples and keeps the greatest and least stiffness, each with the lowest sample number
that attains it, so the result does not depend on how samples are grouped.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.errors import InputError

Numbers = NDArray[np.int64]

_BITS = 20
_HALF = 1 << (_BITS - 1)
FARTHEST = _HALF - 1
"""Largest index of a cell along an axis."""

_NO_SAMPLE = np.iinfo(np.int64).max


@dataclass(frozen=True)
class CellTable:
    """The cells that samples fell into, for m directions, in the order of their keys."""

    key: Numbers  # (M,) packed indices of the cell, ascending
    count: Numbers  # (M,) number of samples
    best: Array  # (m, M) greatest stiffness
    worst: Array  # (m, M) least stiffness
    best_sample: Numbers  # (m, M) lowest number of a sample with the greatest stiffness
    worst_sample: Numbers  # (m, M) likewise for the least

    @classmethod
    def empty(cls, m: int) -> "CellTable":
        """Return a table without cells, for m directions."""
        none, values = np.empty(0, np.int64), np.empty((m, 0))
        return cls(none, none, values, values, values.astype(np.int64), values.astype(np.int64))

    @classmethod
    def of_samples(cls, key: Numbers, stiffness: Array, sample: Numbers) -> "CellTable":
        """Return the table of ascending samples in cells (k,), with stiffnesses (m, k)."""
        each = np.broadcast_to(sample, stiffness.shape)
        return _reduced(cls(key, np.ones(len(key), np.int64), stiffness, stiffness, each, each))

    def __len__(self) -> int:
        return len(self.key)

    @property
    def cells(self) -> Numbers:
        """Indices (M, 3) of the cells."""
        mask = (1 << _BITS) - 1
        parts = [self.key >> (2 * _BITS), (self.key >> _BITS) & mask, self.key & mask]
        return np.stack(parts, axis=1) - _HALF

    @property
    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """All columns by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


class MapPart(NamedTuple):
    """Results of some blocks of samples: of one block, or of the first ones."""

    blocks: int  # their number
    lost: int  # samples at which the arm has no stable equilibrium
    low: Array  # least coordinates (3,) of the tip, in m
    high: Array  # greatest coordinates (3,)
    table: CellTable


def cell_indices(position: Array, cell: float) -> Numbers:
    """Return the indices (k, 3) of the cells that contain positions (k, 3)."""
    return np.asarray(np.floor(position / cell + 0.5), dtype=np.int64)


def cell_keys(indices: Numbers) -> Numbers:
    """Pack indices (k, 3) of cells into one number each, with the same order."""
    shifted = indices + _HALF
    return np.asarray(
        (shifted[:, 0] << (2 * _BITS)) | (shifted[:, 1] << _BITS) | shifted[:, 2], dtype=np.int64
    )


def merged(tables: Sequence[CellTable]) -> CellTable:
    """Merge tables into one."""
    if len(tables) == 1:
        return tables[0]
    names = [field.name for field in fields(CellTable)]
    columns = [np.concatenate([getattr(t, name) for t in tables], axis=-1) for name in names]
    return _reduced(CellTable(*columns))


class Gathering:
    """A table that grows to at most `max_cells`; added tables are merged in batches."""

    _ENOUGH = 1 << 18  # rows

    def __init__(self, table: CellTable, max_cells: int) -> None:
        self._table = table
        self._max_cells = max_cells
        self._waiting: list[CellTable] = []
        self._rows = 0

    def add(self, table: CellTable) -> None:
        """Add a table."""
        self._waiting.append(table)
        self._rows += len(table)
        if self._rows > max(len(self._table) // 2, self._ENOUGH):
            self.table()

    def table(self) -> CellTable:
        """Return the table of everything added so far."""
        self._table = merged([self._table, *self._waiting])
        self._waiting, self._rows = [], 0
        if len(self._table) > self._max_cells:
            raise InputError(
                f"the workspace fills more than {self._max_cells:,} cells, which is more than a "
                "map may have; choose larger cells"
            )
        return self._table


def _reduced(rows: CellTable) -> CellTable:
    """Merge rows with the same key; return them in ascending order."""
    if not len(rows.key):
        return rows
    order = np.argsort(rows.key, kind="stable")
    key = rows.key[order]
    first = np.concatenate([[True], key[1:] != key[:-1]])
    starts = np.flatnonzero(first)
    group = np.cumsum(first) - 1
    worst, worst_sample = _least(rows.worst, rows.worst_sample, order, starts, group)
    best, best_sample = _least(-rows.best, rows.best_sample, order, starts, group)
    count = np.add.reduceat(rows.count[order], starts)
    return CellTable(key[starts], count, -best, worst, best_sample, worst_sample)


def _least(
    values: Array, samples: Numbers, order: NDArray[np.intp], starts: Numbers, group: Numbers
) -> tuple[Array, Numbers]:
    """Return each group's least value (m, M) and the lowest sample that attains it."""
    values = values[:, order]
    least = np.minimum.reduceat(values, starts, axis=1)
    holders = np.where(values == least[:, group], samples[:, order], _NO_SAMPLE)
    return least, np.minimum.reduceat(holders, starts, axis=1)
