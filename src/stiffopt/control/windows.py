"""Windows: averages of the tip at rest, from which the arm's numbers are adapted."""

from __future__ import annotations

import math

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.adaptation import Window
from stiffopt.control.estimator import TipEstimator
from stiffopt.control.formula import are_within
from stiffopt.control.tuning import WindowTuning


class WindowWatch:
    """Collects windows while the arm rests: the newest one of each posture.

    `windows`: the present windows; a new tuple when they change.
    """

    def __init__(self, tuning: WindowTuning) -> None:
        self._tuning = tuning
        self.windows: tuple[Window, ...] = ()
        self.begin()

    def begin(self) -> None:
        """Wait for rest; windows stay."""
        self._rested: float | None = None  # when the rest began, in s
        self._since = 0.0  # when the wait for the next window began, in s
        self._first: Array | None = None

    def has_rested(self, now: float) -> bool:
        """Whether the arm has rested for long enough."""
        return self._rested is not None and now - self._rested >= self._tuning.wait

    def look(self, now: float, pressures: Array, estimator: TipEstimator) -> None:
        """Average an arm at rest: effective pressures (n,) and the estimated tip."""
        t = self._tuning
        if self._rested is None:
            self._rested = self._since = now
        if now - self._since < t.wait:
            return
        n, values = len(pressures), np.concatenate([pressures, estimator.position])
        if not all(map(math.isfinite, values.tolist())):
            return
        if self._first is None:
            self._first, self._sum, self._count, self._begun = values, 0 * values, 0, now
        moved = values - self._first
        rests = are_within(t.drift_pressure, moved[:n]) and are_within(t.drift_position, moved[n:])
        if not rests:
            self._first = None  # the arm still creeps
            return
        self._sum += values
        self._count += 1
        if now - self._begun < t.duration:
            return
        mean = self._sum / self._count
        rotation = estimator.estimate.rotation if estimator.turn_known else None
        self._add(Window(now, mean[:n], mean[n:], rotation))
        self._first, self._since = None, now + t.again

    def _add(self, window: Window) -> None:
        """Add a window, replacing those of its posture, or the oldest one if there are many.

        If the tip has moved at the same posture, all earlier windows are void.
        """
        t, others = self._tuning, list(self.windows)
        for other in self.windows:
            if np.linalg.norm(other.pressures - window.pressures) > t.same:
                continue
            others.remove(other)
            if np.linalg.norm(other.position - window.position) > t.changed:
                others = []  # the load has changed
                break
        self.windows = (*others[-(t.most - 1) :], window)
