"""The controller: from a task, pressure readings and tracker samples to the next pressures.

It follows a smooth reference to the plan (`Reference`) in the space of pressures, where every
straight line between permitted pressures is permitted. Feedback at the tip (`TipFeedback`) corrects
the offset that the observer (`ArmObserver`) estimates and the plan does not account for yet, and
damps the arm's vibration. A small quadratic program (`Allocation`) combines both within all limits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.arrays import Array
from stiffopt.control.adaptation import Adapted
from stiffopt.control.bracing import BracePhase, Bracing
from stiffopt.control.checks import refusing
from stiffopt.control.correction_bound import CorrectionBound
from stiffopt.control.course import Course
from stiffopt.control.first_motion import FirstMotion
from stiffopt.control.forecast import Forecast, Present
from stiffopt.control.formula import are_within
from stiffopt.control.interface import ControlOutput, Notice, SampleCounts
from stiffopt.control.linearised_tip import LeaningTip
from stiffopt.control.observer import ArmObserver
from stiffopt.control.planner import InlinePlanner, ProcessPlanner
from stiffopt.control.posture import PostureCourse
from stiffopt.control.pressing import Phase, Pressing
from stiffopt.control.reference import Reference
from stiffopt.control.replanning import Pursuit, Replanner
from stiffopt.control.report import Report
from stiffopt.control.requests import Requests
from stiffopt.control.setup import ControlSetup
from stiffopt.control.state import ControllerStatus, Severity
from stiffopt.control.tip_errors import target_arrays
from stiffopt.control.tip_feedback import TipFeedback
from stiffopt.control.tuning import ControlTuning
from stiffopt.control.vibration import BendingMode, BentMode
from stiffopt.control.way_back import WayBack
from stiffopt.control.way_to_target import WayToTarget
from stiffopt.control.windows import WindowWatch
from stiffopt.errors import InputError
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.paths.trajectory import Trajectory
from stiffopt.rig.interface import PoseSample, PressureLimits, PressureReading
from stiffopt.rig.settings import ControlSettings, Safety

Flags = NDArray[np.bool_]

_HELD = 2.5  # periods without `compute`, after which others have commanded the pressures


class TipController:
    """Controls the tip of an arm; see `Controller` for its methods.

    Parameters
    ----------
    robot : the model of the arm.
    limits : limits of the commands.
    slew : greatest rate of change (n,), in Pa/s.
    period : period of the loop, in s.
    control, safety : settings of the rig.
    vibrates : whether to model a vibration, if the settings leave that open.
    scene : objects that the arm has to keep clear of; None: nothing is checked.
    plan_in_process : whether to plan in a separate process; otherwise inline, for simulated time.
    slow_first_motion : whether each channel is slow until the tip has followed it (`FirstMotion`).
    tuning : tuning of the parts.

    Attributes
    ----------
    forecast : checks requests against the scene; None without one.
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
        slow_first_motion: bool = True,
        tuning: ControlTuning | None = None,
    ) -> None:
        self.robot, self.limits = robot, limits
        control, safety = control or ControlSettings(), safety or Safety()
        self._tuning = tuning = (tuning or ControlTuning()).on_rig(control, safety)
        self._period, n = period, robot.n_pressures
        self._no_motion: Array = np.zeros((3, n))
        self._slew = slew = np.broadcast_to(np.asarray(slew, dtype=float), n).copy()
        if control.vibration != "auto":
            vibrates = control.vibration == "modelled"
        mode = BendingMode.of(robot.description) if vibrates else None
        setup = ControlSetup(robot, limits, slew, period, control, safety, mode, scene, tuning)
        self._arm = ArmObserver(setup, self._go_back)
        # models before the present one: the robot file's, and the newest ones
        self._earlier: list[Adapted] = []
        lag, dead_time = self._arm.pressures.lag, self._arm.pressures.dead_time
        self._reference = Reference(
            period, slew, lag, control.damping, 6, tuning.reference.slew_share
        )
        self._mode, self._vibrates = mode, mode is not None
        self._bent: BentMode | None = None  # modes that the estimator has
        self._feedback = TipFeedback(setup, self._arm)
        self._way_back = WayBack(round(tuning.reference.taken_back / period))
        unbounded = {} if slow_first_motion else {"slew_share": math.inf, "correction": math.inf}
        self._first_motion = FirstMotion(replace(tuning.first_motion, **unbounded))
        self._way_to_target = WayToTarget(setup, self._arm)
        self._correction = CorrectionBound(tuning.correction, period, vibrates=self._vibrates)
        self._requests = Requests(setup)
        Planner = ProcessPlanner if plan_in_process else InlinePlanner
        self.replanner = Replanner(Planner(robot, scene), tuning.replanning, period, dead_time)
        self.forecast: Forecast | None = None
        if scene is not None:
            self.forecast = Forecast(Planner(robot, scene), tuning.forecast)
        self._lead = dead_time + 0.5 * period
        self._report = Report(setup, self._arm, self.replanner)
        self._windows = WindowWatch(tuning.windows)
        self._adapts, self._tip_speed = control.adaptation != "none", control.tip_speed
        self.begin(0.0)

    def check(self) -> None:
        """Compile and try the model; see `Controller.check`."""
        if self._arm.model is None:
            self._arm.check()
            self.begin(self._now)

    def begin(self, now: float) -> None:
        """Restart with a vented arm and no task."""
        self._now = now
        self.replanner.begin()
        self._arm.begin(now)
        self._first_motion.begin()
        self._reference.begin(np.concatenate([self._arm.pressures.command, np.zeros(6)]))
        self._feedback.begin()
        self._permitted = self.limits.low, self.limits.high  # commands (n,) that the task permits
        self._at_rest = True  # the reference begins at the present pressures
        self._moved_at = -math.inf  # last time at which the reference moved
        self._computed_at = now
        self._adapted_at = -math.inf  # last adaptation of the model since the last request
        self._model_changed_at = -math.inf  # last change of the model
        self._untold: list[Notice] = []  # events since the last call of `notices`
        self._went_back_at = -math.inf  # last return to an earlier model
        self._watched_at = -math.inf  # last check whether the tip rests
        self._lost = self._arm.channels.lost
        self._windows.begin()
        self._led_to: Target | None = None  # present target of a trajectory of pressures
        self._way_back.forget()
        self._way_to_target.begin()
        self._correction.begin()

    def set_task(self, task: Task) -> None:
        """Pursue a task; see `Controller.set_task`."""
        with refusing("task"):
            pursuit, bracing = self._requests.of_task(task), self._bracing
            if bracing is not None and bracing.leans:
                bracing.release(task)
            else:
                self._pursue(pursuit)
            self._arm.watch.forgive()

    def set_target(self, target: Target) -> None:
        """Go to another target; see `Controller.set_target`."""
        bracing = self._bracing
        if bracing is not None:
            self.set_task(bracing.task.model_copy(update={"target": target}))
            return
        with refusing("target"):
            self._pursue(self._requests.of_target(target, self.replanner.pursuit))

    def follow(self, trajectory: Trajectory, now: float) -> None:
        """Follow a trajectory; see `Controller.follow`."""
        with refusing("trajectory"):
            if self._bracing is not None:
                raise InputError("the arm leans on objects; give it a task without 'brace' first")
            if trajectory.pressures is not None:
                self._follow_posture(trajectory, trajectory.pressures, now)
            else:
                estimate = self._arm.tip.estimate
                last = self.replanner.pursuit
                course = last.course
                on_the_way = isinstance(course, Course) and now < course.end
                # from rest the tip cannot be sooner at the first waypoint than the reference
                late = 0.0 if on_the_way else self.trajectory_delay - trajectory.waypoints[0].time
                begin = now + max(0.0, late)
                course = Course(trajectory, begin, estimate.position, estimate.rotation)
                self._pursue(self._requests.of_target(course.at(now), last, course))
            self._arm.watch.forgive()

    @property
    def _bracing(self) -> Bracing | None:
        course = self.replanner.pursuit.course
        return course if isinstance(course, Bracing) else None

    def set_channels(self, without: Sequence[int]) -> None:
        """Do without some channels; see `Controller.set_channels`."""
        self._arm.channels.take_out(without)

    @property
    def trajectory_delay(self) -> float:
        """Time by which the reference is late, and with it a trajectory's beginning, in s."""
        self._set_reference_rate()
        return self._reference.delay + self._lead

    def _follow_posture(self, trajectory: Trajectory, pressures: Array, now: float) -> None:
        """Follow a trajectory of pressures (k, n) as the posture.

        It begins later by the reference's delay, so that the reference does not miss its beginning.
        """
        start, n = self._start(now), pressures.shape[1]
        if self.forecast is not None:
            self.forecast.confirm(trajectory, start[:n])
        last = self.replanner.pursuit
        self._requests.check_posture(trajectory, pressures, start[:n], last.task)
        begin = now + self.trajectory_delay
        course = PostureCourse(trajectory, begin, start, lambda p: self._arm.at_waypoint(p).pose)
        self._pursue(self._requests.of_target(course.at(now), last, course))
        self._computed_at, self._led_to = now, None

    def _start(self, now: float) -> Array:
        """Return the start of a motion: pressures and the tip's offset for them (n + 6,).

        The start is the reference's goal, or the held pressures if others have commanded them.
        """
        if not self._is_held(now):
            return self._reference.goal
        pressures = self._arm.pressures
        posture = pressures.command + pressures.history_offset
        return np.concatenate([posture, self._offset])

    @property
    def _offset(self) -> Array:
        """Offset of the tip (6,) to compensate: without the displacement that a press intends."""
        course, offset = self.replanner.pursuit.course, self._arm.tip.offset
        return course.corrected(offset) if isinstance(course, Pressing) else offset

    @property
    def _goes_to_target(self) -> bool:
        """Whether the task has a single target, without a trajectory, a brace or a begun press."""
        course = self.replanner.pursuit.course
        return course is None or (isinstance(course, Pressing) and course.phase is Phase.GOING)

    @property
    def _waits(self) -> bool:
        """Whether the reference waits because something pushes the arm.

        It does not in a press, which must be able to go back at any time.
        """
        return self._arm.watch.waits and self._goes_to_target

    def _is_held(self, now: float) -> bool:
        """Whether the pressures are held, so that they are not the reference's."""
        return self._at_rest or now - self._computed_at > _HELD * self._period

    def _pursue(self, pursuit: Pursuit) -> None:
        assert pursuit.task is not None
        permitted = pursuit.task.pressure_bounds(self.robot.description)
        self.replanner.pursue(pursuit)
        self._adapted_at = -math.inf
        self._permitted = permitted  # last: the pursuit has changed and this cannot fail

    def check_ahead(self, request: Task | Target | Trajectory) -> None:
        """Refuse a request that leads the arm too near to the scene; for any thread."""
        leans, adapted = self._bracing is not None, self.replanner.adapted
        self._requests.check_ahead(request, self.forecast, leans, adapted)

    def resume(self, now: float) -> None:
        """Resume control from the present pressures.

        A trajectory of pressures continues where it stopped: its way is clear, a shortcut may not
        be.
        """
        course = self.replanner.pursuit.course
        pause = now - self._computed_at - self._period
        if isinstance(course, PostureCourse) and pause > 0:
            course.wait(pause)
        self._computed_at = now
        self._arm.watch.go_on()
        offset, pressures = self._offset, self._arm.pressures
        here = pressures.chamber if self._arm.channels.lost.any() else pressures.command
        self._reference.begin(np.concatenate([here + pressures.history_offset, offset]))
        self._feedback.resume()
        self._way_back.forget()
        self._way_to_target.begin()
        self._correction.begin()
        self._at_rest = False

    def observe(
        self,
        now: float,
        commanded: Array,
        reading: PressureReading,
        samples: Sequence[PoseSample],
    ) -> SampleCounts:
        """Estimate pressures and tip; see `Controller.observe`."""
        self._now = now
        self._arm.touch.stiffness_error = self.replanner.deviation
        course, steers = self.replanner.pursuit.course, not self._is_held(now)
        if isinstance(course, Bracing):
            course.follow(steers, self._arm.pressures.effective)
        swings = now - self._moved_at < self._tuning.estimator.swings_on
        self._arm.tip.learns = steers and swings
        counts = self._arm.observe(now, commanded, reading, samples, course)
        tip, sample = self._arm.modelled, self._arm.tip.sample
        if counts.used and sample and tip:
            estimator = self._arm.tip
            if not self._first_motion.is_over:
                parts = tip.pose[:3, :3] @ tip.jacobian[:3] * estimator.captured
                self._first_motion.take(estimator.predicted, sample.position, parts)
            self.replanner.look(sample.time, estimator.offset, estimator.captured, tip)
        if self.forecast is not None:
            self.forecast.present = self._present(now)
        return counts

    def _present(self, now: float) -> Present:
        estimate, replanner = self._arm.tip.estimate, self.replanner
        return Present(
            replanner.pursuit, replanner.plan, self._way(now), self._arm.tip.offset,
            self._arm.pressures.command_offset,
            replanner.limited(self._arm.channels.available(), np.zeros(self.robot.n_pressures)),
            replanner.adapted, estimate.position, estimate.rotation, self._vibrates,
        )  # fmt: skip

    def _way(self, now: float) -> Array:
        """Return effective pressures (2, n): on the reference's path now, and at its goal."""
        n, goal = self.robot.n_pressures, self._start(now)
        here = goal if self._is_held(now) else self._reference.path
        return np.stack([here[:n], goal[:n]])

    def compute(self, now: float) -> ControlOutput:
        """Compute the next command; see `Controller.compute`."""
        output = self._compute(now)
        self._computed_at = now
        return output

    def _output(self, pressures: Array, saturated: Flags, *, valid: bool = True) -> ControlOutput:
        """Return commands (n,) with what is known of them."""
        posture = pressures + self._arm.pressures.command_offset
        leans = self._arm.leaning is not None
        return ControlOutput(pressures, valid, saturated.copy(), posture, leans)

    def _compute(self, now: float) -> ControlOutput:
        reference, pressures = self._reference, self._arm.pressures
        if self._adapts:
            self._adapt(now)
        self._press(now)
        plan = self._plan(now)
        last, n = pressures.command, len(pressures.command)
        if plan is None:  # no pursuit, or no plan yet
            self._at_rest = True
            _, high = self._arm.channels.commands(last, *self._permitted)
            return self._output(np.minimum(last, high), np.zeros(n, dtype=bool))
        lost = self._arm.channels.lost
        newly_lost = lost is not self._lost and (lost & ~self._lost).any()
        if self._at_rest or newly_lost:  # they are not where the reference is
            self.resume(now)
        if newly_lost:
            estimate = self._arm.tip.estimate
            self.replanner.go_straight(
                now, estimate.position, estimate.rotation, self._reference.path[:n], self._offset
            )
            plan = self._reference.path
        self._lost = lost
        if self._report.model_is_wrong:
            return self._output(last.copy(), self._feedback.saturated, valid=False)
        self._set_reference_rate()
        reference.omega = self._arm.tip.omega
        reference.motion_share = self._motion_share(reference.path[:n])
        reference.advance(self._awaited(plan, now))
        moves = self._moves()
        if moves:
            self._moved_at = now
        if self._arm.leaning is not None:
            self._way_back.forget()  # a free posture is none for an arm that leans, or leant
            return self._feedforward(reference.command - pressures.command_offset, last)
        tip = self._arm.on_path(reference.path[:n])
        if now - self._went_back_at > self._tuning.adaptation.blind_time:
            self._arm.watch.intend(now, tip.pose[:3, 3] + reference.path[n : n + 3])
        course = self.replanner.pursuit.course
        if self._vibrates:
            is_bounded = self.replanner.stiffens
        else:  # feedback makes up at once for a model that has just been adapted
            is_bounded = moves and now - self._model_changed_at > self._tuning.adaptation.calm_time
        self._correction.take(tip.pose[:3, 3], applies=course is None and is_bounded)
        if self._arm.channels.pace == 0 and self._way_back and moves:  # feedback waits as well
            without = reference.command - pressures.command_offset + self._way_back.added
            return self._feedforward(without, last)
        bent = self._bend(None if isinstance(course, PostureCourse) else self.replanner.bent)
        self._led_to = None
        if isinstance(course, PostureCourse):
            self._led_to = course.target(tip.pose, reference.path[n:])
        goal = reference.command - pressures.command_offset
        limits = self._arm.channels.commands(reference.path[:n], *self._permitted, goal)
        command = self._feedback.command(
            tip,
            reference,
            self.replanner.pursuit.prescribed,
            self._offset,
            goal,
            self.replanner.limited(limits, pressures.command_offset),
            None if isinstance(course, PostureCourse | Pressing) else course is not None,
            min(self._first_motion.largest_correction(tip.pose[:3, 3]), self._correction.largest),
            bent,
        )
        if command is None:
            return self._output(last.copy(), self._feedback.saturated, valid=False)
        self._way_back.add(reference.path.copy(), command - goal)
        return self._output(command, self._feedback.saturated)

    def _motion_share(self, path: Array) -> Array:
        """Return the motion of the tip per pressure (3, n), over its greatest one in a period."""
        if self._tip_speed is None or self._bracing is not None:
            return self._no_motion
        return self._arm.on_path(path).jacobian[:3] / (self._tip_speed * self._period)

    def _bend(self, bent: BentMode | None) -> BentMode | None:
        """Let the estimator have the modes of the bent arm, and return them."""
        if bent is not self._bent and self._mode is not None:
            self._bent, none = bent, np.zeros((3, self.robot.n_pressures))
            self._arm.tip.excess = none if bent is None else bent.excess(self._mode.participation)
        return self._bent

    def stop(self, now: float) -> Array | None:
        """Stop a doubted motion; see `Controller.stop`.

        The reference goes back to where it was a while before. On its smooth path the arm does not
        begin to vibrate, as it would if its commands froze. What feedback adds goes back on the
        same path, since it may have followed a sensor that is wrong; it stays if only the arm is
        doubted. A channel that moves against its command gets the pressure at which it last
        followed: even reversed it goes back to that.
        """
        channels, last = self._arm.channels, self._arm.pressures.command
        reference, offset = self._reference, self._arm.pressures.command_offset
        doubt = self._arm.watch.doubt
        is_doubted = doubt is not None or channels.opposed.any()
        if not self._vibrates or not is_doubted or not self._way_back:
            return None
        goal = self._way_back.goal
        if goal is None:
            added = last - (reference.command - offset)
            reference.shift(np.concatenate([added, np.zeros(6)]))
            stays = doubt is not None and doubt.is_of_arm
            goal = self._way_back.set_out(added if stays else self._way_back.added)
        if self._is_near(goal[: len(last)]):
            return None
        reference.advance(goal)
        command = reference.command - offset
        command = np.where(channels.opposed, channels.last_followed, command)
        return self._feedforward(command, last).pressures

    def _awaited(self, plan: Array, now: float) -> Array:
        """Return the reference's goal (n + 6,): the plan, unless channels or tip do not follow.

        The reference waits for them where it is, and a trajectory of pressures too; on the way to a
        target also for the end of a push.
        """
        course = self.replanner.pursuit.course
        pace = 0.0 if self._waits else min(self._arm.channels.pace, self._arm.watch.pace)
        if pace == 1 or isinstance(course, Bracing):
            return plan
        if isinstance(course, PostureCourse):
            course.wait((1 - pace) * min(now - self._computed_at, _HELD * self._period))
            return plan
        # an arm that vibrates goes on for a while before its smooth path turns
        back = self._way_back
        path = back.earliest if self._vibrates and back else self._reference.path
        return path + pace * (plan - path)

    def _feedforward(self, pressures: Array, last: Array) -> ControlOutput:
        """Command pressures (n,) without feedback: contacts change how the arm vibrates."""
        step = self._slew * self._period
        low, high = self._arm.channels.commands(self._reference.path[: len(last)], *self._permitted)
        command = np.clip(np.clip(pressures, last - step, last + step), low, high)
        self._feedback.saturated = np.zeros(len(last), dtype=bool)
        return self._output(command, self._feedback.saturated)

    def _plan(self, now: float) -> Array | None:
        """Return the reference's next goal, pressures and offset (n + 6,); None without a plan."""
        reference, estimator, replanner = self._reference, self._arm.tip, self.replanner
        course, tuning = replanner.pursuit.course, self._tuning
        if isinstance(course, PostureCourse):
            reference.slew_share = tuning.posture.slew_share
            return course.goal(now + reference.delay + self._lead)
        if isinstance(course, Bracing) and course.phase is not BracePhase.PLANNING:
            return self._brace(course, now)
        calm = now - self._adapted_at < tuning.adaptation.calm_time
        share = tuning.adaptation.slew_share if calm else tuning.reference.slew_share
        reference.slew_share = np.fmin(share, self._first_motion.slew_share)
        way = None if self.forecast is None else self._way(now)
        found = replanner.update(
            now, self._offset, self._arm.pressures.command_offset, estimator.omega,
            reference.delay, self._arm.channels.available(), way, self._windows.windows,
            reference.path[: self.robot.n_pressures] if self._vibrates else None,
            self._correction.largest,
            waits=self._waits,
        )  # fmt: skip
        if isinstance(course, Bracing):
            return self._brace_planned(course, found, now)
        if self._goes_to_target:
            demands = replanner.pursuit.demands
            share = self._way_to_target.slew_share(replanner.plan, reference, demands=demands)
            reference.slew_share = np.fmin(reference.slew_share, share)
        return found

    def _brace_planned(self, course: Bracing, found: Array | None, now: float) -> Array | None:
        """Begin a brace once it is planned; until then the arm stays where it is."""
        plan = self.replanner.current
        if plan is None:
            return None if self._at_rest else self._start(now)
        if plan.approach is None:  # the plan keeps clear of the objects
            text = "no posture that leans is stiffer at this target: the arm keeps clear of objects"
            self._untold.append(Notice("brace-clear", text, Severity.INFO))
            self.replanner.pursue(self.replanner.pursuit.to(course.task.target))
            return found
        course.begin(plan.approach, self._start(now)[: self.robot.n_pressures])
        return self._brace(course, now)

    def _brace(self, course: Bracing, now: float) -> Array | None:
        """Advance a brace; see `_plan`. The tip's offset is not compensated."""
        self._reference.slew_share = self._tuning.reference.slew_share
        before = course.pressures
        is_there = not self._is_held(now) and self._is_near(before)
        course.advance(min(now - self._computed_at, _HELD * self._period), is_there)
        leans = self._arm.leaning is not None
        if course.leans is not leans and course.approach is not None:
            leaning = LeaningTip(course.approach) if course.leans else None
            self._shift(self._arm.lean_on(leaning))
        if course.phase is BracePhase.RELEASED and course.next is not None:
            self.set_task(course.next)
            return self._plan(now)
        if course.phase is BracePhase.HELD:
            self._correct_brace(course, now)
        return np.concatenate([course.pressures, self._arm.tip.offset])

    def _is_near(self, pressures: Array) -> bool:
        """Whether the reference rests at pressures (n,)."""
        off = self._reference.path[: len(pressures)] - pressures
        return are_within(self._tuning.reference.there, off) and not self._moves()

    def _moves(self) -> bool:
        """Return whether the reference is still moving."""
        rate = self._reference.motion[1, : self.robot.n_pressures]
        return not are_within(self._tuning.reference.at_rest, rate)

    def _correct_brace(self, course: Bracing, now: float) -> None:
        """Bring the braced tip to its target; without one for its position it stays."""
        tip = self._arm.modelled
        wanted, _, _ = target_arrays(course.task.target)
        if tip is None:
            return
        position = self._arm.tip.position
        error = np.nan_to_num((position if wanted is None else wanted) - position)
        elapsed = min(now - self._computed_at, _HELD * self._period)
        offset = self._arm.pressures.command_offset
        limits = self._permitted[0] + offset, self._permitted[1] + offset
        course.correct(elapsed, error, tip.pose[:3, :3] @ tip.jacobian[:3], limits)

    def _shift(self, change: Array) -> None:
        """Shift reference and feedback by a change of the offset (6,), without a jump."""
        self._reference.shift(np.concatenate([np.zeros(self.robot.n_pressures), change]))
        self._feedback.shift(change)

    def _press(self, now: float) -> None:
        """Advance a press, if there is one."""
        course, tip = self.replanner.pursuit.course, self._arm.modelled
        if not isinstance(course, Pressing) or tip is None:
            return
        R, plan = tip.pose[:3, :3], self.replanner.current
        short = np.zeros(3) if plan is None else np.array(plan.short)
        elapsed = min(now - self._computed_at, _HELD * self._period)
        if self.replanner.stiffens:
            rates = np.abs(self._reference.motion[1, : self.robot.n_pressures])
            course.change_posture(elapsed * float(np.linalg.norm(tip.jacobian[:3], axis=0) @ rates))
        arrived = self._rests(now) and not self.replanner.stiffens
        course.advance(
            elapsed, arrived, self._is_known(now), self._arm.tip.estimate.position,
            self._arm.tip.offset, self._arm.touch.felt, self._arm.touch.creep,
            R, R @ tip.compliance[:3, :3] @ R.T, short,
        )  # fmt: skip

    def _is_known(self, now: float) -> bool:
        """Whether no adaptation of the model's stiffness is pending or recent."""
        if not self._adapts:
            return True
        known, calm = self.replanner.known, self._tuning.adaptation.calm_time
        return known is not None and known.proposal is None and now - self._adapted_at > calm

    def _adapt(self, now: float) -> None:
        """Record the tip at rest, and adapt the model when it is time."""
        if now - self._watched_at < self._tuning.windows.every:
            return
        self._watched_at = now
        windows, known = self._windows, self.replanner.known
        if self._rests(now) and not self._arm.touch.felt.touches:
            windows.look(now, self._arm.pressures.effective, self._arm.tip)
        else:
            windows.begin()
        if windows.has_rested(now) and self._arm.pressures.adapt():
            self._reference.set_lag(self._arm.pressures.lag)
        if known is None or known.proposal is None or not windows.has_rested(now):
            return
        if now - self._adapted_at > self._tuning.adaptation.interval:
            self._go_on_with(known.proposal)

    def _rests(self, now: float) -> bool:
        """Whether the arm is at rest, controlled, and seen."""
        estimator, t = self._arm.tip, self._tuning.windows
        sample = estimator.sample
        if sample is None or now - sample.time > t.seen or self._is_held(now):
            return False
        if not self._goes_to_target or not self._has_arrived():
            return False
        return are_within(t.vibration, estimator.vibration[0])

    def _go_on_with(self, adapted: Adapted) -> None:
        """Change the model's numbers so that nothing moves at this time."""
        change = self._arm.change_robot(adapted.description)
        if change is not None:
            none = Adapted(self.robot.description, np.zeros_like(adapted.applied))
            earlier = [*self._earlier, self.replanner.adapted or none]
            self._earlier = earlier[:1] + earlier[1:][-self._tuning.adaptation.kept :]
            self._adopt(adapted, change)

    def _go_back(self, pressures: Array) -> bool:
        """Go back to the last model that has an equilibrium at pressures (n,), without a jump.

        Return whether there is one. Later models keep short of the one that has none.
        """
        for index in reversed(range(len(self._earlier))):
            adapted = self._earlier[index]
            change = self._arm.change_robot(adapted.description, pressures)
            if change is not None:
                del self._earlier[index:]
                self._adopt(adapted.short_of(self.replanner.adapted), change)
                if self._arm.watch.doubt is None:  # the tip of the other model ran away
                    self._arm.watch.begin()
                self._went_back_at = self._now
                return True
        return False

    def _adopt(self, adapted: Adapted, change: Array) -> None:
        """Go on with a model, whose offset of the tip differs by a change (6,)."""
        self._shift(change)
        self._adapted_at = self._model_changed_at = self._now
        self.replanner.go_on_with(adapted, change)

    def _has_arrived(self) -> bool:
        """Whether the reference rests on the plan."""
        plan = self.replanner.plan
        if plan is None or not self._is_near(plan.pressures):
            return False
        off = self._reference.goal[: len(plan.pressures)] - plan.pressures
        return are_within(self._tuning.reference.there, off)

    def _set_reference_rate(self) -> None:
        tuning, rate = self._tuning.reference, self._tuning.reference.rigid_rate
        if self._vibrates:
            rate = min(rate, tuning.vibrating_rate * self._arm.tip.omega)
        self._reference.rate = rate

    def status(self, now: float) -> ControllerStatus:
        """Return the controller's part of the state; see `Controller.status`."""
        led = self._led_to
        at = None if led is None else (led, self._reference.goal[: self.robot.n_pressures])
        return self._report.status(now, at)

    def notices(self) -> tuple[Notice, ...]:
        """Return alarms and events."""
        untold, self._untold = self._untold, []
        waits = self._waits and not self._is_held(self._now) and not self._has_arrived()
        return (*untold, *self._report.notices(self._rests_short(), waits=waits))

    def _rests_short(self) -> bool:
        """Return whether the tip is at rest although its target, out of reach, is elsewhere.

        It is at rest at the end of its plan, and while the pressures are held.
        """
        plan, pursuit = self.replanner.plan, self.replanner.pursuit
        if plan is None or plan.reached or pursuit.course is not None:
            return False
        return self._is_held(self._now) or self._has_arrived()

    def close(self) -> None:
        """End the planners."""
        self.replanner.close()
        if self.forecast is not None:
            self.forecast.close()
