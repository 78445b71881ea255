"""The functions of a task structure on one arm: machine code where that can be had."""

from collections.abc import Hashable
from functools import cached_property, partial
from pathlib import Path

import casadi as ca

from stiffopt.model.batch import BatchFunction, InterpretedFunction
from stiffopt.model.compiled import Library, library
from stiffopt.model.layout import Layout, free_tip_function
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.program import Program

_SOURCES = (str(Path(__file__).with_name("native") / "solver.c"),)
_COMPILED = ("pose", "point", "judge")
_MOST_MEASURES = 6  # of more, code takes too long to compile: the general method serves them


class Functions:
    """Those of `Program`, on the inputs of the tip's shape and `Arm.parameters` of the program's.

    From the library, or each made in the CasADi VM when it is first asked for.
    """

    def __init__(self, robot: Manipulator, program: Program) -> None:
        self._robot = robot
        self._program = program
        self._library: Library | None = None

    @property
    def library(self) -> Library | None:
        """Machine code of an arm without loads, with the compiled solver; None for the VM."""
        robot, program = self._robot, self._program
        if (
            self._library is None
            and not robot.is_loaded
            and len(program.measures) <= _MOST_MEASURES
        ):
            content = (robot.layout.skeleton, program.structure)
            make = partial(_free_functions, robot.layout, program)
            self._library = library(content, make, _SOURCES, daqp=True)
        return self._library

    @cached_property
    def pose(self) -> BatchFunction:
        """See `Program.pose`."""
        return self._function("pose")

    @cached_property
    def point(self) -> BatchFunction:
        """See `Program.point`."""
        return self._function("point")

    @cached_property
    def judge(self) -> BatchFunction:
        """See `Program.judge`."""
        return self._function("judge")

    @cached_property
    def worth(self) -> BatchFunction | None:
        """See `Program.worth`; None where `point` takes hardly longer than a call."""
        return None if self.library or self._robot.is_loaded else self._function("worth")

    def _function(self, name: str) -> BatchFunction:
        if self.library is not None:
            return self.library.function(name)
        outputs = getattr(self._program, name)
        if self._robot.is_loaded:
            formula = self._robot.tip_function(name, outputs, self._program.n_parameters)
            return InterpretedFunction(formula)
        return _interpreted(self._robot.layout, self._program.structure, name, self._program)


def _free_functions(layout: Layout, program: Program) -> list[ca.Function]:
    return [_formula(layout, program, name) for name in _COMPILED]


def _formula(layout: Layout, program: Program, name: str) -> ca.Function:
    return free_tip_function(layout, name, getattr(program, name), program.n_parameters)


_in_vm: dict[Hashable, InterpretedFunction] = {}
_MOST_IN_VM = 256


def _interpreted(
    layout: Layout, structure: Hashable, name: str, program: Program
) -> InterpretedFunction:
    """One of the functions in the CasADi VM; arms of one layout share it."""
    key = (layout, structure, name)
    if key not in _in_vm:
        while len(_in_vm) >= _MOST_IN_VM:
            _in_vm.pop(next(iter(_in_vm)), None)
        _in_vm[key] = InterpretedFunction(_formula(layout, program, name))
    return _in_vm[key]


def functions(robot: Manipulator, program: Program) -> Functions:
    """Functions of the program's structure; made once and kept by the robot."""
    key = ("functions", robot.is_loaded, program.structure)
    return robot.kept(key, lambda: Functions(robot, program))
