"""Feedback that damps the arm's vibration and brings its tip home, for any frequency of it.

Beside the reference, an axis of the tip in which the arm swings obeys ::

    tau sigma' = u - sigma                        static position, behind the regulators' lag
    epsilon'' = -2 zeta omega epsilon' - omega^2 (epsilon - sigma)         the tip

and the linear-quadratic regulator ``u = -K (sigma, epsilon, epsilon')`` that minimises
``int epsilon^2 + weight u^2`` brings it to rest: more damping and little haste for a large weight.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

__all__ = ["Gains"]

Array = NDArray[np.float64]

_FREQUENCIES = np.geomspace(2.0, 200.0, 60)  # rad/s


class Gains:
    """Gains K (3,) of an axis, on static position, tip and its speed, by frequency.

    Parameters
    ----------
    period :
        Of the loop, in s.
    lag :
        Of the regulators, in s.
    damping :
        Share of critical damping that the arm has by itself.
    weight :
        Of effort against error.
    """

    def __init__(self, period: float, lag: float, damping: float, weight: float) -> None:
        table = [
            regulator(omega, damping, max(lag, 1e-3), period, weight) for omega in _FREQUENCIES
        ]
        self._table = np.array(table)
        self._last: tuple[float, Array] = (-1.0, np.zeros(3))

    def at(self, omega: float) -> Array:
        """Gains (3,) for an angular frequency, in rad/s; the last in s."""
        if omega != self._last[0]:
            columns = [np.interp(omega, _FREQUENCIES, column) for column in self._table.T]
            self._last = omega, np.array(columns)
        return self._last[1]


def regulator(omega: float, damping: float, lag: float, period: float, weight: float) -> Array:
    """Gains (3,) of the linear-quadratic regulator for one frequency, sampled at the period."""
    A = np.array(
        [[-1 / lag, 0, 0], [0, 0, 1], [omega**2, -(omega**2), -2 * damping * omega]], dtype=float
    )
    B = np.array([[1 / lag], [0], [0]])
    whole = expm(period * np.block([[A, B], [np.zeros((1, 4))]]))
    F, G = whole[:3, :3], whole[:3, 3:]
    Q, R = np.diag([0.0, 1.0, 0.0]), np.array([[weight]])
    S = solve_discrete_are(F, G, Q, R)
    gain: Array = np.linalg.solve(R + G.T @ S @ G, G.T @ S @ F)[0]
    return gain
