"""Whether the tracker sees the tip, and whether its samples are credible."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from enum import Enum

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.interface import SampleCounts
from stiffopt.control.noticing_tuning import TrackerTuning
from stiffopt.rig.interface import PoseSample
from stiffopt.rig.settings import Safety


class Sight(Enum):
    """Whether the tracker sees the tip."""

    SEEN = "seen"
    MISSING = "missing"
    LOST = "lost"


class TrackerWatch:
    """Watches for how long the tip has not been seen, and whether it seems to jump.

    A sample counts only if it was used and is newer than all before. Until the loop is armed, the
    watch learns the usual interval and age of samples; a sample is overdue by its age beyond the
    usual one.

    A tip that was missing is seen again after `TrackerTuning.back` ticks with new samples in which
    none was overdue, so that single samples do not switch control on and off. It is lost when no
    sample was used for the timeout.

    If the tracker is so slow that the permitted number of missing frames takes longer than the
    timeout, the tip is missing at the timeout and lost shortly after. If its interval exceeds the
    timeout, the tip is never seen. The loop's period, in s, is the resolution of these times.
    """

    def __init__(self, safety: Safety, period: float, tuning: TrackerTuning | None = None) -> None:
        self._safety, self._period = safety, period
        self.tuning = tuning = tuning or TrackerTuning()
        self.jumps = 0  # successive samples that were rejected
        self._back = tuning.back  # ticks with new samples since the tip was missing
        self._frame: int | None = None
        self._reported = self._latest = -np.inf
        # interval between samples, and their age on arrival, in s; a guess until learned
        self.usual = safety.tracker_timeout / safety.tracker_frames, 0.0
        self._before = -np.inf
        self._intervals: deque[float] = deque(maxlen=tuning.window)
        self._ages: deque[float] = deque(maxlen=tuning.window)
        self._positions: deque[Array] = deque(maxlen=tuning.window)

    def forget(self) -> None:
        """Learn again; until there are enough samples, interval and age keep their values."""
        self._before = -np.inf
        self._intervals.clear()
        self._ages.clear()
        self._positions.clear()

    def begin(self, now: float) -> None:
        """Restart at a time at which the tip is seen, in s: the first samples take a while."""
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
            self._latest = now  # the tip may be missing from now on
        is_new = False
        if seen.used:
            self.jumps = 0
            if is_new := seen.latest > self._reported:
                self._reported = seen.latest
                self._latest = min(seen.latest, now)  # never in the future
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
        """Return whether the tip is seen, by the age of the newest sample alone."""
        interval, _ = self.usual
        overdue = self.overdue(now)
        slack = self._period + self.tuning.jitter * interval
        timeout = self._safety.tracker_timeout
        if overdue > timeout + slack:
            return Sight.LOST
        # a tip is missing at least the slack, and so one tick, before it is lost
        if overdue > min(self._safety.tracker_frames * interval + slack, timeout):
            return Sight.MISSING
        return Sight.SEEN

    @property
    def jumping(self) -> bool:
        """Whether so many successive samples were rejected that it is a fault."""
        return self.jumps >= self._safety.max_jumps


def _median(values: deque[float]) -> float:
    return sorted(values)[len(values) // 2]
