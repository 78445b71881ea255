"""`Prepared`: limits, samples and compiled solvers that tasks with different targets share."""

from collections.abc import Callable, Hashable
from functools import cached_property
from typing import TypeVar

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError
from stiffopt.model.arm_clearance import SceneKey
from stiffopt.model.compiled import Library
from stiffopt.model.loaded_arm import LoadedArm
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.fast import FastSolver
from stiffopt.optimise.functions import functions
from stiffopt.optimise.problem import floor_bounds
from stiffopt.optimise.program import Program
from stiffopt.optimise.samples import SampleTable
from stiffopt.optimise.settings import KEPT, SAMPLES
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task

Made = TypeVar("Made")


class Prepared:
    """Limits, samples and compiled solvers of similar tasks on one arm.

    Attributes
    ----------
    robot : the arm, which carries the task's load.
    lower, upper : (n,), pressure limits in Pa.
    unit : unit of the task's first stiffness.
    """

    def __init__(self, robot: Manipulator, task: Task, seed: int) -> None:
        self.robot = task.loaded(robot)
        task.check_scene(robot.description)
        self.lower, self.upper = task.pressure_bounds(robot.description)
        self._program = Program.of(task, robot.description)
        self._floors = floor_bounds(task.stiffness)
        self.unit = task.measures[0].unit if task.measures else None
        self._seed = seed
        limits = (self.lower.tobytes(), self.upper.tobytes())
        self._key = (self.robot.tip_load, *limits, seed)
        self._scene = None if task.scene is None else SceneKey(task.scene)
        self._rows: dict[tuple[Hashable, ...], tuple[FastSolver, Array] | None] = {}

    def program(self, target: Target) -> Program:
        """Return the program of a task with this target."""
        return self._program.at(target)

    def fast(self, program: Program) -> tuple[FastSolver, Array] | None:
        """Return the compiled solver and a task's row without its target; None if there is none."""
        terms = tuple(term.structure for term in program.terms)  # the rest is the same for all
        if terms not in self._rows:
            library = functions(self.robot, program).library
            if library is None:
                return None  # not cached: another thread may be compiling
            solver = self._solver(library, program)
            found = None
            if solver is not None:
                found = solver, solver.row(program, self.lower, self.upper, self._floors)
            self._rows[terms] = found
        return self._rows[terms]

    def _solver(self, library: Library, program: Program) -> FastSolver | None:
        """Return the compiled solver; None for a loaded arm without equilibrium at rest."""
        if not self.robot.is_loaded:
            return _recent(
                self.robot, "fast solvers", (program.structure, self._key, self._scene),
                lambda: self._among(library, program),
            )  # fmt: skip
        table = _recent(self.robot, "loaded arms", self._key, lambda: self._loaded_samples(library))
        if table is None:
            return None
        solver = FastSolver(library, self.robot, program, table)
        return solver.among(program.obstacles, self.robot) if program.obstacles else solver

    def _among(self, library: Library, program: Program) -> FastSolver:
        """Return the compiled solver of a free arm; scenes with as many rows share most of it."""
        obstacles = program.obstacles
        rows = 0 if obstacles is None else len(obstacles.row_objects)
        solver = _recent(
            self.robot, "fast solvers of all scenes", (program.structure, self._key, rows),
            lambda: FastSolver(library, self.robot, program, self.samples),
        )  # fmt: skip
        return solver if obstacles is None else solver.among(obstacles, self.robot)

    def _loaded_samples(self, library: Library) -> SampleTable | None:
        """Sample the arm under its load in machine code; None without an equilibrium at rest."""
        try:
            arm = LoadedArm(library, self.robot)
            table = SampleTable(self.robot, self.lower, self.upper, self._seed, arm)
        except EquilibriumError:
            return None
        return table if len(table.pressures) else None

    def samples_to_lean(self, arm: LoadedArm) -> SampleTable:
        """Sample an arm under load more densely, in machine code, to find where it could lean."""
        count = SAMPLES.leaning
        return SampleTable(self.robot, self.lower, self.upper, self._seed, arm, count)

    @cached_property
    def samples(self) -> SampleTable:
        """Configurations from which the general method starts, or any search for a free arm."""
        return _recent(
            self.robot, "samples", self._key,
            lambda: SampleTable(self.robot, self.lower, self.upper, self._seed),
        )  # fmt: skip


def prepared(robot: Manipulator, task: Task, seed: int) -> Prepared:
    """Return the preparation for a task; recent ones are reused.

    Raises `InputError` if the task's pressure limits do not suit the robot.
    """
    scene = None if task.scene is None else SceneKey(task.scene)
    key = (task.stiffness, task.tip_load, task.pressure, scene, robot.tip_load, seed)
    return _recent(robot, "prepared", key, lambda: Prepared(robot, task, seed))


def _recent(robot: Manipulator, group: str, key: Hashable, make: Callable[[], Made]) -> Made:
    """Return a recently made item of a group, or make it.

    The cache is bounded: a planner that varies limits, loads or directions must not fill the
    memory.
    """
    kept: dict[Hashable, tuple[Made]] = robot.kept(group, dict)
    found = kept.get(key)
    if found is None:
        found = kept[key] = (make(),)
        if len(kept) > KEPT.per_arm:
            kept.pop(next(iter(kept)), None)
    return found[0]
