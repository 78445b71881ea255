"""Estimate how the arm creeps, at rest after motions, and predict how its tip goes on creeping.

Creep is what `stiffopt.model.history` says: a share a_k of the pressures p acts through slow states
z_k, ``T_k z_k' = p - z_k``. For given time constants T_k it displaces the tip, relative to the
model of an arm that does not creep, by

    q = sum_k a_k phi_k,    phi_k = J (z_k - p),

with the Jacobian J of the tip. The pressures' past determines phi, so a few numbers a_k, the same
for all motions and lateral axes, describe the creep of the arm. A Kalman filter estimates them
together with the remaining error e of the model, which changes with motion; what changes at rest in
the directions and at the rates of phi is creep. It learns while nothing touches the tip. Then q is
known, with its covariance, also while something does.

An arm elongates with other shares than it bends: its weight, which does not creep, holds a hanging
arm straight. Only displacements in which a force would be felt count, so the a_k are those of
bending. A rest of seconds shows nothing of what creeps for a minute. But silicone creeps at many
rates at once, so an arm of which much creeps soon also creeps more later: the a_k are correlated.

A robot file or a calibration may have a creep of its own: effective pressures contain it, and a_k
is what is missing from it.
"""

from __future__ import annotations

import math

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.contact_tuning import CreepTuning

_FAR = 25.0  # squared distance in deviations of a sample that is no creep
_UNLIKELY = 3.0  # deviations of a share from what is believed that no arm has


class CreepEstimator:
    """Estimates the creep of the tip's position.

    Parameters
    ----------
    n : number of channels.
    known : whether the effective pressures already contain the creep of this robot.
    tuning : time constants, priors and noise.
    """

    def __init__(self, n: int, known: bool, tuning: CreepTuning) -> None:
        self._tuning, self._times = tuning, np.array(tuning.times)
        count = len(self._times)
        self._states: Array = np.zeros((count, n))  # z, in Pa
        self._behind: Array = np.zeros((count, n))  # z - p
        self._phi: Array = np.zeros((3, count))
        # mean and deviation of the shares before anything is learned
        self._prior = (0.0, tuning.known) if known else (tuning.share, tuning.deviation)
        self._mean, self._covariance = np.zeros(3 + count), np.zeros((3 + count, 3 + count))
        self._unlearn()

    def begin(self) -> None:
        """Forget the model's error; what is known about the arm's creep stays."""
        error = self._covariance[:3]
        error[:] = self._covariance[:, :3] = 0.0
        error[:, :3] = np.eye(3) * self._tuning.first_error**2
        self._sum, self._count, self._elapsed = np.zeros((3, 1 + len(self._times))), 0, 0.0
        self._noise, self._felt = 0.0, np.eye(3)

    def _unlearn(self) -> None:
        """Restart from what is believed about any arm."""
        share, deviation = self._prior
        self._mean[3:] = share
        count, alike = len(self._times), self._tuning.alike
        self._covariance[3:, 3:] = deviation**2 * ((1 - alike) * np.eye(count) + alike)
        self.begin()

    @property
    def shares(self) -> Array:
        """Shares (k,) that creep with the time constants of the tuning."""
        return self._mean[3:]

    @property
    def displacement(self) -> Array:
        """Displacement (3,) of the tip by the creep that is still to come, negative, in m."""
        return self._phi @ self._mean[3:]

    def rate_deviation(self, direction: Array) -> float:
        """Return the deviation of the tip's speed by creep along a direction (3,), in m/s."""
        return self._deviation(direction, 1 / self._times)

    def deviation(self, direction: Array, duration: float) -> float:
        """Return the deviation of the creep along (3,) within a duration in s, in m."""
        return self._deviation(direction, 1 - np.exp(-duration / self._times))

    def _deviation(self, direction: Array, shares: Array) -> float:
        change = direction @ self._phi * shares
        return math.sqrt(change @ self._covariance[3:, 3:] @ change)

    def take_over(self, jacobian: Array) -> Array:
        """Change to the Jacobian (3, n) of another model; return the change of q (3,), in m.

        The tip stays where it is: the model's error takes up the change.
        """
        before, phi = self.displacement, self._phi
        self._phi = jacobian @ self._behind.T
        self._sum[:, 1:] += self._count * (self._phi - phi)
        change: Array = self.displacement - before
        self._mean[:3] -= change
        return change

    def advance(self, elapsed: float, pressures: Array, jacobian: Array) -> None:
        """Go on by a time in s to pressures (n,); `jacobian` (3, n) in base axes."""
        shares = 1 - np.exp(-elapsed / self._times)
        self._states += shares[:, None] * (pressures - self._states)
        self._behind = self._states - pressures
        self._phi = jacobian @ self._behind.T

    def change_model(self, change: Array) -> None:
        """Adjust to another model, for which the tip's offset changes by (3,)."""
        self._mean[:3] += change
        self._sum[:, 0] += self._count * change

    def learn(self, elapsed: float, away: Array, grown: float, speed: float, felt: Array) -> None:
        """Take in a sample of a tip that nothing touches.

        Parameters
        ----------
        elapsed : time since the last sample, in s.
        away : measured position (3,) minus the model's, without vibration, in m.
        grown : growth of the square of the model's recent way, in m^2.
        speed : of the model's tip, in m/s.
        felt : projection (3, 3) on the directions in which the arm feels a force.
        """
        t, P = self._tuning, self._covariance
        error = np.arange(3)
        P[error, error] += t.model_error**2 * max(grown, 0.0) + t.drift**2 * elapsed
        share = np.arange(3, len(P))
        P[share, share] += t.changes**2 * max(grown, 0.0)
        self._sum[:, 0] += away
        self._sum[:, 1:] += self._phi
        self._noise, self._felt = max(self._noise, t.noise**2 + (t.late * speed) ** 2), felt
        self._count, self._elapsed = self._count + 1, self._elapsed + elapsed
        if self._elapsed >= t.every:
            self._correct()

    def _correct(self) -> None:
        """Correct by the mean of the last samples."""
        m, P, rows = self._mean, self._covariance, self._sum / self._count
        H = np.hstack([np.eye(3), rows[:, 1:]])
        missed = rows[:, 0] - H @ m
        noise = self._noise * self._felt + self._tuning.unfelt**2 * (np.eye(3) - self._felt)
        S = H @ P @ H.T + noise
        if missed @ np.linalg.solve(S, missed) > _FAR:  # a jump of the model's error
            jump = np.eye(3) * float(missed @ missed)
            P[:3, :3] += jump
            S += jump
        gain = np.linalg.solve(S, H @ P).T
        self._mean = m + gain @ missed
        left = np.eye(len(m)) - gain @ H
        self._covariance = left @ P @ left.T + gain @ noise @ gain.T
        self._sum[:], self._count, self._elapsed, self._noise = 0.0, 0, 0.0, 0.0
        share, deviation = self._prior
        if (np.abs(self.shares - share) > _UNLIKELY * deviation).any():
            self._unlearn()  # it was no creep, such as a contact that nobody noticed

    def skip(self) -> None:
        """Something touches the tip: the model's error may be another one afterwards."""
        if self._covariance[0, 0] < self._tuning.first_error**2:
            self.begin()
