"""`SlideEstimator`: how far contacts that should stick have slid, by place and turn of the tip.

Relative to the model of an arm whose k contacts stick, place and turn (6,) of the tip are

    y = b + C F + S s + noise

with the model's error b, the compliance C (6, 3) to a push F at the tip, and the effect S (6, 2k)
of slides s. Silicone creeps, so b grows by c (6,) per e-fold of the time in contact. Nobody knows b
and c beforehand: a Kalman filter learns them while the arm holds. A push comes and goes, and moves
the tip in three of six directions. What moves it otherwise, and quicker than it creeps, is a slide.
One that stays becomes part of b in the end, as all that drifts slowly does. A turn that has jumped
alone, as that of a sensor about its own axis may, does not count any more.
"""

from __future__ import annotations

import math

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.control.contact_tuning import SlidingTuning
from stiffopt.control.friction import Friction
from stiffopt.paths.leaning import BraceApproach

_ERROR, _CREEP, _PUSH, _FIRST = slice(0, 6), slice(6, 12), slice(12, 15), 15  # in the state


class SlideEstimator:
    """Estimates how far contacts slide.

    Parameters
    ----------
    approach : the way into contact.
    friction : of the contacts, linear about its end.
    usual : covariance (3, 3) of pushes, base axes, in N^2.
    tuning : what is expected of errors, pushes and slides.
    """

    def __init__(
        self, approach: BraceApproach, friction: Friction, usual: Array, tuning: SlidingTuning
    ) -> None:
        t, held, tip = tuning, approach.hold.sticking, approach.tips[-1]
        self._tuning, self._usual = t, usual
        self._pose, self._pressures = tip.pose, approach.pressures[-1]
        R = tip.pose[:3, :3]
        turned = lie.rotate_blocks(R)
        self._per_pressure = turned @ tip.jacobian + friction.tip @ held.per_pressure
        per_push = turned @ tip.compliance[:, :3] @ R.T + friction.tip @ held.per_push
        self._rows = np.hstack([np.eye(6), np.zeros((6, 6)), per_push, held.tip])
        self._noise = np.diag(np.repeat(t.noise * np.array([1.0, t.turn]), 3) ** 2)
        count = self._rows.shape[1]
        deviations = np.full(count, t.noise)  # of slides at first
        deviations[:_FIRST] = np.repeat([*t.error, *t.creep, 0.0], 3)
        self._state, self._covariance = np.zeros(count), np.diag(deviations**2)
        # silicone creeps mostly as if all pressures grew, or fell, by a share
        creep = t.creep_share * self._per_pressure @ self._pressures
        self._covariance[_CREEP, _CREEP] += np.outer(creep, creep)
        self._jumps = 0  # successive samples in which the turn has jumped without the place
        self._drift = np.diag(np.repeat(t.drift, 3) ** 2)

    def take(
        self, elapsed: float, held: float, seen: Array, quaternion: Array | None, pressures: Array
    ) -> None:
        """Take in a sample of the tip.

        Parameters
        ----------
        elapsed, held : time since the last sample, and in contact, in s.
        seen, quaternion : measured position (3,), in m, and orientation (4,), w first; None if it
            is not measured.
        pressures : effective pressures (n,), in Pa.
        """
        off = np.concatenate([seen - self._pose[:3, 3], np.zeros(3)])
        if quaternion is not None:
            turn = lie.rotation_from_quaternion(quaternion) @ self._pose[:3, :3].T
            turned = lie.quaternion_from_rotation(turn)
            off[3:] = lie.rotation_vector_from_quaternion(turned)
        off -= self._per_pressure @ (pressures - self._pressures)
        self._go_on(elapsed, held)
        H, P = self._rows[:6], self._covariance
        innovation, S = off - H @ self._state, H @ P @ H.T + self._noise
        measured = quaternion is not None and self._is_turn(innovation, S)
        rows = slice(0, 6 if measured else 3)
        H = H[rows]
        gain = np.linalg.solve(S[rows, rows], H @ P).T
        self._state = self._state + gain @ innovation[rows]
        P = P - gain @ H @ P
        self._covariance = (P + P.T) / 2

    def _is_turn(self, innovation: Array, S: Array) -> bool:
        """Return whether a measured turn counts, by the innovation (6,) and its covariance (6, 6).

        Once it has jumped alone, in a few samples, it does not count any more.
        """
        jumps = np.abs(innovation) > self._tuning.jump * np.sqrt(np.diag(S))
        alone = bool(jumps[3:].any() and not jumps[:3].any())
        if self._jumps < self._tuning.samples:
            self._jumps = self._jumps + 1 if alone else 0
        return not alone and self._jumps < self._tuning.samples

    def _go_on(self, elapsed: float, held: float) -> None:
        """Predict the state after a time in s."""
        t, own = self._tuning, slice(_FIRST, len(self._state))
        fades, stays = math.exp(-elapsed / t.push_time), math.exp(-elapsed / t.longest)
        F = np.eye(len(self._state))
        F[_ERROR, _CREEP] = elapsed / (t.creep_time + held) * np.eye(6)
        F[_PUSH, _PUSH] *= fades
        F[own, own] *= stays
        F[_ERROR, own] = (1 - stays) * self._rows[:, own]
        self._state = F @ self._state
        P = F @ self._covariance @ F.T
        P[_PUSH, _PUSH] += (1 - fades**2) * self._usual
        P[_ERROR, _ERROR] += elapsed * self._drift
        P[own, own] += elapsed * t.slide**2 * np.eye(len(F) - _FIRST)
        self._covariance = P

    @property
    def slides(self) -> Array:
        """Slides (k, 2) along the surfaces, in m."""
        return self._state[_FIRST:].reshape(-1, 2)

    def deviations(self) -> Array:
        """Return how many of its deviations (k,) each slide is."""
        P = self._covariance[_FIRST:, _FIRST:]
        own = [P[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(len(P) // 2)]
        squares = [s @ np.linalg.solve(p, s) for p, s in zip(own, self.slides, strict=True)]
        return np.sqrt(squares)
