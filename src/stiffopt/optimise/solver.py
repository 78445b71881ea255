"""`PressureSolver`: find the stiffest pressures for a task.

It tries `compiled_search.CompiledSearch` first and, without machine code or without an answer,
`general_search.GeneralSearch`.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import InputError, StoppedError, shown
from stiffopt.model.arguments import checked_integer, checked_vector
from stiffopt.model.compiled import (
    CodeReadyError,
    Stopwatch,
    compilation_is_held_off,
    compiling_at_once,
    until_ready,
)
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.stopping import Cancel, checkpoint, giving_up, stop_flag
from stiffopt.optimise.answers import Answers
from stiffopt.optimise.braced import lean
from stiffopt.optimise.compiled_search import CompiledSearch
from stiffopt.optimise.fast import FastSolver
from stiffopt.optimise.general_search import GeneralSearch
from stiffopt.optimise.leaning import BracedProblem
from stiffopt.optimise.prepared import prepared
from stiffopt.optimise.problem import PressureProblem
from stiffopt.optimise.program import Program
from stiffopt.optimise.reach import can_reach
from stiffopt.optimise.samples import SampleTable
from stiffopt.optimise.search import starts
from stiffopt.optimise.solution import Judgement, PressureSolution, are_within
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.optimise.warm import WarmAnswer, WarmCalls, task_with_target


class PressureSolver:
    """Solver for one kind of task on one arm; reusable work is done once.

    Parameters
    ----------
    robot : Manipulator
        The arm; a load of the task is put on it.
    task : Task
    seed : int
        Seed of the global search.  The same seed gives the same answer.

    Raises
    ------
    InputError
        If the task's pressure limits do not suit the robot.
    """

    def __init__(self, robot: Manipulator, task: Task, *, seed: int = 0) -> None:
        if not isinstance(robot, Manipulator):
            raise InputError(f"robot must be a Manipulator, see load_robot; got {shown(robot)}")
        if not isinstance(task, Task):
            raise InputError(f"task must be a Task, see load_task; got {shown(task)}")
        self.task, self._given = task, robot
        self.seed = checked_integer("seed", seed, 0)
        self._prepared = prepared(robot, task, self.seed)
        self.robot = self._prepared.robot
        self._answers = Answers(self._prepared, partial(_at_once, robot, self.seed))
        self._search = CompiledSearch(self._answers)
        self._generally = GeneralSearch(self._answers)
        self._warm_calls: WarmCalls | None = None

    def solve(
        self,
        target: Target | None = None,
        guess: ArrayLike | None = None,
        *,
        timeout: float | None = None,
        cancel: Cancel | None = None,
    ) -> PressureSolution:
        """Solve for the task's target, or for another one.

        Parameters
        ----------
        target : Target, optional
            Replaces the task's target.
        guess : (n,), optional
            Pressures in Pa near the answer, for example the previous one.  The answer is then the
            local optimum next to it.  If none is found there, the search is global.
        timeout : float, optional
            Seconds after which to give up.  The answer is then the best one found that holds, with
            ``confidence.complete`` false; without one its status is "failed".  Work that is done
            once for a kind of task (formulas, machine code) is always completed.
        cancel : threading.Event or callable, optional
            Gives up in the same way as soon as the event is set or the callable returns true.  It
            is polled every 10 ms, possibly from another thread.
        """
        watch = Stopwatch()
        task, start = self._aimed_at(target), self._checked(guess)
        with giving_up(timeout, cancel):
            solution = self._found(task, start)
        solution.timings.update(watch.timings())
        return _pressed(self, solution)

    def warm(
        self,
        position: ArrayLike | None,
        guess: ArrayLike,
        *,
        pointing: ArrayLike | None = None,
        orientation: ArrayLike | None = None,
        limits: tuple[ArrayLike, ArrayLike] | None = None,
        timeout: float | None = None,
        cancel: Cancel | None = None,
    ) -> WarmAnswer:
        """Find the answer next to a guess with as little overhead as possible.

        Parameters
        ----------
        position : (3,) or None
            Replaces the position of the task's target, in m; axes that are free there stay free.
        guess : (n,)
            Pressures in Pa near the answer.  If there is none next to them, the search is global.
        pointing : (3,), optional
            Replaces the direction of the task's target.
        orientation : (4,), optional
            Replaces the unit quaternion (w, x, y, z) of the task's target.
        limits : two (n,), optional
            Lowest and highest pressures in Pa; they can only narrow the task's limits.
        timeout, cancel : optional
            When to give up, see `solve`.  An answer that is not `found` by then has no pressures,
            or pressures that do not hold.

        Raises
        ------
        InputError
            If an argument is wrong, or replaces a part that the task's target does not have.
        """
        if timeout is not None or cancel is not None:
            with giving_up(timeout, cancel), stop_flag() as stop:
                return self._warm(position, guess, pointing, orientation, limits, stop)
        return self._warm(position, guess, pointing, orientation, limits)

    def _warm(
        self, position: Any, guess: Any, pointing: Any, orientation: Any, limits: Any, stop: int = 0
    ) -> WarmAnswer:
        """Implement `warm`; `stop` is the address of a `StopFlag`, or 0."""
        calls = self._warm_calls or self._prepare_warm_calls()
        if calls is not None and limits is None:
            block = calls.next_to(guess, position, pointing, orientation, stop)
            if block is not None:
                return WarmAnswer(calls.fast.pressures(block), self, block)
        task = task_with_target(self.task, position, pointing, orientation)
        p = checked_vector("guess", guess, self.robot.n_pressures)
        return self._warm_otherwise(task, p, limits)

    def reachable(
        self,
        target: Target | None = None,
        *,
        timeout: float | None = None,
        cancel: Cancel | None = None,
    ) -> bool:
        """Return whether the arm can meet a target (default: the task's), whatever its stiffness.

        The samples whose tips are nearest to the target are brought to it one by one.  True: one
        arrived, so pressures within the limits are known to meet all tolerances.  False: none
        arrived.  That is no proof, but such a target is rarely reachable; `solve` reports how far
        the arm stays from it.

        Raises
        ------
        OutOfTimeError, CancelledError
            If `timeout` or `cancel` (see `solve`) ended the search before it was decided.
        """
        task = self._aimed_at(target)
        with giving_up(timeout, cancel):
            fast = self._search.fast(task.unbraced, None)
            if fast is not None:
                found = fast[0].can_reach(fast[1])
            else:
                problem = PressureProblem(self.robot, task)
                candidates, effort = starts(problem, self._prepared.samples)
                found = can_reach(problem, list(islice(candidates, effort.screened)))
            if not found and task.brace is not None:
                found = self._found(task, None).found
            if not found:
                checkpoint()
            return found

    def follow(
        self, guess: ArrayLike, *, timeout: float | None = None, cancel: Cancel | None = None
    ) -> PressureSolution:
        """Return an answer for interactive display: sooner than `solve`, even where out of reach.

        If there is none next to the guess, (n,) in Pa, this is the closest configuration found from
        there.  Only for a pose that can be reached does a global search follow.  See `solve`.
        """
        start = self._checked(guess)
        with giving_up(timeout, cancel):
            calls = self._warm_calls or self._prepare_warm_calls()
            block = None if calls is None else calls.next_to(start, None, None, None)
            try:
                found = self._solution_of(block) if block is not None else None
                found = found or self._search.nearest(self.task, start)
            except StoppedError as error:
                return PressureSolution("failed", str(error), self.task)
            return _pressed(self, found or self._found(self.task, start))

    def solve_at_once(
        self,
        target: Target | None = None,
        guess: ArrayLike | None = None,
        limits: tuple[Array, Array] | None = None,
    ) -> PressureSolution | None:
        """Solve by the compiled search alone, in about a millisecond; for control loops.

        Parameters
        ----------
        target, guess :
            As for `solve`.
        limits : two (n,), optional
            Lowest and highest pressures in Pa, within those of the task.

        Returns
        -------
        PressureSolution or None
            None if that search has no machine code, or finds no answer that holds.  `solve` would
            go on with the general method, which may take minutes for an arm under gravity.
        """
        return self._search.solve(self._aimed_at(target), self._checked(guess), limits)

    def __repr__(self) -> str:
        return f"PressureSolver({self._given!r}, {self.task!r})"

    @property
    def is_compiled(self) -> bool:
        """Whether there is machine code for the task; if not, it is compiled in the background."""
        return self._search.fast(self.task.unbraced, None) is not None

    def compile(self) -> bool:
        """Wait for the task's machine code, unless an arm is armed; return `is_compiled`."""
        if not compilation_is_held_off():
            with compiling_at_once():
                return self.is_compiled
        return self.is_compiled

    def __reduce__(self) -> tuple[object, ...]:
        """Support pickling: keep the arm and the task, and prepare the rest again."""
        return partial(PressureSolver, seed=self.seed), (self._given, self.task)

    def _aimed_at(self, target: Target | None) -> Task:
        """Return the task with another target, if one is given."""
        if target is None:
            return self.task
        if not isinstance(target, Target):
            raise InputError(f"target must be a Target; got {shown(target)}")
        return self.task.model_copy(update={"target": target})

    # -- warm calls -------------------------------------------------------------------------

    def _prepare_warm_calls(self) -> WarmCalls | None:
        """Return memory for warm calls; None until code is compiled, or for a task with a brace."""
        if self.task.brace is not None:
            return None
        program = self._prepared.program(self.task.target)
        fast = self._prepared.fast(program)
        if fast is not None:
            self._warm_calls = WarmCalls(*fast, program)
        return self._warm_calls

    def _warm_otherwise(
        self, task: Task, guess: Array, limits: tuple[ArrayLike, ArrayLike] | None
    ) -> WarmAnswer:
        """Answer a warm call that `WarmCalls` cannot; all arguments but the limits are checked."""
        narrow = None
        if limits is not None:
            n, own = self.robot.n_pressures, self._prepared
            low = np.maximum(checked_vector("the lower limits", limits[0], n), own.lower)
            high = np.minimum(checked_vector("the upper limits", limits[1], n), own.upper)
            if (low > high).any():
                raise InputError("limits leave a channel no pressure that the task permits")
            narrow = low, high
            pressure = PressureRange(min=tuple(low.tolist()), max=tuple(high.tolist()))
            task = task.model_copy(update={"pressure": pressure})
        if self._warm_calls is not None:
            solution = self._search.solve(task, guess, narrow)
        else:
            start = guess if narrow is None else np.clip(guess, *narrow)
            solution = PressureSolver(self._given, task, seed=self.seed).solve(guess=start)
        solution = solution if solution is not None and solution.found else None
        return WarmAnswer.judged(None if solution is None else solution.pressures, solution)

    def _confirms(self, block: Array) -> bool:
        """Return whether the model confirms an answer of a warm call."""
        calls = self._warm_calls
        assert calls is not None  # or there would be no block
        answer = calls.fast.judged(block)
        if answer is None:
            return False
        within = are_within(answer.pressures, self._prepared.lower, self._prepared.upper)
        return Judgement.of(calls.program, answer.judged, within).holds

    def _solution_of(self, block: Array) -> PressureSolution | None:
        """Return the solution for an answer of a warm call; None if it does not hold."""
        calls = self._warm_calls
        assert calls is not None
        task = calls.task_of(block, self.task)
        return self._answers.if_it_holds(
            task, self._prepared.program(task.target), calls.fast.judged(block)
        )

    # -- solutions --------------------------------------------------------------------------

    def _found(self, task: Task, guess: Array | None) -> PressureSolution:
        if task.brace is not None:
            return self._leaning(task, guess)
        return self._search.solve(task, guess) or self._otherwise(task, guess)

    def _leaning(self, task: Task, guess: Array | None) -> PressureSolution:
        """Return the better of the best answer that leans on objects and the best that does not."""
        plain = task.unbraced
        free = self._found(plain, guess)
        if free.status == "failed":
            return replace(free, task=task)
        fast = self._search.fast(plain, None)
        table = self._prepared.samples if fast is None else fast[0].table

        def samples() -> SampleTable:
            return table if table.arm is None else self._prepared.samples_to_lean(table.arm)

        return lean(BracedProblem(self.robot, task), samples, free, guess)

    def _otherwise(self, task: Task, guess: Array | None) -> PressureSolution:
        """Answer a task for which the compiled search found no solution."""
        try:
            checkpoint()
            found = self._search.nearest(task)
            if found is None and task.scene is not None:
                found = self._search.among_obstacles(task)
            return found or self._general(task, guess)
        except StoppedError as error:
            return PressureSolution("failed", str(error), task)

    def _general(self, task: Task, guess: Array | None) -> PressureSolution:
        """Answer by the general method, or by the compiled search once its code is ready."""
        awaited = self._search.fast(task, None) is None
        try:
            with until_ready(lambda: awaited and self._search.fast(task, None) is not None):
                return self._generally.solve(task, guess)
        except CodeReadyError:
            found = self._search.solve(task, guess) or self._search.nearest(task)
            return found or self._generally.solve(task, guess)

    def _checked(self, guess: ArrayLike | None) -> Array | None:
        if guess is None:
            return None
        return checked_vector("guess", guess, self.robot.n_pressures)


def solve_pressure(
    robot: Manipulator,
    task: Task,
    guess: ArrayLike | None = None,
    *,
    seed: int = 0,
    timeout: float | None = None,
    cancel: Cancel | None = None,
) -> PressureSolution:
    """Find the pressures that reach a task's pose and best meet its stiffness goal.

    An unreachable target raises nothing: the solution reports it and holds the closest
    configuration.  See `PressureSolver` for many similar tasks, and for the arguments.
    """
    solver = PressureSolver(robot, task, seed=seed)
    return solver.solve(guess=guess, timeout=timeout, cancel=cancel)


def solve_batch(
    robot: Manipulator,
    tasks: Iterable[Task],
    guesses: Iterable[ArrayLike | None] | None = None,
    *,
    seed: int = 0,
    threads: int | None = None,
    timeout: float | None = None,
    cancel: Cancel | None = None,
) -> list[PressureSolution]:
    """Solve many tasks on one arm, on all cores; the solutions are those of `solve_pressure`.

    Parameters
    ----------
    robot : Manipulator
    tasks : iterable of Task
        They may differ in anything; tasks of the same structure share machine code.
    guesses : iterable, optional
        Pressures (n,) in Pa or None for each task, see `PressureSolver.solve`.
    seed : int
        Seed of the global search.
    threads : int, optional
        Default: one for each core.  The solutions do not depend on it.
    timeout, cancel : optional
        For all tasks together, see `PressureSolver.solve`.  Tasks solved by then keep their
        solutions; the status of the others is "failed".

    Raises
    ------
    InputError
        If an argument is wrong or a task's pressure limits do not suit the robot.  No task is
        solved then.
    """
    watch = Stopwatch()
    if threads is not None:
        threads = checked_integer("threads", threads, 1)
    if isinstance(tasks, Task) or not isinstance(tasks, Iterable):
        raise InputError(f"tasks must be several tasks, in a list for example; got {shown(tasks)}")
    if guesses is not None and not isinstance(guesses, Iterable):
        raise InputError(f"guesses must be one for each task; got {shown(guesses)}")
    tasks = list(tasks)
    starts = [None] * len(tasks) if guesses is None else list(guesses)
    if len(starts) != len(tasks):
        raise InputError(
            f"expected a guess or None for each of {len(tasks)} tasks; got {len(starts)}"
        )
    solvers = [PressureSolver(robot, task, seed=seed) for task in tasks]
    checked = [solver._checked(guess) for solver, guess in zip(solvers, starts, strict=True)]
    with giving_up(timeout, cancel):
        return _solved(list(zip(solvers, tasks, checked, strict=True)), threads, watch)


def _solved(
    jobs: list[tuple[PressureSolver, Task, Array | None]],
    threads: int | None,
    watch: Stopwatch,
) -> list[PressureSolution]:
    """Solve checked tasks; tasks of one structure are solved together."""
    found: dict[int, PressureSolution | None] = {}
    groups: dict[FastSolver, list[tuple[int, Array, Program]]] = {}
    for index, (solver, task, guess) in enumerate(jobs):
        fast = solver._search.fast(task, guess)
        if fast is not None:
            groups.setdefault(fast[0], []).append((index, *fast[1:]))
    for fast_solver, members in groups.items():
        answers = fast_solver.solve_all(np.stack([row for _, row, _ in members]), threads)
        for (index, _, program), answer in zip(members, answers, strict=True):
            solver, task, _ = jobs[index]
            found[index] = solver._answers.if_it_holds(task, program, answer)
    shares = {name: time / max(1, len(jobs)) for name, time in watch.timings().items()}
    solutions = []
    for index, (solver, task, guess) in enumerate(jobs):
        watch = Stopwatch()
        solution = found.get(index)
        if index not in found:  # machine code may have become ready meanwhile
            solution = solver._found(task, guess)
        solution = solution or solver._otherwise(task, guess)
        solution.timings.update(shares)
        for name, time in watch.timings().items():
            solution.timings[name] = shares.get(name, 0.0) + time
        solutions.append(_pressed(solver, solution))
    return solutions


def _at_once(robot: Manipulator, seed: int, task: Task) -> PressureSolution | None:
    return PressureSolver(robot, task, seed=seed).solve_at_once()


def _pressed(solver: PressureSolver, solution: PressureSolution) -> PressureSolution:
    """Return a solution that says if its press is too hard, or cannot be felt there."""
    press, pose, compliance = solution.task.press, solution.tip_pose, solution.compliance
    if press is None or solution.status == "failed" or pose is None or compliance is None:
        return solution
    if not solution.found:
        if not (solution.position_error or 0.0) > solution.task.target.tolerance.position:
            return solution
        plain = solution.task.model_copy(update={"stiffness": None, "press": None})
        if not PressureSolver(solver._given, plain, seed=solver.seed).solve().found:
            return solution
        reached = solution.message.removeprefix("unreachable: ")
        why = f"the arm reaches this pose, but cannot hold {press.force:g} N there"
        return replace(solution, message=f"{why}; while it presses, {reached}")
    R = pose[:3, :3]
    reason = press.refusal(R, R @ compliance[:3, :3] @ R.T)
    return replace(solution, status="unreachable", message=reason) if reason else solution


def stiffness_blind(solver: PressureSolver, solution: PressureSolution) -> PressureSolution:
    """Return the plain solution: the pose of a solution with the least pressure."""
    plain = {"stiffness": None, "load": None, "press": None, "brace": None}
    blind = PressureSolver(solver.robot, solution.task.model_copy(update=plain), seed=solver.seed)
    return blind.solve(guess=solution.pressures)
