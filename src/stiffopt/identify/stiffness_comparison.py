"""Measured stiffnesses beside what a robot file predicts before and after its calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from stiffopt.errors import StiffoptError
from stiffopt.logs import StiffnessTable
from stiffopt.model.compliance import Boundary
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator

__all__ = ["StiffnessComparison", "compare_stiffness"]


@dataclass(frozen=True)
class StiffnessComparison:
    """A measured stiffness and its predictions.

    Attributes
    ----------
    pressures : of the channels, in Pa.
    direction : unit vector in the base frame.
    boundary : ``free``, ``guided`` or ``clamped``.
    measured : in N/m.
    sigma : its standard uncertainty, in N/m.
    before, after : predictions of the robot file before and after calibration, in N/m; None where
        the model has no equilibrium.
    """

    pressures: tuple[float, ...]
    direction: tuple[float, float, float]
    boundary: str
    measured: float
    sigma: float
    before: float | None
    after: float | None


def compare_stiffness(
    tables: Sequence[StiffnessTable], before: RobotDescription, after: RobotDescription
) -> list[StiffnessComparison]:
    """Compare all rows of tables in which a stiffness was measured."""
    arms = [Manipulator(before), Manipulator(after)]
    found = []
    for table in tables:
        for i in np.flatnonzero(np.isfinite(table.stiffness)):
            pressures, boundary = table.pressures[i], table.boundaries[i]
            x, y, z = map(float, table.directions[i])
            predicted = [
                _predicted(arm, pressures, (x, y, z), cast(Boundary, boundary)) for arm in arms
            ]
            found.append(
                StiffnessComparison(
                    tuple(map(float, pressures)),
                    (x, y, z),
                    boundary,
                    float(table.stiffness[i]),
                    float(table.sigma[i]),
                    *predicted,
                )
            )
    return found


def _predicted(
    arm: Manipulator,
    pressures: np.ndarray,
    direction: tuple[float, float, float],
    boundary: Boundary,
) -> float | None:
    try:
        return float(arm.stiffness(pressures, direction, boundary=boundary))
    except StiffoptError:  # the arm buckles there, or its strain law ends
        return None
