"""The paper's discretisation: products of exponentials and sums over elements."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from independent.arms import Arm
from independent.motions import Vector, hat6, shift, wrench_map
from independent.sections import CentroidSection, section


def five_exponentials(kappa_x: float, kappa_y: float, s: float) -> Vector:
    """One arc as the product of the five exponentials of eqs 6 and 7 and Table I."""
    kappa = np.hypot(kappa_x, kappa_y)
    phi = -np.arctan2(kappa_x, kappa_y)
    chord = 2 / kappa * np.sin(kappa * s / 2) if kappa else s
    z, y, slide = np.eye(6)[5], np.eye(6)[4], np.eye(6)[2]
    links = [(z, phi), (y, kappa * s / 2), (slide, chord), (y, kappa * s / 2), (z, -phi)]
    T = np.eye(4)
    for screw, amplitude in links:
        T = T @ expm(hat6(screw * amplitude))
    return T


def _element(segment: CentroidSection, s: float) -> Vector:
    """Motion of the axis along an element whose centroid line has length s."""
    x, y = segment.centroid
    return shift(x, y, 0) @ five_exponentials(*segment.curvature, s) @ shift(-x, -y, 0)


@dataclass
class Discretised:
    """Tip pose (4, 4) and compliance (6, 6) in tip axes by sums over elements."""

    pose: Vector = field(default_factory=lambda: np.eye(4))
    compliance: Vector = field(default_factory=lambda: np.zeros((6, 6)))


def discretise(arm: Arm, p: ArrayLike, n: int) -> Discretised:
    """The arm by n elements per segment (eqs 5-10, 16, 17), elements at their middle."""
    T = np.eye(4)
    middles: list[tuple[Vector, Vector]] = []  # pose and flexibility times length
    for tube, own in zip(arm.tubes, arm.split(p), strict=True):
        law = section(tube, own)
        s = tube.length * law.stretch / n
        whole, half = _element(law, s), _element(law, s / 2)
        to_axis = shift(*law.centroid, 0)
        for _ in range(n):
            middles.append((T @ half @ to_axis, law.flexibility * s))
            T = T @ whole
        T = T @ shift(0, 0, tube.connector)
    C = np.zeros((6, 6))
    for T_0i, flexibility in middles:
        inverse = np.linalg.inv(wrench_map(np.linalg.inv(T) @ T_0i))  # Ad_ti^-1
        C += inverse.T @ flexibility @ inverse
    return Discretised(T, C)
