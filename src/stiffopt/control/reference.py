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
from typing import Any

import casadi as ca
import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.formula import Formula

Symbols = Any  # of CasADi

_LAGS = 4
_LONGEST = 2.0  # s, longest half period of a vibration that is averaged over
# from the lags' states to the last state and its derivatives, in units of the rate
_DIFFERENCES = ((0, 0, 0, 0, 1), (0, 0, 0, 1, -1), (0, 0, 1, -2, 1), (0, 1, -3, 3, -1))


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
        self._lag = lag
        self._step = _step(period, slew, damping, extra)
        # share of the slew that the pressures may use, of each (n,) or all
        self.slew_share: float | Array = slew_share
        # motion of the tip per pressure (3, n), over the greatest one in a step; 0: no bound
        self.motion_share: Array = np.zeros((3, len(slew)))
        self.rate = 1.0  # a of the four lags, in 1/s
        self.omega = math.inf  # of the vibration, in rad/s; infinite where there is none
        self.begin(np.zeros(len(slew) + extra))

    def begin(self, values: Array) -> None:
        """Restart at rest, at pressures and the numbers that belong to them (n + m,)."""
        self._states = np.tile(values, (_LAGS + 1, 1))
        # the path now and its first three time derivatives, in s
        self.motion = np.concatenate([self._states[-1:], np.zeros((_LAGS - 1, len(values)))])

    def shift(self, change: Array) -> None:
        """Add a change (n + m,) to the pressures and their numbers, along the whole path."""
        self._states += change
        self.motion[0] += change

    def set_lag(self, lag: float) -> None:
        """Change the regulators' lag, in s; without a jump if the path rests."""
        self._lag = lag

    @property
    def delay(self) -> float:
        """Delay of the path behind the plan, in s."""
        return _LAGS / self.rate

    @property
    def goal(self) -> Array:
        """Where the path comes to rest if the plan no longer changes (n + m,)."""
        return self._states[0]

    @property
    def path(self) -> Array:
        """The path now (n + m,)."""
        return self.motion[0]

    def advance(self, plan: Array) -> None:
        """Take a step towards a plan (n + m,).

        This sets `command`, the pressures (n,) to command, and `chamber`, those in the chambers
        when the command acts, in Pa.
        """
        self._states, self.motion, self.command, self.chamber = self._step(
            self._states, plan, self.rate, self.omega, self._lag, self.slew_share,
            self.motion_share,
        )  # fmt: skip


class VibrationFilter:
    """Averages what feedback corrects over one vibration, so that the correction excites none.

    The average of four values, a quarter of the vibration's period T apart, has zeros at its
    frequency and at twice and three times it; in some postures the second bending mode is near one
    of them. The first mode, with damping ratio zeta, follows the average on a path without residual
    vibration: the average is two steps of half the height, T / 2 apart (zero-vibration shaping), of
    the mean of two values that are T / 4 apart. It is late by 3 / 8 T.

    `averages`: the average, and path and speed of the mode (3, m).
    """

    def __init__(self, period: float, damping: float, m: int) -> None:
        self._period, self._damping = period, damping
        self._kept = 2 * math.ceil(_LONGEST / period) + 4
        self._times = np.arange(float(self._kept))  # in steps
        self.begin(np.zeros(m))

    def begin(self, values: Array) -> None:
        """Restart with values (m,) that have long been constant."""
        # the newest first, stored twice: any `_kept` in a row are contiguous
        self._past = np.tile(values, (2 * self._kept, 1))
        self._newest = self._kept
        self._omega, self._weights = math.inf, np.array([[1.0], [1.0], [0.0]])
        self.averages: Array = np.stack([values, values, np.zeros(len(values))])

    def shift(self, change: Array) -> None:
        """Add a change (m,) to all values, past ones as well."""
        self._past += change
        self.averages = self.averages + np.stack([change, change, np.zeros(len(change))])

    @property
    def value(self) -> Array:
        """The average (m,)."""
        return self.averages[0]

    @property
    def motion(self) -> Array:
        """Path and speed of the mode (2, m)."""
        return self.averages[1:]

    def advance(self, values: Array, omega: float) -> None:
        """Take in values (m,) with a vibration of `omega`, in rad/s; infinite: no vibration."""
        self._newest = (self._newest or self._kept) - 1
        self._past[self._newest] = self._past[self._newest + self._kept] = values
        if omega != self._omega:
            self._omega, self._weights = omega, self._shape(omega)
        past = self._past[self._newest : self._newest + self._weights.shape[1]]
        self.averages = self._weights.dot(past)

    def _shape(self, omega: float) -> Array:
        """Return weights (3, k) of average, path and speed, for the newest value first."""
        half = min(math.pi / omega, _LONGEST) / self._period
        if half < 1:
            return np.array([[1.0, 0.0], [1.0, 0.0], [1 / self._period, -1 / self._period]])
        decay = self._damping * omega * self._period
        later = 1 / (1 + math.exp(decay * half))
        whole, quarter = int(half), int(half / 2)
        mode = np.exp((1j * math.pi / half - decay) * self._times[: whole + 1]).imag
        mode /= mode.sum()
        steps = (
            (0, 1 - later),
            (whole, later * (1 - half % 1)),
            (whole + 1, later * (half % 1)),
        )
        weights = np.zeros((3, whole + quarter + 3))
        # the mean of two values a quarter of T apart, between two samples in part
        share = half / 2 % 1
        for delay, part in ((0, 0.5), (quarter, 0.5 * (1 - share)), (quarter + 1, 0.5 * share)):
            for at, height in steps:
                weights[0, delay + at] += part * height
            weights[1, delay : delay + whole + 1] += part * mode
        weights[2] = weights[1] / self._period
        weights[2, 1:] -= weights[1, :-1] / self._period
        return weights


def _step(period: float, slew: Array, damping: float, extra: int) -> Formula:
    """Return the formula of a step: states (5, n + m), motion (4, n + m), command, chamber (n,).

    Inputs: states, the first being the input of the lags; the plan (n + m,); the rate of the lags,
    in 1/s; omega of the vibration, in rad/s; the regulators' lag, in s; the shares of `slew`, the
    greatest rates of the n pressures, that may be used; the motion of the tip per pressure (3, n),
    over the greatest one in a step, of all channels or of one.
    """
    n = len(slew)
    states, plan = ca.SX.sym("states", _LAGS + 1, n + extra), ca.SX.sym("plan", n + extra)
    rate, omega, lag = ca.SX.sym("rate"), ca.SX.sym("omega"), ca.SX.sym("lag")
    slew_share, motion_share = ca.SX.sym("slew_share", n), ca.SX.sym("motion_share", 3, n)
    way = plan.T - states[0, :]
    # all channels take the share of their way that the slowest one can cover in a step
    steps = ca.mmax(ca.fabs(way[:n]).T / ca.DM(slew * period) / slew_share)
    moved = motion_share @ ca.diag(way[:n])
    squares = ca.vertcat(ca.sum1(moved**2).T, ca.sumsqr(ca.sum2(moved)))
    steps = ca.fmax(steps, ca.sqrt(ca.mmax(squares)))
    share = ca.if_else(steps > 1, 1 / steps, 1)
    begun = ca.vertcat(states[0, :] + share * way, states[1:, :])
    after = _transition(rate * period) @ begun
    powers = ca.vertcat(1, rate, rate**2, rate**3)
    motion = ca.diag(powers) @ (ca.DM(_DIFFERENCES) @ after)
    # weights of the path and its derivatives in the pressures of the chambers, and in the command
    first, second = 2 * damping / omega, 1 / omega**2
    in_chamber = ca.vertcat(1, first, second, 0)
    in_command = in_chamber + lag * ca.vertcat(0, in_chamber[:3])
    pressures = motion[:, :n].T
    inputs = [states, plan, rate, omega, lag, slew_share, motion_share]
    outputs = [after, motion, pressures @ in_command, pressures @ in_chamber]
    return Formula(inputs, outputs, [states, motion_share, after, motion])


def _transition(duration: Symbols) -> Symbols:
    """Return the transition (5, 5) of the lags under a constant input, over a number of lags."""
    M = ca.SX.eye(_LAGS + 1)
    # the step response of k lags in series is 1 minus the sum of the first k terms
    terms = [ca.exp(-duration) * duration**k / math.factorial(k) for k in range(_LAGS)]
    for i in range(1, _LAGS + 1):
        M[i, 0] = 1 - sum(terms[:i])
        for k in range(i):
            M[i, i - k] = terms[k]
    return M
