"""Find the best sequence of linked candidates, one at each point, by dynamic programming."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.compiled import Library, compiling_at_once, library
from stiffopt.paths.links import Indices, Layers, Links

_SOURCES = (str(Path(__file__).with_name("native") / "route.c"),)


@lru_cache(maxsize=1)
def compiled() -> Library | None:
    """Return machine code of the dynamic programming, which takes little time to compile."""
    with compiling_at_once():
        return library("routes", list, _SOURCES)


class LinkedSequence(NamedTuple):
    """A sequence: its first candidate, its links in order, worst value (if it counts) and mean."""

    first: int
    links: list[int]
    worst: float
    mean: float


class Sequences:
    """All sequences of linked candidates.

    Parameters
    ----------
    code : machine code, or None.

    Attributes
    ----------
    usable : (m,), values of the candidates that sequences may use; minus infinity for the others.
    """

    def __init__(self, layers: Layers, links: Links, code: Library | None) -> None:
        self._layers, self.code = layers, code
        self.usable = layers.values
        self.use(links)

    def use(self, links: Links) -> None:
        """Replace the links."""
        self.links = links
        self._begin = np.searchsorted(links.goal, np.arange(len(self.usable) + 1))

    def hold(self, end: int | None) -> None:
        """Restrict sequences to begin and end with one candidate of the first point; None: any."""
        values = self._layers.values
        self.usable = values
        if end is not None:
            self.usable = values.copy()
            for own in (self._layers.at(0), self._layers.at(-1)):
                self.usable[own] = -np.inf
                self.usable[own.start + end] = values[own.start + end]

    def best(self, over: str, computed: bool) -> LinkedSequence | None:
        """Return the best sequence, of computed links alone if asked; None if there is none."""
        least = best = -np.inf
        if over == "worst":
            worst, _ = self._reached(-np.inf, bottleneck=True, computed=computed)
            best = float(worst[self._layers.at(-1)].max(initial=-np.inf))
            if not np.isfinite(best):
                return None
            least = best - 1e-9
        reached, last = self._reached(least, bottleneck=False, computed=computed)
        ends = self._layers.at(-1)
        at = int(ends.start + reached[ends].argmax())
        if not np.isfinite(reached[at]):
            return None
        return self._traced(at, last, best, float(reached[at]) / len(self._layers))

    def longest(self) -> LinkedSequence:
        """Return the longest sequence of computed links from the first point on."""
        reached, last = self._reached(-np.inf, bottleneck=False, computed=True)
        known = np.flatnonzero(np.isfinite(reached))
        known = known[self._layers.point[known] == self._layers.point[known[-1]]]
        return self._traced(int(known[reached[known].argmax()]), last, -np.inf, 0.0)

    def _traced(self, at: int, last: Indices, worst: float, mean: float) -> LinkedSequence:
        """Return the sequence that ends with a candidate, from the last link to each."""
        links: list[int] = []
        while at >= self._layers.first[1]:
            links.append(int(last[at]))
            at = int(self.links.origin[links[-1]])
        return LinkedSequence(at, links[::-1], worst, mean)

    def _reached(self, least: float, *, bottleneck: bool, computed: bool) -> tuple[Array, Indices]:
        """Return for each candidate the best sequence to it: its worst value or sum, its last link.

        All values of a sequence are at least `least`.
        """
        links, first, begin = self.links, self._layers.first, self._begin
        own = np.where(self.usable >= least, self.usable, -np.inf)
        found, last = np.empty(len(own)), np.zeros(len(own), dtype=np.intp)
        price = links.worst if bottleneck else links.total
        usable = links.known if computed else np.ones_like(links.known)
        if self.code is not None:
            arrays = (begin, links.origin, usable, links.worst, price, own, found, last)
            self.code.cdll.stiffopt_reached(
                *map(ctypes.c_int64, (bottleneck, int(first[1]), len(own))),
                ctypes.c_double(least),
                *(ctypes.c_void_p(each.ctypes.data) for each in arrays),
            )
            return found, last
        price = np.where((links.worst >= least) & usable, price, -np.inf)
        join = np.minimum if bottleneck else np.add
        came = np.full(len(own), -np.inf)
        found[:] = -np.inf
        found[: first[1]] = own[: first[1]]
        for start, stop in pairwise(first[1:].tolist()):
            some = slice(begin[start], begin[stop])
            values = join(found[links.origin[some]], price[some])
            np.maximum.at(came, links.goal[some], values)
            found[start:stop] = join(came[start:stop], own[start:stop])
        best = np.flatnonzero(join(found[links.origin], price) == came[links.goal])[::-1]
        last[links.goal[best]] = best
        return found, last
