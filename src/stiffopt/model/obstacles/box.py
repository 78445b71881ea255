"""Obstacle `box`: a box of any orientation."""

from functools import cached_property

import casadi as ca
import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.directions import Quaternion
from stiffopt.model.obstacle import Obstacle, Point, Radius, from_box
from stiffopt.schema import Vector


class Box(Obstacle):
    """A box.

    Attributes
    ----------
    centre : in m.
    size : length of its edges along its own x, y and z, in m.
    orientation : unit quaternion (w, x, y, z) of its axes in the base frame.
    """

    key = "box"
    n_parameters = 15

    centre: Point
    size: Vector[Radius]
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)

    @staticmethod
    def formula(point: ca.SX, parameters: ca.SX) -> ca.SX:
        """Return the distance, from the excess beyond the faces in the box's own axes."""
        seen = ca.reshape(parameters[6:15], 3, 3).T @ (point - parameters[:3])
        return from_box(ca.fabs(seen) - parameters[3:6] / 2)

    @property
    def pieces(self) -> list[list[float]]:
        """Centre, edges, axes one after another."""
        return [[*self.centre, *self.size, *self._axes.ravel(order="F").tolist()]]

    @cached_property
    def _axes(self) -> Array:
        return np.asarray(lie.rotation_from_quaternion(np.array(self.orientation)))

    def outline(self, size: float) -> list[Array]:
        """See `Obstacle.outline`."""
        ring = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) / 2.0
        shares, heights = np.array([0.0, 1.0, 1.0, 0.0]), np.array([-0.5, -0.5, 0.5, 0.5])
        corners = np.stack([
            np.outer(shares, ring[:, 0]), np.outer(shares, ring[:, 1]),
            np.outer(heights, np.ones(5)),
        ])  # fmt: skip
        edges = np.array(self.size)[:, None, None] * corners
        turned: Array = np.einsum("ij,jkl->ikl", self._axes, edges)
        return [turned + np.array(self.centre)[:, None, None]]
