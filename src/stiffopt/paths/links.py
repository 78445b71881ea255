"""The candidates at all points of a path, and the links between them.

A link is a step to the next point that the rates allow, or a crossing (`stiffopt.paths.crossings`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array, Flags
from stiffopt.paths.points import PathCandidate
from stiffopt.paths.settings import RATES

Indices = NDArray[np.intp]


class Layers:
    """The m candidates at all N points of a path, numbered from point to point.

    Parameters
    ----------
    optima, lanes : at each point, its local optima and its further candidates.
    n : number of channels.

    Attributes
    ----------
    is_lane : (m,), whether a candidate is a further one.
    first : (N + 1,), number of the first candidate at each point, and m.
    point : ndarray (m,)
    values, pressures : ndarray (m,), (m, n)
    best : (N,), largest value at each point.
    """

    def __init__(
        self,
        optima: Sequence[Sequence[PathCandidate]],
        lanes: Sequence[Sequence[PathCandidate]],
        n: int,
    ) -> None:
        pairs = list(zip(optima, lanes, strict=True))
        sizes = [len(own) + len(more) for own, more in pairs]
        self.candidates = [each for own, more in pairs for each in (*own, *more)]
        self.is_lane = np.array(
            [lane for pair in pairs for lane in (False, True) for _ in pair[lane]], dtype=bool
        )
        self.first = np.cumsum([0, *sizes])
        self.point = np.repeat(np.arange(len(pairs)), sizes)
        self.values = np.array([each.value for each in self.candidates])
        self.pressures = np.array([each.pressures for each in self.candidates]).reshape(-1, n)
        self.best = np.maximum.reduceat(self.values, self.first[:-1])

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.best)

    def at(self, point: int) -> slice:
        """Return the numbers of the candidates at a point; -1 is the last one."""
        point %= len(self)
        return slice(self.first[point], self.first[point + 1])


@dataclass
class Links:
    """Links from a candidate to one at a later point, sorted by their ends."""

    # origin, goal: numbers of the candidates at both ends
    origin: Indices
    goal: Indices
    # worst, total: smallest value and sum of values in between; estimates until `known`
    worst: Array
    total: Array
    known: Flags  # whether these are computed
    checked: Flags  # whether the body is known to keep clear along a link
    # the candidates along each computed crossing, by the link's number
    between: dict[int, list[PathCandidate]] = field(default_factory=dict)

    def with_crossings(self, others: Links) -> Links:
        """Return these links and crossings, of which none is computed, together."""
        order = np.argsort(np.concatenate([self.goal, others.goal]), kind="stable")
        names = [each.name for each in fields(Links) if each.name != "between"]
        pairs = ((getattr(self, name), getattr(others, name)) for name in names)
        sorted_: list[Any] = [np.concatenate(pair)[order] for pair in pairs]
        return Links(*sorted_)

    def exclude(self, numbers: Indices) -> None:
        """Let no sequence use some links."""
        self.checked[numbers] = True
        self.worst[numbers] = self.total[numbers] = -np.inf


def all_steps(layers: Layers, steps: Array) -> Links:
    """Return the steps from point to point that the rates allow, at most `steps` (N - 1, n)."""
    origins, goals = [], []
    for point, step in enumerate(steps):
        own, others = layers.at(point + 1), layers.at(point)
        after_x, before_x = layers.pressures[own].T, layers.pressures[others].T
        most = largest(step)
        after, before = (np.abs(after_x[0][:, np.newaxis] - before_x[0]) <= most[0]).nonzero()
        for channel in range(1, len(most)):
            fits = np.abs(after_x[channel][after] - before_x[channel][before]) <= most[channel]
            after, before = after[fits], before[fits]
        origins.append(others.start + before)
        goals.append(own.start + after)
    origin, goal = np.concatenate(origins), np.concatenate(goals)
    count = len(goal)
    known, checked = np.ones(count, bool), np.zeros(count, bool)
    return Links(origin, goal, np.full(count, np.inf), np.zeros(count), known, checked)


def largest(step: Array) -> Array:
    """Return the largest change (n,) that counts as within a step."""
    return step * (1 + RATES.rounding) + 1e-9
