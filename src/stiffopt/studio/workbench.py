"""The answers of a design: quick ones while it is changed, the best one when it rests.

`Workbench` holds what is shown; it can be used without any view. `NewestWins` is the thread that
asks it, so that no event of a browser waits for a search.
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
"""Seconds without a change after which the best answer is searched for."""
_BETTER = 1e-3  # relative, of a stiffness, for which an arm at rest may jump to another answer
_CHEAP = 5e-3  # s that plain pressures may take while the arm is dragged
_STEPS = 200  # that can be undone


@dataclass(frozen=True, eq=False)
class StudioAnswer:
    """The answer to a design.

    Attributes
    ----------
    design : what it answers.
    solution : the pressures, and what the model says of them.
    plain : the same pose with the least pressure, or None where that is not known.
    is_best : whether it was searched for everywhere, and not only next to the previous one.
    """

    design: Design
    solution: PressureSolution
    plain: PressureSolution | None
    is_best: bool

    @property
    def pressures(self) -> NDArray[np.float64]:
        """In Pa (n,); of a search that failed there is no answer."""
        assert self.solution.pressures is not None
        return self.solution.pressures

    @property
    def robot(self) -> Manipulator:
        """The arm with the task's load."""
        assert self.solution.robot is not None
        return self.solution.robot

    @cached_property
    def at_limit(self) -> NDArray[np.int_]:
        """At which limit each pressure (n,) is: -1 at the lowest, 1 at the highest, else 0."""
        found = np.zeros(len(self.pressures), dtype=int)
        for channel, side in active_bounds(self.robot, self.design.task, self.pressures).values():
            found[channel] = side
        return found

    @property
    def plain_stiffness(self) -> float | None:
        """What the plain pressures have of the first stiffness that the task names."""
        measures = self.design.task.measures
        if self.plain is None or self.plain.pressures is None or not measures:
            return None
        m = measures[0]
        value = self.robot.stiffness(self.plain.pressures, m.direction, m.kind, m.boundary, m.frame)
        return float(value)


class Workbench:
    """A design, its history, its answer, and the answers that were kept.

    Any thread may change the design; one thread asks for answers.

    Attributes
    ----------
    design : what is shown now.
    answer : the newest answer, which may be to an earlier design, or None.
    kept : answers to compare with.
    leaning : the arm as it leans on objects at held pressures, or None.
    trouble : why there is no answer to the design, or an empty text.
    """

    def __init__(self, design: Design) -> None:
        self.design = design
        self.answer: StudioAnswer | None = None
        self.kept: list[StudioAnswer] = []
        self.leaning: Leaning | None = None
        self.trouble = ""
        self._held: NDArray[np.float64] | None = None  # pressures, in Pa
        self._past: deque[Design] = deque(maxlen=_STEPS)
        self._step = ""
        self._robot: Manipulator | None = None
        self._plain_takes = float("inf")  # s
        self._lock = threading.RLock()

    def change(self, kind: str, change: Callable[[Design], Design]) -> bool:
        """Change the design; changes of one kind that follow each other are one step to undo.

        Returns False, and leaves the design as it is, if nothing changes.

        Raises
        ------
        InputError
            The change makes no sense; the design is as it was.
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
        """The next change is a step of its own to undo."""
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
        """Keep the answer to compare others with it; return False if there is none."""
        if self.answer is None or any(self.answer is each for each in self.kept):
            return False
        self.kept.append(self.answer)
        return True

    # -- leaning ------------------------------------------------------------------------------

    def hold(self, *, held: bool) -> None:
        """Hold the pressures of the answer, so that the arm leans on objects; or no longer.

        Raises
        ------
        InputError
            There is no answer.
        """
        if held and self.answer is None:
            raise InputError("there are no pressures to hold yet")
        with self._lock:
            self._held = self.answer.pressures if held and self.answer is not None else None
            self.leaning = None

    def _lean(self, design: Design, pressures: NDArray[np.float64]) -> bool:
        self.leaning = None
        self.leaning = Leaning.of(design, self._solver(design).robot, pressures)
        self.trouble = ""
        return True

    # -- answers ------------------------------------------------------------------------------

    def answer_quickly(self, cancel: Cancel) -> bool:
        """Look next to the previous answer; return whether there is an answer now."""
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
        """Search everywhere; return whether there is another answer now."""
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
        """A solver on the robot of before, if it is the same: what was prepared for it is kept."""
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
    """A thread that answers the newest of many requests, first quickly, at rest in full.

    Parameters
    ----------
    quickly, fully :
        What it calls, with a function that says whether a newer request has come: after a request,
        and when none has come for `REST` seconds after that.

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
        """Ask for an answer; returns at once."""
        if not self._wanted.is_set():
            self._since = perf_counter()
        self._wanted.set()

    def close(self) -> None:
        """End; what is being searched for is given up."""
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
