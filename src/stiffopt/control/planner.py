"""The re-planner: which pressures are best for the target, as far off as the arm is found to be.

The arm's tip is found beside where the model has it, by an offset.  A target moved back by that
offset, given to the optimiser, yields pressures that are the stiffest on the arm as it is, but for
how stiffness itself is off.  The plan is the local optimum next to the last one; if the offset has
changed much and the arm is at rest, all configurations are searched again, and the arm leaves its
own only for one that is clearly better.

Plans are made one at a time by `Planning`: at once (`InlinePlanner`, for simulated time), or in a
process beside the control loop (`ProcessPlanner`), which is started again when it dies.
"""

from __future__ import annotations

import math
import os
import pickle
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.control.closest import closest
from stiffopt.control.planner_line import PlannerLine
from stiffopt.control.plans import Plan, Request
from stiffopt.control.state import Severity
from stiffopt.control.steering import Notice
from stiffopt.errors import StiffoptError
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.solver import PressureSolver
from stiffopt.optimise.target import Target, Tolerance
from stiffopt.optimise.tip import TipModel

__all__ = [
    "InlinePlanner",
    "Plan",
    "Planner",
    "Planning",
    "ProcessPlanner",
    "Request",
    "moved_back",
]

Array = NDArray[np.float64]

_CLEARLY = 0.02  # by which share a configuration must be stiffer to be worth a move
_MUCH = 2e-3  # m; change of the offset after which all is searched again
_STILL = 5e-5  # m from plan to plan; more, and the arm is not at rest
_NEAR = 2e4  # Pa; an answer that is farther from the last plan is another configuration
_FAR_PER_METRE = 2e7  # Pa/m; the same for each metre that the target has moved
_PATIENCE = 20  # plans
_EXACT = Tolerance(position=1e-5, angle=1e-3)
_RESTART_AFTER = 1.0  # s
_PREPARES = 0.5  # s; a new task that takes longer is worth a word


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


class Planner(Protocol):
    """Plans for whoever asks, when it is done."""

    def ask(self, request: Request) -> None:
        """Want a plan; one that was asked for before and is not begun is forgotten."""

    def latest(self) -> Plan | None:
        """Return the newest plan."""

    def notices(self) -> tuple[Notice, ...]:
        """What is wrong with the planner; see `Steering.notices`."""

    def close(self) -> None:
        """End."""


class InlinePlanner:
    """Plans at once, where it is asked: time stands still meanwhile, as in a simulation."""

    def __init__(self, robot: Manipulator) -> None:
        self._planning = Planning(robot)
        self._plan: Plan | None = None
        self._trouble: tuple[Notice, ...] = ()

    def ask(self, request: Request) -> None:
        """Plan."""
        try:
            self._plan = self._planning.plan(request)
            self._trouble = ()
        except StiffoptError as error:
            self._trouble = (Notice("planner", f"the planner failed: {error}", standing=True),)

    def latest(self) -> Plan | None:
        """Return the plan."""
        return self._plan

    def notices(self) -> tuple[Notice, ...]:
        """Say whether the last request failed."""
        return self._trouble

    def close(self) -> None:
        """Nothing to end."""


class ProcessPlanner:
    """Plans in a process of its own, so that neither whoever asks nor Python's lock ever waits.

    If planning fails in a way that no one thought of, or the process dies, the last plan stays, an
    alarm says so, and another process is started.

    Parameters
    ----------
    robot :
        The arm.
    patience :
        A plan that takes longer than this is worth an alarm, in s. The first one of a kind may be
        compiled, which takes seconds.
    """

    def __init__(self, robot: Manipulator, patience: float = 5.0) -> None:
        self._robot, self._patience = robot, patience
        self._wanted: Request | None = None
        self._serial = -1  # of what was asked last
        self._plan: Plan | None = None
        self._trouble, self._ended = "", False
        self._start()

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-P",
                    "-m",
                    "stiffopt.control.planner_process",
                    str(theirs.fileno()),
                ],
                pass_fds=(theirs.fileno(),),
                start_new_session=True,  # a terminal's Ctrl-C is not for it
            )
        _let_it_yield(self._process.pid)
        self._line = PlannerLine(ours.detach())
        self._begun: float | None = math.inf  # busy with itself until it says that it is ready
        self._started_at = time.monotonic()
        self._line.begin(self._robot)

    def ask(self, request: Request) -> None:
        """Want a plan."""
        if self._wanted is not None and self._wanted.serial == request.serial:
            request = replace(request, anew=self._wanted.anew or request.anew)
        self._wanted = request
        self._exchange()

    def latest(self) -> Plan | None:
        """Return the newest plan."""
        self._exchange()
        return self._plan

    def notices(self) -> tuple[Notice, ...]:
        """Say whether planning has failed, or takes too long."""
        begun = self._begun
        if self._trouble:
            return (Notice("planner", self._trouble, standing=True),)
        elapsed = 0.0 if begun is None else time.monotonic() - begun
        if elapsed > _PREPARES and (self._plan is None or self._plan.serial != self._serial):
            text = (
                "the optimiser prepares for a new task; the first of a kind is compiled, which "
                "takes seconds, and until then the pressures stay"
            )
            return (Notice("preparing", text, Severity.INFO, standing=True),)
        if elapsed > self._patience:
            return (Notice("planner", "the planner is slow; the last plan stays", standing=True),)
        return ()

    def close(self) -> None:
        """End the process."""
        self._ended = True
        self._line.close()  # which ends it
        try:
            self._process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _exchange(self) -> None:
        """Take what was planned, and hand over what is wanted if the process is free for it."""
        if self._ended or (self._begun is None and self._wanted is None):
            return
        try:
            while self._line.has_answer():
                answer = self._line.receive()
                self._begun = None
                if isinstance(answer, Plan):
                    self._plan, self._trouble = answer, ""
                elif answer is not None:  # None: it is ready
                    self._trouble = f"the planner failed and begins anew: {answer}"
            if self._wanted is not None and self._begun is None:
                self._line.ask(self._wanted)
                self._serial = self._wanted.serial
                self._wanted, self._begun = None, time.monotonic()
        except (OSError, EOFError, pickle.UnpicklingError):
            self._start_again()

    def _start_again(self) -> None:
        self._trouble = "the planner died and is started again; the last plan stays"
        if time.monotonic() - self._started_at < _RESTART_AFTER:
            return
        self._line.close()
        self._process.kill()
        self._process.wait()
        self._start()


def _let_it_yield(process: int) -> None:
    """Let a process not interrupt whoever wakes it, where the system can be told so.

    It is woken by each request, and would plan at once, for milliseconds, on the very processor on
    which the control loop is in the middle of a tick. It also loses the loop's real-time priority,
    which it has got if the loop itself started it.
    """
    with suppress(AttributeError, OSError):
        os.sched_setscheduler(process, os.SCHED_BATCH, os.sched_param(0))


def moved_back(target: Target, offset: Array) -> Target:
    """What the model has to reach, for an arm whose tip is off by an offset (6,) to reach a target.

    Parameters
    ----------
    target :
        Of the arm.
    offset :
        In m and rad (rotation vector), base axes.
    """
    update: dict[str, object] = {"tolerance": _EXACT}
    if target.position is not None:
        update["position"] = tuple(
            None if axis is None else axis - float(shift)
            for axis, shift in zip(target.position, offset[:3], strict=True)
        )
    back = lie.exp(np.concatenate([np.zeros(3), -offset[3:]]))[:3, :3]
    if target.pointing is not None:
        update["pointing"] = tuple((back @ np.array(target.pointing)).tolist())
    if target.orientation is not None:
        rotation = back @ lie.rotation_from_quaternion(np.array(target.orientation))
        q = lie.quaternion_from_rotation(rotation)
        update["orientation"] = tuple((q if q[0] >= 0 else -q).tolist())
    return target.model_copy(update=update)


def _shift(last: Plan, target: Target) -> Array:
    """By how much a target for the model differs from the one of the last plan, in m."""
    before = moved_back(last.target, last.offset).position
    if before is None or target.position is None:
        return np.zeros(3)
    pairs = zip(before, target.position, strict=True)
    return np.array([0.0 if a is None or b is None else b - a for a, b in pairs])


def _value(stiffness: float | None, otherwise: float = 0.0) -> float:
    return otherwise if stiffness is None else float(stiffness)
