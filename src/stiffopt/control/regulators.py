"""Where the pressures are on their way to the commands, and where they will be.

Each regulator follows its set-point after a dead time, as a first-order lag ``tau x' = u + b - x``
of limited slew.  Readings correct x and the offset b, so that a regulator that saturates, leaks or
is off by a little is taken for where it is, not for where it should be.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.control.formula import Formula

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
    ahead : ndarray
        (n,) a dead time from now, which no further command can change, in Pa.
    offset : ndarray
        (n,) by which the pressures end beside the commands, in Pa.
    """

    def __init__(self, period: float, lag: ArrayLike, dead_time: float, slew: Array) -> None:
        n = len(slew)
        lags = np.broadcast_to(np.asarray(lag, dtype=float), n)
        share = 1 - np.exp(-period / np.maximum(lags, 1e-6))
        self._depth = round(dead_time / period) + 1
        self._step = _step(share, slew * period, self._depth, period)
        self.begin(np.zeros(n))

    def begin(self, pressures: Array) -> None:
        """Start anew, settled at pressures (n,)."""
        self.pressures, self.offset = pressures.copy(), np.zeros_like(pressures)
        self.ahead = self.pressures
        self._sent = np.tile(pressures, (self._depth, 1))  # the next to arrive comes first

    def advance(self, commanded: Array, reading: Array) -> Array:
        """Take a step in which (n,) was commanded, at whose end (n,) is read; NaN: not measured.

        Returns
        -------
        Pressures (n,) now, in Pa.
        """
        sent = self._sent
        sent[:-1] = sent[1:]
        sent[-1] = commanded
        self.pressures, self.offset, self.ahead = self._step(
            self.pressures, self.offset, sent, reading
        )
        return self.pressures


def _step(share: Array, most: Array, depth: int, period: float) -> Formula:
    """Pressures, offset and pressures ahead (n,) each, from those, commands (depth, n), reading."""
    n = len(share)
    x, offset, reading = ca.SX.sym("x", n), ca.SX.sym("offset", n), ca.SX.sym("reading", n)
    sent = ca.SX.sym("sent", depth, n)

    def moved(x: Any, offset: Any, command: Any) -> Any:
        change = ca.DM(share) * (command.T + offset - x)
        return x + ca.fmin(ca.fmax(change, -ca.DM(most)), ca.DM(most))

    now = moved(x, offset, sent[0, :])
    error = ca.if_else(ca.fabs(reading) < np.inf, reading - now, 0)  # NaN is not less
    offset_after = offset + _LEARN * period**2 * error / ca.DM(share)
    now = now + min(1.0, _TRUST * period) * error
    ahead = now
    for k in range(1, depth):
        ahead = moved(ahead, offset_after, sent[k, :])
    return Formula([x, offset, sent, reading], [now, offset_after, ahead], [sent])
