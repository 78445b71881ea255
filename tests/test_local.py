"""The local method in Python: its results hold, are optimal, and are those of compiled code."""

import sys
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import stiffopt as so
from stiffopt.optimise import local
from stiffopt.optimise.local import descend
from stiffopt.optimise.prepared import Prepared
from stiffopt.optimise.problem import PressureProblem
from stiffopt.optimise.reach import bounded_steps, reach, reach_all
from stiffopt.optimise.search import search, starts
from stiffopt.optimise.settings import Effort
from stiffopt.optimise.solver import PressureSolver

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

from quality import case

KINDS = ["position", "free-axis", "pointing", "pose-5", "guided", "several", "limited", "floor",
         "least-pressure"]  # fmt: skip
SEED = 5


@cache
def robot(name="stiff-flop-2"):
    return so.load_robot(name)


@pytest.fixture
def without_compiler(monkeypatch):
    monkeypatch.setenv("STIFFOPT_COMPILER", "none")
    robot.cache_clear()
    yield
    robot.cache_clear()


def program(kind, number=0, name="stiff-flop-2"):
    """A random task's problem, and pressures to start from."""
    task = case(robot(name), kind, SEED, number)
    problem = PressureProblem(robot(name), task)
    table = Prepared(robot(name), task, 0).samples
    return problem, np.array(list(starts(problem, table)[0]))


def feasible(problem, point):
    return (
        point.reached
        and (point.x >= problem.lower).all()
        and (point.x <= problem.upper).all()
        and all(ball.error <= ball.radius for ball in point.balls)
    )


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_reached_is_at_the_pose_and_within_the_limits(kind, without_compiler):
    problem, x = program(kind)
    points = [reach(problem, row) for row in x[:8]]
    assert any(point.reached for point in points)
    assert all(feasible(problem, point) for point in points if point.reached)
    came, excess = reach_all(problem, x[:8])
    assert (came >= problem.lower).all()
    assert (came <= problem.upper).all()
    for row, ratio in zip(came, excess, strict=True):
        assert problem.pose(row).reached == (ratio <= 1)


@pytest.mark.parametrize("kind", KINDS)
def test_descents_stay_feasible_improve_and_end_at_a_stationary_point(kind, without_compiler):
    problem, x = program(kind)
    for row in x[:4]:
        start = reach(problem, row)
        if not start.reached:
            continue
        before = problem.point(start.x)
        result = descend(problem, start)
        assert result.converged
        assert feasible(problem, result.point)
        missed = local.violation(problem, before)
        assert result.violation <= missed + 1e-9
        if missed == 0:
            assert result.value <= problem.objective.value(before) + 1e-9
        if result.holds_floors:
            assert lagrangian_gradient(problem, result) < 2e-3


def lagrangian_gradient(problem, result):
    """Length of the Lagrangian's gradient in pressures that are free, relative to the terms'."""
    prices, point = result.multipliers, result.point
    gradients = problem.objective.terms(point)[1]
    slope = prices.terms @ gradients - prices.floors @ point.floor_gradients
    for ball, pull in zip(point.bounded, prices.balls, strict=True):
        slope = slope + pull @ ball.jacobian
    free = (point.x > problem.lower) & (point.x < problem.upper)
    at_limits = np.where(point.x <= problem.lower, -slope, slope)[~free]
    assert (at_limits <= 1e-3 * np.linalg.norm(gradients)).all()  # they pull outwards
    return np.linalg.norm(slope[free]) / np.linalg.norm(gradients)


def test_a_descent_that_comes_next_to_a_known_optimum_ends_there(without_compiler):
    problem, x = program("position")
    start = next(point for point in (reach(problem, row) for row in x) if point.reached)
    first = descend(problem, start)
    assert descend(problem, start, [first], 1e-3) is first
    assert descend(problem, start) is not first


@pytest.mark.parametrize("shape", [(), (5,)])
def test_bounded_steps_fit_as_well_as_bounds_allow(shape):
    rng = np.random.default_rng(0)
    J, wanted = rng.normal(size=(*shape, 3, 6)), rng.normal(size=(*shape, 3))
    D, wide = 1e-9 * np.eye(3), np.full((*shape, 6), 1e3)
    d = bounded_steps(J, wanted, D, -wide, wide)
    assert (J @ d[..., np.newaxis])[..., 0] == pytest.approx(wanted, abs=1e-6)
    low, high = np.full((*shape, 6), -0.05), np.full((*shape, 6), 0.3)
    d = bounded_steps(J, wanted, D, low, high)
    assert (d >= low - 1e-12).all()
    assert (d <= high + 1e-12).all()


def test_search_is_over_when_nothing_new_is_found(without_compiler):
    problem, x = program("position")
    found = search(problem, x)
    assert found.confidence.complete
    assert found.confidence.starts == len(x)
    assert found.results[0].value == min(result.value for result in found.results)
    values = [result.value for result in found.results]
    assert all(a <= b for a, b in pairwise(values))
    short = search(problem, x, Effort(len(x), 3, 1))
    assert not short.confidence.complete
    assert short.confidence.reached == 1


def test_a_search_may_have_to_find_the_best_several_times(without_compiler):
    problem, x = program("position")
    found = search(problem, x, Effort(len(x), 1, len(x)))
    assert found.confidence.complete
    longer = search(problem, x, Effort(len(x), 1, len(x)), best_found=found.confidence.agreeing + 1)
    assert longer.confidence.reached > found.confidence.reached
    assert longer.confidence.complete == (longer.confidence.agreeing > found.confidence.agreeing)
    other = found.results[-1]
    own = sum(abs(end.value - other.value) < found.same for end in found.ends)
    needed = replace(found, best_found=own + 1)
    assert found.confidence_in(other).complete
    assert not needed.confidence_in(other).complete
    never = search(problem, x, Effort(len(x), 1, len(x)), best_found=len(x) + 1)
    assert not never.confidence.complete


def test_search_for_what_cannot_be_reached_says_where_it_ended(without_compiler):
    problem, x = program("unreachable")
    found = search(problem, x)
    assert not found.results
    assert len(found.nearest) == len(x)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", ["position", "pose-5", "guided", "several", "limited", "floor"])
def test_agrees_with_compiled_code(kind, compiled, monkeypatch):
    """Next to an answer of compiled code the other implementation finds the same optimum."""
    arm = so.load_robot("stiff-flop-2")
    for number in range(4):
        task = case(arm, kind, SEED, number)
        solver = PressureSolver(arm, task)
        answer = solver.solve()
        with monkeypatch.context() as context:
            context.setenv("STIFFOPT_COMPILER", "none")
            interpreted = so.solve_pressure(
                so.load_robot("stiff-flop-2"), task, guess=answer.pressures
            )
        assert answer.found
        assert answer.counts  # of the compiled solver
        assert interpreted.found
        assert interpreted.counts == {}  # the general method
        first = len(task.stiffness.maximise)
        expected = min(answer.stiffnesses[:first])
        assert min(interpreted.stiffnesses[:first]) == pytest.approx(expected, rel=1e-6)
