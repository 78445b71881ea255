"""Obstacle `cylinder`: a cylinder with flat ends."""

import casadi as ca
import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.obstacle import BetweenEnds, from_box, norm, revolved


class Cylinder(BetweenEnds):
    """A cylinder with flat ends; see `BetweenEnds` for its keys."""

    key = "cylinder"

    @staticmethod
    def formula(point: ca.SX, parameters: ca.SX) -> ca.SX:
        """Return the distance of the rectangle that generates the cylinder, in its half-plane."""
        way = parameters[3:6] - parameters[:3]
        length = ca.sqrt(ca.sumsqr(way))
        seen = point - parameters[:3]
        height = ca.dot(seen, way) / length
        beside = norm(seen - height * way / length)
        beyond = ca.fabs(height - length / 2) - length / 2
        return from_box(ca.vertcat(beside - parameters[6], beyond))

    def outline(self, size: float) -> list[Array]:
        """See `Obstacle.outline`."""
        way = np.subtract(self.end, self.start)
        length = float(np.linalg.norm(way))
        radii = (0.0, self.radius, self.radius, 0.0)
        return [revolved(self.start, way / length, (0.0, 0.0, length, length), radii)]
