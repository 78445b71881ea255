"""`plan_motion`: plan a motion between configurations with the whole body clear of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.errors import EquilibriumError, InputError, StoppedError, shown
from stiffopt.model.compiled import Stopwatch
from stiffopt.model.compliance import stiffness_of
from stiffopt.model.contact.equilibrium import ContactEquilibrium
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.motion_clearance import MOTION_ERROR, ClearMotions
from stiffopt.model.scene import Scene
from stiffopt.model.stopping import Cancel, giving_up
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.solver import PressureSolver, solve_pressure
from stiffopt.optimise.task import Load, Task
from stiffopt.paths.configurations import (
    Configuration,
    End,
    TaskConfigurations,
    Unsolved,
    maximised,
    several,
)
from stiffopt.paths.leaning import (
    gradual,
    least_times_along,
    stiffness_leaning,
    touches_at,
    way_from_rest,
    way_into_contact,
)
from stiffopt.paths.motion_request import MotionRequest
from stiffopt.paths.rates import least_times
from stiffopt.paths.shortening import rounded, shortened
from stiffopt.paths.solution import PathSolution
from stiffopt.paths.tree_search import TreeSearch
from stiffopt.schema import BadKeyError

_NEARLY_AS_STIFF = 0.95  # share of the best stiffness from which no stiffer goal is sought
_MORE = 50  # motions checked for a stiffer goal, in addition to as many as for the first
_LEAST_STEP = 1.1e-3  # s, shortest time between points that a trajectory accepts
_MARGINS = 5  # largest number of ways sought for the margin of a calibrated arm
_GROWTH = 1.02  # of the margin over the uncertainty along the last way
_STEPS = 50  # smallest number of steps in a motion, unless they would be shorter than ...
_SHORT = 5e-3  # ... this, in s


def plan_motion(
    robot: Manipulator,
    start: End,
    goal: End | Sequence[End],
    *,
    scene: Scene | None = None,
    clearance: float | None = None,
    slew: float | ArrayLike | None = None,
    load: Load | None = None,
    seed: int = 0,
    timeout: float | None = 10.0,
    cancel: Cancel | None = None,
) -> PathSolution:
    """Find pressures over time from a start to a goal with the body clear of a scene all the way.

    The planner tries the straight way in the space of pressures.  If it is not clear, two trees
    grow towards each other (RRTConnect of OMPL), and their way is shortened and rounded.  Clearance
    is checked continuously along each piece, not only at points (see
    `stiffopt.model.motion_clearance`): linearly interpolated pressures keep it to 0.03 mm.

    Parameters
    ----------
    robot : Manipulator
    start : (n,) or Task
        Pressures in Pa, or a task, which stands for its solution.  If that leans, the motion
        releases the contact on the way to rest, and goes on from there.
    goal : (n,) or Task, or several of them
        A task stands for all configurations that solve it: the stiffest and others.  The motion
        goes to the stiffest with a clear straight way; if there is none, to whichever the trees
        reach.  If that one has less than 0.95 of the best known stiffness, the search goes on, for
        about as long again, towards one that has more.  For a single task with a brace whose answer
        leans, the motion goes to rest first, and from there into contact
        (`stiffopt.paths.leaning`); an arm that touches such an object at the
        start or at rest stays in contact on the way there.
    scene : Scene, optional
        Replaces that of the tasks.  Without any, the way is straight.  With a brace, it must have
        the objects to lean on; if it is not given, tasks may not have different scenes.
    clearance : float, optional
        Required of the body, in m; by default that of the scene.  For a calibrated robot, the
        uncertainty of the tip is added (`Manipulator.tip_uncertainty`).
    slew : float or (n,), optional
        Largest rates of change in Pa/s, in addition to the robot's; one of the two must be known.
    load : Load, optional
        At the tip all the way; replaces that of the tasks.  With a brace, it must be that task's.
    seed : int
        Of the search.  The same seed gives the same motion, unless time ended the search.
    timeout : float, optional
        Seconds after which to give up; compiling a kind of task once does not count, nor does the
        search for where to lean.
    cancel : threading.Event or callable, optional
        The search gives up once it is set, or returns true; another thread may call it.

    Returns
    -------
    PathSolution
        With status "unreachable" if no way was found; the message says what blocks it.

    Raises
    ------
    InputError
        An argument is invalid, pressures are outside the robot's limits, or tasks differ in load,
        or with a brace in scene.
    MissingExtraError
        A search is needed, and OMPL is not installed.
    """
    goals = several(goal)
    braced = [each for each in (start, *goals) if isinstance(each, Task) and each.brace is not None]
    if braced:
        if len(braced) > 1 or (braced[0] is not start and len(goals) > 1):
            raise InputError(
                "a task with 'brace' must be the only goal of a motion, or its start, and not both"
            )
        tasks = [each for each in (start, *goals) if isinstance(each, Task)]
        task = _in_one_scene(braced[0], tasks, scene, load)
        options: dict[str, Any] = {"clearance": clearance, "load": task.load, "seed": seed}
        options |= {"slew": slew, "timeout": timeout}
        with giving_up(None, cancel):
            if braced[0] is start:
                return _releasing(robot, task, goals, options)
            return _leaning(robot, start, task, options)
    watch = Stopwatch()
    request = MotionRequest.of(robot, start, goal, scene, clearance, slew, load, seed)
    timings: dict[str, float] = {}
    for end in (request.start, *request.goals):
        if isinstance(end, Task):
            PressureSolver(request.bare, request.posed(end), seed=request.seed).compile()
    try:
        with giving_up(timeout, cancel):
            planner, way = _with_margin(request, timings)
        found = planner.described(way)
    except Unsolved as reason:
        found = request.without_answer(str(reason), "unreachable")
    except (StoppedError, EquilibriumError) as error:
        found = request.without_answer(str(error), "failed")
    found.timings.update(timings | watch.timings())
    return found


def _with_margin(request: MotionRequest, timings: dict[str, float]) -> tuple[_Planner, Array]:
    """Return a way whose margin is at least the calibrated uncertainty along it, and its planner.

    The margin begins with the uncertainty at given ends, and grows to that along the last way.
    """
    ends = [each for each in (request.start, *request.goals) if not isinstance(each, Task)]
    if request.margin is not None and len(ends) == 1 + len(request.goals):
        nearest = min(request.uncertainty(each[np.newaxis]) for each in ends[1:])
        margin = max(request.uncertainty(ends[0][np.newaxis]), nearest)
        request = replace(request, margin=_GROWTH * margin)
    for _ in range(_MARGINS):
        planner = _Planner(request, timings)
        way = planner.way()
        left_open = 0.0 if request.margin is None else request.uncertainty(way)
        if request.margin is None or left_open <= request.margin:
            return planner, planner.shorter(way)
        request = replace(request, margin=_GROWTH * left_open)
    unit = display_units().length
    raise Unsolved(
        "no way was found on which the clearance exceeds the uncertainty of the calibration; on "
        f"the last one that is {unit.text(left_open, '.3g')}"
    )


def _in_one_scene(braced: Task, tasks: list[Task], scene: Scene | None, load: Load | None) -> Task:
    """Return a task with a brace in the scene of its whole motion.

    Refuse tasks that differ in scene or load, and a scene without what the arm leans on.
    """
    if load is not None and not isinstance(load, Load):
        raise InputError(f"load must be a Load; got {shown(load)}")
    loads = [each.tip_load for each in tasks] if load is None else [load]
    if any(each != braced.load for each in loads):
        raise InputError(
            "a motion to or from a task with 'brace' has that task's load, or none if it has none, "
            "all the way; give all its tasks the same load"
        )
    if scene is None:
        own = [each.scene for each in tasks if each.scene is not None]
        if any(
            (each.clearance, each.objects) != (own[0].clearance, own[0].objects) for each in own
        ):
            raise InputError(
                "the tasks of a motion to or from a task with 'brace' have different scenes; give "
                "one scene with the objects of all"
            )
        scene = braced.scene
    if not isinstance(scene, Scene):
        raise InputError(f"scene must be a Scene, see load_scene; got {shown(scene)}")
    assert braced.brace is not None
    try:
        braced.brace.check_objects(scene)
    except BadKeyError as error:
        raise InputError(
            f"the scene of the motion does not suit the task with 'brace': {error}"
        ) from None
    return braced.model_copy(update={"scene": scene})


def _leaning(robot: Manipulator, start: End, goal: Task, options: dict[str, Any]) -> PathSolution:
    """Plan a motion to a task with a brace: to rest, and from there into contact.

    Down to rest the body keeps clear of the scene, unless it leans on an object at the start or
    lies on one at rest.
    """
    watch = Stopwatch()
    found = solve_pressure(robot, goal, seed=options["seed"])
    rest = np.zeros(robot.n_pressures)
    lies = touches_at(robot, goal, rest)
    if found.pressures is None or not (found.contacts or lies):
        return plan_motion(robot, start, goal.unbraced, **options)
    own = {name: value for name, value in options.items() if name != "timeout"}
    request = MotionRequest.of(robot, start, rest, goal.scene, **own)
    measures = maximised(goal)
    if not found.found:
        return request.without_answer(found.message, "unreachable")
    try:
        states = way_into_contact(robot, found)
        begins_in_contact = not isinstance(request.start, Task) and touches_at(
            robot, goal, request.start
        )
        if lies or begins_in_contact:
            down = _down_in_contact(robot, goal, request)
        else:
            down = plan_motion(robot, start, rest, scene=goal.scene, **options)
            if not down.found:
                return down
            down = replace(
                down, stiffness=_least_stiffness(request.robot, down.pressures, measures)
            )
    except Unsolved as reason:
        return request.without_answer(str(reason), "unreachable")
    except StoppedError as reason:
        return request.without_answer(str(reason), "failed")
    times = gradual(least_times_along(robot, states, request.slew))
    way, leant = states[1:], _leant_on(states[-1])
    message = f"from rest on into contact: at the end it leans on {leant}; a motion that has the "
    message += "task as its start releases the contact"
    if not leant:
        message = "from rest, where the arm lies on an object, to a posture that is clear of it"
    return replace(
        down,
        message=message,
        times=np.concatenate([down.times, down.times[-1] + times[1:]]),
        pressures=np.concatenate([down.pressures, [eq.pressures for eq in way]]),
        tip_poses=np.concatenate([down.tip_poses, [eq.tip_pose for eq in way]]),
        stiffness=np.concatenate([down.stiffness, [stiffness_leaning(eq, goal) for eq in way]]),
        stiffness_unit=measures[0].unit,
        clearance=None,
        equilibria=(*down.equilibria, *way),
        timings=down.timings | watch.timings(),
        confidence=f"{down.confidence}; the equilibria in contact were followed from rest",
    )


def _releasing(
    robot: Manipulator, start: Task, goals: list[End], options: dict[str, Any]
) -> PathSolution:
    """Plan a motion from a task with a brace: to rest, out of contact, and from there to a goal.

    All pressures fall in proportion, by the speed and the rate of force with which an arm leans.
    """
    watch = Stopwatch()
    found = solve_pressure(robot, start, seed=options["seed"])
    if found.pressures is None or not found.contacts:
        return plan_motion(robot, start.unbraced, goals, scene=start.scene, **options)
    rest = np.zeros(robot.n_pressures)
    own = {name: value for name, value in options.items() if name != "timeout"}
    request = MotionRequest.of(robot, start, rest, start.scene, **own)
    if not found.found:
        return request.without_answer(found.message, "unreachable")
    try:
        states = way_into_contact(robot, found, is_eased=False)[::-1]
    except Unsolved as reason:
        return request.without_answer(str(reason), "unreachable")
    on = plan_motion(robot, rest, goals, scene=start.scene, **options)
    if not on.found:
        return on
    times = gradual(least_times_along(robot, states, request.slew))
    measures, later = maximised(start), on.pressures[1:]
    message = f"at the start it leans on {_leant_on(states[0])}, and lets go on the way to rest"
    stiffness = np.array([stiffness_leaning(eq, start) for eq in states])
    if len(later):
        message += f"; from there on {on.message}" if on.message else ""
        stiffness = np.concatenate([stiffness, _least_stiffness(request.robot, later, measures)])
    return replace(
        on,
        message=message,
        times=np.concatenate([times, times[-1] + on.times[1:]]),
        pressures=np.concatenate([[eq.pressures for eq in states], later]),
        tip_poses=np.concatenate([[eq.tip_pose for eq in states], on.tip_poses[1:]]),
        stiffness=stiffness,
        stiffness_unit=measures[0].unit,
        clearance=None,
        equilibria=(*states, *[None] * len(later)),
        timings=on.timings | watch.timings(),
        confidence=f"the equilibria in contact were followed from rest; {on.confidence}",
    )


def _leant_on(eq: ContactEquilibrium) -> str:
    """Return what an arm leans on, and with which force; empty if on nothing."""
    unit = display_units().force
    return " and ".join(
        f"'{eq.contacts[on[0]].object}' with {unit.text(force, '.3g')}"
        for on, force in eq.pressed()
    )


def _down_in_contact(robot: Manipulator, goal: Task, request: MotionRequest) -> PathSolution:
    """Return the motion to rest of an arm that touches an object at the start or at rest."""
    start = request.start
    if isinstance(start, Task):
        start = TaskConfigurations(
            "start", robot, request.posed(start), request.seed
        ).best.pressures
    states = way_from_rest(robot, goal, start)[::-1]
    return replace(
        request.without_answer("", "solved"),
        times=gradual(least_times_along(robot, states, request.slew)),
        pressures=np.array([eq.pressures for eq in states]),
        tip_poses=np.array([eq.tip_pose for eq in states]),
        stiffness=np.array([stiffness_leaning(eq, goal) for eq in states]),
        equilibria=tuple(states),
        confidence="a straight way in pressures",
    )


@dataclass
class _Planner:
    """Finds and describes the motion of a request."""

    request: MotionRequest
    timings: dict[str, float]
    poses: int = 0
    goals: list[Configuration] = field(default_factory=list)
    searched: bool = False
    motions: ClearMotions | None = field(init=False)

    def __post_init__(self) -> None:
        scene = self.request.scene
        self.motions = None if scene is None else ClearMotions(self.request.robot, scene)

    def is_clear(self, rows: Array) -> bool:
        """Whether the way along pressures (N, n) is clear."""
        if self.motions is None:
            return True
        found = self.motions.along(rows, self.request.required)
        self.poses += found.poses
        return found.clear

    def is_still_clear(self, rows: Array) -> bool:
        """Whether the way is clear; false once the time is over."""
        try:
            return self.is_clear(rows)
        except StoppedError:
            return False

    def way(self) -> Array:
        """Return a way (k, n) in pressures, not yet shortened; raise `Unsolved` with a reason."""
        begin = perf_counter()
        start = self._start()
        tasks, goals = self._first_goals()
        self.timings["goals"] = perf_counter() - begin
        end = self._straight_to(start, goals)
        if end is not None:
            way = np.stack([start, end.pressures])
        else:
            begin = perf_counter()
            goals = [*goals, *(each for task in tasks for each in task.others(start))]
            self.goals = goals
            self.timings["goals"] += perf_counter() - begin
            way = self._search(start, goals, tasks)
        return way

    def shorter(self, way: Array) -> Array:
        """Return a shorter and rounder way if its margin suffices, else the given one."""
        begin, found = perf_counter(), way
        try:
            if len(way) > 2:
                found = shortened(way, self.is_still_clear, self.request.slew, self.request.seed)
                found = rounded(found, self.is_still_clear, self.request.slew)
                margin = self.request.margin
                if margin is not None and self.request.uncertainty(found) > margin:
                    found = way
        except StoppedError:
            found = way
        self.timings["shorten"] = perf_counter() - begin
        return found

    # -- ends -------------------------------------------------------------------------------

    def _start(self) -> Array:
        request = self.request
        given = request.start
        if isinstance(given, Task):
            task = request.posed(given)
            return TaskConfigurations("start", request.bare, task, request.seed).best.pressures
        self._check("start", given)
        return given

    def _first_goals(self) -> tuple[list[TaskConfigurations], list[Configuration]]:
        """Return the solvable tasks among the goals, and the best configuration of each goal."""
        request = self.request
        tasks, goals, refused = [], [], []
        for number, goal in enumerate(request.goals, start=1):
            name = "goal" if len(request.goals) == 1 else f"goal {number}"
            try:
                if isinstance(goal, Task):
                    task = TaskConfigurations(name, request.bare, request.posed(goal), request.seed)
                    tasks.append(task)
                    goals.append(task.best)
                else:
                    self._check(name, goal)
                    goals.append(Configuration(goal, name=name))
            except Unsolved as reason:
                refused.append(str(reason))
        self.goals = goals
        if not goals:
            raise Unsolved("; ".join(refused))
        return tasks, goals

    def _check(self, name: str, p: Array) -> None:
        """Refuse an end that is not clear."""
        if self.motions is not None and not self.is_clear(np.stack([p, p])):
            raise Unsolved(f"{name if p.any() else 'at rest'}: {self._in_the_way(p)}")

    def _in_the_way(self, p: Array) -> str:
        """Describe the nearest object at pressures (n,) and the missing clearance."""
        request = self.request
        assert request.scene is not None
        near = request.robot.clearances(p, request.scene)
        index = int(np.argmin(near.distances))
        distance, name = float(near.distances[index]), near.names[index]
        shape = next(item.shape for item in request.scene.objects if item.name == name)
        unit = display_units().length
        missing = unit.text(request.required - distance, ".3g")
        text = f"the body is {missing} {shape.amiss} '{name}'"
        if request.required:
            text += f", where {unit.text(request.required, '.3g')} of clearance are required"
        if request.margin:
            kept = unit.text(request.margin, ".3g")
            text += f", {kept} of them for the uncertainty of the calibration"
        return text

    # -- ways -------------------------------------------------------------------------------

    def _straight_to(self, start: Array, goals: list[Configuration]) -> Configuration | None:
        """Return the best goal to which the straight way is clear."""
        best_first = sorted(goals, key=lambda each: -each.worth)
        ways = ((each, np.stack([start, each.pressures])) for each in best_first)
        return next((each for each, way in ways if self.is_clear(way)), None)

    def _search(
        self, start: Array, goals: list[Configuration], tasks: list[TaskConfigurations]
    ) -> Array:
        """Search a way around obstacles; `plan_motion` says to which goal."""
        begin = perf_counter()
        assert self.motions is not None  # or the straight way was clear
        weights = self.motions.bounds.speeds.max(axis=0)[self.motions.piece_of]
        limits = self._limits(start, goals, tasks)
        search = TreeSearch(self.is_still_clear, *limits, weights, self.request.seed)
        end = self._straight_to(start, goals)
        between = np.zeros((0, len(start)))
        if end is None:
            self.searched = True
            found, reached = search.way(start, _all(goals), np.inf)
            if found is None:
                raise Unsolved(self._no_way(reached))
            end, between = _nearest(goals, found[-1]), found[1:-1]
        way = np.concatenate([[start], between, [end.pressures]])
        best = max(goal.worth for goal in goals)
        stiff = [goal for goal in goals if goal.worth >= _NEARLY_AS_STIFF * best]
        if end not in stiff:
            way = self._stiffer(search, way, stiff)
        self.timings["search"] = perf_counter() - begin
        return way

    def _stiffer(self, search: TreeSearch, way: Array, stiff: list[Configuration]) -> Array:
        """Extend the way to one of the stiff goals, if a short search finds how."""
        goal = self._straight_to(way[-1], stiff)
        if goal is not None:
            return np.concatenate([way, [goal.pressures]])
        found, _ = search.way(way[-1], _all(stiff), search.tried + _MORE)
        if found is None:
            return way
        return np.concatenate([way, found[1:-1], [_nearest(stiff, found[-1]).pressures]])

    def _limits(
        self, start: Array, goals: list[Configuration], tasks: list[TaskConfigurations]
    ) -> tuple[Array, Array]:
        """Return limits of the way that include its ends.

        They are those of the tasks if all goals are tasks, else the robot's.
        """
        robot = self.request.robot
        if len(tasks) == len(self.request.goals):
            low = np.min([task.limits[0] for task in tasks], axis=0)
            high = np.max([task.limits[1] for task in tasks], axis=0)
        else:
            low, high = robot.pressure_min, robot.pressure_max
        ends = np.stack([start, *(goal.pressures for goal in goals)])
        return np.minimum(low, ends.min(axis=0)), np.maximum(high, ends.max(axis=0))

    def _no_way(self, reached: Array | None) -> str:
        text = "no clear way was found in the time given, which is no proof that there is none"
        if reached is not None and self.request.scene is not None:
            nearest = self.request.robot.clearances(reached, self.request.scene).nearest
            text += f"; where the search from the start ended, '{nearest}' is the nearest"
        return text

    # -- the answer -------------------------------------------------------------------------

    def described(self, way: Array) -> PathSolution:
        """Return the motion along a way, timed and evaluated by the model."""
        begin = perf_counter()
        request = self.request
        robot = request.robot
        p, times = timed(way, request.slew)
        measures = _measures(request.goals)
        clearance = None if request.scene is None else robot.clearance(p, request.scene)
        found = PathSolution(
            status="solved",
            message=self._message(way[-1], clearance),
            robot=robot,
            times=times,
            pressures=p,
            tip_poses=robot.pose(p, robot.length),
            slew=request.slew,
            stiffness=_least_stiffness(robot, p, measures) if measures else None,
            stiffness_unit=measures[0].unit if measures else None,
            clearance=clearance,
            confidence=self._confidence(),
        )
        self.timings["describe"] = perf_counter() - begin
        return found

    def _message(self, end: Array, clearance: Array | None) -> str:
        reached = ""
        if len(self.request.goals) > 1:
            reached = f"to {_nearest(self.goals, end).name} of {len(self.request.goals)}"
        if clearance is None:
            return reached
        margin, unit = self.request.margin, display_units().length
        counted = (
            "this includes no error of the model, as the robot is not calibrated"
            if margin is None
            else f"{unit.text(margin, '.3g')} of it are kept for the uncertainty of the "
            "calibration (95 %)"
        )
        least = unit.text(clearance.min(), ".3g")
        kept = f"the body is at least {least} clear of the scene; {counted}"
        return f"{reached}; {kept}" if reached else kept

    def _confidence(self) -> str:
        if self.motions is None:
            return "a straight way in pressures; there is no scene"
        goals = "" if len(self.goals) == 1 else f" to one of {len(self.goals)} goal configurations"
        how = "RRTConnect" if self.searched else "a straight way in pressures"
        kept = f"the way between them is clear to {display_units().length.text(MOTION_ERROR, 'g')}"
        return f"{how}{goals}, {self.poses} poses looked at; {kept}"


def _least_stiffness(robot: Manipulator, p: Array, measures: Sequence[StiffnessMeasure]) -> Array:
    """Return the smallest (N,) of several stiffnesses of the tip at pressures (N, n)."""
    C = robot.compliance_between(p, robot.length, robot.length)  # base axes
    R = robot.pose(p, robot.length)[:, :3, :3]
    directions = [
        R @ each.direction if each.frame == "tip" else np.broadcast_to(each.direction, (len(p), 3))
        for each in measures
    ]
    pairs = zip(measures, directions, strict=True)
    return np.min([stiffness_of(C, d, each.kind, each.boundary) for each, d in pairs], 0)


def timed(way: Array, rates: Array) -> tuple[Array, Array]:
    """Return points (N, n) along a way at the highest speed within the rates, and times (N,)."""
    if len(way) < 2 or not np.ptp(way, axis=0).any():
        return way[:1], np.zeros(1)
    least = np.maximum(least_times(way, rates), _LEAST_STEP)
    longest = max(float(least.sum()) / _STEPS, _SHORT)
    points, times = [way[:1]], [np.zeros(1)]
    for a, b, time in zip(way[:-1], way[1:], least, strict=True):
        count = int(np.ceil(time / longest - 1e-9))
        shares = np.arange(1, count + 1)[:, None] / count
        points.append(a + shares * (b - a))
        points[-1][-1] = b
        times.append(times[-1][-1] + shares[:, 0] * time)
    return np.concatenate(points), np.concatenate(times)


def _all(goals: Sequence[Configuration]) -> Array:
    return np.stack([goal.pressures for goal in goals])


def _nearest(goals: Sequence[Configuration], p: Array) -> Configuration:
    """Return the goal nearest to pressures (n,)."""
    return min(goals, key=lambda goal: float(np.abs(goal.pressures - p).max()))


def _measures(goals: Sequence[Array | Task]) -> tuple[StiffnessMeasure, ...]:
    """Return the stiffnesses maximised by the first goal that maximises any."""
    tasks = (goal for goal in goals if isinstance(goal, Task))
    return next((found for found in map(maximised, tasks) if found), ())
