"""Candidates: local optima at each point of a path, as many of its branches as are seen.

At some points (knots) local optima are looked for from samples near the target; each is followed
from point to point, forwards and backwards.  A branch ends where its optimum vanishes: the search
next to it then leads to another branch, or to none.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.stopping import checkpoint
from stiffopt.optimise.problem import PressureProblem
from stiffopt.optimise.reach import reach_all
from stiffopt.paths.points import Local, PathCandidate, PathTasks
from stiffopt.paths.settings import CANDIDATES, LANES

Vector = NDArray[np.float64]


def candidates(tasks: PathTasks) -> tuple[list[list[PathCandidate]], int]:
    """Distinct candidates at each point, the best first, and how many starts were tried."""
    count = len(tasks)
    n_knots = CANDIDATES.knots if tasks.is_compiled else CANDIDATES.general_knots
    knots = np.unique(np.linspace(0, count - 1, min(count, n_knots)).round().astype(int)).tolist()
    at_knots, starts = _at_knots(tasks, knots)
    found: list[list[PathCandidate]] = []
    new: list[list[PathCandidate]] = []  # those that did not come from the point before
    live: list[PathCandidate] = []
    for index in range(count):
        came = _next_to(tasks, index, live)
        live = distinct(tasks, [*came, *at_knots.get(index, [])])
        found.append(live)
        new.append([each for each in live if not _is_one_of(each, came)])
    live = []
    for index in reversed(range(count)):
        came = _next_to(tasks, index, live)
        found[index] = distinct(tasks, [*found[index], *came])
        live = [each for each in found[index] if _is_one_of(each, [*came, *new[index]])]
    return found, starts


def _is_one_of(candidate: PathCandidate, some: Iterable[PathCandidate]) -> bool:
    return any(candidate is each for each in some)


def distinct(tasks: PathTasks, some: Iterable[PathCandidate]) -> list[PathCandidate]:
    """Those of some candidates that are unlike each other, the first of each; the best first."""
    kept: list[PathCandidate] = []
    tolerance = CANDIDATES.same * tasks.unit
    for each in some:
        if all((abs(each.pressures - other.pressures) > tolerance).any() for other in kept):
            kept.append(each)
    most = CANDIDATES.kept if tasks.is_compiled else CANDIDATES.general_kept
    return sorted(kept, key=lambda each: -each.value)[:most]


def lanes(tasks: PathTasks) -> list[list[PathCandidate]]:
    """Further candidates at each point of a free arm: any pressures that solve the task there.

    Some are spread over all that reach the target at a few points, and follow the path from there
    with as little change as possible.  A way from branch to branch leads over them where the
    direct one does not stay on the path.
    """
    count, n = len(tasks), len(tasks.unit)
    if tasks.robot.is_loaded:
        return [[] for _ in range(count)]
    problems = [tasks.problem(index) for index in range(count)]
    knots = np.unique(np.linspace(0, count - 1, LANES.knots).round().astype(int)).tolist()
    spread = {
        knot: _spread(tasks, _come(problems[knot], tasks.near(knot, LANES.starts)))
        for knot in knots
    }
    followed: list[list[Vector]] = [[] for _ in range(count)]
    for order in (range(count), range(count - 1, -1, -1)):
        live = np.zeros((0, n))
        for index in order:
            checkpoint()
            live = _come(problems[index], np.vstack([live, spread.get(index, live[:0])]))
            followed[index].append(live)
    return [
        tasks.assessed(index, _spread(tasks, np.vstack(some), len(tasks.unit) * LANES.kept))
        for index, some in enumerate(followed)
    ]


def _come(problem: PressureProblem, pressures: Vector) -> Vector:
    """Those of some pressures (k, n) that come to the target, there."""
    if not len(pressures):
        return pressures
    x, excess = reach_all(problem, pressures / problem.unit)
    return np.clip(x[excess <= 1], problem.lower, problem.upper) * problem.unit


def _spread(tasks: PathTasks, pressures: Vector, most: int = LANES.kept) -> Vector:
    """Some of these pressures (k, n), far from each other: each the furthest from those before."""
    if not len(pressures):
        return pressures
    x = pressures / tasks.unit
    chosen = [0]
    distance = np.abs(x - x[0]).max(axis=1)
    while len(chosen) < most and distance.max() > LANES.apart:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.abs(x - x[chosen[-1]]).max(axis=1))
    return pressures[chosen]


def _at_knots(tasks: PathTasks, knots: Sequence[int]) -> tuple[dict[int, list[PathCandidate]], int]:
    """Candidates at some points, from samples near their targets."""
    starts = CANDIDATES.starts_loaded if tasks.robot.is_loaded else CANDIDATES.starts
    if not tasks.is_compiled:
        starts = CANDIDATES.general_starts
    questions = [
        Local(index, guess, tasks.lower, tasks.upper)
        for index in knots
        for guess in tasks.near(index, starts)
    ]
    checkpoint()
    answers = tasks.locals(questions)
    best = tasks.bests(knots)
    found: dict[int, list[PathCandidate]] = {}
    for index, candidate in (
        *zip(knots, best, strict=True),
        *((q.point, a) for q, a in zip(questions, answers, strict=True)),
    ):
        if candidate is not None:
            found.setdefault(index, []).append(candidate)
    return {index: distinct(tasks, some) for index, some in found.items()}, len(questions)


def _next_to(tasks: PathTasks, index: int, some: Sequence[PathCandidate]) -> list[PathCandidate]:
    """Candidates at a point, next to those at its neighbour."""
    checkpoint()
    questions = [Local(index, each.pressures, tasks.lower, tasks.upper) for each in some]
    return [answer for answer in tasks.locals(questions) if answer is not None]
