"""Judge the pressures found for a path, and say in words what they keep and what they do not."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.solution import Judgement
from stiffopt.paths.geometry import PathPoints
from stiffopt.paths.path import Path
from stiffopt.paths.points import BodyCheck, PathTasks
from stiffopt.paths.rates import step_limits
from stiffopt.paths.solution import PathSolution

Failure = tuple[int, str]
"""A point at which something fails, and why."""


class PathAnswers:
    """The solutions of one path on one arm, with their messages; `slew` (n,) is in Pa/s or None."""

    def __init__(
        self, robot: Manipulator, path: Path, points: PathPoints, slew: Array | None
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
        pressures: Array,
        times: Array,
        alone: Array,
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
            f"({self._along(index)} along it) no pressures were found that keep them"
            f"{self._binding(solution)}. It can be followed {slowed:.3g} times slower, as given."
        )
        return _unreachable(solution, index, message)

    def not_near(self, unreachable: Failure) -> PathSolution:
        """Return the answer when a point is out of reach and no path near it was found."""
        index, why = unreachable
        message = (
            f"{self._cannot_be_reached(index, why)}, and no path near it was found that can be "
            "followed"
        )
        return _unreachable(self.failed(message), index, message)

    def cut_short(
        self, solution: PathSolution, pressures: Array, beyond: float | None
    ) -> PathSolution:
        """Return the solution of a path's beginning, beyond whose pressures (k, n) none were found.

        `beyond` is the largest clearance with which steps go on, if known.
        """
        index, scene = len(pressures) - 1, self._path.scene
        message = f"{self.name(index)} is the last that pressures were found to follow"
        if scene is not None and beyond is not None:
            message += f" with the body clear. {self._falls(index, beyond)}"
        else:
            message += " without a jump"
            if scene is not None:
                nearest = solution.robot.clearances(pressures[-1], scene).nearest
                message += f", and clear of '{nearest}'"
            message += (
                ": beyond it the arm would have to change to another configuration while the tip "
                "stays on the path"
            )
        return _unreachable(solution, index, f"{message}. The path up to there is given.")

    # -- what fails ---------------------------------------------------------------------------

    def _failure(
        self,
        tasks: PathTasks,
        solution: PathSolution,
        judgements: Sequence[Judgement],
        unreachable: Failure | None,
    ) -> Failure | None:
        """Return the first point at which a solution does not keep the path, and why; or None."""
        if unreachable is not None:
            text = self._cannot_be_reached(*unreachable)
            return unreachable[0], f"{text}. The nearest path that can be followed is given."
        for index, judgement in enumerate(judgements):
            if not judgement.holds:
                return index, f"{self.name(index)} does not hold: {_what_is_wrong(judgement)}"
        if self._slew is not None and self._points.times is not None:
            limits = step_limits(solution.times, self._slew)
            assert (np.abs(np.diff(solution.pressures, axis=0)) <= limits * (1 + 1e-6) + 1e-6).all()
        return self._blocked(tasks, solution.pressures)

    def _blocked(self, tasks: PathTasks, p: Array) -> Failure | None:
        """Return the first point after which the body is too near the scene, and why; or None."""
        if tasks.scene is None or len(p) < 2:
            return None
        body = tasks.body or BodyCheck(tasks.robot, tasks.scene)
        whole = body.motion(p)
        if whole.clear:
            return None
        found = ((k, body.motion(p[k : k + 2])) for k in range(len(p) - 1))
        index, motion = next(((k, each) for k, each in found if not each.clear), (0, whole))
        if not np.isfinite(motion.least):
            return index, (
                f"{_after(index)} the arm has no stable equilibrium, or snaps to another."
            )
        return index, (
            f"{self._falls(index, motion.least)}. With more points, or lower rates, it may keep "
            "clear."
        )

    # -- words --------------------------------------------------------------------------------

    def _along(self, index: int) -> str:
        return display_units().length.text(self._points.lengths[index])

    def _cannot_be_reached(self, index: int, why: str) -> str:
        return f"{self.name(index)} cannot be reached: {why.removeprefix('unreachable: ')}"

    def _falls(self, index: int, least: float) -> str:
        """Say what the clearance falls to after a point."""
        scene, length = self._path.scene, display_units().length
        assert scene is not None
        return (
            f"{_after(index)} the clearance of the body falls to {length.text(least, '.3g')}; "
            f"the scene asks for {length.text(scene.clearance, 'g')}"
        )

    def _binding(self, solution: PathSolution) -> str:
        """Name the channel that uses most of its rate."""
        if self._slew is None:
            return ""
        rates = np.abs(np.diff(solution.pressures, axis=0)) / np.diff(solution.times)[:, np.newaxis]
        share = rates / self._slew
        channel = int(np.unravel_index(share.argmax(), share.shape)[1])
        name = self._robot.description.channel_name(channel)
        rate = display_units().pressure.text(self._slew[channel], "g")
        return f"; {name} with {rate}/s holds it back most"

    def _notes(self, solution: PathSolution) -> str:
        """Return remarks for the user on a path that can be followed."""
        notes: list[str] = []
        if self._slew is None:
            notes.append("No rate of change is known, of the robot or of the path; none was kept.")
        middle = (solution.pressures[1:] + solution.pressures[:-1]) / 2
        if len(middle) and self._points.targets[0].position is not None:
            lengths = self._points.lengths[: len(solution.pressures)]
            lengths = (lengths[1:] + lengths[:-1]) / 2
            tips = solution.robot.tip_pose(middle)[:, :3, 3]
            off = np.linalg.norm(tips - self._points.at(lengths), axis=1)
            own = [target.tolerance.position for target in self._points.targets]
            allowed = 2 * np.maximum(own[1:], own[:-1])[: len(off)]
            index = int((off / allowed).argmax())
            if off[index] > allowed[index]:
                error = display_units().length.text(off[index], ".2g")
                notes.append(
                    f"{_after(index)} the tip is up to {error} off the path; with more points, or "
                    "lower rates, it stays nearer."
                )
        return " ".join(notes)


def _after(index: int) -> str:
    return f"Between points {index + 1} and {index + 2}"


def _unreachable(solution: PathSolution, index: int, message: str) -> PathSolution:
    return replace(solution, status="unreachable", message=message, first_failure=index)


def _errors(judgements: Sequence[Judgement], name: str) -> Array | None:
    if name not in judgements[0].errors:
        return None
    return np.array([judgement.errors[name] for judgement in judgements])


def _what_is_wrong(judgement: Judgement) -> str:
    if not judgement.is_clear:
        name, missing = max(judgement.intruders.items(), key=lambda item: item[1])
        return f"the body is {display_units().length.text(missing, '.3g')} too near to '{name}'"
    if not judgement.limits_hold:
        return "a pressure is beyond its limits"
    return "the tip is off its target"
