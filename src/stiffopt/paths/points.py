"""The tasks at the points of a path, solved and evaluated together.

They differ only in target and stiffness direction.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array, Flags
from stiffopt.errors import EquilibriumError
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.motion_clearance import ClearMotions, MotionClearance
from stiffopt.model.scene import Scene
from stiffopt.optimise.fast import CompiledAnswer
from stiffopt.optimise.functions import functions
from stiffopt.optimise.local import descend
from stiffopt.optimise.prepared import prepared
from stiffopt.optimise.problem import PressureProblem
from stiffopt.optimise.program import Constraint, Program, pressure_ranges
from stiffopt.optimise.reach import reach
from stiffopt.optimise.solution import Judgement, are_within, judge
from stiffopt.optimise.task import Task
from stiffopt.paths.settings import RATES


class PathCandidate(NamedTuple):
    """Pressures that solve the task at a point.

    `pressures`: (n,), in Pa. `value`: logarithm of the smallest stiffness that is maximised; if
    none is, the negative mean square of the relative pressures.
    """

    pressures: Array
    value: float


class Local(NamedTuple):
    """A local search at a point, from a guess and within limits, in Pa."""

    point: int
    guess: Array
    lower: Array
    upper: Array


class Brought(NamedTuple):
    """Pressures (k, n) brought to targets, in Pa, and their values (k,) as in `PathCandidate`.

    A value is minus infinity where the target was not reached.
    """

    pressures: Array
    values: Array

    @property
    def arrived(self) -> Flags:
        """Which of them (k,) reached their targets."""
        return np.isfinite(self.values)


class Slopes(NamedTuple):
    """The tasks at k points, linearised; derivatives are per share of a channel's range.

    `residuals` (k, m), `jacobians` (k, m, n): of the terms. `costs` (k, t), `gradients` (k, t, n):
    negative logarithms of the stiffnesses; the largest of each point is minimised.
    """

    residuals: Array
    jacobians: Array
    costs: Array
    gradients: Array


def joined(ranges: Iterable[range]) -> list[range]:
    """Return ranges of points, in order of their starts, with those joined that overlap or meet."""
    found: list[range] = []
    for each in ranges:
        if found and each.start <= found[-1].stop:
            found[-1] = range(found[-1].start, max(each.stop, found[-1].stop))
        else:
            found.append(each)
    return found


class BodyCheck:
    """Checks that the body keeps the clearance of a scene between the points of a path.

    `robot`: with its load.
    """

    def __init__(self, robot: Manipulator, scene: Scene) -> None:
        self._robot, self._scene = robot, scene
        self._motions = ClearMotions(robot, scene)
        self._required = scene.clearance - RATES.clearance_between

    def motion(self, pressures: Array) -> MotionClearance:
        """Check the motion along rows of pressures (N, n)."""
        return self._motions.along(pressures, self._required)

    def are_clear(self, pressures: Array) -> Flags:
        """Return whether the body keeps clear at each of the pressures (N, n)."""
        return np.asarray(self._robot.clearance(pressures, self._scene) >= self._required)


class PathTasks:
    """The tasks of a path (at least one), with the same load, scene and limits.

    Attributes
    ----------
    robot : the arm, which carries the load.
    lower, upper, unit : (n,), limits, and ranges of the channels, in Pa.
    is_compiled : whether they are solved by machine code.
    """

    def __init__(self, robot: Manipulator, tasks: Sequence[Task], seed: int) -> None:
        self.tasks, self.scene = tuple(tasks), tasks[0].scene
        # the robot carries the load
        plain = {"load": None}
        self._without_load = [t if t.load is None else t.model_copy(update=plain) for t in tasks]
        self._prepared = prepared(robot, tasks[0], seed)
        self.robot = self._prepared.robot
        self.lower, self.upper = self._prepared.lower, self._prepared.upper
        self.unit = pressure_ranges(robot.description)
        first = Program.of(tasks[0], robot.description)
        self.programs = [
            replace(
                first,
                terms=task.target.terms,
                measures=() if task.stiffness is None else task.stiffness.first,
            )
            for task in tasks
        ]
        self._fast = self._prepared.fast(first)
        self.is_compiled = self._fast is not None
        self._functions = functions(self.robot, self.programs[0])
        self._rows: dict[int, Array] = {}

    @cached_property
    def body(self) -> BodyCheck | None:
        """The check of the body between points; None without a scene or machine code."""
        if self.scene is None or not self.is_compiled:
            return None
        return BodyCheck(self.robot, self.scene)

    @cached_property
    def _all_rows(self) -> Array:
        """The rows (N, w) of all points."""
        return np.array([self._row(index) for index in range(len(self))])

    @cached_property
    def _parameters(self) -> Array:
        """Parameters of the compiled functions at each point."""
        return np.array([self.robot.parameters(each.parameters) for each in self.programs])

    @cached_property
    def own_constraints(self) -> list[Constraint]:
        """The bounds on the residuals but those of obstacles; their radii are those at point 0."""
        first = self.programs[0]
        return [c for c in first.constraints(self.robot.length) if c.first < first.n_own_rows]

    @cached_property
    def radii(self) -> Array:
        """Radii (N, c) of the own constraints at each point."""
        count = len(self.own_constraints)
        return np.array([each.radii[:count] for each in self.programs])

    def __len__(self) -> int:
        return len(self.tasks)

    def near(self, index: int, count: int) -> Array:
        """Return the sampled pressures (count, n) whose tips are nearest to a point's target."""
        table = self._prepared.samples
        distances = table.distances(self.programs[index].terms, self.robot.length)
        return table.pressures[table.nearest_first(distances, count)]

    # -- local optima -----------------------------------------------------------------------

    def locals(self, questions: Sequence[Local]) -> list[PathCandidate | None]:
        """Return the local optima near guesses; None where the search finds no valid one."""
        if self._fast is None:
            return [self._general(question) for question in questions]
        solver = self._fast[0]
        rows = [solver.next_to(self._row(q.point), q.guess, q.lower, q.upper) for q in questions]
        if not rows:
            return []
        threads = None if len(rows) > 64 else 1  # starting threads costs as much as several answers
        pressures, values = solver.optima(np.stack(rows), threads)
        pairs = zip(pressures, (-values).tolist(), strict=True)
        return [PathCandidate(p, value) if value > -np.inf else None for p, value in pairs]

    def bests(self, indices: Sequence[int]) -> list[PathCandidate | None]:
        """Return the best candidate that a global search finds at each point, or None."""
        if self._fast is None:
            return [None for _ in indices]
        rows = np.stack([self._row(index) for index in indices])
        answers = self._fast[0].solve_all(rows)
        return [
            None if a is None else self.accepted(i, a.pressures, self._judgement(i, a))
            for i, a in zip(indices, answers, strict=True)
        ]

    def _row(self, index: int) -> Array:
        """Return the numbers of a point's task, as machine code expects them."""
        if index not in self._rows:
            assert self._fast is not None
            solver, program = self._fast[0], self.programs[index]
            row = solver.row(program, self.lower, self.upper, np.zeros(0))
            self._rows[index] = solver.with_target(row, program, None)
        return self._rows[index]

    def _judgement(self, index: int, answer: CompiledAnswer) -> Judgement:
        within = are_within(answer.pressures, self.lower, self.upper)
        return Judgement.of(self.programs[index], answer.judged, within)

    def accepted(
        self, index: int, pressures: Array, judgement: Judgement | None
    ) -> PathCandidate | None:
        """Return judged pressures (n,) as a candidate at a point, or None if they miss its task."""
        if judgement is None or not judgement.holds:
            return None
        program = self.programs[index]
        if program.measures:
            return PathCandidate(pressures, float(np.log(min(judgement.stiffnesses))))
        return PathCandidate(pressures, -float(np.mean((pressures / program.reference) ** 2)))

    def _general(self, question: Local) -> PathCandidate | None:
        """Search a local optimum without machine code."""
        index = question.point
        problem = PressureProblem(self.robot, self._without_load[index])
        problem.lower, problem.upper = question.lower / self.unit, question.upper / self.unit
        x = np.clip(question.guess / self.unit, problem.lower, problem.upper)
        try:
            point = reach(problem, x)
            if point is None or not point.reached:
                return None
            result = descend(problem, point)
        except EquilibriumError:
            return None
        if not result.point.reached:
            return None
        pressures = np.clip(result.point.x * self.unit, question.lower, question.upper)
        return self.candidate(index, pressures)

    # -- evaluation -------------------------------------------------------------------------

    def brought(self, indices: NDArray[np.intp], pressures: Array) -> Brought:
        """Bring pressures (k, n) to the targets of points (k,) nearby, clear of the scene.

        They need not be optimal there.  Without machine code, none arrives.
        """
        if self._fast is None or not len(indices):
            return Brought(pressures, np.full(len(pressures), -np.inf))
        found, objectives = self._fast[0].brought(self._all_rows[indices], pressures)
        return Brought(found, -objectives)

    def judged(self, pressures: Array) -> list[Judgement | None]:
        """Judge pressures (N, n), one row for each point; None where there is no equilibrium."""
        if self._fast is None:
            return [self.judged_at(index, p) for index, p in enumerate(pressures)]
        solver = self._fast[0]
        rows = [solver.judging(self._row(index), p) for index, p in enumerate(pressures)]
        answers = enumerate(solver.solve_all(np.stack(rows)))
        return [answer and self._judgement(index, answer) for index, answer in answers]

    def judged_at(self, index: int, pressures: Array) -> Judgement | None:
        """Judge pressures (n,) at one point; None if there is no equilibrium."""
        try:
            return judge(self.robot, self._without_load[index], pressures)
        except EquilibriumError:
            return None

    def candidate(self, index: int, pressures: Array) -> PathCandidate | None:
        """Return pressures (n,) as a candidate at a point, or None if they miss its task."""
        return self.accepted(index, pressures, self.judged_at(index, pressures))

    def hold(self, slopes: Slopes) -> bool:
        """Return whether all points are within their tolerances, by the slopes of all points."""
        for c, radii in zip(self.own_constraints, self.radii.T, strict=True):
            r = slopes.residuals[:, c.first : c.end]
            sizes = r[:, 0] if c.one_sided else np.linalg.norm(r, axis=1)
            if (sizes > radii).any():
                return False
        return True

    def slopes(self, indices: Sequence[int], pressures: Array) -> Slopes | None:
        """Linearise the tasks at some points about pressures (k, n); None without equilibrium."""
        if self.robot.is_loaded:
            parts = [self._loaded(i, p) for i, p in zip(indices, pressures, strict=True)]
            known = [part for part in parts if part is not None]
            if len(known) < len(parts):
                return None
            return Slopes(*(np.stack(each) for each in zip(*known, strict=True)))
        point = self._functions["point"]
        parameters = self._parameters[np.asarray(indices)]
        residuals, jacobians, costs, gradients = point.many(pressures, parameters)[:4]
        return Slopes(
            residuals[..., 0],
            jacobians.swapaxes(1, 2) * self.unit,
            costs[..., 0],
            gradients.swapaxes(1, 2) * self.unit,
        )

    def _loaded(self, index: int, pressures: Array) -> tuple[Array, ...] | None:
        """Return `Slopes` at one point of a loaded arm; None if it has no equilibrium."""
        program = self.programs[index]
        if self._fast is not None:
            parameters = self.robot.parameters(program.parameters)
            found = self._fast[0].point(parameters, np.array(program.radii), pressures)
            if found is None:
                return None
            own = slice(program.n_own_rows)
            return found[0][own], found[1][own], found[2], found[3]
        task = self._without_load[index].model_copy(update={"scene": None})
        try:
            point = PressureProblem(self.robot, task).point(pressures / self.unit)
        except EquilibriumError:
            return None
        return point.residual, point.jacobian, point.terms, point.term_gradients
