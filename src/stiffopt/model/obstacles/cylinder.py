"""A cylinder with flat ends."""

from typing import Annotated

import casadi as ca
import numpy as np
from pydantic import Field, model_validator

from stiffopt.model.obstacle import (
    Array,
    Obstacle,
    Point,
    Radius,
    check_apart,
    from_box,
    norm,
    revolved,
)


class Cylinder(Obstacle):
    """A cylinder with flat ends.

    Attributes
    ----------
    start, end : centres of its ends, in m; ``from`` and ``to`` in files.
    radius : in m.
    """

    key = "cylinder"
    n_parameters = 7

    start: Annotated[Point, Field(alias="from")]
    end: Annotated[Point, Field(alias="to")]
    radius: Radius

    @model_validator(mode="after")
    def _check(self) -> "Cylinder":
        check_apart(self.start, self.end, "expected another 'to'")
        return self

    @staticmethod
    def formula(point: ca.SX, parameters: ca.SX) -> ca.SX:
        """Distance of the rectangle that makes the cylinder, in its half-plane."""
        way = parameters[3:6] - parameters[:3]
        length = ca.sqrt(ca.sumsqr(way))
        seen = point - parameters[:3]
        height = ca.dot(seen, way) / length
        beside = norm(seen - height * way / length)
        beyond = ca.fabs(height - length / 2) - length / 2
        return from_box(ca.vertcat(beside - parameters[6], beyond))

    @property
    def pieces(self) -> list[list[float]]:
        """Both ends, radius."""
        return [[*self.start, *self.end, self.radius]]

    def outline(self, size: float) -> list[Array]:
        """See `Obstacle.outline`."""
        way = np.subtract(self.end, self.start)
        length = float(np.linalg.norm(way))
        radii = (0.0, self.radius, self.radius, 0.0)
        return [revolved(self.start, way / length, (0.0, 0.0, length, length), radii)]
