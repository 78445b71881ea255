"""The controller: from a task, pressure readings and tracker samples to the next pressures.

It moves in the space of pressures, where every straight line between permitted pressures is
permitted, along a smooth reference to the plan (`Reference`). It corrects at the tip, for the
offset that the estimator finds and the plan does not account for yet, and damps the vibration of
the arm (`stiffopt.control.feedback`). A small quadratic program (`Allocation`) combines both within
all limits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.control.allocation import Allocation
from stiffopt.control.checks import limited_range, refusing
from stiffopt.control.course import Course
from stiffopt.control.estimator import TipEstimator
from stiffopt.control.feedback import GainSchedule, tracking_rows
from stiffopt.control.interface import ControlOutput, Notice, SampleCounts
from stiffopt.control.linearised_tip import LinearisedTip
from stiffopt.control.planner import InlinePlanner, ProcessPlanner
from stiffopt.control.reference import Reference
from stiffopt.control.regulators import PressureEstimator
from stiffopt.control.replanning import Pursuit, Replanner
from stiffopt.control.state import ControllerStatus, Severity
from stiffopt.control.tip_errors import TipErrors, target_arrays, wrench_at
from stiffopt.control.tuning import ControlTuning
from stiffopt.control.vibration import BendingMode
from stiffopt.errors import InputError
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.optimise.tip import TipAt
from stiffopt.paths.trajectory import Trajectory
from stiffopt.rig.interface import PoseSample, PressureLimits, PressureReading
from stiffopt.rig.settings import ControlSettings, Safety

Array = NDArray[np.float64]

_MOST_STEPS = 50  # of the estimators in one tick, after a pause


class TipController:
    """Controls the tip of an arm; see `Controller` for its methods.

    Parameters
    ----------
    robot :
        The model of the arm.
    limits :
        Of the commands.
    slew :
        Greatest rate of change (n,), in Pa/s.
    period :
        Of the loop, in s.
    control, safety :
        Settings of the rig.
    vibrates :
        Whether the arm vibrates as its robot file implies, where the settings leave that open.
    plan_in_process :
        Whether plans are made in a process of their own; otherwise at once, for simulated time.
    tuning :
        Of the parts.
    """

    def __init__(
        self,
        robot: Manipulator,
        limits: PressureLimits,
        slew: ArrayLike,
        *,
        period: float,
        control: ControlSettings | None = None,
        safety: Safety | None = None,
        vibrates: bool = True,
        plan_in_process: bool = False,
        tuning: ControlTuning | None = None,
    ) -> None:
        self.robot, self.limits = robot, limits
        control, safety = control or ControlSettings(), safety or Safety()
        self._tuning = tuning = tuning or ControlTuning()
        self._period, n = period, robot.n_pressures
        slew = np.broadcast_to(np.asarray(slew, dtype=float), n).copy()
        if control.vibration != "auto":
            vibrates = control.vibration == "modelled"
        mode = BendingMode.of(robot.description) if vibrates else None
        self._pressures = PressureEstimator(
            robot.description, control, period, slew, tuning.regulators
        )
        lag, dead_time = self._pressures.lag, self._pressures.dead_time
        filter_tuning = replace(
            tuning.estimator,
            noise=control.tracker_noise,
            max_speed=safety.max_tip_speed,
            damping=control.damping,
        )
        self._estimator = TipEstimator(period, n, mode, filter_tuning)
        self._reference = Reference(
            period, slew, lag, control.damping, 6, tuning.reference.slew_share
        )
        effort = tuning.feedback.effort
        self._gains = GainSchedule(period, lag, control.damping, effort) if vibrates else None
        self._allocation = Allocation(
            tracking_rows(n, mode, control.damping, dead_time, tuning.feedback),
            limits.low,
            limits.high,
            slew * period,
            safety.max_tip_speed * period,
            control.solver,
            tuning.feedback,
        )
        planner = ProcessPlanner(robot) if plan_in_process else InlinePlanner(robot)
        self.replanner = Replanner(planner, tuning.replanning, period, dead_time)
        self._errors = TipErrors()
        self._model: LinearisedTip | None = None  # at the effective pressures
        self._path_model: LinearisedTip | None = None  # on the reference's path
        self.begin(0.0)

    def check(self) -> None:
        """Compile and try the model; see `Controller.check`."""
        if self._model is not None:
            return
        model = LinearisedTip(self.robot)
        path_model = LinearisedTip(self.robot, self._tuning.reference.model_range)
        if not model.is_fast and self.robot.is_loaded:
            raise InputError(
                "the control loop needs a C compiler for an arm under gravity or a load; "
                "install one (Debian: apt install gcc) or set STIFFOPT_COMPILER"
            )
        self._model, self._path_model = model, path_model
        self.begin(self._now)

    def begin(self, now: float) -> None:
        """Start anew with a vented arm and no task."""
        self._now = now
        self.replanner.begin()
        self._pressures.begin()
        self._estimator.begin()
        zero = self._pressures.command
        self._reference.begin(np.concatenate([zero, np.zeros(6)]))
        self._corrected_offset = np.zeros(6)
        self._saturated = np.zeros(len(zero), dtype=bool)
        self._allocation.limit(self.limits.low, self.limits.high)
        self._tip: TipAt | None = None
        if self._model is not None:
            self._tip = self._model.at(zero)
            self._estimator.advance(now, zero, self._tip)
        self._at_rest = True  # the reference begins at the present pressures

    def set_task(self, task: Task) -> None:
        """Pursue a task; see `Controller.set_task`."""
        with refusing("task"):
            self._pursue_task(task)

    def set_target(self, target: Target) -> None:
        """Go to another target; see `Controller.set_target`."""
        with refusing("target"):
            self._pursue_target(target)

    def follow(self, trajectory: Trajectory, now: float) -> None:
        """Follow a trajectory; see `Controller.follow`."""
        with refusing("trajectory"):
            estimate = self._estimator.estimate
            course = Course(trajectory, now, estimate.position, estimate.rotation)
            self._pursue_target(course.at(now), course)

    def _pursue_task(self, task: Task, course: Course | None = None) -> None:
        limited = _within_limits(task, self.robot, self.limits)
        lower, upper = limited.pressure_bounds(self.robot.description)
        self.replanner.pursue(Pursuit.of(task, limited, course))
        self._allocation.limit(lower, upper)  # last, since it cannot fail: the pursuit has changed

    def _pursue_target(self, target: Target, course: Course | None = None) -> None:
        """Go to a target, with goal and limits of the task, if there is one."""
        pursuit = self.replanner.pursuit
        if pursuit.task is None:
            self._pursue_task(Task(robot=self.robot.description.name, target=target), course)
        else:
            self.replanner.pursue(pursuit.to(target, course))

    def resume(self, now: float) -> None:
        """Control again from where the pressures are."""
        offset, pressures = self._estimator.offset, self._pressures
        self._corrected_offset = offset
        self._reference.begin(
            np.concatenate([pressures.command + pressures.history_offset, offset])
        )
        self._at_rest = False

    def observe(
        self,
        now: float,
        commanded: Array,
        reading: PressureReading,
        samples: Sequence[PoseSample],
    ) -> SampleCounts:
        """Estimate pressures and tip; see `Controller.observe`."""
        steps = min(max(1, round((now - self._now) / self._period)), _MOST_STEPS)
        self._now = now
        self._pressures.advance(steps, commanded, reading.pressures)
        effective = self._pressures.effective
        self._tip = tip = self._models()[0].at(effective)
        for step in range(steps):
            moment = now - (steps - 1 - step) * self._period
            self._estimator.advance(moment, effective, tip)
        return self._estimator.take(samples)

    def compute(self, now: float) -> ControlOutput:
        """Compute the next command; see `Controller.compute`."""
        reference, estimator, pressures = self._reference, self._estimator, self._pressures
        omega, command_offset = estimator.omega, pressures.command_offset
        plan = self.replanner.update(now, estimator.offset, command_offset, omega, reference.delay)
        last, n = pressures.command, len(pressures.command)
        if plan is None:  # nothing to do, or no plan yet
            self._at_rest = True
            return ControlOutput(last.copy(), True, np.zeros(n, dtype=bool))
        if self._at_rest:
            self.resume(now)
        if self._model_is_wrong():
            return ControlOutput(last.copy(), False, self._saturated.copy())
        tuning = self._tuning.reference
        reference.rate = tuning.rigid_rate
        if self._gains is not None:
            reference.rate = min(reference.rate, tuning.vibrating_rate * omega)
        reference.omega = omega
        reference.advance(plan)
        tip = self._models()[1].at(reference.path[:n])
        self._update_corrected_offset(omega)
        correction = reference.path[n:] - self._corrected_offset
        prescribed = self.replanner.pursuit.prescribed
        command, held, residual = self._allocation.solve(
            (tip.pose, tip.jacobian, prescribed, correction, *self._vibration_inputs()),
            reference.command - command_offset,
            last,
        )
        if command is None:
            return ControlOutput(last.copy(), False, self._saturated.copy())
        reported = residual > self._tuning.feedback.unreported_error
        self._saturated = held if reported else np.zeros(n, dtype=bool)
        return ControlOutput(command, True, self._saturated.copy())

    def status(self, now: float) -> ControllerStatus:
        """Return the controller's part of the state; see `Controller.status`."""
        n, tip, pursuit = self.robot.n_pressures, self._tip, self.replanner.pursuit
        if tip is None:
            return ControllerStatus(plan=np.full(n, np.nan))
        estimate = self._estimator.estimate
        target = pursuit.target_at(now)
        position, pointing, quaternion = target_arrays(target)
        position_error, angle_error = self._errors.at(target, estimate.position, estimate.rotation)
        sample, plan = self._estimator.sample, self.replanner.plan
        stiffness = math.nan
        if pursuit.stiffness is not None:
            stiffness = pursuit.stiffness(tip.compliance, tip.pose[:3, :3])
        turn = estimate.turn if self._estimator.turn_known else None
        planned = np.full(n, np.nan)
        if plan is not None:
            planned = plan.pressures - self._pressures.history_offset
        return ControllerStatus(
            plan=planned,
            tip_position=estimate.position,
            tip_quaternion=estimate.quaternion,
            seen_position=np.full(3, np.nan) if sample is None else sample.position,
            seen_age=math.inf if sample is None else now - sample.time,
            target_position=position,
            target_quaternion=quaternion,
            target_pointing=pointing,
            position_error=position_error,
            angle_error=angle_error,
            stiffness=stiffness,
            best_stiffness=math.nan if plan is None else plan.stiffness,
            disturbance=estimate.offset,
            wrench=wrench_at(tip, estimate.offset, turn),
            task=pursuit.kind,
            stiffness_unit=pursuit.unit,
            model_position=estimate.static,
        )

    def notices(self) -> tuple[Notice, ...]:
        """Return what is wrong."""
        notices = self.replanner.notices()
        if self._model_is_wrong():
            away = 1e3 * float(np.linalg.norm(self._estimator.offset[:3]))
            text = (
                f"the tip is seen {away:.0f} mm from where the model has it; check the tracker's "
                "registration and sensor, the tubes, and that the robot file is this arm's"
            )
            notices = (*notices, Notice("implausible", text, Severity.ERROR, standing=True))
        return notices

    def close(self) -> None:
        """End the planner."""
        self.replanner.close()

    def _model_is_wrong(self) -> bool:
        """Whether the offset is too large to be an error of this arm's model."""
        offset = self._estimator.offset[:3]
        most = self._tuning.feedback.max_offset * self.robot.length
        return float(offset @ offset) > most**2

    def _models(self) -> tuple[LinearisedTip, LinearisedTip]:
        """The model at the effective pressures, and on the reference's path."""
        if self._model is None or self._path_model is None:
            self.check()
            return self._models()
        return self._model, self._path_model

    def _update_corrected_offset(self, omega: float) -> None:
        """Let the offset that feedback corrects follow the estimate.

        In an arm that vibrates it is filtered: part of each vibration is mistaken for an offset,
        and all of the higher modes, which the estimator does not model.
        """
        share = 1.0
        if math.isfinite(omega):
            share = -math.expm1(-self._tuning.feedback.offset_rate * omega * self._period)
        offset = self._corrected_offset
        self._corrected_offset = offset + share * (self._estimator.offset - offset)

    def _vibration_inputs(self) -> tuple[ArrayLike, ...]:
        """Inputs of `tracking_rows` for an arm that vibrates."""
        if self._gains is None:
            return ()
        estimator, motion = self._estimator, self._reference.motion
        n = len(self._pressures.command)
        return (
            estimator.vibration, estimator.soft_plane, estimator.omega,
            self._gains.at(estimator.omega), self._pressures.effective_ahead,
            self._reference.chamber, motion[0, :n], motion[1, :n],
        )  # fmt: skip


def _within_limits(task: Task, robot: Manipulator, limits: PressureLimits) -> Task:
    """Return a task with the rig's limits of pressure as well; see `limited_range`."""
    on_rig = task.model_copy(update={"pressure": limited_range(task.pressure, limits)})
    lower, upper = on_rig.pressure_bounds(robot.description)
    pressure = PressureRange(min=tuple(lower.tolist()), max=tuple(upper.tolist()))
    # a load shows in the tip's offset, by as much as there is of it
    return task.model_copy(update={"pressure": pressure, "load": None})
