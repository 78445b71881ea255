"""Finds a sensor that lies still while the pressures turn the tip.

At its target, the tip may stay where it is while the arm becomes stiffer, but it turns. A sensor
that has come off, or a tracker that repeats an old pose, shows neither motion nor turn. A wrong
model would move the tip somewhere, so that its error explains no rest. A push that grows as fast as
feedback makes up for it may turn the tip back; how far follows from the displacement made up for.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.noticing_tuning import StillTuning
from stiffopt.control.tip_errors import missed_turn, turn_of_a_push
from stiffopt.optimise.tip import TipAt


class _Pose(NamedTuple):
    time: float  # s
    position: Array  # (3,), of the sensor
    rotation: Array  # (3, 3), of the sensor
    predicted: Array  # position (3,) by the model
    modelled: Array  # rotation (3, 3) by the model


class StillWatch:
    """Compares the turn of the model's tip with a pose that is seen not to change.

    Parameters
    ----------
    tuning : sizes and times of the test.
    scatter : standard deviation of a tracked position in each axis, in m.
    """

    def __init__(self, tuning: StillTuning, scatter: float) -> None:
        self._tuning, self._scatter = tuning, scatter
        self._poses: deque[_Pose] = deque()
        self.begin()

    def begin(self) -> None:
        """Restart."""
        self._poses.clear()
        self._count = 0  # successive samples in which the tip should have turned

    def take(
        self, time: float, position: Array, rotation: Array, predicted: Array, modelled: Array,
        tip: TipAt,
    ) -> float:  # fmt: skip
        """Take in a sample; return the turn that is not seen, in rad, once it is certain, or 0.

        Parameters
        ----------
        time :
            Time of capture, in s.
        position, rotation :
            Position (3,), in m, and axes (3, 3) in the sample.
        predicted, modelled :
            The same as the model has them at that time.
        tip :
            The model's tip now.
        """
        poses = self._poses
        poses.append(_Pose(time, position, rotation, predicted, modelled))
        while time - poses[0].time > self._tuning.window + 1e-6:
            poses.popleft()
        missing = self._missing(tip)
        self._count = self._count + 1 if missing > 0 else 0
        return missing if self._count >= self._tuning.misses else 0.0

    def _missing(self, tip: TipAt) -> float:
        """Return the turn that is not seen in the last samples, in rad; 0 if all may be."""
        tuning, poses = self._tuning, list(self._poses)
        first, last = poses[0], poses[-1]
        if last.time - first.time < tuning.window - tuning.interval:
            return 0.0
        if not math.hypot(*_turn(first.modelled, last.modelled).tolist()) > tuning.least:
            return 0.0
        if len(poses) < 3 * tuning.samples:
            return 0.0
        places = _thirds([pose.position for pose in poses])
        if _spread(places) > tuning.scatters * self._scatter:
            return 0.0
        turns = _thirds([_turn(last.rotation, pose.rotation) for pose in poses])
        if _spread(turns) > tuning.turn:
            return 0.0
        predicted = _thirds([pose.predicted for pose in poses])
        modelled = _thirds([_turn(last.modelled, pose.modelled) for pose in poses])
        moved, turned = predicted[2] - predicted[0], modelled[2] - modelled[0]
        # a push that keeps the tip where it is displaces and turns it against the model
        missing = missed_turn(turn_of_a_push(tip) @ -moved, -turned, tuning.further)
        return missing if missing > tuning.least else 0.0


def _turn(before: Array, after: Array) -> Array:
    """Return the turn (3,) between axes (3, 3), in rad, if it is small; base axes."""
    R = after @ before.T
    return 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])


def _thirds(values: list[Array]) -> list[Array]:
    """Return the means (3,) of the first, the middle and the last third of values (3,)."""
    n = len(values) // 3
    parts = values[:n], values[-2 * n : -n], values[-n:]
    return [np.mean(part, axis=0) for part in parts]


def _spread(values: list[Array]) -> float:
    """Return the largest distance between values (3,)."""
    return max(math.dist(a, b) for a in values for b in values)
