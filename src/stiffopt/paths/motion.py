"""`plan_motion`: from one configuration to another, the whole body clear of a scene all the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import EquilibriumError, InputError, StoppedError, shown
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.motion_clearance import MOTION_ERROR, ClearMotions
from stiffopt.model.scene import Scene
from stiffopt.model.stopping import giving_up
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.task import Load, Task
from stiffopt.paths.configurations import (
    Configuration,
    End,
    TaskConfigurations,
    Unsolved,
    checked_pressures,
    maximised,
    several,
)
from stiffopt.paths.rates import least_times, slew_limits
from stiffopt.paths.shortening import rounded, shortened
from stiffopt.paths.solution import PathSolution
from stiffopt.paths.stiffness import least_stiffness
from stiffopt.paths.tree_search import TreeSearch

Vector = NDArray[np.float64]

_NEARLY_AS_STIFF = 0.95  # of the best, which is not worth looking for stiffer ones
_MORE = 50  # motions tried for a stiffer goal, beyond as many as for the first
_USUAL_RATE = 1e5  # Pa/s, where no rate is known
_LEAST_STEP = 1.1e-3  # s, between points: what a trajectory takes
_STEPS = 50  # into which the motion is divided at least, unless they are shorter than:
_SHORT = 5e-3  # s
_MARGIN_SAMPLES = 12  # pressures at which a calibration is asked for the error


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
) -> PathSolution:
    """Find pressures over time from a start to a goal with the body clear of a scene all the way.

    Ways are straight in the space of pressures where that is clear, else found by two trees that
    grow towards each other (RRTConnect of OMPL); then they are shortened, rounded and timed.  Each
    piece of what is returned was judged as a whole, not only at points of it (see
    `stiffopt.model.motion_clearance`): pressures that are interpolated linearly keep the clearance
    to 0.03 mm.

    Parameters
    ----------
    robot : Manipulator
    start : (n,) or Task
        Pressures in Pa, or a task, whose solution is meant.
    goal : (n,) or Task, or several of them
        A task means all configurations that solve it: the stiffest, and others.  The stiffest to
        which the straight way is clear is taken; if there is none, whichever the trees reach.
        Where that one is softer than 0.95 of the best that is known, as many motions again are
        tried to reach one that is not.
    scene : Scene, optional
        Instead of that of the tasks.  Without any, the way is straight.
    clearance : float, optional
        To be kept by the body, in m; that of the scene if absent.  A calibrated robot's body keeps
        as much more as the calibration leaves unknown of the tip (`Manipulator.tip_uncertainty`).
    slew : float or (n,), optional
        Greatest rates of change in Pa/s; the robot's own hold too.
    load : Load, optional
        At the tip all the way, instead of that of the tasks.
    seed : int
        Of the search.  The same gives the same motion, unless time ended the search.
    timeout : float, optional
        Seconds after which to give up.

    Returns
    -------
    PathSolution
        "unreachable" where no way was found; the message says what is blocked.

    Raises
    ------
    InputError
        An argument is wrong; pressures are outside of the robot's limits; tasks differ in load.
    MissingExtraError
        The straight way is not clear, and OMPL is not installed.
    """
    if not isinstance(robot, Manipulator):
        raise InputError(f"robot must be a Manipulator, see load_robot; got {shown(robot)}")
    begin = perf_counter()
    request = _Request.of(robot, start, several(goal), scene, clearance, slew, load, seed)
    timings: dict[str, float] = {}
    with giving_up(timeout):
        try:
            found = _Planner(request, timings).solution()
        except Unsolved as reason:
            found = request.without_answer(str(reason), "unreachable")
        except (StoppedError, EquilibriumError) as error:
            found = request.without_answer(str(error), "failed")
    timings["total"] = perf_counter() - begin
    found.timings.update(timings)
    return found


@dataclass(frozen=True)
class _Request:
    """What was asked for, checked.

    Attributes
    ----------
    bare, robot : without and with the load of the motion.
    margin : of the asked clearance, for what a calibration leaves unknown; None: nothing is known.
    """

    bare: Manipulator
    robot: Manipulator
    load: Load | None
    start: Vector | Task
    goals: list[Vector | Task]
    scene: Scene | None
    clearance: float
    margin: float | None
    slew: Vector | None
    seed: int

    @classmethod
    def of(
        cls,
        robot: Manipulator,
        start: End,
        goals: list[End],
        scene: Scene | None,
        clearance: float | None,
        slew: float | ArrayLike | None,
        load: Load | None,
        seed: int,
    ) -> _Request:
        """Check arguments."""
        if not goals:
            raise InputError("a motion needs a goal; got an empty list")
        tasks = [each for each in (*goals, start) if isinstance(each, Task)]
        load = _load_of(tasks, load)
        bearer = robot.with_load(load.force, load.moment, load.frame) if load else robot
        scene = scene or next((task.scene for task in tasks if task.scene is not None), None)
        if scene is not None:
            if not isinstance(scene, Scene):
                raise InputError(f"scene must be a Scene, see load_scene; got {shown(scene)}")
            if clearance is not None:
                scene = scene.model_copy(update={"clearance": _checked_clearance(clearance)})
            scene.check_against(robot.description)
        elif clearance is not None:
            raise InputError("a clearance needs a scene, to whose objects it is kept")
        ends = [
            each if isinstance(each, Task) else checked_pressures(name, robot, each)
            for name, each in (("start", start), *(("goal", goal) for goal in goals))
        ]
        return cls(
            bare=robot,
            robot=bearer,
            load=load,
            start=ends[0],
            goals=ends[1:],
            scene=scene,
            clearance=0.0 if scene is None else scene.clearance,
            margin=None if scene is None else _margin(bearer),
            slew=slew_limits(robot.description, _checked_slew(robot, slew)),
            seed=seed,
        )

    @property
    def asked(self) -> float:
        """Clearance that is kept by the model's body, in m."""
        return self.clearance + (self.margin or 0.0)

    def posed(self, task: Task) -> Task:
        """A task with the load, the scene and the clearance of the motion."""
        scene = self.scene
        if scene is not None:
            scene = scene.model_copy(update={"clearance": self.asked})
        return task.model_copy(update={"load": self.load, "scene": scene})

    def without_answer(self, message: str, status: Any) -> PathSolution:
        """Solution with nothing but its message."""
        n = self.robot.n_pressures
        return PathSolution(
            status, message, self.robot, np.empty(0), np.empty((0, n)), np.empty((0, 4, 4)),
            slew=self.slew,
        )  # fmt: skip


@dataclass
class _Planner:
    """Finds and describes the motion of a request."""

    request: _Request
    timings: dict[str, float]
    poses: int = 0
    known: int = 0
    searched: bool = False
    motions: ClearMotions | None = field(init=False)

    def __post_init__(self) -> None:
        scene = self.request.scene
        self.motions = None if scene is None else ClearMotions(self.request.robot, scene)

    def is_clear(self, rows: Vector) -> bool:
        """Whether the way along pressures (N, n) is clear."""
        if self.motions is None:
            return True
        found = self.motions.along(rows, self.request.asked)
        self.poses += found.poses
        return found.clear

    def solution(self) -> PathSolution:
        """Plan, or raise `Unsolved` with what is in the way."""
        begin = perf_counter()
        start = self._start()
        tasks, goals = self._first_goals()
        self.timings["goals"] = perf_counter() - begin
        way, end = self._straight(start, goals)
        if way is None or end is None:
            begin = perf_counter()
            goals = [*goals, *(each for task in tasks for each in task.others(start))]
            self.known = len(goals)
            self.timings["goals"] += perf_counter() - begin
            way, end = self._search(start, goals, tasks)
        begin = perf_counter()
        scale = np.full(len(start), _USUAL_RATE) if self.request.slew is None else self.request.slew
        if len(way) > 2:
            way = shortened(way, self.is_clear, scale, self.request.seed)
            way = rounded(way, self.is_clear, scale)
        self.timings["shorten"] = perf_counter() - begin
        begin = perf_counter()
        found = self._described(way, scale)
        self.timings["describe"] = perf_counter() - begin
        return found

    # -- ends -------------------------------------------------------------------------------

    def _start(self) -> Vector:
        request = self.request
        given = request.start
        if isinstance(given, Task):
            task = request.posed(given)
            return TaskConfigurations("start", request.bare, task, request.seed).best.pressures
        self._check("start", given)
        return given

    def _first_goals(self) -> tuple[list[TaskConfigurations], list[Configuration]]:
        """The tasks among the goals that can be solved, and the best of each goal."""
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
                    goals.append(Configuration(goal))
            except Unsolved as reason:
                refused.append(str(reason))
        self.known = len(goals)
        if not goals:
            raise Unsolved("; ".join(refused))
        return tasks, goals

    def _check(self, name: str, p: Vector) -> None:
        """Refuse an end that is not clear."""
        if self.motions is not None and not self.is_clear(np.stack([p, p])):
            raise Unsolved(f"{name}: {self._in_the_way(p)}")

    def _in_the_way(self, p: Vector) -> str:
        """Which object is the nearest at pressures, and how it is."""
        request = self.request
        assert request.scene is not None
        near = request.robot.clearances(p, request.scene)
        index = int(np.argmin(near.distances))
        distance, name = float(near.distances[index]), near.names[index]
        shape = next(item.shape for item in request.scene.objects if item.name == name)
        if distance < 0:
            return f"the body is {-distance * 1e3:.3g} mm {shape.amiss} '{name}'"
        asked = f"{request.asked * 1e3:.3g} mm"
        if request.margin:
            asked += f" ({request.margin * 1e3:.3g} mm of it for what the calibration leaves open)"
        return f"the body is {distance * 1e3:.3g} mm from '{name}', where {asked} are asked"

    # -- ways -------------------------------------------------------------------------------

    def _straight(
        self, start: Vector, goals: list[Configuration]
    ) -> tuple[Vector | None, Configuration | None]:
        """The straight way to the best goal of those to which it is clear."""
        for goal in sorted(goals, key=lambda each: -each.worth):
            way = np.stack([start, goal.pressures])
            if self.is_clear(way):
                return way, goal
        return None, None

    def _search(
        self, start: Vector, goals: list[Configuration], tasks: list[TaskConfigurations]
    ) -> tuple[Vector, Configuration]:
        """A way around; see `plan_motion` for which goal."""
        begin = perf_counter()
        self.searched = True
        low, high = self._limits(start, goals, tasks)
        assert self.motions is not None
        bounds = self.motions.bounds
        weights = bounds.speeds[self.motions.piece_of]
        search = TreeSearch(self.is_clear, low, high, weights, self.request.seed)
        way, end = self._straight(start, goals)
        reached: Vector | None = None
        if way is None:
            way, reached = search.way(start, np.stack([g.pressures for g in goals]), np.inf)
        if way is None:
            raise Unsolved(self._no_way(reached))
        end = min(goals, key=lambda goal: float(np.abs(goal.pressures - way[-1]).max()))
        way = np.concatenate([[start], way[1:-1], [end.pressures]])
        best = max(goal.worth for goal in goals)
        stiff = [goal for goal in goals if goal.worth >= _NEARLY_AS_STIFF * best]
        if end not in stiff:
            way, end = self._stiffer(search, way, end, stiff)
        self.timings["search"] = perf_counter() - begin
        return way, end

    def _stiffer(
        self, search: TreeSearch, way: Vector, end: Configuration, stiff: list[Configuration]
    ) -> tuple[Vector, Configuration]:
        """On to one of the stiff goals, if that is soon found."""
        further, goal = self._straight(end.pressures, stiff)
        if further is not None and goal is not None:
            return np.concatenate([way, further[1:]]), goal
        found, _ = search.way(
            end.pressures, np.stack([g.pressures for g in stiff]), search.tried + _MORE
        )
        if found is None:
            return way, end
        goal = min(stiff, key=lambda each: float(np.abs(each.pressures - found[-1]).max()))
        return np.concatenate([way, found[1:-1], [goal.pressures]]), goal

    def _limits(
        self, start: Vector, goals: list[Configuration], tasks: list[TaskConfigurations]
    ) -> tuple[Vector, Vector]:
        """Limits of the way: those of the tasks, if all goals are tasks, but all ends within."""
        robot = self.request.robot
        if len(tasks) == len(self.request.goals):
            low = np.min([task.limits[0] for task in tasks], axis=0)
            high = np.max([task.limits[1] for task in tasks], axis=0)
        else:
            low, high = robot.pressure_min, robot.pressure_max
        ends = np.stack([start, *(goal.pressures for goal in goals)])
        return np.minimum(low, ends.min(axis=0)), np.maximum(high, ends.max(axis=0))

    def _no_way(self, reached: Vector | None) -> str:
        text = "no clear way was found in the time given, which is no proof that there is none"
        if reached is not None and self.request.scene is not None:
            nearest = self.request.robot.clearances(reached, self.request.scene).nearest
            text += f"; where the search from the start ended, '{nearest}' is the nearest"
        return text

    # -- the answer -------------------------------------------------------------------------

    def _described(self, way: Vector, rates: Vector) -> PathSolution:
        """The motion with its times and all that the model says of it."""
        request = self.request
        robot = request.robot
        p, times = timed(way, rates)
        measures = _measures(request.goals)
        clearance = None if request.scene is None else robot.clearance(p, request.scene)
        return PathSolution(
            status="solved",
            message=self._message(clearance),
            robot=robot,
            times=times,
            pressures=p,
            tip_poses=robot.pose(p, robot.length),
            slew=request.slew,
            stiffness=least_stiffness(robot, p, measures) if measures else None,
            stiffness_unit=measures[0].unit if measures else None,
            clearance=clearance,
            confidence=self._confidence(),
        )

    def _message(self, clearance: Vector | None) -> str:
        request = self.request
        parts = []
        if clearance is not None:
            parts.append(f"the body is at least {clearance.min() * 1e3:.3g} mm clear of the scene")
            if request.margin is None:
                parts[0] += "; this counts no error of the model, as the robot is not calibrated"
            else:
                parts[0] += (
                    f", of which {request.margin * 1e3:.3g} mm are kept for what the calibration "
                    "leaves unknown (95 %)"
                )
        if request.slew is None:
            parts.append(
                f"no rate of the pressures is known: timed at {_USUAL_RATE * 1e-5:g} bar/s"
            )
        return "; ".join(parts)

    def _confidence(self) -> str:
        if self.motions is None:
            return "a straight way in pressures; there is no scene"
        goals = "" if self.known == 1 else f", one of {self.known} goal configurations"
        how = "RRTConnect" if self.searched else "a straight way in pressures"
        return f"{how}{goals}, {self.poses} poses looked at, clear between them to {MOTION_ERROR * 1e3:g} mm"


def timed(way: Vector, rates: Vector) -> tuple[Vector, Vector]:
    """Points (N, n) on the way, divided evenly in time, and their times (N,), as soon as can be."""
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


def _measures(goals: Sequence[Vector | Task]) -> tuple[StiffnessMeasure, ...]:
    """What the first task among the goals maximises."""
    tasks = (goal for goal in goals if isinstance(goal, Task))
    return next((found for found in map(maximised, tasks) if found), ())


def _load_of(tasks: list[Task], load: Load | None) -> Load | None:
    """The load of the whole motion."""
    if load is not None:
        if not isinstance(load, Load):
            raise InputError(f"load must be a Load; got {shown(load)}")
        return load
    loads = [task.load for task in tasks]
    if any(each != loads[0] for each in loads):
        raise InputError("the tasks of a motion must have the same load; give one for all of them")
    return loads[0] if loads else None


def _checked_clearance(clearance: float) -> float:
    if not isinstance(clearance, int | float) or not 0 <= clearance < np.inf:
        raise InputError(f"clearance must be a length in m, not negative; got {shown(clearance)}")
    return float(clearance)


def _checked_slew(robot: Manipulator, slew: float | ArrayLike | None) -> Any:
    """Rates (n,) that are positive, or None."""
    if slew is None:
        return None
    try:
        rates = np.broadcast_to(np.asarray(slew, dtype=float), robot.n_pressures)
        good = bool((rates > 0).all() and np.isfinite(rates).all())
    except (TypeError, ValueError):
        good = False
    if not good:
        raise InputError(
            f"slew must be one rate above 0 in Pa/s or {robot.n_pressures} of them; "
            f"got {shown(slew)}"
        )
    return tuple(rates.tolist())


def _margin(robot: Manipulator) -> float | None:
    """What a calibration leaves unknown of the tip, in m; the largest over the pressures."""
    if robot.description.calibration is None:
        return None

    def find() -> float:
        rng = np.random.default_rng(0)
        shares = rng.random((_MARGIN_SAMPLES, robot.n_pressures))
        shares[:2] = [[0.0], [1.0]]
        low, high = robot.pressure_min, robot.pressure_max
        pressures = low + shares * (high - low)
        return max(float(robot.tip_uncertainty(p).semi_axes[0]) for p in pressures)

    return robot.kept(("margin of motions", robot.tip_load), find)
