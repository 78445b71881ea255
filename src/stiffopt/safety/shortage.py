"""Why a channel stays below its command: a leak, or too little pressure in the supply line.

`Shortage` tells the two apart by how one channel responds when its command changes, `SupplyLine` by
several channels that fall together.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stiffopt.safety.settings import MONITOR

Array = NDArray[np.float64]


class Shortage:
    """Finds channels that have leaked from the beginning, by their response to a changed command.

    One command and one reading cannot tell a leak from a regulator whose supply has no more
    pressure: both channels stay below their commands. But the latter reads the same at any command,
    whereas behind a leak the pressure rises and falls with the command, roughly in proportion. So
    for each channel that is short at rest its command and reading are remembered; if the command
    changes, and the channel at rest again is still short but reads more, or less, accordingly, it
    leaks.

    A disconnected tube has no pressure at any command, like a line without pressure. A channel
    with less than the share `nothing` of what is due, while another one has more than the share
    `much` of it, counts as leaking, also while commands move. In between, a leak that takes all
    that its regulator can deliver cannot be told from a line that has no more.

    Parameters
    ----------
    tolerance :
        Shortage (n,) that is too much, in Pa; a response must be at least half of it.
    time :
        For how long that must be so, in s.
    """

    def __init__(self, tolerance: Array, time: float) -> None:
        self._tolerance, self._time = tolerance, time
        n = len(tolerance)
        self._due: Array = np.full(n, np.nan)  # expected pressure when first short; NaN: not short
        self._gave: Array = np.full(n, np.nan)
        self._for: Array = np.zeros((2, n))  # s for which it has followed, and had no pressure

    def clear(self) -> None:
        """Forget everything."""
        self._due[:] = self._gave[:] = np.nan
        self._for[:] = 0.0

    def leaks(
        self,
        elapsed: float,
        short: NDArray[np.bool_],
        due: Array,
        reading: Array,
        at_rest: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """Return which channels (n,) certainly leak.

        Parameters
        ----------
        elapsed :
            Time since the last reading, in s.
        short :
            Channels (n,) that have been below what is due for long enough, for no known reason.
        due, reading :
            Expected and measured pressures (n,), in Pa.
        at_rest :
            Channels (n,) whose commands are at rest; readings of others tell nothing here.
        """
        self._due[~short] = self._gave[~short] = np.nan
        first = short & at_rest & np.isnan(self._due)
        self._due[first], self._gave[first] = due[first], reading[first]
        change = due - self._due
        gives = np.sign(change) * (reading - self._gave)
        proportional = np.abs(change) * self._gave / np.maximum(self._due, 1.0)
        follows = (
            at_rest
            & (np.abs(change) >= MONITOR.learn_change)
            & (gives > np.maximum(0.5 * self._tolerance, MONITOR.learn_share * proportional))
            & (due - reading > self._tolerance)
        )  # False where nothing is remembered or measured (NaN)
        another = float(np.fmax.reduce(reading)) > MONITOR.much * due
        much = due - reading > 2 * self._tolerance
        nothing = short & another & much & (reading < MONITOR.nothing * due)
        self._for = np.where((follows, nothing), self._for + elapsed, 0.0)
        within = np.array([[self._time], [max(self._time, MONITOR.nothing_time)]])
        follows, nothing = self._for >= within * (1 - 1e-9)
        leaking: NDArray[np.bool_] = follows | nothing
        return leaking


class SupplyLine:
    """Tells a sagging supply line from leaks, by channels that fall together.

    Regulators on a line with too little pressure all pass on the pressure of the line. So if a
    channel is short, another one reads the same and is short too, at least by half as much, and no
    channel reads more, then that is the pressure of the line. A leaking channel reads less than the
    others, or is short alone.

    A line that has lost more than half of the highest pressure that was read has failed, rather
    than sagged.

    Parameters
    ----------
    shortage :
        Pressure (n,) below what is due from which a channel is short, in Pa; readings that differ
        by less are the same.

    Attributes
    ----------
    pressure : float
        Pressure, in Pa, that the line has had at least since it limited several channels; inf if it
        never did, or has failed.
    """

    def __init__(self, shortage: Array) -> None:
        self._shortage = shortage
        self._little: Array = 0.5 * shortage
        self._none: NDArray[np.bool_] = np.zeros(len(shortage), dtype=bool)
        self.pressure = np.inf

    @property
    def known(self) -> bool:
        """Whether the pressure of the line is known."""
        return self.pressure < np.inf

    def clear(self) -> None:
        """Forget the pressure of the line."""
        self.pressure = np.inf

    def look(self, missing: Array, reading: Array, reached: Array) -> NDArray[np.bool_]:
        """Return which channels (n,) have the pressure of a sagging line.

        Parameters
        ----------
        missing :
            Expected less measured pressures (n,), in Pa.
        reading, reached :
            Measured pressures (n,), and the highest since arming, in Pa.
        """
        short = missing > self._shortage  # False where nothing is measured (NaN)
        if not (self.known or short.any()):
            return self._none
        highest = float(np.fmax.reduce(reading))
        together = (missing > self._little) & (reading > highest - self._shortage)
        if np.count_nonzero(together) < MONITOR.line_channels or not (together & short).any():
            self.pressure = max(self.pressure, highest)  # NaN, if nothing is measured, does not win
            return self._none
        if highest < MONITOR.line_lost * float(reached.max()):
            self.pressure = np.inf
            return self._none
        self.pressure = highest
        return together
