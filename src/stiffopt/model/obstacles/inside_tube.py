"""Obstacle `inside_tube`: a tube that the arm stays inside."""

from itertools import pairwise
from typing import Annotated

import casadi as ca
import numpy as np
from pydantic import AfterValidator

from stiffopt.arrays import Array
from stiffopt.model.description import RobotDescription
from stiffopt.model.obstacle import (
    Obstacle,
    Point,
    Radius,
    check_width,
    from_segment,
    norm,
    revolved,
)
from stiffopt.schema import Items


def _at_least_two(points: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    if len(points) < 2:
        raise ValueError(f"expected at least 2 points, not {len(points)}")
    for index, (start, end) in enumerate(pairwise(points)):
        if np.linalg.norm(np.subtract(end, start)) < 1e-9:
            raise ValueError(f"point {index + 2} is where point {index + 1} is; remove one")
    return points


_ROUNDS = 5  # towards the nearest point of a ridge; exact to a micrometre up to a right angle
_FOLDED = 1e-3  # cosine of half a bend; beyond that the line turns back, and no ridge is reached


class InsideTube(Obstacle):
    """The inside of a tube about a line of straight pieces, round at its ends and bends.

    On the inner side of a bend, the walls of both pieces meet in a ridge: half of the ellipse in
    which the plane that bisects the bend cuts them. Within the tube the distance of `formula`, the
    largest of the pieces, is that of the wall except near a ridge. There it has a kink and is too
    small, by up to 1 / cos(bend / 2) - 1 of itself. The distance for contacts is exact.

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

    @classmethod
    def contact_formula(cls) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Return the distance of the wall of a piece, and of the ridge at its end.

        The nearest point of the wall is on the ridge if the direction from there lies between the
        normals of both pieces. See `Obstacle.contact_formula`.
        """
        point, q = ca.SX.sym("point", 3), ca.SX.sym("parameters", cls.n_parameters + 7)
        seen, inwards, along, sine = point - q[3:6], q[7:10], q[10:13], q[13]
        height = ca.dot(seen, along)
        flat = ca.vertcat(ca.dot(seen, inwards), ca.dot(seen, ca.cross(along, inwards)))
        axes = ca.vertcat(q[6] / ca.sqrt(1 - sine**2), q[6])
        angle = _nearest_angle(flat, axes)  # as cosine and sine
        ridge = norm(ca.vertcat(flat - axes * angle, height))
        is_on_ridge = ca.logic_and(
            ca.logic_and(flat[0] > 0, ca.sumsqr(flat / axes) < 1),
            ca.fabs(height) < ridge * sine * angle[0],
        )
        return point, q, ca.if_else(is_on_ridge, ridge, cls.formula(point, q))

    @property
    def contact_pieces(self) -> list[list[float]]:
        """Pieces, each with the bend at its end.

        That is the direction to its inner side, the normal of the plane that bisects it, and the
        sine of half its angle; zeros where there is no bend.
        """
        ways = [np.subtract(end, start) for start, end in pairwise(self.points)]
        bends = [
            _bend(way / np.linalg.norm(way), after / np.linalg.norm(after))
            for way, after in pairwise(ways)
        ]
        return [
            [*piece, *bend] for piece, bend in zip(self.pieces, [*bends, [0.0] * 7], strict=True)
        ]

    def check_against(self, robot: RobotDescription, clearance: float) -> None:
        """Require a tube that is wider than the arm and contains its base.

        See `Obstacle.check_against`.
        """
        check_width(self, max(segment.outer_radius for segment in robot.segments), clearance)
        super().check_against(robot, clearance)

    def outline(self, size: float) -> list[Array]:
        """See `Obstacle.outline`."""
        surfaces = []
        for start, end in zip(self.points, self.points[1:], strict=False):
            way = np.subtract(end, start)
            length = float(np.linalg.norm(way))
            surfaces.append(revolved(start, way / length, (0.0, length), (self.radius,) * 2))
        return surfaces


def _bend(before: Array, after: Array) -> list[float]:
    """Return a bend between two directions as in `InsideTube.contact_pieces`."""
    turn, mean = (after - before) / 2, (after + before) / 2
    sine, cosine = float(np.linalg.norm(turn)), float(np.linalg.norm(mean))
    if sine < 1e-9 or cosine < _FOLDED:
        return [0.0] * 7
    return [*(turn / sine), *(mean / cosine), sine]


def _nearest_angle(point: ca.SX, axes: ca.SX) -> ca.SX:
    """Return cosine and sine of the angle at which half an ellipse is nearest to a point within.

    The ellipse is axes * (cosine, sine), with positive cosines. The direction in which the centre
    of curvature at one angle sees the point gives the next angle.
    """
    angle = point / axes / norm(point / axes)
    squares = axes**2
    for _ in range(_ROUNDS):
        centre = (squares - squares[[1, 0]]) * angle**3 / axes
        radius = norm(axes * angle - centre)
        towards = point - centre
        found = (centre + radius * towards / norm(towards)) / axes
        found = ca.vertcat(ca.fmax(found[0], 0), found[1])
        angle = found / norm(found)
    return angle
