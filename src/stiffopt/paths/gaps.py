"""Find the regions of a path in which no steps lead on from candidate to candidate."""

from __future__ import annotations

import math

import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.paths.links import Layers, Links
from stiffopt.paths.points import joined
from stiffopt.paths.settings import ROUTE


def gaps(
    layers: Layers, links: Links, over: str, best: float | None, longest_change: float, attempt: int
) -> list[range]:
    """Return regions of points in which no steps lead from candidate to candidate.

    Only candidates count with which a sequence would be better than the best one so far.  In the
    first attempt a region is where those that end and those that go on are nearest to each other;
    later it has all points where there are both.  It is long enough for a change between any two,
    and longer in later attempts.  `best` is the value of the best sequence so far, and
    `longest_change` the number of steps in which the rates allow any change of pressures.
    """
    bar = np.full(len(layers), -np.inf)
    if best is not None and over == "worst":
        bar[:] = best + ROUTE.better * (layers.best.min() - best)
    elif best is not None:
        bar = layers.best - (layers.best.mean() - best) / ROUTE.better
    usable = layers.values >= bar[layers.point]
    margin = ROUTE.widths[attempt] * max(ROUTE.margin, math.ceil(2 * longest_change))
    regions: list[range] = []
    (ends, before), (begins, after) = (_breaks(layers, links, usable, way) for way in (1, -1))
    for begin, end in zip(begins[::-1], ends, strict=False):
        if begin + 1 < end and not attempt:
            begin = end = _nearest(layers, range(begin + 1, end), before, after)
        first, last = sorted((begin, end))
        regions.append(range(max(0, first - margin), min(len(layers), last + margin + 1)))
    return joined(regions) or [range(len(layers))]


def _nearest(layers: Layers, points: range, before: Flags, after: Flags) -> int:
    """Return the point at which two sets of candidates are nearest to each other."""

    def apart(point: int) -> float:
        own = layers.at(point)
        x = layers.pressures[own]
        gaps: Array = np.abs(x[before[own]][:, np.newaxis] - x[after[own]]).max(axis=2)
        return float(gaps.min(initial=np.inf))

    return min(points, key=apart)


def _breaks(layers: Layers, links: Links, usable: Flags, way: int) -> tuple[list[int], Flags]:
    """Return the points at which every sequence of usable candidates has ended.

    They are counted from the first point (`way` 1) or the last (-1), anew after each.  The
    second array marks the candidates that are on a sequence.
    """
    is_step = layers.point[links.goal] == layers.point[links.origin] + 1
    is_step &= links.known & (links.worst > -np.inf)
    origin, goal = links.origin[is_step], links.goal[is_step]
    heads = np.searchsorted(goal, layers.first)
    alive, found = usable.copy(), []
    for k in range(1, len(layers))[::way]:
        some = slice(heads[k], heads[k + 1])
        before, after, point = origin[some], goal[some], k
        if way < 0:
            before, after, point = after, before, k - 1
        came = np.zeros(len(alive), bool)
        came[after[alive[before]]] = True
        own = layers.at(point)
        if (came[own] & usable[own]).any():
            alive[own] &= came[own]
        else:
            found.append(point)
    return found, alive
