"""The objects of a task's scene as rows of its program: how far the body is from each.

After the rows of the terms there is one for each object and segment (with its connector), of a
ring one for the whole arm: ``margin - (distance - clearance) <= margin``.  Distances are exact
minima along the body (`stiffopt.model.clearance`); a row has the derivatives of the nearest point.
Scenes are data of these rows, so that no object compiles anything.
"""

import ctypes
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.arm_clearance import MeasuredScene, measured_scene
from stiffopt.model.body import ModelInC
from stiffopt.model.clearance import range_ends
from stiffopt.model.distances import scene_library
from stiffopt.model.description import RobotDescription
from stiffopt.model.loaded_arm import LoadedArm
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.optimise.settings import OBSTACLES

Vector = NDArray[np.float64]

_integer, _double, _pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class _Obstacles(ctypes.Structure):
    """`Obstacles` of native/obstacles.h."""

    _fields_ = [
        ("body", _pointer),
        ("objects", _pointer),
        ("count", _integer),
        ("segments", _integer),
        *((name, _pointer) for name in ("ends", "bounds", "stations")),
        *((name, _double) for name in ("clearance", "margin", "cutoff", "allowed")),
    ]


class ObstaclesInC:
    """Obstacles around an arm as C takes them; this object holds the memory.

    Attributes
    ----------
    address : int
        Of the `Obstacles`.
    """

    def __init__(
        self, obstacles: "Obstacles", arm: Manipulator, rod: LoadedArm | None
    ) -> None:
        code = scene_library()
        assert code is not None  # see `Functions.library`
        body, objects = ModelInC(arm, rod), obstacles.measured.in_c(code)
        ranges = range_ends(arm.description, OBSTACLES.spacing)
        ends = np.array(obstacles.range_groups, dtype=np.int64)
        bounds = np.array([[start, end] for start, end, _ in ranges])
        stations = np.array([count for _, _, count in ranges], dtype=np.int64)
        self._keep = (body, objects, code, ends, bounds, stations)
        self._structure = _Obstacles(
            body=body.address,
            objects=ctypes.addressof(objects),
            count=len(objects),
            segments=len(ends),
            ends=ends.ctypes.data,
            bounds=bounds.ctypes.data,
            stations=stations.ctypes.data,
            clearance=obstacles.scene.clearance,
            margin=OBSTACLES.margin,
            cutoff=obstacles.scene.clearance + OBSTACLES.cutoff,
            allowed=OBSTACLES.allowed,
        )
        self.address = ctypes.addressof(self._structure)


@dataclass(frozen=True)
class Obstacles:
    """The objects around one arm.

    Attributes
    ----------
    scene : Scene
    description : RobotDescription
        The arm.
    range_groups : tuple of int
        Number of ranges (soft or rigid pieces of the body) up to the end of each segment.
    row_objects : tuple of int
        Which object each row is of.
    """

    scene: Scene
    description: RobotDescription = field(repr=False)
    measured: MeasuredScene = field(init=False, repr=False, compare=False)
    range_groups: tuple[int, ...] = field(init=False)
    row_objects: tuple[int, ...] = field(init=False)

    def __post_init__(self) -> None:
        counts = [1 + (segment.connector > 0) for segment in self.description.segments]
        object.__setattr__(self, "range_groups", tuple(np.cumsum(counts).tolist()))
        measured = measured_scene(self.scene)
        object.__setattr__(self, "measured", measured)
        rows = [
            index
            for index, item in enumerate(measured.items)
            for _ in range(1 if item.is_ring else len(counts))
        ]
        object.__setattr__(self, "row_objects", tuple(rows))

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of the constraints, a row each."""
        return tuple(f"clearance of {self.measured.names[index]}" for index in self.row_objects)

    def intruders(self, rows: list[float]) -> dict[str, float]:
        """Names of objects whose rows say that the body is too near, and by how much, in m."""
        found: dict[str, float] = {}
        for index, row in zip(self.row_objects, rows, strict=True):
            missing = row - OBSTACLES.margin
            name = self.measured.names[index]
            if not missing <= found.get(name, 0.0):
                found[name] = missing
        return found
