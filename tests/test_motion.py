"""Motions: the body stays clear all the way, within the rates; what is in the way is told.

Distances are measured once more, with formulas in NumPy on many stations of the body.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt import (
    InputError,
    Load,
    Manipulator,
    MissingExtraError,
    PathSolution,
    Scene,
    StiffnessGoal,
    Target,
    Task,
    load_robot,
    plan_motion,
)
from stiffopt.cli.main import main
from stiffopt.model.compiled import compiling_at_once
from stiffopt.model.motion_clearance import MOTION_ERROR, ClearMotions
from stiffopt.paths.motion import timed
from stiffopt.paths.shortening import rounded, shortened
from test_obstacles import KINDS, distances, scene_of

Array = NDArray[np.float64]

needs_ompl = pytest.mark.skipif(
    find_spec("ompl") is None, reason="OMPL is not installed: pip install 'stiffopt[plan]'"
)

ASKED = 2e-3
EXACT = 5e-5  # m, by which a motion may be nearer than it may be
LEFT = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 0.0]) * 1e5
RIGHT = np.array([0.0, 1.0, 0.0, 0.0, 1.0, 0.0]) * 1e5


@pytest.fixture(scope="module")
def two() -> Manipulator:
    return load_robot("stiff-flop-2")


def post_between(robot: Manipulator) -> dict[str, Any]:
    """A ball where the tip is half of the straight way from left to right."""
    centre = robot.tip_pose((LEFT + RIGHT) / 2)[:3, 3]
    return {"name": "post", "sphere": {"centre": tuple(centre.tolist()), "radius": 0.008}}


def clearance(robot: Manipulator, p: Array, scene: Scene) -> float:
    """The least distance of the body, for arms of one outer radius, at pressures (N, n)."""
    x = robot.backbone(p, 150)[:, :, :3, 3].reshape(-1, 3)
    least = []
    for item in scene.model_dump(by_alias=True)["objects"]:
        (kind,) = (key for key in KINDS if item.get(key) is not None)
        least.append(distances(kind, item[kind], x).min())
    return float(min(least) - robot.description.segments[0].outer_radius)


def cluttered(robot: Manipulator, rng: np.random.Generator) -> tuple[Scene, Array, Array]:
    """Eight objects within reach, and two configurations that are clear of them."""
    low, high = robot.pressure_min, robot.pressure_max
    while True:
        objects: list[dict[str, Any]] = []
        while len(objects) < 8:
            p = low + (high - low) * rng.random(len(low))
            x = robot.pose(p, robot.length * rng.uniform(0.4, 1))[:3, 3] + 0.02 * rng.normal(size=3)
            aside = 0.03 * rng.normal(size=3) / 2
            shapes: dict[str, dict[str, Any]] = {
                "sphere": {"centre": x, "radius": rng.uniform(0.005, 0.015)},
                "capsule": {"from": x - aside, "to": x + aside, "radius": rng.uniform(0.003, 8e-3)},
                "box": {"centre": x, "size": rng.uniform(0.01, 0.03, 3)},
            }
            kind = str(rng.choice(list(shapes)))
            if distances(kind, shapes[kind], np.zeros((1, 3)))[0] > 0.03:
                objects.append({"name": f"{kind} {len(objects)}", kind: shapes[kind]})
        scene = scene_of(*objects)
        p = low + (high - low) * rng.random((100, len(low)))
        p = p[robot.clearance(p, scene) > ASKED]
        if len(p) > 1:
            return scene, p[0], p[1]


def check(motion: PathSolution, scene: Scene, asked: float = ASKED) -> None:
    """Clear at twenty points of each step, within the rates, and judged by the model."""
    assert motion.found
    robot, p = motion.robot, motion.pressures
    assert motion.slew is not None
    steps = np.diff(motion.times)
    assert (steps >= 1e-3).all()
    assert (np.abs(np.diff(p, axis=0)) <= steps[:, None] * motion.slew * (1 + 1e-9)).all()
    assert (p >= robot.pressure_min).all()
    assert (p <= robot.pressure_max).all()
    shares = np.linspace(0, 1, 20, endpoint=False)[:, None]
    dense = np.concatenate([*(a + shares * (b - a) for a, b in pairwise(p)), p[-1:]])
    assert clearance(robot, dense, scene) > asked - EXACT
    assert motion.clearance is not None
    np.testing.assert_allclose(motion.clearance, robot.clearance(p, scene), atol=1e-9)
    np.testing.assert_allclose(motion.tip_poses, robot.tip_pose(p), atol=1e-9)


# -- the judge of motions -------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["stiff-flop-2", pytest.param("stiff-flop-3", marks=pytest.mark.long)]
)
def test_no_motion_is_clear_that_touches_something(name: str, compiled: Path) -> None:
    robot, rng = load_robot(name), np.random.default_rng(2)
    robot._body.machine_code(10_000)
    verdicts = []
    for _ in range(4):
        scene, start, _ = cluttered(robot, rng)
        motions = ClearMotions(robot, scene)
        for _ in range(12):
            end = robot.pressure_min + (robot.pressure_max - robot.pressure_min) * rng.random(
                robot.n_pressures
            )
            found = motions.along(np.stack([start, end]), ASKED)
            dense = start + np.linspace(0, 1, 200)[:, None] * (end - start)
            least = robot.clearance(dense, scene).min()
            assert found.clear == (least > ASKED - MOTION_ERROR)
            verdicts.append(found.clear)
            if found.clear:
                assert found.least > ASKED - MOTION_ERROR
            else:
                assert found.blocked_at is not None
                assert robot.clearance(found.blocked_at, scene) < ASKED
    assert 0.1 < np.mean(verdicts) < 0.9


def test_both_ways_judge_alike(two: Manipulator, compiled: Path) -> None:
    rng = np.random.default_rng(3)
    two._body.machine_code(10_000)
    scene, start, end = cluttered(two, rng)
    ends = [end, *(two.pressure_max * rng.random((5, 6)))]
    motions = ClearMotions(two, scene)
    for each in ends:
        rows = np.stack([start, each])
        slowly = motions._interpreted(rows, ASKED - 2e-5)
        assert motions.along(rows, ASKED).clear == slowly.clear


def test_the_bounds_hold(two: Manipulator) -> None:
    motions = ClearMotions(two, scene_of(post_between(two)))
    ranges, speeds, bends = motions.bounds
    rng = np.random.default_rng(4)
    for _ in range(40):
        a, b = two.pressure_max * rng.random((2, 6))
        change = np.linalg.norm((b - a).reshape(2, 3), axis=1)
        for part, (start, end) in enumerate(ranges.bounds):
            at = np.linspace(start, end, 8)
            x = two._body.poses(a + np.linspace(0, 1, 21)[:, None] * (b - a), at)[:, :, :3, 3]
            way = speeds[part] @ change
            speed = np.linalg.norm(np.diff(x, axis=0), axis=-1).max() * 20
            second = np.linalg.norm(np.diff(x, 2, axis=0), axis=-1).max() * 400
            assert speed < way
            assert second < way**2 / bends[part]


def test_a_tip_that_leaves_a_ring_is_noticed(two: Manipulator, compiled: Path) -> None:
    """It is through the ring at both ends of the motion, and not in between."""
    long, short = np.full(6, 1.2e5), np.zeros(6)
    height = (two.tip_pose(long)[2, 3] + two.tip_pose(short)[2, 3]) / 2
    ring = {"name": "port", "trocar": {"centre": (0, 0, height), "axis": (0, 0, 1), "radius": 0.03}}
    motions = ClearMotions(two, scene_of(ring))
    assert motions.along(np.stack([long, long * 0.95]), ASKED).clear
    assert not motions.along(np.stack([long, short, long]), ASKED).clear
    found = motions._interpreted(np.stack([long, short]), ASKED)
    assert not found.clear


# -- ways -----------------------------------------------------------------------------------


def test_the_straight_way_where_nothing_is_in_it(two: Manipulator) -> None:
    motion = plan_motion(two, LEFT, RIGHT)
    assert motion.found
    assert motion.clearance is None
    np.testing.assert_array_equal(motion.pressures[[0, -1]], [LEFT, RIGHT])
    shares = np.linspace(0, 1, len(motion.times))[:, None]
    np.testing.assert_allclose(motion.pressures, LEFT + shares * (RIGHT - LEFT), atol=1e-6)
    assert motion.times[-1] == pytest.approx(0.2)  # 1 bar at 5 bar/s
    slow = plan_motion(two, LEFT, RIGHT, slew=[1e5, 1e5, 1e5, 1e4, 1e6, 1e6])
    assert slow.times[-1] == pytest.approx(10.0)
    np.testing.assert_array_equal(slow.slew, [1e5, 1e5, 1e5, 1e4, 5e5, 5e5])
    still = plan_motion(two, LEFT, LEFT)
    assert still.found
    assert len(still.times) == 1


@needs_ompl
def test_around_a_post(two: Manipulator, compiled: Path) -> None:
    two._body.machine_code(10_000)
    scene = scene_of(post_between(two))
    motion = plan_motion(two, LEFT, RIGHT, scene=scene, seed=1)
    check(motion, scene)
    assert "RRTConnect" in motion.confidence
    assert "not calibrated" in motion.message
    again = plan_motion(two, LEFT, RIGHT, scene=scene, seed=1)
    np.testing.assert_array_equal(again.pressures, motion.pressures)
    wide = plan_motion(two, LEFT, RIGHT, scene=scene, clearance=6e-3)
    check(wide, scene, 6e-3)
    turns = np.diff(motion.pressures, axis=0)
    turns /= np.linalg.norm(turns, axis=1)[:, None]
    assert (np.sum(turns[1:] * turns[:-1], axis=1) > 0.5).all()  # no sharp corners are left


@needs_ompl
def test_cluttered_scenes(compiled: Path) -> None:
    rng, around = np.random.default_rng(5), 0
    for name in ("stiff-flop-2", "stiff-flop-3"):
        robot = load_robot(name)
        robot._body.machine_code(10_000)
        for _ in range(3):
            scene, start, end = cluttered(robot, rng)
            motion = plan_motion(robot, start, end, scene=scene)
            check(motion, scene)
            around += "RRTConnect" in motion.confidence
    assert around


@needs_ompl
def test_an_arm_under_gravity(compiled: Path) -> None:
    robot = load_robot("stiff-flop-2-hanging")
    robot._body.machine_code(10_000)
    scene = scene_of(post_between(robot))
    check(plan_motion(robot, LEFT, RIGHT, scene=scene), scene)


@needs_ompl
def test_without_machine_code(two: Manipulator) -> None:
    robot = load_robot("stiff-flop-1")
    left, right = LEFT[:3], RIGHT[:3]
    centre = tuple(robot.tip_pose((left + right) / 2)[:3, 3].tolist())
    scene = scene_of({"name": "post", "sphere": {"centre": centre, "radius": 0.004}})
    motion = plan_motion(robot, left, right, scene=scene, timeout=60)
    check(motion, scene)


def test_ompl_is_needed_for_ways_that_are_not_straight(
    two: Manipulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ompl", None)
    scene = scene_of(post_between(two))
    assert plan_motion(two, LEFT, 0.9 * LEFT, scene=scene).found
    with pytest.raises(MissingExtraError, match=r"stiffopt\[plan\]"):
        plan_motion(two, LEFT, RIGHT, scene=scene)


# -- goals ----------------------------------------------------------------------------------


def task_at(robot: Manipulator, p: Any, **options: Any) -> Task:
    position = tuple(robot.tip_pose(p)[:3, 3].tolist())
    goal = StiffnessGoal(maximise={"direction": (1, 0, 0)})
    return Task(target=Target(position=position), stiffness=goal, **options)


@needs_ompl
def test_a_task_as_start_and_goal(two: Manipulator, compiled: Path) -> None:
    two._body.machine_code(10_000)
    scene = scene_of(post_between(two))
    goal = task_at(two, RIGHT, scene=scene)
    with compiling_at_once():
        motion = plan_motion(two, task_at(two, LEFT), goal, timeout=None)
    check(motion, scene)
    off = motion.tip_poses[-1, :3, 3] - np.array(goal.target.position)
    assert np.linalg.norm(off) < goal.target.tolerance.position + 1e-9
    assert motion.stiffness is not None
    assert motion.stiffness_unit == "N/m"
    np.testing.assert_allclose(
        motion.stiffness, two.stiffness(motion.pressures, [1, 0, 0]), rtol=1e-9
    )


@needs_ompl
def test_a_way_that_ends_in_another_configuration_than_the_stiffest(compiled: Path) -> None:
    robot = load_robot("stiff-flop-2")
    robot._body.machine_code(10_000)
    scene, start, end = cluttered(robot, np.random.default_rng(12))
    with compiling_at_once():
        motion = plan_motion(robot, start, task_at(robot, end), scene=scene, timeout=None)
    check(motion, scene)
    assert "to one of 3 goal configurations" in motion.confidence


def test_of_several_goals_one_that_is_clear(two: Manipulator) -> None:
    scene = scene_of(post_between(two))
    blocked = (LEFT + RIGHT) / 2
    motion = plan_motion(two, LEFT, [blocked, 0.8 * LEFT], scene=scene)
    assert motion.found
    np.testing.assert_array_equal(motion.pressures[-1], 0.8 * LEFT)
    assert motion.message.startswith("to goal 2 of 2; the body is at least")
    same = plan_motion(two, LEFT, np.stack([blocked, 0.8 * LEFT]), scene=scene)
    np.testing.assert_array_equal(same.pressures, motion.pressures)


def test_what_is_in_the_way_is_told(two: Manipulator) -> None:
    scene = scene_of(post_between(two))
    blocked = (LEFT + RIGHT) / 2
    motion = plan_motion(two, blocked, LEFT, scene=scene)
    assert motion.status == "unreachable"
    assert motion.pressures.shape == (0, 6)
    assert motion.message.startswith("start: the body is")
    assert "mm too near 'post', where 2 mm of clearance are required" in motion.message
    motion = plan_motion(two, LEFT, blocked, scene=scene)
    assert motion.message.startswith("goal: the body is")
    near = scene_of({"name": "wall", "half_space": {"point": (0, 0, 0.2), "normal": (0, 0, -1)}})
    motion = plan_motion(two, np.zeros(6), LEFT, scene=near, clearance=7e-3)
    assert motion.message.startswith("at rest: the body is")
    far = Task(target=Target(position=(0, 0, 1)))
    motion = plan_motion(two, LEFT, far)
    assert motion.status == "unreachable"
    assert motion.message.startswith("goal: unreachable")


@needs_ompl
def test_no_way(two: Manipulator, compiled: Path) -> None:
    """The arm would have to go through a wall with its tip on one side and the other."""
    two._body.machine_code(10_000)
    wall = {"name": "wall", "box": {"centre": (0, 0, 0.2), "size": (0.002, 0.6, 0.29)}}
    a, b = np.array([1.4, 0, 0, 1.4, 0, 0]) * 1e5, np.array([0, 1.4, 0, 0, 1.4, 0]) * 1e5
    scene = scene_of(wall)
    if min(two.clearance(a, scene), two.clearance(b, scene)) > ASKED:
        motion = plan_motion(two, a, b, scene=scene, timeout=0.3)
        assert motion.status == "unreachable"
        assert "no clear way was found" in motion.message


def test_a_motion_that_nobody_wants_any_more(two: Manipulator) -> None:
    motion = plan_motion(two, task_at(two, LEFT), RIGHT, cancel=lambda: True)
    assert motion.status == "failed"
    assert "cancelled" in motion.message


def test_the_margin_of_a_calibrated_robot() -> None:
    """It is the uncertainty along the way, which grows with the distance to what was recorded."""
    robot = load_robot("ucl-2x55-calibrated")
    low, high = np.zeros(6), np.full(6, 0.05e5)
    table = {"name": "table", "half_space": {"point": (0, 0, 0.2), "normal": (0, 0, -1)}}
    motion = plan_motion(robot, low, high, scene=scene_of(table), slew=1e5)
    assert motion.found, motion.message
    largest = max(robot.tip_uncertainty(p).semi_axes[0] for p in motion.pressures)
    kept = re.search(
        r"([\d.]+) mm of it are kept for the uncertainty of the calibration", motion.message
    )
    assert kept
    assert largest <= 1e-3 * float(kept[1]) * 1.005 < 1.1 * largest
    near = {"name": "near", "half_space": {"point": (0, 0, 0.13), "normal": (0, 0, -1)}}
    refused = plan_motion(robot, low, high, scene=scene_of(near), slew=1e5)
    assert refused.status == "unreachable"
    assert "of them for the uncertainty of the calibration" in refused.message


# -- shorter, rounder, timed ----------------------------------------------------------------


def test_shortening_keeps_what_is_clear() -> None:
    """In the plane, around a square."""

    def is_clear(rows: Array) -> bool:
        points = np.concatenate([np.linspace(a, b, 200) for a, b in pairwise(rows)])
        return not (np.abs(points) < 1).all(axis=1).any()

    way = np.array([[-2.0, 0], [-3, 3], [-1, 4], [0, 2.5], [3, 4], [2, 0]])
    scale = np.ones(2)
    short = shortened(way, is_clear, scale, 0)
    assert is_clear(short)
    lengths = [np.linalg.norm(np.diff(each, axis=0), axis=1).sum() for each in (way, short)]
    assert lengths[1] < 0.6 * lengths[0]
    bow = rounded(short, is_clear, scale)
    assert is_clear(bow)
    np.testing.assert_array_equal(bow[[0, -1]], way[[0, -1]])
    assert len(bow) > len(short)


def test_times_are_the_least() -> None:
    p, times = timed(np.array([[0.0, 0], [1e5, 0], [1e5, 1e5]]), np.array([1e5, 5e4]))
    assert times[-1] == pytest.approx(3.0)
    assert [1e5, 0] in p.tolist()
    assert len(p) >= 50


# -- bad input ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"start": LEFT[:3]}, "the start's pressures must be 6"),
        ({"goal": 2 * LEFT}, r"goal: segment 1 channel 1 is at 2 bar, outside of its limits"),
        ({"goal": []}, "empty"),
        ({"slew": 0}, "slew must be one rate above 0"),
        ({"clearance": -1.0}, "clearance must be"),
        ({"scene": {"objects": []}}, "scene must be a Scene"),
        ({"timeout": -1}, "timeout must be"),
        ({"cancel": 3}, "cancel must be"),
        ({"load": 3}, "load must be a Load"),
    ],
)
def test_bad_arguments(two: Manipulator, changes: dict[str, Any], text: str) -> None:
    given: dict[str, Any] = {"start": LEFT, "goal": RIGHT, "scene": scene_of(post_between(two))}
    given |= changes
    with pytest.raises(InputError, match=text):
        plan_motion(two, given.pop("start"), given.pop("goal"), **given)


def test_what_does_not_fit_together(two: Manipulator) -> None:
    with pytest.raises(InputError, match="a clearance needs a scene"):
        plan_motion(two, LEFT, RIGHT, clearance=1e-3)
    load = Load(force=(0, 0, -0.02))
    with pytest.raises(InputError, match="must have the same load"):
        plan_motion(two, task_at(two, LEFT), task_at(two, RIGHT, load=load))
    silent = two.description.pressure.model_copy(update={"slew": None})
    slow = Manipulator(two.description.model_copy(update={"pressure": silent}))
    with pytest.raises(InputError, match="give slew"):
        plan_motion(slow, LEFT, RIGHT)


# -- the command ----------------------------------------------------------------------------

A, B = "1, 0, 0, 1, 0, 0 bar", "0 bar, 1 bar, 0 bar, 0 bar, 100 kPa, 0 bar"
SCENE = """\
format: stiffopt-scene/1
clearance: 2 mm
objects: [{name: table, half_space: {point: [0 mm, 0 mm, %s mm], normal: [0, 0, -1]}}]
"""


def planned(*arguments: str) -> int:
    return main(["plan", "--from", A, "--to", B, *arguments])


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = ("--robot", "stiff-flop-2")
    files = [str(tmp_path / name) for name in ("motion.csv", "motion.yaml", "motion.png")]
    scene = tmp_path / "scene.yaml"
    scene.write_text(SCENE % "300")
    given = (*robot, "--scene", str(scene), "--slew", "2 bar/s")
    out = ("--out", files[0], "--out", files[1], "--plot", files[2])
    assert planned(*given, "--json", *out) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["status"] == "solved"
    assert record["pressures_pa"][-1] == RIGHT.tolist()
    assert record["times_s"][-1] == pytest.approx(0.5)
    assert min(record["clearance_m"]) > ASKED
    assert all(Path(file).stat().st_size for file in files)
    assert planned(*given, "--clearance", "3 mm") == 0
    assert "required: at least 3 mm" in capsys.readouterr().out
    scene.write_text(SCENE % "70")
    assert planned(*given) == 3
    assert "too near 'table'" in " ".join(capsys.readouterr().out.split())


def test_each_goal_has_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert planned("--robot", "stiff-flop-2", "--to", A) == 0
    said = capsys.readouterr().out
    assert "not checked: neither --scene nor a task gives a scene" in said
    lines = [line.split() for line in said.splitlines()]
    assert ["to", *B.split()] in lines
    assert lines.count(A.split()) == 1


@needs_ompl
def test_the_program_ends_without_a_word_of_ompl() -> None:
    code = """
import numpy as np
from stiffopt.cli.main import main
from stiffopt.paths.tree_search import TreeSearch
zero, one = np.zeros(1), np.ones(1)
TreeSearch(lambda _: True, zero, one, one, 0).way(zero, one[None], 9)
main()
"""
    ended = subprocess.run(
        [sys.executable, "-c", code, "--version"], capture_output=True, text=True, timeout=60
    )
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((), "--robot: name a robot"),
        (("--robot", "stiff-flop-2", "--to", "2 bar"), "--to: expected one pressure for each"),
        (("--robot", "stiff-flop-2", "--to", "0, 0 mm"), "--to: "),
        (("--robot", "stiff-flop-2", "--to", "9, 0, 0, 0, 0, 0 bar"), "--to: segment 1 channel 1"),
        (("--robot", "stiff-flop-2", "--slew", "2 bar"), "--slew: "),
        (("--robot", "stiff-flop-2", "--slew", "0 bar/s"), "--slew: must be greater than 0"),
        (("--robot", "stiff-flop-2", "--slew", "2, 1 bar/s"), "--slew: expected one rate"),
        (("--robot", "stiff-flop-2", "--clearance", "2 mm"), "a clearance needs a scene"),
        (("--robot", "stiff-flop-2", "--clearance", "-1 mm"), "--clearance: must be at least 0"),
        (("--robot", "stiff-flop-2", "--to", "missing.yaml"), "missing.yaml"),
        (("--robot", "stiff-flop-2", "--timeout", "-1 s"), "timeout must be"),
    ],
)
def test_bad_options(
    arguments: tuple[str, ...], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert planned(*arguments) == 2
    assert text in capsys.readouterr().err
