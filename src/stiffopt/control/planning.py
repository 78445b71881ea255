"""Making plans: which pressures are best for the target, as far off as the arm is found to be.

The arm's tip is found beside where the model has it, by an offset.  A target moved back by that
offset, given to the optimiser, yields pressures that are the stiffest on the arm as it is, but for
how stiffness itself is off.  The plan is the local optimum next to the last one; if the offset has
changed much and the arm is at rest, all configurations are searched again, and the arm leaves its
own only for one that is clearly better.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stiffopt.control.closest import closest
from stiffopt.control.plans import Plan, Request
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.solver import PressureSolver
from stiffopt.optimise.target import Target, Tolerance
from stiffopt.optimise.tip import TipModel

__all__ = ["Planning", "moved_back"]

Array = NDArray[np.float64]

_CLEARLY = 0.02  # by which share a configuration must be stiffer to be worth a move
_MUCH = 2e-3  # m; change of the offset after which all is searched again
_STILL = 5e-5  # m from plan to plan; more, and the arm is not at rest
_NEAR = 2e4  # Pa; an answer that is farther from the last plan is another configuration
_FAR_PER_METRE = 2e7  # Pa/m; the same for each metre that the target has moved
_PATIENCE = 20  # plans
_EXACT = Tolerance(position=1e-5, angle=1e-3)


class Planning:
    """Makes plans, each from the one before.

    Parameters
    ----------
    robot :
        The arm.
    """

    def __init__(self, robot: Manipulator) -> None:
        self._robot = robot
        self._tip = TipModel(robot)
        self._serial = -1
        self._last: Plan | None = None
        self._searched_at: Array = np.zeros(6)
        self._advantage, self._misses = _CLEARLY, 0

    def plan(self, request: Request) -> Plan:
        """Answer a request.

        Raises
        ------
        StiffoptError
            The optimiser could not be run.
        """
        if request.serial != self._serial or self._last is None:
            exact = request.target.model_copy(update={"tolerance": _EXACT})
            self._solver = PressureSolver(
                self._robot, request.task.model_copy(update={"target": exact})
            )
            self._is_compiled = self._solver.is_compiled
            self._serial, self._last = request.serial, None
        target = moved_back(request.target, request.offset)
        self._limits = self._left(request.beside)
        last = self._last
        if last is None or request.anew:
            self._searched_at, self._advantage, self._misses = request.offset, _CLEARLY, 0
            solution = self._solved(target, None)
        else:
            solution = self._next_to(last, target)
            solution = self._better(request, target, solution, last) if solution else None
        if solution is not None and solution.pressures is not None:
            pressures = np.array(solution.pressures, dtype=float)
            stiffness = _value(solution.stiffness, math.nan)
            self._last = Plan(
                request.serial, pressures, request.offset, request.target, True, stiffness, ""
            )
        else:
            self._last = self._closest(request, target)
        return self._last

    def _left(self, beside: Array) -> tuple[Array, Array]:
        """Limits (n,) each, of pressures that act: those for which there are commands.

        What is beside the commands never widens them; the model ends there.
        """
        lower, upper = self._solver.task.pressure_bounds(self._robot.description)
        left = np.maximum(lower, lower + beside), np.minimum(upper, upper + beside)
        return (lower, upper) if (left[0] > left[1]).any() else left

    def _next_to(self, last: Plan, target: Target) -> PressureSolution | None:
        """The optimum next to the last plan; another one only if that is not to be had for long."""
        solution = self._solved(target, last.pressures)
        if solution is None or solution.pressures is None:
            return None
        way = float(np.max(np.abs(solution.pressures - last.pressures)))
        if way <= _NEAR + _FAR_PER_METRE * float(np.linalg.norm(_shift(last, target))):
            self._misses = 0
            return solution
        self._misses += 1
        if self._misses <= _PATIENCE:
            return None
        self._misses = 0
        return solution

    def _better(
        self, request: Request, target: Target, solution: PressureSolution, last: Plan
    ) -> PressureSolution:
        """The stiffest configuration, where things have changed and the arm is at rest.

        Each change of configuration makes the next one harder: on another one the offset is
        another, and so may the choice be.
        """
        changed = float(np.linalg.norm((request.offset - self._searched_at)[:3]))
        drift = float(np.linalg.norm((request.offset - last.offset)[:3]))
        if changed <= _MUCH or drift > _STILL:
            return solution
        self._searched_at = request.offset
        other = self._solved(target, None)
        if other is None or other.pressures is None:
            return solution
        if _value(other.stiffness) <= (1 + self._advantage) * _value(solution.stiffness):
            return solution
        self._advantage *= 2
        return other

    def _solved(self, target: Target, guess: Array | None) -> PressureSolution | None:
        """Answer of the optimiser; None if it has none that holds, soon."""
        if self._is_compiled:
            return self._solver.solve_at_once(target, guess, self._limits)
        solution = self._solver.solve(target, guess)
        return solution if solution.found else None

    def _closest(self, request: Request, target: Target) -> Plan:
        """Plan for a target that is out of reach, or whose stiffness cannot be had there."""
        start = 0.5 * (self._limits[0] + self._limits[1])
        if self._last is not None:
            start = np.clip(self._last.pressures, *self._limits)
        pressures, away, turned = closest(self._tip, target, self._limits, start)
        tolerance = request.task.target.tolerance
        if away <= tolerance.position and turned <= tolerance.angle:
            message = "the pose can be reached, but not with the stiffness that is asked for"
        else:
            message = f"the nearest pose is {1e3 * away:.1f} mm away"
            if turned > tolerance.angle:
                message += f" and {math.degrees(turned):.1f} deg"
        return Plan(
            serial=request.serial,
            pressures=pressures,
            offset=request.offset,
            target=request.target,
            reached=False,
            stiffness=math.nan,
            message=message,
        )


def moved_back(target: Target, offset: Array) -> Target:
    """What the model has to reach, for an arm whose tip is off by an offset (6,) to reach a target.

    Parameters
    ----------
    target :
        Of the arm.
    offset :
        In m and rad (rotation vector), base axes.
    """
    return target.moved_back(offset).model_copy(update={"tolerance": _EXACT})


def _shift(last: Plan, target: Target) -> Array:
    """By how much a target for the model differs from the one of the last plan, in m."""
    before = moved_back(last.target, last.offset).position
    if before is None or target.position is None:
        return np.zeros(3)
    pairs = zip(before, target.position, strict=True)
    return np.array([0.0 if a is None or b is None else b - a for a, b in pairs])


def _value(stiffness: float | None, otherwise: float = 0.0) -> float:
    return otherwise if stiffness is None else float(stiffness)
