"""Find candidates: local optima of the stiffness at each point of a path.

At some points (knots), local searches start from samples near the target.  Each optimum is followed
from point to point, forwards and backwards, which traces a branch.  A branch ends where its optimum
vanishes: the local search then finds another branch, or nothing.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.stopping import checkpoint
from stiffopt.paths.points import Local, PathCandidate, PathTasks
from stiffopt.paths.settings import CANDIDATES, WITHOUT_MACHINE_CODE, CandidateSettings


def candidates(tasks: PathTasks) -> tuple[list[list[PathCandidate]], int]:
    """Return distinct candidates at each point, the best first, and the number of starts."""
    count = len(tasks)
    knots = spaced(0, count - 1, min(count, _settings(tasks).knots)).tolist()
    at_knots, starts = _at_knots(tasks, knots)
    found: list[list[PathCandidate]] = []
    new: list[list[PathCandidate]] = []  # not reached from the point before
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
    """Return candidates without near duplicates, the best first, at most `kept` of them."""
    kept: list[PathCandidate] = []
    tolerance = CANDIDATES.same * tasks.unit
    for each in some:
        if all((abs(each.pressures - other.pressures) > tolerance).any() for other in kept):
            kept.append(each)
    return sorted(kept, key=lambda each: -each.value)[: _settings(tasks).kept]


def spaced(first: int, last: int, count: int) -> NDArray[np.intp]:
    """Return distinct whole numbers from first to last, at most `count`, spaced evenly."""
    return np.unique(np.linspace(first, last, count).round().astype(int))


def _settings(tasks: PathTasks) -> CandidateSettings:
    return CANDIDATES if tasks.is_compiled else WITHOUT_MACHINE_CODE


def _at_knots(tasks: PathTasks, knots: Sequence[int]) -> tuple[dict[int, list[PathCandidate]], int]:
    """Return candidates at the knots, found from samples near their targets."""
    settings = _settings(tasks)
    starts = settings.starts_loaded if tasks.robot.is_loaded else settings.starts
    checkpoint()
    found = {
        index: [] if best is None else [best]
        for index, best in zip(knots, tasks.bests(knots), strict=True)
    }
    going, count = list(knots), 0
    for part in (slice(0, starts // 2), slice(starts // 2, starts)):
        questions = [
            Local(index, guess, tasks.lower, tasks.upper)
            for index in going
            for guess in tasks.near(index, starts)[part]
        ]
        count += len(questions)
        for question, candidate in zip(questions, tasks.locals(questions), strict=True):
            if candidate is not None:
                found[question.point].append(candidate)
        going = [index for index in going if not _agree(tasks, found[index])]
    return {index: distinct(tasks, some) for index, some in found.items() if some}, count


def _agree(tasks: PathTasks, some: Sequence[PathCandidate]) -> bool:
    """Return whether there are candidates and several starts led to each of them."""
    x = np.array([each.pressures for each in some]).reshape(-1, len(tasks.unit))
    alike = (abs(x[:, np.newaxis] - x) <= CANDIDATES.same * tasks.unit).all(axis=2)
    return len(x) > 0 and bool((alike.sum(axis=1) > 1).all())


def _next_to(tasks: PathTasks, index: int, some: Sequence[PathCandidate]) -> list[PathCandidate]:
    """Return candidates at a point, found from those at its neighbour."""
    checkpoint()
    questions = [Local(index, each.pressures, tasks.lower, tasks.upper) for each in some]
    return [answer for answer in tasks.locals(questions) if answer is not None]
