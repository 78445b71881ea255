"""Lags of the regulators, adapted to how their readings follow their commands.

A regulator follows its set-point u, after its dead time, as ``tau x' = u - x``, and its gauge reads
x + b. A Kalman filter for each channel estimates z, the logarithm of tau over the rig file's value,
and the offset b. Its measurement matrix is (dx/dz, 1), so readings at rest tell nothing about z and
leave it as it is. The deviation of z never falls below a floor, hence a lag that changes is
followed.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.control.formula import Formula
from stiffopt.control.tuning import LagTuning

Array = NDArray[np.float64]


class LagEstimator:
    """Estimates the lags of n regulators, in steps of `period`, in s.

    The rig file says that they have these lags (n,) and a dead time, in s; their greatest slew (n,)
    is in Pa/s.
    """

    def __init__(
        self, period: float, lag: Array, dead_time: float, slew: Array, tuning: LagTuning
    ) -> None:
        self._file, self._tuning = lag, tuning
        self._step = _step(period, np.maximum(lag, 1e-6), slew * period, tuning)
        self._sent: Array = np.zeros((round(dead_time / period) + 1, len(lag)))
        # z and b, and their variances and covariance, rows of zz, zb and bb
        self._known: Array = np.zeros((2, len(lag)))
        self._variances: Array = np.zeros((3, len(lag)))
        self._variances[0] = tuning.deviation**2
        self.begin()

    def begin(self) -> None:
        """Restart with vented channels; what is known of the lags stays."""
        self._sent[:] = 0.0
        self._motion: Array = np.zeros_like(self._known)  # x, and its derivative by z
        self._known[1], self._variances[1] = 0.0, 0.0
        self._variances[2] = self._tuning.offset**2

    def advance(self, commanded: Array, reading: Array, lost: NDArray[np.bool_]) -> None:
        """Take a step with commands (n,) and, at its end, readings (n,); NaN: not measured.

        Channels that are `lost` (n,) do not follow their commands, and tell nothing.
        """
        self._sent[:-1] = self._sent[1:]
        self._sent[-1] = commanded
        seen = np.where(lost, np.nan, reading) if any(lost.tolist()) else reading
        self._motion, self._known, self._variances = self._step(
            self._motion, self._known, self._variances, self._sent[0], seen
        )

    @property
    def lag(self) -> Array:
        """The estimated lags (n,), in s."""
        return np.asarray(self._file * np.exp(self._known[0]))

    @property
    def deviation(self) -> Array:
        """Their standard deviations (n,), in s."""
        return np.asarray(self.lag * np.sqrt(self._variances[0]))


def _step(period: float, lag: Array, reach: Array, tuning: LagTuning) -> Formula:
    """Return the formula of a step: motion (2, n), numbers (2, n) and variances (3, n) after it.

    Inputs: these, the command (n,) that acts now, and the readings (n,).
    """
    n = len(lag)
    motion, known, variances = (ca.SX.sym(*a) for a in (("m", 2, n), ("k", 2, n), ("v", 3, n)))
    command, reading = ca.SX.sym("command", n), ca.SX.sym("reading", n)
    z, b, x, s = known[0, :], known[1, :], motion[0, :], motion[1, :]
    zz, zb, bb = ca.vertsplit(variances)
    decay = ca.exp(-period / (ca.DM(lag).T * ca.exp(z)))
    away = command.T - x
    free = (1 - decay) * away
    change = ca.fmin(ca.fmax(free, -ca.DM(reach).T), ca.DM(reach).T)
    x = x + change
    slope = decay * s + decay * ca.log(decay) * away  # of x by z
    x_z = ca.if_else(ca.fabs(free) > ca.DM(reach).T, s, slope)  # a limited step has none
    bb = bb + tuning.offset_drift**2 * period
    error = reading.T - x - b
    variance = zz * x_z**2 + 2 * zb * x_z + bb + tuning.noise**2
    tells = ca.fabs(error) < tuning.gate * ca.sqrt(variance)  # False for NaN
    gain_z, gain_b = (zz * x_z + zb) / variance, (zb * x_z + bb) / variance
    z_after = ca.fmin(ca.fmax(z + gain_z * error, -tuning.bound), tuning.bound)
    updated = (
        z_after,
        b + gain_b * error,
        ca.fmax(zz - gain_z * (zz * x_z + zb), tuning.least_deviation**2),
        zb - gain_z * (zb * x_z + bb),
        bb - gain_b * (zb * x_z + bb),
    )
    z, b, zz, zb, bb = (
        ca.if_else(tells, new, old) for new, old in zip(updated, (z, b, zz, zb, bb), strict=True)
    )
    after = ca.vertcat(x, x_z), ca.vertcat(z, b), ca.vertcat(zz, zb, bb)
    matrices = [motion, known, variances]
    return Formula([*matrices, command, reading], after, [*matrices, *after])
