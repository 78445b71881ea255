"""Export the surface of an arm under pressure as a mesh file."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.documents import write_whole
from stiffopt.errors import FileError, InputError, require_package
from stiffopt.model.manipulator import Manipulator

MESH_ENDINGS = (".stl", ".obj", ".ply")
SPACING = 1e-3
"""Distance between rings along the arm, in m, at rest."""
_AROUND = 48  # vertices of a ring
_CAP = 12  # rings of the hemisphere


def surface_mesh(robot: Manipulator, pressures: ArrayLike, spacing: float = SPACING) -> Any:
    """Return the surface of an arm under pressure as a `trimesh.Trimesh`, in m, in base axes.

    It is the body of `Manipulator.clearance`: a tube of the outer radius (with swelling if
    the strain law models it) that is flat at the base and ends in a hemisphere at the tip.  Under
    gravity and loads it is that of the equilibrium.

    Raises
    ------
    PressureError
        The pressures are not (n,), or the strain law does not hold there.
    InputError
        The spacing does not suit the arm.
    MissingExtraError
        trimesh is not installed.
    """
    require_package("trimesh", "mesh")
    import trimesh

    p = robot.checked_pressures(pressures)
    if not 1e-5 <= spacing <= robot.length / 2:
        raise InputError(f"a spacing of {spacing:g} m does not suit an arm of {robot.length:g} m")
    rings = _rings(robot, p, spacing)
    count = len(rings)
    vertices = np.concatenate([rings.reshape(-1, 3), [np.zeros(3)], [_end(robot, p)]])
    around = np.arange(_AROUND)
    after = np.roll(around, -1)
    first = (np.arange(count - 1) * _AROUND)[:, None]
    lower, upper = (
        (first + around, first + after),
        (first + _AROUND + around, first + _AROUND + after),
    )
    sides = np.stack(
        [np.stack([*lower, upper[1]], -1), np.stack([lower[0], upper[1], upper[0]], -1)]
    )
    base, tip = count * _AROUND, count * _AROUND + 1
    last = (count - 1) * _AROUND
    lids = [
        np.stack([np.full(_AROUND, base), after, around], -1),
        np.stack([last + around, last + after, np.full(_AROUND, tip)], -1),
    ]
    return trimesh.Trimesh(vertices, np.concatenate([sides.reshape(-1, 3), *lids]), process=False)


def _rings(robot: Manipulator, p: Array, spacing: float) -> Array:
    """Return vertices (rings, around, 3) of the tube and of the hemisphere without its pole."""
    at = np.linspace(0, robot.length, int(np.ceil(robot.length / spacing)) + 1)[1:]
    poses = np.concatenate([np.eye(4)[None], robot.pose(p, at)])
    radii = robot.body_radius(p, np.concatenate([[0.0], at]))
    polar = np.linspace(0, np.pi / 2, _CAP + 1)[1:-1]
    poses = np.concatenate([poses, np.repeat(poses[-1:], len(polar), axis=0)])
    ahead = np.concatenate([np.zeros(len(radii)), radii[-1] * np.sin(polar)])
    radii = np.concatenate([radii, radii[-1] * np.cos(polar)])
    angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
    local = np.stack(
        [
            radii[:, None] * np.cos(angle),
            radii[:, None] * np.sin(angle),
            np.broadcast_to(ahead[:, None], (len(radii), _AROUND)),
        ],
        axis=-1,
    )
    return np.asarray(local @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3])


def _end(robot: Manipulator, p: Array) -> Array:
    """Return the pole of the hemisphere, (3,)."""
    tip = robot.tip_pose(p)
    return np.asarray(tip[:3, 3] + robot.body_radius(p, robot.length) * tip[:3, 2])


def save_mesh(robot: Manipulator, pressures: ArrayLike, path: str | Path) -> None:
    """Write `surface_mesh` to an STL, OBJ or PLY file, by its ending.

    Raises
    ------
    FileError
        The file cannot be written, or its name has another ending.
    """
    ending = Path(path).suffix.lower()
    if ending not in MESH_ENDINGS:
        raise FileError(path, f"expected a name that ends in {' or '.join(MESH_ENDINGS)}")
    content = surface_mesh(robot, pressures).export(file_type=ending[1:])
    write_whole(path, content.encode() if isinstance(content, str) else content)
