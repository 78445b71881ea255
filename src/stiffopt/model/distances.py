"""Distances of points from the objects of a scene, in the CasADi VM and for C.

One library of machine code serves all kinds of objects. A scene's numbers are arguments of
its functions, so a new scene needs no compilation:

* ``distance_KEY``: (point, parameters of a piece) to the distance and its gradient (3,);
* ``cell_KEY``, for kinds that interpolate in a grid: to the cube (3,) of a point;
* ``passage_KEY``, for rings: to height, distance beyond the circle, distance of the disc, and the
  gradient (3,) of that.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.model.batch import BatchFunction
from stiffopt.model.codegen import dense
from stiffopt.model.compiled import Library, interpreted, library
from stiffopt.model.obstacle import Obstacle
from stiffopt.model.obstacles import OBSTACLES

_SOURCES = (str(Path(__file__).with_name("native") / "scene.c"),)
_COURSES = {"convex": 0, "concave": 1, "any": 2}  # as in scene.h
_MEMORY, _MAX_PARAMETERS = 64, 32  # as in scene.h

_integer, _pointer = ctypes.c_int64, ctypes.c_void_p


_kept: list[Library] = []


def scene_library() -> Library | None:
    """Return machine code of all distances; None if it is not ready. Once found it is cached."""
    if not _kept:
        found = library("distances of scenes", distance_functions, _SOURCES)
        _kept.extend([] if found is None else [found])
    return _kept[0] if _kept else None


def distance_functions() -> list[ca.Function]:
    """Return the functions of all kinds of objects."""
    found = []
    for key, kind in OBSTACLES.items():
        point, q = ca.SX.sym("point", 3), ca.SX.sym("parameters", kind.n_parameters)
        distance = kind.formula(point, q)
        gradient = ca.gradient(distance, point)
        found.append(_function(f"distance_{key}", point, q, [distance, gradient]))
        if kind.is_interpolated:
            found.append(_function(f"cell_{key}", point, q, [kind.cell(point, q)]))
        if kind.is_ring:
            passage = kind.passage(point, q)
            passage.append(ca.gradient(passage[-1], point))
            found.append(_function(f"passage_{key}", point, q, passage))
    for function in found:
        if function.sz_w() > _MEMORY or function.sz_iw() or function.size1_in(1) > _MAX_PARAMETERS:
            raise NotImplementedError(f"{function.name()} needs more memory than scene.h has")
    return found


def _function(name: str, point: ca.SX, parameters: ca.SX, values: list[ca.SX]) -> ca.Function:
    found = ca.cse([ca.densify(value) for value in values])
    return dense(ca.Function(name, [point, parameters], found))


@lru_cache(maxsize=1)
def _interpreted() -> dict[str, BatchFunction]:
    return dict(interpreted(distance_functions))


class Distances(NamedTuple):
    """Distances of points from an object."""

    values: Array  # (k,), in m
    normals: Array  # their gradients (k, 3)
    pieces: NDArray[np.int64]  # index of the nearest piece of the object, (k,)


class Passages(NamedTuple):
    """Positions of points relative to a ring."""

    heights: Array  # above its plane, (k,), in m
    beyond: Array  # distances beyond its circle, (k,), in m
    from_disc: Array  # distances of the disc (k,), in m
    normals: Array  # their gradients (k, 3)


class SceneObjectInC(ctypes.Structure):
    """Structure `SceneObject` of native/scene.h."""

    _fields_ = [
        *((name, _pointer) for name in ("distance", "cell", "passage")),
        *((name, _integer) for name in ("course", "pieces", "size")),
        ("begin", ctypes.c_double),
        *((name, _pointer) for name in ("parameters", "grids", "shapes")),
    ]  # fmt: skip


class MeasuredObject:
    """An object as numbers, from which distances are computed.

    Attributes
    ----------
    key : its kind.
    along : see `Obstacle`.
    is_ring : whether the arm passes through it.
    is_interpolated : whether its distances come from grids.
    begin : arc length at rest from which the body counts, see `Obstacle.begin`, in m.
    """

    def __init__(self, shape: Obstacle, begin: float = 0.0) -> None:
        self.key, self.along, self.begin = shape.key, shape.along, begin
        self.is_ring = shape.is_ring
        self.is_interpolated = shape.is_interpolated
        self._parameters = np.array(shape.pieces, dtype=float)  # (pieces, size)
        self._grids = [grid.values for grid in shape.grids]
        self._addresses = np.array([grid.ctypes.data for grid in self._grids], dtype=np.uint64)
        self._shapes = np.array([grid.shape for grid in self._grids], dtype=np.int64)

    def distances(self, points: Array) -> Distances:
        """Return the distances of points (k, 3)."""
        found = [self._of_piece(index, points) for index in range(len(self._parameters))]
        values = np.stack([value for value, _ in found])  # (pieces, k)
        normals = np.stack([normal for _, normal in found])  # (pieces, k, 3)
        pieces, rows = values.argmax(axis=0), np.arange(len(points))
        return Distances(values[pieces, rows], normals[pieces, rows], pieces)

    def piece_distance(self, index: int, point: Array) -> float:
        """Return the distance of a point (3,) from one piece."""
        return float(self._of_piece(index, point[None])[0][0])

    def _of_piece(self, index: int, points: Array) -> tuple[Array, Array]:
        parameters = self._parameters[index]
        if self._grids:
            parameters = self._with_corners(index, points)
        value, normal = self._call("distance", points, parameters)
        return value[:, 0, 0], normal[:, :, 0]

    def _with_corners(self, index: int, points: Array) -> Array:
        """Return parameters (k, size) with the grid values at the corners of the points' cubes."""
        (cells,) = self._call("cell", points, self._parameters[index])
        i, j, k = cells[:, :, 0].astype(int).T
        rows = np.repeat(self._parameters[index][None], len(points), axis=0)
        for corner, (di, dj, dk) in enumerate(product((0, 1), repeat=3)):
            rows[:, corner - 8] = self._grids[index][i + di, j + dj, k + dk]
        return rows

    def passages(self, points: Array) -> Passages:
        """Return the positions of points (k, 3) relative to a ring."""
        height, beyond, disc, normal = self._call("passage", points, self._parameters[0])
        return Passages(height[:, 0, 0], beyond[:, 0, 0], disc[:, 0, 0], normal[:, :, 0])

    def _call(self, what: str, points: Array, parameters: Array) -> list[Array]:
        return _interpreted()[f"{what}_{self.key}"].many(points, parameters)

    def in_c(self, code: Library) -> SceneObjectInC:
        """Return the object as a structure for C, which points into this object's memory."""
        return SceneObjectInC(
            distance=_address(code, f"distance_{self.key}"),
            cell=_address(code, f"cell_{self.key}") if self.is_interpolated else None,
            passage=_address(code, f"passage_{self.key}") if self.is_ring else None,
            course=_COURSES[self.along],
            pieces=len(self._parameters),
            size=self._parameters.shape[1],
            begin=self.begin,
            parameters=self._parameters.ctypes.data,
            grids=self._addresses.ctypes.data,
            shapes=self._shapes.ctypes.data,
        )


@lru_cache(maxsize=64)
def _address(code: Library, function: str) -> int | None:
    return ctypes.cast(getattr(code.cdll, function), _pointer).value
