"""The ends of a motion: given pressures, or configurations that solve a task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.errors import InputError, StoppedError
from stiffopt.model.arguments import checked_vector
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.solver import PressureSolver
from stiffopt.optimise.task import Task

End = ArrayLike | Task

_LOCAL = 3  # number of searches from random guesses, for other local optima
_NEAR = 8  # number of searches for the best answer near a random guess
_NEARNESS = 0.4  # half width of the box about such a guess, as a share of a channel's range
_ALIKE = 0.02  # of the ranges; configurations that differ by less count as one


@dataclass(frozen=True, eq=False)
class Configuration:
    """Pressures at which a motion may end."""

    pressures: Array  # (n,), in Pa
    # its stiffness as a share of the best known for its task; 1 if nothing is maximised
    worth: float = 1.0
    name: str = ""  # of the end to which it belongs: "goal 2"


class Unsolved(Exception):  # noqa: N818
    """A task at an end of the motion has no solution; the text says why."""


def several(goal: End | Sequence[End]) -> list[End]:
    """Return a list of goals, from one goal or several."""
    if isinstance(goal, Task):
        return [goal]
    if isinstance(goal, np.ndarray):
        return list(goal) if goal.ndim == 2 and len(goal) else [goal]
    kinds = (Task, Sequence, np.ndarray)
    if isinstance(goal, Sequence) and (
        not goal or any(isinstance(each, kinds) and not isinstance(each, str) for each in goal)
    ):
        return list(goal)
    return [cast(End, goal)]


def checked_pressures(name: str, robot: Manipulator, pressures: ArrayLike) -> Array:
    """Return pressures (n,), or raise `InputError` if they are outside the robot's limits."""
    p = checked_vector(f"the {name}'s pressures", pressures, robot.n_pressures)
    low, high = robot.pressure_min, robot.pressure_max
    for index in np.flatnonzero((p < low) | (p > high)):
        channel, unit = robot.description.channel_name(int(index)), display_units().pressure
        raise InputError(
            f"{name}: {channel} is at {unit.text(p[index], 'g')}, outside of its limits "
            f"{unit.number(low[index], 'g')} to {unit.text(high[index], 'g')}"
        )
    return p


class TaskConfigurations:
    """Finds configurations that solve a task.

    Raises `Unsolved`: the task has no solution; `StoppedError`: the solver failed, or the time is
    over.

    Parameters
    ----------
    name : of the end, for messages.
    robot : without the task's load.
    task : with the scene and the clearance of the motion.
    seed : of the searches.

    Attributes
    ----------
    best : the stiffest configuration.
    limits : lower and upper limits of the pressures, (n,) each.
    """

    def __init__(self, name: str, robot: Manipulator, task: Task, seed: int) -> None:
        self._solver, self._seed = PressureSolver(robot, task, seed=seed), seed
        self.limits = task.pressure_bounds(robot.description)
        solution = self._solver.solve()
        if solution.status == "failed":
            raise StoppedError(f"{name}: {solution.message}")
        if not solution.found or solution.pressures is None:
            raise Unsolved(f"{name}: {solution.status}: {solution.message}")
        self.best = Configuration(solution.pressures, name=name)
        self._maximised = len(maximised(task))
        self._most = min(solution.stiffnesses[: self._maximised], default=None)

    def others(self, start: Array) -> list[Configuration]:
        """Search further configurations, near the start of a motion and near random guesses."""
        low, high = self.limits
        span = high - low
        rng = np.random.default_rng(self._seed)
        guesses = [start, *(low + span * rng.random((_LOCAL + _NEAR, len(low))))]
        found: list[Configuration] = []
        for index, guess in enumerate(guesses):
            near = None
            if not 0 < index <= _LOCAL:
                reach = _NEARNESS * span
                near = np.clip(guess - reach, low, high), np.clip(guess + reach, low, high)
            answer = self._solver.solve_at_once(guess=guess, limits=near)
            if answer is None or not answer.found or answer.pressures is None:
                continue
            p = answer.pressures
            known = [self.best.pressures, *(each.pressures for each in found)]
            if all((np.abs(p - each) > _ALIKE * span).any() for each in known):
                worth = 1.0
                if self._most is not None:
                    worth = min(answer.stiffnesses[: self._maximised]) / self._most
                found.append(Configuration(p, worth, self.best.name))
        return found


def maximised(task: Task) -> tuple[StiffnessMeasure, ...]:
    """Return the directional stiffnesses that a task maximises."""
    return task.stiffness.maximise if task.stiffness is not None else ()
