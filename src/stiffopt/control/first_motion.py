"""The first motion of each channel: slow until the tip has been seen to go where the model goes.

Channels may have been swapped since the arm was last used, or the tracker's frame turned, also on a
rig that was commissioned. The watch of the motion (`MotionWatch`) finds that after a few
millimetres, but until the chambers obey its hold, a fast arm moves much farther than that.
Meanwhile feedback corrects no more than a usual error of the model: with swapped channels it drives
the tip away, the faster the farther it is.
A channel without a part in the first motion is slow when it first has one: its effect is unknown.
"""

from __future__ import annotations

import math

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.tuning import FirstMotionTuning


class FirstMotion:
    """Compares the way of the tip since arming with that of the model.

    Parameters
    ----------
    tuning : speed of the first motion, and when it ends.
    """

    def __init__(self, tuning: FirstMotionTuning) -> None:
        self._tuning = tuning
        self.begin()

    def begin(self) -> None:
        """Restart with a vented arm."""
        self._responds = np.array(False)  # of each channel (n,), once the tip is seen
        # positions (n, 2, 3) of model and tip when each channel began to have a part in the motion
        self._starts: Array | None = None
        self._on_path: Array | None = None  # position (3,) of the model on the reference's path

    @property
    def is_over(self) -> bool:
        """True once every channel has moved the tip as the model predicts."""
        return bool(self._responds.all())

    def take(self, modelled: Array, seen: Array, parts: Array) -> None:
        """Take in where the model has the tip (3,), and where it is seen (3,), in m.

        `parts` (3, n) are the parts that the channels' pressures have in the model's way, in m.
        """
        now, sizes = np.stack([modelled, seen]), np.sqrt((parts**2).sum(axis=0))
        if self._starts is None:
            self._starts = np.tile(now, (len(sizes), 1, 1))
            self._responds = np.zeros(len(sizes), dtype=bool)
        self._starts[sizes < self._tuning.part] = now
        way, moved = np.moveaxis(now - self._starts, 1, 0)
        way_size = np.sqrt((way**2).sum(axis=1))
        off = np.sqrt(((moved - way) ** 2).sum(axis=1))
        follows = (way_size > self._tuning.way) & (off < self._tuning.error * way_size)
        self._responds |= follows & (sizes > self._tuning.way)

    def largest_correction(self, on_path: Array) -> float:
        """Return the largest correction, in m, with the model's tip on the reference at (3,)."""
        if self._responds.any():
            return math.inf
        if self._on_path is None:
            self._on_path = on_path.copy()
        way = float(np.linalg.norm(on_path - self._on_path))
        return self._tuning.correction + self._tuning.correction_share * way

    @property
    def slew_share(self) -> Array:
        """Largest share of the slew that the reference may take, of each channel (n,) or all."""
        return np.where(self._responds, math.inf, self._tuning.slew_share)
