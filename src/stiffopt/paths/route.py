"""Find the best sequence of candidates, one at each point of a path, within the rates.

Candidates at consecutive points are linked if the rates allow the step.  A crossing links
candidates several points apart: the pressures go from one to the other at full rate while the tip
stays on the path.  Dynamic programming finds the best sequence.  The stiffness along a crossing is
expensive; it is computed only if a best sequence would use the crossing, and until then estimated
from its ends.  Likewise, whether the body keeps clear of a scene between the points is checked
only for links that a best sequence would use.
"""

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.compiled import Library, compiling_at_once, library
from stiffopt.model.stopping import checkpoint
from stiffopt.paths.points import BodyCheck, Local, PathCandidate, PathTasks
from stiffopt.paths.settings import RATES, ROUTE

Vector = NDArray[np.float64]
Indices = NDArray[np.intp]
_NONE = np.zeros(0, dtype=np.intp)
_SOURCES = (str(Path(__file__).with_name("native") / "route.c"),)


@lru_cache(maxsize=1)
def _compiled() -> Library | None:
    """Return machine code of the dynamic programming, which takes little time to compile."""
    with compiling_at_once():
        return library("routes", list, _SOURCES)


@dataclass
class Route:
    """A sequence of candidates, one at each point.

    Attributes
    ----------
    candidates : list of PathCandidate
    crossings : number of crossings from branch to branch.
    """

    candidates: list[PathCandidate]
    crossings: int

    def value(self, over: str) -> float:
        """Return the worst value of the sequence, or the mean."""
        values = [each.value for each in self.candidates]
        return float(min(values) if over == "worst" else np.mean(values))


class _Sequence(NamedTuple):
    """A sequence: its first candidate, its links in order, worst value (if it counts) and mean."""

    first: int
    links: list[int]
    worst: float
    mean: float


@dataclass
class _Links:
    """Links from a candidate to one at a later point, sorted by their ends.

    Candidates are numbered through all points.  A link is a step to the next point or a crossing.

    Attributes
    ----------
    origin, goal : candidates at both ends.
    worst, total : smallest value and sum of values in between; estimates until `known`.
    known : whether these are computed.
    checked : whether the body is known to keep clear along a link.
    between : the candidates along each computed crossing, by the link's number.
    """

    origin: Indices
    goal: Indices
    worst: Vector
    total: Vector
    known: NDArray[np.bool_]
    checked: NDArray[np.bool_]
    between: dict[int, list[PathCandidate]] = field(default_factory=dict)

    @classmethod
    def steps(cls, origin: Indices, goal: Indices) -> "_Links":
        """Return links to the next point, with nothing in between."""
        count = len(goal)
        known, checked = np.ones(count, bool), np.zeros(count, bool)
        return cls(origin, goal, np.full(count, np.inf), np.zeros(count), known, checked)

    def with_crossings(self, others: "_Links") -> "_Links":
        """Return these links and crossings together."""
        order = np.argsort(np.concatenate([self.goal, others.goal]), kind="stable")
        return _Links(
            np.concatenate([self.origin, others.origin])[order],
            np.concatenate([self.goal, others.goal])[order],
            np.concatenate([self.worst, others.worst])[order],
            np.concatenate([self.total, others.total])[order],
            np.concatenate([self.known, others.known])[order],
            np.concatenate([self.checked, others.checked])[order],
        )

    def sorted_by_point(self, first: Indices) -> list[tuple[slice, Indices, Indices]]:
        """Return, for each point, its links, the first link of each goal, and the goals."""
        bounds = np.searchsorted(self.goal, first)
        heads = np.flatnonzero(np.diff(self.goal, prepend=-1))
        runs = np.searchsorted(heads, bounds)
        return [
            (slice(a, b), heads[c:d] - a, self.goal[heads[c:d]])
            for a, b, c, d in zip(bounds[:-1], bounds[1:], runs[:-1], runs[1:], strict=True)
            if b > a
        ]


class RouteSearch:
    """Searches for the best sequence of candidates.

    Parameters
    ----------
    tasks : PathTasks
    layers : list of list of PathCandidate
        Local optima at each of N points.
    steps : (N - 1, n)
        Largest changes of pressure from point to point, in Pa.
    over : "worst" or "mean"
        Which value along the path to maximise.
    lanes : list of list of PathCandidate, optional
        Further candidates at each point.
    is_closed : whether sequences end with the pressures with which they begin.
    body : BodyCheck, optional
        Excludes links on which the body does not keep clear.

    Attributes
    ----------
    first : the first sequence that `best` found, which may be worse than what it returns.
    """

    def __init__(
        self,
        tasks: PathTasks,
        layers: Sequence[Sequence[PathCandidate]],
        steps: Vector,
        over: str,
        lanes: Sequence[Sequence[PathCandidate]] | None = None,
        is_closed: bool = False,
        body: BodyCheck | None = None,
    ) -> None:
        self._tasks, self._steps, self._over = tasks, steps, over
        self._body = body
        self._code = _compiled() if tasks.is_compiled else None
        count = len(layers)
        if is_closed:
            layers = [*layers[:-1], layers[0]]
        further = lanes or [[] for _ in layers]
        pairs = list(zip(layers, further, strict=True))
        sizes = [len(own) + len(more) for own, more in pairs]
        self._candidates = [each for own, more in pairs for each in (*own, *more)]
        self._is_lane = np.array(
            [lane for pair in pairs for lane in (False, True) for _ in pair[lane]], dtype=bool
        )
        self._first = np.cumsum([0, *sizes])  # candidate of each point, of all
        self._point = np.repeat(np.arange(count), sizes)
        self._values = np.array([each.value for each in self._candidates])
        self._pressures = np.array([each.pressures for each in self._candidates]).reshape(
            len(self._candidates), len(tasks.unit)
        )
        self._ends: Sequence[int | None] = range(len(layers[0])) if is_closed else [None]
        self._usable = self._values
        self.first: Route | None = None
        self._repeats = ROUTE.repeats
        self._set_links(self._all_steps())

    def best(
        self, rounds: int = ROUTE.rounds, *, share: float | None = None, any_will_do: bool = False
    ) -> Route | None:
        """Return the best sequence, or any if `any_will_do`; None if there is none.

        Crossings are computed in at most `rounds` rounds, until a sequence is about as good as
        possible, or has the given share of the single points' stiffness.
        """
        self._repeats = ROUTE.repeats if not any_will_do else ROUTE.few_repeats
        hope = self._hope()
        best = self._best_of_ends(0, hope, share, any_will_do)
        if best is None or not (any_will_do or self._is_enough(best, hope, share)):
            self._add_crossings()
            best = self._best_of_ends(rounds, hope, share, any_will_do)
        return None if best is None else self._route(best)

    def _best_of_ends(
        self, rounds: int, hope: _Sequence, share: float | None, any_will_do: bool
    ) -> _Sequence | None:
        found: list[_Sequence] = []
        for end in self._ends:
            self._hold(end)
            one = self._best(rounds, hope, share, any_will_do)
            found += [] if one is None else [one]
        self._hold(None)
        return max(found, key=lambda each: (each.worst, each.mean), default=None)

    def _best(
        self, rounds: int, hope: _Sequence, share: float | None, any_will_do: bool
    ) -> _Sequence | None:
        known = self._sequence(computed=True)
        for _ in range(rounds):
            if known is not None and self.first is None:
                self.first = self._route(known)
            if known is not None and (any_will_do or self._is_enough(known, hope, share)):
                return known
            hoped = self._sequence()
            if hoped is None:
                return None
            unknown = [each for each in hoped.links if not self._links.known[each]]
            if not unknown or (known is not None and self._is_enough(known, hoped, None)):
                return known
            for number in unknown:
                checkpoint()
                self._compute(number)
            if any(number in self._links.between for number in unknown):
                known = self._sequence(computed=True)
        return known

    def _hold(self, end: int | None) -> None:
        """Restrict sequences to begin and end with one candidate of the first point; None: any."""
        self._usable = self._values
        if end is not None:
            self._usable = self._values.copy()
            for first, last in (self._first[:2], self._first[-2:]):
                self._usable[first:last] = -np.inf
                self._usable[first + end] = self._values[first + end]

    def _is_enough(self, known: _Sequence, hoped: _Sequence, share: float | None) -> bool:
        """Whether a sequence has the given share (by default nearly all) of the hoped stiffness."""
        over = self._over == "worst"
        gain = hoped.worst - known.worst if over else hoped.mean - known.mean
        if share is not None:
            return gain < -math.log(share)
        on_average = hoped.mean - known.mean
        return gain < ROUTE.hardly and (not over or on_average < ROUTE.hardly_on_average)

    def _hope(self) -> _Sequence:
        """Return an upper bound of all sequences."""
        best = np.maximum.reduceat(self._values, self._first[:-1])
        return _Sequence(0, [], float(best.min()), float(best.mean()))

    def comes_up_to(self, route: Route | None, share: float) -> bool:
        """Whether a sequence has this share of the upper bound, the single points' stiffness."""
        hope = self._hope()
        best = hope.worst if self._over == "worst" else hope.mean
        return route is not None and route.value(self._over) > best + np.log(share)

    def beginning(self) -> list[PathCandidate]:
        """Return the longest sequence of candidates from the first point on."""
        links: list[int] = []
        for _ in range(ROUTE.repeats):
            reached, last = self._reached(-np.inf, bottleneck=False, computed=True)
            known = np.flatnonzero(np.isfinite(reached))
            known = known[self._point[known] == self._point[known[-1]]]
            at = int(known[reached[known].argmax()])
            links = []
            while at >= self._first[1]:
                links.append(int(last[at]))
                at = int(self._links.origin[links[-1]])
            links.reverse()
            if not self._drops_blocked(links):
                break
        else:  # the part of the last one up to the first blocked link
            kept = [self._links.worst[each] > -np.inf for each in links]
            links = links[: kept.index(False)]
        return self._route(_Sequence(at, links, -np.inf, 0.0)).candidates

    def gaps(self, best: Route | None, attempt: int) -> list[range]:
        """Return regions of the path in which no steps lead from candidate to candidate.

        Only candidates count with which a sequence would be better than the best one so far.  In
        the first attempt a region is where those that end and those that go on are nearest to each
        other; later it has all points where there are both.  It is long enough for a change
        between any two, and longer in later attempts.
        """
        alone = np.maximum.reduceat(self._values, self._first[:-1])
        bar = np.full(len(alone), -np.inf)
        if best is not None and self._over == "worst":
            found = best.value("worst")
            bar[:] = found + ROUTE.better * (alone.min() - found)
        elif best is not None:
            bar = alone - (alone.mean() - best.value("mean")) / ROUTE.better
        usable = self._values >= bar[self._point]
        widest = self._tasks.unit / np.median(self._steps, axis=0)
        margin = ROUTE.widths[attempt] * max(ROUTE.margin, math.ceil(2 * widest.max()))
        count = len(self._first) - 1
        regions: list[range] = []
        (ends, before), (begins, after) = (self._breaks(usable, way) for way in (1, -1))
        for begin, end in zip(begins[::-1], ends, strict=False):
            if begin + 1 < end and not attempt:
                begin = end = self._nearest(range(begin + 1, end), before, after)
            first, last = sorted((begin, end))
            begin, stop = max(0, first - margin), min(count, last + margin + 1)
            if regions and begin <= regions[-1].stop:
                regions[-1] = range(regions[-1].start, max(stop, regions[-1].stop))
            else:
                regions.append(range(begin, stop))
        return regions or [range(count)]

    def _nearest(self, points: range, before: NDArray[np.bool_], after: NDArray[np.bool_]) -> int:
        """Return the point at which two sets of candidates are nearest to each other."""
        apart = []
        for point in points:
            own = slice(self._first[point], self._first[point + 1])
            x = self._pressures[own]
            gaps = np.abs(x[before[own]][:, np.newaxis] - x[after[own]]).max(axis=2)
            apart.append(gaps.min(initial=np.inf))
        return points[int(np.argmin(apart))]

    def _breaks(self, usable: NDArray[np.bool_], way: int) -> tuple[list[int], NDArray[np.bool_]]:
        """Return the points at which every sequence of usable candidates has ended.

        They are counted from the first point (`way` 1) or the last (-1), anew after each.  The
        second array marks the candidates that are on a sequence.
        """
        links, count = self._links, len(self._first) - 1
        is_step = self._point[links.goal] == self._point[links.origin] + 1
        is_step &= links.known & (links.worst > -np.inf)
        origin, goal = links.origin[is_step], links.goal[is_step]
        heads = np.searchsorted(goal, self._first)
        alive, found = usable.copy(), []
        for k in range(1, count) if way > 0 else range(count - 1, 0, -1):
            some = slice(heads[k], heads[k + 1])
            before, after = origin[some], goal[some]
            point = k if way > 0 else k - 1
            if way < 0:
                before, after = after, before
            came = np.zeros(len(alive), bool)
            came[after[alive[before]]] = True
            own = slice(self._first[point], self._first[point + 1])
            if (came[own] & usable[own]).any():
                alive[own] &= came[own]
            else:
                found.append(point)
        return found, alive

    def relaxed(self, route: Route, fixed: Sequence[int]) -> Route:
        """Return a sequence whose points are moved one by one, each between its neighbours.

        A point moves to a local optimum that the rates allow, if the body keeps clear on the way.
        """
        found = list(route.candidates)
        best = np.maximum.reduceat(self._values, self._first[:-1])
        movable = np.ones(len(found), dtype=bool)
        movable[list(fixed)] = False
        for _ in range(ROUTE.sweeps if self._tasks.is_compiled else 0):
            checkpoint()
            values = np.array([each.value for each in found])
            poor = movable & (values < best - ROUTE.hardly / 2)
            moved = np.zeros(len(found), dtype=bool)
            for odd in (0, 1):
                points = np.flatnonzero(poor[odd::2]) * 2 + odd
                moved[points] = self._move(found, points.tolist())
            movable = np.zeros(len(found), dtype=bool)
            for aside in (slice(1, None), slice(0, -1)), (slice(0, -1), slice(1, None)):
                movable[aside[0]] |= moved[aside[1]]
            movable |= moved
            movable[list(fixed)] = False
            if not moved.any():
                break
        return Route(found, route.crossings)

    def _move(self, found: list[PathCandidate], points: Sequence[int]) -> list[bool]:
        """Move some points of a sequence, in place, if they become stiffer; return which moved."""
        p, steps, tasks = [each.pressures for each in found], self._steps, self._tasks
        questions = []
        for k in points:
            lower, upper = tasks.lower, tasks.upper
            for other, step in ((k - 1, k - 1), (k + 1, k)):
                if 0 <= other < len(p):
                    lower = np.maximum(lower, p[other] - steps[step])
                    upper = np.minimum(upper, p[other] + steps[step])
            questions.append(Local(k, np.clip(p[k], lower, upper), lower, upper))
        moved = []
        for k, new in zip(points, tasks.locals(questions), strict=True):
            is_better = new is not None and new.value > found[k].value + ROUTE.hardly / 10
            if new is not None and is_better and self._body is not None:
                way = [*p[max(k - 1, 0) : k], new.pressures, *p[k + 1 : k + 2]]
                is_better = self._body.motion(np.array(way)).clear
            if new is not None and is_better:
                found[k] = new
            moved.append(is_better)
        return moved

    # -- dynamic programming ------------------------------------------------------------------

    def _set_links(self, links: _Links) -> None:
        self._links = links
        self._begin = np.searchsorted(links.goal, np.arange(len(self._values) + 1))

    def _sequence(self, *, computed: bool = False) -> _Sequence | None:
        """Return the best sequence, of computed links alone if asked; None if there is none.

        The body keeps clear of the scene along its computed links.
        """
        for _ in range(self._repeats):
            checkpoint()
            found = self._unchecked_sequence(computed)
            if found is None or not self._drops_blocked(found.links):
                return found
        return None

    def _drops_blocked(self, numbers: Sequence[int]) -> bool:
        """Exclude links on which the body does not keep clear; return whether there were any."""
        links, blocked = self._links, False
        for number in numbers:
            if self._body is None or links.checked[number] or not links.known[number]:
                continue
            between = [each.pressures for each in links.between.get(number, [])]
            ends = self._pressures[[links.origin[number], links.goal[number]]]
            links.checked[number] = True
            if not self._body.motion(np.array([ends[0], *between, ends[1]])).clear:
                blocked = True
                self._exclude(np.array([number]))
                if not between:
                    self._exclude_others(int(self._point[links.origin[number]]))
        return blocked

    def _exclude_others(self, point: int) -> None:
        """Exclude steps from a point half-way along which the body is too near."""
        assert self._body is not None
        links = self._links
        is_step = (self._point[links.origin] == point) & (self._point[links.goal] == point + 1)
        steps = np.flatnonzero(is_step & ~links.checked)
        middle = (self._pressures[links.origin[steps]] + self._pressures[links.goal[steps]]) / 2
        if len(steps):
            self._exclude(steps[~self._body.are_clear(middle)])

    def _exclude(self, numbers: Indices) -> None:
        links = self._links
        links.checked[numbers] = True
        links.worst[numbers] = links.total[numbers] = -np.inf

    def _unchecked_sequence(self, computed: bool) -> _Sequence | None:
        if self._over == "mean":
            return self._traced(-np.inf, computed=computed)
        worst, _ = self._reached(-np.inf, bottleneck=True, computed=computed)
        best = float(worst[self._first[-2] :].max(initial=-np.inf))
        if not np.isfinite(best):
            return None
        found = self._traced(best - 1e-9, computed=computed)
        return found and found._replace(worst=best)

    def _reached(
        self, least: float, *, bottleneck: bool, computed: bool = False
    ) -> tuple[Vector, Indices]:
        """Return for each candidate the best sequence to it: its worst value or sum, its last link.

        All values of a sequence are at least `least`.
        """
        links = self._links
        own = np.where(self._usable >= least, self._usable, -np.inf)
        found, last = np.empty(len(own)), np.zeros(len(own), dtype=np.intp)
        first, origin, goal = int(self._first[1]), links.origin, links.goal
        price = links.worst if bottleneck else links.total
        if self._code is not None:
            usable = links.known if computed else np.ones_like(links.known)
            arrays = (self._begin, origin, usable, links.worst, price, own, found, last)
            self._code.cdll.stiffopt_reached(
                *map(ctypes.c_int64, (bottleneck, first, len(own))),
                ctypes.c_double(least),
                *(ctypes.c_void_p(each.ctypes.data) for each in arrays),
            )
            return found, last
        price = np.where((links.worst >= least) & (links.known | (not computed)), price, -np.inf)
        join = np.minimum if bottleneck else np.add
        came = np.full(len(own), -np.inf)
        found[:] = -np.inf
        found[:first] = own[:first]
        for some, runs, goals in links.sorted_by_point(self._first):
            came[goals] = np.maximum.reduceat(join(found[origin[some]], price[some]), runs)
            found[goals] = join(came[goals], own[goals])
        best = np.flatnonzero(join(found[origin], price) == came[goal])[::-1]
        last[goal[best]] = best
        return found, last

    def _traced(self, least: float, *, computed: bool = False) -> _Sequence | None:
        """Return the sequence with the largest sum of values that are all at least `least`."""
        reached, last = self._reached(least, bottleneck=False, computed=computed)
        at = int(self._first[-2] + reached[self._first[-2] :].argmax())
        if not np.isfinite(reached[at]):
            return None
        mean = float(reached[at]) / (len(self._first) - 1)
        links: list[int] = []
        while at >= self._first[1]:
            links.append(int(last[at]))
            at = int(self._links.origin[links[-1]])
        return _Sequence(at, links[::-1], -np.inf, mean)

    def _route(self, found: _Sequence) -> Route:
        candidates = [self._candidates[found.first]]
        crossings = 0
        for each in found.links:
            between = self._links.between.get(each, [])
            candidates += [*between, self._candidates[self._links.goal[each]]]
            crossings += bool(between)
        return Route(candidates, crossings)

    # -- steps and crossings ----------------------------------------------------------------------

    def _all_steps(self) -> _Links:
        """Return the steps from point to point that the rates allow."""
        origins, goals = [_NONE], [_NONE]
        first = self._first.tolist()
        for a, b, c, step in zip(first[:-2], first[1:-1], first[2:], self._steps, strict=True):
            most = step * (1 + RATES.rounding) + 1e-9
            own, others = self._pressures[b:c].T, self._pressures[a:b].T
            after, before = (np.abs(own[0][:, np.newaxis] - others[0]) <= most[0]).nonzero()
            for channel in range(1, len(most)):
                fits = np.abs(own[channel][after] - others[channel][before]) <= most[channel]
                after, before = after[fits], before[fits]
            origins.append(a + before)
            goals.append(b + after)
        return _Links.steps(np.concatenate(origins), np.concatenate(goals))

    def _add_crossings(self) -> None:
        """Add crossings from some points between candidates that are too far apart for a step."""
        count = len(self._first) - 1
        reach = np.concatenate([np.zeros((1, len(self._tasks.unit))), self._steps.cumsum(axis=0)])
        widest = np.ptp(self._pressures, axis=0)
        origins, goals = [_NONE], [_NONE]
        for begin in range(0, count - 2, max(1, count // ROUTE.crossings)):
            checkpoint()
            lengths = np.arange(2, count - begin)
            limits = np.maximum((reach[begin + 2 :] - reach[begin]) * ROUTE.within, 1e-9)
            most = (widest / limits).max(axis=1) * lengths  # steps, by the widest apart
            longest = lengths[np.ceil(max(ROUTE.lengths) * np.maximum(most, 1.0)) >= lengths]
            every = 1 + longest.max(initial=2) // ROUTE.ends
            some = slice(0, longest.max(initial=1) - 1, every)
            origin = np.arange(self._first[begin], self._first[begin + 1])
            before, after = self._pairs(begin, origin, lengths[some], limits[some], every)
            origins.append(before)
            goals.append(after)
        new = self._guessed(np.concatenate(origins), np.concatenate(goals))
        self._set_links(self._links.with_crossings(new))

    def _pairs(
        self, begin: int, origin: Indices, lengths: Indices, limits: Vector, every: int
    ) -> tuple[Indices, Indices]:
        """Choose crossings from candidates of one point; return their origins and goals.

        `lengths` are in points, spaced by `every`; `limits` are the changes that they allow.
        """
        goal = np.flatnonzero(np.isin(self._point, begin + lengths))
        at = (self._point[goal] - begin - 2) // every
        length, limit = lengths[at], limits[at]
        before, after = [_NONE], [_NONE]
        for is_lane in (False, True):
            own = origin[self._is_lane[origin] == is_lane]
            # crossings end at local optima, unless the mean counts
            others = np.flatnonzero(~self._is_lane[goal] | (not is_lane or self._over == "mean"))
            if not len(own) or not len(others):
                continue
            # number of steps needed, if all allow the same change
            needed = np.zeros((len(own), len(others)))
            columns = self._pressures[own].T, self._pressures[goal[others]].T, limit[others].T
            for a, b, most in zip(*columns, strict=True):
                np.maximum(needed, np.abs(a[:, np.newaxis] - b) / most, out=needed)
            needed *= length[others]
            for more in ROUTE.lengths:
                wanted = np.ceil(more * np.maximum(needed, 1.0))
                fits = (wanted <= length[others]) & (wanted > length[others] - every)
                rank = np.where(fits & (needed > 1), needed, np.inf)
                few = min(ROUTE.nearest, rank.shape[1]) - 1
                nearest = np.argpartition(rank, few, axis=1)[:, : few + 1]
                row, column = np.isfinite(np.take_along_axis(rank, nearest, 1)).nonzero()
                before.append(own[row])
                after.append(goal[others[nearest[row, column]]])
        return np.concatenate(before), np.concatenate(after)

    def _guessed(self, origin: Indices, goal: Indices) -> _Links:
        """Return crossings with values estimated from their ends."""
        values = self._values
        between = self._point[goal] - self._point[origin] - 1
        worst = np.minimum(values[origin], values[goal]) - ROUTE.price
        total = between * ((values[origin] + values[goal]) / 2 - ROUTE.price)
        known, checked = np.zeros((2, len(goal)), dtype=bool)
        return _Links(origin, goal, worst, total, known, checked)

    def _compute(self, number: int) -> None:
        """Compute the values along a crossing; minus infinity if it cannot be followed."""
        links = self._links
        origin, goal = links.origin[number], links.goal[number]
        begin, end = int(self._point[origin]), int(self._point[goal])
        start, last = self._pressures[origin], self._pressures[goal]
        between = crossed(self._tasks, begin, start, last, self._steps[begin:end])
        links.known[number] = True
        links.worst[number] = links.total[number] = -np.inf
        if between is not None:
            values = [each.value for each in between]
            links.between[number] = between
            links.worst[number] = min(values) - ROUTE.price
            links.total[number] = sum(values) - ROUTE.price * len(values)


def crossed(
    tasks: PathTasks, begin: int, start: Vector, goal: Vector, steps: Vector
) -> list[PathCandidate] | None:
    """Return candidates at the points between point `begin`, at pressures `start`, and the goal.

    At each point these are the stiffest pressures from which the goal is still within reach of the
    remaining steps; `steps` (k, n) are the largest.  None if the tip cannot stay on the path.
    """
    found: list[PathCandidate] = []
    here = start
    for k in range(len(steps) - 1):
        left = steps[k + 1 :].sum(axis=0) * ROUTE.within
        lower = np.maximum(np.maximum(here - steps[k], goal - left), tasks.lower)
        upper = np.minimum(np.minimum(here + steps[k], goal + left), tasks.upper)
        if (lower > upper).any():
            return None
        guess = np.clip(here + (goal - here) / (len(steps) - k), lower, upper)
        (candidate,) = tasks.locals([Local(begin + k + 1, guess, lower, upper)])
        if candidate is None:
            return None
        found.append(candidate)
        here = candidate.pressures
    if (np.abs(goal - here) > steps[-1] * (1 + RATES.rounding) + 1e-9).any():
        return None
    return found
