"""Where the pressures are on their way to the commands, and where they will be.

Each regulator follows its set-point after a dead time, as a first-order lag ``tau x' = u + b - x``
of limited slew.  Readings correct x and the offset b, so that a regulator that saturates, leaks or
is off by a little is taken for where it is, not for where it should be.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["RegulatorModel"]

Array = NDArray[np.float64]

_TRUST = 30.0  # 1/s, at which a reading corrects the pressure
_LEARN = 225.0  # 1/s^2, at which it corrects the offset


class RegulatorModel:
    """Pressures of n channels, followed in equal steps.

    Parameters
    ----------
    period :
        Of the steps, in s.
    lag, dead_time :
        Of the regulators (n,), in s.
    slew :
        Greatest rate of change (n,), in Pa/s.

    Attributes
    ----------
    pressures : ndarray
        (n,) now, in Pa.
    offset : ndarray
        (n,) by which the pressures end beside the commands, in Pa.
    """

    def __init__(self, period: float, lag: ArrayLike, dead_time: float, slew: Array) -> None:
        n = len(slew)
        self._period = period
        lags = np.broadcast_to(np.asarray(lag, dtype=float), n)
        self._share = 1 - np.exp(-period / np.maximum(lags, 1e-6))
        self._most = slew * period
        self._delay = round(dead_time / period)
        self._trust, self._learn = min(1.0, _TRUST * period), _LEARN * period**2
        self.pressures: Array = np.zeros(n)
        self.offset: Array = np.zeros(n)
        self._sent: deque[Array] = deque()
        self.begin(np.zeros(n))

    def begin(self, pressures: Array) -> None:
        """Start anew, settled at pressures (n,)."""
        self.pressures, self.offset = pressures.copy(), np.zeros_like(pressures)
        self._sent = deque([pressures.copy()] * (self._delay + 1), maxlen=self._delay + 1)

    def advance(self, commanded: Array, reading: Array) -> Array:
        """Take a step in which (n,) was commanded, at whose end (n,) is read; NaN: not measured.

        Returns
        -------
        Pressures (n,) now, in Pa.
        """
        self._sent.append(commanded)
        x = self._stepped(self.pressures, self._sent[0])
        error = reading - x
        error[~np.isfinite(error)] = 0.0
        self.offset = self.offset + self._learn * error / self._share
        self.pressures = x + self._trust * error
        return self.pressures

    def ahead(self) -> Array:
        """Pressures (n,) a dead time from now, which no further command can change."""
        x = self.pressures
        for sent in list(self._sent)[1:]:
            x = self._stepped(x, sent)
        return x

    def _stepped(self, x: Array, command: Array) -> Array:
        change = self._share * (command + self.offset - x)
        result: Array = x + np.minimum(np.maximum(change, -self._most), self._most)
        return result
