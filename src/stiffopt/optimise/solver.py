"""From a task to the stiffest pressures: global search, judgement and diagnosis."""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import EquilibriumError, InputError, StoppedError, shown
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
from stiffopt.optimise import diagnosis
from stiffopt.optimise.braced import lean
from stiffopt.optimise.fast import CompiledAnswer, FastSolver
from stiffopt.optimise.leaning import BracedProblem
from stiffopt.optimise.local import LocalResult, descend
from stiffopt.optimise.prepared import prepared
from stiffopt.optimise.problem import PressureProblem, ProgramPoint
from stiffopt.optimise.program import Program
from stiffopt.optimise.reach import comes, reach
from stiffopt.optimise.search import Search, search, starts
from stiffopt.optimise.settings import ANSWER, CLOSEST, OBSTACLES, PRICES, Effort
from stiffopt.optimise.solution import (
    Confidence,
    Explanation,
    Judgement,
    PressureSolution,
    Sensitivities,
    active_bounds,
    are_within,
    judge,
)
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.optimise.warm import WarmAnswer, WarmCalls, asked_task

Vector = NDArray[np.float64]

_ONE = Effort(1, 1, 1)


class PressureSolver:
    """Solver of one kind of task on one arm; what can be prepared is prepared once.

    Parameters
    ----------
    robot : Manipulator
        The arm; a load of the task is put on it.
    task : Task
    seed : int
        Of the global search.  The same seed gives the same answer.

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
            Instead of the task's.
        guess : (n,), optional
            Pressures in Pa near the answer, for example the previous one: the answer is then
            the local optimum next to it.  If none is found there, the search is global.
        timeout : float, optional
            Seconds after which to give up.  The answer is then the best that was found and holds,
            with a confidence that is not complete, or its status is "failed" if there is none.
            What is made once for a kind of task (formulas, machine code) is made to the end.
        cancel : threading.Event or callable, optional
            Give up in the same way as soon as it is set, or says true; it is asked every 10 ms,
            maybe by another thread.
        """
        if target is not None and not isinstance(target, Target):
            raise InputError(f"target must be a Target; got {shown(target)}")
        watch = Stopwatch()
        start = self._checked(guess)
        task = self.task if target is None else self.task.model_copy(update={"target": target})
        with giving_up(timeout, cancel):
            solution = self._found(task, start)
        solution.timings.update(watch.timings())
        return _felt(solution)

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
        """The answer next to a guess, with as little as possible around the search for it.

        Parameters
        ----------
        position : (3,) or None
            Instead of the position in the task's target, in m; axes that are free there stay so.
        guess : (n,)
            Pressures in Pa near the answer.  If there is none next to them, the search is global.
        pointing : (3,), optional
            Instead of the direction in the task's target.
        orientation : (4,), optional
            Instead of the unit quaternion (w, x, y, z) in the task's target.
        limits : two (n,), optional
            Lowest and highest pressures in Pa, where they are narrower than the task's.
        timeout, cancel : optional
            When to give up, see `solve`; what is not `found` by then has no pressures, or some
            that do not hold.

        Raises
        ------
        InputError
            If an argument is wrong, or not a part of the task's target.
        """
        if timeout is not None or cancel is not None:
            with giving_up(timeout, cancel), stop_flag() as stop:
                return self._warm(position, guess, pointing, orientation, limits, stop)
        return self._warm(position, guess, pointing, orientation, limits)

    def _warm(
        self, position: Any, guess: Any, pointing: Any, orientation: Any, limits: Any, stop: int = 0
    ) -> WarmAnswer:
        """See `warm`; `stop` is the address of a `StopFlag`."""
        calls = self._warm_calls or self._prepare_warm_calls()
        if calls is not None and limits is None:
            block = calls.next_to(guess, position, pointing, orientation, stop)
            if block is not None:
                return WarmAnswer(calls.fast.pressures(block), self, block)
        task = asked_task(self.task, position, pointing, orientation)
        p = checked_vector("guess", guess, self.robot.n_pressures)
        return self._warm_otherwise(task, p, limits)

    def reachable(
        self,
        target: Target | None = None,
        *,
        timeout: float | None = None,
        cancel: Cancel | None = None,
    ) -> bool:
        """Whether the arm comes to a target (the task's, or another one); stiffness left aside.

        The configurations nearest to the target, of those that were sampled over the range of
        pressures, are brought to it one by one.  True: one of them came, so pressures within the
        limits are known that meet all tolerances.  False: none did, which is no proof, but rare
        for a target that can be had; `solve` says how far the arm is from it.

        Raises
        ------
        OutOfTimeError, CancelledError
            Where `timeout` or `cancel`, as those of `solve`, ended it before it was known.
        """
        if target is not None and not isinstance(target, Target):
            raise InputError(f"target must be a Target; got {shown(target)}")
        task = self.task if target is None else self.task.model_copy(update={"target": target})
        with giving_up(timeout, cancel):
            fast = self._fast(task.unbraced, None)
            if fast is not None:
                found = fast[0].comes(fast[1])
            else:
                problem = PressureProblem(self.robot, task)
                candidates, effort = starts(problem, self._prepared.samples)
                found = comes(problem, list(islice(candidates, effort.screened)))
            if not found and task.brace is not None:
                found = self._found(task, None).found
            if not found:
                checkpoint()
            return found

    def solve_at_once(
        self,
        target: Target | None = None,
        guess: ArrayLike | None = None,
        limits: tuple[Vector, Vector] | None = None,
    ) -> PressureSolution | None:
        """Solve by the compiled search alone, in a millisecond or so; for control loops.

        Parameters
        ----------
        target, guess :
            As for `solve`.
        limits : two (n,), optional
            Lowest and highest pressures in Pa, within those of the task.

        Returns
        -------
        None where that search finds no answer that holds, or is not to be had; `solve` would then
        go on by its general method, which may take minutes for an arm under gravity.
        """
        task = self.task if target is None else self.task.model_copy(update={"target": target})
        return self._compiled(task, self._checked(guess), limits)

    def __repr__(self) -> str:
        return f"PressureSolver({self._given!r}, {self.task!r})"

    @property
    def is_compiled(self) -> bool:
        """Whether there is compiled code for the task; if not, it is made in the background."""
        return self._fast(self.task.unbraced, None) is not None

    def compile(self) -> bool:
        """Wait for compiled code for the task, unless an arm is armed; return `is_compiled`."""
        if not compilation_is_held_off():
            with compiling_at_once():
                return self.is_compiled
        return self.is_compiled

    def __reduce__(self) -> tuple[object, ...]:
        """Support pickling: the arm and the task are kept, and what was prepared is made anew."""
        return partial(PressureSolver, seed=self.seed), (self._given, self.task)

    # -- warm calls -------------------------------------------------------------------------

    def _prepare_warm_calls(self) -> WarmCalls | None:
        """Memory for warm calls, once there is compiled code; none for a task with a brace."""
        if self.task.brace is not None:
            return None
        program = self._prepared.program(self.task.target)
        fast = self._prepared.fast(program)
        if fast is not None:
            self._warm_calls = WarmCalls(*fast, program)
        return self._warm_calls

    def _warm_otherwise(
        self, task: Task, guess: Vector, limits: tuple[ArrayLike, ArrayLike] | None
    ) -> WarmAnswer:
        """Answer where the leanest call has none; all but the limits is checked."""
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
            solution = self._compiled(task, guess, narrow)
        else:
            start = guess if narrow is None else np.clip(guess, *narrow)
            solution = PressureSolver(self._given, task, seed=self.seed).solve(guess=start)
        solution = solution if solution is not None and solution.found else None
        return WarmAnswer.judged(None if solution is None else solution.pressures, solution)

    def _confirms(self, block: Vector) -> bool:
        """Whether the model confirms an answer of a warm call."""
        calls = self._warm_calls
        assert calls is not None  # or there would be no block
        answer = calls.fast.judged(block)
        if answer is None:
            return False
        within = are_within(answer.pressures, self._prepared.lower, self._prepared.upper)
        return Judgement.of(calls.program, answer.judged, within).holds

    def _solution_of(self, block: Vector) -> PressureSolution | None:
        """Solution from an answer of a warm call; None if it does not hold."""
        calls = self._warm_calls
        assert calls is not None
        task = calls.task_of(block, self.task)
        return self._accepted(task, self._prepared.program(task.target), calls.fast.judged(block))

    # -- solutions --------------------------------------------------------------------------

    def _found(self, task: Task, guess: Vector | None) -> PressureSolution:
        if task.brace is not None:
            return self._leaning(task, guess)
        return self._compiled(task, guess) or self._otherwise(task, guess)

    def _leaning(self, task: Task, guess: Vector | None) -> PressureSolution:
        """The better of the best answer that leans on objects and the best that does not."""
        plain = task.unbraced
        free = self._found(plain, guess)
        if free.status == "failed":
            return replace(free, task=task)
        fast = self._fast(plain, None)
        table = self._prepared.samples if fast is None else fast[0].table
        return lean(BracedProblem(self.robot, task), table, free, guess)

    def _compiled(
        self, task: Task, guess: Vector | None, limits: tuple[Vector, Vector] | None = None
    ) -> PressureSolution | None:
        """Answer of the compiled solver, if there is one that holds."""
        if limits is not None and guess is not None:
            guess = np.clip(guess, *limits)
        fast = self._fast(task, guess)
        if fast is None:
            return None
        solver, row, program = fast
        if limits is not None:
            solver.limit(row, *limits)
        return self._accepted(task, program, solver.solve(row))

    def _fast(self, task: Task, guess: Vector | None) -> tuple[FastSolver, Vector, Program] | None:
        """Compiled solver of a task, its row of numbers and its program; none knows of contacts."""
        if task.brace is not None:
            return None
        program = self._prepared.program(task.target)
        fast = self._prepared.fast(program)
        if fast is None:
            return None
        solver, row = fast
        return solver, solver.with_target(row, program, guess), program

    def _accepted(
        self, task: Task, program: Program, answer: CompiledAnswer | None
    ) -> PressureSolution | None:
        """Solution from an answer of the compiled solver, if it holds."""
        if answer is None:
            return None
        p = answer.pressures
        within = are_within(p, self._prepared.lower, self._prepared.upper)
        judgement = Judgement.of(program, answer.judged, within)
        if not judgement.holds:
            return None

        def explain() -> Explanation:
            problem = PressureProblem(self.robot, task)
            point = problem.point(p / problem.unit)
            result = LocalResult.at(problem, point)
            return self._explanation(problem, result, judgement, p)

        fields = self._quantities(task, judgement)
        fields.update(
            status="solved",
            pressures=p,
            confidence=answer.confidence,
            counts=answer.counts,
            timings={},
        )
        return PressureSolution.explained_later(explain, fields)

    def _otherwise(self, task: Task, guess: Vector | None) -> PressureSolution:
        """Answer where the compiled search has none."""
        try:
            checkpoint()
            found = self._nearest(task)
            if found is None and task.scene is not None:
                found = self._among_obstacles(task)
            return found or self._general(task, guess)
        except StoppedError as error:
            return PressureSolution("failed", str(error), task)

    def _nearest(self, task: Task, start: Vector | None = None) -> PressureSolution | None:
        """Closest configuration by compiled code; None if the pose can be had, or for no code.

        Among obstacles the answer from there, if the pose can be had.  A start (n,) is in Pa.
        """
        fast = self._fast(task, None)
        answer = None if fast is None else fast[0].closest(fast[1], start)
        checkpoint()  # a search that was cut short proves nothing
        if fast is None or answer is None or answer.slope is None:
            return None
        p = answer.pressures
        within = are_within(p, self._prepared.lower, self._prepared.upper)
        judgement = Judgement.of(fast[2], answer.judged, within)
        if judgement.pose_holds and task.scene is not None:
            return self._compiled(task, p)
        if judgement.pose_holds or not within:
            return None
        active = active_bounds(self.robot, task, p)
        holding = [*map(repr, judgement.touched), *_pressed(active, -answer.slope)]
        message = diagnosis.unreachable_message(judgement, task, holding) + self._blocked(
            task, judgement.touched
        )

        def explain() -> Explanation:
            problem = PressureProblem(self.robot, task)
            last = diagnosis.last_stage(problem, judgement.errors)
            result = LocalResult.at(last, last.pose(p / problem.unit))
            return self._explanation(problem, result, judgement, p, message)

        fields = self._quantities(task, judgement)
        fields.update(
            status="unreachable",
            message=message,
            active_bounds=tuple(active),
            pressures=p,
            confidence=replace(answer.confidence, reached=0),  # none came to the pose
            counts=answer.counts,
            timings={},
        )
        return PressureSolution.explained_later(explain, fields)

    def _among_obstacles(self, task: Task) -> PressureSolution | None:
        """Answer of compiled code where neither search nor descents to the target had one.

        The pose can be had, but no stiffness that is demanded; or descents start from the clear
        sample nearest to the target, or from the clearest; or nothing is clear.
        """
        fast = self._fast(task, None)
        if fast is None or task.scene is None:
            return None
        solver, row, program = fast
        answer = solver.solve(row)
        checkpoint()
        if answer is not None:
            within = are_within(answer.pressures, self._prepared.lower, self._prepared.upper)
            judgement = Judgement.of(program, answer.judged, within)
            if judgement.pose_holds and judgement.is_clear and within and judgement.shortfalls:
                return self._too_soft(task, judgement, answer)
        samples = solver.table.pressures[: OBSTACLES.clearest]
        distances = self.robot.clearance(samples, task.scene)
        clear = distances >= task.scene.clearance
        far = solver.table.distances(program.terms, self.robot.length)[: len(samples)]
        start = np.where(clear, far, np.inf).argmin() if clear.any() else distances.argmax()
        found = self._nearest(task, samples[int(start)])
        if found is None and not clear.any():
            return self._clearest(task, samples, distances)
        return found

    def _too_soft(
        self, task: Task, judgement: Judgement, answer: CompiledAnswer
    ) -> PressureSolution:
        """The stiffest that was found, where more is demanded."""
        return PressureSolution(
            status="unreachable",
            message=diagnosis.demands_message(judgement),
            active_bounds=tuple(active_bounds(self.robot, task, answer.pressures)),
            **self._quantities(task, judgement),
            pressures=answer.pressures,
            confidence=answer.confidence,
            counts=answer.counts,
        )

    def _clearest(self, task: Task, samples: Vector, distances: Vector) -> PressureSolution:
        """Of configurations none of which keeps enough clearance the one with most of it."""
        p = samples[int(distances.argmax())]
        judgement = judge(self.robot, task, p)
        return PressureSolution(
            status="unreachable",
            message=diagnosis.no_way_message(judgement, task, len(samples)),
            active_bounds=tuple(active_bounds(self.robot, task, p)),
            **self._quantities(task, judgement),
            pressures=p,
            confidence=Confidence(len(samples), 0, 0, 0, complete=False),
        )

    def _general(self, task: Task, guess: Vector | None) -> PressureSolution:
        """Answer of the general method, or of the compiled solver if its code comes meanwhile."""
        awaited = self._fast(task, None) is None
        try:
            with until_ready(lambda: awaited and self._fast(task, None) is not None):
                return self._solve_generally(task, guess)
        except CodeReadyError:
            found = self._compiled(task, guess) or self._nearest(task)
            return found or self._solve_generally(task, guess)

    def _solve_generally(self, task: Task, guess: Vector | None) -> PressureSolution:
        try:
            return self._solve(PressureProblem(self.robot, task), guess)
        except EquilibriumError as error:
            return PressureSolution("failed", str(error), task)

    def _solve(self, problem: PressureProblem, guess: Vector | None) -> PressureSolution:
        if guess is not None:
            nearby = self._from_guess(problem, guess)
            if nearby is not None:
                return nearby
        found = search(problem, *starts(problem, self._prepared.samples))
        if not found.results:
            return self._closest(problem, found)
        if len(problem.floors) and not found.results[0].holds_floors:
            return self._without_floors(problem, found)
        at_once = self._judged(problem, found.results[0], found.confidence)
        return at_once or self._first_that_holds(problem, found)

    def _from_guess(self, problem: PressureProblem, guess: Vector) -> PressureSolution | None:
        problem.restart()
        point = reach(problem, np.clip(guess / problem.unit, problem.lower, problem.upper))
        if point is None or not point.reached:
            return None
        result = descend(problem, point)
        if not result.converged or not result.holds_floors:
            return None
        local = Confidence(1, 1, 1, 1, complete=False)
        at_once = self._judged(problem, result, local)
        if at_once is not None:
            return at_once
        solution = self._solution(problem, result, local)
        return solution if solution.found else None

    def _judged(
        self, problem: PressureProblem, result: LocalResult, confidence: Confidence
    ) -> PressureSolution | None:
        """Solution of an arm without loads, if it holds; it is explained when that is asked for."""
        if self.robot.is_loaded:
            return None
        p = np.clip(result.point.x * problem.unit, self._prepared.lower, self._prepared.upper)
        answer = CompiledAnswer(p, confidence, {}, problem.judged(p))
        return self._accepted(problem.task, problem.program, answer)

    def _first_that_holds(self, problem: PressureProblem, found: Search) -> PressureSolution:
        """Best local optimum that the model confirms from rest."""
        best: PressureSolution | None = None
        for result in found.results[: ANSWER.tried]:
            try:
                solution = self._solution(problem, result, found.confidence)
            except EquilibriumError:
                continue
            if solution.found:
                return solution
            best = best or solution
        if best is None:
            raise EquilibriumError(
                "the optima that were found are not reached continuously from rest: the arm "
                "buckles or falls over on the way; lower the pressure limits or the load"
            )
        return best

    # -- what cannot be had -----------------------------------------------------------------

    def _closest(self, problem: PressureProblem, found: Search) -> PressureSolution:
        """Closest configuration to a pose that no start came to."""
        near = sorted(found.nearest, key=_beyond)
        table = self._prepared.samples
        order = table.nearest_first(
            table.distances(problem.program.terms, self.robot.length), CLOSEST.samples
        )
        any_ = table.pressures[: 2 * CLOSEST.samples]
        sampled = np.concatenate([table.pressures[order], any_]) / problem.unit
        candidates = [*(point.x for point in near), *sampled]
        results = diagnosis.closest_configurations(problem, candidates)
        if results and _reaches(problem, results[0]):
            again = search(problem, [results[0].point.x], _ONE)
            if again.results:
                return self._first_that_holds(problem, again)
        results = results[:1]
        scene = problem.task.scene
        if not results and scene is not None:
            clearest = table.pressures[: CLOSEST.samples]
            clearest = clearest[np.argmax(self.robot.clearance(clearest, scene))]
            results = [diagnosis.unimproved(problem, clearest / problem.unit)]
        if self.robot.is_loaded:  # what is found need not be what is reached from rest
            as_they_are = (diagnosis.unimproved(problem, x) for x in candidates[: ANSWER.tried])
            results = [*results[: ANSWER.tried], *as_they_are]
        judged = []
        for result in results:
            try:
                judged.append(self._solution(problem, result, found.confidence))
            except EquilibriumError:
                continue  # not reached from rest
        if not judged:
            raise EquilibriumError("no stable equilibrium was found near the target")
        return min(judged, key=_distance)

    def _without_floors(self, problem: PressureProblem, found: Search) -> PressureSolution:
        """Best that can be had where a stiffness that is demanded was not found."""
        nearest = problem.changed(problem.best_floors(), floors=False)
        candidates = (result.point.x for result in found.results)
        best = search(nearest, candidates)
        if best.results and best.results[0].value <= 0:
            again = search(problem, [best.results[0].point.x], _ONE)
            if again.results and again.results[0].holds_floors:
                return self._first_that_holds(problem, again)
        return self._first_that_holds(nearest, best if best.results else found)

    # -- words and numbers ------------------------------------------------------------------

    def _solution(
        self, problem: PressureProblem, result: LocalResult, confidence: Confidence
    ) -> PressureSolution:
        """Judge a result and put it into words."""
        pressures = np.clip(
            result.point.x * problem.unit, self._prepared.lower, self._prepared.upper
        )
        judgement = judge(self.robot, problem.task, pressures)
        return PressureSolution(
            status="solved" if judgement.holds else "unreachable",
            **self._explanation(problem, result, judgement, pressures)._asdict(),
            **self._quantities(problem.task, judgement),
            pressures=pressures,
            confidence=confidence,
        )

    def _quantities(self, task: Task, judgement: Judgement) -> dict[str, Any]:
        """What a solution takes from its judgement."""
        return {
            "task": task,
            "robot": self.robot,
            "tip_pose": judgement.tip_pose,
            "errors": judgement.errors,
            "position_error": judgement.errors.get("position"),
            "angle_error": judgement.errors.get("angle"),
            "compliance": judgement.compliance,
            "stiffness": judgement.stiffnesses[0] if judgement.stiffnesses else None,
            "stiffness_unit": self._prepared.unit,
            "stiffnesses": judgement.stiffnesses,
            "matrix_distance": judgement.matrix_distance,
        }

    def _explanation(
        self,
        problem: PressureProblem,
        result: LocalResult,
        judgement: Judgement,
        pressures: Vector,
        message: str = "",
    ) -> Explanation:
        """Put a judged result into words, unless there are some already."""
        task = problem.task
        active = active_bounds(self.robot, task, pressures)
        sensitivities = self._sensitivities(problem, result, judgement, pressures, active)
        freedom = diagnosis.freedom(problem, pressures / problem.unit)
        if not message and not judgement.pose_holds:
            holding = [*map(repr, judgement.touched), *self._holding(result, active)]
            message = diagnosis.unreachable_message(judgement, task, holding) + self._blocked(
                task, judgement.touched
            )
        elif not message and not judgement.holds:
            message = diagnosis.demands_message(judgement)
        elif not message and freedom == 0 and task.stiffness is not None:
            message = diagnosis.no_freedom_message(task, self.robot.n_pressures, sensitivities)
        return Explanation(message, tuple(active), freedom, sensitivities)

    def _blocked(self, task: Task, touched: Iterable[str]) -> str:
        """What a scene keeps the arm from, if the task is solved without it."""
        if task.scene is None:
            return ""
        coarse = diagnosis.coarse_meshes(self.robot, task.scene, touched)
        plain = task.model_copy(update={"scene": None})
        found = PressureSolver(self._given, plain, seed=self.seed).solve_at_once()
        if found is None or not found.found or found.pressures is None:
            return coarse
        return diagnosis.in_the_way(self.robot, task.scene, found.pressures) + coarse

    @staticmethod
    def _holding(result: LocalResult, active: dict[str, tuple[int, int]]) -> list[str]:
        """Active limits that the closest configuration presses against."""
        if result.multipliers is None:
            return list(active)
        return _pressed(active, result.multipliers.bounds)

    def _sensitivities(
        self,
        problem: PressureProblem,
        result: LocalResult,
        judgement: Judgement,
        pressures: Vector,
        active: dict[str, tuple[int, int]],
    ) -> Sensitivities | None:
        prices = result.multipliers
        if prices is None:
            return None
        gradient = None
        if problem.task.measures:
            gradient = problem.task.measures[0].stiffness_gradient(self.robot, pressures)
        scale = result.objective.gain(result.point)

        per_tolerance: dict[str, float] = {}
        for ball, pull in zip(result.point.bounded, prices.balls, strict=True):
            price = scale * _clean(float(np.linalg.norm(pull)))
            per_tolerance[ball.name] = per_tolerance.get(ball.name, 0.0) + price
        return Sensitivities(
            tip_jacobian=self.robot.tip_jacobian(pressures),
            stiffness_gradient=gradient,
            per_bound={
                name: scale
                * _clean(max(0.0, side * float(prices.bounds[index])))
                / float(problem.unit[index])
                for name, (index, side) in active.items()
            },
            per_tolerance=per_tolerance,
            objective_unit=result.objective.unit,
        )

    def _checked(self, guess: ArrayLike | None) -> Vector | None:
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
    """Find the pressures that reach a task's pose and do best by its stiffness.

    Nothing is raised for a target that cannot be reached: the solution says so and holds the
    closest configuration.  See `PressureSolver` for many similar tasks, and for the arguments.
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
    """Solve many tasks on one arm, on all cores: the solutions of `solve_pressure` one by one.

    Parameters
    ----------
    robot : Manipulator
    tasks : iterable of Task
        They may differ in anything; those of the same structure share what is compiled.
    guesses : iterable, optional
        Pressures (n,) in Pa or None for each task, see `PressureSolver.solve`.
    seed : int
        Of the global search.
    threads : int, optional
        Instead of one for each core.  The solutions do not depend on it.
    timeout, cancel : optional
        For all tasks together, see `PressureSolver.solve`: what was solved by then is kept, and
        the status of the others is "failed".

    Raises
    ------
    InputError
        If an argument is wrong or a task's pressure limits do not suit the robot; nothing is
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
    asked: list[tuple[PressureSolver, Task, Vector | None]],
    threads: int | None,
    watch: Stopwatch,
) -> list[PressureSolution]:
    """Solutions of checked tasks, those of one structure together."""
    found: dict[int, PressureSolution | None] = {}
    groups: dict[FastSolver, list[tuple[int, Vector, Program]]] = {}
    for index, (solver, task, guess) in enumerate(asked):
        fast = solver._fast(task, guess)
        if fast is not None:
            groups.setdefault(fast[0], []).append((index, *fast[1:]))
    for fast_solver, members in groups.items():
        answers = fast_solver.solve_all(np.stack([row for _, row, _ in members]), threads)
        for (index, _, program), answer in zip(members, answers, strict=True):
            solver, task, _ = asked[index]
            found[index] = solver._accepted(task, program, answer)
    shares = {name: time / max(1, len(asked)) for name, time in watch.timings().items()}
    solutions = []
    for index, (solver, task, guess) in enumerate(asked):
        watch = Stopwatch()
        solution = found.get(index)
        if index not in found:  # there was no code then; there may be now
            solution = solver._found(task, guess)
        solution = solution or solver._otherwise(task, guess)
        solution.timings.update(shares)
        for name, time in watch.timings().items():
            solution.timings[name] = shares.get(name, 0.0) + time
        solutions.append(_felt(solution))
    return solutions


def _felt(solution: PressureSolution) -> PressureSolution:
    """The solution, which is none if the arm could not feel there how hard it presses."""
    press, pose, compliance = solution.task.press, solution.tip_pose, solution.compliance
    if press is None or not solution.found or pose is None or compliance is None:
        return solution
    R = pose[:3, :3]
    reason = press.refusal(R, R @ compliance[:3, :3] @ R.T)
    return replace(solution, status="unreachable", message=reason) if reason else solution


def stiffness_blind(solver: PressureSolver, solution: PressureSolution) -> PressureSolution:
    """The pose of a solution with the least pressure: what a plain solver would answer."""
    plain = {"stiffness": None, "load": None, "press": None, "brace": None}
    blind = PressureSolver(solver.robot, solution.task.model_copy(update=plain), seed=solver.seed)
    return blind.solve(guess=solution.pressures)


def _reaches(problem: PressureProblem, result: LocalResult) -> bool:
    """Whether a result of another program lies within the tolerances of this one."""
    pairs = zip(result.point.errors, problem.constraints, strict=True)
    return all(error <= constraint.radius for error, constraint in pairs)


def _beyond(point: ProgramPoint) -> float:
    """Sum by which constraints are missed, each over its scale."""
    pairs = zip(point.errors, point.constraints, strict=True)
    return sum(max(0.0, error - c.radius * c.one_sided) / c.scale for error, c in pairs)


def _distance(solution: PressureSolution) -> list[float]:
    """Rank of a closest configuration: how far each term is missed, the position last."""
    terms = sorted(solution.task.target.terms, key=lambda t: (not t.is_inequality, -t.order))
    rank = []
    for term in terms:
        value = solution.errors[term.name]
        rank.append(-value if term.is_inequality else value - term.radius * (1 + 1e-6))
    last = rank.pop() if terms[-1].order == 0 else 0.0
    return [*(max(0.0, value) for value in rank), last]


def _pressed(active: dict[str, tuple[int, int]], prices: Vector) -> list[str]:
    """Those of the active limits that have a price, of prices (n,) that count upwards."""
    least = 1e-6 * float(np.abs(prices).max())
    return [name for name, (index, side) in active.items() if side * prices[index] > least]


def _clean(price: float) -> float:
    return price if price > PRICES.least else 0.0
