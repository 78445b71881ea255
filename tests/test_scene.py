"""Scenes: distances of objects by other means, and exact minima along bodies."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stiffopt.model import distances as distances_module
from stiffopt.model.clearance import nearest_point, survey
from stiffopt.model.distances import MeasuredObject, scene_library
from stiffopt.model.obstacles import OBSTACLES
from stiffopt.model.obstacles.box import Box
from stiffopt.model.obstacles.capsule import Capsule
from stiffopt.model.obstacles.cylinder import Cylinder
from stiffopt.model.obstacles.half_space import HalfSpace
from stiffopt.model.obstacles.inside_tube import InsideTube
from stiffopt.model.obstacles.mesh import Mesh
from stiffopt.model.obstacles.sphere import Sphere
from stiffopt.model.obstacles.trocar import Trocar

coal = pytest.importorskip("coal")
trimesh = pytest.importorskip("trimesh")

TURNED = (0.8, 0.2, -0.4, 0.4)  # of length 1


pytestmark = pytest.mark.usefixtures("kept_grids")

SHAPES: dict[str, Any] = {
    "sphere": Sphere(centre=(0.01, 0.02, 0.03), radius=0.02),
    "capsule": Capsule(start=(0.04, -0.03, 0.09), end=(0.03, 0.03, 0.08), radius=0.006),
    "box": Box(centre=(0.02, 0.0, 0.06), size=(0.02, 0.04, 0.06), orientation=TURNED),
    "cylinder": Cylinder(start=(0.0, 0.01, 0.02), end=(0.03, 0.03, 0.05), radius=0.012),
    "half_space": HalfSpace(point=(0.0, 0.0, 0.06), normal=(0.0, 0.6, -0.8)),
    "inside_tube": InsideTube(
        points=[(0.0, 0.0, 0.0), (0.0, 0.0, 0.08), (0.03, 0.01, 0.14), (0.08, 0.0, 0.16)],
        radius=0.02,
    ),
    "trocar": Trocar(centre=(0.005, 0.0, 0.05), axis=(0.0, 0.2, 1.0), radius=0.022),
}


def placed(direction: Any, origin: Any) -> Any:
    """Coal's placement of a shape along its z axis."""
    z = np.asarray(direction) / np.linalg.norm(direction)
    x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x /= np.linalg.norm(x)
    return coal.Transform3s(np.stack([x, np.cross(z, x), z], axis=1), np.asarray(origin))


def in_coal(shape: Any) -> tuple[Any, Any]:
    """The same shape in coal, with its placement."""
    if isinstance(shape, Sphere):
        return coal.Sphere(shape.radius), coal.Transform3s(np.eye(3), np.array(shape.centre))
    if isinstance(shape, Box):
        place = coal.Transform3s(rotation(shape.orientation), np.array(shape.centre))
        return coal.Box(*shape.size), place
    if isinstance(shape, HalfSpace):
        normal = np.array(shape.normal)
        return coal.Halfspace(normal, float(normal @ np.array(shape.point))), coal.Transform3s()
    way = np.subtract(shape.end, shape.start)
    middle = np.add(shape.end, shape.start) / 2
    kind = coal.Capsule if isinstance(shape, Capsule) else coal.Cylinder
    return kind(shape.radius, float(np.linalg.norm(way))), placed(way, middle)


def rotation(quaternion: Any) -> np.ndarray:
    """By Rodrigues' formula."""
    w, *axis = quaternion
    angle = 2 * np.arccos(w)
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


@pytest.mark.parametrize("key", ["sphere", "capsule", "box", "cylinder", "half_space"])
def test_distances_are_those_of_another_library(key):
    points = np.random.default_rng(1).uniform(-0.1, 0.12, (300, 3))
    found = MeasuredObject(SHAPES[key]).distances(points).values
    shape, where = in_coal(SHAPES[key])
    ball = coal.Sphere(1e-6)
    for point, distance in zip(points, found, strict=True):
        result = coal.DistanceResult()
        place = coal.Transform3s(np.eye(3), point)
        other = coal.distance(ball, place, shape, where, coal.DistanceRequest(), result)
        assert distance - 1e-6 == pytest.approx(other, abs=2e-6)


def test_distance_inside_a_tube_is_the_radius_less_that_of_its_line():
    shape = SHAPES["inside_tube"]
    points = np.random.default_rng(2).uniform(-0.05, 0.15, (200, 3))
    share = np.linspace(0, 1, 4001)[:, None]
    corners = np.array(shape.points)
    line = np.concatenate([a + share * (b - a) for a, b in pairwise(corners)])
    far = np.linalg.norm(points[:, None] - line[None], axis=2).min(axis=1)
    found = MeasuredObject(shape).distances(points).values
    assert found == pytest.approx(shape.radius - far, abs=1e-6)


def test_distance_of_a_ring_is_that_of_its_circle():
    shape = SHAPES["trocar"]
    axis = np.array(shape.axis)
    first = np.cross(axis, [1.0, 0, 0])
    first /= np.linalg.norm(first)
    angle = np.linspace(0, 2 * np.pi, 20001)[:, None]
    ring = np.cos(angle) * first + np.sin(angle) * np.cross(axis, first)
    circle = np.array(shape.centre) + shape.radius * ring
    points = np.random.default_rng(3).uniform(-0.05, 0.1, (60, 3))
    far = np.linalg.norm(points[:, None] - circle[None], axis=2).min(axis=1)
    assert MeasuredObject(shape).distances(points).values == pytest.approx(far, abs=1e-7)


def test_a_mesh_is_never_farther_than_it_says_and_not_much_nearer(organ):
    shape = Mesh(file=organ, scale=0.001, centre=(0.01, 0.0, 0.05), orientation=TURNED)
    points = np.random.default_rng(4).uniform(-0.09, 0.11, (1500, 3))
    mesh = trimesh.load_mesh(organ)
    mesh.apply_scale(0.001)
    seen = (points - np.array(shape.centre)) @ rotation(shape.orientation)
    _, far, _ = trimesh.proximity.closest_point(mesh, seen)
    inside = mesh.contains(seen)
    true = np.where(inside, -far, far)
    found = MeasuredObject(shape).distances(points).values
    short = true - found
    assert short.min() > -1e-7
    covered = true < 0.02
    assert short[covered].max() < 2 * shape.grid_error
    outside = (true > 0.01) & covered
    assert np.median(short[outside]) < 0.05e-3
    assert short[true < 0.1].max() < 2e-3
    near = np.abs(true - 0.012) < 0.004  # where a body touches
    assert near.sum() > 10
    assert short[near].max() < 0.25e-3
    for point, distance in zip(points[:5], true, strict=False):
        assert shape.distance_of(point) == pytest.approx(distance, abs=1e-6)


def test_the_distance_of_a_mesh_does_not_jump(organ):
    shape = Mesh(file=organ, scale=0.001)
    start, end = np.array([-0.2, 0.013, 0.004]), np.array([0.2, -0.01, 0.02])
    line = start + np.linspace(0, 1, 20001)[:, None] * (end - start)
    step = np.linalg.norm(line[1] - line[0])
    found = MeasuredObject(shape).distances(line).values
    assert np.abs(np.diff(found)).max() < 2 * step


@pytest.mark.parametrize("key", sorted(OBSTACLES))
def test_gradients_are_those_of_finite_differences(key, organ):
    shape = Mesh(file=organ, scale=0.001) if key == "mesh" else SHAPES[key]
    item = MeasuredObject(shape)
    points = np.random.default_rng(5).uniform(-0.08, 0.1, (100, 3))
    normals, step = item.distances(points).normals, 1e-7
    for axis in range(3):
        aside = step * np.eye(3)[axis]
        change = item.distances(points + aside).values - item.distances(points - aside).values
        off = np.abs(change / (2 * step) - normals[:, axis])
        assert np.quantile(off, 0.95) < 1e-5  # a few are on a kink
    if key != "mesh":
        assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=1e-6)


def test_a_distance_has_a_gradient_where_it_has_a_kink():
    for key, point in (
        ("sphere", SHAPES["sphere"].centre),
        ("capsule", SHAPES["capsule"].start),
        ("box", SHAPES["box"].centre),
        ("cylinder", SHAPES["cylinder"].start),
        ("inside_tube", (0.0, 0.0, 0.03)),
        ("trocar", SHAPES["trocar"].centre),
    ):
        found = MeasuredObject(SHAPES[key]).distances(np.array([point]))
        assert np.isfinite(found.normals).all()


# -- minima along bodies --------------------------------------------------------------------------


class Snake:
    """Arcs of circles one after another, in closed form: a body that no model made."""

    def __init__(self, arcs: list[tuple[float, float, float, float, float]]) -> None:
        self.arcs = arcs  # length at rest, stretch, curvature in 1/m, its direction, radius

    @property
    def ends(self) -> tuple[tuple[float, float, int], ...]:
        ends, start = [], 0.0
        for length, *_ in self.arcs:
            ends.append((start + 1e-9, start + length - 1e-9, 12))
            start += length
        return tuple(ends)

    def __call__(self, arc_lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        found = [self.at(float(s)) for s in arc_lengths]
        positions, tangents, radii = zip(*found, strict=True)
        return np.array(positions), np.array(tangents), np.array(radii)

    def at(self, s: float) -> tuple[np.ndarray, np.ndarray, float]:
        R, r = np.eye(3), np.zeros(3)
        for number, (length, stretch, curvature, azimuth, radius) in enumerate(self.arcs):  # noqa: B007
            own = s if number == len(self.arcs) - 1 else min(s, length)
            angle, way = curvature * stretch * own, stretch * own
            side = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            if abs(curvature) > 1e-9:
                across, along = (1 - np.cos(angle)) / curvature, np.sin(angle) / curvature
            else:
                across, along = 0.0, way
            r = r + R @ (side * across + np.array([0, 0, along]))
            x, y = side[:2]
            K = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])
            R = R @ (np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)
            s -= own
            if s <= 0:
                break
        return r, R[:, 2], radius


def random_snake(rng: np.random.Generator) -> Snake:
    return Snake(
        [
            (0.08, rng.uniform(0.95, 1.3), rng.uniform(0, 25), rng.uniform(0, 7), 0.012),
            (0.01, 1.0, 0.0, 0.0, 0.012),
            (0.07, rng.uniform(0.95, 1.3), rng.uniform(0, 30), rng.uniform(0, 7), 0.009),
        ]
    )


def random_shape(key: str, rng: np.random.Generator, organ: Path) -> Any:
    centre, other = rng.uniform((-0.045, -0.045, 0.045), (0.045, 0.045, 0.135), (2, 3))
    if key == "sphere":
        return Sphere(centre=centre, radius=rng.uniform(0.002, 0.03))
    if key in ("capsule", "cylinder"):
        kind = Capsule if key == "capsule" else Cylinder
        return kind(start=centre, end=other, radius=rng.uniform(0.002, 0.02))
    if key == "half_space":
        return HalfSpace(point=centre, normal=rng.normal(size=3))
    if key == "box":
        quaternion = rng.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        return Box(centre=centre, size=rng.uniform(0.01, 0.05, 3), orientation=quaternion)
    if key == "inside_tube":
        steps = np.cumsum(rng.normal((0.003, 0, 0.05), 0.01, (4, 3)), axis=0)
        return InsideTube(points=[(0.0, 0.0, -0.01), *steps], radius=rng.uniform(0.015, 0.03))
    if key == "mesh":
        quaternion = rng.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        return Mesh(file=organ, scale=0.001, centre=centre, orientation=quaternion)
    axis = rng.normal((0, 0, 1.0), 0.5)
    middle = rng.normal((0, 0, rng.uniform(0.01, 0.19)), 0.01)
    return Trocar(centre=middle, axis=axis, radius=rng.uniform(0.013, 0.03))


@lru_cache(maxsize=1)
def snakes() -> list[tuple[Snake, np.ndarray, np.ndarray]]:
    """Bodies with positions and radii of very many stations."""
    rng = np.random.default_rng(6)
    made = [random_snake(rng) for _ in range(12)]
    found = [(snake, snake(np.linspace(0, 0.16, 2000))) for snake in made]
    return [(snake, positions, radii) for snake, (positions, _, radii) in found]


def by_brute_force(item: MeasuredObject, positions: np.ndarray, radii: np.ndarray) -> float:
    """The least distance of many stations."""
    found = item.distances(positions)
    if not item.is_ring:
        return float((found.values - radii).min())
    seen = item.passages(positions)
    crossings = np.flatnonzero(seen.heights[:-1] * seen.heights[1:] <= 0)
    if not len(crossings):
        return -float(seen.from_disc[-1])
    worst = (found.values - radii).argmin()
    inside = sum(bool(seen.beyond[k] <= 0) for k in crossings) % 2 == 1
    return float((found.values[worst] if inside else -found.values[worst]) - radii[worst])


@pytest.mark.one_in(2)
@pytest.mark.parametrize("key", sorted(OBSTACLES))
def test_the_minimum_along_a_body_is_that_of_very_many_stations(key, organ):
    rng = np.random.default_rng(7)
    negative = 0
    for snake, positions, radii in snakes():
        shape = random_shape(key, rng, organ)
        item = MeasuredObject(shape)
        found = nearest_point(snake, item, survey(snake, snake.ends))
        brute = by_brute_force(item, positions, radii)
        assert brute - 5e-5 < found.distance  # as stations are 0.1 mm apart
        beside = item.is_ring and brute < 0
        assert found.distance < brute + (5e-5 if beside else 1e-5 if key == "mesh" else 4e-6)
        if isinstance(shape, Mesh):  # the triangles themselves; what is interpolated has kinks
            seen = (positions - np.array(shape.centre)) @ rotation(shape.orientation)
            assert found.distance < (shape.surface.distances(seen) - radii).min() + 4e-6
        negative += found.distance < 0
        position, _, radius = snake.at(found.s)
        assert position == pytest.approx(found.position, abs=1e-9)
        if not item.is_ring:
            value = item.distances(found.position[None]).values[0]
            assert value - radius == pytest.approx(found.distance, abs=1e-9)
    assert 0 < negative < 12


NEAREST = ("distance", "s", "radius_share", "x", "y", "z", "nx", "ny", "nz")


def nearest_in_c(snake: Snake, items: list[MeasuredObject], cutoff: float = np.inf) -> np.ndarray:
    """What native/scene.h finds, (k, 9)."""
    code = scene_library()
    assert code is not None
    assert code.cdll.stiffopt_scene_object_size() == ctypes.sizeof(distances_module.SceneObjectInC)
    numbers = ctypes.POINTER(ctypes.c_double)

    @ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, numbers, numbers, numbers)
    def station(_: Any, s: float, position: Any, tangent: Any, radius: Any) -> int:
        r, t, radius[0] = snake.at(s)
        for k in range(3):
            position[k], tangent[k] = r[k], t[k]
        return 1

    objects = (distances_module.SceneObjectInC * len(items))(*(item.in_c(code) for item in items))
    ends = np.array([end[:2] for end in snake.ends])
    counts = np.array([end[2] for end in snake.ends], dtype=np.int64)
    found = np.full((len(items), len(NEAREST)), np.nan)
    failed = code.cdll.stiffopt_nearest(
        objects, ctypes.c_int64(len(items)), station, None, ctypes.c_void_p(ends.ctypes.data),
        ctypes.c_void_p(counts.ctypes.data), ctypes.c_int64(len(ends)), ctypes.c_double(cutoff),
        ctypes.c_void_p(found.ctypes.data),
    )  # fmt: skip
    assert not failed
    return found


@pytest.mark.usefixtures("compiled")
def test_c_and_python_find_the_same(organ):
    rng = np.random.default_rng(8)
    for snake, _, _ in snakes()[:6]:
        items = [MeasuredObject(random_shape(key, rng, organ)) for key in sorted(OBSTACLES)]
        found = nearest_in_c(snake, items)
        ranges = survey(snake, snake.ends)
        for item, row in zip(items, found, strict=True):
            same = nearest_point(snake, item, ranges)
            wanted = [same.distance, same.s, same.radius_share, *same.position, *same.normal]
            assert row == pytest.approx(wanted, abs=1e-12)
        cut = nearest_in_c(snake, items, 0.005)[:, 0]
        for item, distance, other in zip(items, found[:, 0], cut, strict=True):
            exact = item.is_ring or distance < 0.005
            assert other == pytest.approx(distance, abs=1e-5) if exact else other >= 0.005 - 1e-5


def test_scenes_do_not_compile(compiled, organ):
    assert scene_library() is not None
    before = sorted(compiled.glob("*.so"))
    rng, (snake, _, _) = np.random.default_rng(10), snakes()[0]
    nearest_in_c(snake, [MeasuredObject(random_shape(key, rng, organ)) for key in OBSTACLES])
    assert sorted(compiled.glob("*.so")) == before
