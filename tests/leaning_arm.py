"""What the tests of a brace share: the arm beside a post, its answer and its way into contact."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import stiffopt
from stiffopt.optimise import braced
from stiffopt.optimise.settings import BRACE, Effort
from stiffopt.optimise.solution import PressureSolution
from stiffopt.paths.leaning import BraceApproach, approach_to

ROBOT = stiffopt.load_robot("stiff-flop-2")
TASK = stiffopt.load_task("problems/braced/post.yaml")
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
