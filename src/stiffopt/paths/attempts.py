"""Search for the best sequences of candidates in several attempts, each with further candidates."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stiffopt.arrays import Array
from stiffopt.paths.gaps import gaps
from stiffopt.paths.lanes import lanes
from stiffopt.paths.points import PathCandidate, PathTasks
from stiffopt.paths.quickening import quickened, share_of
from stiffopt.paths.refinement import refined
from stiffopt.paths.relaxation import relaxed
from stiffopt.paths.route import Route, RouteSearch
from stiffopt.paths.settings import ROUTE


class RouteAttempts:
    """Searches for sequences, with further candidates if local optima do not suffice.

    Pressures are given at the `given` points; other arguments are those of `RouteSearch`.

    `alone`: (N,), largest values of the local optima; not a number where there is none.
    """

    def __init__(
        self,
        tasks: PathTasks,
        layers: Sequence[Sequence[PathCandidate]],
        over: str,
        given: set[int],
        is_closed: bool,
    ) -> None:
        self._tasks, self._over = tasks, over
        self._layers = [list(layer) for layer in layers]
        self._given, self._is_closed = given, is_closed
        self._fixed = {0, len(tasks) - 1} if is_closed else given  # when points move one by one
        self.alone = np.array([max((c.value for c in layer), default=np.nan) for layer in layers])
        self._further: list[list[PathCandidate]] = [[] for _ in layers]

    def best(self, steps: Array, *, any_will_do: bool = False) -> list[Route]:
        """Return the best sequences within steps (N - 1, n), the best first, or none.

        There are several only if another one, once refined, may become better than the best.
        """
        if not all(self._layers):
            return []
        tasks, has_scene = self._tasks, self._tasks.scene is not None
        known: list[Route] = []
        is_last = any_will_do
        for attempt in range(len(ROUTE.widths) + 1):
            search = self._search(steps)
            alone = search.layers.best  # further candidates included
            rounds = ROUTE.first_rounds
            if is_last and not any_will_do:
                rounds = ROUTE.rounds
                if has_scene:
                    rounds = ROUTE.few_rounds if known else ROUTE.rounds_in_scene
            share = ROUTE.enough if attempt else None
            best = search.best(rounds, share=share, any_will_do=any_will_do)
            if best is not None:
                best = relaxed(tasks, best, steps, alone, self._fixed)
                if any_will_do or best.comes_up_to(ROUTE.enough, alone, self._over):
                    return [best]
            known += [each for each in (best, search.first) if each is not None]
            known.sort(key=lambda each: -each.value(self._over))
            if is_last:
                break
            value = known[0].value(self._over) if known else None
            change = float((tasks.unit / np.median(steps, axis=0)).max())
            regions = gaps(search.layers, search.links, self._over, value, change, attempt)
            is_whole = len(regions[0]) == len(tasks)
            is_last = attempt == len(ROUTE.widths) - 1 or (attempt > 0 and is_whole)
            self._add_lanes(regions, attempt, is_last, known[0] if known else None)
        return known[: 1 if has_scene else ROUTE.refined]

    def slower(self, steps: Array) -> tuple[float, list[Route]]:
        """Find a small slow-down with which the path can be followed, and how; 1 if none is needed.

        Any sequence will do at first; it is then quickened as a whole.
        """
        few = ROUTE.few_further  # with long steps, every candidate has steps to every other
        self._further = [some[:: 1 + len(some) // few] for some in self._further]
        most, factor = float((self._tasks.unit / steps).max()), 1.0
        routes: list[Route] = []
        while not routes and factor < most:
            factor = min(2 * factor, most)
            routes = self.best(steps * factor, any_will_do=True)
        if not routes:
            return factor, []
        own = quickened(self._tasks, routes[0].candidates, steps, self._given, self._is_closed)
        routes = [replace(routes[0], candidates=own)]
        for index, each in enumerate(own):
            if index in self._fixed:
                self._layers[index].append(each)
            else:
                self._further[index].append(each)
        factor = max(1.0, share_of(steps, routes[0].pressures))
        best = self._search(steps * factor).best(ROUTE.first_rounds)
        if best is None:
            return factor, routes
        return factor, [relaxed(self._tasks, best, steps * factor, self.alone, self._fixed)]

    def refined(self, routes: Sequence[Route], steps: Array) -> tuple[Route, Array]:
        """Return the sequence that is best when refined, and its pressures.

        Others are refined only if the first does not become about as stiff as single points.
        """
        tasks, join = self._tasks, np.min if self._over == "worst" else np.mean
        found: list[tuple[float, Route, Array]] = []
        for route in routes:
            if route.comes_up_to(ROUTE.nearly_all, self.alone, self._over):
                return route, route.pressures
            pressures = refined(tasks, route.pressures, steps, self._over, self._fixed)
            slopes = tasks.slopes(range(len(tasks)), pressures)
            value = -np.inf if slopes is None else float(join(-slopes.costs.max(axis=1)))
            found.append((value, route, pressures))
            if value > join(self.alone) + np.log(ROUTE.enough):
                break
        return max(found, key=lambda each: each[0])[1:]

    def beginning(self, steps: Array) -> list[PathCandidate]:
        """Return the longest sequence of candidates from the first point on."""
        return self._search(steps).beginning()

    def clearance_beyond(self, last: PathCandidate, point: int, step: Array) -> float | None:
        """Return the largest clearance with which steps (n,) go on from a candidate at a point.

        None without a scene, or if the rates allow no step.
        """
        p, body = last.pressures, self._tasks.body
        next_ones = [*self._layers[point + 1], *self._further[point + 1]]
        near = [q for q, _ in next_ones if (np.abs(q - p) <= step).all()]
        if body is None or not near:
            return None
        return max(body.motion(np.array([p, q])).least for q in near)

    def _search(self, steps: Array) -> RouteSearch:
        """Return a search over local optima and the further candidates that there are."""
        return RouteSearch(
            self._tasks, self._layers, steps, self._over, self._further, self._is_closed
        )

    def _add_lanes(
        self, regions: Sequence[range], attempt: int, is_last: bool, known: Route | None
    ) -> None:
        """Add further candidates in regions of the path, none where the pressures are given.

        They replace earlier ones once a sequence is known, which is kept.
        """
        least = -np.inf
        if known is not None:
            self._further = [[] for _ in self._layers]
            least = known.value("worst") if self._over == "worst" else least
        for region in regions:
            new = lanes(self._tasks, self._layers, region, attempt, is_last)
            for index, some in enumerate(new):
                if index not in self._fixed:
                    self._further[index] += [each for each in some if each.value > least]
        for some, each in zip(self._further, known.candidates if known else (), strict=False):
            some.append(each)
