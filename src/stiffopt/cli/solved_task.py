"""A solved task: its solution, and all that is printed, written and drawn with it."""

import os
from dataclasses import dataclass, replace

from stiffopt.errors import EquilibriumError, FileError, InputError
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.model.uncertainty import TipUncertainty
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.pareto import pareto_front
from stiffopt.optimise.solution import PressureSolution, judge
from stiffopt.optimise.solver import PressureSolver, stiffness_blind
from stiffopt.optimise.task import Task, load_task


@dataclass(frozen=True)
class SolvedTask:
    """A task file and what became of it, whether it could be solved or not.

    Attributes
    ----------
    file : the task file as the user named it.
    robot : the arm under the task's load.
    solution : of the task.
    plain : the task's stiffnesses at a solution that ignores stiffness; empty without one.
    uncertainty : how well the tip is known there, or None for a robot without calibration.
    intervals : 95 % intervals of the task's stiffnesses; empty where there is no `uncertainty`.
    front : the trade-off between tip error and stiffness; None without --pareto or if it failed.
    complaint : why there is no trade-off although --pareto was given; else empty.
    """

    file: str
    robot: Manipulator
    solution: PressureSolution
    plain: tuple[float, ...] = ()
    uncertainty: TipUncertainty | None = None
    intervals: tuple[tuple[float, float], ...] = ()
    front: tuple[PressureSolution, ...] | None = None
    complaint: str = ""

    @property
    def task(self) -> Task:
        """The task itself."""
        return self.solution.task

    @property
    def name(self) -> str:
        """The name of the task file without folder and ending."""
        return os.path.splitext(os.path.basename(self.file))[0]


def solve_file(file: str, *, seed: int, pareto: int | None) -> SolvedTask:
    """Solve a task file.

    Parameters
    ----------
    file :
        Path of the task file.
    seed :
        Of the global search.
    pareto :
        Points of the trade-off, or None for none.

    Raises
    ------
    InputError
        The task file or its robot is wrong; the message names the file.
    """
    task = load_task(file)
    try:
        robot = load_robot(task.resolve_robot())
        solver = PressureSolver(robot, task, seed=seed)
        answer = _solved(file, solver)
    except FileError:
        raise
    except InputError as error:
        raise FileError(file, str(error)) from None
    if pareto is None or answer.solution.status == "failed":
        return answer
    return _with_front(answer, pareto, seed)


def _solved(file: str, solver: PressureSolver) -> SolvedTask:
    try:
        solution = solver.solve()
    except EquilibriumError as error:
        solution = PressureSolution("failed", str(error), solver.task)
    answer = SolvedTask(file, solver.robot, solution, _plain(solver, solution))
    return _with_uncertainty(answer)


def _with_uncertainty(answer: SolvedTask) -> SolvedTask:
    pressures = answer.solution.pressures
    if answer.robot.description.calibration is None or pressures is None:
        return answer
    try:
        uncertainty = answer.robot.tip_uncertainty(pressures)
        measures = answer.task.measures[: len(answer.solution.stiffnesses)]
        intervals = tuple(
            uncertainty.stiffness_interval(m.direction, m.kind, m.boundary, m.frame)
            for m in measures
            if isinstance(m, StiffnessMeasure)
        )
    except EquilibriumError:  # no equilibrium there, or hardly: nothing is known of its errors
        return answer
    return replace(answer, uncertainty=uncertainty, intervals=intervals)


def _plain(solver: PressureSolver, solution: PressureSolution) -> tuple[float, ...]:
    """The task's stiffnesses at the pressures of a solver that does not look at stiffness."""
    if not solution.found or not solution.stiffnesses:
        return ()
    try:
        plain = stiffness_blind(solver, solution)
        if not plain.found or plain.pressures is None:
            return ()
        return judge(solver.robot, solution.task, plain.pressures).stiffnesses
    except EquilibriumError:
        return ()


def _with_front(answer: SolvedTask, n: int, seed: int) -> SolvedTask:
    try:
        return replace(answer, front=tuple(pareto_front(answer.robot, answer.task, n, seed=seed)))
    except (InputError, EquilibriumError) as error:
        return replace(answer, complaint=str(error))
