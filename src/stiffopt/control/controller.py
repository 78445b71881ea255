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

from stiffopt.control.adaptation import Adapted
from stiffopt.control.allocation import Allocation
from stiffopt.control.bracing import BracePhase, Bracing
from stiffopt.control.channels import Channels
from stiffopt.control.checks import check_press, check_rates, limited_range, refusing
from stiffopt.control.course import Course
from stiffopt.control.estimator import TipEstimator
from stiffopt.control.feedback import GainSchedule, tracking_rows
from stiffopt.control.forecast import Forecast, Present
from stiffopt.control.interface import ControlOutput, Notice, SampleCounts
from stiffopt.control.linearised_tip import LeaningTip, LinearisedTip
from stiffopt.control.motion_watch import MotionWatch
from stiffopt.control.planner import InlinePlanner, ProcessPlanner
from stiffopt.control.posture import PostureCourse
from stiffopt.control.pressing import Phase, Pressing
from stiffopt.control.reference import Reference, VibrationFilter
from stiffopt.control.regulators import PressureEstimator
from stiffopt.control.replanning import AnyCourse, Pursuit, Replanner
from stiffopt.control.state import ControllerStatus, Severity
from stiffopt.control.tip_errors import TipErrors, target_arrays
from stiffopt.control.touch import TouchEstimator
from stiffopt.control.tuning import ControlTuning
from stiffopt.control.vibration import BendingMode
from stiffopt.control.windows import WindowWatch
from stiffopt.errors import InputError, StiffoptError, dotted
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.optimise.tip import TipAt, TipModel
from stiffopt.paths.trajectory import Trajectory
from stiffopt.rig.interface import PoseSample, PressureLimits, PressureReading
from stiffopt.rig.settings import ControlSettings, Safety
from stiffopt.schema import BadKeyError

Array = NDArray[np.float64]

_NORMAL = 1.959963984540054  # 97.5 % quantile
_MOST_STEPS = 50  # of the estimators in one tick, after a pause
_HELD = 2.5  # periods without a command, after which others have commanded
_SLACK = 1e-3  # Pa, of a limit, by rounding


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
    scene :
        What the arm has to keep clear of; None: nothing is checked.
    plan_in_process :
        Whether plans are made in a process of their own; otherwise at once, for simulated time.
    tuning :
        Of the parts.

    Attributes
    ----------
    forecast : of requests that are to be checked against the scene; None without one.
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
        scene: Scene | None = None,
        plan_in_process: bool = False,
        tuning: ControlTuning | None = None,
    ) -> None:
        self.robot, self.limits, self._scene = robot, limits, scene
        control, safety = control or ControlSettings(), safety or Safety()
        self._tuning = tuning = tuning or ControlTuning()
        self._period, n = period, robot.n_pressures
        self._slew = slew = np.broadcast_to(np.asarray(slew, dtype=float), n).copy()
        if control.vibration != "auto":
            vibrates = control.vibration == "modelled"
        mode = BendingMode.of(robot.description) if vibrates else None
        tolerance = np.broadcast_to(np.asarray(safety.max_pressure_error, dtype=float), n)
        self._channels = Channels(limits, slew, tolerance, tuning.regulators)
        self._pressures = PressureEstimator(
            robot.description, control, period, slew, tuning.regulators, self._channels
        )
        lag, dead_time = self._pressures.lag, self._pressures.dead_time
        filter_tuning = replace(
            tuning.estimator,
            noise=control.tracker_noise,
            max_speed=safety.max_tip_speed,
            damping=control.damping,
        )
        self._estimator = TipEstimator(period, n, mode, filter_tuning)
        self._touch = TouchEstimator(
            [segment.n_channels for segment in robot.description.segments],
            vibrates=mode is not None,
            damping=control.damping,
            tuning=replace(tuning.touch, noise=max(tuning.touch.noise, 2 * control.tracker_noise)),
        )
        self._reference = Reference(
            period, slew, lag, control.damping, 6, tuning.reference.slew_share
        )
        self._averaged = VibrationFilter(period, control.damping, 6)  # the offset
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
        Planner = ProcessPlanner if plan_in_process else InlinePlanner
        self.replanner = Replanner(Planner(robot, scene), tuning.replanning, period, dead_time)
        self.forecast: Forecast | None = None
        if scene is not None:
            self.forecast = Forecast(Planner(robot, scene), tuning.forecast)
        self._frequency = control.frequency
        self._lead = dead_time + 0.5 * period
        self._errors = TipErrors()
        self._windows = WindowWatch(tuning.windows)
        self._adapts = control.adaptation != "none"
        self._watch = MotionWatch(
            robot.description, replace(tuning.motion, scatter=control.tracker_noise)
        )
        self._model: LinearisedTip | None = None  # at the effective pressures
        self._path_model: LinearisedTip | None = None  # on the reference's path
        self._waypoint_model: TipModel | None = None  # at a trajectory's waypoints
        self._robot = robot  # as adapted
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
        self._waypoint_model = TipModel(self.robot)
        self._robot = self.robot
        self._set_frequency()
        self.begin(self._now)

    def _set_frequency(self) -> None:
        """Let the vented arm swing as the settings say, whatever its model."""
        if self._frequency is not None and self._waypoint_model is not None:
            vented = self._waypoint_model.at(np.zeros(self.robot.n_pressures))
            self._estimator.set_frequency(2 * math.pi * self._frequency, vented)

    def begin(self, now: float) -> None:
        """Start anew with a vented arm and no task."""
        self._now = now
        self.replanner.begin()
        self._pressures.begin()
        self._estimator.begin()
        self._touch.begin()
        self._watch.begin()
        zero = self._pressures.command
        self._reference.begin(np.concatenate([zero, np.zeros(6)]))
        self._averaged.begin(np.zeros(6))
        self._saturated = np.zeros(len(zero), dtype=bool)
        self._permitted = self.limits.low, self.limits.high  # commands (n,), by the task
        self._tip: TipAt | None = None
        self._looked_at = now  # capture of the last sample, in s
        self._leaning: LeaningTip | None = None  # the braced tip, while the arm may lean
        if self._model is not None:
            self._model.lean(None)
            self._tip = self._model.at(zero)
            self._estimator.advance(now, zero, self._tip)
        self._at_rest = True  # the reference begins at the present pressures
        self._computed_at = now
        self._adapted_at = -math.inf  # when the model changed; not since the last request
        self._watched_at = -math.inf  # when it was last looked whether the tip rests
        self._windows.begin()
        self._led_to: Target | None = None  # by a trajectory of pressures, now

    def set_task(self, task: Task) -> None:
        """Pursue a task; see `Controller.set_task`."""
        with refusing("task"):
            course: AnyCourse | None = None
            if task.press is not None:
                course = Pressing(task.press, task.target, self._tuning.pressing)
            elif task.brace is not None:
                task = self._in_the_rigs_scene(task)
                course = Bracing(task, self._tuning.bracing)
            if self._bracing is not None and self._bracing.leans:
                _within_limits(task, self.robot, self.limits)  # refuse it now or never
                self._bracing.release(task)
            else:
                self._pursue_task(task, course)
            self._watch.forgive()

    def set_target(self, target: Target) -> None:
        """Go to another target; see `Controller.set_target`."""
        bracing = self._bracing
        if bracing is not None:
            self.set_task(bracing.task.model_copy(update={"target": target}))
            return
        with refusing("target"):
            self._pursue_target(target)

    def follow(self, trajectory: Trajectory, now: float) -> None:
        """Follow a trajectory; see `Controller.follow`."""
        with refusing("trajectory"):
            if self._bracing is not None:
                raise InputError("the arm leans on objects; give it a task without 'brace' first")
            if trajectory.pressures is not None:
                self._follow_posture(trajectory, trajectory.pressures, now)
            else:
                estimate = self._estimator.estimate
                course = Course(trajectory, now, estimate.position, estimate.rotation)
                self._pursue_target(course.at(now), course)
            self._watch.forgive()

    @property
    def _bracing(self) -> Bracing | None:
        course = self.replanner.pursuit.course
        return course if isinstance(course, Bracing) else None

    def _in_the_rigs_scene(self, task: Task) -> Task:
        """Return a task in the rig's scene, which must have the objects that it leans on."""
        if self._scene is None:
            raise InputError("brace: the rig file has no scene, so nothing to lean on is known")
        there = task.model_copy(update={"scene": self._scene})
        assert there.brace is not None
        try:
            there.brace.check(there)
        except BadKeyError as error:
            raise InputError(f"{dotted(error.loc)}: {error}; that is of the rig's scene") from None
        return there

    def set_channels(self, without: Sequence[int]) -> None:
        """Do without some channels; see `Controller.set_channels`."""
        self._channels.take_out(without)

    def _follow_posture(self, trajectory: Trajectory, pressures: Array, now: float) -> None:
        """Follow a trajectory of pressures (k, n) as the posture.

        It begins later by the delay of the reference, which so does not cut off its beginning.
        """
        start, n = self._start(now), pressures.shape[1]
        if self.forecast is not None:
            self.forecast.confirm(trajectory, start[:n])
        self._check_beginning(trajectory.waypoints[0].time, pressures[0], start[:n])
        task = self.replanner.pursuit.task
        if task is not None:
            _check_within(pressures, *task.pressure_bounds(self.robot.description))
        self._models()
        assert self._waypoint_model is not None
        model = self._waypoint_model
        self._set_reference_rate()
        begin = now + self._reference.delay + self._lead
        course = PostureCourse(trajectory, begin, start, lambda p: model.at(p).pose)
        self._pursue_target(course.at(now), course)
        self._computed_at, self._led_to = now, None

    def _start(self, now: float) -> Array:
        """Where a motion begins: pressures and the offset of the tip that goes with them (n + 6,).

        That is where the reference leads, or else the pressures that are held.
        """
        if not self._is_held(now):
            return self._reference.goal
        pressures = self._pressures
        posture = pressures.command + pressures.history_offset
        return np.concatenate([posture, self._offset])

    @property
    def _offset(self) -> Array:
        """Offset of the tip (6,) that is made up for: all but what a press wants."""
        course, offset = self.replanner.pursuit.course, self._estimator.offset
        return course.corrected(offset) if isinstance(course, Pressing) else offset

    def _is_held(self, now: float) -> bool:
        """Whether the pressures are not those that the reference leads to."""
        return self._at_rest or now - self._computed_at > _HELD * self._period

    def _check_beginning(self, time: float, first: Array, start: Array) -> None:
        """Refuse a first waypoint (n,), at a time in s, that cannot be had from the start (n,)."""
        if time > 0:
            check_rates(np.array([0.0, time]), np.stack([start, first]), self._slew, before_first=1)
            return
        for channel in np.flatnonzero(np.abs(first - start) > self._tuning.posture.there):
            raise InputError(
                f"waypoint 1 is at 0 s and has {first[channel] * 1e-5:.4g} bar in channel "
                f"{channel + 1}, which has {start[channel] * 1e-5:.4g} bar now; give it a later "
                "time, in which the arm goes there, or go there before"
            )

    def _pursue_task(self, task: Task, course: AnyCourse | None = None) -> None:
        limited = _within_limits(task, self.robot, self.limits)
        lower, upper = limited.pressure_bounds(self.robot.description)
        self.replanner.pursue(Pursuit.of(task, limited, course))
        self._adapted_at = -math.inf
        self._permitted = lower, upper  # last, since it cannot fail: the pursuit has changed

    def _pursue_target(self, target: Target, course: AnyCourse | None = None) -> None:
        """Go to a target, with goal and limits of the task, if there is one."""
        pursuit = self.replanner.pursuit
        if pursuit.task is None:
            self._pursue_task(self._plain_task(target), course)
        else:
            self.replanner.pursue(pursuit.to(target, course))
            self._adapted_at = -math.inf

    def _plain_task(self, target: Target) -> Task:
        return Task(robot=self.robot.description.name, target=target)

    def check_ahead(self, request: Task | Target | Trajectory) -> None:
        """Refuse what would lead the arm too near to the scene; any thread may ask."""
        if isinstance(request, Task):
            check_press(self.robot, self.limits, request)
            if request.brace is not None:
                self._in_the_rigs_scene(request)
                return  # planned, and its way checked, when it is pursued
        forecast = self.forecast
        if forecast is None or self._bracing is not None:
            return
        if isinstance(request, Trajectory) and request.pressures is not None:
            forecast.check_posture(request, request.pressures)
            return
        here, course, task = forecast.here(), None, None
        if isinstance(request, Trajectory):
            course = Course(request, 0.0, here.position, here.rotation)
            target = course.at(0.0)
        elif isinstance(request, Task):
            target, task = request.target, request
        else:
            target = request
        if task is None and here.pursuit.task is not None:
            forecast.check(here.pursuit.to(target, course))
            return
        task = task or self._plain_task(target)
        limited = _within_limits(task, self.robot, self.limits)
        forecast.check(Pursuit.of(task, limited, course))

    def resume(self, now: float) -> None:
        """Control again from where the pressures are.

        A trajectory of pressures goes on where it was: its way is clear, a shorter one may not be.
        """
        course = self.replanner.pursuit.course
        pause = now - self._computed_at - self._period
        if isinstance(course, PostureCourse) and pause > 0:
            course.wait(pause)
        self._computed_at = now
        self._watch.go_on()
        offset, pressures = self._offset, self._pressures
        self._reference.begin(
            np.concatenate([pressures.command + pressures.history_offset, offset])
        )
        self._averaged.begin(offset)
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
        counts = self._estimator.take(samples)
        sample = self._estimator.sample
        if counts.used and sample is not None:
            bracing = self._bracing
            if bracing is not None and self._leaning is not None:
                elapsed = sample.time - self._looked_at
                bracing.look(elapsed, sample.position, tip, effective)
                self._looked_at = sample.time
            else:
                self._feel(sample, effective, tip)
        if self.forecast is not None:
            self.forecast.present = self._present(now)
        return counts

    def _feel(self, sample: PoseSample, effective: Array, tip: TipAt) -> None:
        """Estimate the force on the tip from a sample, and check the sample against the model."""
        predicted = self._estimator.predicted
        course, pushed = self.replanner.pursuit.course, np.zeros(3)
        presses = isinstance(course, Pressing) and course.touches_on_purpose
        self._touch.stiffness_error = self.replanner.deviation
        if isinstance(course, Pressing) and presses:
            self._touch.expect(course.direction, course.press.speed, presses=course.presses)
        else:
            self._touch.expect(None)
        self._touch.take(
            sample.time, sample.position - predicted, effective, tip, self._estimator.omega
        )
        if presses:
            pushed = self._touch.felt.displacement
        self._watch.take(
            sample.time, sample.position - pushed, predicted, self._estimator.offset,
            effective, tip, turns=self._estimator.turn_known, swing=self._estimator.swing,
        )  # fmt: skip

    def _present(self, now: float) -> Present:
        estimate, replanner = self._estimator.estimate, self.replanner
        return Present(
            replanner.pursuit, replanner.plan, self._way(now), self._estimator.offset,
            self._pressures.command_offset, self._channels.available(), replanner.adapted,
            estimate.position, estimate.rotation,
        )  # fmt: skip

    def _way(self, now: float) -> Array:
        """Effective pressures (2, n) on the reference's path now, and where that leads."""
        n, goal = self.robot.n_pressures, self._start(now)
        here = goal if self._is_held(now) else self._reference.path
        return np.stack([here[:n], goal[:n]])

    def compute(self, now: float) -> ControlOutput:
        """Compute the next command; see `Controller.compute`."""
        output = self._compute(now)
        self._computed_at = now
        posture = output.pressures + self._pressures.command_offset
        return replace(output, posture=posture, leans=self._leaning is not None)

    def _compute(self, now: float) -> ControlOutput:
        reference, estimator, pressures = self._reference, self._estimator, self._pressures
        command_offset = pressures.command_offset
        if self._adapts:
            self._adapt(now)
        self._press(now)
        plan = self._plan(now)
        last, n = pressures.command, len(pressures.command)
        if plan is None:  # nothing to do, or no plan yet
            self._at_rest = True
            _, high = self._channels.commands(last, *self._permitted)
            return ControlOutput(np.minimum(last, high), True, np.zeros(n, dtype=bool))
        if self._at_rest:
            self.resume(now)
        if self._model_is_wrong():
            return ControlOutput(last.copy(), False, self._saturated.copy())
        self._set_reference_rate()
        reference.omega = estimator.omega
        reference.advance(plan)
        if self._leaning is not None:
            return self._held_to(reference.command - command_offset, last)
        tip = self._models()[1].at(reference.path[:n])
        self._watch.intend(now, tip.pose[:3, 3] + reference.path[n : n + 3])
        course = self.replanner.pursuit.course
        self._led_to = None
        if isinstance(course, PostureCourse):
            self._led_to = course.target(tip.pose, reference.path[n:])
        prescribed = self.replanner.pursuit.prescribed
        correction = reference.path[n:] - self._correct(estimator)
        self._allocation.limit(*self._channels.commands(reference.path[:n], *self._permitted))
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

    def _held_to(self, pressures: Array, last: Array) -> ControlOutput:
        """Command pressures (n,) as they are: contacts change how the arm swings."""
        most = self._slew * self._period
        low, high = self._channels.commands(self._reference.path[: len(last)], *self._permitted)
        command = np.clip(np.clip(pressures, last - most, last + most), low, high)
        self._saturated = np.zeros(len(last), dtype=bool)
        return ControlOutput(command, True, self._saturated.copy())

    def _plan(self, now: float) -> Array | None:
        """Pressures and offset (n + 6,) that the reference is to lead to; None without a plan."""
        reference, estimator, replanner = self._reference, self._estimator, self.replanner
        course, tuning = replanner.pursuit.course, self._tuning
        if isinstance(course, PostureCourse):
            reference.slew_share = tuning.posture.slew_share
            return course.goal(now + reference.delay + self._lead)
        if isinstance(course, Bracing) and course.phase is not BracePhase.PLANNING:
            return self._brace(course, now)
        calm = now - self._adapted_at < tuning.adaptation.calm_time
        share = tuning.adaptation.slew_share if calm else tuning.reference.slew_share
        reference.slew_share = share
        way = None if self.forecast is None else self._way(now)
        found = replanner.update(
            now, self._offset, self._pressures.command_offset, estimator.omega,
            reference.delay, self._channels.available(), way, self._windows.windows,
        )  # fmt: skip
        if isinstance(course, Bracing):
            return self._brace_planned(course, found, now)
        return found

    def _brace_planned(self, course: Bracing, found: Array | None, now: float) -> Array | None:
        """Begin a brace when its plan is there; until then the arm stays where it is."""
        plan = self.replanner.current
        if plan is None:
            return None if self._at_rest else self._start(now)
        if plan.approach is None:  # the arm does better to keep clear of the objects
            self.replanner.pursue(self.replanner.pursuit.to(course.task.target))
            return found
        course.begin(plan.approach, self._start(now)[: self.robot.n_pressures])
        return self._brace(course, now)

    def _brace(self, course: Bracing, now: float) -> Array | None:
        """Go on with a brace; see `_plan`. The tip's offset is left as it is."""
        self._reference.slew_share = self._tuning.reference.slew_share
        self.replanner.latest()  # an answer that nobody takes would look like a slow planner
        before = course.pressures
        is_there = not self._is_held(now) and self._is_near(before)
        course.advance(min(now - self._computed_at, _HELD * self._period), is_there)
        if course.leans is not (self._leaning is not None) and course.approach is not None:
            self._lean_on(LeaningTip(course.approach) if course.leans else None)
        if course.phase is BracePhase.RELEASED and course.next is not None:
            self.set_task(course.next)
            return self._plan(now)
        if course.phase is BracePhase.HELD:
            self._correct_brace(course, now)
        return np.concatenate([course.pressures, self._estimator.offset])

    def _is_near(self, pressures: Array) -> bool:
        """Whether the reference is at rest, at pressures (n,)."""
        n, tuning = len(pressures), self._tuning.reference
        off = float(np.abs(self._reference.path[:n] - pressures).max())
        return off < tuning.there and bool(
            np.abs(self._reference.motion[1, :n]).max() <= tuning.at_rest
        )

    def _correct_brace(self, course: Bracing, now: float) -> None:
        """Bring the braced tip to its target."""
        tip = self._tip
        wanted, _, _ = target_arrays(course.task.target)
        if tip is None or wanted is None:
            return
        error = np.nan_to_num(wanted - self._estimator.position)
        elapsed = min(now - self._computed_at, _HELD * self._period)
        course.correct(elapsed, error, tip.pose[:3, :3] @ tip.jacobian[:3])

    def _lean_on(self, leaning: LeaningTip | None) -> None:
        """Go on with the model of an arm that leans on objects; None: of the free one."""
        model, effective = self._models()[0], self._pressures.effective
        before = model.at(effective)
        self._leaning = leaning
        model.lean(leaning)
        self._tip = model.at(effective)
        self._shift(before, self._tip)
        self._touch.begin()
        self._watch.go_on()

    def _shift(self, before: TipAt, after: TipAt) -> Array:
        """Let the offset (6,) take up what the model changes by, everywhere in the loop."""
        change = self._estimator.change_model(before, after)
        self._watch.change_model(change)
        self._touch.change_model(change)
        self._reference.shift(change)
        self._averaged.shift(change)
        return change

    def _press(self, now: float) -> None:
        """Go on with a press."""
        course, tip = self.replanner.pursuit.course, self._tip
        if not isinstance(course, Pressing) or tip is None:
            return
        R = tip.pose[:3, :3]
        elapsed = min(now - self._computed_at, _HELD * self._period)
        course.advance(
            elapsed, self._rests(now), self._is_known(now), self._estimator.estimate.position,
            self._estimator.offset, self._touch.felt, R, R @ tip.compliance[:3, :3] @ R.T,
        )  # fmt: skip

    def _is_known(self, now: float) -> bool:
        """Whether the stiffness is known as well as adaptation will soon know it."""
        if not self._adapts:
            return True
        known, calm = self.replanner.known, self._tuning.adaptation.calm_time
        return known is not None and known.proposal is None and now - self._adapted_at > calm

    def _adapt(self, now: float) -> None:
        """Watch the tip at rest, and go on with other numbers of the arm when it is time."""
        if now - self._watched_at < self._tuning.windows.every:
            return
        self._watched_at = now
        windows, known = self._windows, self.replanner.known
        if self._rests(now) and not self._touch.felt.touches:
            windows.look(now, self._pressures.effective, self._estimator)
        else:
            windows.begin()
        if known is None or known.proposal is None or not windows.has_rested(now):
            return
        if now - self._adapted_at > self._tuning.adaptation.interval:
            self._go_on_with(known.proposal)

    def _rests(self, now: float) -> bool:
        """Whether the arm is at rest, steered, and seen."""
        estimator, t = self._estimator, self._tuning.windows
        sample = estimator.sample
        if sample is None or now - sample.time > t.seen or self._is_held(now):
            return False
        course = self.replanner.pursuit.course
        goes = course is None or (isinstance(course, Pressing) and course.phase is Phase.GOING)
        if not goes or not self._has_arrived():
            return False
        return float(np.abs(estimator.vibration[0]).max()) < t.vibration

    def _go_on_with(self, adapted: Adapted) -> None:
        """Go on with other numbers of the arm, so that nothing moves at this moment.

        The offset takes up what the model changes by, everywhere in the loop.
        """
        model, path_model = self._models()
        assert self._waypoint_model is not None
        models = (model, path_model, self._waypoint_model)
        effective = self._pressures.effective
        before, last = model.at(effective), self._robot
        try:
            robot = Manipulator(adapted.description)
            for each in models:
                each.change(robot)
            after = model.at(effective)
        except StiffoptError:  # no such arm stands: stay with the last
            for each in models:
                each.change(last)
            return
        self._robot, self._tip, self._adapted_at = robot, after, self._now
        self._set_frequency()
        self.replanner.go_on_with(adapted, self._shift(before, after))

    def _has_arrived(self) -> bool:
        """Whether the reference rests on the plan."""
        reference, plan = self._reference, self.replanner.plan
        if plan is None:
            return False
        n, tuning = len(plan.pressures), self._tuning.reference
        for place in (reference.path, reference.goal):
            if np.abs(place[:n] - plan.pressures).max() > tuning.there:
                return False
        return bool(np.abs(reference.motion[1, :n]).max() <= tuning.at_rest)

    def _set_reference_rate(self) -> None:
        tuning, rate = self._tuning.reference, self._tuning.reference.rigid_rate
        if self._gains is not None:
            rate = min(rate, tuning.vibrating_rate * self._estimator.omega)
        self._reference.rate = rate

    def status(self, now: float) -> ControllerStatus:
        """Return the controller's part of the state; see `Controller.status`."""
        n, tip, pursuit = self.robot.n_pressures, self._tip, self.replanner.pursuit
        if tip is None:
            return ControllerStatus(plan=np.full(n, np.nan))
        estimate = self._estimator.estimate
        felt, bracing = self._touch.felt, self._bracing
        touches, force, covariance = felt.touches, felt.force, felt.covariance
        if bracing is not None and bracing.leans:
            force, covariance = bracing.push, bracing.covariance
            touches = bool(force.any())
        target, press_force, press_goal = self._led_to or pursuit.target_at(now), math.nan, math.nan
        if isinstance(pursuit.course, Pressing):
            target = pursuit.course.shown(estimate.position)
            press_force, press_goal = pursuit.course.force, pursuit.course.press.force
            touches = touches or pursuit.course.phase is Phase.PRESSING
        position, pointing, quaternion = target_arrays(target)
        position_error, angle_error = self._errors.at(target, estimate.position, estimate.rotation)
        sample, plan = self._estimator.sample, self.replanner.plan
        stiffness = math.nan
        if pursuit.stiffness is not None:
            stiffness = pursuit.stiffness(tip.compliance, tip.pose[:3, :3])
        ratio = math.exp(_NORMAL * self.replanner.deviation)  # NaN if it is not known
        planned = np.full(n, np.nan)
        if self._led_to is not None:
            planned = self._reference.goal[:n] - self._pressures.history_offset
        elif plan is not None:
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
            stiffness_low=stiffness / ratio,
            stiffness_high=stiffness * ratio,
            adapted=() if self.replanner.known is None else self.replanner.known.numbers,
            best_stiffness=math.nan if plan is None else plan.stiffness,
            disturbance=estimate.offset,
            touches=touches,
            wrench=np.concatenate([force, np.zeros(3)]),
            wrench_covariance=covariance.ravel(),
            press_force=press_force,
            press_goal=press_goal,
            brace="" if bracing is None else bracing.phase.value,
            brace_force=math.nan if bracing is None else bracing.force,
            brace_margin=math.nan if bracing is None else bracing.margin,
            task=pursuit.kind,
            stiffness_unit=pursuit.unit,
            model_position=estimate.static,
            lost=self._channels.lost,
            shortfall=self._channels.shortfall,
        )

    def notices(self) -> tuple[Notice, ...]:
        """Return what is wrong."""
        notices = (*self.replanner.notices(self._away()), *self._channels.notices())
        course = self.replanner.pursuit.course
        if isinstance(course, Pressing | Bracing):
            notices = (*notices, *course.notices())
        if self._model_is_wrong():
            away = 1e3 * float(np.linalg.norm(self._estimator.offset[:3]))
            text = (
                f"the tip is seen {away:.0f} mm from where the model has it; check the tracker's "
                "registration and sensor, the tubes, and that the robot file is this arm's"
            )
            notices = (*notices, Notice("implausible", text, Severity.ERROR, standing=True))
        if doubt := self._watch.doubt:
            notices = (*notices, Notice(doubt.kind, doubt.text, Severity.ERROR, True, hold=True))
        return notices

    def _away(self) -> tuple[float, float] | None:
        """Distance and angle of a tip that rests on its plan from its target; else None."""
        plan, pursuit = self.replanner.plan, self.replanner.pursuit
        if plan is None or plan.reached or pursuit.course is not None or not self._has_arrived():
            return None
        estimate = self._estimator.estimate
        return self._errors.at(pursuit.target, estimate.position, estimate.rotation)

    def close(self) -> None:
        """End the planners."""
        self.replanner.close()
        if self.forecast is not None:
            self.forecast.close()

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

    def _correct(self, estimator: TipEstimator) -> Array:
        """Offset (6,) that feedback corrects now.

        That of an arm that vibrates is averaged over a vibration, except along its stiff axis.
        """
        self._averaged.advance(self._offset, estimator.omega)
        offset = self._averaged.value.copy()
        behind = self._offset[:3] - offset[:3]
        offset[:3] += behind - estimator.soft_plane @ behind
        return offset

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
            motion[:2, n : n + 3] - self._averaged.motion[:, :3],
        )  # fmt: skip


def _check_within(pressures: Array, low: Array, high: Array) -> None:
    """Refuse waypoints' pressures (k, n) beyond the limits of the task that is pursued."""
    beyond = (pressures < low - _SLACK) | (pressures > high + _SLACK)
    for index, channel in np.argwhere(beyond):
        raise InputError(
            f"waypoints[{index}].pressures: {pressures[index, channel] * 1e-5:g} bar is beyond the "
            f"limits of the task in channel {channel + 1}, {low[channel] * 1e-5:g} to "
            f"{high[channel] * 1e-5:g} bar"
        )


def _within_limits(task: Task, robot: Manipulator, limits: PressureLimits) -> Task:
    """Return a task with the rig's limits of pressure as well; see `limited_range`."""
    on_rig = task.model_copy(update={"pressure": limited_range(task.pressure, limits)})
    lower, upper = on_rig.pressure_bounds(robot.description)
    pressure = PressureRange(min=tuple(lower.tolist()), max=tuple(upper.tolist()))
    # a load shows in the tip's offset, by as much as there is of it
    return task.model_copy(update={"pressure": pressure, "load": None, "press": None})
