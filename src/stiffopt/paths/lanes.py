"""Lanes: further configurations of a free arm along a path, which need not be optimal.

At a few points of a region, configurations are spread over all that reach the target.  These and
the local optima follow the path, from mark to mark, with as little change as possible.  They
connect branches where the direct crossing would leave the path or touch an object.
"""

import itertools
from collections.abc import Sequence

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.stopping import checkpoint
from stiffopt.paths.candidates import spaced
from stiffopt.paths.points import PathCandidate, PathTasks
from stiffopt.paths.settings import LANES

Guesses = list[tuple[int, Array]]
"""Points of a path, with pressures (k, n) near their targets."""


def lanes(
    tasks: PathTasks,
    layers: Sequence[Sequence[PathCandidate]],
    region: range,
    attempt: int,
    is_last: bool,
) -> list[list[PathCandidate]]:
    """Return further candidates at each point, which lie in a region of the path.

    Each attempt draws other configurations.  The last one adds no variants of those that are
    carried along, which leaves room for more of them.
    """
    found: list[list[PathCandidate]] = [[] for _ in range(len(tasks))]
    if not tasks.is_compiled or tasks.robot.is_loaded:
        return found
    many = min(len(region), LANES.marks, max(2 * LANES.knots, len(region) // LANES.every))
    marks = spaced(region[0], region[-1], many)
    knots = marks[spaced(0, len(marks) - 1, LANES.last_knots if is_last else LANES.knots)].tolist()
    born = {
        mark: np.array([each.pressures for each in layers[mark]]).reshape(-1, len(tasks.unit))
        for mark in marks.tolist()
    }
    starts = LANES.starts * (attempt + 1)
    for knot in knots:
        near = tasks.near(knot, starts)[-LANES.starts :]
        new = tasks.brought(np.full(len(near), knot), near)
        born[knot] = np.concatenate([born[knot], new.pressures[new.arrived]])
    rng = None if is_last else np.random.default_rng(attempt)
    guesses: Guesses = []
    for order in (marks.tolist(), marks[::-1].tolist()):
        guesses += _followed(tasks, order, knots, born, rng)
    where = np.concatenate([np.full(len(some), point) for point, some in guesses])
    here = tasks.brought(where, np.concatenate([some for _, some in guesses]))
    for point, p, value in zip(where.tolist(), here.pressures, here.values.tolist(), strict=True):
        if value > -np.inf:
            found[point].append(PathCandidate(p, value))
    return found


def _followed(
    tasks: PathTasks,
    marks: Sequence[int],
    knots: Sequence[int],
    born: dict[int, Array],
    rng: np.random.Generator | None,
) -> Guesses:
    """Follow configurations from mark to mark, joined by those born there.

    Between two marks their pressures are interpolated.  With `rng`, random ones beside them are
    tried too.
    """
    live = _spread(tasks, np.zeros((0, len(tasks.unit))), born[marks[0]])
    guesses = [(marks[0], live)]
    for here, there in itertools.pairwise(marks):
        checkpoint()
        guess = live
        if rng is not None:
            aside = LANES.aside * tasks.unit * rng.uniform(-1, 1, live.shape)
            guess = np.concatenate([live, live + aside])
        came = tasks.brought(np.full(len(guess), there), guess)
        kept, is_new = np.split(came.arrived, [len(live)])
        own, new = came.pressures[: len(live)][kept], came.pressures[len(live) :][is_new]
        for point in range(here, there, 1 if there > here else -1)[1:]:
            share = (point - here) / (there - here)
            guesses.append((point, live[kept] + share * (own - live[kept])))
        if there in knots:  # leave room for new ones
            own = own[: LANES.kept // 2]
        live = _spread(tasks, own, np.concatenate([born[there], new]))
        guesses.append((there, live))
    return guesses


def _spread(tasks: PathTasks, live: Array, new: Array) -> Array:
    """Return at most `LANES.kept` distinct pressures (k, n): of `live`, then of `new`.

    New ones are farther from all others, and the farthest come first.
    """
    x = np.vstack([live, new]) / tasks.unit
    distance = np.full(len(x), np.inf)
    chosen: list[int] = []
    for some, apart in (
        (slice(0, len(live)), LANES.alike),
        (slice(len(live), len(x)), LANES.apart),
    ):
        own = distance[some]
        while len(own) and len(chosen) < LANES.kept and own.max() > apart:
            chosen.append(some.start + int(own.argmax()))
            np.minimum(distance, np.abs(x - x[chosen[-1]]).max(axis=1), out=distance)
    return x[chosen] * tasks.unit
