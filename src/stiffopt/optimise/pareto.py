"""`pareto_front`: the trade-off between tip error and stiffness."""

from math import pi

import numpy as np

from stiffopt.errors import InputError, StoppedError, shown
from stiffopt.model.arguments import checked_integer
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.stopping import Cancel, checkpoint, giving_up
from stiffopt.optimise.braced import least_maximised
from stiffopt.optimise.settings import ANSWER
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.solver import PressureSolver
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task


def pareto_front(
    robot: Manipulator,
    task: Task,
    n: int,
    *,
    seed: int = 0,
    timeout: float | None = None,
    cancel: Cancel | None = None,
) -> list[PressureSolution]:
    """Return the stiffest solutions at `n` growing tolerances, up to a quarter of the arm.

    The tolerance of the position grows, starting at the task's own.  For a task without position it
    is the angle's, up to half a turn.  Only solutions that are stiffer than all with less error are
    returned, so there may be fewer than `n`; none if the target is out of reach at every tolerance.

    Raises
    ------
    InputError
        If the task maximises no stiffness, or `n` is less than 2.
    OutOfTimeError, CancelledError
        If it was stopped, see `PressureSolver.solve`; `found` of the error is the front so far.
    """
    if not isinstance(task, Task):
        raise InputError(f"task must be a Task, see load_task; got {shown(task)}")
    if task.stiffness is None or not task.stiffness.maximise:
        raise InputError("a trade-off needs a stiffness to maximise; add 'stiffness: maximise'")
    n = checked_integer("n, the number of points of a trade-off,", n, 2)
    solver = PressureSolver(robot, task, seed=seed)
    names = {term.name for term in task.target.terms}
    which = next((name for name in ("position", "angle") if name in names), None)
    if which is None:
        raise InputError("a trade-off needs a target with a position or an angle")
    own: float = getattr(task.target.tolerance, which)
    largest = ANSWER.largest_tolerance * robot.length if which == "position" else pi
    front: list[PressureSolution] = []
    with giving_up(timeout, cancel):
        for size in np.geomspace(own, max(own, largest), n):
            tolerance = task.target.tolerance.model_copy(update={which: float(size)})
            _extend(front, solver, task.target.model_copy(update={"tolerance": tolerance}))
            try:
                checkpoint()
            except StoppedError as error:
                error.found = front
                raise
    return front


def _extend(front: list[PressureSolution], solver: PressureSolver, target: Target) -> None:
    """Add the stiffest solution of a target, if it is stiffer than those before."""
    candidates = [solver.solve(target)]
    if front:  # the answer for a smaller tolerance is a start for this one
        candidates.append(solver.solve(target, guess=front[-1].pressures))
    found = [solution for solution in candidates if solution.found]
    if not found:
        return
    best = max(found, key=_least)
    if not front or _least(best) > _least(front[-1]) * (1 + 1e-9):
        front.append(best)


def _least(solution: PressureSolution) -> float:
    return least_maximised(solution.task, solution.stiffnesses)
