"""Obstacle `capsule`: all points within a radius of a straight line."""

import casadi as ca

from stiffopt.arrays import Array
from stiffopt.model.obstacle import BetweenEnds, from_segment, norm, rounded


class Capsule(BetweenEnds):
    """A cylinder with round ends; see `BetweenEnds` for its keys."""

    key = "capsule"

    @staticmethod
    def formula(point: ca.SX, parameters: ca.SX) -> ca.SX:
        """Return the distance of the line between the ends, less the radius."""
        return norm(from_segment(point, parameters[:3], parameters[3:6])) - parameters[6]

    def outline(self, size: float) -> list[Array]:
        """See `Obstacle.outline`."""
        return [rounded(self.start, self.end, self.radius)]
