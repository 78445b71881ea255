"""Compute tip stiffness at many pressures at once, for a free or loaded arm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.goal import StiffnessMeasure

Vector = NDArray[np.float64]


def least_stiffness(robot: Manipulator, p: Vector, measures: Sequence[StiffnessMeasure]) -> Vector:
    """Return the smallest (N,) of several stiffnesses of the tip at pressures (N, n)."""
    C = robot.compliance_between(p, robot.length, robot.length)
    R = robot.pose(p, robot.length)[:, :3, :3]
    found: Vector = np.min([_stiffness(C, R, each) for each in measures], axis=0)
    return found


def _stiffness(C: Vector, R: Vector, measure: StiffnessMeasure) -> Vector:
    """Return a stiffness (N,) from compliances (N, 6, 6) and rotations of the tip, base axes."""
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
