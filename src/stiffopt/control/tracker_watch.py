"""Whether the tracker sees the tip, and whether its samples are credible."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from stiffopt.control.interface import SampleCounts
from stiffopt.control.tuning import TrackerTuning
from stiffopt.rig.interface import PoseSample
from stiffopt.rig.settings import Safety

Array = NDArray[np.float64]


class Sight(Enum):
    """Whether the tracker sees the tip."""

    SEEN = "seen"
    MISSING = "missing"
    LOST = "lost"


class TrackerWatch:
    """Watches for how long the tip has not been seen, and whether it seems to jump.

    Only samples count that were used and are newer than all before. The usual interval and age of
    samples are learned until the loop is armed; a sample is overdue by its age beyond the usual.

    A tip that was missing is seen again after `TrackerTuning.back` ticks with new samples in which
    none was overdue: single samples must not switch control on and off. It is lost when no sample
    was used for the timeout.

    With a tracker so slow that the frames which may be missing take longer than the timeout, the
    tip is missing at the timeout, and lost shortly after. With an interval longer than the timeout
    it is never seen. The period of the loop, in s, is the resolution of these times.
    """

    def __init__(self, safety: Safety, period: float, tuning: TrackerTuning | None = None) -> None:
        self._safety, self._period = safety, period
        self.tuning = tuning = tuning or TrackerTuning()
        self.jumps = 0  # samples in a row that were rejected
        self._back = tuning.back  # ticks with new samples since the tip was missing
        self._frame: int | None = None
        self._reported = self._latest = -np.inf
        # interval between samples, and their age on arrival, in s; a guess before they are learned
        self.usual = safety.tracker_timeout / safety.tracker_frames, 0.0
        self._before = -np.inf
        self._intervals: deque[float] = deque(maxlen=tuning.window)
        self._ages: deque[float] = deque(maxlen=tuning.window)
        self._positions: deque[Array] = deque(maxlen=tuning.window)

    def forget(self) -> None:
        """Learn anew; until there are enough samples, interval and age stay as they were."""
        self._before = -np.inf
        self._intervals.clear()
        self._ages.clear()
        self._positions.clear()

    def begin(self, now: float) -> None:
        """Start anew from a time at which the tip is seen, in s: the first samples take a while."""
        self.jumps = 0
        self._latest = max(self._latest, now - self.usual[1])

    def new(self, samples: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """Return the samples without repetitions of a frame."""
        if not samples:
            return samples
        fresh = []
        for sample in samples:
            if sample.frame != self._frame:
                self._frame = sample.frame
                fresh.append(sample)
        return fresh

    def learn(self, now: float, samples: Sequence[PoseSample]) -> None:
        """Learn interval, age and position from samples of a vented arm."""
        for sample in samples:
            if not sample.visible or not self._before < sample.time <= now:
                continue
            if self._before > -np.inf:
                self._intervals.append(sample.time - self._before)
            self._before = sample.time
            self._positions.append(sample.position)
            self._ages.append(now - sample.time)
            if len(self._positions) >= self.tuning.enough:
                self.usual = _median(self._intervals), _median(self._ages)

    @property
    def samples(self) -> int:
        """Number of samples learned from."""
        return len(self._positions)

    @property
    def position(self) -> Array:
        """Position of the tip of the vented arm (3,), in m."""
        return np.median(np.array(self._positions), axis=0)

    @property
    def noise(self) -> float:
        """Standard deviation of a sample of the vented arm in each axis, in m."""
        return float(np.sqrt(np.mean(np.var(np.array(self._positions), axis=0))))

    def update(self, now: float, seen: SampleCounts) -> None:
        """Take in how many samples of a tick were used or rejected."""
        if self._latest == -np.inf:
            self._latest = now  # from here on it may be missing
        is_new = False
        if seen.used:
            self.jumps = 0
            if is_new := seen.latest > self._reported:
                self._reported = seen.latest
                self._latest = min(seen.latest, now)  # not from the future
        elif seen.rejected:
            self.jumps += seen.rejected
        if self._by_age(now) is not Sight.SEEN:
            self._back = 0
        elif is_new:
            self._back += 1

    def overdue(self, now: float) -> float:
        """Age of the newest sample used, beyond the usual age, in s."""
        return now - self._latest - self.usual[1]

    def sight(self, now: float) -> Sight:
        """Return whether the tip is seen."""
        sight = self._by_age(now)
        return Sight.MISSING if sight is Sight.SEEN and self._back < self.tuning.back else sight

    def _by_age(self, now: float) -> Sight:
        """Return the same by the age of the newest sample alone."""
        interval, _ = self.usual
        overdue = self.overdue(now)
        slack = self._period + self.tuning.jitter * interval
        timeout = self._safety.tracker_timeout
        if overdue > timeout + slack:
            return Sight.LOST
        # missing precedes lost by the slack at least, and so by one tick
        if overdue > min(self._safety.tracker_frames * interval + slack, timeout):
            return Sight.MISSING
        return Sight.SEEN

    @property
    def jumping(self) -> bool:
        """Whether so many samples in a row were rejected that it is a fault."""
        return self.jumps >= self._safety.max_jumps


def _median(values: deque[float]) -> float:
    return sorted(values)[len(values) // 2]
