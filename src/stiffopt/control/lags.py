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

from stiffopt.arrays import Array, Flags
from stiffopt.control.formula import Formula
from stiffopt.control.tuning import LagTuning

_Z, _ZZ, _BB = 2, 4, 6  # rows of the state


class LagEstimator:
    """Estimates the lags of n regulators, in steps of `period`, in s.

    The rig file says that they have these lags (n,) and a dead time, in s; their greatest slew (n,)
    is in Pa/s.
    """

    def __init__(
        self, period: float, lag: Array, dead_time: float, slew: Array, tuning: LagTuning
    ) -> None:
        self._file, self._tuning = lag, tuning
        depth = round(dead_time / period) + 1
        self._step = _step(period, np.maximum(lag, 1e-6), slew * period, depth, tuning)
        # rows (n,): x and its derivative by z; z and b; their variances and covariance zz, zb and
        # bb; and the commands under way, the oldest first
        self._state: Array = np.zeros((7 + depth, len(lag)))
        self._state[_ZZ] = tuning.deviation**2
        self.begin()

    def begin(self) -> None:
        """Restart with vented channels; what is known of the lags stays."""
        lasting = self._state[[_Z, _ZZ]]
        self._state[:] = 0.0
        self._state[[_Z, _ZZ]] = lasting
        self._state[_BB] = self._tuning.offset**2

    def advance(self, commanded: Array, reading: Array, lost: Flags) -> None:
        """Take a step with commands (n,) and, at its end, readings (n,); NaN: not measured.

        Channels that are `lost` (n,) do not follow their commands, and tell nothing.
        """
        seen = np.where(lost, np.nan, reading) if any(lost.tolist()) else reading
        (self._state,) = self._step(self._state, commanded, seen)

    @property
    def lag(self) -> Array:
        """The estimated lags (n,), in s."""
        return np.asarray(self._file * np.exp(self._state[_Z]))

    @property
    def deviation(self) -> Array:
        """Their standard deviations (n,), in s."""
        return np.asarray(self.lag * np.sqrt(self._state[_ZZ]))


def _step(period: float, lag: Array, reach: Array, depth: int, tuning: LagTuning) -> Formula:
    """Return the formula of a step of the state (7 + depth, n), see `LagEstimator`.

    Inputs: the state, commands (n,), and readings (n,).
    """
    n = len(lag)
    state, commanded = ca.SX.sym("state", 7 + depth, n), ca.SX.sym("commanded", n)
    reading = ca.SX.sym("reading", n)
    x, s, z, b, zz, zb, bb, _, *sent = ca.vertsplit(state)
    sent = [*sent, commanded.T]
    decay = ca.exp(-period / (ca.DM(lag).T * ca.exp(z)))
    away = sent[0] - x
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
    after = ca.vertcat(x, x_z, z, b, zz, zb, bb, *sent)
    return Formula([state, commanded, reading], [after], [state, after])
