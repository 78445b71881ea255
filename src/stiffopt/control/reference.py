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

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.control.formula import Formula

__all__ = ["Reference"]

Array = NDArray[np.float64]

_LAGS = 4
# of the levels: the last one, and its derivatives in units of the rate
_DIFFERENCES = np.array(
    [[0, 0, 0, 0, 1], [0, 0, 0, 1, -1], [0, 0, 1, -2, 1], [0, 1, -3, 3, -1]], dtype=float
)


class Reference:
    """A smooth way to the plan, for n pressures and m numbers that go with them.

    Parameters
    ----------
    period :
        Of the steps, in s.
    slew :
        Greatest rates of change (n,), in Pa/s.
    lag :
        Of the regulators, in s.
    damping :
        Share of critical damping of the vibration.
    beside :
        m.

    Attributes
    ----------
    rate : float
        a of the four lags, in 1/s.
    omega : float
        Angular frequency of the vibration, in rad/s; infinite where there is none.
    motion : ndarray
        The path now and its first three derivatives by time (4, n + m), in s.
    command, chamber : ndarray
        Pressures (n,) to command, and those in the chambers when they take effect, in Pa.
    """

    def __init__(
        self, period: float, slew: Array, lag: float, damping: float = 0.0, beside: int = 0
    ) -> None:
        self._period, self._lag, self._damping = period, lag, damping
        self._step = _step(slew * period, beside)
        self._told: tuple[float, float] | None = None  # rate and omega of what follows
        self._constants: tuple[Array, ...] = ()
        self.rate, self.omega = 1.0, math.inf
        self.begin(np.zeros(len(slew) + beside))

    def begin(self, values: Array) -> None:
        """Start anew, at rest at pressures and what goes with them (n + m,)."""
        self._levels = np.tile(values, (_LAGS + 1, 1))
        self.motion = np.concatenate([self._levels[-1:], np.zeros((_LAGS - 1, len(values)))])

    @property
    def delay(self) -> float:
        """By how much the path is later than the plan, in s."""
        return _LAGS / self.rate

    @property
    def path(self) -> Array:
        """Where the path is now (n + m,)."""
        value: Array = self.motion[0]
        return value

    def advance(self, plan: Array) -> None:
        """Take a step towards a plan (n + m,)."""
        if self._told != (self.rate, self.omega):
            self._told, self._constants = (self.rate, self.omega), self._computed()
        self._levels, self.motion, self.command, self.chamber = self._step(
            self._levels, plan, *self._constants
        )

    def _computed(self) -> tuple[Array, ...]:
        """What a step does to the levels (5, 5) while the first stays; see `_step`."""
        a, x = self.rate, self.rate * self._period
        # a step of the first of k lags in a row has gone through the last by 1 - sum of these
        parts = [math.exp(-x) * x**k / math.factorial(k) for k in range(_LAGS)]
        M = np.eye(_LAGS + 1)
        for i in range(1, _LAGS + 1):
            M[i, 0] = 1 - sum(parts[:i])
            for k in range(i):
                M[i, i - k] = parts[k]
        c1, c2, tau = 2 * self._damping / self.omega, 1 / self.omega**2, self._lag
        return (
            M,
            np.array([[1.0], [a], [a**2], [a**3]]) * _DIFFERENCES,
            np.array([1.0, c1 + tau, c2 + tau * c1, tau * c2]),
            np.array([1.0, c1, c2, 0.0]),
        )


def _step(most: Array, beside: int) -> Formula:
    """Levels (5, n + m) and motion after a step, and pressures (n,) to command and in the chambers.

    From levels, the plan, what a step does (5, 5), differences (4, 5), and weights (4,) of the
    motion in the command and in the chambers; n pressures may change by `most` in a step.
    """
    n = len(most)
    levels, plan = ca.SX.sym("levels", _LAGS + 1, n + beside), ca.SX.sym("plan", n + beside)
    transition = ca.SX.sym("transition", _LAGS + 1, _LAGS + 1)
    differences = ca.SX.sym("differences", _LAGS, _LAGS + 1)
    command, chamber = ca.SX.sym("command", _LAGS), ca.SX.sym("chamber", _LAGS)
    away = plan.T - levels[0, :]
    # the share of the way that the slowest channel can go
    needed = ca.mmax(ca.fabs(away[:n]).T / ca.DM(most))
    share = ca.if_else(needed > 0.9, 0.9 / needed, 1)
    begun = ca.vertcat(levels[0, :] + share * away, levels[1:, :])
    after = transition @ begun
    motion = differences @ after
    pressures = motion[:, :n].T
    inputs = [levels, plan, transition, differences, command, chamber]
    outputs = [after, motion, pressures @ command, pressures @ chamber]
    return Formula(inputs, outputs, [levels, after, motion])
