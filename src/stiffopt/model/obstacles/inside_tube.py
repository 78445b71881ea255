"""Obstacle `inside_tube`: a tube that the arm stays inside."""

from itertools import pairwise
from typing import Annotated

import casadi as ca
import numpy as np
from pydantic import AfterValidator

from stiffopt.model.description import RobotDescription
from stiffopt.model.obstacle import Array, Obstacle, Point, Radius, from_segment, norm, revolved
from stiffopt.schema import BadKeyError, Items


def _at_least_two(points: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    if len(points) < 2:
        raise ValueError(f"expected at least 2 points, not {len(points)}")
    for index, (start, end) in enumerate(pairwise(points)):
        if np.linalg.norm(np.subtract(end, start)) < 1e-9:
            raise ValueError(f"point {index + 2} is where point {index + 1} is; remove one")
    return points


class InsideTube(Obstacle):
    """The inside of a tube about a line of straight pieces, round at its ends and bends.

    Attributes
    ----------
    points : of its centre line, at least 2, in m.
    radius : of the tube, in m.
    """

    key = "inside_tube"
    amiss = "too far out of"
    along = "concave"
    wrong_side = "outside of"
    n_parameters = 7

    points: Annotated[Items[Point], AfterValidator(_at_least_two)]
    radius: Radius

    @staticmethod
    def formula(point: ca.SX, parameters: ca.SX) -> ca.SX:
        """Return the radius less the distance of the straight piece."""
        return parameters[6] - norm(from_segment(point, parameters[:3], parameters[3:6]))

    @property
    def pieces(self) -> list[list[float]]:
        """Both ends and the radius of each straight piece."""
        pairs = zip(self.points, self.points[1:], strict=False)
        return [[*start, *end, self.radius] for start, end in pairs]

    def check_against(self, robot: RobotDescription, clearance: float) -> None:
        """Require a tube that is wider than the arm and contains its base.

        See `Obstacle.check_against`.
        """
        widest = max(segment.outer_radius for segment in robot.segments)
        if self.radius < widest + clearance:
            asked = f" with {clearance * 1e3:g} mm of clearance" if clearance else ""
            raise BadKeyError(
                f"{self.key}.radius",
                f"{self.radius * 1e3:g} mm is too narrow for the arm, whose outer radius is "
                f"{widest * 1e3:g} mm{asked}",
            )
        super().check_against(robot, clearance)

    def outline(self, size: float) -> list[Array]:
        """See `Obstacle.outline`."""
        surfaces = []
        for start, end in zip(self.points, self.points[1:], strict=False):
            way = np.subtract(end, start)
            length = float(np.linalg.norm(way))
            surfaces.append(revolved(start, way / length, (0.0, length), (self.radius,) * 2))
        return surfaces
