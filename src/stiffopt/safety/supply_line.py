"""What the common supply line has, where several channels are at its end together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["SupplyLine"]

Array = NDArray[np.float64]

_SEVERAL = 2  # channels; one alone tells nothing
_LOST = 0.5  # of the highest pressure that was read; a line with less than that has failed


class SupplyLine:
    """Tells a line that sags from leaks, by channels that fall together.

    Regulators that share a line and have too little all give what the line has. So where a channel
    is short, and another one reads the same and is short too, be it by half as much, and no channel
    reads more, that is the pressure of the line. A channel that leaks reads less than others, or is
    short alone.

    A line that has lost half of the highest pressure that was read is not taken for one that sags.

    Parameters
    ----------
    shortage :
        Pressure (n,) below what is due from which a channel is short, in Pa; readings that differ
        by less are the same.

    Attributes
    ----------
    pressure : float
        What the line has at least, since channels were at its end last, in Pa; inf if they never
        were, or if it has failed.
    """

    def __init__(self, shortage: Array) -> None:
        self._shortage = shortage
        self._little: Array = 0.5 * shortage
        self._none: NDArray[np.bool_] = np.zeros(len(shortage), dtype=bool)
        self.pressure = np.inf

    @property
    def known(self) -> bool:
        """Whether it is known what the line has."""
        return self.pressure < np.inf

    def clear(self) -> None:
        """Forget what it had."""
        self.pressure = np.inf

    def look(self, missing: Array, reading: Array, reached: Array) -> NDArray[np.bool_]:
        """Return which channels (n,) are at its end together.

        Parameters
        ----------
        missing :
            What is due and not read (n,), in Pa.
        reading, reached :
            Pressures (n,) that are read, and the highest that were, in Pa.
        """
        short = missing > self._shortage  # NaN, where nothing is measured, is not
        if not (self.known or short.any()):
            return self._none
        highest = float(np.fmax.reduce(reading))
        together = (missing > self._little) & (reading > highest - self._shortage)
        if np.count_nonzero(together) < _SEVERAL or not (together & short).any():
            self.pressure = max(self.pressure, highest)  # NaN, if nothing is measured, is not more
            return self._none
        if highest < _LOST * float(reached.max()):
            self.pressure = np.inf
            return self._none
        self.pressure = highest
        return together
