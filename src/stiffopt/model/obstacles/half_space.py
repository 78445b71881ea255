"""Obstacle `half_space`: everything behind a plane."""

import casadi as ca
import numpy as np

from stiffopt.arrays import Array
from stiffopt.directions import Direction
from stiffopt.model.obstacle import Obstacle, Point, across


class HalfSpace(Obstacle):
    """A table or a wall: everything behind a plane.

    Attributes
    ----------
    point : a point of the plane, in m.
    normal : unit normal, towards the side where the arm may be.
    """

    key = "half_space"
    n_parameters = 6

    point: Point
    normal: Direction

    @staticmethod
    def formula(point: ca.SX, parameters: ca.SX) -> ca.SX:
        """Return ``n . (x - point)``."""
        return ca.dot(parameters[3:6], point - parameters[:3])

    @property
    def pieces(self) -> list[list[float]]:
        """Point, normal."""
        return [[*self.point, *self.normal]]

    def outline(self, size: float) -> list[Array]:
        """Return a square about the base's projection on the plane; see `Obstacle.outline`."""
        normal = np.array(self.normal)
        middle = normal * float(normal @ np.array(self.point))
        first, second = across(normal)
        sides = np.meshgrid([-0.6 * size, 0.6 * size], [-0.6 * size, 0.6 * size])
        spread = first[:, None, None] * sides[0] + second[:, None, None] * sides[1]
        return [middle[:, None, None] + spread]
