"""Why a channel stays below its command: no more pressure in the line, or a leak."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Shortage"]

Array = NDArray[np.float64]

_CHANGE = 1e4  # Pa, by which a command must have changed to learn anything from it
_SHARE = 0.5  # of what a leak in proportion to the pressure would give
_NOTHING, _MUCH = 0.25, 0.5  # of what is due
_NOTHING_FOR = 1.0  # s, at least


class Shortage:
    """Tells leaks that were there from the beginning, by what channels give when more is asked.

    From one command and one reading nobody can tell a leak from a regulator that has no more
    pressure: both stay below. But the pressure of that regulator is the same whatever it is told,
    and behind a leak it rises and falls with the command, in proportion, more or less. So each
    channel at rest that is short is remembered with what it was told then and what it gave; when it
    is told something else, at rest again and still short, and gives more or less accordingly, it
    leaks.

    A tube that is off gives nothing whatever it is told, as a line without pressure does. A channel
    that has less than a quarter of what is due, while another one has twice as much at least, is
    taken for leaking, whether commands move or not. In between, a leak that takes all that its
    regulator can deliver cannot be told from a line that has no more.

    Parameters
    ----------
    tolerance :
        Shortage (n,) that is too much, in Pa; half of it must be given, or kept back, at least.
    time :
        For how long that must be so, in s.
    """

    def __init__(self, tolerance: Array, time: float) -> None:
        self._tolerance, self._time = tolerance, time
        n = len(tolerance)
        self._due: Array = np.full(n, np.nan)  # remembered; NaN: nothing
        self._gave: Array = np.full(n, np.nan)
        self._for: Array = np.zeros((2, n))  # s, that it follows, and that it gives nothing

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
        """Return which channels (n,) leak for certain.

        Parameters
        ----------
        elapsed :
            Since the last reading, in s.
        short :
            Channels (n,) that have been below what is due for long enough, without those of which
            it is known why.
        due, reading :
            Pressures (n,) that there should be, and are, in Pa.
        at_rest :
            Channels (n,) whose command is; of those that move it tells nothing what they give.
        """
        self._due[~short] = self._gave[~short] = np.nan
        first = short & at_rest & np.isnan(self._due)
        self._due[first], self._gave[first] = due[first], reading[first]
        change = due - self._due
        gives = np.sign(change) * (reading - self._gave)
        proportional = np.abs(change) * self._gave / np.maximum(self._due, 1.0)
        follows = (
            at_rest
            & (np.abs(change) >= _CHANGE)
            & (gives > np.maximum(0.5 * self._tolerance, _SHARE * proportional))
            & (due - reading > self._tolerance)
        )  # NaN, where nothing is remembered or measured, is not
        another = float(np.fmax.reduce(reading)) > _MUCH * due
        much = due - reading > 2 * self._tolerance
        nothing = short & another & much & (reading < _NOTHING * due)
        self._for = np.where((follows, nothing), self._for + elapsed, 0.0)
        within = np.array([[self._time], [max(self._time, _NOTHING_FOR)]])
        follows, nothing = self._for >= within * (1 - 1e-9)
        leaking: NDArray[np.bool_] = follows | nothing
        return leaking
