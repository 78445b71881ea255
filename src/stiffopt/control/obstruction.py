"""Notice that something holds the tip back from its target.

Feedback adds the remaining error of the tip to the pressures' goal until the tip is at its target.
If the model is wrong, the tip follows the pressures by about as much as the model's tip, and the
error vanishes. If an object is in the way, the tip stays, the error remains, and the pressures
press ever harder. So the change of the offset since the tip stopped tells the one from the other. A
wrong model may change it by twice the error at that time, since it takes several corrections, and
creep by a share of the way before. While the arm becomes stiff at the target, the errors of its
channels change it as well; then feedback keeps the error of the tip small.
"""

from __future__ import annotations

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.contact_tuning import ObstructionTuning


class ObstructionWatch:
    """Watches the tip on its way to a target, and there.

    `withheld`: displacement (3,) by which the tip has not followed since it stopped, in m.
    `allowed`: the largest such displacement of an arm that nothing holds back, in m.
    """

    def __init__(self, tuning: ObstructionTuning) -> None:
        self._tuning = tuning
        self.begin()

    def begin(self) -> None:
        """Restart, for another target."""
        self._begun: Array | None = None  # model's tip (3,) at the first sample
        self._stopped: Array = np.full(3, np.inf)  # tip (3,) where it last was in motion
        self._offset: Array = np.zeros(3)  # its offset (3,) at that time
        self.withheld: Array = np.zeros(3)
        self.allowed = 0.0
        self._channels_moved = 0.0  # since that time, see `change_posture`

    def change_posture(self, moved: float) -> None:
        """Take in by how much the channels have moved the tip, each alone, in m, added up."""
        self._channels_moved += moved

    def change_model(self, change: Array) -> None:
        """Adjust to another model, for which the tip's offset changes by (6,)."""
        self._offset = self._offset + change[:3]
        if self._begun is not None:
            self._begun = self._begun - change[:3]

    def take(self, tip: Array, offset: Array, target: Array) -> bool:
        """Return whether something holds the tip back.

        `tip`, `offset`: position (3,) of the tip, in m, and its offset (6,) from the model.
        `target`: position (3,) of the target; NaN along free axes.
        """
        t, modelled = self._tuning, tip - offset[:3]
        left = float(np.linalg.norm(np.nan_to_num(target - tip)))
        if self._begun is None:
            self._begun = modelled
        if not np.linalg.norm(tip - self._stopped) < t.still:
            self._stopped, self._offset = tip.copy(), offset[:3].copy()
            way = float(np.linalg.norm(modelled - self._begun))
            self.allowed, self._channels_moved = t.least + 2 * left + t.creep * way, 0.0
        self.withheld = self._offset - offset[:3]
        by_posture = t.posture * self._channels_moved * min(1.0, t.error / max(left, 1e-9))
        allowed = self.allowed + by_posture
        return float(np.linalg.norm(self.withheld)) * min(1.0, left / t.error) > allowed
