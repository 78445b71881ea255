"""`ContactSurface`: distances from an object with their first and second derivatives."""

from functools import cache, cached_property
from itertools import product
from typing import NamedTuple

import casadi as ca
import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.batch import InterpretedFunction
from stiffopt.model.codegen import dense
from stiffopt.model.distances import MeasuredObject
from stiffopt.model.obstacle import Obstacle
from stiffopt.model.obstacles.mesh import Mesh
from stiffopt.model.scene import SceneObject

_STENCIL = 1.5  # half width of the smoothing of a grid's distances, in cubes


class SurfacePoint(NamedTuple):
    """Distance of a point in m, its gradient (3,) and its second derivatives (3, 3)."""

    distance: float
    normal: Array
    curvature: Array


class ContactSurface:
    """An object that an arm may touch.

    Attributes
    ----------
    name : of the object.
    max_force : largest force on it, in N; infinite where none is given.
    friction : coefficient.
    softness : depth per normal force, in m/N.
    begin : arc length at rest from which the arm's body counts, in m.
    key, pieces : kind of the object, and the numbers (k, size) of its formula for contacts.
    is_interpolated : whether its distances come from a grid instead.
    """

    def __init__(self, item: SceneObject, begin: float) -> None:
        assert item.contact is not None
        self.name = item.name
        self.max_force = np.inf if item.contact.max_force is None else item.contact.max_force
        self.friction = item.contact.friction
        self.softness = 0.0 if item.contact.stiffness is None else 1 / item.contact.stiffness
        self.begin = begin
        self._shape = item.shape
        self.key, self.pieces = item.shape.key, np.array(item.shape.contact_pieces, dtype=float)
        self.is_interpolated = item.shape.is_interpolated
        self._functions = None if self.is_interpolated else _interpreted(type(item.shape))

    @cached_property
    def _measured(self) -> MeasuredObject:
        return MeasuredObject(self._shape, self.begin)

    def distances(self, points: Array) -> Array:
        """Return distances (k,) of points (k, 3), in m."""
        if self._functions is None:
            return self._measured.distances(points).values
        return self._of_pieces(points).max(axis=0)

    def _of_pieces(self, points: Array) -> Array:
        """Return distances (pieces, k) of points (k, 3)."""
        assert self._functions is not None
        found = [self._functions[0].many(points, piece)[0][:, 0, 0] for piece in self.pieces]
        return np.array(found)

    def at(self, point: Array) -> SurfacePoint:
        """Return the distance of one point (3,) with its derivatives."""
        if self._functions is None:
            return self._smoothed(point)
        nearest = int(self._of_pieces(point[None]).argmax())
        value, normal, curvature = self._functions[1](point, self.pieces[nearest])
        return SurfacePoint(float(value[0, 0]), normal[:, 0], curvature)

    def _smoothed(self, point: Array) -> SurfacePoint:
        """Fit a quadratic to a grid's distances about the point, as the grid is not smooth."""
        assert isinstance(self._shape, Mesh)
        size = _STENCIL * self._shape.spacing
        values = self.distances(point + size * _OFFSETS)
        constant, *rest = _FIT @ values
        slope = np.array(rest[:3]) / size
        xx, yy, zz, xy, xz, yz = np.array(rest[3:]) / size**2
        curvature = np.array([[2 * xx, xy, xz], [xy, 2 * yy, yz], [xz, yz, 2 * zz]])
        steepness = float(np.linalg.norm(slope))
        normal = slope / steepness
        along = np.eye(3) - np.outer(normal, normal)
        distance = float(constant) + self._shape.error_at(float(constant))
        return SurfacePoint(distance, normal, along @ curvature @ along / steepness)


_OFFSETS = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
_x, _y, _z = _OFFSETS.T
_FIT = np.linalg.pinv(
    np.stack([np.ones(27), _x, _y, _z, _x**2, _y**2, _z**2, _x * _y, _x * _z, _y * _z], axis=1)
)


def surface_functions(kind: type[Obstacle]) -> list[ca.Function]:
    """Return functions of a point (3,) and a piece's parameters.

    The first has the distance; the second has the gradient (3,) and second derivatives (3, 3) too.
    """
    point, q, distance = kind.contact_formula()
    hessian, gradient = ca.hessian(distance, point)
    outputs = ca.cse([distance, ca.densify(gradient), ca.densify(hessian)])
    return [
        dense(ca.Function(f"surface_distance_{kind.key}", [point, q], [ca.cse(distance)])),
        dense(ca.Function(f"surface_{kind.key}", [point, q], outputs)),
    ]


@cache
def _interpreted(kind: type[Obstacle]) -> list[InterpretedFunction]:
    return [InterpretedFunction(each) for each in surface_functions(kind)]
