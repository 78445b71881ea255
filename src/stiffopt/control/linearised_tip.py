"""The model of the arm in the loop: its tip, linearised where it was evaluated last.

The loaded model takes a good part of a tick. Between two ticks pressures change little, so that it
is evaluated only where they have left the range in which its linearisation is good enough.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.control.formula import Formula
from stiffopt.errors import EquilibriumError, InputError, PressureError, StiffoptError
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.tip import TipAt, TipModel
from stiffopt.paths.leaning import BraceApproach

Array = NDArray[np.float64]


class LeaningTip:
    """The tip of an arm on its way into contact, of equilibria that were found before.

    Parameters
    ----------
    approach :
        The way into contact. Pressures off this way take the model of its nearest equilibrium.
    """

    def __init__(self, approach: BraceApproach) -> None:
        self._approach, end = approach, approach.pressures[-1]
        self._along = end / float(end @ end)

    def at(self, pressures: Array) -> TipAt:
        """Return the tip at pressures (n,), in Pa, linear about the nearest equilibrium."""
        approach = self._approach
        share = min(max(float(self._along @ pressures), 0.0), 1.0)
        index = round(share * (len(approach.tips) - 1))
        tip = approach.tips[index]
        pose = tip.pose.copy()
        change = tip.jacobian[:3] @ (pressures - approach.pressures[index])
        pose[:3, 3] += pose[:3, :3] @ change
        return TipAt(pose, tip.jacobian, tip.compliance)


class ArmModel:
    """The model of an arm at the three places where the loop needs its tip.

    Parameters
    ----------
    robot :
        The arm.
    path_range :
        Change of pressure over which the tip on the reference's path is taken to be linear, in Pa.

    Attributes
    ----------
    chambers, path : LinearisedTip
        At the effective pressures, and on the reference's path.
    waypoints : TipModel
        At a trajectory's waypoints, and wherever else it is asked for seldom.

    Raises
    ------
    InputError
        If the arm is loaded and there is no compiler: too slow for a loop.
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

    def change(self, robot: Manipulator, pressures: Array) -> None:
        """Go on with another arm; `StiffoptError`, and no change, if none stands at (n,) Pa."""
        last = self._robot
        try:
            self._take(robot)
            self.chambers.at(pressures)
        except StiffoptError:
            self._take(last)
            raise

    def _take(self, robot: Manipulator) -> None:
        for each in (self.chambers, self.path, self.waypoints):
            each.change(robot)
        self._robot = robot


class LinearisedTip:
    """Pose, Jacobian and compliance of the tip at pressures that change little from call to call.

    Pressures beyond the robot's limits are taken for those at the limit.

    Parameters
    ----------
    robot :
        The arm.
    linear_range :
        Change of pressure over which the model is taken to be linear, in Pa, as the norm over all
        channels. Over 600 Pa the position is right to a few micrometres, over 3 kPa the Jacobian to
        a few percent.
    """

    def __init__(self, robot: Manipulator, linear_range: float = 600.0) -> None:
        self._model = TipModel(robot)
        self._leaning: LeaningTip | None = None
        self._linear_range = linear_range
        self._linearisation = _linearisation(robot.pressure_min, robot.pressure_max)
        self._tip: TipAt | None = None  # at the operating point
        self._operating_point = np.full(robot.n_pressures, np.inf)

    @property
    def is_fast(self) -> bool:
        """Whether machine code evaluates the model; see `TipModel`."""
        return self._model.is_fast

    def change(self, robot: Manipulator) -> None:
        """Go on with another arm; see `TipModel.change`."""
        self._tip = None
        self._operating_point = np.full(robot.n_pressures, np.inf)
        self._model.change(robot)

    def lean(self, leaning: LeaningTip | None) -> None:
        """Go on with an arm that leans on objects; None: with the free one."""
        self._leaning, self._tip = leaning, None
        self._operating_point = np.full_like(self._operating_point, np.inf)

    def at(self, pressures: Array) -> TipAt:
        """Return the tip at pressures (n,), in Pa; `StiffoptError` without an equilibrium there."""
        tip, there = self._tip, self._operating_point
        if tip is None:
            p, _, _ = self._linearisation(pressures, there, np.eye(4), np.zeros((6, len(there))))
        else:
            p, distance, pose = self._linearisation(pressures, there, tip.pose, tip.jacobian)
            if distance[0] < self._linear_range and self._leaning is None:
                return TipAt(pose, tip.jacobian, tip.compliance)
        try:
            self._tip = (self._leaning or self._model).at(p)
        except (EquilibriumError, PressureError) as error:
            raise StiffoptError(f"the model has no answer: {error}") from error
        self._operating_point = p
        return self._tip


def _linearisation(low: Array, high: Array) -> Formula:
    """Pressures (n,) within limits, their distance from the operating point, and the pose there.

    Inputs are pressures (n,), and those (n,), pose (4, 4) and Jacobian (6, n) of the operating
    point. The orientation is that of the operating point.
    """
    n = len(low)
    pressures, there = ca.SX.sym("pressures", n), ca.SX.sym("there", n)
    pose, jacobian = ca.SX.sym("pose", 4, 4), ca.SX.sym("jacobian", 6, n)
    within = ca.fmin(ca.fmax(pressures, ca.DM(low)), ca.DM(high))
    p = ca.if_else(ca.fabs(pressures) < np.inf, within, np.nan)
    change = p - there
    displaced = ca.SX(pose)
    displaced[:3, 3] += pose[:3, :3] @ (jacobian[:3, :] @ change)
    outputs = [p, ca.norm_2(change), displaced]
    return Formula([pressures, there, pose, jacobian], outputs, [jacobian])
