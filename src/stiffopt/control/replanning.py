"""The controller's pursuit (task, target or trajectory), and when to request a plan for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.adaptation import Adapted, Estimate, Window
from stiffopt.control.bracing import Bracing
from stiffopt.control.course import Course
from stiffopt.control.feedback import prescribed_components
from stiffopt.control.interface import Notice
from stiffopt.control.missing_motion import MissingMotion
from stiffopt.control.plan import Plan, PlanRequest
from stiffopt.control.planner import InlinePlanner, ProcessPlanner
from stiffopt.control.planning import nearest_words
from stiffopt.control.posture import PostureCourse
from stiffopt.control.pressing import Phase, Pressing
from stiffopt.control.tip_errors import stiffness_function, target_arrays
from stiffopt.control.tuning import ReplanningTuning
from stiffopt.control.vibration import BentMode
from stiffopt.errors import InputError
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.optimise.tip import TipAt
from stiffopt.paths.trajectory import Trajectory, Waypoint

AnyCourse = Course | PostureCourse | Pressing | Bracing

_TOO_SOFT = (
    "the arm is softer than can be modelled: with the numbers that fit its tip at rest, the "
    "model has no equilibrium where the arm goes; earlier numbers are used, and the stiffness "
    "may be less than reported. Run 'stiffopt calibrate', or correct moduli, gains and tip mass in "
    "the robot file"
)


@dataclass(frozen=True, eq=False)
class Pursuit:
    """What the controller pursues."""

    task: Task | None = None  # within the limits of the rig; None: nothing is pursued
    target: Target | None = None  # replaces the task's own
    # a motion under way, whose target replaces `target`
    course: AnyCourse | None = None
    prescribed: Array = field(default_factory=lambda: np.zeros(5))  # see `prescribed_components`
    stiffness: Callable[[Array, Array], float] | None = None  # in the task's first direction
    unit: str = "N/m"  # of that stiffness

    @classmethod
    def of(cls, task: Task, limited: Task, course: AnyCourse | None = None) -> Pursuit:
        """Return the pursuit of a task; `limited` is the task within the limits of the rig."""
        prescribed = prescribed_components(task.target)
        unit = task.measures[0].unit if task.measures else "N/m"
        return cls(limited, task.target, course, prescribed, stiffness_function(task), unit)

    def to(self, target: Target, course: AnyCourse | None = None) -> Pursuit:
        """Return the pursuit of another target, or of a course that begins there."""
        prescribed = prescribed_components(target)
        return replace(self, target=target, course=course, prescribed=prescribed)

    def target_at(self, now: float) -> Target | None:
        """Return the target at a time, in s."""
        return self.target if self.course is None else self.course.at(now)

    @property
    def demands(self) -> bool:
        """Whether the task demands a stiffness, by its key `at_least` or `match`."""
        goal = None if self.task is None else self.task.stiffness
        return goal is not None and bool(goal.at_least or goal.match)

    def is_new_after(self, before: Pursuit) -> bool:
        """Whether planning starts from scratch, not from the last plan."""
        if self.task is not before.task or before.target is None:
            return True
        if bool((self.prescribed != before.prescribed).any()):
            return True
        return isinstance(self.course, PostureCourse) or isinstance(before.course, PostureCourse)

    @property
    def kind(self) -> str:
        """``press``, ``brace``, ``trajectory``, ``target``, or empty."""
        if isinstance(self.course, Bracing):
            return "brace"
        if isinstance(self.course, Pressing):
            return "press"
        if self.course is not None:
            return "trajectory"
        return "" if self.target is None else "target"


class Replanner:
    """Requests plans for the pursuit at intervals, and keeps the newest.

    `period` of the loop and `dead_time` of the regulators are in s.
    """

    def __init__(
        self,
        planner: InlinePlanner | ProcessPlanner,
        tuning: ReplanningTuning,
        period: float,
        dead_time: float,
    ) -> None:
        self._planner, self._tuning = planner, tuning
        self._missing = MissingMotion(tuning.missing)
        self.known: Estimate | None = None  # of the model's numbers
        self.adapted: Adapted | None = None  # the model that plans use; None: the robot file's
        self._newest: Plan | None = None  # the last that `latest` took
        self._goal_of: Plan | None = None  # the last of which it returned pressures and offset
        self._goal: Array = np.zeros(0)
        self._lead = dead_time + 0.5 * period
        self._serial, self._search = 0, True
        self.begin()

    def begin(self) -> None:
        """Start anew, with nothing to pursue."""
        self.pursuit = Pursuit()
        self.plan: Plan | None = None  # the newest, possibly of the task before
        self._detour: Course | None = None  # the tip's way to its target after a loss of channels
        self._detour_from: Plan | None = None  # where it begins, until that is planned from
        self._offset = np.zeros(6)
        self._forget_missing()
        self._updated_at = -math.inf  # time of the last update, in s
        self.deviation = math.nan  # of the plan's stiffness, relative
        self._available: tuple[Array, Array] | None = None  # see `update`
        self.bent: BentMode | None = None  # modes of the arm where the reference was last
        self._renew()

    def pursue(self, pursuit: Pursuit) -> None:
        """Change the pursuit; an error changes nothing."""
        before = self.pursuit
        far_position, far_angle = self._tuning.far_position, self._tuning.far_angle
        new = pursuit.is_new_after(before)
        far = is_far(before.target, pursuit.target, far_position, far_angle)
        self.pursuit, self._detour = pursuit, None
        if new:
            self._renew()
        if isinstance(pursuit.course, PostureCourse):
            self.plan = None  # it belongs to another posture than the trajectory's
        self._search = self._search or far
        self._requested_at = -math.inf
        left = is_far(self._lacking_at, pursuit.target, far_position, far_angle)
        if self._search or left or pursuit.course is not None:
            self._forget_missing()

    def _forget_missing(self) -> None:
        """Let all channels go as far as others permit."""
        self._missing.begin()
        self._lacking_at = self.pursuit.target  # where motion of a channel may be missing

    def look(self, time: float, offset: Array, pressures: Array, tip: TipAt) -> None:
        """Look whether the tip lacks the motion of a channel as the arm becomes stiff.

        Parameters
        ----------
        time : of capture of a sample, in s.
        offset : of the tip (6,) from the model's.
        pressures : effective ones (n,) at that time, in Pa.
        tip : the model's tip now.
        """
        if self.stiffens and self.pursuit.course is None:
            jacobian = tip.pose[:3, :3] @ tip.jacobian[:3]
            self._missing.take(time, offset[:3], pressures, jacobian)
        else:
            self._missing.pause()

    def limited(self, limits: tuple[Array, Array], offset: Array) -> tuple[Array, Array]:
        """Return the lowest and highest commands (n,), within others, that may be used.

        They are those of plans, see `MissingMotion.limited`. `offset`: effective pressures relative
        to commands (n,), in Pa.
        """
        if not self._missing.channels:
            return limits
        low, high = self._missing.limited(limits[0] + offset, limits[1] + offset)
        return low - offset, high - offset

    def go_straight(
        self, now: float, position: Array, rotation: Array, pressures: Array, offset: Array
    ) -> None:
        """Lead the tip straight to its target, in small steps from where it is.

        Without the channels that are lost, pressures for the target may be far from the present
        ones; the straight line to them could bend widely at the tip. Trajectories and presses have
        a way of their own.

        Parameters
        ----------
        now : time, in s.
        position, rotation : of the tip now, (3,) and (3, 3).
        pressures, offset : effective pressures (n,), in Pa, and the tip's offset (6,) now.
        """
        target, here = self.pursuit.target, target_arrays(self.pursuit.target)[0]
        if self.pursuit.course is not None or target is None:
            return
        way = 0.0 if here is None else float(np.linalg.norm(np.nan_to_num(here - position)))
        end = Waypoint(time=max(way / self._tuning.detour_speed, 0.5), target=target)
        try:
            self._detour = Course(Trajectory(waypoints=(end,)), now, position, rotation)
        except InputError:  # it has to turn by half a turn
            return
        self._detour_from = Plan(
            self._serial, pressures, offset, self._detour.at(now), True, math.nan, "",
            adapted=self.adapted,
        )  # fmt: skip
        self._offset, self._requested_at = offset.copy(), -math.inf

    def _renew(self) -> None:
        self._serial += 1
        self._search, self._blocked = True, ""
        self._requested_at = -math.inf

    def update(
        self,
        now: float,
        offset: Array,
        pressure_offset: Array,
        omega: float,
        delay: float,
        available: tuple[Array, Array],
        way: Array | None = None,
        windows: tuple[Window, ...] = (),
        here: Array | None = None,
        most: float = math.inf,
        *,
        waits: bool = False,
    ) -> Array | None:
        """Request a plan when it is time; return the newest.

        Returns effective pressures and offset of the plan (n + 6,); None without a plan.

        Parameters
        ----------
        now : time, in s.
        offset, pressure_offset : see `PlanRequest`.
        omega : angular frequency of the vibration, in rad/s.
        delay : delay of the reference behind the plan, in s.
        available : lowest and highest pressures (n,) that the channels can have, in Pa. A change of
            more than a little starts a search of all configurations.
        way : see `PlanRequest`; None without a scene.
        windows, here : see `PlanRequest`; `here` is None for an arm that does not vibrate.
        most : largest change of the tip's position, in m, that plans begin to follow at once.
        waits : whether the reference waits; then plans that make the arm stiff do not go on.
        """
        task, target = self.pursuit.task, self.pursuit.target
        interval = self._tuning.interval
        self._missing.go_back(min(now - self._updated_at, interval))
        self._updated_at = now
        is_due = now - self._requested_at >= interval - 1e-6
        if waits and self.stiffens and not self._search:
            is_due = False
        if task is not None and target is not None and is_due:
            self._note_available(available)
            detour, course = self._detour, self.pursuit.course
            search = self._search and course is None and detour is None
            self._requested_at, self._search = now, False
            later = now + delay + self._lead
            if detour is not None and later < detour.end:
                target = detour.at(later)
            if isinstance(course, Course):  # the target when the reference will be there
                target = course.at(later, delay)
            elif course is not None:
                target = course.at(later)
            # The offset depends on the posture. Plans follow it slowly, feedback at once.
            time = max(self._tuning.offset_time, self._tuning.offset_periods / omega)
            share = 1.0 if search else -math.expm1(-interval / time)
            ahead = offset - self._offset
            bound = min(1.0, most / max(float(np.linalg.norm(ahead[:3])), 1e-9))
            self._offset = self._offset + share * bound * ahead
            stay = isinstance(course, Pressing) and course.phase is not Phase.GOING
            request = PlanRequest(
                self._serial, task, target, self._offset.copy(), pressure_offset, search,
                *self._missing.limited(*available), windows=windows, adapted=self.adapted,
                stay=stay, last=self._detour_from,
                step=math.inf if detour is None else self._tuning.detour_step,
                here=np.zeros(0) if here is None else here,
            )  # fmt: skip
            self._detour_from = None
            self._planner.request(request if way is None else replace(request, way=way))
        return self.latest()

    @property
    def current(self) -> Plan | None:
        """The newest plan, unless it is of the task before."""
        return self.plan if self.plan is not None and self.plan.serial == self._serial else None

    @property
    def stiffens(self) -> bool:
        """Whether plans still make the arm stiffer; the tip has gone to its target before."""
        return self.plan is not None and bool(self.plan.tip_first) and not self._blocked

    def go_on_with(self, adapted: Adapted, change: Array) -> None:
        """Plan with an adapted model, whose offset differs by a change (6,)."""
        self.adapted = adapted
        self._missing.pause()
        if self.known is not None:
            limited = adapted.limits is not None
            self.known = replace(self.known, proposal=None, is_limited=limited)
        self._offset = self._offset + change
        if self.plan is not None:
            self.plan = replace(self.plan, offset=self.plan.offset + change, adapted=adapted)
        self._requested_at = -math.inf

    def _note_available(self, available: tuple[Array, Array]) -> None:
        """Have all configurations searched after a change of the available pressures."""
        before = self._available
        if before is None:
            self._available = available
        elif before[0] is not available[0] or before[1] is not available[1]:
            change = np.abs(np.stack(available) - np.stack(before))
            if (change > self._tuning.other_pressure).any():
                self._available, self._search = available, True

    def latest(self) -> Array | None:
        """Take the newest plan, unless its way is blocked; return as `update` does."""
        plan = self._planner.latest()
        if plan is not None and plan.serial == self._serial and plan is not self._newest:
            if self._detour is not None and self._newest is not None:
                self._end_detour(plan, self._newest)
            self._newest, self.deviation = plan, plan.deviation
            self.known = plan.estimate or self.known
            self.bent = plan.bent or self.bent
            self._blocked = plan.blocked
            if not plan.blocked and plan.adapted is self.adapted:
                self.plan = plan
        plan = self.plan
        if plan is not None and plan is not self._goal_of:
            self._goal_of, self._goal = plan, np.concatenate([plan.pressures, plan.offset])
        return None if plan is None else self._goal

    def _end_detour(self, plan: Plan, before: Plan) -> None:
        """End a detour whose last plans rest at its end; search further if that is short of it."""
        assert self._detour is not None
        is_last = plan.target == before.target == self.pursuit.target
        moved = float(np.abs(plan.pressures - before.pressures).max())
        if is_last and moved < self._tuning.detour_rest:
            self._detour, self._search = None, not plan.reached

    def notices(self, away: tuple[float, float] | None = None) -> tuple[Notice, ...]:
        """Return what is wrong with the planner and its plan.

        `away` is the measured distance of the tip from its target, in m, and the angle, in rad, for
        a tip at rest on its plan, or off it under held pressures; None: use the plan's own.
        """
        notices, plan = self._planner.notices(), self.plan
        is_final = plan is not None and plan.serial == self._serial and self._detour is None
        if plan is not None and is_final and not plan.reached:
            message, task = f"{plan.message} by the model; the tip is on its way", self.pursuit.task
            if away is not None and task is not None:
                message = nearest_words(*away, task.target.tolerance, "the tip")
            text = "the target cannot be reached"
            if not plan.far and self.pursuit.demands:
                text += " with the stiffness that is asked for"
                message = message if away else "the tip goes there without it"
            elif not plan.far:
                text = "no optimum is found for the target, only pressures that lead near it"
            text = f"{text}: {message}"
            notices = (*notices, Notice("unreachable", text, standing=True))
        if plan is not None and is_final and plan.reached and plan.far:
            text = f"the arm goes to other pressures for its target; until then {plan.message}"
            notices = (*notices, Notice("changes-posture", text, standing=True))
        if self._missing.channels:
            each = ", ".join(str(channel + 1) for channel in self._missing.channels)
            text = (
                f"the tip does not move as the pressure of channel {each} should move it: its "
                "chamber does not get the pressure that the gauge reads, or something pushes the "
                "arm; look at its tube. Until there is another target, the other channels make up "
                "for it"
            )
            notices = (*notices, Notice("missing-motion", text, standing=True))
        limited = self.adapted is not None and self.adapted.limits is not None
        if limited and (self.known is None or self.known.is_limited):
            notices = (*notices, Notice("too-soft", _TOO_SOFT, standing=True))
        if plan is not None and plan.doubt:
            notices = (*notices, Notice("extrapolating", plan.doubt, standing=True))
        if self._blocked:
            text = f"the arm does not go on: {self._blocked}"
            notices = (*notices, Notice("blocked", text, standing=True))
        return notices

    def close(self) -> None:
        """End the planner."""
        self._planner.close()


def is_far(before: Target | None, target: Target | None, position: float, angle: float) -> bool:
    """Whether two targets are farther apart than a distance, in m, or an angle, in rad."""
    (here, *directions), (there, *others) = target_arrays(before), target_arrays(target)
    if here is not None and there is not None:
        distance = float(np.linalg.norm(np.nan_to_num(there - here)))
        if distance > position:
            return True
    cosine = math.cos(angle)
    return any(
        abs(float(a @ b)) < cosine
        for a, b in zip(directions, others, strict=True)
        if a is not None and b is not None
    )
