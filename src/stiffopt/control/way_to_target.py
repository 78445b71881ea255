"""The tip's way to a new target, before the arm becomes stiff, takes a least time.

That way is short in the space of pressures. If it were faster, stopping would leave more vibration,
and a channel that does not follow would move the tip off its way farther before that is noticed.
"""

from __future__ import annotations

import math

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.observer import ArmObserver
from stiffopt.control.plan import Plan
from stiffopt.control.reference import Reference
from stiffopt.control.setup import ControlSetup


class WayToTarget:
    """Bounds the speed of the reference on that way.

    Parameters
    ----------
    setup : what it has in common with the other parts of the controller.
    arm : the observer of the arm.
    """

    def __init__(self, setup: ControlSetup, arm: ArmObserver) -> None:
        self._tuning, self._slew, self._arm = setup.tuning.reference, setup.slew, arm
        self.begin()

    def begin(self) -> None:
        """Begin anew with the way, if there is one."""
        self._tip_first: tuple[float, ...] = ()  # of the way under way, see `Plan`
        # the rest of that way, in s at the full slew, and the share of the slew for it
        self._left, self._share = 0.0, math.inf
        self._at: Array = np.zeros(0)  # where the reference was at the last call (n,)

    def slew_share(self, plan: Plan | None, reference: Reference, *, demands: bool) -> float:
        """Return the share of the slew that the reference may take now; in each tick.

        The bound ends when the reference has moved as far as the way is. `demands`: whether the
        task demands a stiffness. Then the channels may go far, against each other.
        """
        path = reference.path[: len(self._slew)]
        if plan is not None and plan.tip_first and plan.tip_first != self._tip_first:
            self._tip_first, tuning = plan.tip_first, self._tuning
            ways = plan.pressures - np.stack([path, reference.goal[: len(path)]])
            sizes = (np.maximum(np.abs(ways), tuning.there) / self._slew).max(axis=1).tolist()
            self._left, self._share = sizes[0], sizes[1] / self._least_time(path, ways[0], demands)
        elif self._left > 0:
            self._left -= float((np.abs(path - self._at) / self._slew).max())
        self._at = path
        return self._share if self._left > 0 else math.inf

    def _least_time(self, path: Array, way: Array, demands: bool) -> float:
        """Return the least time for a way (n,) from the path's pressures (n,), in s."""
        moved = self._arm.on_path(path).jacobian[:3] * way
        by_channel = float(np.linalg.norm(moved, axis=0).max())
        vibration = self._tuning.periods_to_target * 2 * math.pi / self._arm.tip.omega
        tuning = self._tuning
        speed = tuning.demanded_channel_speed if demands else tuning.channel_speed
        return max(vibration, by_channel / speed)
