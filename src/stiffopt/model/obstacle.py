"""`Obstacle`: base class of shapes in the base frame, each with a formula of its distance.

Each kind has one formula, in CasADi, with the shape's numbers as arguments.  Machine code
for all kinds is compiled from it once (`stiffopt.model.distances`), so that moving or adding an
object needs no compilation.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cache, cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import casadi as ca
import numpy as np
from pydantic import ConfigDict, Field, model_validator

from stiffopt.arrays import Array
from stiffopt.model.batch import InterpretedFunction
from stiffopt.schema import BadKeyError, Schema, Vector
from stiffopt.units import Length, within

if TYPE_CHECKING:
    from stiffopt.model.description import RobotDescription
    from stiffopt.model.distance_grid import DistanceGrid

Along = Literal["convex", "concave", "any"]

Point = Vector[Annotated[Length, within(1e3, "m")]]
"""A point in the base frame, in m."""
Radius = Annotated[Length, Field(gt=0, le=1e3)]
"""In m."""

_RISEN = 1.25  # factor on the arc length at which a straight arm is clear of its mount
_FLUSH = 1e-9  # m, allowed height of an object above the plane of the base
_ABOVE = 1e-4  # m above the base, at which the direction of an object is determined
_STRAIGHT = 1e-9  # allowed relative lag of the distance behind the height: 0.05 mrad
_SIDES = 24  # of a drawn surface of revolution
_TINY = 1e-24  # m^2, added under roots so that gradients exist at zero distance


class Obstacle(Schema, ABC):
    """A shape that the arm keeps clear of, stays in, or passes through.

    Attributes
    ----------
    key : its name in files.
    along : the distance as a function along a straight line: "convex" (that from any convex shape),
        "concave" in each piece (that inside a tube), or "any". Exact minima along an arm rely on
        it.
    wrong_side : where the arm must not be, in words before "it".
    amiss : how a body violates the clearance, in words before the object's name.
    n_parameters : number of parameters of the formula for a piece.
    is_interpolated : whether distances come from grids; the last eight parameters are then the
        values at the corners of a point's cube.
    is_ring : whether the arm passes through it.
    """

    model_config = ConfigDict(populate_by_name=True)

    key: ClassVar[str]
    along: ClassVar[Along] = "convex"
    wrong_side: ClassVar[str] = "within"
    amiss: ClassVar[str] = "too near"
    n_parameters: ClassVar[int]
    is_interpolated: ClassVar[bool] = False
    is_ring: ClassVar[bool] = False

    @staticmethod
    @abstractmethod
    def formula(point: ca.SX, parameters: ca.SX) -> ca.SX:
        """Return the signed distance of a point (3,) in m, negative where the arm must not be."""

    @staticmethod
    def cell(point: ca.SX, parameters: ca.SX) -> ca.SX:
        """Return the cube (3,) of a grid that contains a point, for interpolated kinds."""
        raise NotImplementedError

    @staticmethod
    def passage(point: ca.SX, parameters: ca.SX) -> list[ca.SX]:
        """Return a ring's height to a point, and distances beyond its circle and of its disc."""
        raise NotImplementedError

    @property
    @abstractmethod
    def pieces(self) -> list[list[float]]:
        """Parameters of each piece; the distance is the largest of the pieces' distances."""

    @classmethod
    def contact_formula(cls) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Return symbols of a point (3,) and of a contact's piece, and the distance for contacts.

        It is `formula` except for kinds of which that has kinks that an arm can touch.
        """
        point, q = ca.SX.sym("point", 3), ca.SX.sym("parameters", cls.n_parameters)
        return point, q, cls.formula(point, q)

    @property
    def contact_pieces(self) -> list[list[float]]:
        """Parameters of each piece for contacts; their distance is the largest too."""
        return self.pieces

    @property
    def grids(self) -> tuple[DistanceGrid, ...]:
        """Grids of distances, one for each piece, or none."""
        return ()

    def error_at(self, distance: float) -> float:
        """Return how much too small an interpolated distance in m can be."""
        return 0.0

    @abstractmethod
    def outline(self, size: float) -> list[Array]:
        """Return surfaces (3, rows, columns) in m for drawing, cut off at a size if infinite."""

    def check_against(self, robot: RobotDescription, clearance: float) -> None:
        """Reject a shape that does not suit an arm.

        Parameters
        ----------
        clearance : clearance asked of the arm's body, in m.

        Raises
        ------
        BadKeyError
        """
        radius, length = robot.segments[0].outer_radius, robot.segments[0].length
        begin = self.begin(radius, clearance)
        if begin > 0.5 * length:
            raise BadKeyError(
                self.key,
                f"the arm is mounted on it, and a clearance of {clearance * 1e3:g} mm from it "
                f"counts from {begin * 1e3:.4g} mm up the arm; expected less than half the first "
                f"segment, {500 * length:g} mm",
            )
        left = self.from_base - radius
        if begin > 0 or left >= clearance:
            return
        has = f"has {left * 1e3:.4g} mm of the clearance of {clearance * 1e3:g} mm asked for"
        lies = f"lies {-left * 1e3:.4g} mm {self.wrong_side} it, where it can never be clear"
        raise BadKeyError(
            self.key,
            f"the arm's base, a body of radius {radius * 1e3:g} mm about the origin, "
            f"{has if left >= 0 else lies}",
        )

    def begin(self, base_radius: float, clearance: float) -> float:
        """Return the arc length at rest from which an arm's body counts: 0 except for its mount.

        An arm is mounted on a convex object if the object's point nearest to the base lies straight
        behind the base.  The object is then behind a plane that the base does not cross, but the
        round end of the body there would be nearer than the clearance.  The straight arm is clear
        of it from radius plus clearance on, less the distance; a quarter is added, as a bent arm
        rises less. The part before that needs no check: along an arc that leaves the plane at a
        right angle, the disc of a section at arc length s is (1/k - radius) sin(k s) above it for a
        curvature k, which is nowhere less than at both ends.

        Parameters
        ----------
        base_radius : of the arm, in m.
        clearance : clearance asked for, in m.
        """
        missing = base_radius + clearance - self.from_base
        return _RISEN * missing if missing > 0 and self._is_behind_base else 0.0

    @property
    def _is_behind_base(self) -> bool:
        if self.along != "convex" or self.from_base < -_FLUSH:
            return False
        rise = self.distance_of((0.0, 0.0, 2 * _ABOVE)) - self.distance_of((0.0, 0.0, _ABOVE))
        return rise > (1 - _STRAIGHT) * _ABOVE

    @cached_property
    def from_base(self) -> float:
        """Signed distance of the origin, the middle of an arm's base, in m."""
        return self.distance_of((0.0, 0.0, 0.0))

    def distance_of(self, point: Any) -> float:
        """Return the signed distance of one point (3,), from the formula itself, in m."""
        formula = _function(type(self))
        return max(float(formula(point, piece)[0][0, 0]) for piece in self.pieces)


@cache
def _function(kind: type[Obstacle]) -> InterpretedFunction:
    point, q = ca.SX.sym("point", 3), ca.SX.sym("parameters", kind.n_parameters)
    return InterpretedFunction(ca.Function("distance", [point, q], [kind.formula(point, q)]))


class BetweenEnds(Obstacle):
    """A shape with a radius about the straight line between two points.

    Attributes
    ----------
    start, end : centres of its ends, in m; ``from`` and ``to`` in files.
    radius : in m.
    """

    n_parameters = 7

    start: Annotated[Point, Field(alias="from")]
    end: Annotated[Point, Field(alias="to")]
    radius: Radius

    @model_validator(mode="after")
    def _check(self) -> BetweenEnds:
        if np.linalg.norm(np.subtract(self.end, self.start)) < 1e-9:
            raise BadKeyError("to", "it ends where it begins; expected another point")
        return self

    @property
    def pieces(self) -> list[list[float]]:
        """Both ends, radius."""
        return [[*self.start, *self.end, self.radius]]


def check_width(opening: Any, width: float, clearance: float) -> None:
    """Refuse a tube or a ring whose radius leaves an arm's outer radius no clearance, in m."""
    if opening.radius < width + clearance:
        asked = f" with {clearance * 1e3:g} mm of clearance" if clearance else ""
        raise BadKeyError(
            f"{opening.key}.radius",
            f"{opening.radius * 1e3:g} mm is too narrow for the arm, whose outer radius is "
            f"{width * 1e3:g} mm{asked}",
        )


def norm(vector: ca.SX) -> ca.SX:
    """Return the length of a vector, with a gradient at zero too; exact to 1e-12."""
    return ca.sqrt(ca.sumsqr(vector) + _TINY)


def from_segment(point: ca.SX, start: ca.SX, end: ca.SX) -> ca.SX:
    """Return the vector (3,) to a point from the nearest point of a line segment."""
    way = end - start
    share = ca.fmin(ca.fmax(ca.dot(point - start, way) / ca.sumsqr(way), 0), 1)
    return point - start - share * way


def from_box(excess: ca.SX) -> ca.SX:
    """Return the signed distance of a box, given a point's excess (k,) beyond its faces."""
    outside = norm(ca.fmax(excess, 0))
    return outside + ca.fmin(ca.mmax(excess), 0)


# -- surfaces for plots ---------------------------------------------------------------------------


def across(axis: Array) -> tuple[Array, Array]:
    """Return two unit vectors that form a right-handed frame with a unit vector."""
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def revolved(origin: Any, axis: Any, heights: Any, radii: Any) -> Array:
    """Return a surface (3, rows, _SIDES + 1) of revolution, given heights and radii."""
    axis = np.asarray(axis, dtype=float)
    first, second = across(axis)
    angle = np.linspace(0.0, 2 * np.pi, _SIDES + 1)
    ring = np.outer(first, np.cos(angle)) + np.outer(second, np.sin(angle))  # (3, _SIDES + 1)
    along = np.multiply.outer(axis, np.asarray(heights, dtype=float))  # (3, rows)
    centres = np.asarray(origin, dtype=float)[:, None] + along
    return centres[:, :, None] + np.asarray(radii)[None, :, None] * ring[:, None, :]


def rounded(start: Any, end: Any, radius: float) -> Array:
    """Return the surface of a capsule, or of a sphere if both ends coincide."""
    way = np.subtract(end, start).astype(float)
    length = float(np.linalg.norm(way))
    angle = np.linspace(-np.pi / 2, np.pi / 2, 14)
    heights = radius * np.sin(angle) + length * (angle > 0)
    axis = way / length if length else np.array([0.0, 0.0, 1.0])
    return revolved(start, axis, heights, radius * np.cos(angle))
