"""What tasks have in common that differ in their target only: prepared once, kept by the robot."""

from collections.abc import Callable, Hashable
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import EquilibriumError
from stiffopt.model.compiled import Library
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.fast import FastSolver
from stiffopt.optimise.functions import functions
from stiffopt.optimise.loaded import LoadedArm, loaded_library
from stiffopt.optimise.problem import floor_bounds
from stiffopt.optimise.program import Program, ProgramStructure
from stiffopt.optimise.samples import SampleTable
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task

Vector = NDArray[np.float64]

_MOST_KEPT = 64  # of each kind of thing that varies from task to task

Made = TypeVar("Made")


class Prepared:
    """Limits, starts and compiled solvers of similar tasks on one arm.

    Attributes
    ----------
    robot : Manipulator
        The arm, which carries the task's load.
    lower, upper : ndarray (n,)
        Pressure limits in Pa.
    unit : str or None
        Of the first stiffness.
    """

    def __init__(self, robot: Manipulator, task: Task, seed: int) -> None:
        load = task.load
        self.robot = robot.with_load(load.force, load.moment, load.frame) if load else robot
        self.lower, self.upper = task.pressure_bounds(robot.description)
        self._program = Program.of(task.target, task.stiffness, robot.description)
        self._floors = floor_bounds(task.stiffness)
        self.unit = task.measures[0].unit if task.measures else None
        self._seed = seed
        self._rows: dict[ProgramStructure, tuple[FastSolver, Vector] | None] = {}

    def program(self, target: Target) -> Program:
        """Program of a task with this target."""
        return self._program.at(target)

    def fast(self, program: Program) -> tuple[FastSolver, Vector] | None:
        """Compiled solver and the row of a task without its target; None if there is none."""
        if self.robot.is_loaded and program.has_stations:
            return None  # the integrator in C knows of the tip alone
        structure = program.structure
        if structure not in self._rows:
            loaded = self.robot.is_loaded
            library = (
                loaded_library(self.robot, program)
                if loaded
                else functions(self.robot, program).library
            )
            if library is None:
                return None  # not remembered: another thread may be compiling
            if loaded:
                self._rows[structure] = self._loaded(library, program)
                return self._rows[structure]
            limits = (self.lower.tobytes(), self.upper.tobytes(), self._seed)
            solver = _recent(
                self.robot, "fast solvers", (structure, limits),
                lambda: FastSolver(library, self.robot, program, self.samples),
            )  # fmt: skip
            row = solver.row(program, self.lower, self.upper, self._floors)
            self._rows[structure] = (solver, row)
        return self._rows[structure]

    def _loaded(self, library: Library, program: Program) -> tuple[FastSolver, Vector] | None:
        """The same for an arm under gravity or a load; None if it does not stand at rest."""
        start = self._loaded_start(library)
        if start is None:
            return None
        arm, table = start
        solver = FastSolver(library, self.robot, program, table, arm)
        return solver, solver.row(program, self.lower, self.upper, self._floors)

    def _loaded_start(self, library: Library) -> tuple[LoadedArm, SampleTable] | None:
        """The arm under its load and its samples; None if it does not stand at rest."""
        lower, upper = self.lower, self.upper
        key = (self.robot.tip_load, lower.tobytes(), upper.tobytes(), self._seed)

        def make() -> tuple[LoadedArm, SampleTable] | None:
            try:
                arm = LoadedArm(library, self.robot)
                table = SampleTable(self.robot, lower, upper, self._seed, arm.settled)
            except EquilibriumError:
                return None
            return (arm, table) if len(table.pressures) else None

        return _recent(self.robot, "loaded arms", key, make)

    @cached_property
    def samples(self) -> SampleTable:
        """Configurations that searches start from."""
        lower, upper = self.lower, self.upper
        key = (self.robot.tip_load, lower.tobytes(), upper.tobytes(), self._seed)
        return _recent(
            self.robot, "samples", key, lambda: SampleTable(self.robot, lower, upper, self._seed)
        )


def prepared(robot: Manipulator, task: Task, seed: int) -> Prepared:
    """Preparation for a task; one of the most recent if it will do.

    Raises
    ------
    InputError
        If the task's pressure limits do not suit the robot.
    """
    key = (task.stiffness, task.load, task.pressure, robot.tip_load, seed)
    return _recent(robot, "prepared", key, lambda: Prepared(robot, task, seed))


def _recent(robot: Manipulator, group: str, key: Hashable, make: Callable[[], Made]) -> Made:
    """One of the things that were made last for this arm, or a new one.

    A planner that varies limits, loads or directions must not fill the memory.
    """
    kept: dict[Hashable, tuple[Made]] = robot.kept(group, dict)
    found = kept.get(key)
    if found is None:
        found = kept[key] = (make(),)
        if len(kept) > _MOST_KEPT:
            kept.pop(next(iter(kept)), None)
    return found[0]
