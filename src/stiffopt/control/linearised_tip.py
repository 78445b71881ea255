"""The model of the arm in the loop: its tip, linearised about the last point of evaluation.

The loaded model takes a good part of a tick. Pressures change little between ticks, so the model is
evaluated only when they leave the range in which its linearisation is accurate enough. It is then
evaluated ahead of them, as far as the range allows: pressures that go on in the same direction stay
in it for nearly twice as long, and the tip hardly jumps where one linearisation follows another.
"""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.control.formula import Formula
from stiffopt.errors import EquilibriumError, InputError, PressureError, StiffoptError
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.tip import TipAt, TipModel
from stiffopt.paths.leaning import BraceApproach

Symbols = Any  # of CasADi

# share of the range by which an operating point is ahead of pressures that have just left the last
# one's; less for faster ones, and none for those that leave a range in every step anyway
_AHEAD = 0.7


class LeaningTip:
    """The tip of an arm on its way into contact, from equilibria that were computed before.

    `approach`: the way into contact. Other pressures use the model of its nearest equilibrium.
    """

    def __init__(self, approach: BraceApproach) -> None:
        self._approach = approach

    def at(self, pressures: Array) -> TipAt:
        """Return the tip at pressures (n,), in Pa, linearised about the nearest equilibrium."""
        approach = self._approach
        off = pressures - approach.pressures
        index = int(np.einsum("ki,ki->k", off, off).argmin())
        tip = approach.tips[index]
        pose = tip.pose.copy()
        change = tip.jacobian[:3] @ (pressures - approach.pressures[index])
        pose[:3, 3] += pose[:3, :3] @ change
        return TipAt(pose, tip.jacobian, tip.compliance)


class ArmModel:
    """The model of an arm, for each of the uses that the loop has for its tip.

    Raises `InputError` if the arm is loaded and there is no compiler: the model is too slow for a
    loop.

    Parameters
    ----------
    robot : the arm.
    path_range : as `linear_range` of `LinearisedTip`, for the tip on the reference's path.

    Attributes
    ----------
    chambers, path : the tip at the effective pressures, and on the reference's path.
    waypoints : the tip at a trajectory's waypoints, and for other rare uses.
    """

    def __init__(self, robot: Manipulator, path_range: float) -> None:
        self._robot = robot
        self.chambers, self.path = LinearisedTip(robot), LinearisedTip(robot, path_range)
        self.waypoints = TipModel(robot)
        if not self.chambers.is_fast and robot.is_loaded:
            raise InputError(
                "the control loop needs a C compiler for an arm under gravity or a load; "
                "install one (Debian: apt install gcc) or set STIFFOPT_COMPILER"
            )

    def change(self, robot: Manipulator, pressures: Array, ahead: Array | None = None) -> TipAt:
        """Change to another arm, and return its tip at pressures (n,), in Pa.

        `StiffoptError`, and no change, if it is unstable there, or at the pressures `ahead` (n,),
        to which the arm goes.
        """
        last = self._robot
        try:
            self._take(robot)
            tip = self.chambers.at(pressures)
            if ahead is not None:
                self.chambers.at(ahead)
                self.path.at(ahead)
            return tip
        except StiffoptError:
            self._take(last)
            raise

    def _take(self, robot: Manipulator) -> None:
        for each in (self.chambers, self.path, self.waypoints):
            each.change(robot)
        self._robot = robot


class LinearisedTip:
    """Pose, Jacobian and compliance of the tip at pressures that change little between calls.

    Pressures beyond the robot's limits are clipped to them.

    Parameters
    ----------
    robot : the arm.
    linear_range : motion over which the model counts as linear, as a turn in rad: the change of the
        pressures times the Jacobian, as norms, a displacement being divided by the arm's length.
        Over 0.03 the position is accurate to some micrometres, over 0.07 the Jacobian to a few
        percent, or to a sixth where an arm bends by nearly half a turn.
    """

    def __init__(self, robot: Manipulator, linear_range: float = 0.03) -> None:
        self._model = TipModel(robot)
        self._leaning: LeaningTip | None = None
        self._linear_range = linear_range
        low, high = robot.pressure_min, robot.pressure_max
        self._linearisation = _linearisation(low, high, robot.length, linear_range)
        self._tip: TipAt | None = None  # at the operating point

    @property
    def is_fast(self) -> bool:
        """Whether machine code evaluates the model; see `TipModel`."""
        return self._model.is_fast

    def change(self, robot: Manipulator) -> None:
        """Change to another arm; see `TipModel.change`."""
        self._tip = None
        self._model.change(robot)

    def lean(self, leaning: LeaningTip | None) -> None:
        """Change to the model of an arm that leans on objects; None: of the free arm."""
        self._leaning, self._tip = leaning, None

    def at(self, pressures: Array) -> TipAt:
        """Return the tip at pressures (n,), in Pa; `StiffoptError` without an equilibrium there."""
        tip = self._tip
        p, motion, pose, ahead = self._linearisation.again(pressures)
        if tip is None or self._leaning is not None:
            return self._evaluate(p.copy())
        if not motion[0] < self._linear_range:
            p, ahead = p.copy(), ahead.copy()
            try:
                tip = self._evaluate(ahead)
            except StiffoptError:
                return self._evaluate(p)
            _, _, pose, _ = self._linearisation.again(p)
        return TipAt(pose.copy(), tip.jacobian, tip.compliance)

    def _evaluate(self, pressures: Array) -> TipAt:
        """Return the tip at pressures (n,), about which it is linearised from now on."""
        try:
            tip = (self._leaning or self._model).at(pressures)
        except (EquilibriumError, PressureError) as error:
            raise StiffoptError(f"the model has no answer: {error}") from error
        if not math.isfinite(tip.compliance.sum()):
            raise StiffoptError("the model has no answer: its compliance is not finite")
        self._linearisation.view(pressures, pressures, tip.pose, tip.jacobian)
        self._tip = tip
        return tip


def _linearisation(low: Array, high: Array, length: float, linear_range: float) -> Formula:
    """Return the formula of a linearisation about an operating point.

    Inputs: pressures (n,); pressures (n,), pose (4, 4) and Jacobian (6, n) of the operating point.
    Outputs: the pressures within limits (n,), the motion from the operating point, see
    `LinearisedTip`, the pose there, and the next operating point (n,), ahead of the pressures. In
    the tip's axes the Jacobian hardly changes as the arm bends, so the pose follows by its
    exponential.
    """
    n = len(low)
    pressures, point = ca.SX.sym("pressures", n), ca.SX.sym("point", n)
    pose, jacobian = ca.SX.sym("pose", 4, 4), ca.SX.sym("jacobian", 6, n)

    def within(pressures: Symbols) -> Symbols:
        clipped = ca.fmin(ca.fmax(pressures, ca.DM(low)), ca.DM(high))
        return ca.if_else(ca.fabs(pressures) < np.inf, clipped, np.nan)

    p = within(pressures)
    change = p - point
    scaled = ca.vertcat(jacobian[:3, :] / length, jacobian[3:, :])
    motion = ca.norm_2(change) * ca.norm_fro(scaled)
    ahead = within(p + _AHEAD * ca.fmax(2 * linear_range / motion - 1, 0) * change)
    outputs = [p, motion, pose @ lie.exp(jacobian @ change), ahead]
    return Formula([pressures, point, pose, jacobian], outputs, [jacobian])
