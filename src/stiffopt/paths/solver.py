"""`solve_path`: find the stiffest pressures with which the tip follows a path within the rates."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from stiffopt.display import display_units
from stiffopt.errors import EquilibriumError, InputError, StoppedError, shown
from stiffopt.model.compiled import Stopwatch
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.stopping import Cancel, giving_up
from stiffopt.optimise.solution import Judgement, PressureSolution
from stiffopt.optimise.solver import PressureSolver
from stiffopt.optimise.task import Task
from stiffopt.paths.candidates import candidates, lanes
from stiffopt.paths.path import Path
from stiffopt.paths.points import BodyCheck, PathCandidate, PathTasks
from stiffopt.paths.rates import least_times, slew_limits, step_limits
from stiffopt.paths.refinement import refined
from stiffopt.paths.relaxation import relaxed
from stiffopt.paths.route import Route, RouteSearch
from stiffopt.paths.settings import RATES, ROUTE
from stiffopt.paths.solution import PathSolution

Vector = NDArray[np.float64]


def solve_path(
    robot: Manipulator,
    path: Path,
    *,
    seed: int = 0,
    timeout: float | None = None,
    cancel: Cancel | None = None,
) -> PathSolution:
    """Find pressures over time with which the tip follows a path, as stiff as possible.

    Every point is within its tolerance, the body keeps the clearance of the scene, and no
    pressure changes faster than the rates of robot and path allow.  The solver finds several local
    optima at each point, searches for the best sequence of them (`stiffopt.paths.route`), and then
    optimises neighbouring points together where rates bind (`stiffopt.paths.refinement`).

    Parameters
    ----------
    robot : Manipulator
    path : Path
    seed : int
        Of the searches.  The same seed gives the same answer.
    timeout, cancel : optional
        As for `PressureSolver.solve`; the status is then "failed".

    Raises
    ------
    InputError
        The path does not suit the robot: its limits, its scene, or given pressures at an end that
        do not reach the end point.  A path that cannot be followed raises nothing: the solution
        says where and why, and holds the nearest path that can be followed.
    """
    if not isinstance(robot, Manipulator):
        raise InputError(f"robot must be a Manipulator, see load_robot; got {shown(robot)}")
    if not isinstance(path, Path):
        raise InputError(f"path must be a Path, see load_path; got {shown(path)}")
    watch = Stopwatch()
    with giving_up(timeout, cancel):
        solution = _PathSolver(robot, path, seed).solve()
    solution.timings.update(watch.timings())
    return solution


class _PathSolver:
    """One path on one arm."""

    def __init__(self, robot: Manipulator, path: Path, seed: int) -> None:
        self._robot, self._path, self._seed = robot, path, seed
        self._points = path.points()
        self._tasks = [
            path.task(target, goal)
            for target, goal in zip(self._points.targets, self._points.goals, strict=True)
        ]
        self._ends = path.end_pressures(robot.description)
        self._slew = slew_limits(robot.description, path.pressure.slew)
        self._over = "mean" if path.stiffness is None else path.stiffness.over
        self._unreachable: tuple[int, str] | None = None  # the first point, and why
        self._further: list[list[PathCandidate]] = [[] for _ in self._tasks]
        self._body: BodyCheck | None = None

    def solve(self) -> PathSolution:
        """Answer; see `solve_path`."""
        if len(self._tasks) > RATES.few_points:  # enough points to wait for machine code
            PressureSolver(self._robot, self._tasks[0], seed=self._seed).compile()
        tasks = PathTasks(self._robot, self._tasks, self._seed)
        self._check_ends(tasks)
        try:
            layers, starts = candidates(tasks)
            tasks, layers = self._with_reachable(tasks, layers)
            for index, pressures in ((0, self._ends[0]), (-1, self._ends[1])):
                if pressures is not None:
                    index %= len(layers)
                    layers[index] = [
                        PathCandidate(pressures, self._value_at(tasks, index, pressures))
                    ]
            return self._answer(tasks, layers, starts)
        except StoppedError as error:
            return self._failed(str(error))
        except EquilibriumError as error:
            return self._failed(str(error))

    # -- ends and unreachable points -----------------------------------------------------------

    def _check_ends(self, tasks: PathTasks) -> None:
        """Refuse given pressures at an end of the path that do not solve its task."""
        for key, index, pressures in (
            ("start", 0, self._ends[0]),
            ("end", len(self._tasks) - 1, self._ends[1]),
        ):
            if pressures is None:
                continue
            judgement = tasks.judged_at(index, pressures)
            if judgement is not None and judgement.pose_holds and judgement.is_clear:
                continue
            where = "the arm does not stand at these pressures"
            if judgement is not None and not judgement.pose_holds:
                terms = tasks.programs[index].terms
                off = [
                    term.words(judgement.errors[term.name])
                    for term in terms
                    if not term.holds(judgement.errors[term.name])
                ]
                where = f"the tip is {' and '.join(off)} off that point"
            elif judgement is not None:
                where = f"the body is too near to '{next(iter(judgement.intruders))}'"
            raise self._path.error_at(
                f"{key}.pressures",
                f"are not at the {'first' if index == 0 else 'last'} point of the path: {where}; "
                "give pressures that are, or none, and plan a motion there (stiffopt plan)",
            )

    def _value_at(self, tasks: PathTasks, index: int, pressures: Vector) -> float:
        judgement = tasks.judged_at(index, pressures)
        assert judgement is not None  # the ends were checked
        return tasks.value(index, judgement, pressures)

    def _with_reachable(
        self, tasks: PathTasks, layers: list[list[PathCandidate]]
    ) -> tuple[PathTasks, list[list[PathCandidate]]]:
        """Return tasks and candidates in which unreachable points are moved to the nearest pose."""
        moved = list(self._tasks)
        closest: dict[int, Vector] = {}
        for index, layer in enumerate(layers):
            if layer:
                continue
            solution = PressureSolver(self._robot, self._tasks[index], seed=self._seed).solve()
            if solution.found and solution.pressures is not None:
                candidate = tasks.candidate(index, solution.pressures)
                layers[index] = [] if candidate is None else [candidate]
                continue
            if solution.status == "failed" or solution.tip_position is None:
                raise EquilibriumError(f"{self._name(index)}: {solution.message}")
            if self._unreachable is None:
                self._unreachable = index, solution.message
            moved[index] = _at_tip(self._tasks[index], solution)
            if solution.pressures is not None:
                closest[index] = solution.pressures
        if self._unreachable is None:
            return tasks, layers
        nearest = PathTasks(self._robot, moved, self._seed)
        found, _ = candidates(nearest)
        for index, layer in enumerate(found):
            if not layer:  # on the border of the reachable workspace
                found[index] = list(layers[index])
                own = nearest.candidate(index, closest[index]) if index in closest else None
                found[index] += [] if own is None else [own]
        return nearest, found

    # -- the answer ----------------------------------------------------------------------------

    def _answer(
        self, tasks: PathTasks, layers: list[list[PathCandidate]], starts: int
    ) -> PathSolution:
        alone = np.array([max((c.value for c in layer), default=np.nan) for layer in layers])
        times = self._points.times
        slowed = 1.0
        steps = self._steps(tasks, times)
        routes = self._best_routes(tasks, layers, steps)
        stuck = None
        if not routes and times is not None and all(layers):
            stuck = len(self._search(tasks, layers, steps).beginning()) - 1
            slowed, routes = self._slower(tasks, layers, steps)
            if routes:
                times, steps = times * slowed, steps * slowed
        if not routes:
            return self._without_route(tasks, layers, steps, alone)
        route, pressures = self._refined(tasks, routes, steps, alone)
        if times is None:
            times = self._fastest(pressures)
        if self._unreachable is not None:  # judge by the original tasks
            tasks = PathTasks(self._robot, self._tasks, self._seed)
        solution = self._judged(tasks, pressures, times, alone)
        branches = max(map(len, layers))
        confidence = (
            f"{starts} starts found at most {branches} local optima at a point; "
            f"the best sequence crosses between branches at full rate {route.crossings} times"
        )
        solution = replace(solution, confidence=confidence)
        if stuck is not None:
            return self._too_fast(solution, stuck, slowed)
        return solution

    def _steps(self, tasks: PathTasks, times: Vector | None) -> Vector:
        """Return the largest changes (N - 1, n) of the pressures from point to point."""
        if times is None or self._slew is None:
            return np.tile(RATES.largest_step * tasks.unit, (len(tasks) - 1, 1))
        return step_limits(times, self._slew)

    def _refined(
        self, tasks: PathTasks, routes: Sequence[Route], steps: Vector, alone: Vector
    ) -> tuple[Route, Vector]:
        """Return the sequence that is best when refined, and its pressures.

        Others are refined only if the first does not become about as stiff as single points.
        """
        join = np.min if self._over == "worst" else np.mean
        found: list[tuple[float, Route, Vector]] = []
        for route in routes:
            pressures = route.pressures
            if route.value(self._over) > join(alone) + np.log(ROUTE.nearly_all):
                return route, pressures
            pressures = refined(
                tasks, pressures, steps, self._over, self._fixed, self._body_check(tasks)
            )
            slopes = tasks.slopes(range(len(tasks)), pressures)
            value = -np.inf if slopes is None else float(join(-slopes.costs.max(axis=1)))
            found.append((value, route, pressures))
            if value > join(alone) + np.log(ROUTE.enough):
                break
        return max(found, key=lambda each: each[0])[1:]

    def _best_routes(
        self,
        tasks: PathTasks,
        layers: list[list[PathCandidate]],
        steps: Vector,
        *,
        any_will_do: bool = False,
    ) -> list[Route]:
        """Return the best sequences, with further configurations if local optima do not suffice."""
        if not all(layers):
            return []
        has_scene = self._path.scene is not None
        known: list[Route] = []
        is_last = any_will_do
        for attempt in range(len(ROUTE.widths) + 1):
            search = self._search(tasks, layers, steps)
            rounds = ROUTE.first_rounds
            if is_last and not any_will_do:
                rounds = ROUTE.rounds
                if has_scene:
                    rounds = ROUTE.few_rounds if known else ROUTE.rounds_in_scene
            share = ROUTE.enough if attempt else None
            best = search.best(rounds, share=share, any_will_do=any_will_do)
            if best is not None:
                own = search.layers.best
                best = relaxed(tasks, best, steps, own, self._fixed, self._body_check(tasks))
                if any_will_do or search.comes_up_to(best, ROUTE.enough):
                    return [best]
            known += [each for each in (best, search.first) if each is not None]
            known.sort(key=lambda each: -each.value(self._over))
            if is_last:
                break
            regions = search.gaps(known[0] if known else None, attempt)
            is_whole = len(regions[0]) == len(tasks)
            is_last = attempt == len(ROUTE.widths) - 1 or (attempt > 0 and is_whole)
            self._set_lanes(tasks, layers, regions, attempt, is_last, known[:1])
        # another one, once refined, may become better than the best
        return known[: 1 if has_scene else ROUTE.refined]

    def _search(
        self, tasks: PathTasks, layers: Sequence[Sequence[PathCandidate]], steps: Vector
    ) -> RouteSearch:
        """Return a search over local optima and the further candidates that there are."""
        body, closed = self._body_check(tasks), self._path.closed
        return RouteSearch(
            tasks, layers, steps, self._over, self._further, is_closed=closed, body=body
        )

    @property
    def _fixed(self) -> list[int]:
        """Points at which the pressures are given."""
        ends = zip((0, len(self._tasks) - 1), self._ends, strict=True)
        return [index for index, end in ends if end is not None or self._path.closed]

    def _body_check(self, tasks: PathTasks) -> BodyCheck | None:
        """Return the check of the body between points; None without a scene or machine code."""
        if self._path.scene is None or not tasks.is_compiled:
            return None
        if self._body is None:
            self._body = BodyCheck(tasks.robot, self._path.scene)
        return self._body

    def _set_lanes(
        self,
        tasks: PathTasks,
        layers: Sequence[Sequence[PathCandidate]],
        regions: Sequence[range],
        attempt: int,
        is_last: bool,
        known: Sequence[Route],
    ) -> None:
        """Add further candidates in regions of the path, none where the pressures are given.

        They replace earlier ones once a sequence is known, which is kept.
        """
        least = -np.inf
        if known:
            self._further = [[] for _ in layers]
            least = known[0].value("worst") if self._over == "worst" else least
        for region in regions:
            for index, new in enumerate(lanes(tasks, layers, region, attempt, is_last)):
                if index not in self._fixed:
                    self._further[index] += [each for each in new if each.value > least]
        for route in known:
            for index, each in enumerate(route.candidates):
                self._further[index].append(each)

    def _slower(
        self, tasks: PathTasks, layers: list[list[PathCandidate]], steps: Vector
    ) -> tuple[float, list[Route]]:
        """Find the smallest slow-down, to 5 %, with which the path can be followed, and how."""
        few = ROUTE.few_further  # with long steps, every candidate has steps to every other
        self._further = [some[:: 1 + len(some) // few] for some in self._further]
        follow = partial(self._best_routes, tasks, layers)
        factor, low = float((tasks.unit / steps).max()), 1.0
        routes = follow(steps=steps * factor, any_will_do=True) if factor > 1 else []
        while routes and factor / low > 1.05:
            middle = (low * factor) ** 0.5
            quicker = follow(steps=steps * middle, any_will_do=True)
            if quicker:
                factor, routes = middle, quicker
            else:
                low = middle
        return factor, routes and (follow(steps=steps * factor) or routes)

    def _fastest(self, pressures: Vector) -> Vector:
        """Return the earliest times (N,) of the points that the rates allow."""
        if self._slew is None:
            raise self._path.error_at(
                "timing.fastest", "needs to know the rates; give pressure.slew here or in the robot"
            )
        least = np.maximum(least_times(pressures, self._slew), RATES.least_time)
        return np.concatenate([[0.0], np.cumsum(least)])

    # -- judgement ------------------------------------------------------------------------------

    def _judged(
        self, tasks: PathTasks, pressures: Vector, times: Vector, alone: Vector
    ) -> PathSolution:
        """Return the solution at pressures (N, n), judged by the model against the path's tasks."""
        judgements = tasks.judged(pressures)
        known = [j for j in judgements if j is not None]
        if len(known) < len(judgements):
            index = judgements.index(None)
            return self._failed(f"{self._name(index)}: the arm has no stable equilibrium there")
        measured = self._path.stiffness is not None
        stiffness = np.array([min(j.stiffnesses) for j in known]) if measured else None
        if stiffness is not None:
            alone = np.fmax(np.exp(alone), stiffness)
        scene = self._path.scene
        solution = PathSolution(
            status="solved",
            message="",
            robot=tasks.robot,
            times=times,
            pressures=pressures,
            tip_poses=np.stack([j.tip_pose for j in known]),
            slew=self._slew,
            stiffness=stiffness,
            stiffness_unit=tasks.tasks[0].measures[0].unit if measured else None,
            alone=alone if measured else None,
            position_errors=_errors(known, "position"),
            angle_errors=_errors(known, "angle"),
            clearance=None if scene is None else tasks.robot.clearance(pressures, scene),
        )
        wrong = [i for i, j in enumerate(known) if not j.holds]
        if self._unreachable is not None:
            index, why = self._unreachable
            message = (
                f"{self._cannot_be_reached(index, why)}. "
                "The nearest path that can be followed is given."
            )
            return replace(solution, status="unreachable", message=message, first_failure=index)
        if wrong:
            message = f"{self._name(wrong[0])} does not hold: {_what_is_wrong(known[wrong[0]])}"
            return replace(solution, status="unreachable", message=message, first_failure=wrong[0])
        if self._slew is not None and self._points.times is not None:
            limits = step_limits(times, self._slew)
            assert (np.abs(np.diff(pressures, axis=0)) <= limits * (1 + 1e-6) + 1e-6).all()
        blocked = self._blocked(tasks, solution)
        if blocked is not None:
            index, message = blocked
            return replace(solution, status="unreachable", message=message, first_failure=index)
        return replace(solution, message=self._notes(solution))

    def _blocked(self, tasks: PathTasks, solution: PathSolution) -> tuple[int, str] | None:
        """Return the first point after which the body is too near the scene, and the message."""
        scene, p = self._path.scene, solution.pressures
        if scene is None or len(p) < 2:
            return None
        body = self._body or BodyCheck(tasks.robot, scene)
        whole = body.motion(p)
        if whole.clear:
            return None
        found = ((k, body.motion(p[k : k + 2])) for k in range(len(p) - 1))
        index, motion = next(((k, each) for k, each in found if not each.clear), (0, whole))
        between = f"Between points {index + 1} and {index + 2}"
        if not np.isfinite(motion.least):
            return index, f"{between} the arm has no stable equilibrium, or snaps to another."
        length = display_units().length
        return index, (
            f"{between} the clearance of the body falls to {length.text(motion.least, '.3g')}; "
            f"the scene asks for {length.text(scene.clearance, 'g')}. With more points, or lower "
            "rates, it may keep clear."
        )

    def _notes(self, solution: PathSolution) -> str:
        """Return remarks for the user on a path that can be followed."""
        notes: list[str] = []
        if self._slew is None:
            notes.append("No rate of change is known, of the robot or of the path; none was kept.")
        middle = (solution.pressures[1:] + solution.pressures[:-1]) / 2
        if len(middle) and self._points.targets[0].position is not None:
            lengths = self._points.lengths[: len(solution.pressures)]
            lengths = (lengths[1:] + lengths[:-1]) / 2
            tips = solution.robot.tip_pose(middle)[:, :3, 3]
            off = np.linalg.norm(tips - self._points.at(lengths), axis=1)
            index, allowed = int(off.argmax()), self._path.tolerance.position
            if off[index] > 2 * allowed:
                error = display_units().length.text(off[index], ".2g")
                notes.append(
                    f"Between points {index + 1} and {index + 2} the tip is up to {error} off the "
                    "path; with more points, or lower rates, it stays nearer."
                )
        return " ".join(notes)

    def _too_fast(self, solution: PathSolution, index: int, slowed: float) -> PathSolution:
        along = display_units().length.text(self._points.lengths[index])
        message = (
            f"The path is too fast for the rates: beyond point {index + 1} of {len(self._tasks)} "
            f"({along} along it) no pressures keep them"
            f"{self._binding(solution)}. It can be followed {slowed:.3g} times slower, as given."
        )
        if solution.status != "solved":
            return solution
        return replace(solution, status="unreachable", message=message, first_failure=index)

    def _binding(self, solution: PathSolution) -> str:
        """Name the channel that uses most of its rate."""
        if self._slew is None:
            return ""
        rates = np.abs(np.diff(solution.pressures, axis=0)) / np.diff(solution.times)[:, np.newaxis]
        share = rates / self._slew
        channel = int(np.unravel_index(share.argmax(), share.shape)[1])
        name = self._robot.description.channel_name(channel)
        rate = display_units().pressure.text(self._slew[channel], "g")
        return f"; {name} with {rate}/s holds it back most"

    def _without_route(
        self, tasks: PathTasks, layers: list[list[PathCandidate]], steps: Vector, alone: Vector
    ) -> PathSolution:
        """Return the answer when no sequence was found: the path up to where it ends."""
        empty = next((i for i, layer in enumerate(layers) if not layer), None)
        if self._unreachable is not None:
            point, why = self._unreachable
            message = f"{self._cannot_be_reached(point, why)}, and no path near it can be followed"
            unreachable = replace(self._failed(message), status="unreachable")
            return replace(unreachable, first_failure=point)
        if empty is not None:
            return self._failed(f"{self._name(empty)}: no pressures were found near the target")
        begin = self._search(tasks, layers, steps).beginning()
        index, pressures = len(begin) - 1, np.array([each.pressures for each in begin])
        message = f"{self._name(index)} is the last that pressures were found to follow"
        least = self._clearance_beyond(layers, pressures, steps)
        scene = self._path.scene
        if scene is not None and least is not None:
            length = display_units().length
            message += (
                f" with the body clear. Between points {index + 1} and {index + 2} the clearance "
                f"of the body falls to {length.text(least, '.3g')}; the scene asks for "
                f"{length.text(scene.clearance, 'g')}"
            )
        else:
            message += " without a jump"
            if scene is not None:
                near = tasks.robot.clearances(pressures[-1], scene)
                message += f", and clear of '{near.names[int(np.argmin(near.distances))]}'"
            message += (
                ": beyond it the arm would have to change to another configuration while the tip "
                "stays on the path"
            )
        times = self._points.times
        times = self._fastest(pressures) if times is None else times[: len(begin)]
        solution = self._judged(tasks, pressures, times, alone[: len(begin)])
        message += ". The path up to there is given."
        return replace(solution, status="unreachable", message=message, first_failure=index)

    def _clearance_beyond(
        self, layers: Sequence[Sequence[PathCandidate]], pressures: Vector, steps: Vector
    ) -> float | None:
        """Return the largest clearance with which steps go on after the last of some points.

        None without a scene, or if the rates allow no step.
        """
        index, last = len(pressures) - 1, pressures[-1]
        next_ones = [*layers[index + 1], *self._further[index + 1]]
        near = [p for p, _ in next_ones if (np.abs(p - last) <= steps[index]).all()]
        if self._body is None or not near:
            return None
        return max(self._body.motion(np.array([last, p])).least for p in near)

    def _failed(self, message: str) -> PathSolution:
        n = self._robot.n_pressures
        none = np.zeros((0, n))
        return PathSolution(
            "failed", message, self._robot, np.zeros(0), none, np.zeros((0, 4, 4)), self._slew
        )

    def _cannot_be_reached(self, index: int, why: str) -> str:
        return f"{self._name(index)} cannot be reached: {why.removeprefix('unreachable: ')}"

    def _name(self, index: int) -> str:
        along = display_units().length.text(self._points.lengths[index])
        return f"point {index + 1} of {len(self._tasks)} ({along} along the path)"


def _at_tip(task: Task, solution: PressureSolution) -> Task:
    """Return the task with a solution's tip pose as its target."""
    assert solution.tip_position is not None
    assert solution.tip_pose is not None
    target = task.target
    parts: dict[str, object] = {}
    if target.position is not None:
        pairs = zip(target.position, solution.tip_position.tolist(), strict=True)
        parts["position"] = tuple(None if axis is None else own for axis, own in pairs)
    if target.pointing is not None:
        parts["pointing"] = tuple(solution.tip_pose[:3, 2].tolist())
    if target.orientation is not None and solution.tip_quaternion is not None:
        parts["orientation"] = tuple(solution.tip_quaternion.tolist())
    return task.model_copy(update={"target": target.model_copy(update=parts)})


def _errors(judgements: Sequence[Judgement], name: str) -> Vector | None:
    if name not in judgements[0].errors:
        return None
    return np.array([judgement.errors[name] for judgement in judgements])


def _what_is_wrong(judgement: Judgement) -> str:
    if not judgement.is_clear:
        name, missing = max(judgement.intruders.items(), key=lambda item: item[1])
        return f"the body is {display_units().length.text(missing, '.3g')} too near to '{name}'"
    if not judgement.limits_hold:
        return "a pressure is beyond its limits"
    return "the tip is off its target"
