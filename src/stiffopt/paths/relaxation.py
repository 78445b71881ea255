"""Move the points of a sequence one by one, each to the local optimum between its neighbours."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.stopping import checkpoint
from stiffopt.paths.points import Local, PathCandidate, PathTasks
from stiffopt.paths.route import Route
from stiffopt.paths.settings import ROUTE


def relaxed(
    tasks: PathTasks, route: Route, steps: Array, best: Array, fixed: Collection[int]
) -> Route:
    """Return a sequence whose points are moved one by one, each between its neighbours.

    A point moves to a local optimum that the rates allow, if the body keeps clear on the way; the
    `fixed` ones do not move.  `steps` (N - 1, n) are the largest changes from point to point in Pa,
    and `best` (N,) the best values of the single points.
    """
    found = list(route.candidates)
    free = np.ones(len(found), dtype=bool)
    free[list(fixed)] = False
    movable = free
    for _ in range(ROUTE.sweeps if tasks.is_compiled else 0):
        checkpoint()
        values = np.array([each.value for each in found])
        poor = movable & (values < best - ROUTE.hardly / 2)
        moved = np.zeros(len(found), dtype=bool)
        for odd in (0, 1):
            points = np.flatnonzero(poor[odd::2]) * 2 + odd
            moved[points] = _move(tasks, found, points.tolist(), steps)
        if not moved.any():
            break
        movable = moved.copy()  # these and their neighbours
        movable[1:] |= moved[:-1]
        movable[:-1] |= moved[1:]
        movable &= free
    return replace(route, candidates=found)


def _move(
    tasks: PathTasks, found: list[PathCandidate], points: Sequence[int], steps: Array
) -> list[bool]:
    """Move some points of a sequence, in place, if they become stiffer; return which moved."""
    p = [each.pressures for each in found]
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
        if new is not None and is_better:
            way = [*p[max(k - 1, 0) : k], new.pressures, *p[k + 1 : k + 2]]
            is_better = tasks.body is None or tasks.body.motion(np.array(way)).clear
        if new is not None and is_better:
            found[k] = new
        moved.append(is_better)
    return moved
