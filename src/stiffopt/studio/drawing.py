"""What all views draw in space: arms, arrows and lines, changed in place."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.model.contact.equilibrium import ContactEquilibrium
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.plots import style
from stiffopt.plots.shapes import segment_poses, segment_stations

Vector = NDArray[np.float64]
Floats = NDArray[np.float32]

_STATIONS = 16  # of the tube, per segment
_SPOKES = 20  # of the tube, around
_SOLID = 0.72  # opacity, through which the ellipsoid is seen
_GHOST = 1.04  # times the radius, so that a ghost is seen about an arm in the same place
_ANGLES = np.linspace(0, 2 * np.pi, _SPOKES, endpoint=False)
KEPT = ("#8e5bb5", "#2a8a57", "#c99a0b", "#b5547a", "#4aa7b5", "#6b7a3a")
"""Colours of answers that were kept, in turn."""
NOWHERE = np.zeros((1, 2, 3), dtype=np.float32)
"""A line or an arrow that is not to be seen."""


def rgb(colour: str) -> tuple[int, int, int]:
    """Return a colour such as ``#2f6db3`` as viser takes it."""
    return (int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16))


def tube_vertices(poses: Vector, radius: float) -> Floats:
    """Points of a tube about poses (k, 4, 4): a ring about each, then the middle of the last."""
    ring = radius * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])  # (2, spokes)
    points = poses[:, None, :3, 3] + np.einsum("kij,js->ksi", poses[:, :3, :2], ring)
    return np.concatenate([points.reshape(-1, 3), poses[-1:, :3, 3]]).astype(np.float32)


def tube_faces(rings: int) -> NDArray[np.uint32]:
    """Triangles of the points of `tube_vertices`, with a lid on the last ring."""
    spoke = np.arange(_SPOKES)
    after = (spoke + 1) % _SPOKES
    side = np.stack([
        np.stack([spoke, after, spoke + _SPOKES], axis=1),
        np.stack([after, after + _SPOKES, spoke + _SPOKES], axis=1),
    ]).reshape(-1, 3)  # fmt: skip
    sides = (side[None] + _SPOKES * np.arange(rings - 1)[:, None, None]).reshape(-1, 3)
    last = _SPOKES * (rings - 1)
    lid = np.stack([last + spoke, last + after, np.full(_SPOKES, last + _SPOKES)], axis=1)
    return np.concatenate([sides, lid]).astype(np.uint32)


class ArmTube:
    """An arm as a tube, each segment with its outer radius and in its colour.

    Parameters
    ----------
    server : viser.ViserServer
    name :
        Of the node in the scene tree.
    description :
        The robot, at whose `n_segments` the number of tubes is fixed.
    colour, opacity :
        Instead of the colours of segments, for an arm that is compared with.
    """

    def __init__(
        self,
        server: Any,
        name: str,
        description: RobotDescription,
        colour: str | None = None,
        opacity: float | None = None,
    ) -> None:
        self._meshes = []
        self._width = 1.0 if colour is None else _GHOST
        faces = tube_faces(_STATIONS)
        flat = np.zeros((_STATIONS * _SPOKES + 1, 3), dtype=np.float32)
        for number in range(description.n_segments):
            shade = style.segment_colour(number) if colour is None else colour
            self._meshes.append(
                server.scene.add_mesh_simple(
                    f"{name}/{number}", flat, faces, color=rgb(shade), opacity=opacity or _SOLID,
                    side="double", visible=False, cast_shadow=False,
                    receive_shadow=False,
                )
            )  # fmt: skip

    def show(
        self,
        robot: Manipulator,
        pressures: ArrayLike,
        equilibrium: ContactEquilibrium | None = None,
    ) -> None:
        """Draw it at pressures (n,) in Pa; or as it leans on objects there."""
        if equilibrium is None:
            poses = segment_poses(robot, pressures, _STATIONS)
        else:
            at = segment_stations(robot, _STATIONS)
            poses = equilibrium.poses(at.ravel()).reshape(*at.shape, 4, 4)
        pairs = zip(self._meshes, robot.description.segments, poses, strict=True)
        for mesh, segment, mine in pairs:
            mesh.vertices = tube_vertices(mine, self._width * segment.outer_radius)
        self.visible = True

    @property
    def visible(self) -> bool:
        """Whether it is seen."""
        return bool(self._meshes[0].visible)

    @visible.setter
    def visible(self, visible: bool) -> None:
        for mesh in self._meshes:
            if mesh.visible != visible:
                mesh.visible = visible

    @property
    def end(self) -> Vector:
        """Middle of the lid of its tip (3,), in m."""
        return np.asarray(self._meshes[-1].vertices[-1], dtype=np.float64)

    def remove(self) -> None:
        """Take it away for good."""
        for mesh in self._meshes:
            mesh.remove()


def add_surroundings(server: Any, description: RobotDescription) -> None:
    """Draw the base and the floor, and look at the arm from the side; what hangs is drawn so."""
    length = description.length
    hangs = description.gravity[2] > 0
    up = -1.0 if hangs else 1.0
    server.scene.set_up_direction("-z" if hangs else "+z")
    server.scene.add_grid(
        "/floor", width=1.6 * length, height=1.6 * length, cell_size=0.01, section_size=0.05,
        cell_color=(225, 225, 225), section_color=(190, 190, 190),
    )  # fmt: skip
    server.scene.add_frame("/base", axes_length=0.12 * length, axes_radius=0.004 * length)
    radius = 1.7 * description.segments[0].outer_radius
    server.scene.add_cylinder(
        "/plate", radius=radius, height=0.02 * length, color=(141, 153, 166),
        position=(0.0, 0.0, -0.011 * length),
    )  # fmt: skip
    camera = server.initial_camera
    middle = np.array([0.28, 0.1 * up, 0.55]) * length  # x to the right; beside the panel
    camera.position = tuple(middle + np.array([0.62, -0.95 * up, 0.32 * up]) * length)
    camera.look_at = tuple(middle)
    camera.up = (0.0, 0.0, up)


def draw(handle: Any, points: ArrayLike) -> None:
    """Draw other arrows or lines, (k, 2, 3), if they are not there already."""
    if not np.array_equal(handle.points, points):
        handle.points = points


def place(handle: Any, position: ArrayLike) -> None:
    """Move a node, if it is not there already."""
    point = np.asarray(position, dtype=float)
    if not np.array_equal(np.asarray(handle.position), point):
        handle.position = point


def turn(handle: Any, quaternion: ArrayLike) -> None:
    """Turn a node to a quaternion (w first), if it is not turned so already."""
    wanted = np.asarray(quaternion, dtype=float)
    if not np.array_equal(np.asarray(handle.wxyz), wanted):
        handle.wxyz = wanted
