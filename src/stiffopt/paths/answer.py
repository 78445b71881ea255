"""Judge the pressures found for a path, and say in words what they keep and what they do not."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stiffopt.display import display_units
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.solution import Judgement
from stiffopt.paths.geometry import PathPoints
from stiffopt.paths.path import Path
from stiffopt.paths.points import BodyCheck, PathTasks
from stiffopt.paths.rates import step_limits
from stiffopt.paths.solution import PathSolution

Vector = NDArray[np.float64]
Failure = tuple[int, str]
"""A point at which something fails, and why."""


class PathAnswers:
    """The solutions of one path on one arm, with their messages.

    Parameters
    ----------
    robot, path, points :
    slew : (n,) or None
        Largest rates, in Pa/s.
    """

    def __init__(
        self, robot: Manipulator, path: Path, points: PathPoints, slew: Vector | None
    ) -> None:
        self._robot, self._path, self._points, self._slew = robot, path, points, slew

    def name(self, index: int) -> str:
        """Name a point in words."""
        return f"point {index + 1} of {len(self._points)} ({self._along(index)} along the path)"

    def failed(self, message: str) -> PathSolution:
        """Return the solution with a message alone."""
        return PathSolution.without_answer("failed", message, self._robot, self._slew)

    def judged(
        self,
        tasks: PathTasks,
        pressures: Vector,
        times: Vector,
        alone: Vector,
        unreachable: Failure | None,
    ) -> PathSolution:
        """Return the solution at pressures (N, n), judged by the model against the path's tasks.

        `alone` are the logarithms (N,) of the single points' stiffness, `unreachable` the first
        point that cannot be reached, if any.
        """
        judgements = tasks.judged(pressures)
        known = [j for j in judgements if j is not None]
        if len(known) < len(judgements):
            index = judgements.index(None)
            return self.failed(f"{self.name(index)}: the arm has no stable equilibrium there")
        scene, stiffness, unit = self._path.scene, None, None
        if self._path.stiffness is not None:
            stiffness = np.array([min(j.stiffnesses) for j in known])
            unit = tasks.tasks[0].measures[0].unit
        solution = PathSolution(
            status="solved",
            message="",
            robot=tasks.robot,
            times=times,
            pressures=pressures,
            tip_poses=np.stack([j.tip_pose for j in known]),
            slew=self._slew,
            stiffness=stiffness,
            stiffness_unit=unit,
            alone=None if stiffness is None else np.fmax(np.exp(alone), stiffness),
            position_errors=_errors(known, "position"),
            angle_errors=_errors(known, "angle"),
            clearance=None if scene is None else tasks.robot.clearance(pressures, scene),
        )
        failure = self._failure(tasks, solution, known, unreachable)
        if failure is not None:
            return _unreachable(solution, *failure)
        return replace(solution, message=self._notes(solution))

    def too_fast(self, solution: PathSolution, index: int, slowed: float) -> PathSolution:
        """Return a solution that follows the path slower, beyond a point at which it is stuck."""
        if solution.status != "solved":
            return solution
        message = (
            f"The path is too fast for the rates: beyond point {index + 1} of {len(self._points)} "
            f"({self._along(index)} along it) no pressures keep them"
            f"{self._binding(solution)}. It can be followed {slowed:.3g} times slower, as given."
        )
        return _unreachable(solution, index, message)

    def not_near(self, unreachable: Failure) -> PathSolution:
        """Return the answer when a point is out of reach and no path near it was found."""
        index, why = unreachable
        message = f"{self._cannot_be_reached(index, why)}, and no path near it can be followed"
        return _unreachable(self.failed(message), index, message)

    def cut_short(self, solution: PathSolution, beyond: float | None) -> PathSolution:
        """Return the solution of a path's beginning, beyond which no pressures were found.

        `beyond` is the largest clearance with which steps go on, if known.
        """
        index, scene = len(solution.pressures) - 1, self._path.scene
        message = f"{self.name(index)} is the last that pressures were found to follow"
        if scene is not None and beyond is not None:
            message += f" with the body clear. {self._falls(index, beyond)}"
        else:
            message += " without a jump"
            if scene is not None:
                nearest = self._robot_of(solution).clearances(solution.pressures[-1], scene).nearest
                message += f", and clear of '{nearest}'"
            message += (
                ": beyond it the arm would have to change to another configuration while the tip "
                "stays on the path"
            )
        return _unreachable(solution, index, f"{message}. The path up to there is given.")
