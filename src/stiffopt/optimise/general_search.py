"""Global search in Python: the general method, for tasks without machine code.

It also takes the tasks that the compiled search does not support or cannot solve.
"""

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError
from stiffopt.optimise import diagnosis
from stiffopt.optimise.answers import Answers
from stiffopt.optimise.fast import CompiledAnswer
from stiffopt.optimise.local import LocalResult, descend
from stiffopt.optimise.problem import PressureProblem, ProgramPoint
from stiffopt.optimise.reach import reach
from stiffopt.optimise.search import Search, search, starts
from stiffopt.optimise.settings import ANSWER, CLOSEST, Effort
from stiffopt.optimise.solution import Confidence, PressureSolution
from stiffopt.optimise.task import Task

_ONE = Effort(1, 1, 1)


class GeneralSearch:
    """Solve any task, more slowly than `CompiledSearch`.

    `answers`: the solver's factory of solutions.
    """

    def __init__(self, answers: Answers) -> None:
        self._answers, self._prepared = answers, answers.prepared
        self._robot = answers.robot

    def solve(self, task: Task, guess: Array | None) -> PressureSolution:
        """Solve a task; prefer the local optimum next to a guess, (n,) in Pa."""
        try:
            return self._solve(PressureProblem(self._robot, task), guess)
        except EquilibriumError as error:
            return PressureSolution("failed", str(error), task)

    def _solve(self, problem: PressureProblem, guess: Array | None) -> PressureSolution:
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

    def _from_guess(self, problem: PressureProblem, guess: Array) -> PressureSolution | None:
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
        solution = self._answers.of(problem, result, local)
        return solution if solution.found else None

    def _judged(
        self, problem: PressureProblem, result: LocalResult, confidence: Confidence
    ) -> PressureSolution | None:
        """Return the solution of an arm without loads if it holds; it is explained lazily."""
        if self._robot.is_loaded:
            return None
        p = np.clip(result.point.x * problem.unit, self._prepared.lower, self._prepared.upper)
        answer = CompiledAnswer(p, confidence, {}, problem.judged(p))
        return self._answers.if_it_holds(problem.task, problem.program, answer)

    def _first_that_holds(self, problem: PressureProblem, found: Search) -> PressureSolution:
        """Return the best local optimum that the model confirms when it is approached from rest."""
        best: PressureSolution | None = None
        for result in found.results[: ANSWER.tried]:
            try:
                solution = self._answers.of(problem, result, found.confidence)
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

    def _closest(self, problem: PressureProblem, found: Search) -> PressureSolution:
        """Return the configuration closest to a pose that no start reached."""
        near = sorted(found.nearest, key=_beyond)
        table = self._prepared.samples
        order = table.nearest_first(
            table.distances(problem.program.terms, self._robot.length), CLOSEST.samples
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
            clearest = clearest[np.argmax(self._robot.clearance(clearest, scene))]
            results = [diagnosis.unimproved(problem, clearest / problem.unit)]
        if self._robot.is_loaded:  # an equilibrium that was found may not be reached from rest
            as_they_are = (diagnosis.unimproved(problem, x) for x in candidates[: ANSWER.tried])
            results = [*results[: ANSWER.tried], *as_they_are]
        judged = []
        for result in results:
            try:
                judged.append(self._answers.of(problem, result, found.confidence))
            except EquilibriumError:
                continue
        if not judged:
            raise EquilibriumError("no stable equilibrium was found near the target")
        return min(judged, key=_distance)

    def _without_floors(self, problem: PressureProblem, found: Search) -> PressureSolution:
        """Return the closest answer where no search result meets the demanded stiffnesses."""
        nearest = problem.changed(problem.best_floors(), floors=False)
        candidates = (result.point.x for result in found.results)
        best = search(nearest, candidates)
        if best.results and best.results[0].value <= 0:
            again = search(problem, [best.results[0].point.x], _ONE)
            if again.results and again.results[0].holds_floors:
                return self._first_that_holds(problem, again)
        return self._first_that_holds(nearest, best if best.results else found)


def _reaches(problem: PressureProblem, result: LocalResult) -> bool:
    """Return whether a result of another program meets the tolerances of this one."""
    pairs = zip(result.point.errors, problem.constraints, strict=True)
    return all(error <= constraint.radius for error, constraint in pairs)


def _beyond(point: ProgramPoint) -> float:
    """Return the sum of constraint violations, each divided by its scale."""
    pairs = zip(point.errors, point.constraints, strict=True)
    return sum(max(0.0, error - c.radius * c.one_sided) / c.scale for error, c in pairs)


def _distance(solution: PressureSolution) -> list[float]:
    """Rank a closest configuration: the violation of each term, the position last."""
    terms = sorted(solution.task.target.terms, key=lambda t: (not t.is_inequality, -t.order))
    rank = []
    for term in terms:
        value = solution.errors[term.name]
        rank.append(-value if term.is_inequality else value - term.radius * (1 + 1e-6))
    last = rank.pop() if terms[-1].order == 0 else 0.0
    return [*(max(0.0, value) for value in rank), last]
