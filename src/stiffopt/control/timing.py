"""When ticks are due, and statistics of how late and how long they are."""

from __future__ import annotations

from bisect import bisect_left

from stiffopt.control.state import Timing

__all__ = ["TickTiming"]

_EDGES = tuple(float(f"{m}e{e}") for e in range(-6, 0) for m in (1, 2, 5))
"""Upper edges of the histogram of lateness, from 1 us to 0.5 s, three per decade."""


class TickTiming:
    """Due times of ticks, and counts of ticks, overruns and lateness.

    Parameters
    ----------
    period :
        Of the loop, in s.

    Attributes
    ----------
    overruns_in_a_row : int
        The last ticks that ended after the next one was due.
    missed : int
        Ticks that were skipped because they were overdue.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._lateness = [0] * (len(_EDGES) + 1)  # the last bin has no upper edge
        self._ticks = self._overruns = 0
        self._tick_time = 0.0
        self.overruns_in_a_row = 0
        self.missed = 0

    def begin(self, due: float | None, now: float) -> None:
        """Note when a tick begins, and when it was due, if it was."""
        if due is not None:
            self._lateness[bisect_left(_EDGES, now - due)] += 1

    def end(self, due: float, now: float, tick_time: float) -> None:
        """Note when a tick ends, when it was due, and how long it took, in s."""
        self._ticks += 1
        self._tick_time = tick_time
        if now > due + self._period * (1 + 1e-9):
            self._overruns += 1
            self.overruns_in_a_row += 1
        else:
            self.overruns_in_a_row = 0

    def next_due(self, due: float, now: float) -> float:
        """Return when the next tick is due that is not overdue already; count those that are."""
        due += self._period
        if due < now:
            late = int((now - due) / self._period) + 1
            self.missed += late
            due += late * self._period
        return due

    def statistics(self) -> Timing:
        """Return the statistics so far."""
        counts = tuple(self._lateness)
        return Timing(self._ticks, self._overruns, self._tick_time, _EDGES, counts)
