"""An arm under gravity or loads for the compiled solver: its functions, rod and samples.

The rod is integrated in C (``native/rod.h``) around the small functions of `stiffopt.model.rod`;
pose terms and measures are functions of the tip, see `tip_functions`.
"""

import ctypes
from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.errors import EquilibriumError
from stiffopt.model.batch import in_parallel
from stiffopt.model.compiled import Library
from stiffopt.model.layout import Layout, symbolic_arm
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.rod import rod_functions, rod_pieces
from stiffopt.model.shape import PointOfArm
from stiffopt.optimise.program import Program
from stiffopt.optimise.settings import KEPT

Vector = NDArray[np.float64]

_integer, _double, _pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class Tip:
    """A tip as symbols of its own: a `Shape` of which all quantities are independent."""

    def __init__(self, n_pressures: int) -> None:
        self.position = ca.SX.sym("r", 3)
        self.rotation = ca.SX.sym("R", 3, 3)
        self.base_compliance = ca.SX.sym("C", 6, 6)
        self.pressures = ca.SX.sym("p", n_pressures)

    @property
    def inputs(self) -> tuple[ca.SX, ...]:
        """Position, rotation, compliance (6, 6) in base axes, pressures."""
        return self.position, self.rotation, self.base_compliance, self.pressures

    @property
    def transform(self) -> ca.SX:
        """Pose (4, 4)."""
        return lie.transform(self.rotation, self.position)

    @property
    def jacobian(self) -> ca.SX:
        """Not a symbol of its own."""
        raise NotImplementedError

    @property
    def compliance(self) -> ca.SX:
        """Compliance (6, 6) in the tip's axes."""
        X = ca.diagcat(self.rotation, self.rotation)
        return X.T @ self.base_compliance @ X

    def station(self, at: float) -> PointOfArm:
        """Not known of the tip alone."""
        raise NotImplementedError

    def flexibility(self, wrench: ca.SX) -> ca.SX:
        """``w' C w`` of a wrench (6,) in the tip's axes."""
        moved = ca.vertcat(self.rotation @ wrench[:3], self.rotation @ wrench[3:])
        return moved.T @ self.base_compliance @ moved

    def total_jacobian(self, values: ca.SX) -> ca.SX:
        """Not known of the tip alone: zeros (k, n)."""
        return ca.SX.zeros(values.numel(), self.pressures.numel())

    def by_twist(self, values: ca.SX) -> ca.SX:
        """Derivative (k, 6) of values by a twist of the tip in its own axes, the rest held."""
        by_turn = [
            ca.jtimes(values, ca.vec(self.rotation), ca.vec(self.rotation @ lie.hat(axis)))
            for axis in ca.DM.eye(3).full()
        ]
        return ca.horzcat(ca.jacobian(values, self.position) @ self.rotation, *by_turn)


def tip_functions(program: Program, layout: Layout) -> list[ca.Function]:
    """Functions of a tip (see `Tip`) and of parameters: the arm's numbers, then the program's own.

    ``residuals``: values (m,) and derivative by a twist (m, 6); ``terms``: terms and floors
    (k,), derivatives by a twist (k, 6), by the compliance (k, 36) and by pressures (k, n);
    ``judge``: as `Program.judge`.
    """
    arm = symbolic_arm(layout)
    tip = Tip(arm.tip.pressures.numel())
    parameters = ca.SX.sym("parameters", program.n_parameters)
    inputs = [*tip.inputs, ca.vertcat(arm.numbers, parameters)]
    residuals, _, terms, _, floors, _ = program.point(tip, parameters)
    terms = ca.vertcat(*terms.elements(), *(floors.elements() if program.n_floors else ()))

    def function(name: str, outputs: list[Any]) -> ca.Function:
        return ca.Function(name, inputs, ca.cse([ca.densify(output) for output in outputs]))

    return [
        function("residuals", [residuals, tip.by_twist(residuals)]),
        function(
            "terms",
            [
                terms, tip.by_twist(terms),
                ca.jacobian(terms, ca.vec(tip.base_compliance)), ca.jacobian(terms, tip.pressures),
            ],
        ),
        function("judge", program.judge(tip, parameters)),
    ]  # fmt: skip


class _Piece(ctypes.Structure):
    """`RodPiece` of native/rod.h."""

    _fields_ = [
        *((name, _integer) for name in ("kind", "parts", "slopes", "channel", "channels", "steps")),
        ("length", _double),
        ("mass", _double),
    ]


class _Rod(ctypes.Structure):
    """`Rod` of native/rod.h."""

    _fields_ = [
        *((name, _integer) for name in ("n", "pieces", "steps", "parts", "slopes")),
        ("piece", ctypes.POINTER(_Piece)),
        ("numbers", _pointer),
        ("gravity", _double * 3),
        ("load", _double * 12),
        ("tip_mass", _double),
        ("hanging", _pointer),
    ]


class LoadedArm:
    """An arm under gravity or a load in machine code: its rod, and equilibria from rest.

    Attributes
    ----------
    address : int
        Of its `Rod`.
    state_size : int
        Numbers of an equilibrium's state.

    Raises
    ------
    EquilibriumError
        If the unpressurised arm falls over.
    """

    def __init__(self, code: Library, robot: Manipulator) -> None:
        equations = rod_functions(robot.layout)
        if equations is None:
            raise EquilibriumError("this arm has no compiled equations")
        self._library, self._numbers = code, robot.numbers  # what pointers below lead to
        found = rod_pieces(robot.description, robot.resolution, equations)
        pieces = (_Piece * len(found))(*(_Piece(*piece) for piece in found))
        steps = sum(piece.steps for piece in found)
        self.state_size = robot.n_pressures + 4 + 7 * steps
        self._hanging = np.zeros(self.state_size)
        self._rod = _Rod(
            n=robot.n_pressures,
            pieces=len(found),
            steps=steps,
            parts=equations.parts,
            slopes=equations.slopes,
            piece=pieces,
            numbers=self._numbers.ctypes.data,
            gravity=(_double * 3)(*robot.description.gravity),
            load=(_double * 12)(*robot.tip_load),
            tip_mass=robot.description.tip_mass,
            hanging=self._hanging.ctypes.data,
        )
        self._pieces = pieces
        self.address = ctypes.addressof(self._rod)
        hang = code.cdll.stiffopt_hang
        hang.argtypes = [_pointer, _pointer]
        if not hang(self.address, self._hanging.ctypes.data):
            raise EquilibriumError("the unpressurised arm falls over")
        self._settle = code.cdll.stiffopt_settle
        self._settle.argtypes = [_pointer] * 5 + [_integer] * 2

    def settled(self, pressures: Vector) -> tuple[NDArray[np.bool_], Vector, Vector]:
        """Which pressures (N, n) have an equilibrium, their states and poses (N, 12)."""
        pressures = np.ascontiguousarray(pressures)
        count = len(pressures)
        states, poses = np.zeros((count, self.state_size)), np.zeros((count, 12))
        found = np.zeros(count, dtype=np.int64)

        def work(starts: Iterator[int]) -> None:
            for start in starts:
                self._settle(
                    self.address, pressures.ctypes.data, states.ctypes.data, poses.ctypes.data,
                    found.ctypes.data, start, min(start + KEPT.chunk, count),
                )  # fmt: skip

        in_parallel(work, range(0, count, KEPT.chunk))
        return found != 0, states, poses
