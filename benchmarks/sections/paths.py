"""Measure stiffness, clearance and time of paths, against warm starts and two references."""

from dataclasses import dataclass, field
from time import process_time

import numpy as np
from scipy.interpolate import CubicSpline

import path_reference as reference
import settings as bars
import tasks
from report import Section, at_least, at_most, percent
from settings import Settings
from stiffopt import Manipulator, PressureSolver, Scene
from stiffopt.paths.path import Path
from stiffopt.paths.solution import PathSolution
from stiffopt.paths.solver import solve_path

TEXT = """\
Random splines, lines and arcs of 250 points 1 mm apart at 10 mm/s and at most 5 bar/s, of which
every point can be had alone; free, and past one to three spheres, capsules and boxes beside the
arm. *Warm starts* solve point after point from the one before, and may jump; *jumps* are steps of
theirs above the rate. The share *of warm starts* is the least on those paths (*fair*) on which
these keep the rates and, half-way between points too, the clearance. *Clear* is the least distance
beyond the clearance, at points and half-way, from 500 stations of the body, computed anew. The
references have 60 points on 240 mm at 5 to 0.2 bar/s: for two segments the best sequence over many
random configurations at each point (a dynamic programme), refined by IPOPT; for three IPOPT on the
whole path from random starts; they share nothing with `solve_path`. Motions past objects, with the
p95 of their time, are in the section *motions*."""

POINTS, SPACING, SPEED = 250, 1e-3, 0.01
REFERENCE_LENGTH = 0.24  # m
SLEW, SLEWS = 5e5, (5e5, 1e5, 0.5e5, 0.2e5)
TOLERANCE, CLEARANCE = 1e-4, 1e-3
ROUNDING = 1e-6  # relative, of steps
BETWEEN = 8e-5  # m, allowed loss of clearance between points
KINDS = ("spline", "line", "arc")
DIRECTIONS = (((1, 0, 0), "base"), ((0, 1, 0), "path"), ((0, 0, 1), "base"))

Vector = np.ndarray


@dataclass
class _Found:
    """What the paths of a row showed."""

    solved: list[bool] = field(default_factory=list)
    broken: int = 0
    clear: list[float] = field(default_factory=list)
    shares: list[float] = field(default_factory=list)
    jumps: int = 0
    seconds: list[float] = field(default_factory=list)


def section(sizes: Settings) -> Section:
    """The table of paths."""
    out = Section(
        "Paths",
        TEXT,
        (
            "segments", "scene", "paths", "solved", "steps above the rate", "clear, mm",
            "of warm starts", "fair", "jumps of these", "CPU, s", "p90, s", "longest, s",
        ),
    )  # fmt: skip
    for segments in (2,) if sizes.quick else (2, 3):
        robot = tasks.arm(segments)
        for name, count in (("none", sizes.paths), ("1 to 3", sizes.scene_paths)):
            if count:
                _row(out, robot, segments, name, count, sizes.seed)
        if sizes.lattice if segments == 2 else sizes.path_starts:
            _references(out, robot, segments, sizes)
    return out


def _row(
    out: Section, robot: Manipulator, segments: int, scene: str, count: int, seed: int
) -> None:
    rng = np.random.default_rng([seed, segments, scene != "none"])
    found = _Found()
    while len(found.solved) < count:
        number = len(found.solved)
        path = path_along(_positions(robot, rng, KINDS[number % 3], POINTS, SPACING), number)
        warm = _warm(robot, path)
        if warm is not None and scene != "none":
            path = path.model_copy(update={"scene": _beside(robot, path, warm, rng)})
            warm = _warm(robot, path)
        if warm is None:
            continue
        if not number:
            solve_path(robot, path)  # what is built once
        begin = process_time()
        solution = solve_path(robot, path)
        found.seconds.append(process_time() - begin)
        _add(found, robot, path, solution, warm)
    arm = f"{tasks.arm_words(segments)}, {scene if scene != 'none' else 'no'} objects"
    seconds = float(np.median(found.seconds))
    slow = float(np.quantile(found.seconds, 0.9, method="inverted_cdf"))
    out.rows.append(
        (
            str(segments), scene, str(count), percent(float(np.mean(found.solved))),
            str(found.broken), f"{1e3 * min(found.clear):.3g}" if found.clear else "-",
            f"{min(found.shares, default=np.nan):.4f}", str(len(found.shares)), str(found.jumps),
            *(f"{each:.2f}" for each in (seconds, slow, max(found.seconds))),
        )
    )  # fmt: skip
    out.data[arm] = {
        "seconds": found.seconds, "of_warm_starts": found.shares, "clear_m": found.clear,
    }  # fmt: skip
    out.verdicts += [
        at_least(f"paths solved, {arm}", 100, 100 * float(np.mean(found.solved)), "%"),
        at_most(f"steps above the rate, {arm}", 0, found.broken, "steps"),
        at_most(f"CPU time of {POINTS} points, {arm}", bars.PATH_SECONDS[segments], seconds, "s"),
    ]
    if found.shares:
        what = f"stiffness over that of warm starts, {arm}"
        out.verdicts.append(at_least(what, 1 - 1e-3, min(found.shares), "x"))
    if found.clear:
        beyond = 1e3 * min(found.clear)
        out.verdicts.append(
            at_least(f"distance beyond the clearance, {arm}", -1e3 * BETWEEN, beyond, "mm")
        )


def _add(
    found: _Found, robot: Manipulator, path: Path, solution: PathSolution, warm: Vector
) -> None:
    """Count one path's figures."""
    found.solved.append(solution.found)
    jumps = int((np.abs(np.diff(warm, axis=0)) > _most(path)).any(axis=1).sum())
    found.jumps += jumps
    if not solution.found:
        return
    p = solution.pressures
    found.broken += int((np.abs(np.diff(p, axis=0)) > _most(path) * (1 + ROUNDING)).any(1).sum())
    is_fair = not jumps
    if path.scene is not None:
        found.clear.append(_beyond(robot, p, path.scene))
        is_fair = is_fair and _beyond(robot, warm, path.scene) > -BETWEEN
    assert path.stiffness is not None
    join = np.min if path.stiffness.over == "worst" else np.mean
    mine, others = (join(np.log(_stiffness(robot, path, each))) for each in (p, warm))
    if is_fair:
        found.shares.append(float(np.exp(mine - others)))


def _beyond(robot: Manipulator, pressures: Vector, scene: Scene) -> float:
    """Least distance beyond the clearance, at pressures (N, n) and half-way between them."""
    every = [*pressures, *(pressures[1:] + pressures[:-1]) / 2]
    return min(clearance(robot, each, scene) for each in every) - CLEARANCE


def path_along(positions: Vector, number: int, over: str | None = None, slew: float = SLEW) -> Path:
    """The path through positions (N, 3) with one of the directions, mostly over the worst."""
    direction, frame = DIRECTIONS[number // 3 % 3]
    measure = {
        "direction": direction, "frame": frame,
        "over": over or ("mean" if number % 4 == 3 else "worst"),
    }  # fmt: skip
    return Path(
        path={"through": [{"position": tuple(row)} for row in positions.tolist()]},
        timing={"speed": SPEED},
        tolerance={"position": TOLERANCE},
        stiffness={"maximise": measure},
        pressure={"slew": slew},
    )


def _most(path: Path) -> Vector:
    """Largest steps (N - 1, 1)."""
    return np.diff(path.points().times)[:, None] * path.pressure.slew


def _stiffness(robot: Manipulator, path: Path, pressures: Vector) -> Vector:
    goals = path.points().goals
    rows = zip(pressures, goals, strict=True)
    return np.array([robot.stiffness(p, goal.maximise[0].direction) for p, goal in rows])


def _warm(robot: Manipulator, path: Path) -> Vector | None:
    """Pressures (N, n) by warm starts; None where a point has no answer."""
    points = path.points()
    solver, found = PressureSolver(robot, path.task(points.targets[0], points.goals[0])), []
    for target, goal in zip(points.targets, points.goals, strict=True):
        if goal != points.goals[0]:
            solver = PressureSolver(robot, path.task(target, goal))
        answer = solver.solve(target, guess=found[-1] if found else None)
        if not answer.found:
            return None
        found.append(answer.pressures)
    return np.array(found)


def _positions(
    robot: Manipulator, rng: np.random.Generator, kind: str, count: int, spacing: float
) -> Vector:
    """Positions (count, 3) along a random line, or less where it is shorter."""
    lower, upper = map(np.array, (robot.pressure_min, robot.pressure_max))
    while True:
        shares = rng.uniform(0.07, 0.8, ({"line": 2, "arc": 3, "spline": 6}[kind], len(lower)))
        x = robot.tip_pose(lower + shares * (upper - lower))[:, :3, 3]
        if kind == "arc":  # a parabola through three points, near enough
            u, dense = [0.0, 0.5, 1.0], np.linspace(0, 1, 2000)
            y = np.stack([np.polyval(np.polyfit(u, axis, 2), dense) for axis in x.T], axis=1)
        elif kind == "line":
            y = x[0] + np.linspace(0, 1, 2000)[:, None] * (x[1] - x[0])
        else:
            y = CubicSpline(np.arange(6), x)(np.linspace(0, 5, 4000))
        lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(y, axis=0), axis=1)))
        if lengths[-1] < (count * spacing if kind == "spline" else 0.04):
            continue
        at = np.linspace(0, min(lengths[-1], (count - 1) * spacing), count)
        return np.stack([np.interp(at, lengths, axis) for axis in y.T], axis=1)


# -- scenes ---------------------------------------------------------------------------------------


def _beside(robot: Manipulator, path: Path, warm: Vector, rng: np.random.Generator) -> Scene:
    """One to three objects that touch or nearly touch arms on the way, but not the tip's path."""
    x, radius = path.points().positions, robot.description.segments[0].outer_radius
    objects: list[dict[str, object]] = []
    wanted = int(rng.integers(1, 4))
    while len(objects) < wanted:
        body = robot.backbone(warm[rng.integers(len(warm))], 60)[:, :3, 3]
        away = rng.normal(size=3) * (1, 1, 0.3)
        away /= np.linalg.norm(away)
        size = rng.uniform(0.004, 0.01)
        gap = radius + size + rng.uniform(-0.004, 0.004)
        centre = body[rng.integers(15, 55)] + gap * away
        if (np.linalg.norm(x - centre, axis=1) < radius + 2 * size + 0.004).any():
            continue
        across = np.cross(away, (0, 0, 1)) * size
        shapes: list[dict[str, object]] = [
            {"sphere": {"centre": tuple(centre), "radius": size}},
            {
                "capsule": {
                    "from": tuple(centre - across), "to": tuple(centre + across), "radius": size,
                }
            },
            {"box": {"centre": tuple(centre), "size": (1.5 * size,) * 3}},
        ]  # fmt: skip
        objects.append({"name": f"object {len(objects)}", **shapes[rng.integers(3)]})
    return Scene(clearance=CLEARANCE, objects=objects)


def clearance(robot: Manipulator, pressures: Vector, scene: Scene) -> float:
    """Least distance of the body from spheres, capsules and boxes, from 500 stations."""
    x = robot.backbone(pressures, 500)[:, :3, 3]
    least = np.inf
    for item in scene.objects:
        if item.sphere is not None:
            away = np.linalg.norm(x - item.sphere.centre, axis=1) - item.sphere.radius
        elif item.box is not None:
            over = np.abs(x - item.box.centre) - np.array(item.box.size) / 2
            away = np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(axis=1), 0)
        else:
            assert item.capsule is not None
            start, way = (
                np.array(item.capsule.start),
                np.subtract(item.capsule.end, item.capsule.start),
            )
            share = np.clip((x - start) @ way / (way @ way), 0, 1)
            away = np.linalg.norm(x - start - share[:, None] * way, axis=1) - item.capsule.radius
        least = min(least, float(away.min()))
    return least - robot.description.segments[0].outer_radius


# -- references -----------------------------------------------------------------------------------


def _references(out: Section, robot: Manipulator, segments: int, sizes: Settings) -> None:
    rng = np.random.default_rng([sizes.seed, segments, 2])
    count = sizes.reference_points
    program = reference.PathProgram(robot, count)
    shares: dict[str, list[float]] = {}
    done = 0
    while done < sizes.reference_paths:
        x = _positions(robot, rng, "spline", count, REFERENCE_LENGTH / count)
        if _warm(robot, path_along(x, 3 * done)) is None:
            continue
        for slew in SLEWS:
            for over in ("worst", "mean"):
                path = path_along(x, 3 * done, over, slew)
                best = best_reference(robot, program, path, sizes)
                solution = solve_path(robot, path)
                if best is None:
                    continue
                asked = question(path, robot)
                value = -np.inf
                if solution.found:
                    value = program.value(asked, solution.pressures / reference.BAR)
                name = f"{segments} segments, {slew / 1e5:g} bar/s, {over}"
                shares.setdefault(name, []).append(float(np.exp(value - best)))
        done += 1
    for name, some in shares.items():
        what = f"stiffness over that of the reference, {name}"
        out.verdicts.append(at_least(what, bars.PATH_SHARE, min(some), "x"))
    out.data[f"references {segments}"] = dict(shares)


def question(path: Path, robot: Manipulator) -> reference.Question:
    """A path as the references want it."""
    points = path.points()
    assert path.stiffness is not None
    directions = np.array([goal.maximise[0].direction for goal in points.goals])
    return reference.Question(
        points.positions, directions,
        np.tile(_most(path) / reference.BAR, robot.n_pressures),
        path.tolerance.position, path.stiffness.over,
    )  # fmt: skip


def best_reference(
    robot: Manipulator, program: reference.PathProgram, path: Path, sizes: Settings
) -> float | None:
    """Logarithm of the best stiffness that a reference finds; None if none follows the path."""
    asked = question(path, robot)
    if robot.n_segments == 2:
        found = reference.lattice(robot, program, asked, sizes.lattice, sizes.seed)
        starts = [] if found is None else [found]
    else:
        starts = list(reference.followed(robot, asked, sizes.path_starts, sizes.seed))
        found = None
    refined = [program.improved(asked, start) for start in starts]
    held = [each for each in (found, *refined) if each is not None]
    return max((program.value(asked, each) for each in held), default=None)
