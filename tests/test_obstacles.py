"""Tasks with a scene: no answer is nearer than it may be, and the stiffest of those is found.

Distances are measured here once more, with formulas in NumPy on 2000 stations of the body.
"""

from __future__ import annotations

import pickle
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt import (
    Manipulator,
    PressureSolution,
    PressureSolver,
    Scene,
    StiffnessGoal,
    Target,
    Task,
    load_robot,
    load_task,
    solve_batch,
    solve_pressure,
)
from stiffopt.errors import DerivativeError, FileError, InputError
from stiffopt.model import compiled as code
from stiffopt.optimise.derivatives import AnswerDerivatives
from stiffopt.optimise.general_search import GeneralSearch
from stiffopt.optimise.problem import PressureProblem

Array = NDArray[np.float64]

PROBLEMS = Path(__file__).parents[1] / "problems"
CLEARANCE = 2e-3
EXACT = 5e-5  # m, by which an answer may be nearer than it may be
AT = (-0.03, 0.01, 0.19)

POST = {"name": "post", "sphere": {"centre": (0.006, -0.012, 0.13), "radius": 0.008}}
RIB = {
    "name": "rib",
    "capsule": {"from": (-0.024, -0.04, 0.11), "to": (-0.024, 0.04, 0.11), "radius": 0.006},
}
KINDS: dict[str, dict[str, Any]] = {
    "sphere": POST["sphere"],
    "capsule": RIB["capsule"],
    "box": {"centre": (0.022, 0.0, 0.12), "size": (0.02, 0.03, 0.02)},
    "cylinder": {"from": (0.018, -0.03, 0.13), "to": (0.018, 0.02, 0.13), "radius": 0.006},
    "half_space": {"point": (0.0173, 0, 0), "normal": (-1, 0, -0.01)},
    "inside_tube": {
        "points": [(0, 0, 0), (0, 0, 0.09), (-0.006, -0.003, 0.14), (-0.03, 0.01, 0.2)],
        "radius": 0.022,
    },
    "trocar": {"centre": (0.0015, 0.0035, 0.1), "axis": (0, 0, 1), "radius": 0.0176},
}


def from_line(x: Array, a: Any, b: Any) -> Array:
    """Distances (k,) of points from a straight line between two."""
    a, way = np.array(a), np.subtract(b, a)
    share = np.clip((x - a) @ way / (way @ way), 0, 1)
    return np.asarray(np.linalg.norm(x - a - share[:, None] * way, axis=1))


def from_box(excess: Array) -> Array:
    outside = np.linalg.norm(np.maximum(excess, 0), axis=1)
    return np.asarray(outside + np.minimum(excess.max(axis=1), 0))


def distances(kind: str, shape: dict[str, Any], x: Array) -> Array:
    """Distances (k,) of points (k, 3) of a centre line."""
    if kind == "sphere":
        return np.asarray(np.linalg.norm(x - shape["centre"], axis=1) - shape["radius"])
    if kind == "capsule":
        return from_line(x, shape["from"], shape["to"]) - shape["radius"]
    if kind == "box":
        return from_box(np.abs(x - shape["centre"]) - np.array(shape["size"]) / 2)
    if kind == "cylinder":
        middle = np.add(shape["from"], shape["to"]) / 2
        way = np.subtract(shape["to"], shape["from"])
        height = (x - middle) @ way / np.linalg.norm(way)
        beside = np.linalg.norm(np.cross(x - middle, way / np.linalg.norm(way)), axis=1)
        half = np.linalg.norm(way) / 2
        return from_box(np.stack([beside - shape["radius"], np.abs(height) - half], 1))
    if kind == "half_space":
        normal = np.array(shape["normal"]) / np.linalg.norm(shape["normal"])
        return np.asarray((x - shape["point"]) @ normal)
    if kind == "inside_tube":
        points = shape["points"]
        pieces = [from_line(x, a, b) for a, b in pairwise(points)]
        return np.asarray(shape["radius"] - np.min(pieces, axis=0))
    centre, axis = np.array(shape["centre"]), np.array(shape["axis"])
    height = (x - centre) @ axis
    beside = np.linalg.norm(x - centre - height[:, None] * axis, axis=1)
    crossing = np.flatnonzero(height[:-1] * height[1:] <= 0)
    assert (beside[crossing] < shape["radius"]).all()
    assert len(crossing) % 2
    return np.hypot(beside - shape["radius"], height)


def clearance(robot: Manipulator, pressures: Any, scene: Scene) -> float:
    """The least of all distances of the body, for arms of one outer radius."""
    x = robot.backbone(pressures, 2000)[:, :3, 3]
    least = []
    for item in scene.model_dump(by_alias=True)["objects"]:
        (kind,) = (key for key in KINDS if item.get(key) is not None)
        least.append(distances(kind, item[kind], x).min())
    return float(min(least) - robot.description.segments[0].outer_radius)


def scene_of(*objects: dict[str, Any]) -> Scene:
    return Scene(clearance=CLEARANCE, objects=list(objects))


def task_with(scene: Scene | None, position: Any = AT, **options: Any) -> Task:
    goal = StiffnessGoal(maximise=[{"direction": (1, 0, 0)}])
    return Task(target=Target(position=position), stiffness=goal, scene=scene, **options)


def optimum_next_to(robot: Manipulator, task: Task, guess: Array) -> tuple[Array, float]:
    """Pressures and stiffness, as exactly as can be had."""
    near = solve_pressure(robot, task, guess=guess)
    assert near.robot is not None
    found = AnswerDerivatives(near.robot, task, near.pressures)
    p = found._point.x * found._problem.unit
    return p, float(robot.stiffness(p, (1, 0, 0)))


def check_derivatives(robot: Manipulator, task: Task, h: float = 1e-6) -> None:
    """By the target, along a direction, and by the clearance, against tasks solved again."""
    found = solve_pressure(robot, task)
    assert found.weakly_active == ()
    assert task.scene is not None
    way = np.array([0.5, -0.7, 0.4]) * [axis is not None for axis in task.target.position]
    tasks: dict[str, list[Task]] = {"target": [], "clearance": []}
    for step in (-h, h):
        target = task.target.moved_back(-step * np.append(way, np.zeros(3)))
        tasks["target"].append(task.model_copy(update={"target": target}))
        scene = task.scene.model_copy(update={"clearance": CLEARANCE + step})
        tasks["clearance"].append(task.model_copy(update={"scene": scene}))
    for by, rate in (("target", way), ("clearance", np.ones(1))):
        (p0, k0), (p1, k1) = (optimum_next_to(robot, each, found.pressures) for each in tasks[by])
        of_p = found.gradient("pressures", by=by).reshape(len(p0), -1) @ rate
        of_k = found.gradient("stiffness", by=by).ravel() @ rate
        assert np.abs(of_p).max() > 1e5
        np.testing.assert_allclose(of_p, (p1 - p0) / (2 * h), atol=1e-4 * np.abs(of_p).max())
        assert of_k == pytest.approx((k1 - k0) / (2 * h), rel=1e-4)


@pytest.fixture(scope="module")
def two() -> Manipulator:
    return load_robot("stiff-flop-2")


@pytest.fixture(params=["general", "compiled"])
def way(request: pytest.FixtureRequest) -> str:
    if request.param == "compiled":
        request.getfixturevalue("compiled")
    return str(request.param)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_object_is_kept_clear_of(kind: str, compiled: Path) -> None:
    robot = load_robot("stiff-flop-2")
    scene = scene_of({"name": "it", kind: KINDS[kind]})
    free = solve_pressure(robot, task_with(None))
    assert free.pressures is not None
    assert robot.clearance(free.pressures, scene) < CLEARANCE - EXACT  # it is in the way
    found = solve_pressure(robot, task_with(scene))
    assert found.found, found.message
    assert clearance(robot, found.pressures, scene) > CLEARANCE - EXACT
    assert found.clearance == pytest.approx(CLEARANCE, abs=EXACT)
    assert found.nearest_object == "it"
    assert found.stiffness is not None
    assert free.stiffness is not None
    assert 0 < found.stiffness < free.stiffness


PLATE = {"name": "plate", "half_space": {"point": (0.0, 0.0, 0.0), "normal": (0.0, 0.0, 1.0)}}


def test_an_arm_on_a_plate_is_solved_as_without_it(way: str) -> None:
    robot = load_robot("stiff-flop-2")
    free = solve_pressure(robot, task_with(scene_of(POST)))
    found = solve_pressure(robot, task_with(scene_of(PLATE, POST)))
    assert found.found, found.message
    assert found.stiffness == pytest.approx(free.stiffness, rel=1e-6)
    assert found.nearest_object == "post"


def test_an_arm_does_not_reach_behind_its_plate(compiled: Path) -> None:
    robot = load_robot("stiff-flop-2")
    p = robot.pressure_max * [0, 0, 1, 0, 0, 1]
    behind = tuple(robot.tip_pose(p)[:3, 3].tolist())
    assert solve_pressure(robot, task_with(None, behind)).found
    found = solve_pressure(robot, task_with(scene_of(PLATE), behind))
    assert found.status == "unreachable"
    assert "'plate'" in found.message


def test_both_methods_find_the_same(way: str) -> None:
    robot = load_robot("stiff-flop-2")
    scene = scene_of(POST, RIB)
    found = solve_pressure(robot, task_with(scene))
    assert found.found
    assert found.stiffness == pytest.approx(1.39652, rel=1e-4)  # as benchmarks/reference.py finds
    assert clearance(robot, found.pressures, scene) > CLEARANCE - EXACT
    expected = [2.065236, 0.514544, -27.084176]
    np.testing.assert_allclose(found.gradient("stiffness", by="target"), expected, rtol=1e-4)


def test_no_local_solution_is_stiffer(compiled: Path) -> None:
    robot = load_robot("stiff-flop-2")
    rng = np.random.default_rng(4)
    for _ in range(6):
        p = rng.uniform(robot.pressure_min, robot.pressure_max)
        other = rng.uniform(robot.pressure_min, robot.pressure_max)
        position = tuple(robot.tip_pose(p)[:3, 3].tolist())
        obstacle = robot.pose(other, 0.15)[:3, 3] + rng.normal(size=3) * 0.01
        scene = scene_of({"name": "a", "sphere": {"centre": obstacle, "radius": 0.006}}, RIB)
        if robot.clearance(p, scene) < CLEARANCE:
            continue
        solver = PressureSolver(robot, task_with(scene, position))
        found = solver.solve()
        assert found.found
        assert clearance(robot, found.pressures, scene) > CLEARANCE - EXACT
        for start in rng.uniform(robot.pressure_min, robot.pressure_max, (15, 6)):
            local = solver.warm(position, start)
            if local.found:
                assert local.solution is not None
                assert local.solution.stiffness <= found.stiffness * 1.005


def test_rows_have_the_derivatives_of_differences(two: Manipulator) -> None:
    ring = {"name": "ring", "trocar": KINDS["trocar"]}
    tube = {"name": "tube", "inside_tube": KINDS["inside_tube"]}
    problem = PressureProblem(two, task_with(scene_of(POST, RIB, tube, ring)))
    x = np.array([0.35, 0.1, 0.2, 0.7, 0.3, 0.55])
    own, step = problem.program.n_own_rows, 1e-4
    slopes = problem.pose(x).jacobian[own:]
    assert slopes.shape == (3 * 2 + 1, 6)
    for k in range(6):
        aside = step * np.eye(6)[k]
        ahead, behind = (problem.pose(x + sign * aside).residual[own:] for sign in (1, -1))
        np.testing.assert_allclose(slopes[:, k], (ahead - behind) / (2 * step), atol=2e-5)


def test_an_arm_under_a_load(compiled: Path) -> None:
    robot = load_robot("stiff-flop-1").with_load((0.0, 0.02, 0.0))
    target = Target(position=(0.012, None, None), tolerance={"position": 2e-3})
    ball = {"name": "ball", "sphere": {"centre": (0.026, 0.01, 0.075), "radius": 0.006}}
    scene = scene_of(ball)
    task = task_with(scene).model_copy(update={"target": target})
    found = solve_pressure(robot, task)
    assert found.found, found.message
    assert clearance(robot, found.pressures, scene) > CLEARANCE - EXACT
    problem = PressureProblem(robot, task)  # the same in the VM
    rows = problem.pose(found.pressures / problem.unit).residual[problem.program.n_own_rows :]
    distance = robot.clearance(found.pressures, scene)
    assert max(rows) - 1e-3 == pytest.approx(CLEARANCE - distance, abs=1e-5)
    check_derivatives(robot, task)


def test_what_is_in_the_way_is_told(compiled: Path) -> None:
    robot = load_robot("stiff-flop-2")
    wall = {"name": "wall", "half_space": {"point": (-0.03, 0, 0), "normal": (1, 0, 0)}}
    found = solve_pressure(robot, task_with(scene_of(POST, wall)))
    assert found.status == "unreachable"
    assert found.position_error == pytest.approx(0.017, abs=2e-4)
    assert found.clearance == pytest.approx(CLEARANCE, abs=EXACT)
    assert "17 mm away; held back by 'wall'" in found.message
    assert "without its scene the task is solved" in found.message
    assert "mm too near 'wall'" in found.message


def test_a_scene_that_leaves_no_way(compiled: Path) -> None:
    robot = load_robot("stiff-flop-2")
    points = [(0, 0, 0), (0, 0, 0.09), (-0.08, 0, 0.1)]  # round a corner
    lumen = {"name": "lumen", "inside_tube": {"points": points, "radius": 0.018}}
    found = solve_pressure(robot, task_with(scene_of(lumen)))
    assert found.status == "unreachable"
    assert "no configuration was found whose body keeps the clearance" in found.message
    assert "mm too far out of 'lumen'" in found.message
    assert found.clearance is not None
    assert found.clearance < CLEARANCE


def test_a_way_through_a_narrow_tube_is_found(compiled: Path) -> None:
    """Out of reach of its target, and not one of the samples is clear of it."""
    robot = load_robot("stiff-flop-2")
    shape = robot.backbone([125e3, 96e3, 142e3, 51e3, 150e3, 130e3], 14)[:, :3, 3]
    points = [(0, 0, -0.02), *shape.tolist()]
    lumen = {"name": "lumen", "inside_tube": {"points": points, "radius": 0.02}}
    found = solve_pressure(robot, task_with(scene_of(lumen), (0.2, 0.2, 0.3)))
    assert "held back by 'lumen'" in found.message
    assert found.clearance == pytest.approx(CLEARANCE, abs=EXACT)


@pytest.fixture
def no_general_method(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have what takes seconds among obstacles fail."""

    def refuse(*_: object) -> None:
        raise AssertionError("the general method was called")

    monkeypatch.setattr(GeneralSearch, "solve", refuse)


@pytest.mark.usefixtures("compiled", "no_general_method")
def test_a_stiffness_that_cannot_be_had_is_told_by_compiled_code() -> None:
    robot = load_robot("stiff-flop-2")
    task = task_with(scene_of(POST))
    best = solve_pressure(robot, task).stiffness
    assert best is not None
    floor = {"direction": (1, 0, 0), "value": 1.5 * best}
    goal = StiffnessGoal(maximise=[{"direction": (0, 1, 0)}], at_least=[floor])
    found = solve_pressure(robot, task.model_copy(update={"stiffness": goal}))
    assert found.status == "unreachable"
    assert "not this stiffness there" in found.message
    assert found.stiffnesses[1] == pytest.approx(best, rel=1e-3)
    assert clearance(robot, found.pressures, task.scene) > CLEARANCE - EXACT


@pytest.mark.usefixtures("compiled", "no_general_method")
def test_an_arm_boxed_in_comes_clear_though_no_sample_is() -> None:
    robot = load_robot("stiff-flop-2")
    p = np.array([0.2, 1.1, 0.4, 0.9, 0.1, 0.3]) * 1e5
    points = robot.backbone(p, 8)[:, :3, 3].tolist()
    lumen = {"name": "lumen", "inside_tube": {"points": points, "radius": 0.0215}}
    scene = scene_of(lumen)
    assert robot.clearance(p, scene) > CLEARANCE
    found = solve_pressure(robot, task_with(scene, (0.05, -0.03, 0.18)))
    assert found.status == "unreachable"
    assert "the closest configuration is 42.4" in found.message
    assert "held back by 'lumen'" in found.message
    assert found.clearance == pytest.approx(CLEARANCE, abs=EXACT)


def test_a_coarse_mesh_says_so(compiled: Path, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("igl")
    trimesh.creation.box((0.06, 0.06, 0.02)).export(tmp_path / "wall.stl")
    robot = load_robot("stiff-flop-2")

    def solved(resolution: float) -> PressureSolution:
        mesh = {"file": str(tmp_path / "wall.stl"), "scale": 1.0, "resolution": resolution,
                "centre": (-0.03, 0.0, 0.24)}  # fmt: skip
        task = task_with(scene_of({"name": "wall", "mesh": mesh}), (-0.03, 0.01, 0.22))
        return solve_pressure(robot, task)

    coarse, fine = solved(8e-3), solved(3e-3)
    assert coarse.status == "unreachable"
    assert coarse.nearest_object == "wall"
    assert coarse.mesh_error == pytest.approx(6.511e-3, abs=1e-6)
    assert (
        "distances from 'wall' are up to 6.5 mm too small: a finer 'resolution'" in coarse.message
    )
    assert fine.mesh_error is None
    assert "resolution" not in fine.message
    assert fine.position_error < coarse.position_error


def test_a_cloud_of_points(compiled: Path) -> None:
    """As many objects as there may be: more rows than fit on a stack as square matrices."""
    robot = load_robot("stiff-flop-2")
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, 900), rng.uniform(0.03, 0.2, 900)
    centres = np.stack([0.0205 * np.cos(angle), 0.0205 * np.sin(angle), height], 1)
    cloud = [
        {"name": f"point {k}", "sphere": {"centre": centre, "radius": 0.0005}}
        for k, centre in enumerate(centres)
    ]
    target = Target(position=(0.0, 0.0, 0.184), tolerance={"position": 1e-3})
    task = task_with(Scene(clearance=1e-3, objects=cloud)).model_copy(update={"target": target})
    found = solve_pressure(robot, task)
    assert found.found
    x = robot.backbone(found.pressures, 500)[:, :3, 3]
    nearest = np.linalg.norm(x[:, None] - centres, axis=2).min()
    assert nearest - 0.0005 - 0.015 > 1e-3 - EXACT


def test_a_scene_is_data(compiled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Adding or moving an object makes no code."""
    robot = load_robot("stiff-flop-2")
    first = solve_pressure(robot, task_with(scene_of(POST)))

    def refuse(*_: object) -> None:
        raise AssertionError("something was compiled")

    monkeypatch.setattr(code, "_make", refuse)
    for x in (0.0, 0.01):
        moved = {"name": "post", "sphere": {"centre": (x, -0.03, 0.13), "radius": 0.008}}
        table = {"name": "table", "half_space": {"point": (0, 0, 0.26), "normal": (0, 0, -1)}}
        found = solve_pressure(load_robot("stiff-flop-2"), task_with(scene_of(moved, RIB, table)))
        assert found.found
        assert not np.allclose(found.pressures, first.pressures)


def test_calls_of_planners_and_processes(compiled: Path) -> None:
    robot = load_robot("stiff-flop-2")
    scene = scene_of(POST, RIB)
    solver = PressureSolver(robot, task_with(scene))
    found = solver.solve()
    assert solver.reachable()
    near = solver.warm((-0.0295, 0.01, 0.19), found.pressures)
    assert near.found
    assert clearance(robot, near.pressures, scene) > CLEARANCE - EXACT
    again = pickle.loads(pickle.dumps(found))
    assert again.clearance == pytest.approx(found.clearance)
    tasks = [task_with(scene), task_with(None), task_with(scene_of(RIB), (-0.028, 0.01, 0.19))]
    for task, each in zip(tasks, solve_batch(robot, tasks), strict=True):
        alone = solve_pressure(robot, task)
        np.testing.assert_allclose(each.pressures, alone.pressures, atol=1.0)


def test_prices_and_derivatives(compiled: Path) -> None:
    robot = load_robot("stiff-flop-2")
    scene = scene_of(POST)
    found = solve_pressure(robot, task_with(scene))
    assert found.sensitivities is not None
    price = found.sensitivities.per_clearance["post"]
    less = scene.model_copy(update={"clearance": CLEARANCE - 1e-4})
    other = solve_pressure(robot, task_with(less))
    assert other.stiffness - found.stiffness == pytest.approx(price * 1e-4, rel=0.05)
    assert found.gradient("stiffness", by="clearance") == pytest.approx(-price, rel=0.01)
    far = scene_of({"name": "post", "sphere": {"centre": (0.1, 0, 0.1), "radius": 0.01}})
    free = solve_pressure(robot, task_with(far))
    plain = solve_pressure(robot, task_with(None))
    np.testing.assert_allclose(
        free.gradient("stiffness", by="target"), plain.gradient("stiffness", by="target"), rtol=1e-3
    )


def mesh_of_a_ball(folder: Path, centre: tuple[float, float, float]) -> dict[str, Any]:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.icosphere(2, 0.008).export(folder / "ball.stl")
    return {"file": folder / "ball.stl", "scale": 1.0, "centre": centre, "resolution": 0.002}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", ["sphere", "box", "half_space", "inside_tube", "mesh"])
def test_derivatives_of_an_answer_that_an_object_holds_back(
    kind: str, compiled: Path, tmp_path: Path
) -> None:
    at = (0.0063, -0.0125, 0.1291)
    shape = mesh_of_a_ball(tmp_path, at) if kind == "mesh" else KINDS[kind]
    check_derivatives(load_robot("stiff-flop-2"), task_with(scene_of({"name": "it", kind: shape})))


def test_derivatives_of_an_answer_that_two_objects_hold_back(compiled: Path) -> None:
    check_derivatives(load_robot("stiff-flop-2"), task_with(scene_of(POST, RIB)))


def test_descents_next_to_a_joint_of_segments_converge(compiled: Path) -> None:
    """None of 64 did while steps saw an object by a few stations of the body."""
    centre = (0.02550724, -0.01340549, 0.11061152)
    scene = scene_of({"name": "post", "sphere": {"centre": centre, "radius": 0.006}})
    task = task_with(scene).model_copy(
        update={"target": Target(position=(0.1187035, -1.673e-5, 0.1548174))}
    )
    robot = load_robot("stiff-flop-2")
    at_once = PressureSolver(robot, task).solve_at_once()
    assert at_once is not None
    assert at_once.clearance >= task.scene.clearance - 1e-5
    assert at_once.confidence.reached > 0


def test_descents_in_a_bent_tube_are_as_short_as_without_it(compiled: Path) -> None:
    """The body leans on the joints of the tube's pieces: its least distances have kinks there."""
    points = [(0, 0, 0), (0, 0, 0.09), (-0.006, -0.003, 0.14), (-0.03, 0.01, 0.2)]
    tube = {"name": "tube", "inside_tube": {"points": points, "radius": 0.021}}
    robot, position = load_robot("stiff-flop-2"), (-0.03, 0.01, 0.195)
    free = solve_pressure(robot, task_with(None, position))
    within = solve_pressure(robot, task_with(scene_of(tube), position))
    assert within.found
    assert within.stiffness < 0.997 * free.stiffness
    assert within.confidence.complete
    assert within.counts["iterations"] <= free.counts["iterations"]


def test_no_derivatives_where_a_distance_has_an_edge(compiled: Path) -> None:
    robot = load_robot("stiff-flop-2")
    found = solve_pressure(robot, task_with(scene_of(RIB)))
    p, _ = optimum_next_to(robot, found.task, found.pressures)
    nearest = robot.clearances(p, found.task.scene).positions[0]
    end = (-0.024, nearest[1], 0.11)  # from there on the rib is round: the same, but for curvature
    short = {"name": "rib", "capsule": {**RIB["capsule"], "to": end}}
    found = solve_pressure(robot, task_with(scene_of(short)), guess=p)
    with pytest.raises(DerivativeError, match="the clearance of rib has an edge at the answer"):
        found.gradient("pressures", by="target")
    free = solve_pressure(robot, task_with(None))
    with pytest.raises(InputError, match="only a task with a scene has a clearance"):
        free.gradient("stiffness", by="clearance")


def test_scenes_that_make_no_sense_for_the_arm(two: Manipulator, tmp_path: Path) -> None:
    inside = scene_of({"name": "rock", "sphere": {"centre": (0, 0, 0), "radius": 0.02}})
    with pytest.raises(InputError, match="rock: the arm's base"):
        PressureSolver(two, task_with(inside))
    text = (PROBLEMS / "two_segment_past_a_rib.yaml").read_text()
    path = tmp_path / "task.yaml"
    path.write_text(text.replace("radius: 20 mm", "radius: 12 mm"))
    with pytest.raises(FileError, match=r"task.yaml:12: scene.objects.0..*port: 12 mm") as caught:
        PressureSolver(two, load_task(path))
    assert caught.value.line is not None
