"""Crossings: links between candidates several points apart, at full rate with the tip on the path.

Their values are estimated from their ends; `crossed` computes one.
"""

from __future__ import annotations

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.stopping import checkpoint
from stiffopt.paths.links import Indices, Layers, Links, largest
from stiffopt.paths.points import Local, PathCandidate, PathTasks
from stiffopt.paths.settings import ROUTE

_NONE = np.zeros(0, dtype=np.intp)


def crossings(layers: Layers, steps: Array, over: str) -> Links:
    """Return crossings from some points between candidates that are too far apart for a step.

    Their values are estimates.  `steps` (N - 1, n) are the largest changes from point to point, in
    Pa; the `over` value ("worst" or "mean") is to be maximised.
    """
    count = len(layers)
    reach = np.concatenate([np.zeros((1, steps.shape[1])), steps.cumsum(axis=0)])
    widest = np.ptp(layers.pressures, axis=0)
    pairs = [(_NONE, _NONE)]
    for begin in range(0, count - 2, max(1, count // ROUTE.crossings)):
        checkpoint()
        lengths = np.arange(2, count - begin)
        limits = np.maximum((reach[begin + 2 :] - reach[begin]) * ROUTE.within, 1e-9)
        most = (widest / limits).max(axis=1) * lengths  # steps, by the widest apart
        longest = lengths[np.ceil(max(ROUTE.lengths) * np.maximum(most, 1.0)) >= lengths]
        every = 1 + longest.max(initial=2) // ROUTE.ends
        some = slice(0, longest.max(initial=1) - 1, every)
        pairs += _pairs(layers, over, begin, lengths[some], limits[some], every)
    return _guessed(layers, *(np.concatenate(each) for each in zip(*pairs, strict=True)))


def _pairs(
    layers: Layers, over: str, begin: int, lengths: Indices, limits: Array, every: int
) -> list[tuple[Indices, Indices]]:
    """Choose crossings from candidates at one point; return their origins and goals.

    `lengths` are in points, spaced by `every`; `limits` are the changes that they allow.
    """
    origin = np.arange(*layers.first[begin : begin + 2])
    goal = np.flatnonzero(np.isin(layers.point, begin + lengths))
    at = (layers.point[goal] - begin - 2) // every
    length, limit = lengths[at], limits[at]
    found = []
    for is_lane in (False, True):
        own = origin[layers.is_lane[origin] == is_lane]
        # crossings end at local optima, unless the mean counts
        others = np.flatnonzero(~layers.is_lane[goal] | (not is_lane or over == "mean"))
        if not len(own) or not len(others):
            continue
        # number of steps needed, if all allow the same change
        needed = np.zeros((len(own), len(others)))
        x = layers.pressures
        for a, b, most in zip(x[own].T, x[goal[others]].T, limit[others].T, strict=True):
            np.maximum(needed, np.abs(a[:, np.newaxis] - b) / most, out=needed)
        needed *= length[others]
        for more in ROUTE.lengths:
            wanted = np.ceil(more * np.maximum(needed, 1.0))
            fits = (wanted <= length[others]) & (wanted > length[others] - every)
            rank = np.where(fits & (needed > 1), needed, np.inf)
            few = min(ROUTE.nearest, rank.shape[1]) - 1
            nearest = np.argpartition(rank, few, axis=1)[:, : few + 1]
            row, column = np.isfinite(np.take_along_axis(rank, nearest, 1)).nonzero()
            found.append((own[row], goal[others[nearest[row, column]]]))
    return found


def _guessed(layers: Layers, origin: Indices, goal: Indices) -> Links:
    """Return crossings with values estimated from their ends."""
    values = layers.values
    between = layers.point[goal] - layers.point[origin] - 1
    worst = np.minimum(values[origin], values[goal]) - ROUTE.price
    total = between * ((values[origin] + values[goal]) / 2 - ROUTE.price)
    known, checked = np.zeros((2, len(goal)), dtype=bool)
    return Links(origin, goal, worst, total, known, checked)


def crossed(
    tasks: PathTasks, begin: int, start: Array, goal: Array, steps: Array
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
    return None if (np.abs(goal - here) > largest(steps[-1])).any() else found
