"""`LoadedArm`: an arm under gravity or loads in machine code, and its equilibria from rest.

The rod is integrated in C (``native/rod.h``) with the small functions of `stiffopt.model.rod`.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.errors import EquilibriumError
from stiffopt.model.batch import in_parallel
from stiffopt.model.compiled import Library
from stiffopt.model.rod import rod_functions, rod_pieces

if TYPE_CHECKING:
    from stiffopt.model.arm import Arm


_CHUNK = 8  # equilibria that a thread takes at a time

_integer, _double, _pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class _Piece(ctypes.Structure):
    """Structure `RodPiece` of native/rod.h."""

    _fields_ = [
        *((name, _integer) for name in ("kind", "parts", "slopes", "channel", "channels", "steps")),
        ("length", _double),
        ("mass", _double),
    ]


class _Rod(ctypes.Structure):
    """Structure `Rod` of native/rod.h."""

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

    `address`: of its `Rod`. `state_size`: number of doubles of an equilibrium's state. Raises
    `EquilibriumError` if the unpressurised arm falls over.
    """

    def __init__(self, code: Library, robot: Arm) -> None:
        equations = rod_functions(robot.layout)
        if equations is None:
            raise EquilibriumError("this arm has no compiled equations")
        self._library, self._numbers = code, robot.numbers  # own the memory of pointers below
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
        self._hang = code.cdll.stiffopt_hang
        self._hang.argtypes = [_pointer, _pointer]
        self._rest()
        self._settle = code.cdll.stiffopt_settle
        self._settle.argtypes = [_pointer] * 5 + [_integer] * 2

    def _rest(self) -> None:
        if not self._hang(self.address, self._hanging.ctypes.data):
            raise EquilibriumError("the unpressurised arm falls over")

    def change(self, robot: Arm) -> None:
        """Switch to an arm that differs only in moduli, corrections and tip mass."""
        self._numbers = robot.numbers
        self._rod.numbers = self._numbers.ctypes.data
        self._rod.tip_mass = robot.description.tip_mass
        self._rest()

    def settled(self, pressures: Array) -> tuple[Flags, Array, Array]:
        """Return which pressures (N, n) have an equilibrium, their states and poses (N, 12)."""
        pressures = np.ascontiguousarray(pressures)
        count = len(pressures)
        states, poses = np.zeros((count, self.state_size)), np.zeros((count, 12))
        found = np.zeros(count, dtype=np.int64)

        def work(starts: Iterator[int]) -> None:
            for start in starts:
                self._settle(
                    self.address, pressures.ctypes.data, states.ctypes.data, poses.ctypes.data,
                    found.ctypes.data, start, min(start + _CHUNK, count),
                )  # fmt: skip

        in_parallel(work, range(0, count, _CHUNK))
        return found != 0, states, poses
