"""`TipModel`: tip pose, Jacobian and compliance, fast enough for a control loop.

`Manipulator` computes the same from rest in the CasADi VM, which takes milliseconds under gravity
or loads.  Here machine code finds each equilibrium from the one before.
"""

import ctypes
from functools import partial
from pathlib import Path
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError
from stiffopt.model.compiled import Library, compiling_at_once, library
from stiffopt.model.layout import Layout
from stiffopt.model.loaded_arm import LoadedArm
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.rod import rod_functions
from stiffopt.model.tip_functions import tip_formulas

_SOURCES = (str(Path(__file__).with_name("native") / "tip.c"),)
_FOUND, _BEYOND_LAW, _NO_EQUILIBRIUM = range(3)  # as in tip.c

_integer, _pointer = ctypes.c_int64, ctypes.c_void_p


class TipAt(NamedTuple):
    """The tip at one set of pressures; the arrays belong to the caller."""

    pose: Array  # (4, 4), in the base frame
    # (6, n), twist of the tip in tip axes per pressure: three rows in m/Pa, then three in rad/Pa
    jacobian: Array
    compliance: Array  # (6, 6), in tip axes, linear first, as `Manipulator.tip_compliance`


class TipModel:
    """Pose, Jacobian and compliance of an arm's tip at successive pressures.

    With gravity or a load, each call follows the equilibrium from that of the call before, along
    the straight line between the pressures.  If the arm becomes unstable on it, the call starts
    from rest.  An arm with several equilibria at the same pressures thus stays on its branch.

    An instance belongs to one thread; see `copy`.  Calls release the interpreter lock.

    Raises `EquilibriumError` if the unpressurised arm falls over under its weight.

    Parameters
    ----------
    robot : the arm with its gravity and load.

    Attributes
    ----------
    is_fast : whether calls run in machine code, which is compiled when an instance is made.
        Without a compiler the model is used, from rest each time, which takes milliseconds for a
        loaded arm.
    """

    def __init__(self, robot: Manipulator) -> None:
        self._robot = robot
        with compiling_at_once():
            self._code = _loaded_tip(robot) if robot.is_loaded else _free_tip(robot)
        self.is_fast = self._code is not None

    def copy(self) -> "TipModel":
        """Return a model of the same arm, from rest, for another thread."""
        return TipModel(self._robot)

    def change(self, robot: Manipulator) -> None:
        """Switch to an arm that differs only in moduli, corrections and tip mass; start from rest.

        This takes much less time than a new instance.

        Raises `EquilibriumError` if the unpressurised arm falls over under its weight; the instance
        is unusable then.
        """
        self._robot = robot
        if self._code is not None:
            self._code.change(robot)

    def at(self, pressures: ArrayLike) -> TipAt:
        """Return the tip at pressures (n,) in Pa.

        Raises `PressureError`: pressures that are not n finite numbers, or are beyond the strain
        law; `EquilibriumError`: the loaded arm has no stable equilibrium there.
        """
        robot, p = self._robot, self._robot.checked_pressures(pressures)
        found = None if self._code is None else self._code(p)
        return found or TipAt(robot.tip_pose(p), robot.tip_jacobian(p), robot.tip_compliance(p))


class _LoadedTip:
    """The tip of a loaded arm in machine code, each equilibrium found from the one before."""

    def __init__(self, code: Library, robot: Manipulator) -> None:
        self._arm = LoadedArm(code, robot)
        self._tip = code.cdll.stiffopt_tip
        self._tip.argtypes = [_pointer] * 5
        size = code.cdll.stiffopt_tip_memory
        size.argtypes, size.restype = [_pointer], _integer
        n = self._n = robot.n_pressures
        self._pressures = np.zeros(n)
        self._state = np.full(self._arm.state_size, np.nan)  # from rest first
        self._memory = np.zeros(size(self._arm.address))
        self._found = np.zeros(16 + 6 * n + 36)
        own = (self._pressures, self._state, self._memory, self._found)
        self._call = (self._arm.address, *(array.ctypes.data for array in own))

    def change(self, robot: Manipulator) -> None:
        """Take another arm's numbers and tip mass."""
        self._state[:] = np.nan
        self._arm.change(robot)

    def __call__(self, pressures: Array) -> TipAt | None:
        self._pressures[:], before = pressures, self._state.copy()
        outcome = self._tip(*self._call)
        if outcome == _FOUND:
            found = self._found.copy()
            jacobian = found[16:-36].reshape(6, self._n)
            return TipAt(found[:16].reshape(4, 4), jacobian, found[-36:].reshape(6, 6))
        self._state[:] = before  # so that the next call stays on this branch
        if outcome == _BEYOND_LAW:
            return None
        bars = ", ".join(f"{value / 1e5:.4g}" for value in pressures)
        raise EquilibriumError(
            f"no stable equilibrium was found at ({bars}) bar: the arm buckles or falls over on "
            "the way there; lower the pressures or the load"
        )


class _FreeTip:
    """The tip of a free arm in machine code, in closed form."""

    def __init__(self, code: Library, robot: Manipulator) -> None:
        self._function, self._numbers = code.function("tip_at"), robot.numbers

    def change(self, robot: Manipulator) -> None:
        """Take another arm's numbers."""
        self._numbers = robot.numbers

    def __call__(self, pressures: Array) -> TipAt | None:
        pose, jacobian, compliance, margin = self._function(pressures, self._numbers)
        return TipAt(pose, jacobian, compliance) if margin[0, 0] > 0 else None


def _free_tip(robot: Manipulator) -> _FreeTip | None:
    code = library(("free tip", robot.layout.skeleton), partial(_free_function, robot.layout))
    return None if code is None else _FreeTip(code, robot)


def _free_function(layout: Layout) -> list[ca.Function]:
    return [tip_formulas(layout).function("tip_at")]


def _loaded_tip(robot: Manipulator) -> _LoadedTip | None:
    if rod_functions(robot.layout) is None:
        return None
    content, make = ("loaded tip", robot.layout.skeleton), partial(_loaded_functions, robot.layout)
    code = library(content, make, _SOURCES)
    return None if code is None else _LoadedTip(code, robot)


def _loaded_functions(layout: Layout) -> list[ca.Function]:
    equations = rod_functions(layout)
    assert equations is not None  # checked in `_loaded_tip`
    return [each for each in equations.functions if "adjoint" not in each.name()]
