"""Obstacle `sphere`."""

import casadi as ca

from stiffopt.arrays import Array
from stiffopt.model.obstacle import Obstacle, Point, Radius, norm, rounded


class Sphere(Obstacle):
    """A sphere.

    Attributes
    ----------
    centre : in m.
    radius : in m.
    """

    key = "sphere"
    n_parameters = 4

    centre: Point
    radius: Radius

    @staticmethod
    def formula(point: ca.SX, parameters: ca.SX) -> ca.SX:
        """Return ``|x - c| - r``."""
        return norm(point - parameters[:3]) - parameters[3]

    @property
    def pieces(self) -> list[list[float]]:
        """Centre, radius."""
        return [[*self.centre, self.radius]]

    def outline(self, size: float) -> list[Array]:
        """See `Obstacle.outline`."""
        return [rounded(self.centre, self.centre, self.radius)]
