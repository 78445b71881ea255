"""Paths against references that share nothing with `solve_path`."""

import sys
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import NDArray

from conftest import is_long
from stiffopt import Manipulator, load_robot
from stiffopt.paths.path import Path
from stiffopt.paths.solver import solve_path

sys.path.insert(0, str(FilePath(__file__).parents[1] / "benchmarks"))

import path_reference as reference

Vector = NDArray[np.float64]

SLEW = 0.5e5  # Pa/s, which holds the arm back
SPEED = 0.01  # m/s
SHARE = 0.99


def path_of(robot: Manipulator, points: int, slew: float) -> Path:
    """A bent line through tips of the arm, with a direction that turns with it."""
    rng = np.random.default_rng(7)
    tips = robot.tip_pose(rng.uniform(0.2e5, 1.1e5, (3, robot.n_pressures)))[:, :3, 3]
    return Path(
        path={"spline": [tuple(row) for row in tips.tolist()]},
        points=points,
        timing={"speed": SPEED},
        tolerance={"position": 1e-4},
        stiffness={"maximise": {"direction": (1, 0, 0), "frame": "path"}},
        pressure={"slew": slew},
    )


def question(path: Path, n: int) -> reference.Question:
    points = path.points()
    assert points.times is not None
    return reference.Question(
        positions=points.positions,
        directions=np.array([goal.maximise[0].direction for goal in points.goals if goal]),
        steps=np.outer(np.diff(points.times), np.full(n, path.pressure.slew)) / reference.BAR,
        tolerance=path.tolerance.position,
        over="worst",
    )


def test_two_segments_against_a_lattice_of_the_null_space(compiled: FilePath) -> None:
    robot = load_robot("stiff-flop-2")
    path = path_of(robot, 24, SLEW)
    asked, program = question(path, 6), reference.PathProgram(robot, 24)
    best = reference.lattice(robot, program, asked, 500, seed=0)
    assert best is not None
    assert program.holds(asked, best)
    solution = solve_path(robot, path)
    assert solution.found, solution.message
    found = program.value(asked, solution.pressures / reference.BAR)
    assert found > program.value(asked, best) + np.log(SHARE)


def test_where_rates_bind_all_along_nothing_is_left_to_gain(compiled: FilePath) -> None:
    robot = load_robot("stiff-flop-2")
    path = path_of(robot, 24, SLEW / 10)
    asked, program = question(path, 6), reference.PathProgram(robot, 24)
    solution = solve_path(robot, path)
    assert solution.found, solution.message
    pressures = solution.pressures / reference.BAR
    better = program.improved(asked, pressures)
    assert better is not None
    assert program.value(asked, pressures) > program.value(asked, better) + np.log(SHARE)


def test_three_segments_against_refined_random_starts(compiled: FilePath) -> None:
    robot = load_robot("stiff-flop-3")
    path = path_of(robot, 12, SLEW)
    asked, program = question(path, 9), reference.PathProgram(robot, 12)
    starts = reference.followed(robot, asked, 2 if is_long() else 1, seed=0)
    refined = [program.improved(asked, start, 60) for start in starts]
    values = [program.value(asked, each) for each in refined if each is not None]
    assert values
    solution = solve_path(robot, path)
    assert solution.found, solution.message
    found = program.value(asked, solution.pressures / reference.BAR)
    assert found > max(values) + np.log(SHARE)
