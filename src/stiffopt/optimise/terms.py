"""What a target asks of the tip's pose, term by term, as residuals with tolerances.

A term splits into its *structure*, for which functions are compiled, and its *parameters*, which
are arguments of them.  To add a term, subclass `PoseTerm` and have `pose_terms` make it from the
target.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.optimise.target import Target

Vector = NDArray[np.float64]

_ALIGNED = 1e-8  # squared sine of an angle below which its series is used


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
        return math.sqrt(self.residual @ self.residual)


class PoseTerm(ABC):
    """One thing that a target asks of the pose.

    Attributes
    ----------
    name : str
        "position" (its residual in m) or "angle" (in rad).
    radius : float
        Tolerance of the residual's length.
    size : int
        Number k of components of the residual.
    """

    name: str
    size: int

    def __init__(self, radius: float) -> None:
        self.radius = radius

    @property
    @abstractmethod
    def structure(self) -> Hashable:
        """What the compiled function depends on."""

    @property
    @abstractmethod
    def parameters(self) -> tuple[float, ...]:
        """Its arguments, always as many for one structure."""

    @abstractmethod
    def residual(self, position: Any, rotation: Any, parameters: Any) -> Any:
        """Symbolic residual (k,) of a pose for symbolic parameters."""


class PositionTerm(PoseTerm):
    """Position of the tip along the base axes that are not free."""

    name = "position"

    def __init__(self, position: tuple[float | None, ...], radius: float) -> None:
        super().__init__(radius)
        self.axes = tuple(axis for axis, value in enumerate(position) if value is not None)
        self._wanted = tuple(value for value in position if value is not None)
        self.size = len(self.axes)

    @property
    def structure(self) -> Hashable:
        """The axes that are asked for."""
        return ("position", self.axes)

    @property
    def parameters(self) -> tuple[float, ...]:
        """The position along these axes."""
        return self._wanted

    def residual(self, position: Any, rotation: Any, parameters: Any) -> Any:
        """Difference to the wanted position; see `PoseTerm.residual`."""
        return position[list(self.axes)] - parameters


class PointingTerm(PoseTerm):
    """Direction of the tip's z axis: its angle to a unit vector.

    The axis is unrolled from the sphere onto the plane that touches it at the wanted direction
    (azimuthal equidistant projection), so that the residual's length is the angle.
    """

    name = "angle"
    size = 2

    def __init__(self, direction: tuple[float, ...], radius: float) -> None:
        super().__init__(radius)
        self._direction = direction

    @property
    def structure(self) -> Hashable:
        """Nothing but its kind."""
        return ("pointing",)

    @property
    def parameters(self) -> tuple[float, ...]:
        """The direction, and two unit vectors across it."""
        x, y, z = self._direction
        # J. Duff et al., Building an Orthonormal Basis, Revisited, JCGT 6 (2017)
        sign = math.copysign(1.0, z)
        a = -1.0 / (sign + z)
        b = x * y * a
        return (x, y, z, 1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y)

    def residual(self, position: Any, rotation: Any, parameters: Any) -> Any:
        """Unrolled axis (2,); see `PoseTerm.residual`."""
        axis = rotation[:, 2]
        cosine = ca.dot(parameters[:3], axis)
        flat = ca.vertcat(ca.dot(parameters[3:6], axis), ca.dot(parameters[6:], axis))
        square = ca.sumsqr(flat)
        aligned = square < _ALIGNED
        sine = ca.sqrt(ca.if_else(aligned, _ALIGNED, square))
        factor = ca.if_else(aligned, 1 + square / 6, ca.atan2(sine, cosine) / sine)
        # exactly opposite every way round is as good: take one
        opposite = ca.logic_and(aligned, cosine < 0)
        return factor * flat + ca.vertcat(ca.if_else(opposite, np.pi, 0), 0)


class OrientationTerm(PoseTerm):
    """Orientation of the tip: the rotation vector from the wanted one."""

    name = "angle"
    size = 3

    def __init__(self, quaternion: tuple[float, ...], radius: float) -> None:
        super().__init__(radius)
        self._quaternion = quaternion

    @property
    def structure(self) -> Hashable:
        """Nothing but its kind."""
        return ("orientation",)

    @property
    def parameters(self) -> tuple[float, ...]:
        """The wanted unit quaternion."""
        return self._quaternion

    def residual(self, position: Any, rotation: Any, parameters: Any) -> Any:
        """Rotation vector (3,); see `PoseTerm.residual`."""
        wanted = lie.rotation_from_quaternion(parameters)
        turn = lie.quaternion_from_rotation(wanted.T @ rotation)
        return lie.rotation_vector_from_quaternion(turn)


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
    found = {}
    for term in pose_terms(target):
        residual = _residual_function(term)(tip_pose[:3, 3], tip_pose[:3, :3], term.parameters)
        none = np.zeros((term.size, 0))
        found[term.name] = Ball(term.name, residual.full()[:, 0], none, term.radius)
    return found


_functions: dict[Hashable, ca.Function] = {}


def _residual_function(term: PoseTerm) -> ca.Function:
    """Residual of a pose as a function, one for each structure."""
    if term.structure not in _functions:
        position, rotation = ca.SX.sym("r", 3), ca.SX.sym("R", 3, 3)
        parameters = ca.SX.sym("parameters", len(term.parameters))
        residual = term.residual(position, rotation, parameters)
        _functions[term.structure] = ca.Function(
            "residual", [position, rotation, parameters], [ca.densify(residual)]
        )
    return _functions[term.structure]
