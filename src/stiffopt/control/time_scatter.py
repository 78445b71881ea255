"""By how much the times of the tracker's samples scatter."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.noticing_tuning import ScatterTuning


class TimeScatter:
    """Estimates by how much the times of samples scatter, from how rough the tip's way is.

    A tip that moves at v is seen v times the error of the sample's time aside, along its motion. A
    third divided difference of four successive positions removes what is smooth,

        e = sum_j w_j y_j / |w|,    w_j = 1 / prod_(i != j) (t_j - t_i),

    and keeps errors that differ from sample to sample. Over a window of motion, the root of the sum
    of the squares of e along v, by that of v, is the standard deviation of the times. Of an error
    far above the median only a part counts, so that single wrong samples hardly matter. Noise of
    the positions counts as scatter as well, the less the faster the tip; so does a fast swing of it
    that is sampled seldom. Hence samples further apart than 45 ms are not judged.

    `noise` is the standard deviation of a position along an axis, in m.

    Attributes
    ----------
    scatter : standard deviation of the times, in s; NaN until the tip has moved for long enough.
    is_large : whether there is to be an alarm.
    """

    def __init__(self, noise: float, tuning: ScatterTuning | None = None) -> None:
        self._tuning = tuning = tuning or ScatterTuning()
        self._least_speed = max(tuning.least_speed, noise / tuning.least)
        self._rows: deque[tuple[float, Array]] = deque(maxlen=4)
        # interval, error along the motion, and speed of each sample in the window
        self._errors: deque[tuple[float, float, float]] = deque()
        self.begin()

    def begin(self) -> None:
        """Restart."""
        self._rows.clear()
        self._errors.clear()
        self._moved = 0.0  # time for which the tip moved in the window, in s
        self.scatter, self.is_large = math.nan, False

    def take(self, time: float, position: Array) -> None:
        """Take in a sample: its time, in s, and position (3,), in m."""
        if self._rows and not time > self._rows[-1][0]:
            self._rows.clear()
        self._rows.append((time, position))
        if len(self._rows) < 4 or time - self._rows[0][0] > self._tuning.longest_span:
            return
        times = np.array([row[0] for row in self._rows]) - time
        positions = np.array([row[1] for row in self._rows])
        velocity = (positions[3] - positions[0]) / (times[3] - times[0])
        speed = math.hypot(*velocity)
        if speed < self._least_speed:
            return
        apart = times[:, None] - times + np.eye(4)
        weights = 1 / apart.prod(axis=1)
        error = abs(float(weights @ positions @ velocity)) / math.hypot(*weights) / speed
        self._judge(time - self._rows[2][0], error, speed)

    def _judge(self, interval: float, error: float, speed: float) -> None:
        """Take in an error along the motion, in m, a speed, and the interval before the sample."""
        tuning = self._tuning
        self._errors.append((interval, error, speed))
        self._moved += interval
        while self._moved - self._errors[0][0] >= tuning.window:
            self._moved -= self._errors.popleft()[0]
        if self._moved < tuning.window or len(self._errors) < tuning.count:
            return
        _, errors, speeds = np.array(self._errors).T
        errors = errors.clip(max=tuning.outlier * np.median(errors))
        self.scatter = math.hypot(*errors) / math.hypot(*speeds)
        # an alarm lasts until the scatter is well below its bound
        self.is_large = self.scatter > (tuning.most / 2 if self.is_large else tuning.most)
