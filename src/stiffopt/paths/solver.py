"""`solve_path`: find the stiffest pressures with which the tip follows a path within the rates."""

from dataclasses import replace

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError, InputError, StoppedError, shown
from stiffopt.model.compiled import Stopwatch
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.stopping import Cancel, giving_up
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.solver import PressureSolver
from stiffopt.optimise.task import Task
from stiffopt.paths.answer import PathAnswers
from stiffopt.paths.attempts import RouteAttempts
from stiffopt.paths.candidates import candidates
from stiffopt.paths.path import Path
from stiffopt.paths.points import PathCandidate, PathTasks
from stiffopt.paths.rates import least_times, step_limits
from stiffopt.paths.settings import RATES
from stiffopt.paths.solution import PathSolution


def solve_path(
    robot: Manipulator,
    path: Path,
    *,
    seed: int = 0,
    timeout: float | None = None,
    cancel: Cancel | None = None,
) -> PathSolution:
    """Find pressures over time with which the tip follows a path, as stiff as possible.

    Every point is within its tolerance, the body keeps the clearance of the scene, and no
    pressure changes faster than the rates of robot and path allow.  The solver finds several local
    optima at each point, searches for the best sequence of them (`stiffopt.paths.route`), and then
    optimises neighbouring points together where rates bind (`stiffopt.paths.refinement`).

    Parameters
    ----------
    robot : Manipulator
    path : Path
    seed : int
        Of the searches.  The same seed gives the same answer.
    timeout, cancel : optional
        As for `PressureSolver.solve`; the status is then "failed".

    Raises
    ------
    InputError
        The path does not suit the robot: its limits, its scene, or given pressures at an end that
        do not reach the end point.  A path that cannot be followed raises nothing: the solution
        says where and why, and holds the nearest path that can be followed.
    """
    if not isinstance(robot, Manipulator):
        raise InputError(f"robot must be a Manipulator, see load_robot; got {shown(robot)}")
    if not isinstance(path, Path):
        raise InputError(f"path must be a Path, see load_path; got {shown(path)}")
    watch = Stopwatch()
    with giving_up(timeout, cancel):
        solution = _PathSolver(robot, path, seed).solve()
    solution.timings.update(watch.timings())
    return solution


class _PathSolver:
    """One path on one arm."""

    def __init__(self, robot: Manipulator, path: Path, seed: int) -> None:
        self._robot, self._path, self._seed = robot, path, seed
        self._points = path.points()
        self._tasks = [
            path.task(target, goal)
            for target, goal in zip(self._points.targets, self._points.goals, strict=True)
        ]
        self._ends = path.end_pressures(robot.description)
        self._slew = robot.description.slew_limits(path.pressure.slew)
        self._over = "mean" if path.stiffness is None else path.stiffness.over
        self._answers = PathAnswers(robot, path, self._points, self._slew)
        self._unreachable: tuple[int, str] | None = None  # the first point, and why

    def solve(self) -> PathSolution:
        """Answer; see `solve_path`."""
        if len(self._tasks) > RATES.few_points:  # enough points to wait for machine code
            PressureSolver(self._robot, self._tasks[0], seed=self._seed).compile()
        tasks = PathTasks(self._robot, self._tasks, self._seed)
        ends = self._checked_ends(tasks)
        try:
            layers, starts = candidates(tasks)
            moved, layers = self._with_reachable(tasks, layers)
            for index, end in ends.items():
                layers[index] = [end]
            return self._answer(tasks, moved, layers, starts, set(ends))
        except (StoppedError, EquilibriumError) as error:
            return self._answers.failed(str(error))

    # -- ends and unreachable points -----------------------------------------------------------

    def _checked_ends(self, tasks: PathTasks) -> dict[int, PathCandidate]:
        """Return the candidates of given pressures at the ends; refuse those off their points."""
        found: dict[int, PathCandidate] = {}
        ends = ("start", "first", 0), ("end", "last", len(tasks) - 1)
        for (key, which, index), pressures in zip(ends, self._ends, strict=True):
            if pressures is None:
                continue
            judgement = tasks.judged_at(index, pressures)
            candidate = tasks.accepted(index, pressures, judgement)
            if candidate is not None:
                found[index] = candidate
                continue
            where = "the arm does not stand at these pressures"
            if judgement is not None and not judgement.pose_holds:
                terms, errors = tasks.programs[index].terms, judgement.errors
                off = [t.words(errors[t.name]) for t in terms if not t.holds(errors[t.name])]
                where = f"the tip is {' and '.join(off)} off that point"
            elif judgement is not None:
                where = f"the body is too near to '{next(iter(judgement.intruders))}'"
            raise self._path.error_at(
                f"{key}.pressures",
                f"are not at the {which} point of the path: {where}; "
                "give pressures that are, or none, and plan a motion there (stiffopt plan)",
            )
        return found

    def _with_reachable(
        self, tasks: PathTasks, layers: list[list[PathCandidate]]
    ) -> tuple[PathTasks, list[list[PathCandidate]]]:
        """Return tasks and candidates in which unreachable points are moved to the nearest pose."""
        moved = list(self._tasks)
        closest: dict[int, Array] = {}
        for index, layer in enumerate(layers):
            if layer:
                continue
            solution = PressureSolver(self._robot, self._tasks[index], seed=self._seed).solve()
            if solution.found and solution.pressures is not None:
                candidate = tasks.candidate(index, solution.pressures)
                layers[index] = [] if candidate is None else [candidate]
                continue
            if solution.status == "failed" or solution.tip_position is None:
                raise EquilibriumError(f"{self._answers.name(index)}: {solution.message}")
            if self._unreachable is None:
                self._unreachable = index, solution.message
            moved[index] = _at_tip(self._tasks[index], solution)
            if solution.pressures is not None:
                closest[index] = solution.pressures
        if self._unreachable is None:
            return tasks, layers
        nearest = PathTasks(self._robot, moved, self._seed)
        found, _ = candidates(nearest)
        for index, layer in enumerate(found):
            if not layer:  # on the border of the reachable workspace
                found[index] = list(layers[index])
                own = nearest.candidate(index, closest[index]) if index in closest else None
                found[index] += [] if own is None else [own]
        return nearest, found

    # -- the answer ----------------------------------------------------------------------------

    def _answer(
        self,
        tasks: PathTasks,
        moved: PathTasks,
        layers: list[list[PathCandidate]],
        starts: int,
        given: set[int],
    ) -> PathSolution:
        """Return the solution; `moved` are the tasks with unreachable points moved."""
        times, slowed, stuck = self._points.times, 1.0, None
        steps = self._steps(tasks, times)
        attempts = RouteAttempts(moved, layers, self._over, given, self._path.closed)
        routes = attempts.best(steps)
        if not routes and all(layers):
            if times is not None:
                stuck = len(attempts.beginning(steps)) - 1
            slowed, routes = attempts.slower(steps)
            if slowed <= 1:
                stuck = None
            if routes:
                times, steps = None if times is None else times * slowed, steps * slowed
        if not routes:
            return self._without_route(moved, layers, attempts, steps)
        route, pressures = attempts.refined(routes, steps)
        if times is None:
            times = self._fastest(pressures)
        solution = self._answers.judged(tasks, pressures, times, attempts.alone, self._unreachable)
        branches, crossings = max(map(len, layers)), route.crossings
        confidence = (
            f"{starts} starts found at most {branches} local "
            f"{'optimum' if branches == 1 else 'optima'} at a point; the best sequence crosses "
            f"between branches at full rate {crossings} time{'' if crossings == 1 else 's'}"
        )
        solution = replace(solution, confidence=confidence)
        if stuck is not None:
            return self._answers.too_fast(solution, stuck, slowed)
        return solution

    def _without_route(
        self,
        tasks: PathTasks,
        layers: list[list[PathCandidate]],
        attempts: RouteAttempts,
        steps: Array,
    ) -> PathSolution:
        """Return the answer when no sequence was found: the path up to where it ends."""
        if self._unreachable is not None:
            return self._answers.not_near(self._unreachable)
        empty = next((i for i, layer in enumerate(layers) if not layer), None)
        if empty is not None:
            name = self._answers.name(empty)
            return self._answers.failed(f"{name}: no pressures were found near the target")
        begin = attempts.beginning(steps)
        count, pressures = len(begin), np.array([each.pressures for each in begin])
        beyond = attempts.clearance_beyond(begin[-1], count - 1, steps[count - 1])
        times = self._points.times
        times = self._fastest(pressures) if times is None else times[:count]
        solution = self._answers.judged(tasks, pressures, times, attempts.alone[:count], None)
        return self._answers.cut_short(solution, pressures, beyond)

    def _steps(self, tasks: PathTasks, times: Array | None) -> Array:
        """Return the largest changes (N - 1, n) of the pressures from point to point."""
        if times is None or self._slew is None:
            return np.tile(RATES.largest_step * tasks.unit, (len(tasks) - 1, 1))
        return step_limits(times, self._slew)

    def _fastest(self, pressures: Array) -> Array:
        """Return the earliest times (N,) of the points that the rates allow."""
        if self._slew is None:
            raise self._path.error_at(
                "timing.fastest", "needs to know the rates; give pressure.slew here or in the robot"
            )
        least = np.maximum(least_times(pressures, self._slew), RATES.least_time)
        return np.concatenate([[0.0], np.cumsum(least)])


def _at_tip(task: Task, solution: PressureSolution) -> Task:
    """Return the task with a solution's tip pose as its target."""
    assert solution.tip_position is not None
    assert solution.tip_pose is not None
    target = task.target
    parts: dict[str, object] = {}
    if target.position is not None:
        pairs = zip(target.position, solution.tip_position.tolist(), strict=True)
        parts["position"] = tuple(None if axis is None else own for axis, own in pairs)
    if target.pointing is not None:
        parts["pointing"] = tuple(solution.tip_pose[:3, 2].tolist())
    if target.orientation is not None and solution.tip_quaternion is not None:
        parts["orientation"] = tuple(solution.tip_quaternion.tolist())
    return task.model_copy(update={"target": target.model_copy(update=parts)})
