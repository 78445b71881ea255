"""Turns a request into a pursuit of the controller, or refuses it."""

from __future__ import annotations

import math

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.adaptation import Adapted
from stiffopt.control.bracing import Bracing
from stiffopt.control.checks import check_press, check_rates, check_scene, limited_range
from stiffopt.control.course import Course
from stiffopt.control.forecast import Forecast
from stiffopt.control.pressing import Pressing
from stiffopt.control.replanning import AnyCourse, Pursuit
from stiffopt.control.setup import ControlSetup
from stiffopt.errors import EquilibriumError, InputError
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.press import Press
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.optimise.tip import TipModel
from stiffopt.paths.trajectory import Trajectory

_SLACK = 1e-3  # Pa, for rounding at limits
_ROUNDING = 1e-6  # share of a speed


class Requests:
    """Turns requests into pursuits, for one arm on one rig.

    All methods raise `InputError` with the reason of a refusal, and change nothing.
    """

    def __init__(self, setup: ControlSetup) -> None:
        speed = setup.control.tip_speed
        self._tip_speed = math.inf if speed is None else speed
        self._robot, self._limits, self._slew = setup.robot, setup.limits, setup.slew
        self._scene, self._tuning = setup.scene, setup.tuning

    def of_task(self, task: Task) -> Pursuit:
        """Return the pursuit of a task, which may press or brace."""
        check_scene(task, self._scene)
        course: AnyCourse | None = None
        if task.press is not None:
            if task.press.speed > self._tip_speed:
                default = float(Press.model_fields["speed"].default)
                raise InputError(
                    f"press.speed: {self._too_fast(task.press.speed)}; write 'speed: "
                    f"{1e3 * self._tip_speed:.3g} mm/s' or less in the task's press (a press "
                    f"without it has {1e3 * default:g} mm/s)"
                )
            course = Pressing(task.press, task.target, self._tuning.pressing)
        elif task.brace is not None:
            task = task.model_copy(update={"scene": self._scene})
            course = Bracing(task, self._tuning.bracing)
        return Pursuit.of(task, self._limited(task), course)

    def of_target(self, target: Target, last: Pursuit, course: AnyCourse | None = None) -> Pursuit:
        """Return the pursuit of a target, with goal and limits of the last task if there is one."""
        if isinstance(course, Course):
            times, tips = course.sampled()
            self._check_speed(times, np.diff(tips, axis=0)[:, :, None])
        if last.task is not None:
            return last.to(target, course)
        task = Task(robot=self._robot.description.name, target=target)
        return Pursuit.of(task, self._limited(task), course)

    def check_posture(
        self, trajectory: Trajectory, pressures: Array, start: Array, task: Task | None
    ) -> None:
        """Refuse a trajectory of pressures (k, n) that cannot begin at a start (n,), in Pa.

        It must also stay within the limits of the present task.
        """
        time = trajectory.waypoints[0].time
        if time > 0:
            ends = np.stack([start, pressures[0]])
            check_rates(np.array([0.0, time]), ends, self._slew, before_first=1)
        else:
            self._check_first(pressures[0], start)
        if task is not None:
            _check_within(pressures, *task.pressure_bounds(self._robot.description))

    def check_ahead(
        self,
        request: Task | Target | Trajectory,
        forecast: Forecast | None,
        leans: bool,
        adapted: Adapted | None,
    ) -> None:
        """Refuse a request that leads the arm too near to the scene; for any thread.

        For a brace, or while the arm leans on objects, the way is checked when it is planned.
        Waypoints with pressures must have an equilibrium by the present model, `adapted` or not.
        """
        if isinstance(request, Trajectory) and request.pressures is not None:
            times = np.array([waypoint.time for waypoint in request.waypoints])
            self._check_speed(times, self._parts(request.pressures, adapted))
        if isinstance(request, Task):
            check_press(self._robot, self._limits, request)
            check_scene(request, self._scene)
            if request.brace is not None:
                return
        if forecast is None or leans:
            return
        if isinstance(request, Trajectory) and request.pressures is not None:
            forecast.check_posture(request, request.pressures)
        elif isinstance(request, Task):
            forecast.check(Pursuit.of(request, self._limited(request)))
        else:
            here, course = forecast.here(), None
            if isinstance(request, Trajectory):
                course = Course(request, 0.0, here.position, here.rotation)
                request = course.at(0.0)
            forecast.check(self.of_target(request, here.pursuit, course))

    def _limited(self, task: Task) -> Task:
        """Return a task with the rig's limits of pressure as well; see `limited_range`."""
        description = self._robot.description
        on_rig = task.model_copy(update={"pressure": limited_range(task.pressure, self._limits)})
        lower, upper = on_rig.pressure_bounds(description)
        pressure = PressureRange(min=tuple(lower.tolist()), max=tuple(upper.tolist()))
        # without its load, whose actual effect is part of the tip's offset
        return task.model_copy(update={"pressure": pressure, "load": None, "press": None})

    def _parts(self, pressures: Array, adapted: Adapted | None) -> Array:
        """Return the motion of the tip between waypoints by each channel (k - 1, 3, n), in m.

        Refuse pressures (k, n) at which the model has no equilibrium.
        """
        arm = self._robot if adapted is None else Manipulator(adapted.description)
        model, tip, jacobians = "adapted model" if adapted else "robot file", TipModel(arm), []
        for index, each in enumerate(pressures):
            try:
                at = tip.at(each)
            except EquilibriumError as error:
                raise InputError(
                    f"waypoints[{index}].pressures: by the {model} the arm has no equilibrium "
                    f"there ({error}); give this waypoint other pressures, or plan again"
                ) from None
            jacobians.append(at.pose[:3, :3] @ at.jacobian[:3])
        J = np.array(jacobians)
        return (J[1:] + J[:-1]) / 2 * np.diff(pressures, axis=0)[:, None, :]

    def _check_speed(self, times: Array, parts: Array) -> None:
        """Refuse waypoints at times (k,), in s, between which the arm would be too fast.

        `parts` (k - 1, 3, m), in m, add up to the motion of the tip, and none may be too fast.
        """
        with np.errstate(all="ignore"):
            alone = np.linalg.norm(parts, axis=1).max(axis=1)
            together = np.linalg.norm(parts.sum(axis=2), axis=1)
            speeds = np.maximum(alone, together) / np.diff(times)
        if not (speeds > (1 + _ROUNDING) * self._tip_speed).any():
            return
        k = int(np.argmax(speeds))
        raise InputError(
            f"waypoints: between {times[k]:.2f} and {times[k + 1]:.2f} s "
            f"{self._too_fast(speeds[k])}; give them more time"
        )

    def _too_fast(self, speed: float) -> str:
        return (
            f"the tip, or its motion by one channel, would have {1e3 * speed:.1f} mm/s; the rig "
            f"file permits {1e3 * self._tip_speed:.1f} mm/s (control.tip_speed)"
        )

    def _check_first(self, first: Array, start: Array) -> None:
        """Refuse pressures (n,) of a waypoint at 0 s that differ from the arm's start (n,)."""
        for channel in np.flatnonzero(np.abs(first - start) > self._tuning.posture.there):
            raise InputError(
                f"waypoint 1 is at 0 s and has {first[channel] * 1e-5:.4g} bar in channel "
                f"{channel + 1}, which has {start[channel] * 1e-5:.4g} bar now; give it a later "
                "time, in which the arm goes there, or go there before"
            )


def _check_within(pressures: Array, low: Array, high: Array) -> None:
    """Refuse waypoints' pressures (k, n) beyond the limits of the present task."""
    beyond = (pressures < low - _SLACK) | (pressures > high + _SLACK)
    for index, channel in np.argwhere(beyond):
        raise InputError(
            f"waypoints[{index}].pressures: {pressures[index, channel] * 1e-5:g} bar is beyond the "
            f"limits of the task in channel {channel + 1}, {low[channel] * 1e-5:g} to "
            f"{high[channel] * 1e-5:g} bar"
        )
