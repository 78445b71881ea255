"""`WorkspaceMap`: the cells that the tip reaches, and the stiffness range in each."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.directions import direction_name
from stiffopt.workspace.plan import MapPlan
from stiffopt.workspace.table import CellTable

Numbers = NDArray[np.int64]
Quantity = Literal["count", "best", "worst", "best_sample", "worst_sample"]

FILL = {"count": 0, "best": np.nan, "worst": np.nan, "best_sample": -1, "worst_sample": -1}
"""Values of cells that no sample reached."""


class Extreme(NamedTuple):
    """The stiffest, or the softest, of all samples in one direction.

    Attributes
    ----------
    stiffness : in N/m, for a rotation in N m/rad.
    sample : number of the sample.
    pressures : (n,) in Pa.
    cell_centre : (3,) centre of the tip's cell, in m.
    """

    stiffness: float
    sample: int
    pressures: Array
    cell_centre: Array


@dataclass(frozen=True)
class WorkspaceMap:
    """The cells of space that the tip reaches, with the range of stiffness in each.

    Rows are the M cells that a sample reached, in the order of their indices; `grid` returns them
    as a box.

    Attributes
    ----------
    plan : the samples and their evaluation.
    table : the results.
    lost : number of samples at which the arm has no stable equilibrium.
    low, high : (3,) least and greatest coordinates of the tip, in m; NaN if no sample has one.
    path : where it is stored, or None.
    evaluated : number of samples evaluated in this run; fewer than all if the map was resumed.
    """

    plan: MapPlan
    table: CellTable
    lost: int
    low: Array
    high: Array
    path: Path | None = None
    evaluated: int = 0

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.plan.total

    @property
    def direction_names(self) -> tuple[str, ...]:
        """Names of the directions."""
        return tuple(direction_name(measure.direction) for measure in self.plan.measures)

    @property
    def count(self) -> Numbers:
        """Number of samples (M,) in each cell."""
        return self.table.count

    @property
    def best(self) -> Array:
        """Greatest stiffness (m, M) that a sample has in each direction and cell."""
        return self.table.best

    @property
    def worst(self) -> Array:
        """Least stiffness (m, M) that a sample has in each direction and cell."""
        return self.table.worst

    @property
    def ratio(self) -> Array:
        """Ratio (m, M) of greatest to least stiffness: the range of choice at a place."""
        return np.asarray(self.best / self.worst)

    @property
    def best_sample(self) -> Numbers:
        """Number (m, M) of the stiffest sample; see `pressures`."""
        return self.table.best_sample

    @property
    def worst_sample(self) -> Numbers:
        """Number (m, M) of the softest sample; see `pressures`."""
        return self.table.worst_sample

    @cached_property
    def cells(self) -> Numbers:
        """Indices (M, 3) of the cells; cell (i, j, k) is centred at (i, j, k) times its size."""
        return self.table.cells

    @property
    def centres(self) -> Array:
        """Centres (M, 3) of the cells in the base frame, in m."""
        return np.asarray(self.cells * self.plan.cell, dtype=np.float64)

    @property
    def volume(self) -> float:
        """Volume of the cells that were reached, in m^3."""
        return len(self.table) * self.plan.cell**3

    @cached_property
    def first_cell(self) -> Numbers:
        """Least indices (3,) of a cell that was reached: the corner of `grid`."""
        return self.cells.min(axis=0) if len(self.table) else np.zeros(3, np.int64)

    @cached_property
    def shape(self) -> tuple[int, int, int]:
        """Number of cells along each axis of the box that contains all cells."""
        if not len(self.table):
            return (0, 0, 0)
        x, y, z = (self.cells.max(axis=0) - self.first_cell + 1).tolist()
        return (x, y, z)

    def pressures(self, sample: int) -> Array:
        """Return the pressures (n,) of a sample in Pa."""
        return np.asarray(self.plan.sampling.pressures(int(sample), int(sample) + 1)[0])

    def grid(self, name: Quantity) -> NDArray[np.generic]:
        """Return a quantity in the box of all cells, (x, y, z) or (m, x, y, z).

        Cells that no sample reached hold NaN, samples -1, counts 0.
        """
        values = getattr(self, name)
        box = np.full((*values.shape[:-1], *self.shape), FILL[name], dtype=values.dtype)
        box[..., *(self.cells - self.first_cell).T] = values
        return box

    def best_in(self, direction: int) -> Extreme | None:
        """Return the stiffest sample in a direction, counted from 0; None if no tip was found."""
        return self._extreme(-self.best[direction], self.best, self.best_sample, direction)

    def worst_in(self, direction: int) -> Extreme | None:
        """Return the softest sample in a direction, counted from 0; None if no tip was found."""
        return self._extreme(self.worst[direction], self.worst, self.worst_sample, direction)

    def _extreme(
        self, ranks: Array, values: Array, samples: Numbers, direction: int
    ) -> Extreme | None:
        if not len(self.table):
            return None
        row = min(np.flatnonzero(ranks == ranks.min()), key=lambda r: samples[direction, r])
        sample = int(samples[direction, row])
        return Extreme(
            float(values[direction, row]), sample, self.pressures(sample), self.centres[row]
        )
