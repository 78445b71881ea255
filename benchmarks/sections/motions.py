"""Measure motions in cluttered scenes; independent distances check their clearance."""

from __future__ import annotations

from itertools import pairwise
from time import perf_counter, process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

import settings as bars
import tasks
from report import Section, at_least, at_most
from settings import Settings
from stiffopt import Manipulator, PathSolution, Scene, plan_motion
from stiffopt.model.compiled import compiling_at_once
from stiffopt.model.distances import scene_library

TEXT = """\
Eight spheres, capsules and boxes within reach of the arm, and two random configurations that are
clear of them by 2 mm; the time is that of `plan_motion` to a timed motion (CPU and wall, hot).
*Around*: solved scenes whose straight way is blocked. Scenes that are not solved in 20 s are left
out; of the others 2 s should be enough. *Below*: by how much the clearance at twenty points of
each step, at 200 stations by formulas in NumPy, comes below the 2 mm at most."""

ASKED = 2e-3  # m
OBJECTS = 8
SECONDS, LONGER = 2.0, 20.0

Array = NDArray[np.float64]


def section(sizes: Settings) -> Section:
    """The table of motions."""
    out = Section(
        "Motions",
        TEXT,
        ("arm", "scenes", "around", "solved", "left out", "median, ms", "p95, ms", "p95 wall, ms",
         "below, mm"),
    )  # fmt: skip
    free: list[float] = []
    solved, all_, below = 0, 0, -np.inf
    for name, robot in (("2", tasks.arm(2)), ("3", tasks.arm(3)), ("hanging", tasks.hanging_arm())):
        count = 3 if sizes.quick else 25
        runs = _runs(robot, count, np.random.default_rng([sizes.seed, len(name), len(free)]))
        kept = [run for run in runs if not run["left_out"]]
        done = [run for run in kept if run["solved"]]
        cpu, wall = ([run[key] * 1e3 for run in done] for key in ("cpu", "wall"))
        lowest = max((run["below"] for run in done), default=np.nan)
        solved, all_, below = solved + len(done), all_ + len(kept), max(below, lowest)
        out.rows.append(
            (
                name, str(count), str(sum(run["around"] for run in done)), str(len(done)),
                str(count - len(kept)), f"{np.median(cpu):.3g}", f"{np.quantile(cpu, 0.95):.3g}",
                f"{np.quantile(wall, 0.95):.3g}", f"{lowest * 1e3:.3f}",
            )
        )  # fmt: skip
        out.data[name] = runs
        if robot.is_loaded:
            limit = bars.MOTION_LOADED_MS
            what = "p95 of CPU time to a timed motion under gravity"
            out.verdicts.append(at_most(what, limit, float(np.quantile(cpu, 0.95)), "ms"))
        else:
            free += cpu
    what = "p95 of CPU time to a timed motion without gravity"
    out.verdicts.append(at_most(what, bars.MOTION_MS, float(np.quantile(free, 0.95)), "ms"))
    out.verdicts.append(
        at_least("share of scenes solved", bars.MOTIONS_SOLVED, solved / max(all_, 1), "")
    )
    out.verdicts.append(
        at_most("clearance below what was asked", bars.MOTION_BELOW_MM, below * 1e3, "mm")
    )
    return out


def _runs(robot: Manipulator, count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    with compiling_at_once():
        robot._body.machine_code(10_000)
        scene_library()
    runs = []
    for index in range(count + 1):
        objects, scene, start, end = cluttered(robot, rng)
        begin, cpu = perf_counter(), process_time()
        motion = plan_motion(robot, start, end, scene=scene, timeout=SECONDS)
        run: dict[str, Any] = {"cpu": process_time() - cpu, "wall": perf_counter() - begin}
        if index == 0:
            continue  # makes the bounds of the arm
        run["solved"] = motion.found
        run["left_out"] = not motion.found and not (
            plan_motion(robot, start, end, scene=scene, timeout=LONGER).found
        )
        if motion.found:
            run["around"] = "RRTConnect" in motion.confidence
            run["below"] = ASKED - least(motion, objects)
        runs.append(run)
    return runs


def cluttered(
    robot: Manipulator, rng: np.random.Generator
) -> tuple[list[tuple[str, dict[str, Any]]], Scene, Array, Array]:
    """Objects by kind, their scene, and two configurations that are clear of them."""
    low, high = robot.pressure_min, robot.pressure_max
    radius = robot.description.segments[0].outer_radius
    while True:
        objects: list[tuple[str, dict[str, Any]]] = []
        while len(objects) < OBJECTS:
            p = low + (high - low) * rng.random(len(low))
            x = robot.pose(p, robot.length * rng.uniform(0.35, 1))[:3, 3]
            x = x + 0.02 * rng.normal(size=3)
            aside = rng.normal(size=3)
            aside *= rng.uniform(0.01, 0.03) / np.linalg.norm(aside)
            kind, shape = [
                ("sphere", {"centre": x, "radius": rng.uniform(0.005, 0.015)}),
                (
                    "capsule",
                    {"from": x - aside, "to": x + aside, "radius": rng.uniform(3e-3, 8e-3)},
                ),
                ("box", {"centre": x, "size": rng.uniform(0.01, 0.03, 3)}),
            ][rng.integers(3)]
            if distances(kind, shape, np.zeros((1, 3)))[0] > radius + ASKED + 0.01:
                objects.append((kind, shape))
        named = [{"name": f"{kind} {k}", kind: shape} for k, (kind, shape) in enumerate(objects)]
        scene = Scene(clearance=ASKED, objects=named)
        p = low + (high - low) * rng.random((100, len(low)))
        p = p[robot.clearance(p, scene) > ASKED]
        if len(p) > 1:
            return objects, scene, p[0], p[1]


def distances(kind: str, shape: dict[str, Any], x: Array) -> Array:
    """Distances (k,) of points (k, 3) from an object."""
    if kind == "sphere":
        return np.asarray(np.linalg.norm(x - shape["centre"], axis=1) - shape["radius"])
    if kind == "capsule":
        way = shape["to"] - shape["from"]
        share = np.clip((x - shape["from"]) @ way / (way @ way), 0, 1)
        off = np.linalg.norm(x - shape["from"] - share[:, None] * way, axis=1)
        return np.asarray(off - shape["radius"])
    beyond = np.abs(x - shape["centre"]) - shape["size"] / 2
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return np.asarray(outside + np.minimum(beyond.max(axis=1), 0))


def least(motion: PathSolution, objects: list[tuple[str, dict[str, Any]]]) -> float:
    """The least clearance at twenty points of each step."""
    robot, found = motion.robot, np.inf
    shares = np.linspace(0, 1, 20)[:, None]
    for a, b in pairwise(motion.pressures):
        x = robot.backbone(a + shares * (b - a), 200)[:, :, :3, 3].reshape(-1, 3)
        found = min(found, *(distances(kind, shape, x).min() for kind, shape in objects))
    return float(found - robot.description.segments[0].outer_radius)
