"""From a task to the stiffest pressures: global search, judgement and diagnosis."""

from collections.abc import Iterator
from itertools import islice
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import EquilibriumError, InputError, shown
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.numeric import checked_integer, checked_vector
from stiffopt.optimise import diagnosis
from stiffopt.optimise.local import LocalResult, descend, reach
from stiffopt.optimise.problem import BAR, Problem
from stiffopt.optimise.search import SampleTable, Search, search, starts
from stiffopt.optimise.solution import (
    Confidence,
    Judgement,
    PressureSolution,
    Sensitivities,
    active_bounds,
    judge,
)
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.optimise.terms import pose_terms

Vector = NDArray[np.float64]

MOST_STARTS = 32
"""Local searches at most, for an arm in closed form."""
MOST_STARTS_LOADED = 12
"""Local searches at most, for an arm under gravity or load."""

_JUDGED = 5  # local optima that are tried in turn if the best does not hold from rest
_PRICE_OF_NOTHING = 1e-9  # multipliers below are rounding


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
        load = task.load
        self.robot = robot.with_load(load.force, load.moment, load.frame) if load else robot
        self.task = task
        self.seed = checked_integer("seed", seed, 0)
        self._problem = Problem(self.robot, task)
        self._samples: SampleTable | None = None

    def solve(
        self, target: Target | None = None, guess: ArrayLike | None = None
    ) -> PressureSolution:
        """Solve for the task's target, or for another one.

        Parameters
        ----------
        target : Target, optional
            Instead of the task's.
        guess : (n,), optional
            Pressures in Pa near the answer, for example the previous one: the answer is then
            the local optimum next to it.  If none is found there, the search is global.
        """
        if target is not None and not isinstance(target, Target):
            raise InputError(f"target must be a Target; got {shown(target)}")
        begin = perf_counter()
        problem = self._problem if target is None else self._problem.at_target(target)
        try:
            solution = self._solve(problem, self._checked(guess))
        except EquilibriumError as error:
            solution = PressureSolution("failed", str(error), problem.task)
        solution.timings["total"] = perf_counter() - begin
        return solution

    def _solve(self, problem: Problem, guess: Vector | None) -> PressureSolution:
        if guess is not None:
            nearby = self._from_guess(problem, guess)
            if nearby is not None:
                return nearby
        most = MOST_STARTS_LOADED if self.robot.is_loaded else MOST_STARTS
        found = search(problem, self._starts(problem), most)
        if not found.results:
            return self._closest(problem, found)
        if problem.floors and not found.results[0].holds_floors:
            return self._without_floors(problem, found)
        return self._first_that_holds(problem, found)

    def _from_guess(self, problem: Problem, guess: Vector) -> PressureSolution | None:
        problem.restart()
        point = reach(problem, np.clip(guess / BAR, problem.lower, problem.upper))
        if point is None or not point.reached:
            return None
        result = descend(problem, point)
        if not result.converged or not result.holds_floors:
            return None
        solution = self._solution(problem, result, Confidence(1, 1, 1, 1, complete=False))
        return solution if solution.found else None

    def _first_that_holds(self, problem: Problem, found: Search) -> PressureSolution:
        """Best local optimum that the model confirms from rest."""
        best: PressureSolution | None = None
        for result in found.results[:_JUDGED]:
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

    def _closest(self, problem: Problem, found: Search) -> PressureSolution:
        """Closest configuration to a pose that no start came to."""
        near = sorted(found.nearest, key=lambda point: sum(b.error for b in point.balls))
        candidates = [*self._nearest(problem, 16), *(point.x for point in near)]
        results = diagnosis.closest_configurations(problem, candidates)
        if results and _reaches(problem, results[0]):
            again = search(problem, iter([results[0].point.x]), 1)
            if again.results:
                return self._first_that_holds(problem, again)
        results = results[:1]
        if self.robot.is_loaded:  # what is found need not be what is reached from rest
            sampled = (diagnosis.unimproved(problem, x) for x in islice(candidates, _JUDGED))
            results = [*results[:_JUDGED], *sampled]
        judged = []
        for result in results:
            try:
                judged.append(self._solution(problem, result, found.confidence))
            except EquilibriumError:
                continue  # not reached from rest
        if not judged:
            raise EquilibriumError("no stable equilibrium was found near the target")
        return min(judged, key=_distance)

    def _without_floors(self, problem: Problem, found: Search) -> PressureSolution:
        """Best that can be had where a stiffness that is demanded was not found."""
        nearest = problem.changed(objective=problem.best_floors(), floors=())
        candidates = (result.point.x for result in found.results)
        best = search(nearest, candidates, len(found.results))
        if best.results and best.results[0].value <= 0:
            again = search(problem, iter([best.results[0].point.x]), 1)
            if again.results and again.results[0].holds_floors:
                return self._first_that_holds(problem, again)
        return self._first_that_holds(nearest, best if best.results else found)

    # -- words and numbers ------------------------------------------------------------------

    def _solution(
        self, problem: Problem, result: LocalResult, confidence: Confidence
    ) -> PressureSolution:
        """Judge a result and put it into words."""
        lower, upper = problem.task.pressure_bounds(self.robot.description)
        pressures = np.clip(result.point.x * BAR, lower, upper)
        task = problem.task
        judgement = judge(self.robot, task, pressures)
        active = active_bounds(self.robot, task, pressures)
        sensitivities = self._sensitivities(problem, result, judgement, pressures, active)
        freedom = diagnosis.freedom(problem, pressures / BAR)
        if judgement.holds:
            goal = task.stiffness
            message = (
                diagnosis.no_freedom_message(task, self.robot.n_pressures, sensitivities)
                if freedom == 0 and goal is not None
                else ""
            )
        elif not judgement.pose_holds:
            message = diagnosis.unreachable_message(judgement, task, self._holding(result, active))
        else:
            message = diagnosis.demands_message(judgement, task)
        return PressureSolution(
            status="solved" if judgement.holds else "unreachable",
            message=message,
            task=task,
            pressures=pressures,
            tip_pose=judgement.tip_pose,
            position_error=judgement.position_error,
            angle_error=judgement.angle_error,
            compliance=judgement.compliance,
            stiffness=judgement.stiffnesses[0] if judgement.stiffnesses else None,
            stiffness_unit=task.measures[0].unit if task.measures else None,
            stiffnesses=judgement.stiffnesses,
            matrix_distance=judgement.matrix_distance,
            active_bounds=tuple(active),
            freedom=freedom,
            confidence=confidence,
            sensitivities=sensitivities,
        )

    @staticmethod
    def _holding(result: LocalResult, active: dict[str, tuple[int, int]]) -> list[str]:
        """Active limits that the closest configuration presses against."""
        if result.multipliers is None:
            return list(active)
        prices = result.multipliers.bounds
        return [name for name, (index, side) in active.items() if side * prices[index] > 1e-9]

    def _sensitivities(
        self,
        problem: Problem,
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
            first = problem.task.measures[0]
            gradient = self.robot.stiffness_gradient(
                pressures, first.direction, first.kind, first.boundary, first.frame
            )
        scale = result.objective.gain(result.point)

        def radius_price(name: str) -> float | None:
            pull = prices.balls.get(name)
            return None if pull is None else scale * _clean(float(np.linalg.norm(pull)))

        return Sensitivities(
            tip_jacobian=self.robot.tip_jacobian(pressures),
            stiffness_gradient=gradient,
            per_bound={
                name: scale * _clean(max(0.0, side * float(prices.bounds[index]))) / BAR
                for name, (index, side) in active.items()
            },
            per_position_tolerance=radius_price("position"),
            per_angle_tolerance=radius_price("angle"),
            objective_unit=result.objective.unit,
        )

    # -- starts -----------------------------------------------------------------------------

    def _starts(self, problem: Problem) -> Iterator[Vector]:
        return starts(problem, self._table(problem))

    def _table(self, problem: Problem) -> SampleTable:
        if self._samples is None:
            self._samples = SampleTable(self.robot, problem.lower, problem.upper, self.seed)
        return self._samples

    def _nearest(self, problem: Problem, count: int) -> list[Vector]:
        """Samples that are nearest to the target."""
        table = self._table(problem)
        order = table.nearest_first(problem.task.target, self.robot.length)
        return list(table.x[order[:count]])

    def _checked(self, guess: ArrayLike | None) -> Vector | None:
        if guess is None:
            return None
        return checked_vector("guess", guess, self.robot.n_pressures)


def solve_pressure(
    robot: Manipulator, task: Task, guess: ArrayLike | None = None, *, seed: int = 0
) -> PressureSolution:
    """Find the pressures that reach a task's pose and do best by its stiffness.

    Nothing is raised for a target that cannot be reached: the solution says so and holds the
    closest configuration.  See `PressureSolver` for many similar tasks.
    """
    return PressureSolver(robot, task, seed=seed).solve(guess=guess)


def stiffness_blind(solver: PressureSolver, solution: PressureSolution) -> PressureSolution:
    """The pose of a solution with the least pressure: what a plain solver would answer."""
    task = solution.task.model_copy(update={"stiffness": None})
    blind = PressureSolver(solver.robot, task.model_copy(update={"load": None}), seed=solver.seed)
    return blind.solve(guess=solution.pressures)


def _reaches(problem: Problem, result: LocalResult) -> bool:
    """Whether a result of another program lies within the tolerances of this one."""
    radii = {term.name: term.radius for term in pose_terms(problem.task.target)}
    return all(ball.error <= radii[ball.name] for ball in result.point.balls)


def _distance(solution: PressureSolution) -> tuple[float, float]:
    """Rank of a closest configuration: the angle beyond its tolerance, then the distance."""
    beyond = (solution.angle_error or 0.0) - solution.task.target.tolerance.angle * (1 + 1e-6)
    return max(0.0, beyond), solution.position_error or 0.0


def _clean(price: float) -> float:
    return price if price > _PRICE_OF_NOTHING else 0.0
