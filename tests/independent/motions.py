"""Rigid motions as matrices, and derivatives by differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm

Vector = NDArray[np.float64]


def hat(w: ArrayLike) -> Vector:
    """Skew matrix of a 3-vector."""
    x, y, z = np.asarray(w)
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def hat6(twist: ArrayLike) -> Vector:
    """Matrix (4, 4) of a twist (eq. 2)."""
    twist = np.asarray(twist)
    matrix = np.zeros((4, 4), dtype=twist.dtype)
    matrix[:3, :3] = hat(twist[3:])
    matrix[:3, 3] = twist[:3]
    return matrix


def shift(x: float, y: float, z: float) -> Vector:
    """Motion by a translation."""
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def turn_z(angle: float) -> Vector:
    """Rotation (4, 4) about z."""
    return expm(hat6([0, 0, 0, 0, 0, angle]))


def wrench_map(T: Vector) -> Vector:
    """``Ad`` of eq. 5: ``W_a = Ad_ab W_b``."""
    R, zero = T[:3, :3], np.zeros((3, 3))
    return np.block([[R, zero], [hat(T[:3, 3]) @ R, R]])


def derivative(f: Callable[[Vector], Any], x: ArrayLike, step: float) -> Vector:
    """Derivative (..., k) of f at x (k,) by central differences of fourth order."""
    x = np.asarray(x, dtype=float)
    columns = []
    for e in step * np.eye(x.size):
        near = np.asarray(f(x + e)) - np.asarray(f(x - e))
        far = np.asarray(f(x + 2 * e)) - np.asarray(f(x - 2 * e))
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, axis=-1)


def body_twists(T: Vector, dT: Vector) -> Vector:
    """Body twists (6, k) of the changes dT (4, 4, k) of a pose."""
    change = np.einsum("ij,jlk->ilk", np.linalg.inv(T), dT)
    return np.array(
        [change[0, 3], change[1, 3], change[2, 3], change[2, 1], change[0, 2], change[1, 0]]
    )
