"""A discrete rod and its potential energy, differentiated by complex steps."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from independent.arms import Arm
from independent.motions import Vector, shift
from independent.sections import rod_section


class DiscreteRod:
    """An arm of elements of constant strain and its potential energy, dead loads only.

    The unknowns are the strains (k, 6) of the elements; derivatives by complex steps.
    """

    def __init__(self, arm: Arm, p: ArrayLike, n: int, force: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        gravity = np.asarray(arm.gravity)
        self.force = np.asarray(force, dtype=float) + arm.tip_mass * gravity
        sections = [
            rod_section(tube, own, gravity)
            for tube, own in zip(arm.tubes, arm.split(p), strict=True)
        ]
        self.h = np.repeat([tube.length / n for tube in arm.tubes], n)
        self.connector = np.zeros(n * len(arm.tubes))
        self.connector[n - 1 :: n] = [tube.connector for tube in arm.tubes]
        self.free = np.repeat([law.strain for law in sections], n, axis=0)
        self.stiffness = np.repeat([np.linalg.inv(law.compliance) for law in sections], n, axis=0)
        self.weight = np.repeat([law.weight for law in sections], n, axis=0)
        self.centroid = np.repeat([law.centroid for law in sections], n, axis=0)
        # strains in units of which the elastic energy is a sum of squares
        self.scale = np.repeat([np.linalg.cholesky(law.compliance) for law in sections], n, axis=0)
        self.scale = self.scale / np.sqrt(self.h)[:, np.newaxis, np.newaxis]

    def _energy(self, x: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Energy (b,) and tip position (b, 3) for unknowns (b, 6 k)."""
        y = x.reshape(len(x), -1, 6)
        extra = np.einsum("kij,bkj->bki", self.scale, y)
        half = _exp_series((self.free + extra) * self.h[:, np.newaxis] / 2)
        T = np.broadcast_to(np.eye(4), (len(x), 4, 4))
        energy = 0.5 * np.sum(y**2, axis=(1, 2))
        for k in range(len(self.h)):
            middle = T @ half[:, k]
            place = middle[:, :3, 3] + middle[:, :3, :3] @ self.centroid[k]
            energy = energy - self.h[k] * place @ self.weight[k]
            T = middle @ half[:, k]
            if self.connector[k]:
                T = T @ shift(0, 0, self.connector[k])
        tip = T[:, :3, 3]
        return energy - tip @ self.force, tip

    def gradient(self, x: Vector) -> Vector:
        """Derivative (6 k,) of the energy."""
        step = 1e-30
        return self._energy(x + 1j * step * np.eye(x.size))[0].imag / step

    def hessian(self, x: Vector) -> Vector:
        """Second derivative (6 k, 6 k), by central differences of the gradient."""
        step = 1e-4 * np.sqrt(self.unit)
        columns = [
            (self.gradient(x + e) - self.gradient(x - e)) / (2 * step)
            for e in step * np.eye(x.size)
        ]
        H = np.array(columns)
        return (H + H.T) / 2

    @property
    def unit(self) -> float:
        """An energy that is typical of the rod: half a radian over its whole length."""
        return float(np.min(self.stiffness[:, 4, 4]) / self.h.sum() / 8)

    def minimum(self, x: Vector | None = None) -> tuple[Vector, Vector]:
        """Unknowns and tip position (3,) where the gradient vanishes, by damped Newton."""
        x = np.zeros(self.free.size) if x is None else x
        for _ in range(60):
            step = np.linalg.solve(self.hessian(x), -self.gradient(x))
            x = x + step * min(1.0, np.sqrt(self.unit) / np.linalg.norm(step))
            if np.linalg.norm(step) < 1e-9 * np.sqrt(self.unit):
                return x, self._energy(x[np.newaxis])[1][0]
        raise AssertionError("the discrete rod's energy has no minimum near")


def _exp_series(twist: NDArray[Any]) -> NDArray[Any]:
    """Exponentials (..., 4, 4) of small twists (..., 6), real or complex, by power series."""
    v, w = twist[..., :3], twist[..., 3:]
    W = np.zeros((*w.shape, 3), dtype=twist.dtype)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        W[..., k, j], W[..., j, k] = w[..., i], -w[..., i]
    x = np.sum(w**2, axis=-1)[..., np.newaxis, np.newaxis]
    first = 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110))))
    second = (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90 * (1 - x / 132))))) / 2
    third = (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110 * (1 - x / 156))))) / 6
    T = np.zeros((*w.shape[:-1], 4, 4), dtype=twist.dtype)
    W2 = W @ W
    T[..., :3, :3] = np.eye(3) + first * W + second * W2
    T[..., :3, 3] = ((np.eye(3) + second * W + third * W2) @ v[..., np.newaxis])[..., 0]
    T[..., 3, 3] = 1
    return T
