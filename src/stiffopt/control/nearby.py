"""The model's tip for pressures that change little from tick to tick."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import EquilibriumError, PressureError, StiffoptError
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.tip import TipAt, TipModel

__all__ = ["NearbyTip"]

Array = NDArray[np.float64]

_NEARBY = 300.0  # Pa; over this the model is linear: the tip to a micrometre


class NearbyTip:
    """Evaluates the model where pressures have changed, else what is linear about it.

    Pressures outside the robot's limits count as those at the limit.

    Parameters
    ----------
    robot :
        The arm.
    """

    def __init__(self, robot: Manipulator) -> None:
        self._model = TipModel(robot)
        self._lowest, self._highest = robot.pressure_min, robot.pressure_max
        self._last: tuple[Array, TipAt, Array] | None = None

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
        p = np.minimum(np.maximum(pressures, self._lowest), self._highest)
        if self._last is not None:
            there, tip, linear = self._last
            away = p - there
            if max(away.max(), -away.min()) < _NEARBY:
                pose = tip.pose.copy()
                pose[:3, 3] += linear @ away
                return tip._replace(pose=pose)
        try:
            tip = self._model.at(p)
        except (EquilibriumError, PressureError) as error:
            raise StiffoptError(f"the model has no answer: {error}") from error
        self._last = p, tip, tip.pose[:3, :3] @ tip.jacobian[:3]
        return tip
