"""Random tasks with objects around the arm, all of which can be done.

A task's target is the tip at random pressures that keep clear of every object with some to spare,
so a solver that finds nothing has failed.  Most objects are put next to the configuration that is
the stiffest without them, the others next to random ones.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

import tasks
from independent.arms import FLOP, Arm
from scenes.judge import distances
from stiffopt import Manipulator, Scene, StiffnessGoal, Target, Task, solve_pressure

Vector = NDArray[np.float64]

CLEARANCE = 2e-3
SPARE = 0.5e-3  # that the pressures of the target have beyond it
RADIUS = FLOP.outer_radius

ARMS: dict[str, tuple[Callable[[], Manipulator], Arm, float]] = {
    "1 segment": (lambda: tasks.arm(1), Arm((FLOP,)), 1.0),
    "2 segments": (lambda: tasks.arm(2), Arm((FLOP, FLOP)), 1.0),
    "3 segments": (lambda: tasks.arm(3), Arm((FLOP, FLOP, FLOP)), 1.0),
    "hanging": (tasks.hanging_arm, Arm((FLOP, FLOP)).under((0.0, 0.0, 9.81), 0.02), 0.5),
}
"""Arms by name: stiffopt's model, the independent one, share of the pressures of targets."""

KINDS = (
    "sphere", "capsule", "box", "cylinder", "half_space", "mesh", "inside_tube", "trocar",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One task: the objects as a scene file has them, in SI, and what is asked for."""

    objects: tuple[dict[str, Any], ...]
    position: tuple[float, ...]
    direction: tuple[float, ...]
    pressures: Vector  # of the target

    @property
    def kinds(self) -> str:
        """The kinds of its objects."""
        return ", ".join(kind_of(item) for item in self.objects)

    def task(self, with_scene: bool = True, variant: int = 0) -> Task:
        """The task, as from a file; variants differ by nothing that matters, and share nothing."""
        direction = tuple(x + 1e-9 * variant for x in self.direction)
        scene = Scene(clearance=CLEARANCE, objects=self.objects) if with_scene else None
        return Task(
            target=Target(position=self.position),
            stiffness=StiffnessGoal(maximise=[{"direction": direction}]),
            scene=scene,
        )


def kind_of(item: dict[str, Any]) -> str:
    """Under which key an object has its shape."""
    return next(key for key in item if key != "name")


def random_case(name: str, seed: int, number: int, folder: Path) -> Case:
    """One of the random tasks of an arm."""
    make, _, share = ARMS[name]
    robot = make()
    rng = np.random.default_rng([seed, list(ARMS).index(name), number])
    while True:
        p = share * rng.uniform(robot.pressure_min, robot.pressure_max)
        position = tuple(robot.tip_pose(p)[:3, 3].tolist())
        direction = rng.normal(size=3)
        case = Case((), position, tuple((direction / np.linalg.norm(direction)).tolist()), p)
        free = solve_pressure(robot, case.task(with_scene=False))
        if not free.found:
            continue
        line = robot.backbone(p, 400)[:, :3, 3]
        objects = []
        for index in range(int(rng.integers(1, 5))):
            item = _object(robot, rng, share, p, free.pressures, line, folder)
            if item is not None:
                objects.append({"name": f"{kind_of(item)} {index}", **item})
        if objects:
            return Case(tuple(objects), position, case.direction, p)


def _object(
    robot: Manipulator, rng: np.random.Generator, share: float, p: Vector, best: Vector,
    line: Vector, folder: Path,
) -> dict[str, Any] | None:  # fmt: skip
    """A random object that the pressures of the target keep clear of; None after many trials."""
    kind = str(rng.choice(KINDS))
    for _ in range(100):
        other = best
        if rng.random() < 0.4:
            other = share * rng.uniform(robot.pressure_min, robot.pressure_max)
        aside = rng.normal(size=3)
        aside *= (RADIUS + 4e-3) * rng.uniform(0.2, 1.2) / np.linalg.norm(aside)
        at = float(rng.uniform(0.3, 1.0) * robot.length)
        place = robot.pose(other, at)[:3, 3] + aside
        item = {kind: _shape(kind, robot, rng, p, place, folder)}
        base = np.inf if kind == "trocar" else distances(item, np.zeros((1, 3)))[0] - RADIUS
        if base > 2 * CLEARANCE and distances(item, line).min() - RADIUS > CLEARANCE + SPARE:
            return item
    return None


def _shape(
    kind: str, robot: Manipulator, rng: np.random.Generator, p: Vector, place: Vector, folder: Path
) -> dict[str, Any]:
    radius = float(rng.uniform(4e-3, 12e-3))
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    quaternion = rng.normal(size=4)
    turned = {"orientation": (quaternion / np.linalg.norm(quaternion)).tolist()}
    if kind == "sphere":
        return {"centre": place.tolist(), "radius": radius}
    if kind in ("capsule", "cylinder"):
        half = float(rng.uniform(0.01, 0.03)) * way
        return {
            "from": (place - half).tolist(), "to": (place + half).tolist(), "radius": radius
        }  # fmt: skip
    if kind == "box":
        return {"centre": place.tolist(), "size": rng.uniform(8e-3, 30e-3, 3).tolist(), **turned}
    if kind == "half_space":
        return {"point": place.tolist(), "normal": way.tolist()}
    if kind == "mesh":
        return {"file": str(_mesh_file(rng, folder)), "scale": 1e-3, "centre": place.tolist(),
                **turned}  # fmt: skip
    if kind == "inside_tube":
        points = robot.backbone(p, int(rng.integers(4, 8)))[:, :3, 3] + rng.normal(size=3) * 1e-3
        return {"points": points.tolist(), "radius": RADIUS + float(rng.uniform(6e-3, 20e-3))}
    T = robot.pose(p, float(rng.uniform(0.2, 0.6)) * robot.length)
    tilted = T[:3, 2] + 0.2 * way
    return {
        "centre": (T[:3, 3] + 2e-3 * way).tolist(),
        "axis": (tilted / np.linalg.norm(tilted)).tolist(),
        "radius": RADIUS + float(rng.uniform(4e-3, 12e-3)),
    }


def _mesh_file(rng: np.random.Generator, folder: Path) -> Path:
    """One of some meshes in mm: an ellipsoid, a ring, a frustum; few, as each has a grid made."""
    number = int(rng.integers(6))
    file = folder / f"mesh-{number}.stl"
    if not file.exists():
        size = 1 + number // 3 / 2
        made = (
            lambda: trimesh.creation.icosphere(subdivisions=3, radius=8 * size),
            lambda: trimesh.creation.torus(16 * size, 5 * size, 48, 24),
            lambda: trimesh.creation.cone(10 * size, 24 * size, sections=6),
        )[number % 3]()
        if number % 3 == 0:
            made.apply_scale([1.0, 0.6, 1.5])
        made.export(file)
    return file
