"""Solve a task file: the solution with everything else that is printed, written and drawn."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from stiffopt.errors import EquilibriumError, FileError, InputError
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.model.uncertainty import TipUncertainty
from stiffopt.optimise.brace_uncertainty import BraceUncertainty
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.pareto import pareto_front
from stiffopt.optimise.solution import PressureSolution, judge
from stiffopt.optimise.solver import PressureSolver, stiffness_blind
from stiffopt.optimise.supports import SupportMap, suggest_supports, times
from stiffopt.optimise.task import load_task


@dataclass(frozen=True)
class SolvedTask:
    """A task file with its solution, found or not."""

    file: str  # the task file as the user named it
    robot: Manipulator  # the arm under the task's load
    solution: PressureSolution  # of the task
    # the task's stiffnesses at the plain solution, which ignores stiffness; empty if unknown
    plain: tuple[float, ...] = ()
    # of the tip; None for a robot without calibration, and for an arm that leans
    uncertainty: TipUncertainty | None = None
    # 95 % intervals of the task's stiffnesses, None for those that are not along a direction; empty
    # for a robot without calibration
    intervals: tuple[tuple[float, float] | None, ...] = ()
    # the trade-off between tip error and stiffness; None without --pareto or if it failed
    front: tuple[PressureSolution, ...] | None = None
    no_front: str = ""  # why --pareto failed; else empty
    # where a post or a wall would help; None without --suggest-post or if it failed
    supports: SupportMap | None = None
    no_supports: str = ""  # why --suggest-post failed; else empty


def solve_file(
    file: str, *, seed: int, pareto: int | None, post_force: float | None = None
) -> SolvedTask:
    """Solve a task file; with `pareto`, also a trade-off with that number of points.

    With `post_force`, the largest contact force in N, also suggest where to lean on a new object.

    Raises `InputError`: the task file or its robot is invalid; the message names the file.
    """
    task = load_task(file)
    try:
        robot = load_robot(task.resolve_robot())
        solver = PressureSolver(robot, task, seed=seed)
        try:
            solution = solver.solve()
        except EquilibriumError as error:
            solution = PressureSolution("failed", str(error), task)
        answer = SolvedTask(file, solver.robot, solution, _plain(solver, solution))
        answer = with_uncertainty(answer)
    except FileError:
        raise
    except InputError as error:
        raise FileError(file, str(error)) from None
    if post_force is not None:
        answer = _with_supports(answer, post_force, seed)
    if pareto is None or solution.status == "failed":
        return answer
    try:
        front = tuple(pareto_front(answer.robot, solution.task, pareto, seed=seed))
    except (InputError, EquilibriumError) as error:
        return replace(answer, no_front=str(error))
    return replace(answer, front=front)


def _with_supports(answer: SolvedTask, force: float, seed: int) -> SolvedTask:
    try:
        found = suggest_supports(answer.robot, answer.solution.task, force, seed=seed)
    except (InputError, EquilibriumError) as error:
        return replace(answer, no_supports=str(error))
    if answer.solution.contacts:  # what is softer than what the task leans on is no help
        stiffer = [each for each in found.supports if times(each.solution, answer.solution) > 1]
        found = replace(found, supports=tuple(stiffer))
    return replace(answer, supports=found)


def with_uncertainty(answer: SolvedTask) -> SolvedTask:
    """Return an answer with what is known of its errors, if its robot was calibrated."""
    pressures = answer.solution.pressures
    if answer.robot.description.calibration is None or pressures is None:
        return answer
    measures = answer.solution.task.measures[: len(answer.solution.stiffnesses)]
    try:
        if answer.solution.contacts:  # that of the tip is known only for a free arm
            return replace(answer, intervals=_braced_intervals(answer, measures))
        uncertainty = answer.robot.tip_uncertainty(pressures)
        intervals = tuple(
            uncertainty.stiffness_interval(m.direction, m.kind, m.boundary, m.frame)
            if isinstance(m, StiffnessMeasure)
            else None
            for m in measures
        )
    except EquilibriumError:  # near a limit of stability, its errors are unknown
        return answer
    return replace(answer, uncertainty=uncertainty, intervals=intervals)


def _braced_intervals(
    answer: SolvedTask, measures: Sequence[object]
) -> tuple[tuple[float, float] | None, ...]:
    task, eq = answer.solution.task, answer.solution.equilibrium
    assert eq is not None
    known = BraceUncertainty(answer.robot, eq)
    return tuple(
        known.stiffness_interval(measure, task) if isinstance(measure, StiffnessMeasure) else None
        for measure in measures
    )


def _plain(solver: PressureSolver, solution: PressureSolution) -> tuple[float, ...]:
    """Return the task's stiffnesses at the plain solution, which ignores stiffness."""
    if not solution.found or not solution.stiffnesses:
        return ()
    try:
        plain = stiffness_blind(solver, solution)
        if not plain.found or plain.pressures is None:
            return ()
        return judge(solver.robot, solution.task, plain.pressures).stiffnesses
    except EquilibriumError:
        return ()
