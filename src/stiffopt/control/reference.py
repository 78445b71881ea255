"""From where the plan jumps to, to a reference that the arm can follow without swinging.

The plan (pressures, and the offset of the tip that it counts with) goes through a limit of slew and
four equal lags ``a / (s + a)``, which leave a path x(t) with three derivatives.  What has to be
commanded for the arm to be on this path is ::

    x_command = (1 + tau s) (1 + 2 zeta / omega s + s^2 / omega^2) x,

the inverse of regulators and first bending mode, one dead time early.  All channels have the same
filter, so that they reach their goal together on a straight way, whatever the tip does between.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["Reference"]

Array = NDArray[np.float64]

_LAGS = 4
# of the levels, that are the derivatives of the last one in units of the rate
_DIFFERENCES = np.array([[0, 0, 0, 1, -1], [0, 0, 1, -2, 1], [0, 1, -3, 3, -1]], dtype=float)


class Reference:
    """A smooth way to the plan, for n pressures and m numbers that go with them.

    Parameters
    ----------
    period :
        Of the steps, in s.
    slew :
        Greatest rates of change (n,), in Pa/s.
    lag, dead_time :
        Of the regulators, in s.

    Attributes
    ----------
    rate : float
        a of the four lags, in 1/s.
    derivatives : ndarray
        First three derivatives (3, n + m) of the path by time, in s.
    """

    def __init__(self, period: float, slew: Array, lag: float, dead_time: float) -> None:
        self._period, self._slew, self._lag, self._dead_time = period, slew, lag, dead_time
        self._n = len(slew)
        self._exact: tuple[float, Array] = (math.nan, np.eye(_LAGS + 1))
        self.rate = 1.0
        self.begin(np.zeros(self._n))

    def begin(self, values: Array) -> None:
        """Start anew, at rest at pressures and what goes with them (n + m,)."""
        self._levels = np.tile(values, (_LAGS + 1, 1))
        self.derivatives = np.zeros((_LAGS - 1, len(values)))

    @property
    def delay(self) -> float:
        """By how much the path is later than the plan, in s."""
        return _LAGS / self.rate

    def advance(self, plan: Array) -> None:
        """Take a step towards a plan (n + m,)."""
        levels, n = self._levels, self._n
        away = plan - levels[0]
        # the share of the way that the slowest channel can go
        needed = float((np.abs(away[:n]) / self._slew).max()) / self._period
        levels[0] += away * min(1.0, 0.9 / needed if needed > 0 else 1.0)
        a = self.rate
        levels = self._levels = self._transition() @ levels
        self.derivatives = np.array([[a], [a**2], [a**3]]) * (_DIFFERENCES @ levels)

    def _transition(self) -> Array:
        """What a step does to the levels (5, 5) while the first one stays: exactly."""
        if self._exact[0] != self.rate:
            x = self.rate * self._period
            # a step of the first of k lags in a row has gone through the last by 1 - sum of these
            parts = [math.exp(-x) * x**k / math.factorial(k) for k in range(_LAGS)]
            M = np.eye(_LAGS + 1)
            for i in range(1, _LAGS + 1):
                M[i, 0] = 1 - sum(parts[:i])
                for k in range(i):
                    M[i, i - k] = parts[k]
            self._exact = self.rate, M
        return self._exact[1]

    @property
    def path(self) -> Array:
        """Where the path is now (n + m,)."""
        value: Array = self._levels[-1]
        return value

    def command(self, omega: float, damping: float) -> tuple[Array, Array]:
        """Pressures (n,) to command, and pressures (n,) in the chambers when they take effect.

        Parameters
        ----------
        omega :
            Angular frequency of the vibration, in rad/s; infinite where there is none.
        damping :
            Its share of critical damping.
        """
        first, second, third = self.derivatives[:, : self._n]
        c1, c2, tau = 2 * damping / omega, 1 / omega**2, self._lag
        chamber = self.path[: self._n] + c1 * first + c2 * second
        return chamber + tau * (first + c1 * second + c2 * third), chamber
