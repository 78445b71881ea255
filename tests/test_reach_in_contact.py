"""Bringing pressures to a target in contact: the arm stays in contact on the way, and arrives."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import stiffopt
from conftest import use_compiler
from stiffopt.optimise.braced import candidates
from stiffopt.optimise.leaning import BracedProblem
from stiffopt.optimise.reach_in_contact import reach_in_contact
from stiffopt.optimise.samples import SampleTable

POST = {
    "name": "post",
    "capsule": {"from": [-0.035, -0.06, 0.1], "to": [-0.035, 0.06, 0.1], "radius": 0.005},
    "contact": {"allowed": True, "max_force": 0.3},
}


@pytest.fixture(scope="module", autouse=True)
def compiled(code_cache: Path):
    with pytest.MonkeyPatch.context() as patch:
        use_compiler(patch, code_cache)
        yield


@pytest.fixture(scope="module")
def robot() -> stiffopt.Manipulator:
    return stiffopt.load_robot("stiff-flop-2")


def problem_of(robot: stiffopt.Manipulator, position: list[float]) -> BracedProblem:
    task = stiffopt.Task(
        robot="stiff-flop-2",
        target={"position": position, "tolerance": {"position": 1e-4}},
        stiffness={"maximise": {"direction": [1, 0, 0]}},
        scene={"objects": [POST]},
        brace={"objects": ["post"]},
    )
    return BracedProblem(robot, task)


def starts(problem: BracedProblem) -> Iterator[np.ndarray]:
    low, high = problem.lower * problem.unit, problem.upper * problem.unit
    return candidates(problem, SampleTable(problem.robot, low, high, 0))


def test_nearly_all_promising_starts_arrive_in_contact(robot):
    """Least squares without regard to the contact bring 15 of these there."""
    problem = problem_of(robot, [-0.03, 0.01, 0.19])
    problem.only_target = True
    arrived = 0
    for x in islice(starts(problem), 24):
        problem.restart()
        point = reach_in_contact(problem, x)
        if point is None or not point.reached:
            continue
        arrived += 1
        found = robot.contact_equilibrium(
            point.x * problem.unit, problem.scene, nearby=point.equilibrium
        )
        assert found.contacts
        assert np.linalg.norm(found.tip_pose[:3, 3] - [-0.03, 0.01, 0.19]) <= 1e-4
        assert (point.x >= problem.lower).all()
        assert (point.x <= problem.upper).all()
    assert arrived >= 22


def test_the_demands_on_contacts_are_met_too(robot):
    problem = problem_of(robot, [-0.03, 0.01, 0.19])
    x = next(starts(problem))
    point = reach_in_contact(problem, x)
    assert point is not None
    assert point.reached
    for way in ([1, 0, 0], [-1, 0, 0]):
        assert point.equilibrium.lift_off(way).force >= 0.02


def test_a_target_out_of_reach_is_approached_in_contact(robot):
    problem = problem_of(robot, [-0.15, 0.0, 0.19])
    problem.only_target = True
    x = next(starts(problem))
    begin = problem.equilibrium(x).tip_pose[:3, 3]
    problem.restart()
    point = reach_in_contact(problem, x)
    assert point is not None
    assert not point.reached
    assert problem.here is point.equilibrium
    assert point.equilibrium.contacts
    left = np.linalg.norm(point.equilibrium.tip_pose[:3, 3] - [-0.15, 0, 0.19])
    assert left < 0.5 * np.linalg.norm(begin - [-0.15, 0, 0.19])


def test_without_contact_there_is_nothing_to_follow(robot):
    problem = problem_of(robot, [-0.03, 0.01, 0.19])
    assert reach_in_contact(problem, np.zeros(6)) is None


def test_the_force_gradient_is_that_of_the_equilibrium(robot):
    problem = problem_of(robot, [-0.03, 0.01, 0.19])
    x = next(starts(problem))
    point = problem.pose(x)
    eq = point.equilibrium
    rng = np.random.default_rng(2)
    d = rng.normal(size=6) * 1e-3
    forces = [
        robot.contact_equilibrium(
            (x + sign * d) * problem.unit, problem.scene, nearby=eq
        ).normal_forces.sum()
        for sign in (1, -1)
    ]
    assert point.force == pytest.approx(eq.normal_forces.sum())
    assert point.force_gradient @ d == pytest.approx((forces[0] - forces[1]) / 2, rel=1e-2)
