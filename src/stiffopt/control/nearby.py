"""The model's tip for pressures that change little from tick to tick."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.control.formula import Formula
from stiffopt.errors import EquilibriumError, PressureError, StiffoptError
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.tip import TipAt, TipModel

__all__ = ["NearbyTip"]

Array = NDArray[np.float64]


class NearbyTip:
    """Evaluates the model where pressures have changed, else what is linear about it.

    Pressures outside the robot's limits count as those at the limit.

    Parameters
    ----------
    robot :
        The arm.
    nearby :
        Over which the model is taken for linear, in Pa, as the norm of all channels' changes. Over
        600 Pa the tip is so to a few micrometres, over 3 kPa the Jacobian is the same to a few
        hundredths.
    """

    def __init__(self, robot: Manipulator, nearby: float = 600.0) -> None:
        self._model = TipModel(robot)
        self._nearby = nearby
        self._moved = _moved(robot.pressure_min, robot.pressure_max)
        self._last: TipAt | None = None
        self._there = np.full(robot.n_pressures, np.inf)  # its pressures

    @property
    def is_fast(self) -> bool:
        """Whether machine code serves; see `TipModel`."""
        return self._model.is_fast

    def at(self, pressures: Array) -> TipAt:
        """Return the tip at pressures (n,), in Pa.

        Raises
        ------
        StiffoptError
            The model has none.
        """
        last = self._last
        if last is None:
            p, _, _ = self._moved(pressures, self._there, np.eye(4), np.zeros((6, len(pressures))))
        else:
            p, away, pose = self._moved(pressures, self._there, last.pose, last.jacobian)
            if away[0] < self._nearby:
                return TipAt(pose, last.jacobian, last.compliance)
        try:
            self._last = self._model.at(p)
        except (EquilibriumError, PressureError) as error:
            raise StiffoptError(f"the model has no answer: {error}") from error
        self._there = p
        return self._last


def _moved(lowest: Array, highest: Array) -> Formula:
    """Pressures (n,) within limits, how far they are from others, and the pose there.

    From pressures, and what pressures (n,), pose (4, 4) and Jacobian (6, n) were before.
    """
    n = len(lowest)
    pressures, there = ca.SX.sym("pressures", n), ca.SX.sym("there", n)
    pose, jacobian = ca.SX.sym("pose", 4, 4), ca.SX.sym("jacobian", 6, n)
    within = ca.fmin(ca.fmax(pressures, ca.DM(lowest)), ca.DM(highest))
    p = ca.if_else(ca.fabs(pressures) < np.inf, within, np.nan)
    away = p - there
    moved = ca.SX(pose)
    moved[:3, 3] += pose[:3, :3] @ (jacobian[:3, :] @ away)
    outputs = [p, ca.norm_2(away), moved]
    return Formula([pressures, there, pose, jacobian], outputs, [jacobian])
