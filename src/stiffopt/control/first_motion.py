"""The first motion after arming: slow until the tip has been seen to go where the model goes.

On a rig that nobody has commissioned, channels may be swapped or the tracker's frame turned. The
watch of the motion (`MotionWatch`) finds that after a few millimetres, but until the chambers obey
its hold, a fast arm moves much farther than that. Meanwhile feedback corrects no more than an error
of the model explains: with swapped channels it drives the tip away, the faster the farther it is.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stiffopt.control.tuning import FirstMotionTuning

Array = NDArray[np.float64]


class FirstMotion:
    """Compares the way of the tip since arming with that of the model.

    Parameters
    ----------
    is_known :
        Whether the arm is known to respond as modelled, so that its first motion may be fast.
    tuning :
        Speed of the first motion, and when it ends.
    """

    def __init__(self, is_known: bool, tuning: FirstMotionTuning) -> None:
        self._is_known, self._tuning = is_known, tuning
        self.begin()

    def begin(self) -> None:
        """Restart with a vented arm."""
        self._responds = self._is_known
        self._start: tuple[Array, Array] | None = None  # positions (3,) of model and tip
        self._on_path: Array | None = None  # position (3,) of the model on the reference's path

    def take(self, modelled: Array, seen: Array) -> None:
        """Take in where the model has the tip (3,), and where it is seen (3,), in m."""
        if self._responds:
            return
        if self._start is None:
            self._start = modelled.copy(), seen.copy()
        way, moved = modelled - self._start[0], seen - self._start[1]
        size, off = float(np.linalg.norm(way)), float(np.linalg.norm(moved - way))
        self._responds = size > self._tuning.way and off < self._tuning.error * size

    def largest_correction(self, on_path: Array) -> float:
        """Return the largest correction, in m, with the model's tip on the reference at (3,)."""
        if self._responds:
            return math.inf
        if self._on_path is None:
            self._on_path = on_path.copy()
        way = float(np.linalg.norm(on_path - self._on_path))
        return self._tuning.correction + self._tuning.error * way

    @property
    def slew_share(self) -> float:
        """Largest share of the slew that the reference may take now."""
        return math.inf if self._responds else self._tuning.slew_share
