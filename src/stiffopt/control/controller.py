"""The controller: from what is asked and seen to the pressures of the next tick.

It moves in the space of pressures, where every straight way between allowed pressures is allowed,
along a smooth reference to the plan (`Reference`), and corrects at the tip: for the offset that the
estimator finds and the plan does not count with yet, and, where the arm swings, by a feedback that
damps the swing (`Gains`).  A small quadratic program (`Allocation`) brings both together within
all limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.control.allocation import Allocation
from stiffopt.control.asked import (
    angle_to,
    distance_to,
    is_far,
    parts_of,
    stiffness_of,
    within_limits,
)
from stiffopt.control.believed import memory_of, regulation_of, wrench_at
from stiffopt.control.demand import demand, parts_asked
from stiffopt.control.estimator import EstimatorSettings, TipEstimator
from stiffopt.control.gains import Gains
from stiffopt.control.nearby import NearbyTip
from stiffopt.control.planner import InlinePlanner, Planner, ProcessPlanner
from stiffopt.control.plans import Plan, Request
from stiffopt.control.reference import Reference
from stiffopt.control.regulators import RegulatorModel
from stiffopt.control.requested import preparing
from stiffopt.control.state import Severity, SteeringStatus
from stiffopt.control.steering import Move, Notice, Seen
from stiffopt.control.trajectory import Course, Trajectory
from stiffopt.control.vibration import Vibration
from stiffopt.errors import InputError
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.optimise.tip import TipAt
from stiffopt.rig.interface import PoseSample, PressureLimits, PressureReading
from stiffopt.rig.settings import ControlSettings, Safety

__all__ = ["Controller"]

Array = NDArray[np.float64]

_PLAN_EVERY = 0.05  # s
_UNHURRIED = 1.0  # s; with which the plan follows the offset
_EFFORT = 1.0  # of feedback against error; see `Gains`
_HASTE = 1.2  # rate of the reference of an arm that swings, over its frequency
_SWINGS = 3.0  # rad of the arm's swing that this takes at least
_HEED = 0.6  # rate with which a swinging arm's offset is corrected, over its frequency
_BRISK = 100.0  # 1/s; rate of the reference of an arm that does not swing
_BELIEVED = 0.5  # of the arm's length; an offset beyond is no model error any more
_OFF = 3e3  # Pa; by which the command makes up for a regulator that is off
_ALIKE = 3e3  # Pa; along the path only the model's derivatives are of interest
_SHORT = 2e-4  # m; what a limit may take from the tip without being mentioned


class Controller:
    """Steers an arm; see `Steering`.

    Parameters
    ----------
    robot :
        What the arm is believed to be.
    limits :
        What may be commanded.
    slew :
        Greatest rate of change (n,), in Pa/s.
    period :
        Of the loop, in s.
    control, safety :
        Settings of the rig.
    swings :
        Whether the arm vibrates as its robot file says, where the settings leave that open.
    beside :
        Whether plans are made in a process of their own; otherwise at once, for simulated time.
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
        swings: bool = True,
        beside: bool = False,
    ) -> None:
        self.robot, self.limits = robot, limits
        self._control, self._safety = control or ControlSettings(), safety or Safety()
        self._period = period
        n = robot.n_pressures
        self._slew = np.broadcast_to(np.asarray(slew, dtype=float), n).copy()
        kind = self._control.vibration
        self._swings = swings if kind == "auto" else kind == "modelled"
        self._farthest = _BELIEVED * robot.length
        self._vibration = Vibration.of(robot.description) if self._swings else None
        lag, dead_time = regulation_of(robot.description, self._control)
        self._lag, self._dead_time = float(np.mean(lag)), dead_time
        self._regulators = RegulatorModel(period, lag, dead_time, self._slew)
        self._damping = self._control.damping
        self._estimator = TipEstimator(
            period,
            n,
            self._vibration,
            EstimatorSettings(
                noise=self._control.tracker_noise,
                max_speed=self._safety.max_tip_speed,
                damping=self._damping,
            ),
        )
        self._gains = Gains(period, self._lag, self._damping, _EFFORT) if self._vibration else None
        self._reference = Reference(period, self._slew, self._lag, self._damping, beside=6)
        self._allocation = Allocation(
            demand(n, self._vibration, self._damping, dead_time),
            limits.low,
            limits.high,
            self._slew * period,
            self._safety.max_tip_speed * period,
            self._control.solver,
        )
        self._planner: Planner = ProcessPlanner(robot) if beside else InlinePlanner(robot)
        self._here: NearbyTip | None = None  # the model where the arm is, and along the path
        self._there: NearbyTip | None = None
        self._serial = 0
        self.begin(0.0)

    # -- Steering -------------------------------------------------------------------------------

    def check(self) -> None:
        """Compile and try the model; see `Steering.check`."""
        if self._here is not None:
            return
        here, there = NearbyTip(self.robot), NearbyTip(self.robot, _ALIKE)
        if not here.is_fast and self.robot.is_loaded:
            raise InputError(
                "the control loop needs a C compiler for an arm under gravity or a load; "
                "install one (Debian: apt install gcc) or set STIFFOPT_COMPILER"
            )
        self._here, self._there = here, there
        self.begin(self._now)

    def begin(self, now: float) -> None:
        """Start anew with a vented arm and no task."""
        none = self._none()
        self._serial += 1
        self._task: Task | None = None
        self._target: Target | None = None
        self._asked = np.zeros(5)  # what of a pose
        self._course: Course | None = None
        self._plan: Plan | None = None
        self._measure: Callable[..., float] | None = None
        self._unit = "N/m"
        self._asked_at = -math.inf
        self._search = True
        self._planned_offset, self._heeded = np.zeros(6), np.zeros(6)
        self._now = now
        self._last_move = none.copy()
        self._effective, self._chamber = none.copy(), none.copy()
        self._memory = memory_of(self.robot.description)
        self._regulators.begin(none)
        self._estimator.begin()
        self._reference.begin(np.concatenate([none, np.zeros(6)]))
        self._saturated = np.zeros(len(none), dtype=bool)
        self._allocation.limit(self.limits.low, self.limits.high)
        self._at_u: TipAt | None = None
        if self._here is not None:
            self._at_u = self._here.at(none)
            self._estimator.advance(now, none, self._at_u)
        self._fresh = True

    def set_task(self, task: Task) -> None:
        """Pursue a task; see `Steering.set_task`."""
        with preparing("task"):
            pursue = self._prepared_task(task)
        pursue()

    def _prepared_task(self, task: Task) -> Callable[[], None]:
        """Return what pursues a task from its call on; until then nothing changes."""
        limited = within_limits(task, self.robot, self.limits)
        lower, upper = limited.pressure_bounds(self.robot.description)
        asked, measure = parts_asked(task.target), stiffness_of(task)
        unit = task.measures[0].unit if task.measures else "N/m"

        def pursue() -> None:
            self._task, self._target, self._course = limited, task.target, None
            self._asked, self._measure, self._unit = asked, measure, unit
            self._allocation.limit(lower, upper)
            self._anew()

        return pursue

    def set_target(self, target: Target) -> None:
        """Go to another target; see `Steering.set_target`."""
        with preparing("target"):
            pursue = self._prepared_target(target)
        pursue()
        self._course = None

    def follow(self, trajectory: Trajectory, now: float) -> None:
        """Follow a trajectory; see `Steering.follow`."""
        with preparing("trajectory"):
            estimate = self._estimator.estimate
            course = Course(trajectory, now, estimate.position, estimate.rotation)
            pursue = self._prepared_target(course.at(now))
        pursue()
        self._course = course

    def resume(self, now: float) -> None:
        """Steer again from where the pressures are."""
        offset = self._estimator.beside
        self._heeded = offset
        self._reference.begin(np.concatenate([self._last_move + self._remembered, offset]))
        self._fresh = False

    def observe(
        self,
        now: float,
        commanded: Array,
        reading: PressureReading,
        samples: Sequence[PoseSample],
    ) -> Seen:
        """Follow pressures and tip; see `Steering.observe`."""
        steps = min(max(1, round((now - self._now) / self._period)), 50)
        self._now = now
        for _ in range(steps):
            self._chamber = self._regulators.advance(commanded, reading.pressures)
        self._last_move = commanded.copy()
        if self._memory is None:
            self._effective = self._chamber
        else:
            self._effective = self._memory.advance(steps * self._period, self._chamber)
        here, _ = self._models()
        self._at_u = here.at(self._effective)
        for step in range(steps):
            moment = now - (steps - 1 - step) * self._period
            self._estimator.advance(moment, self._effective, self._at_u)
        return self._estimator.take(samples)

    def move(self, now: float) -> Move:
        """Decide; see `Steering.move`."""
        self._ask(now)
        aim = self._aim()
        if aim is None:  # nothing to do, or not planned yet
            self._fresh = True
            return Move(self._last_move.copy(), True, np.zeros(len(self._last_move), dtype=bool))
        if self._fresh:
            self.resume(now)
        if self._implausible():
            return Move(self._last_move.copy(), False, self._saturated.copy())
        reference, omega, n = self._reference, self._estimator.omega, len(self._last_move)
        reference.rate = min(_BRISK, _HASTE * omega) if self._swings else _BRISK
        reference.omega = omega
        reference.advance(aim)
        at = self._models()[1].at(reference.path[:n])
        self._heed(omega)
        correction = reference.path[n:] - self._heeded
        pressures, held, missing = self._allocation.solve(
            (at.pose, at.jacobian, self._asked, correction, *self._swing()),
            reference.command - self._beside,
            self._last_move,
        )
        if pressures is None:
            return Move(self._last_move.copy(), False, self._saturated.copy())
        self._saturated = held if missing > _SHORT else np.zeros(n, dtype=bool)
        return Move(pressures, True, self._saturated.copy())

    def standing(self, now: float) -> SteeringStatus:
        """Return what it knows of the state; see `Steering.standing`."""
        n = self.robot.n_pressures
        if self._at_u is None:
            return SteeringStatus(plan=np.full(n, np.nan))
        estimate = self._estimator.estimate
        target = self._course.at(now) if self._course is not None else self._target
        position, pointing, quaternion = parts_of(target)
        sample, plan = self._estimator.sample, self._plan
        stiffness = math.nan
        if self._measure is not None:
            stiffness = float(self._measure(self._at_u.compliance, self._at_u.pose[:3, :3]))
        return SteeringStatus(
            plan=np.full(n, np.nan) if plan is None else plan.pressures - self._remembered,
            tip_position=estimate.position,
            tip_quaternion=estimate.quaternion,
            seen_position=np.full(3, np.nan) if sample is None else sample.position,
            seen_age=math.inf if sample is None else now - sample.time,
            target_position=position,
            target_quaternion=quaternion,
            target_pointing=pointing,
            position_error=distance_to(estimate.position, position),
            angle_error=angle_to(estimate.rotation, pointing, quaternion),
            stiffness=stiffness,
            best_stiffness=math.nan if plan is None else plan.stiffness,
            disturbance=estimate.offset,
            wrench=wrench_at(
                self._at_u, estimate.offset, estimate.turn if self._estimator.turn_known else None
            ),
            task=self._what(),
            stiffness_unit=self._unit,
            model_position=estimate.static,
        )

    def notices(self) -> tuple[Notice, ...]:
        """Say what is wrong."""
        found = list(self._planner.notices())
        plan = self._plan
        if plan is not None and plan.serial == self._serial and not plan.reached:
            text = f"the target cannot be reached: {plan.message}"
            found.append(Notice("unreachable", text, standing=True))
        if self._implausible():
            away = 1e3 * float(np.linalg.norm(self._estimator.beside[:3]))
            text = (
                f"the tip is seen {away:.0f} mm from where the model has it; check the tracker's "
                "registration and sensor, the tubes, and that the robot file is this arm's"
            )
            found.append(Notice("implausible", text, Severity.ERROR, standing=True))
        return tuple(found)

    def _implausible(self) -> bool:
        """Whether the arm is so far from its model that it is rather something else."""
        offset = self._estimator.beside[:3]
        return float(offset @ offset) > self._farthest**2

    def close(self) -> None:
        """End the planner."""
        self._planner.close()

    # -- what is asked --------------------------------------------------------------------------

    def _prepared_target(self, target: Target) -> Callable[[], None]:
        """Return what goes to a target from its call on; until then nothing changes."""
        if self._task is None:
            return self._prepared_task(Task(robot=self.robot.description.name, target=target))
        asked = parts_asked(target)
        anew = self._target is None or bool((asked != self._asked).any())
        far = self._target is not None and is_far(self._target, target)

        def pursue() -> None:
            if anew:
                self._anew()
            self._search = self._search or far
            self._target, self._asked = target, asked
            self._asked_at = -math.inf

        return pursue

    def _anew(self) -> None:
        self._serial += 1
        self._search = True
        self._asked_at = -math.inf

    def _ask(self, now: float) -> None:
        """Ask for a plan now and then, for where the target will be when the path is there."""
        if self._task is None or self._target is None:
            return
        if now - self._asked_at < _PLAN_EVERY - 1e-6:
            return
        anew = self._search and self._course is None
        self._asked_at, self._search = now, False
        target = self._target
        if self._course is not None:
            target = self._course.at(
                now + self._reference.delay + self._dead_time + 0.5 * self._period
            )
        offset = self._estimator.beside
        # The offset depends on the posture too; the posture follows it slowly, the tip at once.
        slowness = max(_UNHURRIED, _SWINGS / self._estimator.omega)
        share = 1.0 if anew else -math.expm1(-_PLAN_EVERY / slowness)
        self._planned_offset = self._planned_offset + share * (offset - self._planned_offset)
        self._planner.ask(
            Request(
                self._serial, self._task, target, self._planned_offset.copy(), self._beside,
                anew,
            )
        )  # fmt: skip

    def _aim(self) -> Array | None:
        """Effective pressures of the plan and the offset that it counts with (n + 6,)."""
        plan = self._planner.latest()
        if plan is not None and plan.serial == self._serial:
            self._plan = plan
        if self._plan is None:
            return None
        return np.concatenate([self._plan.pressures, self._plan.offset])

    def _what(self) -> str:
        if self._course is not None:
            return "trajectory"
        return "" if self._target is None else "target"

    # -- the model ------------------------------------------------------------------------------

    def _none(self) -> Array:
        return np.zeros(self.robot.n_pressures)

    @property
    def _remembered(self) -> Array:
        """By how much the pressures that act differ from those in the chambers (n,)."""
        result: Array = self._effective - self._chamber
        return result

    @property
    def _beside(self) -> Array:
        """By how much the pressures that act will differ from those that are commanded (n,).

        That is what the chambers get beside the command, and the arm beside the chambers.
        """
        off = np.minimum(np.maximum(self._regulators.offset, -_OFF), _OFF)
        result: Array = self._remembered + off
        return result

    def _models(self) -> tuple[NearbyTip, NearbyTip]:
        """The model where the arm is, and along the path."""
        if self._here is None or self._there is None:
            self.check()
            return self._models()
        return self._here, self._there

    def _heed(self, omega: float) -> None:
        """Let the offset that is corrected follow the one that is found.

        For an arm that swings not at once: part of each swing is taken for an offset, and what the
        model has no words for (higher modes) all of it.
        """
        found = self._estimator.beside
        share = 1.0 if not math.isfinite(omega) else -math.expm1(-_HEED * omega * self._period)
        self._heeded = self._heeded + share * (found - self._heeded)

    def _swing(self) -> tuple[ArrayLike, ...]:
        """What `demand` wants to know of an arm that swings."""
        if self._gains is None:
            return ()
        estimator, motion = self._estimator, self._reference.motion
        n = len(self._last_move)
        return (
            estimator.swing, estimator.across_matrix, estimator.omega,
            self._gains.at(estimator.omega), self._regulators.ahead + self._remembered,
            self._reference.chamber, motion[0, :n], motion[1, :n],
        )  # fmt: skip
