"""Term `orientation`: rotation of the tip relative to the wanted orientation."""

import math
from typing import Any, ClassVar

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.directions import Quaternion
from stiffopt.optimise.term import Nearness, Term


class OrientationTerm(Term):
    """Rotation vector from the wanted orientation (a unit quaternion) to the tip's."""

    key = "orientation"
    annotation = Quaternion
    name, unit = "angle", "rad"
    example: ClassVar[Any] = [0.98, 0.17, 0.1, 0.0]
    order = 2
    size = 3

    @property
    def parameters(self) -> tuple[float, ...]:
        """The wanted unit quaternion."""
        return tuple(self.value)

    def residual(self, tip: Any, parameters: Any) -> Any:
        """Return the rotation vector (3,); see `Term.residual`."""
        wanted = lie.rotation_from_quaternion(parameters)
        turn = lie.quaternion_from_rotation(wanted.T @ tip.rotation)
        return lie.rotation_vector_from_quaternion(turn)

    def nearness(self, length: float) -> Nearness:
        """``|R - W| / (pi sqrt(2))``: ``|R - W|^2 = 6 - 2 <W, R>``, twice that of small angles."""
        factor = 1 / (2 * math.pi**2)
        W = lie.rotation_from_quaternion(np.array(self.value))
        turn = tuple((-2 * factor * W.T.ravel()).tolist())
        limit = 2 * math.sin(min(self.radius, math.pi) / 2) / math.pi
        return Nearness(offset=6 * factor, turn=turn, root=1.0, limit=limit)

    @classmethod
    def moved_back(cls, value: Any, offset: Array) -> Any:
        """See `Term.moved_back`."""
        back = lie.exp(np.concatenate([np.zeros(3), -offset[3:]]))[:3, :3]
        rotation = back @ lie.rotation_from_quaternion(np.array(value))
        q = lie.quaternion_from_rotation(rotation)
        return tuple((q if q[0] >= 0 else -q).tolist())
