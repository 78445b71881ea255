"""Find candidates: local optima of the stiffness at each point of a path.

At some points (knots), local searches start from samples near the target.  Each optimum is followed
from point to point, forwards and backwards, which traces a branch.  A branch ends where its optimum
vanishes: the local search then finds another branch, or nothing.
"""

import itertools
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.stopping import checkpoint
from stiffopt.paths.points import Local, PathCandidate, PathTasks
from stiffopt.paths.settings import CANDIDATES, LANES

Vector = NDArray[np.float64]


def candidates(tasks: PathTasks) -> tuple[list[list[PathCandidate]], int]:
    """Return distinct candidates at each point, the best first, and the number of starts."""
    count = len(tasks)
    n_knots = CANDIDATES.knots if tasks.is_compiled else CANDIDATES.general_knots
    knots = np.unique(np.linspace(0, count - 1, min(count, n_knots)).round().astype(int)).tolist()
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
    most = CANDIDATES.kept if tasks.is_compiled else CANDIDATES.general_kept
    return sorted(kept, key=lambda each: -each.value)[:most]


def lanes(
    tasks: PathTasks,
    layers: Sequence[Sequence[PathCandidate]],
    region: range,
    attempt: int,
    is_last: bool,
) -> list[list[PathCandidate]]:
    """Return further candidates of a free arm at each point, which need not be optimal.

    They lie in a region of the path.  At a few of its points, configurations are spread over all
    that reach the target, others for each attempt.  These and the local optima of all marks follow
    the path, from mark to mark, with as little change as possible; those beside them are added,
    unless this is the last attempt, which leaves more room for others.  They connect branches
    where the direct crossing would leave the path or touch an object.
    """
    count = len(tasks)
    if tasks.robot.is_loaded:
        return [[] for _ in range(count)]
    many = min(len(region), LANES.marks, max(2 * LANES.knots, len(region) // LANES.every))
    marks = np.unique(np.linspace(region[0], region[-1], many).round().astype(int))
    n_knots = LANES.last_knots if is_last else LANES.knots
    knots = marks[np.unique(np.linspace(0, len(marks) - 1, n_knots).round().astype(int))]
    born = {
        mark: np.array([each.pressures for each in layers[mark]]).reshape(-1, len(tasks.unit))
        for mark in marks.tolist()
    }
    starts = LANES.starts * (attempt + 1)
    for knot in knots.tolist():
        near = tasks.near(knot, starts)[-LANES.starts :]
        new, _ = tasks.clear(knot, near)
        born[knot] = np.concatenate([born[knot], new])
    rng = np.random.default_rng(attempt)
    points: list[NDArray[np.intp]] = []
    guesses: list[Vector] = []
    for order in (marks.tolist(), marks[::-1].tolist()):
        live = _spread(tasks, np.zeros((0, len(tasks.unit))), born[order[0]])
        points.append(np.full(len(live), order[0]))
        guesses.append(live)
        for here, there in itertools.pairwise(order):
            checkpoint()
            aside = live + LANES.aside * tasks.unit * rng.uniform(-1, 1, live.shape)
            guess = live if is_last else np.concatenate([live, aside])
            came, arrived = tasks.clear(there, guess)
            kept = arrived[: len(live)]
            own, new = came[: kept.sum()], came[kept.sum() :]
            for point in range(here, there, 1 if there > here else -1)[1:]:
                share = (point - here) / (there - here)
                points.append(np.full(len(own), point))
                guesses.append(live[kept] + share * (own - live[kept]))
            if there in knots:  # leave room for new ones
                own = own[: LANES.kept // 2]
            live = _spread(tasks, own, np.concatenate([born[there], new]))
            points.append(np.full(len(live), there))
            guesses.append(live)
    where = np.concatenate(points)
    pressures, arrived = tasks.brought(where, np.concatenate(guesses))
    return tasks.assessed(where[arrived], pressures)


def _spread(tasks: PathTasks, live: Vector, new: Vector) -> Vector:
    """Return at most `LANES.kept` distinct pressures (k, n): of `live`, then of `new`.

    New ones are farther from all others, and the farthest come first.
    """
    x = np.vstack([live, new]) / tasks.unit
    distance = np.full(len(x), np.inf)
    chosen: list[int] = []
    for some, apart in (
        (slice(0, len(live)), LANES.alike),
        (slice(len(live), len(x)), LANES.apart),
    ):
        own = distance[some]
        while len(own) and len(chosen) < LANES.kept and own.max() > apart:
            chosen.append(some.start + int(own.argmax()))
            np.minimum(distance, np.abs(x - x[chosen[-1]]).max(axis=1), out=distance)
    return x[chosen] * tasks.unit


def _at_knots(tasks: PathTasks, knots: Sequence[int]) -> tuple[dict[int, list[PathCandidate]], int]:
    """Return candidates at the knots, found from samples near their targets."""
    starts = CANDIDATES.starts_loaded if tasks.robot.is_loaded else CANDIDATES.starts
    if not tasks.is_compiled:
        starts = CANDIDATES.general_starts
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
