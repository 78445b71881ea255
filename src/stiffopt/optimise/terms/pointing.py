"""Term `pointing`: angle between the tip's z axis and a unit vector."""

import math
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.directions import Direction
from stiffopt.optimise.term import Nearness, Term

_ALIGNED = 1e-8  # squared sine of an angle below which its series is used


class PointingTerm(Term):
    """Angle between the tip's z axis and a direction.

    The azimuthal equidistant projection maps the axis from the sphere to the plane that touches it
    at the wanted direction, so that the residual's length is the angle.
    """

    key = "pointing"
    annotation = Direction
    name, unit = "angle", "rad"
    example: ClassVar[Any] = [0.1, -0.2, 0.9]
    order = 1
    size = 2

    @property
    def parameters(self) -> tuple[float, ...]:
        """The direction, and two unit vectors across it."""
        x, y, z = self.value
        # J. Duff et al., Building an Orthonormal Basis, Revisited, JCGT 6 (2017)
        sign = math.copysign(1.0, z)
        a = -1.0 / (sign + z)
        b = x * y * a
        return (x, y, z, 1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y)

    def residual(self, tip: Any, parameters: Any) -> Any:
        """Return the projected axis (2,); see `Term.residual`."""
        axis = tip.rotation[:, 2]
        cosine = ca.dot(parameters[:3], axis)
        flat = ca.vertcat(ca.dot(parameters[3:6], axis), ca.dot(parameters[6:], axis))
        square = ca.sumsqr(flat)
        aligned = square < _ALIGNED
        sine = ca.sqrt(ca.if_else(aligned, _ALIGNED, square))
        factor = ca.if_else(aligned, 1 + square / 6, ca.atan2(sine, cosine) / sine)
        # exactly opposite, all directions of the residual are equivalent: choose one
        opposite = ca.logic_and(aligned, cosine < 0)
        return factor * flat + ca.vertcat(ca.if_else(opposite, np.pi, 0), 0)

    def nearness(self, length: float) -> Nearness:
        """Return the chord ``|z - d| / pi``, whose square is ``(2 - 2 z . d) / pi^2``."""
        turn = (0.0,) * 6 + tuple(-2 * value / math.pi**2 for value in self.value)
        limit = 2 * math.sin(min(self.radius, math.pi) / 2) / math.pi
        return Nearness(offset=2 / math.pi**2, turn=turn, root=1.0, limit=limit)

    @classmethod
    def moved_back(cls, value: Any, offset: Array) -> Any:
        """See `Term.moved_back`."""
        back = lie.exp(np.concatenate([np.zeros(3), -offset[3:]]))[:3, :3]
        return tuple((back @ np.array(value)).tolist())
