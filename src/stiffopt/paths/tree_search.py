"""Search a way in the space of pressures with OMPL's RRTConnect, two trees that grow together.

A given function checks each straight motion as a whole, so no resolution needs to be set.  Each
channel is weighted by how far it moves the body: distances bound the body's displacement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import StoppedError, require_package
from stiffopt.model.stopping import checkpoint

IsClear = Callable[[Array], bool]
"""Returns whether the way along rows of pressures (N, n) is clear."""

_RANGE = 0.3  # longest branch, as a share of the space's diagonal


class TreeSearch:
    """Searches for ways between pressures (n,) in Pa.

    Raises `MissingExtraError`.

    Parameters
    ----------
    is_clear : checks motions.
    low, high : limits of the pressures, (n,).
    weights : (n,), bound on the body's displacement per pressure, in m/Pa.
    seed : the same seed gives the same ways, unless time ends the search.
    """

    def __init__(
        self, is_clear: IsClear, low: Array, high: Array, weights: Array, seed: int
    ) -> None:
        require_package("ompl", "plan")
        self._is_clear, self._seed = is_clear, seed
        self._free = np.flatnonzero(high > low)
        self._low, self._high = low, high
        self._weights = weights[self._free]
        self.tried = 0

    def way(self, start: Array, goals: Array, most: float) -> tuple[Array | None, Array | None]:
        """Search a way (k, n) from the start to one of the goals (N, n).

        The search ends after checking `most` motions. Without a way it returns None, and, if known,
        the pressures (n,) that the tree from the start reached.
        """
        from ompl import base, geometric, util

        if not len(self._free):
            return None, None
        with _quiet(util):
            util.RNG.setSeed(self._seed + 1)  # OMPL refuses a seed of zero
            space = base.RealVectorStateSpace(len(self._free))
            bounds = base.RealVectorBounds(len(self._free))
            for index, channel in enumerate(self._free):
                bounds.setLow(index, float(self._weights[index] * self._low[channel]))
                bounds.setHigh(index, float(self._weights[index] * self._high[channel]))
            space.setBounds(bounds)
            info = base.SpaceInformation(space)
            info.setStateValidityChecker(lambda _: True)
            info.setMotionValidator(self._validator(base, info, start))
            info.setup()
            problem = base.ProblemDefinition(info)
            problem.addStartState(self._state(info, start))
            ends = base.GoalStates(info)
            for goal in goals:
                ends.addState(self._state(info, goal))
            problem.setGoal(ends)
            planner = geometric.RRTConnect(info)
            planner.setRange(_RANGE * space.getMaximumExtent())
            planner.setProblemDefinition(problem)
            planner.setup()
            last = self.tried + most

            def is_over() -> bool:
                try:
                    checkpoint()
                except StoppedError:
                    return True
                return self.tried >= last

            planner.solve(base.PlannerTerminationCondition(is_over))
            found = problem.getSolutionPath()
            if found is None:
                return None, None
            path = np.array([self._pressures(state, start) for state in found.getStates()])
            if problem.hasExactSolution():
                return path, None
            return None, path[-1]

    def _validator(self, base: Any, info: Any, start: Array) -> Any:
        """Return the check of a motion between two states, as OMPL expects it."""
        search, count = self, len(self._free)
        rows, weights = np.stack([start, start]), self._weights
        all_move = count == len(start)

        class Motions(base.MotionValidator):  # type: ignore[misc]
            def checkMotion(self, first: Any, second: Any) -> bool:  # noqa: N802
                search.tried += 1
                states = np.array([first[0:count], second[0:count]]) / weights
                if all_move:
                    return search._is_clear(states)
                rows[:, search._free] = states
                return search._is_clear(rows)

        return Motions(info)

    def _state(self, info: Any, p: Array) -> Any:
        state = info.allocState()
        state[0 : len(self._free)] = (self._weights * p[self._free]).tolist()
        return state

    def _pressures(self, state: Any, start: Array) -> Array:
        p = start.copy()
        p[self._free] = state[0 : len(self._free)] / self._weights
        return np.clip(p, self._low, self._high)


@contextmanager
def _quiet(util: Any) -> Iterator[None]:
    """Keep OMPL from printing."""
    before = util.getLogLevel()
    util.setLogLevel(util.LogLevel.LOG_NONE)
    try:
        yield
    finally:
        util.setLogLevel(before)
