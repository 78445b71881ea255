"""What a target asks of the tip's pose, term by term, as residuals with tolerances.

To add a term, subclass `PoseTerm` and have `pose_terms` make it from the target.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.optimise.target import Target

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Ball:
    """A residual of the pose that shall not leave a ball.

    Attributes
    ----------
    name : str
        "position" (m) or "angle" (rad).
    residual : ndarray (k,)
    jacobian : ndarray (k, n)
        Per variable.
    radius : float
    """

    name: str
    residual: Vector
    jacobian: Vector
    radius: float

    @property
    def error(self) -> float:
        """Length of the residual."""
        return float(np.linalg.norm(self.residual))


class PoseTerm(ABC):
    """One thing that a target asks of the pose.

    Attributes
    ----------
    name : str
        "position" (its residual in m) or "angle" (in rad).
    radius : float
        Tolerance of the residual's length.
    """

    name: str

    def __init__(self, radius: float) -> None:
        self.radius = radius

    @abstractmethod
    def residual(self, position: Vector, rotation: Vector) -> tuple[Vector, Vector]:
        """Residual (k,) of a pose, and its derivative (k, 6) by a body twist of the tip."""

    def ball(self, position: Vector, rotation: Vector, jacobian: Vector) -> Ball:
        """Residual of a pose whose body twist per variable is `jacobian` (6, n)."""
        residual, per_twist = self.residual(position, rotation)
        return Ball(self.name, residual, per_twist @ jacobian, self.radius)


class PositionTerm(PoseTerm):
    """Position of the tip along the base axes that are not free."""

    name = "position"

    def __init__(self, position: tuple[float | None, ...], radius: float) -> None:
        super().__init__(radius)
        self._asked = [axis for axis, value in enumerate(position) if value is not None]
        self._wanted = np.array([value for value in position if value is not None])

    def residual(self, position: Vector, rotation: Vector) -> tuple[Vector, Vector]:
        """Difference to the wanted position; see `PoseTerm.residual`."""
        per_twist = np.hstack([rotation, np.zeros((3, 3))])[self._asked]
        return position[self._asked] - self._wanted, per_twist


class PointingTerm(PoseTerm):
    """Direction of the tip's z axis: its angle to a unit vector.

    The axis is unrolled from the sphere onto the plane that touches it at the wanted direction
    (azimuthal equidistant projection), so that the residual's length is the angle.
    """

    name = "angle"

    def __init__(self, direction: tuple[float, ...], radius: float) -> None:
        super().__init__(radius)
        self._wanted = np.array(direction)
        self._across = np.linalg.svd(self._wanted[np.newaxis])[2][1:]  # (2, 3)

    def residual(self, position: Vector, rotation: Vector) -> tuple[Vector, Vector]:
        """Unrolled axis (2,); see `PoseTerm.residual`."""
        axis = rotation[:, 2]
        cosine = float(np.clip(self._wanted @ axis, -1.0, 1.0))
        flat = self._across @ axis
        sine = float(np.hypot(*flat))
        if sine > 1e-4:
            factor = np.arctan2(sine, cosine) / sine
            slope = (cosine * factor - 1) / sine**2  # of the factor by the cosine
        elif cosine > 0:
            factor, slope = 1.0 + sine**2 / 6, -1 / 3
        else:  # opposite: every way round is as good
            return np.array([np.pi, 0.0]), self._across @ _axis_per_twist(rotation)
        per_axis = factor * self._across + slope * np.outer(flat, self._wanted)
        return factor * flat, per_axis @ _axis_per_twist(rotation)


class OrientationTerm(PoseTerm):
    """Orientation of the tip: the rotation vector from the wanted one."""

    name = "angle"

    def __init__(self, quaternion: tuple[float, ...], radius: float) -> None:
        super().__init__(radius)
        self._wanted = lie.rotation_from_quaternion(np.array(quaternion))

    def residual(self, position: Vector, rotation: Vector) -> tuple[Vector, Vector]:
        """Rotation vector (3,); see `PoseTerm.residual`."""
        q = lie.quaternion_from_rotation(self._wanted.T @ rotation)
        vector = lie.rotation_vector_from_quaternion(q)
        square = float(vector @ vector)
        first, second, _ = lie.exponential_coefficients(max(square, 1e-12))
        W = lie.hat(vector)
        # inverse of the right Jacobian of SO(3)
        factor = 1 / 12 if square < 1e-8 else (1 - first / (2 * second)) / square
        per_turn = np.eye(3) + 0.5 * W + factor * (W @ W)
        return vector, np.hstack([np.zeros((3, 3)), per_turn])


def _axis_per_twist(rotation: Vector) -> Vector:
    """Derivative (3, 6) of the tip's z axis by a body twist: a turn (a, b, c) adds b x - a y."""
    x, y = rotation[:, 0], rotation[:, 1]
    zero = np.zeros(3)
    return np.column_stack([zero, zero, zero, -y, x, zero])


def pose_terms(target: Target) -> tuple[PoseTerm, ...]:
    """Terms of a target: the position's first, then the angle's."""
    tolerance = target.tolerance
    terms: list[PoseTerm] = []
    if target.position is not None:
        terms.append(PositionTerm(target.position, tolerance.position))
    if target.pointing is not None:
        terms.append(PointingTerm(target.pointing, tolerance.angle))
    if target.orientation is not None:
        terms.append(OrientationTerm(target.orientation, tolerance.angle))
    return tuple(terms)


def pose_errors(target: Target, tip_pose: Vector) -> dict[str, Ball]:
    """Residuals of a tip pose (4, 4) from a target, by name."""
    nothing = np.zeros((6, 0))
    return {
        term.name: term.ball(tip_pose[:3, 3], tip_pose[:3, :3], nothing)
        for term in pose_terms(target)
    }
