"""Evaluate the stiffness experiment: measured and modelled stiffness of each series."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stiffopt.arrays import Array
from stiffopt.experiments.probing import PointsFile, SeriesPoints
from stiffopt.experiments.slope import LineFit, SlopeEstimate, combine, fit_lines
from stiffopt.experiments.stiffness import StiffnessSettings
from stiffopt.logs import StiffnessTable
from stiffopt.model.manipulator import Manipulator

_CURVE = 61  # pressures of the model's curves
_UNKNOWN = SlopeEstimate(math.nan, math.nan, math.nan, math.nan, 0)


@dataclass(frozen=True)
class StiffnessCell:
    """Stiffness at one pressure in one direction."""

    pressure: float  # of the channel, in Pa
    direction: tuple[float, float, float]  # unit vector in the base frame
    # from the displacement of the tip, in N/m; None if no repetition gave a slope
    estimate: SlopeEstimate | None
    # the same from the position of the stage; lower, since contact and sensor yield too
    by_stage: SlopeEstimate | None
    slopes: tuple[float, ...]  # of the repetitions, in N/m
    points: int  # number of points in contact, in all repetitions
    model: float  # stiffness of the model, in N/m


@dataclass(frozen=True, eq=False)
class StiffnessResult:
    """Measured and modelled stiffness of an experiment.

    Attributes
    ----------
    settings : of the experiment.
    cells : one for each pressure and direction.
    curve_pressures : pressures of the channel (K,), in Pa, of the model's curves.
    curves : stiffness of the model (K, d) along the d directions, in N/m.
    """

    settings: StiffnessSettings
    cells: tuple[StiffnessCell, ...]
    curve_pressures: Array
    curves: Array

    def along(self, direction: Sequence[float]) -> list[StiffnessCell]:
        """Return the cells of one direction, in order of pressure."""
        found = [cell for cell in self.cells if cell.direction == tuple(direction)]
        return sorted(found, key=lambda cell: cell.pressure)

    def beside(self, table: StiffnessTable) -> list[tuple[int, StiffnessCell]]:
        """Return the free rows of a table with the cells of the same pressures and direction."""
        return [
            (row, cell)
            for row in range(len(table.stiffness))
            for cell in self.cells
            if table.boundaries[row] == "free"
            and np.allclose(self.settings.pressures_at(cell.pressure), table.pressures[row], atol=1)
            and abs(np.dot(cell.direction, table.directions[row])) > 1 - 1e-6
        ]

    def table(self) -> StiffnessTable:
        """Return the results as a table, for `write_stiffness_table`."""
        cells = self.cells
        estimates = [cell.estimate or _UNKNOWN for cell in cells]
        by_stage = [cell.by_stage or _UNKNOWN for cell in cells]
        return StiffnessTable(
            pressures=np.stack([self.settings.pressures_at(cell.pressure) for cell in cells]),
            directions=np.array([cell.direction for cell in cells]),
            boundaries=("free",) * len(cells),
            stiffness=np.array([e.value for e in estimates]),
            sigma=np.array([e.sigma for e in estimates]),
            others={
                "ci95_n_per_m": np.array([e.half_width for e in estimates]),
                "spread_n_per_m": np.array([e.spread for e in estimates]),
                "repetitions": np.array([float(len(cell.slopes)) for cell in cells]),
                "points": np.array([float(cell.points) for cell in cells]),
                "by_stage_n_per_m": np.array([e.value for e in by_stage]),
                "model_n_per_m": np.array([cell.model for cell in cells]),
            },
        )


def evaluate_stiffness(
    folder: Path, settings: StiffnessSettings, model: Manipulator
) -> StiffnessResult:
    """Fit the stiffness of all series in a folder, and compare it with a model.

    `folder`: of an experiment, complete or not. Raises `FileError`: the points cannot be read.
    """
    series = PointsFile(folder, settings.channels).read()
    top = max(settings.pressures)
    pressures = np.linspace(min(0.0, *settings.pressures), top, _CURVE if top > 0 else 1)
    directions = np.array(settings.directions)
    expected = model.stiffness(
        np.stack([settings.pressures_at(p) for p in settings.pressures]), directions
    )
    cells = tuple(
        _cell(series, pressure, direction, float(expected[i, j]))
        for i, pressure in enumerate(settings.pressures)
        for j, direction in enumerate(settings.directions)
    )
    curves = model.stiffness(np.stack([settings.pressures_at(p) for p in pressures]), directions)
    return StiffnessResult(settings, cells, pressures, curves)


def _cell(
    series: Sequence[SeriesPoints],
    pressure: float,
    direction: tuple[float, float, float],
    model: float,
) -> StiffnessCell:
    mine = [
        one
        for one in series
        if abs(one.key.pressure - pressure) < 1.0
        and np.allclose(one.key.direction, direction, atol=1e-6)
    ]
    lines = _lines(mine, [one.displacement for one in mine])
    return StiffnessCell(
        pressure=pressure,
        direction=direction,
        estimate=combine(lines),
        by_stage=combine(_lines(mine, [one.stage for one in mine])),
        slopes=tuple(line.slope for line in lines),
        points=sum(line.points for line in lines),
        model=model,
    )


def _lines(series: Sequence[SeriesPoints], displacements: Sequence[Array]) -> list[LineFit]:
    """Fit force over displacement for points in contact, with time as a trend for creep."""
    return fit_lines(
        [
            (displacement[one.touching], one.force[one.touching], one.time[one.touching])
            for one, displacement in zip(series, displacements, strict=True)
        ]
    )
