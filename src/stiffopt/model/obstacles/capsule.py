"""A capsule: all within a radius of a straight line."""

from typing import Annotated

import casadi as ca
from pydantic import Field, model_validator

from stiffopt.model.obstacle import (
    Array,
    Obstacle,
    Point,
    Radius,
    check_apart,
    from_segment,
    norm,
    rounded,
)


class Capsule(Obstacle):
    """A cylinder with round ends.

    Attributes
    ----------
    start, end : centres of its ends, in m; ``from`` and ``to`` in files.
    radius : in m.
    """

    key = "capsule"
    n_parameters = 7

    start: Annotated[Point, Field(alias="from")]
    end: Annotated[Point, Field(alias="to")]
    radius: Radius

    @model_validator(mode="after")
    def _check(self) -> "Capsule":
        check_apart(self.start, self.end, "expected a sphere, or another 'to'")
        return self

    @staticmethod
    def formula(point: ca.SX, parameters: ca.SX) -> ca.SX:
        """Distance of the line between the ends, less the radius."""
        return norm(from_segment(point, parameters[:3], parameters[3:6])) - parameters[6]

    @property
    def pieces(self) -> list[list[float]]:
        """Both ends, radius."""
        return [[*self.start, *self.end, self.radius]]

    def outline(self, size: float) -> list[Array]:
        """See `Obstacle.outline`."""
        return [rounded(self.start, self.end, self.radius)]
