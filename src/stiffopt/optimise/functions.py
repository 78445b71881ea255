"""The functions of a task structure on one arm: machine code where that can be had."""

from functools import cached_property
from pathlib import Path

import casadi as ca

from stiffopt.model.compiled import Library, library
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.native_calls import BatchFunction, InterpretedFunction
from stiffopt.optimise.program import Program

_SOURCES = (str(Path(__file__).with_name("native") / "solver.c"),)
_COMPILED = ("pose", "point", "judge")
_MOST_MEASURES = 6  # of more, code takes too long to compile: the general method serves them


class Functions:
    """Those of `Program`, on the inputs of the tip's shape and `Arm.parameters` of the program's.

    From the library, or each made in the CasADi VM when it is first asked for.

    Attributes
    ----------
    library : Library or None
        Machine code of an arm without loads, with the compiled solver; None for the VM.
    """

    def __init__(self, robot: Manipulator, program: Program) -> None:
        self._robot = robot
        self._program = program
        self.library: Library | None = None
        if not robot.is_loaded and len(program.measures) <= _MOST_MEASURES:
            content = (robot.layout.skeleton, program.structure)
            self.library = library(content, self._symbolic, _SOURCES, daqp=True)

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
        return InterpretedFunction(self._formula(name))

    def _symbolic(self) -> list[ca.Function]:
        return [self._formula(name) for name in _COMPILED]

    def _formula(self, name: str) -> ca.Function:
        outputs = getattr(self._program, name)
        return self._robot.tip_function(name, outputs, self._program.n_parameters)


def functions(robot: Manipulator, program: Program) -> Functions:
    """Functions of the program's structure; made once and kept by the robot."""
    key = ("functions", robot.is_loaded, program.structure)
    return robot.kept(key, lambda: Functions(robot, program))
