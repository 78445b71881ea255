"""What the tests of a brace share: the arm beside a post, its answer and its way into contact."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import stiffopt
from stiffopt.control.bracing import BracePhase, Bracing
from stiffopt.control.contact_tuning import BracingTuning
from stiffopt.optimise import braced
from stiffopt.optimise.settings import BRACE, Effort
from stiffopt.optimise.solution import PressureSolution
from stiffopt.paths.leaning import BraceApproach, approach_to

ROBOT = stiffopt.load_robot("stiff-flop-2")
TASK = stiffopt.load_task("problems/braced/post.yaml")
TUNING = BracingTuning(settling=0.1, relief=0.0)
PERIOD = 0.01
LIMITS = (np.zeros(6), np.full(6, 1.5e5))


@contextmanager
def few_starts() -> Iterator[None]:
    """Search from few starts, which find the answer of this task."""
    with pytest.MonkeyPatch.context() as patch:
        few = replace(BRACE, effort=Effort(3, 1, 2), screened=256)
        patch.setattr(braced, "BRACE", few)
        yield


@cache
def braced_solution() -> PressureSolution:
    """The answer, which leans on the post."""
    with few_starts():
        found = stiffopt.solve_pressure(ROBOT, TASK)
    assert [each.object for each in found.contacts] == ["post"]
    return found


@cache
def brace_approach() -> BraceApproach:
    """The way into contact with it."""
    return approach_to(ROBOT, braced_solution())


@pytest.fixture(scope="module", autouse=True, name="with_few_starts")
def few_starts_fixture() -> Iterator[None]:
    with few_starts():
        yield


@pytest.fixture(name="solution")
def solution_fixture() -> PressureSolution:
    return braced_solution()


@pytest.fixture(name="approach")
def approach_fixture() -> BraceApproach:
    return brace_approach()


def held(approach: BraceApproach, tuning: BracingTuning = TUNING, **brace: Any) -> Bracing:
    """A course that has arrived in contact, of the task with other keys of its `brace`."""
    task = TASK.model_copy(update={"brace": TASK.brace.model_copy(update=brace)})
    course = Bracing(task, tuning)
    course.begin(approach, np.zeros(6))
    for _ in range(10_000):
        course.advance(PERIOD, True)
        if course.phase is BracePhase.HELD:
            return course
    raise AssertionError(course.phase)


def samples(course: Bracing, approach: BraceApproach, off: Any, count: int) -> float | None:
    """Look at samples of a tip that is off the braced one; when it was let go, in s."""
    tip, p = approach.tips[-1], approach.pressures[-1]
    for number in range(1, count + 1):
        course.look(0.025, tip.pose[:3, 3] + off, tip, p)
        if course.phase is BracePhase.RELEASING:
            return 0.025 * number
    return None


def settled(approach: BraceApproach, **brace: Any) -> Bracing:
    """`held`, after a second in which the tip is where the way ends."""
    course = held(approach, **brace)
    samples(course, approach, np.zeros(3), 40)
    return course


def pushed(approach: BraceApproach, force: Any) -> Any:
    """Displacement of the braced tip by a force."""
    tip = approach.tips[-1]
    R = tip.pose[:3, :3]
    return R @ tip.compliance[:3, :3] @ R.T @ np.asarray(force)


def lift_off(approach: BraceApproach) -> Any:
    """The push along x that lifts the contact off, in N."""
    lifts = float(-approach.hold.forces[0] / approach.hold.per_push[0, 0])
    assert lifts > 0
    return lifts * np.array([1.0, 0.0, 0.0])


def stiff(approach: BraceApproach, moved: float) -> tuple[BraceApproach, Any]:
    """The same approach with a tip that moves by so much until it lifts off, and that push."""
    lifts, tip = lift_off(approach), approach.tips[-1]
    compliance = tip.compliance * moved / np.linalg.norm(pushed(approach, lifts))
    tips = (*approach.tips[:-1], tip._replace(compliance=compliance))
    return replace(approach, tips=tips), lifts
