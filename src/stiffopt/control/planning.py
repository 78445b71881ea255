"""Planning: the stiffest pressures for a target, given the tip's offset from the model.

The target is moved back by the tip's offset; the model has to reach the result. The optimiser then
finds the pressures that are stiffest on the real arm, except for errors of the modelled stiffness.
An arm that vibrates first goes to a new target by the least motion of each channel, and from there
slowly to the stiffest pressures; where a task demands a stiffness, it first goes as far as that
needs. A plan is the local optimum next to the last plan. When the offset has changed much and the
arm is at rest, all configurations are searched again; the arm changes to another one only if that
is clearly better. For a target that is out of reach, the plan is the nearest configuration.

While the tip presses on something, plans follow the target by the least change of pressures
instead: the error of the model, from which a force must be told, is another one elsewhere, and an
optimum may jump when a channel reaches a limit.

On a rig with a scene, a plan also reports whether the body keeps clear of it on the way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.adaptation import Adapted, Learning
from stiffopt.control.demands import Demands
from stiffopt.control.nearest_search import NearestSearch
from stiffopt.control.plan import Plan, PlanRequest
from stiffopt.control.posture_change import PostureChanges
from stiffopt.control.tip_errors import stiffness_function
from stiffopt.control.tuning import AdaptationTuning, FeedbackTuning, NearestTuning, PlanningTuning
from stiffopt.control.vibration import BentMode
from stiffopt.control.ways import Ways
from stiffopt.errors import InputError, StiffoptError
from stiffopt.model.arguments import checked_measure
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.solver import PressureSolver
from stiffopt.optimise.target import Target, Tolerance
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.optimise.tip import TipAt, TipModel
from stiffopt.paths.configurations import Unsolved
from stiffopt.paths.leaning import approach_to

_SLACK = 100.0  # Pa, by which an answer may exceed its limits
_EXACT = Tolerance(position=PlanningTuning.position_tolerance, angle=PlanningTuning.angle_tolerance)


class Planning:
    """Makes plans for an arm, each starting from the last one."""

    def __init__(self, robot: Manipulator, scene: Scene | None = None) -> None:
        self._tuning, self._scene = PlanningTuning(), scene
        self._original = robot
        self._adapted: Adapted | None = None
        self._learning = Learning(robot.description, AdaptationTuning())
        self._put(robot)
        self._serial, self._is_compiled = -1, False
        self._last: Plan | None = None
        self._searched_at: Array = np.zeros(6)
        self._advantage, self._refused = self._tuning.advantage, 0
        # to another configuration, or after the tip is at its target
        self._changes = PostureChanges(self._tip, self._search, self._tuning)
        self._leaning: tuple[int, Plan | None] = (-1, None)

    def _put(self, robot: Manipulator) -> None:
        """Use this model from now on."""
        self._robot, self._tip = robot, TipModel(robot)
        self._bent_at = np.full(robot.n_pressures, np.inf)  # of the last modes, in Pa
        self._ways = None if self._scene is None else Ways(robot, self._scene)
        self._search = NearestSearch(self._tip, FeedbackTuning().lever, NearestTuning())
        self._solver: PressureSolver | None = None
        self._demands = Demands(None, self._tuning.demand_margin)
        self._stiffness: Callable[[Array, Array], float] | None = None  # in the task's direction

    def _go_on_with(self, request: PlanRequest) -> None:
        """Use the model of a request, and carry the last plan over to it."""
        if request.adapted is self._adapted:
            return
        self._adapted = adapted = request.adapted
        self._put(self._original if adapted is None else Manipulator(adapted.description))
        self._changes.use(self._tip, self._search)
        if self._last is not None:
            self._searched_at = self._searched_at + request.offset - self._last.offset
            self._last = replace(self._last, offset=request.offset)

    def _deviation(self, plan: Plan, task: Task) -> float:
        """Return the relative deviation of a plan's stiffness; NaN if unknown."""
        measure = task.measures[0] if task.measures else None
        if not isinstance(measure, StiffnessMeasure):
            return math.nan
        checked = checked_measure(measure.direction, measure.kind, measure.boundary, measure.frame)
        return self._learning.deviation(plan.pressures, checked)

    def ask_for_code(self) -> None:
        """Compile code for the last task if that was not done while the arm was armed."""
        if self._solver is not None and not self._is_compiled:
            self._is_compiled = self._solver.is_compiled

    def plan(self, request: PlanRequest) -> Plan:
        """Return the plan for a request; `StiffoptError` if the optimiser cannot run."""
        self._go_on_with(request)
        if request.task is None or request.target is None:
            return self._checked(request)
        plan = self._planned(request, request.task, request.target)
        estimate = self._learning.estimate(request.windows, request.adapted)
        deviation = self._deviation(plan, request.task)
        plan = replace(plan, deviation=deviation, estimate=estimate)
        plan = replace(plan, doubt=self._robot.description.extrapolation(plan.pressures))
        if request.here.size:
            plan = replace(plan, bent=self._bent(request.here))
        if plan.approach or plan.blocked:
            return plan
        return replace(plan, blocked=self._blocked(request, plan.pressures))

    def _bent(self, here: Array) -> BentMode | None:
        """Return the modes at pressures (n,); None where they are those of the last call."""
        description = self._robot.description
        pressures = np.clip(here, description.pressure_min, description.pressure_max)
        if float(np.abs(pressures - self._bent_at).max()) < self._tuning.bent_step:
            return None
        self._bent_at = pressures
        try:
            return BentMode.of(self._robot, pressures)
        except (StiffoptError, np.linalg.LinAlgError):  # no equilibrium: the last ones stay
            return None

    def _checked(self, request: PlanRequest) -> Plan:
        """Check a request's way through waypoints; the result holds no new plan."""
        if self._ways is None:
            raise InputError("a request without a task, and no scene to check its way")
        blocked = self._ways.blocked(request.way, waypoints=True)
        pressures = request.way[-1]
        return Plan(request.serial, pressures, request.offset, None, True, math.nan, "", blocked)

    def _planned(self, request: PlanRequest, task: Task, asked: Target) -> Plan:
        if task.brace is not None:
            if self._leaning[0] != request.serial:
                self._leaning = request.serial, self._braced(request, task, asked)
            if self._leaning[1] is not None:
                return self._leaning[1]
            task = task.unbraced
        if request.serial != self._serial:
            self._serial, self._last, self._solver = request.serial, None, None
            self._bent_at = np.full(self._robot.n_pressures, np.inf)
            self._changes.end()
        if self._solver is None or self._last is None:
            exact = asked.model_copy(update={"tolerance": _EXACT})
            self._solver = PressureSolver(self._robot, task.model_copy(update={"target": exact}))
            self._is_compiled = self._solver.compile()
            self._stiffness = stiffness_function(task)
            self._demands = Demands(task, self._tuning.demand_margin)
        self._limits = self._effective_limits(request)
        last, refused = request.last or self._last, self._refused
        self._last = last
        if request.search or request.stay or request.last or request.step < math.inf:
            self._changes.end()
        if last is not None:
            self._changes.note(request, last)
        target = model_target(asked, request.offset + self._changes.lead)
        if last is not None and request.step < math.inf:
            bounds = last.pressures - request.step, last.pressures + request.step
            self._limits = np.clip(bounds[0], *self._limits), np.clip(bounds[1], *self._limits)
        if last is None or request.search:
            self._searched_at = request.offset
            self._advantage, self._refused = self._tuning.advantage, 0
            solution = self._solve(target, None)
        elif request.stay:
            self._last = self._nearest(request, task, target, distant=False)
            return self._last
        elif self._changes.to is not None:
            solution = self._solve(target, self._changes.to)
        else:
            solution = self._next_to(last, target)
            solution = self._better(request, target, solution, last) if solution else None
        if solution is not None and solution.pressures is not None:
            pressures = np.array(solution.pressures, dtype=float)
            stiffness = math.nan if solution.stiffness is None else float(solution.stiffness)
            if last is None or request.search:
                pressures = self._tip_first(request, target, pressures, stiffness)
            else:
                if self._changes.to is None and self._is_distant(last, pressures, target):
                    self._changes.begin(pressures)
                if self._changes.to is not None:
                    pressures = self._on_the_way(request, last, pressures, target)
            message = ""
            if self._changes.leaves_target:
                message = self._away(task.target.tolerance, target, pressures)
            self._last = Plan(
                request.serial, pressures, request.offset, asked, True, stiffness, message,
                far=bool(message), adapted=request.adapted, tip_first=self._changes.tip_first,
            )  # fmt: skip
        else:
            self._changes.end()
            plan = self._nearest(request, task, target, distant=self._refused > refused)
            if (last is None or request.search) and self._demands and request.here.size:
                plan = replace(plan, tip_first=tuple(plan.pressures.tolist()))
            self._last = plan
        return self._last

    def _braced(self, request: PlanRequest, task: Task, asked: Target) -> Plan | None:
        """Plan for an arm that leans on objects; None if keeping clear of them is better."""
        solution = PressureSolver(self._robot, task.model_copy(update={"target": asked})).solve()
        if not solution.contacts or solution.pressures is None:
            return None
        plan = Plan(
            request.serial, np.array(solution.pressures), request.offset, asked, True,
            float(solution.stiffness or math.nan), "", adapted=request.adapted,
        )  # fmt: skip
        try:
            approach = approach_to(self._robot, solution)
        except Unsolved as reason:
            return replace(plan, blocked=str(reason))
        blocked = ""
        if self._ways is not None and len(request.way):  # the arm first goes down to rest
            rest = np.zeros_like(plan.pressures)
            blocked = self._ways.blocked(np.vstack([request.way[:1], rest]))
        return replace(plan, approach=approach, blocked=blocked)

    def _effective_limits(self, request: PlanRequest) -> tuple[Array, Array]:
        """Return limits (n,) of the effective pressures that permitted commands lead to, in Pa.

        The offset never widens the task's limits, beyond which the model does not hold.
        """
        assert self._solver is not None  # made before
        lower, upper = self._solver.task.pressure_bounds(self._robot.description)
        offset = request.pressure_offset
        shifted = np.maximum(lower, lower + offset), np.minimum(upper, upper + offset)
        if (shifted[0] > shifted[1]).any():
            shifted = lower, upper
        if not request.low.size:
            return shifted
        return np.clip(request.low, *shifted), np.clip(request.high, *shifted)

    def _next_to(self, last: Plan, target: Target) -> PressureSolution | None:
        """Return the optimum next to the last plan; a distant one only if it persists."""
        solution = self._solve(target, last.pressures)
        if solution is None or solution.pressures is None:
            return None
        if not self._is_distant(last, np.asarray(solution.pressures), target):
            self._refused = 0
            return solution
        self._refused += 1
        is_due = self._refused % (self._tuning.patience + 1) == 0
        if not is_due or not self._leads_to(last, solution, target):
            return None
        self._refused = 0
        return solution

    def _leads_to(self, last: Plan, solution: PressureSolution, target: Target) -> bool:
        """Return whether the arm may go from the last plan to another configuration.

        Without a way that stays at the target the tip would leave it, by centimetres for seconds.
        It may go all the same if it is not at the target now.
        """
        here, there = last.pressures, np.asarray(solution.pressures)
        at_target = self._at_target(target, here)
        return at_target is None or bool(self._changes.way_on(target, self._limits, here, there))

    def _at_target(self, target: Target, here: Array, **options: bool) -> Array | None:
        """Return pressures (n,) near others that have the tip at its target; None without any."""
        found, is_there = self._search.reaches(target, self._limits, here, **options)
        return found if is_there else None

    def _is_distant(self, last: Plan, pressures: Array, target: Target) -> bool:
        """Return True if pressures (n,) are too far from the last plan for one configuration."""
        t = self._tuning
        displacement = float(np.linalg.norm(self._displacement(last, target)))
        reach = t.neighbourhood + t.neighbourhood_per_metre * displacement
        return float(np.max(np.abs(pressures - last.pressures))) > reach

    def _tip_first(
        self, request: PlanRequest, target: Target, stiffest: Array, best: float
    ) -> Array:
        """Return the pressures (n,) to which the arm goes before the stiffest ones (n,).

        They bring the tip to its target by the least motion of each channel. On the straight line
        to the stiffest ones the channels move the tip against each other, by several times its
        way and as fast; so would the fault of one. The arm goes on from there as to another
        configuration, or from the first place on that way that has a share of the stiffness `best`.

        What a task demands is met there as well, and on the rest of the way. If there is no such
        place, the arm goes straight, with channels as slow as on the tip's way.

        On a rig with a scene the arm goes straight, and as fast as it can, if it would come too
        near to the scene otherwise.
        """
        if not request.here.size:
            return stiffest
        found = self._at_target(target, request.here, least_motion=True)
        way = [] if found is None else self._changes.way_on(target, self._limits, found, stiffest)
        while way and self._is_soft(way[0], self._tuning.soft * best):
            way = way[1:]
        if self._demands:
            way = [*self._as_demanded(way), stiffest]
        if not way or self._blocked(request, *way, stiffest):
            return stiffest
        self._changes.begin(stiffest, tuple(way[0].tolist()))
        return way[0]

    def _on_the_way(
        self, request: PlanRequest, last: Plan, stiffest: Array, target: Target
    ) -> Array:
        """Return the next pressures (n,) of the change to the stiffest ones (n,).

        Where the target has moved, the way may no longer have what the task demands. Then the arm
        goes straight.
        """
        pressures = self._changes.next(request, last, stiffest, target, self._limits)
        if not self._demands or not self._demands.are_missed(self._tip.at(pressures)):
            return pressures
        self._changes.end()
        if request.here.size:
            self._changes.begin(stiffest, tuple(stiffest.tolist()))
        return stiffest

    def _as_demanded(self, way: list[Array]) -> list[Array]:
        """Return the last part of a way (k, n) on which the tip has what the task demands.

        Where it begins, there is a margin.
        """
        begin = len(way)
        for index, place in reversed(list(enumerate(way))):
            tip = self._tip.at(place)
            if self._demands.are_missed(tip):
                break
            if self._demands.are_clearly_met(tip):
                begin = index
        return way[begin:]

    def _is_soft(self, pressures: Array, least: float) -> bool:
        """Return whether the task's stiffness at pressures (n,) is less than `least`."""
        return self._stiffness is not None and self._stiffness_at(self._tip.at(pressures)) < least

    def _stiffness_at(self, tip: TipAt) -> float:
        """Return the stiffness in the task's first direction; NaN if it has none."""
        if self._stiffness is None:
            return math.nan
        return self._stiffness(tip.compliance, tip.pose[:3, :3])

    def _blocked(self, request: PlanRequest, *pressures: Array) -> str:
        """Return why the request's way and on to pressures (n,) is not clear of the scene."""
        if self._ways is None or not len(request.way):
            return ""
        return self._ways.blocked(np.vstack([request.way, *pressures]))

    def _better(
        self, request: PlanRequest, target: Target, solution: PressureSolution, last: Plan
    ) -> PressureSolution:
        """Return the stiffest configuration, if the offset has changed and the arm is at rest.

        Each change of configuration raises the advantage required for the next one: the offset, and
        with it the choice, may differ between configurations.
        """
        changed = float(np.linalg.norm((request.offset - self._searched_at)[:3]))
        drift = float(np.linalg.norm((request.offset - last.offset)[:3]))
        if changed <= self._tuning.search_offset or drift > self._tuning.at_rest:
            return solution
        self._searched_at = request.offset
        other = self._solve(target, None)
        if other is None or other.pressures is None:
            return solution
        if (other.stiffness or 0.0) <= (1 + self._advantage) * (solution.stiffness or 0.0):
            return solution
        if not self._leads_to(last, other, target):
            return solution
        self._advantage *= 2
        return other

    def _solve(self, target: Target, guess: Array | None) -> PressureSolution | None:
        """Return the optimiser's solution; None if it finds none that is valid in time."""
        assert self._solver is not None  # made before
        self._is_compiled = self._is_compiled or self._solver.is_compiled
        if self._is_compiled:
            return self._solver.solve_at_once(target, guess, self._limits)
        solution = self._solver.solve(target, guess)
        if not solution.found or solution.pressures is None:
            return None
        low, high = self._limits
        p = np.asarray(solution.pressures)
        if (p < low - _SLACK).any() or (p > high + _SLACK).any():
            pressure = PressureRange(min=tuple(low.tolist()), max=tuple(high.tolist()))
            task = self._solver.task.model_copy(update={"target": target, "pressure": pressure})
            solution = PressureSolver(self._robot, task).solve(guess=np.clip(p, low, high))
        return solution if solution.found else None

    def _nearest(self, request: PlanRequest, task: Task, target: Target, *, distant: bool) -> Plan:
        """Plan for a target that is out of reach, or unreachable at the required stiffness.

        It counts as reached if `request.stay` asks for no optimum, or if it can be reached in a
        `distant` configuration, which a later plan may take.
        """
        start = 0.5 * (self._limits[0] + self._limits[1])
        if self._last is not None:
            start = np.clip(self._last.pressures, *self._limits)
        elif self._demands and request.here.size:  # mostly only the stiffness is out of reach
            start = np.clip(request.here, *self._limits)
        pressures, distance, angle = self._search.find(target, self._limits, start)
        tolerance = task.target.tolerance
        far = distance > tolerance.position or angle > tolerance.angle
        reached, stiffness, short = (request.stay and not far) or distant, math.nan, np.zeros(3)
        if request.stay or distant:
            tip = self._tip.at(pressures)
            stiffness = self._stiffness_at(tip) if reached else math.nan
            if request.stay and target.position is not None:
                away = np.array(target.position, dtype=float) - tip.pose[:3, 3]
                short = np.nan_to_num(away)
        return Plan(
            request.serial, pressures, request.offset, request.target, reached, stiffness,
            "" if request.stay and not far else nearest_words(distance, angle, tolerance), far=far,
            short=tuple(short.tolist()), adapted=request.adapted,
        )  # fmt: skip

    def _away(self, tolerance: Tolerance, target: Target, pressures: Array) -> str:
        """Return how far the tip at pressures (n,) is from its target; empty if it is there."""
        distance, angle = self._search.distance(target, pressures)
        if distance <= tolerance.position and angle <= tolerance.angle:
            return ""
        return nearest_words(distance, angle, tolerance, "the tip")

    def _displacement(self, last: Plan, target: Target) -> Array:
        """Return by how much (3,) the model's target has moved since the last plan, in m."""
        before = None
        if last.target is not None:
            before = model_target(last.target, last.offset).position
        if before is None or target.position is None:
            return np.zeros(3)
        pairs = zip(before, target.position, strict=True)
        return np.array([0.0 if a is None or b is None else b - a for a, b in pairs])


def nearest_words(
    distance: float, angle: float, tolerance: Tolerance, what: str = "the nearest pose"
) -> str:
    """Report how far the tip, or a pose of it, is from its target, in m and rad."""
    words = f"{what} is {1e3 * distance:.1f} mm away"
    if angle > tolerance.angle:
        words += f" and {math.degrees(angle):.1f} deg"
    return words


def model_target(target: Target, offset: Array) -> Target:
    """Return the target at which the model must aim so that an arm with an offset is on target.

    The offset (6,) is that of `PlanRequest`.
    """
    return target.moved_back(offset).model_copy(update={"tolerance": _EXACT})
