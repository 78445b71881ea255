"""How much feedback and plans correct at once while the arm goes to its pressures.

A chamber behind a narrow or kinked line does not get the pressure that its gauge shows. The tip
lacks what that pressure should have done, which looks like an offset, as by a push. If feedback and
plans make up for it, they go on with the same chamber, and the offset grows; or with others, and
where the pressure comes late after all, the tip swings beyond its target. The offset of a healthy
arm changes slowly while the arm becomes stiff, and before by a share of its latest motion, so it
hardly needs more than this bound. A push is met more slowly in that time.

An arm without inertia has its stiffest pressures as soon as its reference is at rest. Its bound
applies while the reference moves: a tip that is seen too late looks like an offset as well, and
feedback that follows it drives the arm to its limits.
"""

from __future__ import annotations

import math

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.tuning import CorrectionTuning


class CorrectionBound:
    """Bounds corrections by the latest motion of the reference.

    Parameters
    ----------
    tuning : the bound.
    period : time between two calls of `take`, in s.
    vibrates : whether the arm has inertia.

    Attributes
    ----------
    largest : correction of the tip's position, in m.
    """

    def __init__(self, tuning: CorrectionTuning, period: float, *, vibrates: bool) -> None:
        self._tuning, self._period = tuning, period
        release = tuning.release if vibrates else tuning.release_without_inertia
        self._growth = release * period
        self.begin()

    def begin(self) -> None:
        """Restart at rest, without a bound."""
        self._before: Array | None = None  # mean place of the tip on the reference lately (3,)
        self._longest = 0.0  # of these motions lately, in m
        self._released, self.largest = math.inf, math.inf

    def take(self, on_path: Array, *, applies: bool) -> None:
        """Take in where the model's tip is on the reference (3,), and whether the bound applies.

        Once it no longer does, it grows: a correction that was kept back must not come at once.
        """
        tuning = self._tuning
        before = on_path if self._before is None else self._before
        way = on_path - before
        self._before = before + self._period / tuning.time * way
        self._released = 0.0 if applies else self._released + self._growth
        moved = float(np.linalg.norm(way))
        self._longest = max(moved, self._longest * (1 - self._period / tuning.long_time))
        most = max(tuning.most, tuning.share_of_long * self._longest)
        self.largest = min(tuning.least + tuning.share * moved, most) + self._released
