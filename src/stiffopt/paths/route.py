"""The best sequence of candidates, one at each point, whose steps keep the rates.

Candidates whose step is within the rates may follow each other.  Between others there are
crossings: some steps in which the pressures go from one to the other at full rate while the tip
stays on the path.  How stiff the arm is on a crossing is computed only for those that a best
sequence would use; until then a crossing counts as good as its ends.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.stopping import checkpoint
from stiffopt.paths.points import Local, PathCandidate, PathTasks
from stiffopt.paths.settings import RATES, ROUTE

Vector = NDArray[np.float64]


@dataclass(eq=False)
class _Crossing:
    """From candidate `a` of a point to candidate `b` of one `length` steps later.

    `between`: the candidates at the points between, once they are computed.
    """

    begin: int
    a: int
    length: int
    b: int
    worst: float
    total: float
    between: list[PathCandidate] | None = None


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
    """Candidates (point, number) and crossings in order, with their worst value and mean."""

    steps: list[tuple[int, int] | _Crossing]
    worst: float
    mean: float


@dataclass
class _Best:
    """Of the best sequences to each candidate of each point: value, and where it came from."""

    values: list[Vector] = field(default_factory=list)
    before: list[list[tuple[int, int, _Crossing | None] | None]] = field(default_factory=list)


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
        self._may_follow = [
            (np.abs(after - before[:, np.newaxis]) <= step * (1 + RATES.rounding) + 1e-9).all(
                axis=2
            )
            for before, after, step in zip(
                self._pressures[:-1], self._pressures[1:], steps, strict=True
            )
        ]
        self._crossings: dict[int, list[_Crossing]] = {}  # by the point where they end

    def best(self, rounds: int = ROUTE.rounds) -> Route | None:
        """The best sequence; None if there is none.

        Crossings are computed in so many rounds; without any, only steps from candidate to
        candidate count.
        """
        direct = self._sequence()
        if not rounds or (direct is not None and self._is_about(direct, self._hope())):
            return None if direct is None else self._route(direct)
        for crossing in self._all_crossings():
            self._crossings.setdefault(crossing.begin + crossing.length, []).append(crossing)
        for _ in range(rounds):
            hoped = self._sequence()
            if hoped is None:
                return None
            unknown = [c for c in hoped.steps if isinstance(c, _Crossing) and c.between is None]
            if not unknown:
                return self._route(hoped)
            known = self._sequence(computed=True)
            if known is not None and self._is_about(known, hoped):
                return self._route(known)
            for crossing in unknown:
                checkpoint()
                self._compute(crossing)
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

    def _sequence(self, *, computed: bool = False) -> _Sequence | None:
        """The best sequence, maybe of computed crossings alone."""
        least = worst = -np.inf
        if self._over == "worst":
            best = self._best(least, bottleneck=True, computed=computed)
            if not np.isfinite(best.values[-1]).any():
                return None
            worst = float(best.values[-1].max())
            least = worst - 1e-9
        best = self._best(least, bottleneck=False, computed=computed)
        if not np.isfinite(best.values[-1]).any():
            return None
        point, number = len(self._layers) - 1, int(np.argmax(best.values[-1]))
        mean = float(best.values[-1][number]) / len(self._layers)
        found: list[tuple[int, int] | _Crossing] = [(point, number)]
        while (came := best.before[point][number]) is not None:
            point, number, crossing = came
            if crossing is not None:
                found.append(crossing)
            found.append((point, number))
        return _Sequence(found[::-1], worst, mean)

    def _best(self, least: float, *, bottleneck: bool, computed: bool = False) -> _Best:
        """Best worst value (`bottleneck`), or sum of values that are all at least `least`."""
        best = _Best()
        for point, own in enumerate(self._values):
            values = np.where(own >= least, own, -np.inf)
            before: list[tuple[int, int, _Crossing | None] | None] = [None] * len(own)
            if point:
                values = np.full(len(own), -np.inf)
                earlier = best.values[-1]
                if len(own) and len(earlier):
                    reached = np.where(self._may_follow[point - 1].T, earlier, -np.inf)
                    origin = reached.argmax(axis=1)
                    value = reached[np.arange(len(own)), origin]
                    values = np.minimum(value, own) if bottleneck else value + own
                    values = np.where(own >= least, values, -np.inf)
                    before = [(point - 1, int(k), None) for k in origin]
            for crossing in self._crossings.get(point, ()):
                if computed and crossing.between is None:
                    continue
                earlier_value = best.values[crossing.begin][crossing.a]
                if bottleneck:
                    value = min(earlier_value, crossing.worst, own[crossing.b])
                elif crossing.worst < least or own[crossing.b] < least:
                    continue
                else:
                    value = earlier_value + crossing.total + own[crossing.b]
                if value > values[crossing.b]:
                    values[crossing.b] = value
                    before[crossing.b] = (crossing.begin, crossing.a, crossing)
            best.values.append(values)
            best.before.append(before)
        return best

    def _route(self, found: _Sequence) -> Route:
        candidates: list[PathCandidate] = []
        crossings = 0
        for each in found.steps:
            if isinstance(each, _Crossing):
                candidates += each.between or []
                crossings += 1
            else:
                candidates.append(self._layers[each[0]][each[1]])
        return Route(candidates, crossings)

    # -- crossings ------------------------------------------------------------------------------

    def _all_crossings(self) -> Iterator[_Crossing]:
        """Crossings from some points, where candidates are too far apart for a step."""
        count = len(self._layers)
        point = np.repeat(np.arange(count), [len(layer) for layer in self._layers])
        number = np.concatenate([np.arange(len(layer)) for layer in self._layers])
        pressures = np.concatenate(self._pressures)
        reach = np.concatenate([np.zeros((1, len(self._tasks.unit))), self._steps.cumsum(axis=0)])
        for begin in range(0, count - 2, max(1, count // ROUTE.crossings)):
            later = np.flatnonzero(point > begin + 1)
            length = point[later] - begin
            limits = (reach[point[later]] - reach[begin]) * ROUTE.within
            for a, origin in enumerate(self._pressures[begin]):
                apart = np.abs(pressures[later] - origin)
                share = np.max(apart / np.maximum(limits, 1e-9), axis=1)
                needed = share * length  # steps, if all of them are as large
                for more in ROUTE.lengths:
                    fits = (np.ceil(more * np.maximum(needed, 1.0)) == length) & (needed > 1)
                    nearest = np.flatnonzero(fits)[np.argsort(needed[fits], kind="stable")]
                    for k in later[nearest[: ROUTE.nearest]]:
                        yield self._guessed(begin, a, int(point[k]) - begin, int(number[k]))

    def _guessed(self, begin: int, a: int, length: int, b: int) -> _Crossing:
        ends = self._values[begin][a], self._values[begin + length][b]
        mean = sum(ends) / 2 - ROUTE.price
        return _Crossing(begin, a, length, b, min(ends) - ROUTE.price, (length - 1) * mean)

    def _compute(self, crossing: _Crossing) -> None:
        """Follow a crossing; it counts as impossible where that fails."""
        goal = self._pressures[crossing.begin + crossing.length][crossing.b]
        start = self._pressures[crossing.begin][crossing.a]
        steps = self._steps[crossing.begin : crossing.begin + crossing.length]
        between = crossed(self._tasks, crossing.begin, start, goal, steps)
        crossing.between = between or []
        if between is None:
            crossing.worst = crossing.total = -np.inf
            return
        values = [each.value for each in between]
        crossing.worst = min(values) - ROUTE.price
        crossing.total = sum(values) - ROUTE.price * len(values)


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
