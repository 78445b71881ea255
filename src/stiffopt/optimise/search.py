"""Global search: where local optimisations start, and when to stop.

The samples whose tips are nearest to the target are brought to the pose and ranked by the objective
there.  Descents start from the best, those unlike each other first.  A descent that comes close to
a known optimum ends there.  The search ends when enough descents in a row have found no new local
optimum: all optima with a large basin have then probably been seen, but nothing is proved.  The
number required depends on how many configurations meet the target (`effort`).

The folder ``native`` holds the same method in C.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import StoppedError
from stiffopt.optimise.local import LocalResult, descend, violation
from stiffopt.optimise.problem import PressureProblem, ProgramPoint
from stiffopt.optimise.reach import reach, reach_all
from stiffopt.optimise.samples import SampleTable
from stiffopt.optimise.settings import DESCENT, OBSTACLES, REACH, SEARCH, Effort
from stiffopt.optimise.solution import Confidence

Places = Callable[[Any, Iterable[Array]], Iterator[tuple[int, ProgramPoint | None]]]
"""Brings candidates to the target: yields points to descend from, with the number tried so far."""


def effort(rows: int, covered: float, loaded: bool = False) -> Effort:
    """Return the effort of a search.

    A target with fewer components than a position, or with a large tolerance, is reached in very
    different ways, and the best is easily missed.  The numbers were tuned against hundreds of
    descents a task, see benchmarks/quality.py.

    Parameters
    ----------
    rows : components of the residuals that must be zero.
    covered : share of the sampled configurations that meet the target.
    loaded : whether machine code searches for an arm under gravity or a load.
    """
    placed, loose = SEARCH.placed, SEARCH.loose
    if loaded:
        placed, loose = SEARCH.loaded_placed, SEARCH.loaded_loose
    if rows < 3:
        return loose
    share = min(1.0, covered / SEARCH.covered)
    return Effort(*(int(a + share * (b - a)) for a, b in zip(placed, loose, strict=True)))


def starts(problem: PressureProblem, table: SampleTable) -> tuple[Iterator[Array], Effort]:
    """Return variables (n,) to start from, near the target first, and the effort of the search.

    Evaluations are slower than in compiled code, so the effort is smaller.  Without loads, one
    descent less must agree, and half of the samples suffice for up to six pressures, where there
    are few optima. Under load few starts are tried: samples near the target and arbitrary ones
    alternate, unlike each other first.
    """
    distances = table.distances(problem.program.terms, problem.robot.length)
    full = effort(problem.program.n_equal, float((distances == 0).mean()))
    x = table.pressures / problem.unit
    if not problem.robot.is_loaded:
        few = len(problem.lower) <= 6
        screened = full.screened // 2 if few else full.screened
        order = table.nearest_first(distances, screened)
        tries = full._replace(screened=screened, agreeing=full.agreeing - 1)
        return iter(x[order]), tries
    order = table.nearest_first(distances)
    mixed = [i for pair in zip(order, range(len(order)), strict=True) for i in pair]
    x = x[list(dict.fromkeys(mixed))]
    unlike = (x[i] for i in unlike_first(problem, x))
    return islice(unlike, SEARCH.general_starts_loaded), full


@dataclass(frozen=True)
class Search:
    """Outcome of a global search."""

    # ends of descents, the best first, without those that stopped next to a known optimum
    results: tuple[LocalResult, ...]
    # ends of starts that did not reach the pose, if none reached it
    nearest: tuple[ProgramPoint, ...]
    confidence: Confidence  # in the best result
    # ends of the converged descents, one of each, those included that stopped next to a known
    # optimum
    ends: tuple[LocalResult, ...] = ()
    same: float = SEARCH.same_optimum  # difference of values below which ends count as one optimum
    best_found: int = 1  # how many descents must have found an answer for a complete search

    def confidence_in(self, result: LocalResult) -> Confidence:
        """Return how sure the search is of another result than the best, with its own descent."""
        agreeing = max(1, sum(_agree(end, result, self.same) for end in self.ends))
        complete = self.confidence.complete and agreeing >= self.best_found
        return replace(self.confidence, agreeing=agreeing, complete=complete)


def search(
    problem: PressureProblem,
    candidates: Iterable[Array],
    tries: Effort = SEARCH.placed,
    same: float = SEARCH.same_optimum,
    places: Places | None = None,
    best_found: int = 1,
) -> Search:
    """Run local optimisations from candidates until enough of them in a row find nothing new.

    `same` is the difference of values below which optima count as one; `places` brings candidates
    to the target; `best_found` is how many descents must have found the best optimum.
    """
    trail = _Trail(same, tries.agreeing, best_found)
    try:
        _descend_from(problem, (places or _places)(problem, candidates), tries, trail)
    except StoppedError:
        if problem.robot.is_loaded or not trail.optima:
            raise  # nothing was found, or judging it would take long as well
    return trail.outcome()


def _descend_from(
    problem: PressureProblem,
    places: Iterator[tuple[int, ProgramPoint | None]],
    tries: Effort,
    trail: "_Trail",
) -> None:
    """Descend from points at the target until enough has been seen; record ends in the trail."""
    ends: dict[int, LocalResult] = {}
    for tried, point in places:
        trail.starts = tried
        if point is None:
            continue
        if not point.reached:
            trail.nearest.append(point)
            continue
        if id(point) not in ends:
            ends[id(point)] = descend(problem, point, trail.optima, trail.same)
        trail.add(ends[id(point)])
        if trail.is_complete or trail.descents >= tries.most_descents:
            break


class _Trail:
    """Results of the descents of a search so far."""

    def __init__(self, same: float, agreeing: int, best_found: int) -> None:
        self.same, self._agreeing, self._best_found = same, agreeing, best_found
        self.starts = self.descents = self._nothing_new = 0
        self.nearest: list[ProgramPoint] = []
        self.optima: list[LocalResult] = []
        self._results: list[LocalResult] = []
        self._converged: list[LocalResult] = []

    def add(self, result: LocalResult) -> None:
        """Record the end of a descent."""
        self.descents += 1
        if not np.isfinite(result.value):
            return
        if not any(result is known for known in self._results):
            self._results.append(result)
        if not result.converged:
            return
        self._converged.append(result)
        if any(_agree(result, known, self.same) for known in self.optima):
            self._nothing_new += 1
        else:
            self.optima.append(result)
            self._nothing_new = 0

    @property
    def is_complete(self) -> bool:
        """True if enough descents in a row found nothing new, and enough found the best."""
        return self._nothing_new >= self._agreeing and self._agreeing_on_best >= self._best_found

    @property
    def _agreeing_on_best(self) -> int:
        best = min(self._converged, key=_rank, default=None)
        return sum(best is not None and _agree(end, best, self.same) for end in self._converged)

    def outcome(self) -> Search:
        """Return the outcome, the best results first."""
        results = sorted(self._results, key=_rank)
        ends = tuple(self._converged)
        confidence = Confidence(
            self.starts, len(ends), self._agreeing_on_best, len(self.optima), self.is_complete
        )
        nearest = tuple(self.nearest)
        return Search(tuple(results), nearest, confidence, ends, self.same, self._best_found)


def _agree(a: LocalResult, b: LocalResult, same: float) -> bool:
    return abs(a.value - b.value) < same and abs(a.violation - b.violation) < same


def _rank(result: LocalResult) -> tuple[float, float]:
    return (round(result.violation, 7), result.value)


# -- where descents start -------------------------------------------------------------------


def _places(
    problem: PressureProblem, candidates: Iterable[Array]
) -> Iterator[tuple[int, ProgramPoint | None]]:
    """Yield points to descend from, each with the number of candidates tried so far.

    Yield None, or a point off the pose, for a candidate that did not arrive.
    """
    if problem.robot.is_loaded:
        for tried, x in enumerate(candidates, 1):
            problem.restart()  # each from rest
            yield tried, reach(problem, x)
        return
    x = np.array(list(candidates))
    if not len(x):
        return
    x, excess = reach_all(problem, x)
    arrived = x[excess <= 1]
    if not len(arrived):
        points = [problem.pose(row) for row in x[np.argsort(excess, kind="stable")]]
        yield from ((len(x), point) for point in points)
        return
    place = _first_at_same_place(arrived)
    rank = {i: _rank_of_start(problem, arrived[i]) for i in set(place)}
    ranked = sorted(range(len(arrived)), key=lambda i: rank[place[i]])
    points_at: dict[int, ProgramPoint] = {}
    for i in unlike_first(problem, arrived[ranked]):
        at = place[ranked[i]]
        if at not in points_at:
            points_at[at] = _past_obstacles(problem, arrived[at])
        point = points_at[at]
        yield len(x), point if point.is_finite and point.reached else None


def _past_obstacles(problem: PressureProblem, x: Array) -> ProgramPoint:
    """Evaluate pressures (n,) at the target; if the body hits obstacles, move it clear first."""
    point = problem.needed(x)
    if problem.program.obstacles is None or point.reached:
        return point
    moved = reach(problem, x, REACH.iterations_of_many)
    return point if moved is None or not moved.reached else problem.needed(moved.x)


def _intrusion(problem: PressureProblem, x: Array) -> float:
    """Return the sum of missing clearances at pressures (n,), over the arm's length."""
    own = problem.program.n_own_rows
    missing = problem.pose(x).residual[own:] - OBSTACLES.margin
    return float(np.maximum(missing, 0.0).sum()) / problem.robot.length


def _first_at_same_place(x: Array) -> list[int]:
    """Return for each of the pressures (N, n) the index of the first that is nearly equal."""
    same_place = np.abs(x[:, np.newaxis] - x).max(axis=2) < DESCENT.next_to
    return same_place.argmax(axis=1).tolist()


def _rank_of_start(problem: PressureProblem, x: Array) -> float:
    """Return the objective at pressures (n,), with penalties on missed floors and clearances."""
    point = problem.worth(x)
    value = problem.objective.value(point) + SEARCH.price_of_floors * violation(problem, point)
    if problem.program.obstacles is not None:
        value += SEARCH.price_of_obstacles * _intrusion(problem, x)
    return value if np.isfinite(value) else np.inf


def unlike_first(problem: PressureProblem, x: Array) -> Iterator[int]:
    """Yield the indices of pressures (N, n): those far from all before first, then the rest."""
    range_ = problem.upper - problem.lower
    spacing = SEARCH.unlike**2 * float(range_ @ range_)
    squares = np.einsum("ij,ij->i", x, x)
    close = squares[:, np.newaxis] + squares - 2 * x @ x.T <= spacing
    passed_over = np.zeros(len(x), dtype=bool)
    later: list[int] = []
    for i in range(len(x)):
        if passed_over[i]:
            later.append(i)
        else:
            passed_over |= close[i]
            yield i
    yield from later
