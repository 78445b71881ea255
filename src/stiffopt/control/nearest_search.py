"""Search for the pressures that bring the tip nearest to a target."""

from __future__ import annotations

import math

import daqp
import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.tip_errors import TipErrors
from stiffopt.control.tuning import NearestTuning
from stiffopt.errors import StiffoptError
from stiffopt.optimise.target import Target, Tolerance
from stiffopt.optimise.tip import TipModel

_BAR = 1e5
_REACHED = Tolerance()  # of a tip that is at its target


class NearestSearch:
    """Finds the pressures nearest to a target that is out of reach, fast enough for the loop.

    It minimises the squared pose error by Gauss-Newton, within the limits of pressure. A lever, in
    m/rad, converts angles, as in feedback.
    """

    def __init__(self, tip: TipModel, lever: float, tuning: NearestTuning) -> None:
        self._tip, self._lever, self._tuning = tip, lever, tuning
        self._errors = TipErrors()

    def find(
        self,
        target: Target,
        bounds: tuple[Array, Array],
        start: Array,
        *,
        least_motion: bool = False,
    ) -> tuple[Array, float, float]:
        """Return a local optimum between the bounds (n,), from a start (n,), in Pa.

        Returns pressures (n,), and the position and angle errors there, in m and rad. The target is
        the model's. Of several optima it is the one with the least change of the pressures, or with
        `least_motion` that of the tip by each channel, to first order.
        """
        tuning = self._tuning
        low, high = bounds[0] / _BAR, bounds[1] / _BAR
        x = np.clip(start / _BAR, low, high)
        found = self._error(target, x)
        if found is None:  # an answer of another model
            x, found = low, self._errors.weighted(target, self._tip.at(low * _BAR), self._lever)
        error, rows, distance, angle = found
        no_rows, max_step = np.zeros((0, len(x))), tuning.max_step / _BAR
        effort = np.eye(len(x))
        if least_motion:
            squares = (self._tip.at(x * _BAR).jacobian[:3] ** 2).sum(axis=0)
            effort = np.diag(squares / squares.mean())
        for _ in range(tuning.iterations):
            J = rows * _BAR
            H = J.T @ J + tuning.regularisation**2 * effort
            lower, upper = np.maximum(low - x, -max_step), np.minimum(high - x, max_step)
            step, *_ = daqp.solve(H * 1e6, J.T @ error * 1e6, no_rows, upper, lower)
            if step is None or not np.isfinite(step).all():
                break
            share, value = 1.0, float(error @ error)
            while share > 1e-3:
                trial = np.clip(x + share * np.asarray(step), low, high)
                found = self._error(target, trial)
                if found is not None and float(found[0] @ found[0]) < value:
                    break
                share *= 0.5
            else:
                break
            x = trial
            error, rows, distance, angle = found
            if math.sqrt(value) - float(np.linalg.norm(error)) < tuning.progress:
                break
        result: Array = x * _BAR
        return result, distance, angle

    def reaches(
        self, target: Target, bounds: tuple[Array, Array], start: Array, **options: bool
    ) -> tuple[Array, bool]:
        """Return pressures (n,) as `find` does, and whether the tip is at its target there."""
        found, distance, angle = self.find(target, bounds, start, **options)
        return found, distance <= _REACHED.position and angle <= _REACHED.angle

    def distance(self, target: Target, pressures: Array) -> tuple[float, float]:
        """Return the position and angle errors at pressures (n,), in m and rad."""
        found = self._error(target, pressures / _BAR)
        return (math.nan, math.nan) if found is None else found[2:]

    def _error(self, target: Target, x: Array) -> tuple[Array, Array, float, float] | None:
        """Return the error at x (n,), in bar, as `TipErrors.weighted`; None: no equilibrium."""
        try:
            return self._errors.weighted(target, self._tip.at(x * _BAR), self._lever)
        except StiffoptError:
            return None
