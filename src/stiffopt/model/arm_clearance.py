"""Clearance of one arm in a scene, by machine code if there is any."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.model.batch import in_parallel
from stiffopt.model.body import NativeBody
from stiffopt.model.clearance import Nearest, nearest_point, range_ends, survey
from stiffopt.model.compiled import Library
from stiffopt.model.description import RobotDescription
from stiffopt.model.distances import MeasuredObject, SceneObjectInC, scene_library
from stiffopt.model.scene import Scene

if TYPE_CHECKING:
    from stiffopt.model.manipulator import Manipulator


_CHUNK = 64  # poses that a thread takes at a time
_DEGREE = 22  # of polynomials along a range; their error is a nanometre
_STEP = 10.0  # Pa, step of the differences of radii

_integer, _pointer = ctypes.c_int64, ctypes.c_void_p


@dataclass(frozen=True)
class Clearances:
    """Distances of an arm's body from each of k objects, for one pose or N."""

    names: tuple[str, ...]  # of the objects, (k,)
    # of the body's surface, negative where it is within an object, (k,) or (N, k), in m
    distances: Array
    at: Array  # arc lengths at rest of the nearest points of the body, same shape, in m
    positions: Array  # these points of the centre line, (k, 3) or (N, k, 3), in m
    normals: Array  # unit vectors that point away from the object, same shape
    # of the distances by the pressures, (k, n) or (N, k, n), in m/Pa; where a distance has a kink,
    # of one side
    gradients: Array

    @property
    def nearest(self) -> str:
        """Name of the object with the least distance, in all poses."""
        return self.names[int(np.argmin(self.distances)) % len(self.names)]

    def only(self) -> Clearances:
        """Return those of a single pose, without the leading axis."""
        arrays = (self.distances, self.at, self.positions, self.normals, self.gradients)
        return Clearances(self.names, *(array[0] for array in arrays))


class SceneKey:
    """A scene as a key, compared by identity."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    def __hash__(self) -> int:
        return id(self.scene)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SceneKey) and other.scene is self.scene


class MeasuredScene:
    """The objects of a scene as numbers, for arms whose base has a radius in m."""

    def __init__(self, scene: Scene, base_radius: float) -> None:
        self.names = tuple(item.name for item in scene.objects)
        shapes = (item.shape for item in scene.objects)
        self.items = tuple(
            MeasuredObject(shape, shape.begin(base_radius, scene.clearance)) for shape in shapes
        )
        self._in_c: tuple[Library, ctypes.Array[SceneObjectInC]] | None = None

    def in_c(self, code: Library) -> ctypes.Array[SceneObjectInC]:
        """Return the objects as structures for C, which point into these objects' memory."""
        if self._in_c is None or self._in_c[0] is not code:
            objects = (SceneObjectInC * len(self.items))(*(item.in_c(code) for item in self.items))
            self._in_c = code, objects
        return self._in_c[1]


def measured_scene(scene: Scene, robot: RobotDescription) -> MeasuredScene:
    """Return the objects of a scene as numbers for an arm; cached."""
    return _measured(SceneKey(scene), robot.segments[0].outer_radius)


@lru_cache(maxsize=64)
def _measured(key: SceneKey, base_radius: float) -> MeasuredScene:
    return MeasuredScene(key.scene, base_radius)


class Ranges(NamedTuple):
    """The ranges of an arm's body: ends (k, 2) and numbers of coarse stations (k,)."""

    ends: tuple[tuple[float, float, int], ...]
    bounds: Array
    counts: NDArray[np.int64]

    @classmethod
    def of(cls, ends: tuple[tuple[float, float, int], ...]) -> Ranges:
        """Return the ranges with their arrays for C."""
        bounds = np.array([[start, end] for start, end, _ in ends])
        return cls(ends, bounds, np.array([count for *_, count in ends], dtype=np.int64))


class ArmClearance:
    """Distances of an arm's body from a scene, at finite pressures (N, n) in Pa."""

    def __init__(self, arm: Manipulator, scene: Scene) -> None:
        self._arm, self.scene = arm, measured_scene(scene, arm.description)
        self.ranges = arm.kept("ranges", lambda: Ranges.of(range_ends(arm.description)))

    def least(self, p: Array) -> Array:
        """Return the least of all distances, (N,)."""
        found, missing = self._in_c(p, None)
        for row in missing:
            found[row, 0, 0] = min(each.distance for each in self._of(p[row]))
        return found[:, 0, 0]

    def each(self, p: Array) -> Clearances:
        """Return the distances of all objects."""
        slopes = np.empty((len(p), len(self.scene.names), self._arm.n_pressures))
        found, missing = self._in_c(p, slopes)
        for row in missing:
            nearest = self._of(p[row])
            slopes[row] = gradients(self._arm, p[row], nearest)
            for index, each in enumerate(nearest):
                found[row, index] = [*each[:3], *each.position, *each.normal]
        return Clearances(
            self.scene.names, found[..., 0], found[..., 1], found[..., 3:6], found[..., 6:],
            slopes,
        )  # fmt: skip

    # -- without machine code ---------------------------------------------------------------

    def _of(self, p: Array) -> list[Nearest]:
        """Return the nearest points of all objects at pressures (n,)."""
        line = _CentreLine(self._arm, p, self.ranges.bounds)
        ranges = survey(line, self.ranges.ends)
        return [nearest_point(line, item, ranges) for item in self.scene.items]

    # -- in machine code --------------------------------------------------------------------

    def _in_c(self, p: Array, gradients: Array | None) -> tuple[Array, NDArray[np.intp]]:
        """Return least distances (N, 1, 9), or with gradients those of all objects (N, k, 9).

        The second result lists rows without a result: all without machine code, and those at whose
        pressures the arm has no shape, for which the interpreted way raises an error.
        """
        width = 1 if gradients is None else len(self.scene.names)
        found = np.full((len(p), width, 9), np.nan)
        outcome = np.ones(len(p), dtype=np.int64)
        body = self._arm._body.machine_code(len(p))
        code = scene_library() if body is not None else None
        if body is not None and code is not None:
            objects, p = self.scene.in_c(code), np.ascontiguousarray(p)
            address = None if gradients is None else gradients.ctypes.data
            call = partial(
                _clearances(body), body.address, ctypes.addressof(objects), len(objects),
                self.ranges.bounds.ctypes.data, self.ranges.counts.ctypes.data,
                len(self.ranges.ends),
                p.ctypes.data, found.ctypes.data, address, outcome.ctypes.data,
            )  # fmt: skip
            _in_chunks(call, len(p))
        return found, np.flatnonzero(outcome)


def _clearances(body: NativeBody) -> Callable[..., int]:
    function = body.code.cdll.stiffopt_clearances
    function.argtypes = [
        _pointer, _pointer, _integer, _pointer, _pointer, _integer, _pointer, _pointer, _pointer,
        _pointer, _integer, _integer,
    ]  # fmt: skip
    return function


def _in_chunks(call: Callable[[int, int], int], count: int) -> None:
    """Process the rows of a batch in threads."""
    failed: list[int] = []

    def work(starts: Iterator[int]) -> None:
        failed.extend(start for start in starts if call(start, min(start + _CHUNK, count)))

    in_parallel(work, range(0, count, _CHUNK))
    if failed:
        raise MemoryError("no memory is left for the stations of the arm")


def gradients(arm: Manipulator, p: Array, nearest: Sequence[Nearest]) -> Array:
    """Return derivatives (k, n) of k distances by the pressures (n,)."""
    at = np.array([each.s for each in nearest])
    axes = arm._body.poses(p[None], at)[0, :, :3, :3]
    moves = axes @ arm._body.jacobians(p[None], at)[0, :, :3]  # (k, 3, n)
    steps = _STEP * np.eye(len(p))
    widening = arm._body.radii(p + steps, at) - arm._body.radii(p - steps, at)  # (n, k)
    normals = np.array([each.normal for each in nearest])
    shares = np.array([each.radius_share for each in nearest])
    found: Array = (normals[:, None] @ moves)[:, 0]
    return found - (shares * widening / (2 * _STEP)).T


class ArmBody:
    """The body of an arm at pressures (n,)."""

    def __init__(self, arm: Manipulator, p: Array) -> None:
        self._arm, self._p = arm, p[None]

    def __call__(self, at: Array) -> tuple[Array, Array, Array]:
        """See `stiffopt.model.clearance.StationOf`."""
        found = self._arm._body.line(self._p, at)[0]
        return found[:, :3], found[:, 3:6], found[:, 6]


class _CentreLine:
    """The body of an arm at pressures (n,), interpolated by polynomials along each range."""

    def __init__(self, arm: Manipulator, p: Array, bounds: Array) -> None:
        self._bounds = bounds
        nodes = chebyshev.chebpts1(_DEGREE + 1)
        at = bounds.mean(axis=1)[:, None] + np.ptp(bounds, axis=1)[:, None] / 2 * nodes
        positions = arm._body.poses(p[None], at.ravel())[0, :, :3, 3].reshape(*at.shape, 3)
        inverse = np.linalg.inv(chebyshev.chebvander(nodes, _DEGREE))
        self._positions = inverse @ positions  # (ranges, degree + 1, 3)
        self._slopes = chebyshev.chebder(self._positions, axis=1)
        self._radii = arm._body.radii(p[None], bounds.mean(axis=1))[0]

    def __call__(self, at: Array) -> tuple[Array, Array, Array]:
        """See `stiffopt.model.clearance.StationOf`."""
        index = np.searchsorted(self._bounds[:-1, 1], at)
        low, high = self._bounds[index].T
        x = (2 * at - low - high) / (high - low)
        values = chebyshev.chebvander(x, _DEGREE)[:, None]  # (k, 1, degree + 1)
        slopes = (values[..., :-1] @ self._slopes[index])[:, 0]
        tangents = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
        return (values @ self._positions[index])[:, 0], tangents, self._radii[index]
