"""What answers say of themselves is true: prices, completeness, limits that hold back, scale."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

import stiffopt as so

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

from quality import case

SEED = 77


@pytest.fixture
def robot(compiled):
    return so.load_robot("stiff-flop-2")


def with_tolerance(task, size):
    tolerance = task.target.tolerance.model_copy(update={"position": size})
    return task.model_copy(
        update={"target": task.target.model_copy(update={"tolerance": tolerance})}
    )


def test_prices_of_tolerances_are_slopes(robot):
    """Solving again with 1 % more and less tolerance gives the slope that was told.

    A solution is exact to 2e-7 of its stiffness, and so is the slope to 5 times 1e-7 k / 1e-6 m.
    """
    for number in range(44):
        task = case(robot, "position", SEED, number)
        cold = so.solve_pressure(robot, task)
        size = task.target.tolerance.position
        less, more = (
            so.solve_pressure(robot, with_tolerance(task, share * size), guess=cold.pressures)
            for share in (0.99, 1.01)
        )
        slope = (more.stiffness - less.stiffness) / (0.02 * size)
        price = cold.sensitivities.per_position_tolerance
        assert price > 0, number
        assert price == pytest.approx(slope, rel=0.02, abs=1.5 * cold.stiffness), number


def test_a_wide_tolerance_is_searched_as_widely(robot):
    """No answer misses the best of many random starts, for tolerances up to 1.5 arm lengths."""
    rng = np.random.default_rng(9)
    most = robot.pressure_max
    for number in range(16):
        task = case(robot, "position", 78, number)
        task = with_tolerance(task, rng.uniform(0.2, 1.5) * robot.length)
        solution = so.solve_pressure(robot, task)
        spread = np.clip(1.3 * rng.random((60, 6)) - 0.15, 0, 1) * most
        others = so.solve_batch(robot, [task] * len(spread), list(spread), threads=1)
        best = max(other.stiffness for other in others if other.found)
        assert solution.confidence.complete
        assert solution.stiffness > (1 - 1e-3) * best, number


def test_effort_grows_with_what_the_tolerance_covers(robot):
    task = case(robot, "position", 78, 3)
    tries = [
        so.solve_pressure(robot, with_tolerance(task, share * robot.length)).counts["starts"]
        for share in (1e-3, 0.1, 0.5)
    ]
    assert tries[0] < tries[1] <= tries[2]
    assert tries[2] == 256


def farthest(robot, direction):
    """Pressures whose tip is farthest along a direction, and what each pressure adds there."""

    def value(x):
        T = robot.tip_pose(x * 1e5)
        slope = (T[:3, :3] @ robot.tip_jacobian(x * 1e5)[:3]).T @ direction
        return -1e3 * direction @ T[:3, 3], -1e8 * slope

    starts = np.random.default_rng(1).uniform(0, 1.5, (6, 6))
    found = [
        minimize(value, x, jac=True, bounds=[(0, 1.5)] * 6, options={"ftol": 1e-14, "gtol": 1e-9})
        for x in starts
    ]
    best = min(found, key=lambda each: each.fun)
    return best.x * 1e5, -1e-3 * best.jac


def test_limits_that_hold_back_just_out_of_reach_are_named():
    robot = so.load_robot("stiff-flop-2")
    rng = np.random.default_rng(5)
    for distance in (1e-4, 2e-4, 5e-4) * 4:
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        p, slope = farthest(robot, direction)
        holding = {
            f"{robot.description.channel_name(i)} {'max' if slope[i] > 0 else 'min'}"
            for i in range(6)
            if abs(slope[i]) > 1e-4
        }
        beyond = robot.tip_pose(p)[:3, 3] + (distance + 1e-4) * direction
        task = so.Task(robot="x", target=so.Target(position=tuple(beyond)))
        solution = so.solve_pressure(robot, task)
        assert solution.status == "unreachable"
        assert solution.position_error == pytest.approx(distance + 1e-4, abs=1e-6)
        assert holding <= set(solution.active_bounds)
        for name in holding:
            assert name in solution.message, (name, solution.message)


@pytest.mark.parametrize("factor", [0.2 / 1.5, 10 / 1.5])
def test_an_arm_of_other_pressures_has_the_same_answers(factor, compiled, monkeypatch):
    """Moduli and limits scaled together: the same shapes, at pressures scaled as well."""
    robot = so.load_robot("stiff-flop-2")
    given = robot.description.model_dump()
    for segment in given["segments"]:
        segment["material"]["youngs_modulus"] *= factor
    for limit in ("min", "max"):
        given["pressure"][limit] *= factor
    scaled = so.load_robot(so.RobotDescription(**given))
    for kind in ("position", "least-pressure"):
        for number in range(3):
            task = case(robot, kind, SEED, number)
            one, other = so.solve_pressure(robot, task), so.solve_pressure(scaled, task)
            assert other.found
            np.testing.assert_allclose(other.pressures / factor, one.pressures, atol=2e-4 * 1.5e5)
            if task.stiffness is not None:
                assert other.stiffness / factor == pytest.approx(one.stiffness, rel=1e-5)
    monkeypatch.setenv("STIFFOPT_COMPILER", "none")
    task = case(robot, "position", SEED, 0)
    guess = so.solve_pressure(robot, task).pressures
    general = so.solve_pressure(so.load_robot(scaled.description), task, guess=factor * guess)
    assert not general.counts
    np.testing.assert_allclose(general.pressures / factor, guess, atol=2e-4 * 1.5e5)
