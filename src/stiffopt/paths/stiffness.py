"""Stiffness of many configurations of an arm, free or loaded, at the cost of their shapes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.goal import StiffnessMeasure

Vector = NDArray[np.float64]


def least_stiffness(robot: Manipulator, p: Vector, measures: Sequence[StiffnessMeasure]) -> Vector:
    """The smallest of several stiffnesses of the tip (N,) at pressures (N, n)."""
    C = robot.compliance_between(p, robot.length, robot.length)
    R = robot.pose(p, robot.length)[:, :3, :3]
    found: Vector = np.min([_stiffness(C, R, each) for each in measures], axis=0)
    return found


def _stiffness(C: Vector, R: Vector, measure: StiffnessMeasure) -> Vector:
    """One stiffness (N,) of compliances (N, 6, 6) in base axes; see `Manipulator.stiffness`."""
    d = np.broadcast_to(np.array(measure.direction), (len(C), 3))
    if measure.frame == "tip":
        d = (R @ d[..., None])[..., 0]
    part = slice(0, 3) if measure.kind == "translation" else slice(3, 6)
    if measure.boundary == "clamped":
        K = np.linalg.inv(C)[:, part, part]
    elif measure.boundary == "guided":
        K = np.linalg.inv(C[:, part, part])
    else:
        flexibility: Vector = np.einsum("ni,nij,nj->n", d, C[:, part, part], d)
        return 1 / flexibility
    found: Vector = np.einsum("ni,nij,nj->n", d, K, d)
    return found
