"""Obstacle `trocar`: a ring that the arm passes through, at any arc length."""

import casadi as ca

from stiffopt.arrays import Array
from stiffopt.directions import Direction
from stiffopt.model.description import RobotDescription
from stiffopt.model.obstacle import Obstacle, Point, Radius, check_width, norm, revolved


class Trocar(Obstacle):
    """A ring that the arm passes through.

    If the arm's centre line crosses its disc, its distance is that of the circle; if the line
    crosses the plane outside the disc, the negative of that; if it does not cross the plane, the
    negative of the tip's distance from the disc.

    Attributes
    ----------
    centre : in m.
    axis : unit normal of the ring's plane.
    radius : of its opening, in m.
    """

    key = "trocar"
    amiss = "short of passing"
    along = "any"
    n_parameters = 7
    is_ring = True

    centre: Point
    axis: Direction
    radius: Radius

    @staticmethod
    def formula(point: ca.SX, parameters: ca.SX) -> ca.SX:
        """Return the distance of the circle."""
        height, beyond = _seen(point, parameters)
        return norm(ca.vertcat(height, beyond))

    @staticmethod
    def passage(point: ca.SX, parameters: ca.SX) -> list[ca.SX]:
        """See `Obstacle.passage`."""
        height, beyond = _seen(point, parameters)
        return [height, beyond, norm(ca.vertcat(height, ca.fmax(beyond, 0)))]

    @property
    def pieces(self) -> list[list[float]]:
        """Centre, axis, radius."""
        return [[*self.centre, *self.axis, self.radius]]

    def check_against(self, robot: RobotDescription, clearance: float) -> None:
        """Require that the arm's end fits through; see `Obstacle.check_against`."""
        check_width(self, robot.segments[-1].outer_radius, clearance)

    def outline(self, size: float) -> list[Array]:
        """Return a flange about the opening; see `Obstacle.outline`."""
        radii = (self.radius, 1.5 * self.radius)
        return [revolved(self.centre, self.axis, (0.0, 0.0), radii)]


def _seen(point: ca.SX, parameters: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the height above the ring's plane, and the distance beyond the circle."""
    seen = point - parameters[:3]
    height = ca.dot(parameters[3:6], seen)
    return height, norm(seen - height * parameters[3:6]) - parameters[6]
