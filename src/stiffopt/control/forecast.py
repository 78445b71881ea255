"""`Forecast`: checks before a request is accepted that the arm's way there is clear of the scene.

It runs in the thread of the client, and plans in a separate process, as the controller would. The
plans that the controller makes later are checked again (`Planning`), and `ClearanceWatch` checks
each command.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.adaptation import Adapted
from stiffopt.control.course import Course
from stiffopt.control.plan import Plan, PlanRequest
from stiffopt.control.planner import InlinePlanner, ProcessPlanner
from stiffopt.control.replanning import Pursuit, is_far
from stiffopt.control.request_queue import current_requester
from stiffopt.control.tuning import ForecastTuning, ReplanningTuning
from stiffopt.errors import CommandError
from stiffopt.optimise.target import Target
from stiffopt.paths.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Present:
    """The state of the controller that a forecast starts from."""

    pursuit: Pursuit
    plan: Plan | None
    way: Array  # effective pressures (2, n): on the reference's path, and at its goal
    offset: Array  # of the tip (6,), see `PlanRequest`
    pressure_offset: Array  # (n,), see `PlanRequest`
    available: tuple[Array, Array]  # lowest and highest (n,), see `PlanRequest`
    adapted: Adapted | None  # the present model
    position: Array  # of the tip (3,)
    rotation: Array  # (3, 3)
    vibrates: bool


class Forecast:
    """Refuses requests that lead the arm too near to its scene. Any thread may call it."""

    def __init__(self, planner: InlinePlanner | ProcessPlanner, tuning: ForecastTuning) -> None:
        self._planner, self._tuning = planner, tuning
        self._replanning = ReplanningTuning()
        self._lock, self._deadline = threading.Lock(), 0.0
        self._serial, self._pursued = 0, Pursuit()
        self._checked: tuple[Trajectory, Array] | None = None
        self.present: Present | None = None
        """Set by the control thread in each tick."""

    def check(self, pursuit: Pursuit) -> None:
        """Refuse a target or a trajectory of targets that is blocked, by a `CommandError`."""
        with self._lock:
            here, self._deadline = self.here(), time.monotonic() + self._tuning.patience
            if isinstance(pursuit.course, Course):
                self._check_course(pursuit, pursuit.course, here)
            else:
                self._plan(pursuit, here, here.plan, here.way, pursuit.target)

    def check_posture(self, trajectory: Trajectory, pressures: Array) -> None:
        """Refuse a trajectory of pressures (k, n) that is blocked, by a `CommandError`."""
        with self._lock:
            here, self._deadline = self.here(), time.monotonic() + self._tuning.patience
            way = np.vstack([here.way[-1:], pressures])
            request = PlanRequest(
                self._serial, None, None, here.offset.copy(), here.pressure_offset, way=way,
                adapted=here.adapted,
            )  # fmt: skip
            _refuse_blocked(self._answer(request))
            self._checked = trajectory, here.way[-1]

    def confirm(self, trajectory: Trajectory, start: Array) -> None:
        """Refuse a trajectory of pressures unless it was checked from the present start (n,)."""
        checked = self._checked
        if checked is None or checked[0] is not trajectory:
            raise CommandError("the way of this trajectory has not been checked; send it again")
        if np.abs(checked[1] - start).max() > self._tuning.moved:
            raise CommandError(
                "the arm was moving while the way of the trajectory was checked; hold it, or wait "
                "until it rests, and send the trajectory again"
            )

    def close(self) -> None:
        """End the planner."""
        self._planner.close()

    def _check_course(self, pursuit: Pursuit, course: Course, here: Present) -> None:
        """Check a trajectory of targets by successive plans for targets close to each other."""
        tuning = self._tuning
        times = np.linspace(course.begin, course.end, tuning.most)
        targets = [course.at(time) for time in times]
        plan, way = here.plan, here.way
        passed: Target | None = None
        for index, target in enumerate(targets):
            later = targets[index + 1] if index + 1 < len(targets) else None
            between = passed is not None and later is not None
            if between and not is_far(passed, later, tuning.spacing, tuning.turn):
                continue
            plan = self._plan(pursuit, here, plan, way, target)
            way, passed = plan.pressures[None], target

    def _plan(
        self, pursuit: Pursuit, here: Present, last: Plan | None, way: Array, target: Target | None
    ) -> Plan:
        """Plan for a target; refuse if the way from the last plan is blocked."""
        if pursuit.is_new_after(self._pursued):
            self._serial += 1
        self._pursued = pursuit
        fresh = last is here.plan and pursuit.is_new_after(here.pursuit)
        position, angle = self._replanning.far_position, self._replanning.far_angle
        search = pursuit.course is None and is_far(here.pursuit.target, target, position, angle)
        request = PlanRequest(
            self._serial, pursuit.task, target, here.offset.copy(), here.pressure_offset,
            search or fresh or last is None, *here.available, way=way, last=last,
            adapted=here.adapted, here=way[0] if here.vibrates else np.zeros(0),
        )  # fmt: skip
        plan = self._answer(request)
        _refuse_blocked(plan)
        return plan

    def here(self) -> Present:
        """Return the controller's present state; `CommandError` if it is not known yet."""
        if self.present is None:
            raise CommandError("the arm's position is not known yet; try again")
        return self.present

    def _answer(self, request: PlanRequest) -> Plan:
        """Wait for the planner's answer, which has the same offset object as the request."""
        requester, planner = current_requester(), self._planner
        failures = planner.failures
        planner.request(request)
        while True:
            plan = planner.latest()
            if plan is not None and plan.offset is request.offset:
                return plan
            if planner.failures > failures:
                reason = "; ".join(notice.text for notice in planner.notices())
                raise CommandError(f"the way could not be checked: {reason}")
            if requester.gone or time.monotonic() > self._deadline:
                raise CommandError(
                    f"the way could not be checked within {self._tuning.patience:g} s; the first "
                    "task of a kind takes longer, so try again"
                )
            time.sleep(self._tuning.look)


def _refuse_blocked(plan: Plan) -> None:
    if plan.blocked:
        raise CommandError(f"refused: {plan.blocked}")
