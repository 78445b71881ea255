"""Convert a workspace map to a cloud of points, coloured by stiffness."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.display import FIGURES, display_units
from stiffopt.errors import InputError
from stiffopt.model.description import RobotDescription
from stiffopt.workspace.map import WorkspaceMap

_MAX_POINTS = 30_000  # sent to the browser
_SCALE = np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)])


class StiffnessCloud(NamedTuple):
    """The cells of a map with their stiffness in one direction."""

    points: NDArray[np.float32]  # (m, 3), centres of cells in m
    colours: NDArray[np.uint8]  # (m, 3), from violet (soft) to yellow (stiff)
    legend: str  # meaning of the colours, in words
    size: float  # of a point, in m

    @classmethod
    def of(cls, found: WorkspaceMap, direction: int, cut: float = -np.inf) -> StiffnessCloud:
        """Return the largest stiffness of cells beyond y = `cut` (m), in a direction (from 0)."""
        best = found.best[direction]
        low, high = np.log(np.nanpercentile(best, (2, 98)))
        kept = np.flatnonzero(np.isfinite(best) & (found.centres[:, 1] >= cut))
        kept = kept[:: max(1, -(-len(kept) // _MAX_POINTS))]
        values = best[kept]
        if not len(values):
            raise InputError("the map has no cells to show there")
        share = np.clip((np.log(values) - low) / max(high - low, 1e-12), 0, 1) * (len(_SCALE) - 1)
        colours = np.stack(
            [np.interp(share, np.arange(len(_SCALE)), column) for column in _SCALE.T], axis=1
        )
        unit = display_units().of_si(found.plan.unit)
        soft, stiff = (unit.number(float(np.exp(end)), FIGURES) for end in (low, high))
        name = found.direction_names[direction]
        legend = f"stiffest along {name}: violet {soft}, yellow {stiff} {unit}"
        return cls(
            found.centres[kept].astype(np.float32), colours.astype(np.uint8), legend,
            0.12 * found.plan.cell,
        )  # fmt: skip


def check_map(found: WorkspaceMap, description: RobotDescription) -> None:
    """Raise `InputError` unless a map's robot has the same segments."""
    if found.plan.robot.description.segments != description.segments:
        raise InputError(
            f"--map: the map is of '{found.plan.robot.description.name}', which is another arm "
            f"than '{description.name}'"
        )
