"""How punctual the loop is."""

from __future__ import annotations

from bisect import bisect_left

from stiffopt.control.state import Timing

__all__ = ["LatenessHistogram", "Punctuality"]

_EDGES = tuple(float(f"{m}e{e}") for e in range(-6, 0) for m in (1, 2, 5))
"""Upper edges from 1 us to 0.5 s, three a decade."""


class LatenessHistogram:
    """Counts delays in bins that grow with them.

    Attributes
    ----------
    edges : tuple of float
        Upper edges of all bins but the last (k,), in s.
    counts : list of int
        (k + 1,); the last bin takes all that is later.
    """

    def __init__(self) -> None:
        self.edges = _EDGES
        self.counts = [0] * (len(_EDGES) + 1)

    def add(self, lateness: float) -> None:
        """Count a delay, in s; what is early is not late."""
        self.counts[bisect_left(self.edges, lateness)] += 1


class Punctuality:
    """Counts ticks, late ones and overruns.

    Parameters
    ----------
    period :
        Of the loop, in s.

    Attributes
    ----------
    overruns_in_a_row : int
        The last ticks that ended after the next one was due.
    missed : int
        Ticks that were left out because it was too late for them.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._lateness = LatenessHistogram()
        self._ticks = self._overruns = 0
        self._tick_time = 0.0
        self.overruns_in_a_row = 0
        self.missed = 0

    def begin(self, due: float | None, now: float) -> None:
        """Note when a tick begins, and when it was due, if it was."""
        if due is not None:
            self._lateness.add(now - due)

    def end(self, due: float, now: float, tick_time: float) -> None:
        """Note that a tick ends, when it was due, and what it took, in s."""
        self._ticks += 1
        self._tick_time = tick_time
        if now > due + self._period * (1 + 1e-9):
            self._overruns += 1
            self.overruns_in_a_row += 1
        else:
            self.overruns_in_a_row = 0

    def next_due(self, due: float, now: float) -> float:
        """Return when the next tick is due that is not over yet; count those that are."""
        due += self._period
        if due < now:
            late = int((now - due) / self._period) + 1
            self.missed += late
            due += late * self._period
        return due

    def timing(self) -> Timing:
        """Return all that as part of a snapshot."""
        counts = tuple(self._lateness.counts)
        return Timing(self._ticks, self._overruns, self._tick_time, self._lateness.edges, counts)
