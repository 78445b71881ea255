"""`Obstacles`: the objects of a task's scene as rows of its program.

The rows follow those of the terms: one for each object and segment (with its connector); a ring has
a single one for the whole arm.  A row is ``margin - (distance - clearance) <= margin``, with the
derivatives of the nearest point.  Machine code finds the exact minimum along the body if it is
near. Without it, search steps use a few stations, and only answers are judged by the exact minimum
(`stiffopt.model.clearance`).  A scene is data of these rows, so a new scene needs no compilation.
"""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.arm_clearance import (
    ArmBody,
    MeasuredScene,
    Ranges,
    gradients,
    measured_scene,
)
from stiffopt.model.body import ModelInC
from stiffopt.model.clearance import Nearest, StationOf, nearest_point, range_ends, survey
from stiffopt.model.description import RobotDescription
from stiffopt.model.distances import MeasuredObject, scene_library
from stiffopt.model.loaded_arm import LoadedArm
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.model.stopping import checkpoint
from stiffopt.optimise.settings import OBSTACLES

CLEARANCE_OF = "clearance of "
"""Prefix of the names of constraints of obstacles."""

_integer, _double, _pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class _Obstacles(ctypes.Structure):
    """Structure `Obstacles` of native/obstacles.h."""

    _fields_ = [
        ("body", _pointer),
        ("objects", _pointer),
        ("count", _integer),
        ("segments", _integer),
        *((name, _pointer) for name in ("ends", "bounds", "stations")),
        *((name, _double) for name in ("clearance", "margin", "cutoff")),
    ]


def _quickly_nearest(
    body: StationOf, item: MeasuredObject, ranges: Sequence[tuple[float, float, int]]
) -> Nearest:
    """Return the nearest point of ranges of the body, by repeatedly refining the best station."""
    s = np.concatenate(
        [np.linspace(max(start, item.begin), end, 2 * count) for start, end, count in ranges]
    )
    for _ in range(OBSTACLES.turns):
        positions, _, radii = body(s)
        seen = item.distances(positions)
        values = seen.values - radii
        best = int(values.argmin())
        near = Nearest(
            float(values[best]), float(s[best]), 1.0, positions[best], seen.normals[best]
        )
        s = np.linspace(s[max(best - 1, 0)], s[min(best + 1, len(s) - 1)], OBSTACLES.closer)
    return near


class ObstaclesInC:
    """Obstacles around an arm as a structure in C; this object owns the memory.

    `address`: of the `Obstacles`.
    """

    def __init__(self, obstacles: "Obstacles", arm: Manipulator, rod: LoadedArm | None) -> None:
        code = scene_library()
        assert code is not None  # see `Functions.library`
        objects = obstacles.measured.in_c(code)

        def make() -> tuple[Any, ...]:
            return _body_in_c(arm, rod, obstacles.range_groups)

        body, *arrays = make() if rod else arm.kept("body among obstacles", make)
        self._keep = (body, objects, code, *arrays)
        ends, bounds, stations = (array.ctypes.data for array in arrays)
        self._structure = _Obstacles(
            body=body.address,
            objects=ctypes.addressof(objects),
            count=len(objects),
            segments=len(obstacles.range_groups),
            ends=ends,
            bounds=bounds,
            stations=stations,
            clearance=obstacles.scene.clearance,
            margin=OBSTACLES.margin,
            cutoff=obstacles.scene.clearance + OBSTACLES.cutoff,
        )
        self.address = ctypes.addressof(self._structure)


def _body_in_c(arm: Manipulator, rod: LoadedArm | None, groups: tuple[int, ...]) -> tuple[Any, ...]:
    """Return the arm's body, the ends of its segments, and bounds and stations of its ranges."""
    ranges = Ranges.of(range_ends(arm.description))
    return ModelInC(arm, rod), np.array(groups, dtype=np.int64), ranges.bounds, ranges.counts


@dataclass(frozen=True)
class Obstacles:
    """The objects around one arm.

    Attributes
    ----------
    description : the arm.
    range_groups : number of ranges (soft or rigid pieces of the body) up to the end of each
        segment.
    row_objects : index of each row's object.
    """

    scene: Scene
    description: RobotDescription = field(repr=False)
    measured: MeasuredScene = field(init=False, repr=False, compare=False)
    range_groups: tuple[int, ...] = field(init=False)
    row_objects: tuple[int, ...] = field(init=False)

    def __post_init__(self) -> None:
        counts = [1 + (segment.connector > 0) for segment in self.description.segments]
        object.__setattr__(self, "range_groups", tuple(np.cumsum(counts).tolist()))
        measured = measured_scene(self.scene, self.description)
        object.__setattr__(self, "measured", measured)
        rows = [
            index
            for index, item in enumerate(measured.items)
            for _ in range(1 if item.is_ring else len(counts))
        ]
        object.__setattr__(self, "row_objects", tuple(rows))

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of the constraints, one for each row."""
        return tuple(f"{CLEARANCE_OF}{self.measured.names[index]}" for index in self.row_objects)

    def rows(self, arm: Manipulator, p: Array) -> tuple[Array, Array]:
        """Return rows (k,) and derivatives (k, n) per Pa at pressures (n,), not in machine code."""
        checkpoint()
        found = self.nearest(ArmBody(arm, p))
        distances = np.array([nearest.distance for nearest in found])
        rows = OBSTACLES.margin - (distances - self.scene.clearance)
        return rows, -gradients(arm, p, found)

    def nearest(self, body: StationOf) -> list[Nearest]:
        """Return the body's nearest point to the object of each row, approximately."""
        ranges = range_ends(self.description)
        groups = [ranges[begin:end] for begin, end in pairwise((0, *self.range_groups))]
        return [
            nearest
            for item in self.measured.items
            for nearest in (
                [nearest_point(body, item, survey(body, ranges))]
                if item.is_ring
                else [_quickly_nearest(body, item, group) for group in groups]
            )
        ]

    def exactly_nearest(self, body: StationOf) -> list[Nearest]:
        """Return the nearest point of the whole body to each row's object, exactly."""
        ranges = survey(body, range_ends(self.description))
        found = [nearest_point(body, item, ranges) for item in self.measured.items]
        return [found[index] for index in self.row_objects]

    def exact_rows(self, arm: Manipulator, p: Array) -> list[float]:
        """Return rows (k,) for judging, each with the exact least distance of the whole arm."""
        distances = arm.clearances(p, self.scene).distances[list(self.row_objects)]
        return (OBSTACLES.margin - (distances - self.scene.clearance)).tolist()

    def touched(self, rows: list[float]) -> list[str]:
        """Return the names of objects within `OBSTACLES.touching` of the clearance."""
        near = (
            self.measured.names[index]
            for index, row in zip(self.row_objects, rows, strict=True)
            if row > OBSTACLES.margin - OBSTACLES.touching
        )
        return list(dict.fromkeys(near))

    def intruders(self, rows: list[float]) -> dict[str, float]:
        """Return the names of objects that are too near, with the missing distance in m."""
        found: dict[str, float] = {}
        for index, row in zip(self.row_objects, rows, strict=True):
            missing = row - OBSTACLES.margin
            name = self.measured.names[index]
            if not missing <= found.get(name, 0.0):
                found[name] = missing
        return found
