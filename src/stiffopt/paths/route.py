"""The best sequence of candidates, one at each point, whose steps keep the rates.

Candidates whose step is within the rates may follow each other.  Between others there are
crossings: some steps in which the pressures go from one to the other at full rate while the tip
stays on the path.  How stiff the arm is on a crossing is computed only for those that a best
sequence would use; until then a crossing counts as good as its ends.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.stopping import checkpoint
from stiffopt.paths.points import Local, PathCandidate, PathTasks
from stiffopt.paths.settings import RATES, ROUTE

Vector = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass
class _Crossings:
    """Crossings in the order of the points where they end; arrays have a value for each.

    Attributes
    ----------
    begin, a : from which candidate of which point.
    end, b : to which.
    worst, total : values on the way; until a crossing is computed they are guessed.
    between : the candidates at the points between, of those that are computed.
    """

    begin: Indices
    a: Indices
    end: Indices
    b: Indices
    worst: Vector
    total: Vector
    between: dict[int, list[PathCandidate]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.known = np.zeros(len(self.begin), dtype=bool)


@dataclass
class Route:
    """Candidates in order, one at each point.

    Attributes
    ----------
    candidates : list of PathCandidate
    crossings : number of crossings from branch to branch.
    """

    candidates: list[PathCandidate]
    crossings: int

    def value(self, over: str) -> float:
        """Its worst value, or its mean."""
        values = [each.value for each in self.candidates]
        return float(min(values) if over == "worst" else np.mean(values))


class _Sequence(NamedTuple):
    """Candidates (point, number) and numbers of crossings in order; worst value and mean."""

    steps: list[tuple[int, int] | int]
    worst: float
    mean: float


@dataclass
class _Best:
    """Of the best sequences to each candidate: value, and where it came from.

    `before` counts candidates of the point before, and crossings as ``-1 - number``.
    """

    values: list[Vector] = field(default_factory=list)
    before: list[Indices] = field(default_factory=list)


def steps_are_kept(pressures: Vector, steps: Vector) -> bool:
    """Whether pressures (N, n) change by no more than steps (N - 1, n) from point to point."""
    return bool((np.abs(np.diff(pressures, axis=0)) <= steps * (1 + RATES.rounding) + 1e-9).all())


class RouteSearch:
    """Search for the best sequence.

    Parameters
    ----------
    tasks : PathTasks
    layers : list of list of PathCandidate
        At each of N points.
    steps : (N - 1, n)
        Largest changes of pressure from point to point, in Pa.
    over : "worst" or "mean"
        Which value along the path counts.
    """

    def __init__(
        self, tasks: PathTasks, layers: list[list[PathCandidate]], steps: Vector, over: str
    ) -> None:
        self._tasks, self._layers, self._steps, self._over = tasks, layers, steps, over
        self._values = [np.array([each.value for each in layer]) for layer in layers]
        self._pressures = [
            np.array([each.pressures for each in layer]).reshape(len(layer), len(tasks.unit))
            for layer in layers
        ]
        # from each candidate (columns) to each of the next point (rows): 0, or -inf
        self._bars = [
            _bars(before, after, step * (1 + RATES.rounding) + 1e-9)
            for before, after, step in zip(
                self._pressures[:-1], self._pressures[1:], steps, strict=True
            )
        ]
        self._first = np.cumsum([0, *map(len, layers)])  # candidate of each point, of all
        none, nothing = np.zeros(0, dtype=np.intp), np.zeros(0)
        self._crossings = _Crossings(none, none, none, none, nothing, nothing)

    def best(self, rounds: int = ROUTE.rounds, *, any_will_do: bool = False) -> Route | None:
        """The best sequence, or any; None if there is none.

        Crossings are computed in so many rounds; without any, only steps from candidate to
        candidate count.
        """
        direct = self._sequence()
        if (
            not rounds
            or (direct is not None and any_will_do)
            or (direct is not None and self._is_about(direct, self._hope()))
        ):
            return None if direct is None else self._route(direct)
        self._crossings = self._all_crossings()
        for _ in range(rounds):
            hoped = self._sequence()
            if hoped is None:
                return None
            used = [each for each in hoped.steps if isinstance(each, int)]
            unknown = [each for each in used if not self._crossings.known[each]]
            if not unknown:
                return self._route(hoped)
            enough = -np.inf if any_will_do else hoped.worst - ROUTE.hardly
            known = self._sequence(enough, computed=True)
            if known is not None and (any_will_do or self._is_about(known, hoped)):
                return self._route(known)
            for number in unknown:
                checkpoint()
                self._compute(number)
        known = self._sequence(computed=True)
        return None if known is None else self._route(known)

    def _is_about(self, known: _Sequence, hoped: _Sequence) -> bool:
        """Whether a sequence is hardly worse than what is hoped for."""
        if self._over == "worst":
            return (
                known.worst > hoped.worst - ROUTE.hardly
                and known.mean > hoped.mean - ROUTE.hardly_on_average
            )
        return known.mean > hoped.mean - ROUTE.hardly

    def _hope(self) -> _Sequence:
        """What no sequence can be better than."""
        best = [values.max(initial=-np.inf) for values in self._values]
        return _Sequence([], float(min(best)), float(np.mean(best)))

    def comes_up_to(self, route: Route | None, share: float) -> bool:
        """Whether a sequence has this share of what the points alone could have."""
        hope = self._hope()
        best = hope.worst if self._over == "worst" else hope.mean
        return route is not None and route.value(self._over) > best + np.log(share)

    @property
    def furthest(self) -> int:
        """The last point that a sequence comes to."""
        values = self._best(-np.inf, bottleneck=True, computed=True).values
        return max((i for i, each in enumerate(values) if np.isfinite(each).any()), default=0)

    # -- dynamic programming ------------------------------------------------------------------

    def _sequence(self, enough: float = -np.inf, *, computed: bool = False) -> _Sequence | None:
        """The best sequence, maybe of computed crossings alone; None where the worst is less."""
        least = worst = -np.inf
        if self._over == "worst":
            best = self._best(least, bottleneck=True, computed=computed)
            if not np.isfinite(best.values[-1]).any():
                return None
            worst = float(best.values[-1].max())
            if worst < enough:
                return None
            least = worst - 1e-9
        best = self._best(least, bottleneck=False, computed=computed)
        if not np.isfinite(best.values[-1]).any():
            return None
        point, number = len(self._layers) - 1, int(np.argmax(best.values[-1]))
        mean = float(best.values[-1][number]) / len(self._layers)
        found: list[tuple[int, int] | int] = [(point, number)]
        while point:
            came = int(best.before[point][number])
            if came >= 0:
                point, number = point - 1, came
            else:
                found.append(-1 - came)
                point = int(self._crossings.begin[-1 - came])
                number = int(self._crossings.a[-1 - came])
            found.append((point, number))
        return _Sequence(found[::-1], worst, mean)

    def _best(self, least: float, *, bottleneck: bool, computed: bool = False) -> _Best:
        """Best worst value (`bottleneck`), or sum of values that are all at least `least`."""
        best, every = _Best(), np.full(self._first[-1], -np.inf)
        crossings = self._crossings
        usable = np.flatnonzero((crossings.worst >= least) & (crossings.known | (not computed)))
        starts = np.searchsorted(crossings.end[usable], np.arange(len(self._values) + 1))
        origin = self._first[crossings.begin] + crossings.a
        price = crossings.worst if bottleneck else crossings.total
        for point, own in enumerate(self._values):
            values = np.full(len(own), -np.inf if point else np.inf if bottleneck else 0.0)
            before = np.zeros(len(own), dtype=np.intp)
            if point and len(own) and len(best.values[-1]):
                reached = self._bars[point - 1] + best.values[-1]
                before = reached.argmax(axis=1)
                values = reached[np.arange(len(own)), before]
            some = usable[starts[point] : starts[point + 1]]
            if len(some):
                came, passed = every[origin[some]], price[some]
                came = np.minimum(came, passed) if bottleneck else came + passed
                order = np.argsort(came, kind="stable")  # so that the best stays
                over, number = np.full(len(own), -np.inf), np.zeros(len(own), dtype=np.intp)
                goals = crossings.b[some[order]]
                over[goals] = came[order]
                number[goals] = some[order]
                before = np.where(over > values, -1 - number, before)
                values = np.maximum(values, over)
            values = np.minimum(values, own) if bottleneck else values + own
            values = np.where(own >= least, values, -np.inf)
            every[self._first[point] : self._first[point + 1]] = values
            best.values.append(values)
            best.before.append(before)
        return best

    def _route(self, found: _Sequence) -> Route:
        candidates: list[PathCandidate] = []
        crossings = 0
        for each in found.steps:
            if isinstance(each, int):
                candidates += self._crossings.between[each]
                crossings += 1
            else:
                candidates.append(self._layers[each[0]][each[1]])
        return Route(candidates, crossings)

    # -- crossings ------------------------------------------------------------------------------

    def _all_crossings(self) -> _Crossings:
        """Crossings from some points, where candidates are too far apart for a step."""
        count = len(self._layers)
        point = np.repeat(np.arange(count), [len(layer) for layer in self._layers])
        pressures = np.concatenate(self._pressures)
        reach = np.concatenate([np.zeros((1, len(self._tasks.unit))), self._steps.cumsum(axis=0)])
        widest = np.ptp(pressures, axis=0)
        none = np.zeros(0, dtype=np.intp)
        origins, goals = [none], [none]
        for begin in range(0, count - 2, max(1, count // ROUTE.crossings)):
            lengths = np.arange(2, count - begin)
            limits = np.maximum((reach[begin + 2 :] - reach[begin]) * ROUTE.within, 1e-9)
            needed = (widest / limits).max(axis=1) * lengths  # steps, by the widest apart
            longest = lengths[np.ceil(max(ROUTE.lengths) * np.maximum(needed, 1.0)) >= lengths]
            last = begin + longest.max(initial=1)
            later = np.arange(self._first[begin + 2], self._first[last + 1])
            length = point[later] - begin
            for origin in range(self._first[begin], self._first[begin + 1]):
                apart = np.abs(pressures[later] - pressures[origin])
                # steps, if all of them are as large
                needed = np.max(apart / limits[length - 2], axis=1) * length
                for more in ROUTE.lengths:
                    fits = (np.ceil(more * np.maximum(needed, 1.0)) == length) & (needed > 1)
                    nearest = np.flatnonzero(fits)
                    nearest = nearest[np.argsort(needed[nearest], kind="stable")[: ROUTE.nearest]]
                    origins.append(np.full(len(nearest), origin))
                    goals.append(later[nearest])
        return self._guessed(np.concatenate(origins), np.concatenate(goals), point)

    def _guessed(self, origin: Indices, goal: Indices, point: Indices) -> _Crossings:
        """Crossings from candidates to candidates, of all those of all points."""
        order = np.argsort(goal, kind="stable")
        origin, goal = origin[order], goal[order]
        begin, end = point[origin], point[goal]
        values = np.concatenate(self._values)
        mean = (values[origin] + values[goal]) / 2 - ROUTE.price
        return _Crossings(
            begin=begin,
            a=origin - self._first[begin],
            end=end,
            b=goal - self._first[end],
            worst=np.minimum(values[origin], values[goal]) - ROUTE.price,
            total=(end - begin - 1) * mean,
        )

    def _compute(self, number: int) -> None:
        """Follow a crossing; it counts as impossible where that fails."""
        every = self._crossings
        begin, end = int(every.begin[number]), int(every.end[number])
        start, goal = self._pressures[begin][every.a[number]], self._pressures[end][every.b[number]]
        between = crossed(self._tasks, begin, start, goal, self._steps[begin:end])
        every.known[number] = True
        every.between[number] = between or []
        every.worst[number] = every.total[number] = -np.inf
        if between is not None:
            values = [each.value for each in between]
            every.worst[number] = min(values) - ROUTE.price
            every.total[number] = sum(values) - ROUTE.price * len(values)


def _bars(before: Vector, after: Vector, step: Vector) -> Vector:
    """0 where candidates after (rows) may follow those before (columns), -inf elsewhere."""
    may = np.ones((len(after), len(before)), dtype=bool)
    for own, other, most in zip(after.T, before.T, step, strict=True):
        may &= np.abs(own[:, np.newaxis] - other) <= most
    return np.where(may, 0.0, -np.inf)


def crossed(
    tasks: PathTasks, begin: int, start: Vector, goal: Vector, steps: Vector
) -> list[PathCandidate] | None:
    """Candidates at the points between point `begin`, at pressures `start`, and the goal.

    At each point the stiffest pressures are taken from which the goal is still within reach of
    the steps (k, n) that are left.  None where the tip cannot stay on the path on the way.
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
