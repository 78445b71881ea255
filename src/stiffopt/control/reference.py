"""The reference: a smooth path from the present pressures to those of the plan.

Plans jump. Their pressures, and the tip's offset that belongs to them, pass a limit of the slew and
perhaps of the tip's speed, and four equal lags ``a / (s + a)``, which give a path x(t) with three
derivatives. The command that makes the arm follow this path is ::

    x_command = (1 + tau s) (1 + 2 zeta / omega s + s^2 / omega^2) x,

the inverse of the regulators and the first bending mode; the command leads by one dead time. All
channels have the same filter. So they follow a straight line in the space of pressures, on which no
limit can be violated, and reach the plan together.
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.control.formula import Formula

Array = NDArray[np.float64]

_LAGS = 4
_LONGEST = 2.0  # s, longest half period of a vibration that is averaged over
# from the lags' states to the last state and its derivatives, in units of the rate
_DIFFERENCES = np.array(
    [[0, 0, 0, 0, 1], [0, 0, 0, 1, -1], [0, 0, 1, -2, 1], [0, 1, -3, 3, -1]], dtype=float
)


class Reference:
    """The path to the plan, of n pressures and `extra` = m numbers that belong to them.

    A step takes `period`, in s. The pressures change by at most a share of the slew (n,), in Pa/s.
    `lag` is that of the regulators, in s; `damping` the vibration's damping ratio.
    """

    def __init__(
        self,
        period: float,
        slew: Array,
        lag: float,
        damping: float = 0.0,
        extra: int = 0,
        slew_share: float = 0.9,
    ) -> None:
        self._period, self._lag, self._damping = period, lag, damping
        self._step = _step(slew * period, extra)
        self.slew_share = slew_share  # share of the slew that the pressures may use
        # motion of the tip per pressure (3, n), over the greatest one in a step; 0: no bound
        self.motion_share: Array = np.zeros((3, len(slew)))
        self._filter_of: tuple[float, float] | None = None  # rate and omega
        self._filter: tuple[Array, ...] = ()
        self.rate = 1.0  # a of the four lags, in 1/s
        self.omega = math.inf  # of the vibration, in rad/s; infinite where there is none
        self.begin(np.zeros(len(slew) + extra))

    def begin(self, values: Array) -> None:
        """Restart at rest, at pressures and the numbers that belong to them (n + m,)."""
        self._states = np.tile(values, (_LAGS + 1, 1))
        # the path now and its first three time derivatives, in s
        self.motion = np.concatenate([self._states[-1:], np.zeros((_LAGS - 1, len(values)))])

    def shift(self, change: Array) -> None:
        """Add a change (m,) to the numbers that belong to the pressures, along the whole path."""
        n = self._states.shape[1] - len(change)
        self._states[:, n:] += change
        self.motion[0, n:] += change

    def set_lag(self, lag: float) -> None:
        """Change the regulators' lag, in s; without a jump if the path rests."""
        self._lag, self._filter_of = lag, None

    @property
    def delay(self) -> float:
        """Delay of the path behind the plan, in s."""
        return _LAGS / self.rate

    @property
    def goal(self) -> Array:
        """Where the path comes to rest if the plan no longer changes (n + m,)."""
        value: Array = self._states[0]
        return value

    @property
    def path(self) -> Array:
        """The path now (n + m,)."""
        value: Array = self.motion[0]
        return value

    def advance(self, plan: Array) -> None:
        """Take a step towards a plan (n + m,).

        This sets `command`, the pressures (n,) to command, and `chamber`, those in the chambers
        when the command acts, in Pa.
        """
        if self._filter_of != (self.rate, self.omega):
            self._filter_of, self._filter = (self.rate, self.omega), self._matrices()
        self._states, self.motion, self.command, self.chamber = self._step(
            self._states, plan, *self._filter, self.slew_share, self.motion_share
        )

    def _matrices(self) -> tuple[Array, ...]:
        """Return the transition matrix (5, 5) under a constant input, and weights; see `_step`."""
        a, x = self.rate, self.rate * self._period
        # the step response of k lags in series is 1 minus the sum of the first k terms
        terms = [math.exp(-x) * x**k / math.factorial(k) for k in range(_LAGS)]
        M = np.eye(_LAGS + 1)
        for i in range(1, _LAGS + 1):
            M[i, 0] = 1 - sum(terms[:i])
            for k in range(i):
                M[i, i - k] = terms[k]
        c1, c2, tau = 2 * self._damping / self.omega, 1 / self.omega**2, self._lag
        return (
            M,
            np.array([[1.0], [a], [a**2], [a**3]]) * _DIFFERENCES,
            np.array([1.0, c1 + tau, c2 + tau * c1, tau * c2]),
            np.array([1.0, c1, c2, 0.0]),
        )


class VibrationFilter:
    """Averages what feedback corrects over one vibration, so that the correction excites none.

    The average of four values, a quarter of the vibration's period T apart, has zeros at its
    frequency and at twice and three times it; in some postures the second bending mode is near one
    of them. The first mode, with damping ratio zeta, follows the average on a path without residual
    vibration: the average is two steps of half the height, T / 2 apart (zero-vibration shaping), of
    the mean of two values that are T / 4 apart. It is late by 3 / 8 T.
    """

    def __init__(self, period: float, damping: float, m: int) -> None:
        self._period, self._damping = period, damping
        self._kept = 2 * math.ceil(_LONGEST / period) + 4
        self.begin(np.zeros(m))

    def begin(self, values: Array) -> None:
        """Restart with values (m,) that have long been constant."""
        # the newest first, stored twice: any `_kept` in a row are contiguous
        self._past = np.tile(values, (2 * self._kept, 1))
        self._newest = self._kept
        self._omega, self._weights = math.inf, np.array([[1.0], [1.0], [0.0]])
        self.value = values  # the average
        self.motion = np.stack([values, np.zeros(len(values))])  # path and speed of the mode

    def shift(self, change: Array) -> None:
        """Add a change (m,) to all values, past ones as well."""
        self._past += change
        self.value = self.value + change
        self.motion = self.motion + np.stack([change, np.zeros(len(change))])

    def advance(self, values: Array, omega: float) -> None:
        """Take in values (m,) with a vibration of `omega`, in rad/s; infinite: no vibration."""
        self._newest = (self._newest or self._kept) - 1
        self._past[self._newest] = self._past[self._newest + self._kept] = values
        if omega != self._omega:
            self._omega, self._weights = omega, self._shape(omega)
        past = self._past[self._newest : self._newest + self._weights.shape[1]]
        averaged = self._weights @ past
        self.value, self.motion = averaged[0], averaged[1:]

    def _shape(self, omega: float) -> Array:
        """Return weights (3, k) of average, path and speed, for the newest value first."""
        half = min(math.pi / omega, _LONGEST) / self._period
        if half < 1:
            return np.array([[1.0, 0.0], [1.0, 0.0], [1 / self._period, -1 / self._period]])
        later = 1 / (1 + math.exp(self._damping * omega * self._period * half))
        times: Array = np.arange(math.ceil(half) + 1.0)
        steps = (1 - later) * _impulse(times, 0.0) + later * _impulse(times, half)
        mode = np.exp(-self._damping * omega * self._period * times)
        mode *= np.maximum(np.sin(math.pi * times / half), 0.0)
        pair = (_impulse(times, 0.0) + _impulse(times, half / 2)) / 2
        value, path = np.convolve(steps, pair), np.convolve(mode / mode.sum(), pair)
        rate = np.diff(path, prepend=0.0) / self._period
        return np.stack([value, path, rate])


def _impulse(times: Array, at: float) -> Array:
    """Return weights (k,), of sum 1, of a value at a time between two whole ones."""
    weights: Array = np.maximum(1 - np.abs(times - at), 0.0)
    return weights


def _step(reach: Array, extra: int) -> Formula:
    """Return the formula of a step: states (5, n + m), motion (4, n + m), command, chamber (n,).

    Inputs: states, the first being the input of the lags; the plan (n + m,); transition
    matrix (5, 5); differences (4, 5); weights (4,) of the motion in command and chamber; the share
    of `reach`, the greatest change of the n pressures in a step, that may be used; the motion of
    the tip per pressure (3, n), over the greatest one in a step, of all channels or of one.
    """
    n = len(reach)
    states, plan = ca.SX.sym("states", _LAGS + 1, n + extra), ca.SX.sym("plan", n + extra)
    transition = ca.SX.sym("transition", _LAGS + 1, _LAGS + 1)
    differences = ca.SX.sym("differences", _LAGS, _LAGS + 1)
    command, chamber = ca.SX.sym("command", _LAGS), ca.SX.sym("chamber", _LAGS)
    slew_share, motion_share = ca.SX.sym("slew_share"), ca.SX.sym("motion_share", 3, n)
    way = plan.T - states[0, :]
    # all channels take the share of their way that the slowest one can cover in a step
    steps = ca.mmax(ca.fabs(way[:n]).T / ca.DM(reach)) / slew_share
    moved = motion_share @ ca.diag(way[:n])
    squares = ca.vertcat(ca.sum1(moved**2).T, ca.sumsqr(ca.sum2(moved)))
    steps = ca.fmax(steps, ca.sqrt(ca.mmax(squares)))
    share = ca.if_else(steps > 1, 1 / steps, 1)
    begun = ca.vertcat(states[0, :] + share * way, states[1:, :])
    after = transition @ begun
    motion = differences @ after
    pressures = motion[:, :n].T
    inputs = [states, plan, transition, differences, command, chamber, slew_share, motion_share]
    outputs = [after, motion, pressures @ command, pressures @ chamber]
    return Formula(inputs, outputs, [states, motion_share, after, motion])
