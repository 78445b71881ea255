"""How near a centre line comes to the objects of a scene, without anything of stiffopt.

Solid bodies and meshes are measured by coal, from capsules along the line: the smallest distances
of a fine tube.  Coal knows no inside of a tube and no ring: these are formulas on many points.  The
line itself is that of tests/independent/rods.py.
"""

from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import igl
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

Vector = NDArray[np.float64]

GRID, AROUND = 1.25, 25.0  # mm: cubes of the distances of meshes, which IPOPT and tasks use


def clearances(objects: Any, line: Vector, radius: float, asked: float = 0.0) -> list[float]:
    """Least distances of a tube of this radius about points (k, 3), one for each object.

    A plate behind the base, on which the arm is mounted, sees the tube from a quarter more than the
    way along it on which a straight one is as far away as `asked`.
    """
    found, whole = [], line
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(whole, axis=0), axis=1)))
    for item in objects:
        line = whole
        if _is_plate(item):
            line = whole[way > 1.25 * (radius + asked + item["half_space"]["point"][2])]
        if "inside_tube" in item or "trocar" in item:
            found.append(float(distances(item, line).min()) - radius)
        else:
            found.append(_by_coal(item, line, radius))
    return found


def _is_plate(item: dict[str, Any]) -> bool:
    if "half_space" not in item:
        return False
    x, y, z = item["half_space"]["normal"]
    return bool(x == y == 0 < z and item["half_space"]["point"][2] <= 0)


def _by_coal(item: dict[str, Any], line: Vector, radius: float) -> float:
    import coal

    shape, place = _in_coal(item)
    least, request = np.inf, coal.DistanceRequest()
    skip = 0.0
    for a, b in pairwise(line):
        way = b - a
        length = float(np.linalg.norm(way))
        skip -= length
        if skip > 0:  # a distance changes by no more than the way
            continue
        capsule, middle = coal.Capsule(radius, length), coal.Transform3s(_upright(way), (a + b) / 2)
        distance = coal.distance(capsule, middle, shape, place, request, coal.DistanceResult())
        least = min(least, distance)
        skip = distance - least - length
    return float(least)


def _in_coal(item: dict[str, Any]) -> tuple[Any, Any]:
    """A solid in coal, and its placement."""
    import coal

    (kind, shape), = ((k, v) for k, v in item.items() if k != "name")  # fmt: skip
    if kind == "half_space":
        normal = np.array(shape["normal"]) / np.linalg.norm(shape["normal"])
        return coal.Halfspace(normal, float(normal @ shape["point"])), coal.Transform3s()
    if kind in ("capsule", "cylinder"):
        way, middle = (
            np.subtract(shape["to"], shape["from"]),
            np.add(shape["to"], shape["from"]) / 2,
        )
        made = coal.Capsule if kind == "capsule" else coal.Cylinder
        return made(shape["radius"], float(np.linalg.norm(way))), coal.Transform3s(
            _upright(way), middle
        )
    place = coal.Transform3s(_turned(shape), np.array(shape["centre"]))
    if kind == "sphere":
        return coal.Sphere(shape["radius"]), place
    if kind == "box":
        return coal.Box(*shape["size"]), place
    mesh = _mesh(shape["file"])
    model = coal.BVHModelOBBRSS()
    model.beginModel(len(mesh.faces), 3 * len(mesh.faces))
    for triangle in mesh.vertices[mesh.faces] * shape["scale"]:
        model.addTriangle(*triangle)
    model.endModel()
    return model, place


def distances(item: dict[str, Any], x: Vector) -> Vector:
    """Signed distances (k,) of points (k, 3) from an object; of a ring see `_from_ring`."""
    (kind, shape), = ((k, v) for k, v in item.items() if k != "name")  # fmt: skip
    if kind == "sphere":
        return np.asarray(np.linalg.norm(x - shape["centre"], axis=1) - shape["radius"])
    if kind == "capsule":
        return _from_straight(x, shape["from"], shape["to"]) - shape["radius"]
    if kind == "box":
        seen = (x - shape["centre"]) @ _turned(shape)
        return _from_box(np.abs(seen) - np.array(shape["size"]) / 2)
    if kind == "cylinder":
        way = np.subtract(shape["to"], shape["from"])
        length = np.linalg.norm(way)
        height = (x - shape["from"]) @ way / length
        beside = np.linalg.norm(x - shape["from"] - np.outer(height, way / length), axis=1)
        ends = np.abs(height - length / 2) - length / 2
        return _from_box(np.stack([beside - shape["radius"], ends], axis=1))
    if kind == "half_space":
        return (x - shape["point"]) @ np.array(shape["normal"])
    if kind == "inside_tube":
        pieces = [_from_straight(x, a, b) for a, b in pairwise(np.array(shape["points"]))]
        return np.asarray(shape["radius"] - np.min(pieces, axis=0))
    if kind == "mesh":
        seen = (x - shape["centre"]) @ _turned(shape) / shape["scale"]
        return _in_grid(shape["file"], seen) * shape["scale"]
    return _from_ring(shape, x)


def _from_ring(shape: dict[str, Any], x: Vector) -> Vector:
    """Distances of a ring; all of them -1 where the line x does not pass through it."""
    height = (x - shape["centre"]) @ np.array(shape["axis"])
    beside = np.linalg.norm(x - shape["centre"] - np.outer(height, shape["axis"]), axis=1)
    crossing = np.flatnonzero((height[:-1] <= 0) != (height[1:] <= 0))
    if np.sum(beside[crossing] < shape["radius"]) % 2 == 0 and len(x) > 1:
        return np.full(len(x), -1.0)
    return np.hypot(beside - shape["radius"], height)


def _from_straight(x: Vector, a: Any, b: Any) -> Vector:
    way = np.subtract(b, a)
    share = np.clip((x - a) @ way / (way @ way), 0, 1)
    return np.asarray(np.linalg.norm(x - a - np.outer(share, way), axis=1))


def _from_box(excess: Vector) -> Vector:
    outside = np.linalg.norm(np.maximum(excess, 0), axis=1)
    return np.asarray(outside + np.minimum(excess.max(axis=1), 0))


def _in_grid(file: str, x: Vector) -> Vector:
    """Interpolated distances of points from a mesh, all in its unit; beyond the grid roughly."""
    low, values = _grid(file)
    places = (x - low) / GRID
    inside = np.clip(places, 0, np.array(values.shape) - 1)
    beyond = np.linalg.norm(places - inside, axis=1) * GRID
    return np.asarray(ndimage.map_coordinates(values, inside.T, order=1)) + beyond


@cache
def _grid(file: str) -> tuple[Vector, Vector]:
    """First corner (3,) and signed distances at the corners of cubes about a mesh."""
    mesh = _mesh(file)
    low, high = mesh.vertices.min(axis=0) - AROUND, mesh.vertices.max(axis=0) + AROUND
    axes = [np.arange(a, b, GRID) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    squares = igl.point_mesh_squared_distance(points, mesh.vertices, mesh.faces)[0]
    inside = igl.fast_winding_number(mesh.vertices, mesh.faces, points) > 0.5
    signed = np.where(inside, -1, 1) * np.sqrt(squares)
    return low, signed.reshape([len(axis) for axis in axes])


class _Triangles(NamedTuple):
    vertices: Vector
    faces: NDArray[np.int64]


@cache
def _mesh(file: str) -> _Triangles:
    mesh = trimesh.load_mesh(file)
    return _Triangles(
        np.asfortranarray(mesh.vertices, dtype=float), np.asfortranarray(mesh.faces, dtype=np.int64)
    )


def _turned(shape: dict[str, Any]) -> Vector:
    w, *axis = shape.get("orientation", (1.0, 0.0, 0.0, 0.0))
    return np.asarray(Rotation.from_quat([*axis, w]).as_matrix())


def _upright(way: Vector) -> Vector:
    """A rotation (3, 3) whose z axis is along a vector."""
    z = way / np.linalg.norm(way)
    x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
