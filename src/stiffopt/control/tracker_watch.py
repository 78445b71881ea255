"""Whether the tracker still sees the tip, and believably."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from stiffopt.control.steering import Seen
from stiffopt.rig.interface import PoseSample
from stiffopt.rig.settings import Safety

__all__ = ["BACK", "ENOUGH", "Sight", "TrackerWatch"]

Array = NDArray[np.float64]

_KEPT = 24  # samples from which the usual interval and latency are learned
ENOUGH = 8
"""Samples without which neither is known."""
BACK = 8
"""Ticks with new samples, none of them missing for too long, after which the tip is seen again."""
_JITTER = 0.25  # share of an interval by which a sample may be late


class Sight(Enum):
    """What the tracker does."""

    SEEN = "seen"
    MISSING = "missing"
    LOST = "lost"


class TrackerWatch:
    """Says for how long the tip has not been seen, and whether it jumps.

    Only a sample that was used and is newer than all before counts: nothing that is missing, not
    visible, rejected, out of order, or of the same frame again. How old samples usually are, and
    how far apart, is learned until the loop is armed; a sample is overdue by its age beyond that.

    A tip that was missing is seen again only after `BACK` ticks with new samples, in which it was
    not missing: one good sample now and then must not make the loop steer now and then. It is lost
    when there was no good sample for the timeout, not even one now and then.

    Of a tracker so slow that the frames which may be missing last longer than the timeout, the tip
    is missing at the timeout, and lost only after that. One whose frames are further apart than the
    timeout never sees it.

    Parameters
    ----------
    safety :
        How much may be missing.
    period :
        Of the loop, in s: the accuracy with which it can tell.

    Attributes
    ----------
    jumps : int
        Samples in a row that were rejected.
    """

    def __init__(self, safety: Safety, period: float) -> None:
        self._safety, self._period = safety, period
        self.jumps = 0
        self._back = BACK  # ticks with new samples since the tip was missing
        self._frame: int | None = None
        self._reported = self._latest = -np.inf
        self.usual = safety.tracker_timeout / safety.tracker_frames, 0.0
        """Time between samples and their age on arrival, in s; a guess before there are enough."""
        self._before = -np.inf
        self._intervals: deque[float] = deque(maxlen=_KEPT)
        self._ages: deque[float] = deque(maxlen=_KEPT)
        self._positions: deque[Array] = deque(maxlen=_KEPT)

    def forget(self) -> None:
        """Learn anew; until there are enough samples, what was usual still is."""
        self._before = -np.inf
        self._intervals.clear()
        self._ages.clear()
        self._positions.clear()

    def new(self, samples: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """Return the samples without those that have the number of the frame before them."""
        if not samples:
            return samples
        fresh = []
        for sample in samples:
            if sample.frame != self._frame:
                self._frame = sample.frame
                fresh.append(sample)
        return fresh

    def learn(self, now: float, samples: Sequence[PoseSample]) -> None:
        """Take in new samples of a vented arm."""
        for sample in samples:
            if not sample.visible or not self._before < sample.time <= now:
                continue
            if self._before > -np.inf:
                self._intervals.append(sample.time - self._before)
            self._before = sample.time
            self._positions.append(sample.position)
            self._ages.append(now - sample.time)
            if len(self._positions) >= ENOUGH:
                self.usual = _median(self._intervals), _median(self._ages)

    @property
    def samples(self) -> int:
        """Number of samples that were learned from."""
        return len(self._positions)

    @property
    def position(self) -> Array:
        """Where the tip of the vented arm was seen (3,), in m."""
        return np.median(np.array(self._positions), axis=0)

    def update(self, now: float, seen: Seen) -> None:
        """Take in what became of the samples of a tick."""
        if self._latest == -np.inf:
            self._latest = now  # it is given some time before it is missing
        is_new = False
        if seen.used:
            self.jumps = 0
            if is_new := seen.latest > self._reported:
                self._reported = seen.latest
                self._latest = min(seen.latest, now)  # none is from the future
        elif seen.rejected:
            self.jumps += seen.rejected
        if self._by_age(now) is not Sight.SEEN:
            self._back = 0
        elif is_new:
            self._back += 1

    def overdue(self, now: float) -> float:
        """Age of the newest sample that was used beyond the usual, in s."""
        return now - self._latest - self.usual[1]

    def sight(self, now: float) -> Sight:
        """Say whether the tip is seen."""
        sight = self._by_age(now)
        return Sight.MISSING if sight is Sight.SEEN and self._back < BACK else sight

    def _by_age(self, now: float) -> Sight:
        """Say the same of the newest sample alone."""
        interval, _ = self.usual
        overdue = self.overdue(now)
        slack = self._period + _JITTER * interval
        timeout = self._safety.tracker_timeout
        if overdue > timeout + slack:
            return Sight.LOST
        # lost comes after missing by the slack at least, in which there is a tick
        if overdue > min(self._safety.tracker_frames * interval + slack, timeout):
            return Sight.MISSING
        return Sight.SEEN

    @property
    def jumping(self) -> bool:
        """Whether it jumps too often to be believed."""
        return self.jumps >= self._safety.max_jumps


def _median(values: deque[float]) -> float:
    return sorted(values)[len(values) // 2]
