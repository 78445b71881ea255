"""Solve a design: quickly while it is being changed, and fully when it rests.

`Workbench` contains the design with its solutions; it works without any view. `NewestWins` is the
thread that calls it, so that no event of a browser waits for a search.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.stopping import Cancel
from stiffopt.optimise.solution import PressureSolution, active_bounds
from stiffopt.optimise.solver import PressureSolver, stiffness_blind
from stiffopt.plots.wording import least_maximised
from stiffopt.studio.design import Design
from stiffopt.studio.leaning import Leaning

QUICK = 0.03
"""Seconds after which a quick search gives up."""
REST = 0.25
"""Seconds without a change after which the full search starts."""
_BETTER = 1e-3  # relative gain of stiffness for which an arm at rest may jump to another solution
_CHEAP = 5e-3  # s that the plain solution may take during a drag
_STEPS = 200  # that can be undone


@dataclass(frozen=True, eq=False)
class StudioAnswer:
    """The solution of a design."""

    design: Design  # the design that it solves
    solution: PressureSolution  # with pressures
    # the plain solution, with the least pressures for the same pose; None if unknown
    plain: PressureSolution | None
    # whether it comes from the global search, not only from one near the previous one
    is_best: bool

    @property
    def pressures(self) -> Array:
        """Pressures (n,), in Pa."""
        assert self.solution.pressures is not None
        return self.solution.pressures

    @property
    def robot(self) -> Manipulator:
        """The arm with the task's load."""
        assert self.solution.robot is not None
        return self.solution.robot

    @cached_property
    def at_limit(self) -> NDArray[np.int_]:
        """Limit at which each pressure is (n,): -1 at the lowest, 1 at the highest, else 0."""
        found = np.zeros(len(self.pressures), dtype=int)
        for channel, side in active_bounds(self.robot, self.design.task, self.pressures).values():
            found[channel] = side
        return found

    @property
    def plain_stiffness(self) -> float | None:
        """The task's first stiffness at the plain solution, or None."""
        measures = self.design.task.measures
        if self.plain is None or self.plain.pressures is None or not measures:
            return None
        m = measures[0]
        value = self.robot.stiffness(self.plain.pressures, m.direction, m.kind, m.boundary, m.frame)
        return float(value)


class Workbench:
    """A design with its history, its solution, and kept solutions.

    Any thread may change the design; a single thread requests solutions.

    Attributes
    ----------
    design : the present design.
    answer : the newest solution, perhaps of an earlier design, or None.
    kept : solutions to compare with.
    leaning : the arm leaning on objects at held pressures, or None.
    trouble : why the design has no solution, or an empty text.
    """

    def __init__(self, design: Design) -> None:
        self.design = design
        self.answer: StudioAnswer | None = None
        self.kept: list[StudioAnswer] = []
        self.leaning: Leaning | None = None
        self.trouble = ""
        self._held: Array | None = None  # pressures, in Pa
        self._past: deque[Design] = deque(maxlen=_STEPS)
        self._step = ""
        self._robot: Manipulator | None = None
        self._plain_takes = float("inf")  # s
        self._lock = threading.RLock()

    def change(self, kind: str, change: Callable[[Design], Design]) -> bool:
        """Change the design; consecutive changes of one kind are a single step to undo.

        Returns False, and leaves the design as it is, if nothing changes.

        Raises `InputError`: the change is invalid; the design stays as it was.
        """
        with self._lock:
            new = change(self.design)
            if new == self.design:
                return False
            if kind != self._step:
                self._past.append(self.design)
                self._step = kind
            self.design = new
            return True

    def end_step(self) -> None:
        """End the step to undo; the next change begins a new one."""
        with self._lock:
            self._step = ""

    def undo(self) -> bool:
        """Go back by a step; return False if there is none."""
        with self._lock:
            if not self._past:
                return False
            self.design, self._step = self._past.pop(), ""
            return True

    def keep(self) -> bool:
        """Keep the solution for comparison; return False if there is none or it is kept already."""
        if self.answer is None or any(self.answer is each for each in self.kept):
            return False
        self.kept.append(self.answer)
        return True

    # -- leaning ------------------------------------------------------------------------------

    def hold(self, *, held: bool) -> None:
        """Hold the solution's pressures, so that the arm leans on objects; or stop holding them.

        Raises `InputError`: there is no solution.
        """
        if held and self.answer is None:
            raise InputError("there are no pressures to hold yet")
        with self._lock:
            self._held = self.answer.pressures if held and self.answer is not None else None
            self.leaning = None

    def _lean(self, design: Design, pressures: Array) -> bool:
        self.leaning = None
        self.leaning = Leaning.of(design, self._solver(design).robot, pressures)
        self.trouble = ""
        return True

    # -- answers ------------------------------------------------------------------------------

    def answer_quickly(self, cancel: Cancel) -> bool:
        """Search near the previous solution; return whether there is a new one."""
        design, before, held = self.design, self.answer, self._held
        if held is not None:
            return self._lean(design, held)
        solver = self._solver(design)
        guess = None
        if before is not None and len(before.pressures) == solver.robot.n_pressures:
            guess = before.pressures
        if guess is None and not solver.is_compiled:
            return False
        if guess is None:
            solution = solver.solve(timeout=QUICK, cancel=cancel)
        else:
            solution = solver.follow(guess, timeout=QUICK)
        if solution.pressures is None:
            return False
        self._take(design, solver, solution, is_best=guess is None)
        return True

    def answer_best(self, cancel: Cancel) -> bool:
        """Search globally; return whether there is a new solution."""
        design, before = self.design, self.answer
        if self._held is not None:
            return False
        solver = self._solver(design)
        solution = solver.solve(cancel=cancel)
        if solution.pressures is None:
            if design == self.design and (before is None or before.design != design):
                self.trouble = solution.message
            return False
        if before is not None and before.design == design and not _is_better(solution, before):
            solution = before.solution
        self._take(design, solver, solution, is_best=True)
        return True

    def _solver(self, design: Design) -> PressureSolver:
        """Return a solver; it reuses the robot, with its caches, if that did not change."""
        if self._robot is None or self._robot.description != design.description:
            self._robot = Manipulator(design.description)
        return PressureSolver(self._robot, design.task)

    def _take(
        self, design: Design, solver: PressureSolver, solution: PressureSolution, *, is_best: bool
    ) -> None:
        plain = None
        if solution.found and design.task.measures and (is_best or self._plain_takes < _CHEAP):
            begin = perf_counter()
            plain = stiffness_blind(solver, solution)
            self._plain_takes = perf_counter() - begin
        self.answer = StudioAnswer(design, solution, plain, is_best)
        self.trouble = ""


def _is_better(solution: PressureSolution, before: StudioAnswer) -> bool:
    if solution.found != before.solution.found:
        return solution.found
    new, old = least_maximised(solution), least_maximised(before.solution)
    return not solution.found or new is None or old is None or new > old * (1 + _BETTER)


class NewestWins:
    """A thread that serves the newest of many requests: first quickly, then, at rest, fully.

    Parameters
    ----------
    quickly, fully : called after a request, and once no request has come for `REST` seconds. Their
        argument is a function that returns whether a newer request has come.

    Attributes
    ----------
    delays : seconds from the latest requests to the end of their quick answers.
    """

    def __init__(
        self, quickly: Callable[[Cancel], object], fully: Callable[[Cancel], object]
    ) -> None:
        self.delays: deque[float] = deque(maxlen=2000)
        self._quickly, self._fully = quickly, fully
        self._wanted = threading.Event()
        self._since = 0.0
        self._is_over = False
        self._thread = threading.Thread(target=self._run, name="answers", daemon=True)
        self._thread.start()

    def request(self) -> None:
        """Request a solution; returns at once."""
        if not self._wanted.is_set():
            self._since = perf_counter()
        self._wanted.set()

    def close(self) -> None:
        """Cancel the search and end the thread."""
        self._is_over = True
        self._wanted.set()
        self._thread.join()

    def _run(self) -> None:
        while True:
            self._wanted.wait()
            if self._is_over:
                return
            since = self._since
            self._wanted.clear()
            self._quickly(lambda: self._is_over)
            self.delays.append(perf_counter() - since)
            if not self._wanted.wait(REST):
                self._fully(self._wanted.is_set)
