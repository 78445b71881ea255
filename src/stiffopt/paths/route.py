"""Find the best sequence of candidates, one at each point of a path, within the rates.

Candidates at consecutive points are linked if the rates allow the step.  A crossing links
candidates several points apart: the pressures go from one to the other at full rate while the tip
stays on the path.  Dynamic programming finds the best sequence.  The stiffness along a crossing is
expensive; it is computed only if a best sequence would use the crossing, and until then estimated
from its ends.  Likewise, whether the body keeps clear of a scene between the points is checked
only for links that a best sequence would use.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.stopping import checkpoint
from stiffopt.paths.crossings import crossed, crossings
from stiffopt.paths.links import Layers, Links, all_steps
from stiffopt.paths.points import BodyCheck, PathCandidate, PathTasks
from stiffopt.paths.sequences import LinkedSequence, Sequences, compiled
from stiffopt.paths.settings import ROUTE


@dataclass
class Route:
    """A sequence of candidates, one at each point.

    `crossings`: number of crossings from branch to branch.
    """

    candidates: list[PathCandidate]
    crossings: int

    @property
    def pressures(self) -> Array:
        """Pressures (N, n), in Pa."""
        return np.array([each.pressures for each in self.candidates])

    def value(self, over: str) -> float:
        """Return the worst value of the sequence, or the mean."""
        values = [each.value for each in self.candidates]
        return float(min(values) if over == "worst" else np.mean(values))

    def comes_up_to(self, share: float, alone: Array, over: str) -> bool:
        """Whether it has more than this share of the single points' stiffness, values (N,)."""
        best = float(alone.min() if over == "worst" else alone.mean())
        return self.value(over) > best + math.log(share)


class RouteSearch:
    """Searches for the best sequence of candidates along which the body keeps clear.

    Parameters
    ----------
    tasks : PathTasks
    layers : list of list of PathCandidate
        Local optima at each of N points.
    steps : (N - 1, n), largest changes of pressure from point to point, in Pa.
    over : "worst" or "mean"
        Which value along the path to maximise.
    lanes : list of list of PathCandidate, optional
        Further candidates at each point.
    is_closed : whether sequences end with the pressures with which they begin.

    Attributes
    ----------
    layers : Layers
    first : the first sequence that `best` found, which may be worse than what it returns.
    """

    def __init__(
        self,
        tasks: PathTasks,
        layers: Sequence[Sequence[PathCandidate]],
        steps: Array,
        over: str,
        lanes: Sequence[Sequence[PathCandidate]] | None = None,
        is_closed: bool = False,
    ) -> None:
        self._tasks, self._steps, self._over = tasks, steps, over
        if is_closed:
            layers = [*layers[:-1], layers[0]]
        self._ends: Sequence[int | None] = range(len(layers[0])) if is_closed else [None]
        self.layers = Layers(layers, lanes or [[] for _ in layers], len(tasks.unit))
        steps_between = all_steps(self.layers, steps)
        code = compiled() if tasks.is_compiled else None
        self._sequences = Sequences(self.layers, steps_between, code)
        self._repeats = ROUTE.repeats
        self.first: Route | None = None

    @property
    def links(self) -> Links:
        """The links between candidates."""
        return self._sequences.links

    def best(
        self, rounds: int = ROUTE.rounds, *, share: float | None = None, any_will_do: bool = False
    ) -> Route | None:
        """Return the best sequence, or any if `any_will_do`; None if there is none.

        Crossings are computed in at most `rounds` rounds, until a sequence is about as good as
        possible, or has the given share of the single points' stiffness.
        """
        self._repeats = ROUTE.repeats if not any_will_do else ROUTE.few_repeats
        best = self._best_of_ends(0, share, any_will_do)
        if best is None or not (any_will_do or self._is_enough(best, self._hope, share)):
            new = crossings(self.layers, self._steps, self._over)
            self._sequences.use(self.links.with_crossings(new))
            best = self._best_of_ends(rounds, share, any_will_do)
        return None if best is None else self._route(best)

    def _best_of_ends(
        self, rounds: int, share: float | None, any_will_do: bool
    ) -> LinkedSequence | None:
        found: list[LinkedSequence] = []
        for end in self._ends:
            self._sequences.hold(end)
            one = self._best(rounds, share, any_will_do)
            found += [] if one is None else [one]
        self._sequences.hold(None)
        return max(found, key=lambda each: (each.worst, each.mean), default=None)

    def _best(self, rounds: int, share: float | None, any_will_do: bool) -> LinkedSequence | None:
        known = self._sequence(computed=True)
        for _ in range(rounds):
            if known is not None and self.first is None:
                self.first = self._route(known)
            if known is not None and (any_will_do or self._is_enough(known, self._hope, share)):
                return known
            hoped = self._sequence(computed=False)
            if hoped is None:
                return None
            unknown = [each for each in hoped.links if not self.links.known[each]]
            if not unknown or (known is not None and self._is_enough(known, hoped, None)):
                return known
            for number in unknown:
                checkpoint()
                self._compute(number)
            if any(number in self.links.between for number in unknown):
                known = self._sequence(computed=True)
        return known

    @property
    def _hope(self) -> LinkedSequence:
        """An upper bound of all sequences."""
        best = self.layers.best
        return LinkedSequence(0, [], float(best.min()), float(best.mean()))

    def _is_enough(self, known: LinkedSequence, hoped: LinkedSequence, share: float | None) -> bool:
        """Whether a sequence has the given share (by default nearly all) of the hoped stiffness."""
        over = self._over == "worst"
        on_average = hoped.mean - known.mean
        gain = hoped.worst - known.worst if over else on_average
        if share is not None:
            return gain < -math.log(share)
        return gain < ROUTE.hardly and (not over or on_average < ROUTE.hardly_on_average)

    def beginning(self) -> list[PathCandidate]:
        """Return the longest sequence of candidates from the first point on."""
        for _ in range(ROUTE.repeats):
            found = self._sequences.longest()
            if not self._drops_blocked(found.links):
                break
        else:  # the part of the last one up to the first blocked link
            kept = [self.links.worst[each] > -np.inf for each in found.links]
            found = found._replace(links=found.links[: kept.index(False)])
        return self._route(found).candidates

    def _sequence(self, *, computed: bool) -> LinkedSequence | None:
        """Return the best sequence, of computed links alone if asked; None if there is none.

        The body keeps clear of the scene along its computed links.
        """
        for _ in range(self._repeats):
            checkpoint()
            found = self._sequences.best(self._over, computed)
            if found is None or not self._drops_blocked(found.links):
                return found
        return None

    def _drops_blocked(self, numbers: Sequence[int]) -> bool:
        """Exclude links on which the body does not keep clear; return whether there were any."""
        links, body, blocked = self.links, self._tasks.body, False
        for number in numbers:
            if body is None or links.checked[number] or not links.known[number]:
                continue
            between = [each.pressures for each in links.between.get(number, [])]
            start, end = self.layers.pressures[[links.origin[number], links.goal[number]]]
            links.checked[number] = True
            if not body.motion(np.array([start, *between, end])).clear:
                blocked = True
                links.exclude(np.array([number]))
                if not between:
                    self._exclude_others(int(self.layers.point[links.origin[number]]), body)
        return blocked

    def _exclude_others(self, point: int, body: BodyCheck) -> None:
        """Exclude steps from a point half-way along which the body is too near."""
        links, at, p = self.links, self.layers.point, self.layers.pressures
        is_step = (at[links.origin] == point) & (at[links.goal] == point + 1)
        steps = np.flatnonzero(is_step & ~links.checked)
        if len(steps):
            middle = (p[links.origin[steps]] + p[links.goal[steps]]) / 2
            links.exclude(steps[~body.are_clear(middle)])

    def _compute(self, number: int) -> None:
        """Compute the values along a crossing; minus infinity if it cannot be followed."""
        links = self.links
        ends = [links.origin[number], links.goal[number]]
        (begin, end), (start, goal) = self.layers.point[ends], self.layers.pressures[ends]
        between = crossed(self._tasks, int(begin), start, goal, self._steps[begin:end])
        links.known[number] = True
        links.worst[number] = links.total[number] = -np.inf
        if between is not None:
            values = [each.value for each in between]
            links.between[number] = between
            links.worst[number] = min(values) - ROUTE.price
            links.total[number] = sum(values) - ROUTE.price * len(values)

    def _route(self, found: LinkedSequence) -> Route:
        candidates = [self.layers.candidates[found.first]]
        count = 0
        for each in found.links:
            between = self.links.between.get(each, [])
            candidates += [*between, self.layers.candidates[self.links.goal[each]]]
            count += bool(between)
        return Route(candidates, count)
