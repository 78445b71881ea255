"""Learn in motion by how much farther than modelled the tip moves, and where to.

Errors of stiffness and gain let the tip's offset d grow with the motion s of the model::

    d = b + A (s - s_0)

Feedback is late by a time T: it averages the offset over a vibration, and the regulators lag. On a
trajectory with the velocity v the tip is then behind by T A v. With A, the part of the offset that
grows with the motion is known in advance. In a step, which ends before feedback has acted, the tip
would otherwise go too far by it. A Kalman filter estimates A and b; all axes have the same
noise, so it has one covariance (4, 4).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.formula import Formula
from stiffopt.control.tuning import MotionErrorTuning


class MotionErrorEstimator:
    """Estimates the change of the tip's offset with the motion of the model.

    `slope`: A (3, 3), displacement of the tip per displacement of the model's; zero before `learn`.
    """

    def __init__(self, tuning: MotionErrorTuning) -> None:
        self._tuning, self._correct = tuning, _correction(tuning)
        self.stop()

    def stop(self) -> None:
        """Forget everything; the next call of `learn` is the first."""
        self._elapsed = 0.0
        self._start: Array | None = None
        self.slope: Array = np.zeros((3, 3))

    def learn(self, elapsed: float, position: Array, offset: Array) -> None:
        """Take in the position (3,) of the model's tip and its offset (3,), in m.

        `elapsed` is the time since the last call, in s.
        """
        t = self._tuning
        self._elapsed += elapsed
        if self._start is None:
            self._start = self._last = position.copy()
            self._mean = np.vstack([np.zeros((3, 3)), offset])
            self._covariance = np.diag([t.deviation**2] * 3 + [t.noise**2])
        elif self._elapsed >= t.every:
            self._mean, self._covariance = self._correct(
                self._mean, self._covariance, position, self._start, self._last, offset,
                self._elapsed,
            )  # fmt: skip
            self.slope = self._mean[:3].T
            self._last, self._elapsed = position.copy(), 0.0


def _correction(tuning: MotionErrorTuning) -> Formula:
    """Return the formula of the measurement update.

    Inputs: mean (4, 3) and covariance (4, 4), the position (3,) now, at the first and at the last
    update, the offset (3,), and the time since the last update. Outputs: mean and covariance.
    """
    t = tuning
    mean, P = ca.SX.sym("mean", 4, 3), ca.SX.sym("covariance", 4, 4)
    position, start = ca.SX.sym("position", 3), ca.SX.sym("start", 3)
    last, offset, elapsed = ca.SX.sym("last", 3), ca.SX.sym("offset", 3), ca.SX.sym("elapsed")
    h = ca.vertcat(position - start, 1)
    speed = ca.norm_2(position - last) / elapsed
    grown = P + ca.diag(ca.vertcat(0, 0, 0, t.drift**2 * elapsed))
    seen_with = grown @ h
    gain = seen_with / (h.T @ seen_with + t.noise**2 + (t.late * speed) ** 2)
    outputs = [mean + gain @ (offset - mean.T @ h).T, grown - gain @ seen_with.T]
    return Formula([mean, P, position, start, last, offset, elapsed], outputs)
