"""Why a channel stays below its command: a leak, or too little pressure in the supply line.

`Shortage` distinguishes the two by the response of one channel to a change of its command,
`SupplyLine` by several channels that fall together.
"""

from __future__ import annotations

import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.safety.settings import MONITOR


class Shortage:
    """Finds channels that have leaked from the beginning, by their response to a changed command.

    One command and one reading cannot distinguish a leak from a regulator whose supply has no more
    pressure: both channels stay below their commands. But the latter reads the same at any command,
    whereas behind a leak the pressure rises and falls with the command, roughly in proportion. So
    the command and reading of each channel that is short at rest are remembered. If the command
    changes, and the channel at rest again is still short but reads accordingly more or less, it
    leaks.

    A disconnected tube has no pressure at any command, like a line without pressure. A channel
    below the share `nothing` of its expected pressure counts as leaking if another one is above the
    share `much` of it, even while commands move. Between these cases, a leak that takes all that
    its regulator can deliver is indistinguishable from a line that has no more.

    `tolerance`: shortage (n,) that is too much, in Pa; a response must be at least half of it.
    `time`: minimum duration of these conditions, in s.
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
        short: Flags,
        due: Array,
        reading: Array,
        at_rest: Flags,
    ) -> Flags:
        """Return which channels (n,) certainly leak.

        Parameters
        ----------
        elapsed : time since the last reading, in s.
        short : channels (n,) that have been below what is due for too long, for no known reason.
        due, reading : expected and measured pressures (n,), in Pa.
        at_rest : channels (n,) whose commands are at rest; readings of others show nothing here.
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
        return follows | nothing


class SupplyLine:
    """Distinguishes a sagging supply line from leaks, by channels that fall together.

    Regulators on a line with too little pressure all deliver the pressure of the line. That is
    found if one channel is short, another one reads the same and is short by at least half as much,
    and no channel reads more. A leaking channel reads less than the others, or is the only short
    one.

    A line that has lost more than half of the highest measured pressure has failed, not sagged.

    Parameters
    ----------
    shortage : pressure (n,) below what is due beyond which a channel is short, in Pa; readings that
        differ by less count as the same.

    Attributes
    ----------
    pressure : pressure, in Pa, that the line has had at least since it limited several channels;
        inf if it never did, or has failed.
    """

    def __init__(self, shortage: Array) -> None:
        self._shortage = shortage
        self._little: Array = 0.5 * shortage
        self._none: Flags = np.zeros(len(shortage), dtype=bool)
        self.pressure = np.inf

    @property
    def known(self) -> bool:
        """Whether the pressure of the line is known."""
        return self.pressure < np.inf

    def clear(self) -> None:
        """Forget the pressure of the line."""
        self.pressure = np.inf

    def look(self, missing: Array, reading: Array, reached: Array) -> Flags:
        """Return which channels (n,) have the pressure of a sagging line.

        `missing`: expected less measured pressures (n,), in Pa. `reading`, `reached`: measured
        pressures (n,), and the highest since arming, in Pa.
        """
        short = missing > self._shortage  # False where nothing is measured (NaN)
        if not (self.known or short.any()):
            return self._none
        highest = float(np.fmax.reduce(reading))
        together = (missing > self._little) & (reading > highest - self._shortage)
        if np.count_nonzero(together) < MONITOR.line_channels or not (together & short).any():
            self.pressure = max(self.pressure, highest)  # ignores NaN: nothing measured
            return self._none
        if highest < MONITOR.line_lost * float(reached.max()):
            self.pressure = np.inf
            return self._none
        self.pressure = highest
        return together
