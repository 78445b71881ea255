"""The functions of a task structure on one arm: machine code where that can be had."""

from pathlib import Path
from typing import NamedTuple

from stiffopt.model.compiled import Library, interpreted, library
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.native_calls import BatchFunction
from stiffopt.optimise.program import Program

_SOURCES = (str(Path(__file__).with_name("native") / "solver.c"),)


class Functions(NamedTuple):
    """Those of `Program`, on the inputs of the tip's shape and the program's parameters.

    Attributes
    ----------
    pose, point, judge : BatchFunction
    library : Library or None
        Where they come from, with the compiled solver; None for the CasADi VM.
    """

    pose: BatchFunction
    point: BatchFunction
    judge: BatchFunction
    library: Library | None


def functions(robot: Manipulator, program: Program) -> Functions:
    """Functions of the program's structure; made once and kept by the robot."""
    names = ("pose", "point", "judge")

    def make() -> Functions:
        def symbolic() -> list[object]:
            return [
                robot.tip_function(name, getattr(program, name), program.n_parameters)
                for name in names
            ]

        content = (robot.description.model_dump_json(), program.structure)
        code = None if robot.is_loaded else library(content, symbolic, _SOURCES, daqp=True)
        if code is not None:
            pose, point, judge = (code.function(name) for name in names)
            return Functions(pose, point, judge, code)
        in_vm = interpreted(symbolic)
        return Functions(in_vm["pose"], in_vm["point"], in_vm["judge"], None)

    return robot.kept(("functions", robot.is_loaded, program.structure), make)
