"""The functions of a task's structure on one arm: machine code, or the CasADi VM without it."""

from collections.abc import Hashable
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

import casadi as ca

from stiffopt.model.batch import BatchFunction, InterpretedFunction
from stiffopt.model.body_functions import free_moving_functions, loaded_body_functions
from stiffopt.model.compiled import Library, library
from stiffopt.model.distances import scene_library
from stiffopt.model.layout import Layout, free_tip_function
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.rod import rod_functions
from stiffopt.optimise.loaded import tip_functions
from stiffopt.optimise.program import Program
from stiffopt.optimise.settings import KEPT

_NATIVE = Path(__file__).with_name("native")


class Functions:
    """The functions of `Program`, of the tip's inputs and of `Arm.parameters` of the program's.

    Each is made at its first use: in machine code or, without a compiler, in the CasADi VM.
    """

    def __init__(self, robot: Manipulator, program: Program) -> None:
        self._robot = robot
        self._program = program
        self._library: Library | None = None
        self._made: dict[str, BatchFunction] = {}

    @property
    def library(self) -> Library | None:
        """Machine code with the compiled solver; None if the general method must be used.

        With gravity or loads, the integrator in C supports terms of the tip only.
        """
        robot, program = self._robot, self._program
        if self._library is not None:
            return self._library
        with_body = program.obstacles is not None
        if with_body and scene_library() is None:
            return None
        make, source = _free_functions, "scene_solver.c" if with_body else "solver.c"
        if robot.is_loaded:
            if program.has_stations or rod_functions(robot.layout) is None:
                return None
            make, source = _loaded_functions, f"loaded_{source}"
        elif len(program.measures) > KEPT.most_measures:
            return None
        plain = replace(program, obstacles=None)  # a scene is data, not code
        self._library = library(
            (robot.layout.skeleton, program.structure, source),
            partial(make, robot.layout, plain, with_body), (str(_NATIVE / source),), daqp=True,
        )  # fmt: skip
        return self._library

    def __getitem__(self, name: str) -> BatchFunction:
        """Return ``pose``, ``point`` or ``judge`` of `Program`."""
        if name not in self._made:
            compiled = None if self._robot.is_loaded else self.library
            self._made[name] = compiled.function(name) if compiled else self._interpreted(name)
        return self._made[name]

    @cached_property
    def worth(self) -> BatchFunction | None:
        """See `Program.worth`; None where `point` is hardly slower."""
        return None if self._robot.is_loaded or self.library else self._interpreted("worth")

    def _interpreted(self, name: str) -> InterpretedFunction:
        """Return a function in the CasADi VM; free arms of one layout share it."""
        robot, program = self._robot, self._program
        if robot.is_loaded:
            outputs = getattr(program, name)
            return InterpretedFunction(robot.tip_function(name, outputs, program.n_parameters))
        key = (robot.layout, program.structure, name)
        if key not in _in_vm:
            while len(_in_vm) >= KEPT.in_vm:
                _in_vm.pop(next(iter(_in_vm)), None)
            _in_vm[key] = InterpretedFunction(_free_function(robot.layout, program, name))
        return _in_vm[key]


_in_vm: dict[Hashable, InterpretedFunction] = {}


def _free_function(layout: Layout, program: Program, name: str) -> ca.Function:
    return free_tip_function(layout, name, getattr(program, name), program.n_parameters)


def _free_functions(layout: Layout, program: Program, with_body: bool) -> list[ca.Function]:
    """Return the functions of a free arm's tip, and of its body for a scene."""
    own = [_free_function(layout, program, name) for name in ("pose", "point", "judge")]
    return [*own, *free_moving_functions(layout)] if with_body else own


def _loaded_functions(layout: Layout, program: Program, with_body: bool) -> list[ca.Function]:
    equations = rod_functions(layout)
    assert equations is not None  # see `Functions.library`
    own = [*equations.functions, *tip_functions(program, layout)]
    return [*own, *loaded_body_functions(layout)] if with_body else own


def functions(robot: Manipulator, program: Program) -> Functions:
    """Return the functions of the program's structure; the robot caches them."""
    key = ("functions", robot.is_loaded, program.structure, program.obstacles is not None)
    return robot.kept(key, lambda: Functions(robot, program))
