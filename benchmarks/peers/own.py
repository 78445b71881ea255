"""stiffopt itself, behind the interface of the peers."""

from collections.abc import Callable
from typing import ClassVar

import tasks
from peers.base import TaskSolver, Vector
from stiffopt import Manipulator, PressureSolver, Target, Task, solve_pressure


class Stiffopt(TaskSolver):
    """Whole calls from Python, judgement of the answer included."""

    name: ClassVar[str] = "stiffopt"
    distributions: ClassVar[tuple[str, ...]] = ("stiffopt",)

    def __init__(self, segments: int, robot: Manipulator | None = None) -> None:
        super().__init__(segments)
        self.robot = tasks.arm(segments) if robot is None else robot

    def cold(self, task: Task) -> Vector | None:
        """`solve_pressure`."""
        return solve_pressure(self.robot, task).pressures

    def remember(self, task: Task) -> Callable[[Target], Vector | None]:
        """`PressureSolver.solve` with the last pressures as guess."""
        return self.remember_from(task, None)

    def remember_from(self, task: Task, p: Vector | None) -> Callable[[Target], Vector | None]:
        """The same, where an answer is known already."""
        solver = PressureSolver(self.robot, task)
        last = solver.solve(guess=p).pressures
        return lambda target: solver.solve(target, guess=last).pressures
