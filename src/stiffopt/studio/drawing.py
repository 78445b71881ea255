"""Draw arms, arrows and lines in viser's scene, and change them in place."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.arrays import Array
from stiffopt.model.contact.equilibrium import ContactEquilibrium
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.plots import style
from stiffopt.plots.shapes import segment_poses, segment_stations

Floats = NDArray[np.float32]

_STATIONS = 16  # of the tube, per segment
_SPOKES = 20  # points around the tube
_SOLID = 0.72  # opacity of an arm, which shows the ellipsoid inside
_GHOST = 1.04  # radius of a translucent arm, relative to a solid one in the same place
_ANGLES = np.linspace(0, 2 * np.pi, _SPOKES, endpoint=False)
KEPT = ("#8e5bb5", "#2a8a57", "#c99a0b", "#b5547a", "#4aa7b5", "#6b7a3a")
"""Colours of kept solutions, in turn."""
NOWHERE = np.zeros((1, 2, 3), dtype=np.float32)
"""An invisible line or arrow."""


def rgb(colour: str) -> tuple[int, int, int]:
    """Convert a colour such as ``#2f6db3`` to viser's form."""
    return (int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16))


def tube_vertices(poses: Array, radius: float) -> Floats:
    """Return the vertices of a tube: a ring about each pose (k, 4, 4), and the last centre."""
    ring = radius * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])  # (2, spokes)
    points = poses[:, None, :3, 3] + np.einsum("kij,js->ksi", poses[:, :3, :2], ring)
    return np.concatenate([points.reshape(-1, 3), poses[-1:, :3, 3]]).astype(np.float32)


def tube_faces(rings: int) -> NDArray[np.uint32]:
    """Return the triangles of `tube_vertices`, with a lid on the last ring."""
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


def add_force_arrows(server: Any, name: str, length: float) -> Any:
    """Add arrows of forces on an arm of a length, in m; none is visible yet."""
    return server.scene.add_arrows(
        name, NOWHERE, rgb(style.LOAD), shaft_radius=0.005 * length, head_radius=0.013 * length,
        head_length=0.04 * length,
    )  # fmt: skip


class ArmTube:
    """An arm as a tube, each segment with its outer radius and in its colour.

    Parameters
    ----------
    server : viser.ViserServer
    name : of the node in the scene tree.
    description : the robot, which fixes the number of tubes.
    colour, opacity : replace the colours of segments, for an arm shown for comparison.
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
        """Draw the arm at pressures (n,) in Pa, or at an equilibrium on which it leans."""
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
        """Whether the arm is visible."""
        return bool(self._meshes[0].visible)

    @visible.setter
    def visible(self, visible: bool) -> None:
        for mesh in self._meshes:
            if mesh.visible != visible:
                mesh.visible = visible

    @property
    def end(self) -> Array:
        """Centre of the tip's lid (3,), in m."""
        return np.asarray(self._meshes[-1].vertices[-1], dtype=np.float64)

    def remove(self) -> None:
        """Remove the arm from the scene."""
        for mesh in self._meshes:
            mesh.remove()


def add_surroundings(server: Any, description: RobotDescription) -> None:
    """Draw base and floor, and look at the arm from the side; a hanging arm hangs."""
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
    middle = np.array([0.28, 0.1 * up, 0.55]) * length  # x to the right, clear of the panel
    camera.position = tuple(middle + np.array([0.62, -0.95 * up, 0.32 * up]) * length)
    camera.look_at = tuple(middle)
    camera.up = (0.0, 0.0, up)


def draw(handle: Any, points: ArrayLike) -> None:
    """Replace arrows or lines, (k, 2, 3), if they changed."""
    if not np.array_equal(handle.points, points):
        handle.points = points


def place(handle: Any, position: ArrayLike) -> None:
    """Move a node if its position changed."""
    point = np.asarray(position, dtype=float)
    if not np.array_equal(np.asarray(handle.position), point):
        handle.position = point


def turn(handle: Any, quaternion: ArrayLike) -> None:
    """Turn a node to a quaternion (w first) if it changed."""
    wanted = np.asarray(quaternion, dtype=float)
    if not np.array_equal(np.asarray(handle.wxyz), wanted):
        handle.wxyz = wanted
