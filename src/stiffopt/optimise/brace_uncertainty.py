"""Uncertainty of contact forces and braced stiffness by a calibration, to first order.

A calibration states the covariance of the free tip.  It is expressed as that of the pressures (of
least norm) that would move the tip as much, and carried on to contact forces.  The stiffness also
depends on parameters that move the tip little, such as moduli and gains that grow together; its
derivatives by the calibration's parameters are differences of equilibria.

Where a braced arm is near buckling, a small error takes most of its stiffness, which no derivative
shows: `least_stiffness` goes as far as one standard deviation.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError
from stiffopt.model.contact.equilibrium import ContactEquilibrium
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.parameters import Parameter, varied
from stiffopt.model.uncertainty import NORMAL_QUANTILE, TipUncertainty
from stiffopt.optimise.brace import leant_on
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.settings import BRACE
from stiffopt.optimise.task import Task

_LEAST_GRIP = 0.05  # where the contact itself is in doubt; its normal force is a demand of its own
_STEP = 0.3  # standard deviations, of differences by parameters


def _arguments(measure: StiffnessMeasure, task: Task) -> tuple[Any, ...]:
    """Return the arguments of `ContactEquilibrium.stiffness` for a measure of a braced task."""
    assert task.brace is not None
    m = measure
    return m.direction, m.kind, m.boundary, m.frame, task.brace.contacts


class BraceUncertainty:
    """The uncertainty of an equilibrium in contact that remains after the arm's calibration.

    All of it is zero for a robot that is not calibrated.
    """

    def __init__(self, robot: Manipulator, eq: ContactEquilibrium) -> None:
        self._robot, self._eq = robot, eq

    @cached_property
    def _errors(self) -> TipUncertainty:
        return self._robot.tip_uncertainty(self._eq.pressures)

    @cached_property
    def _per_tip(self) -> Array:
        """The pressures (n, 3) of least norm that move the free tip, in Pa/m."""
        robot, p = self._robot, self._eq.pressures
        R = robot.tip_pose(p)[:3, :3]
        return np.asarray(np.linalg.pinv(R @ robot.tip_jacobian(p)[:3]))

    def _pressures(self, squares: Array) -> Array:
        """Return the mean square (n, n) of pressures that move the free tip with one (3, 3)."""
        return np.asarray(self._per_tip @ squares @ self._per_tip.T)

    @cached_property
    def forces(self) -> Array:
        """By how much normal forces (contacts,) may be smaller or larger, in N.

        That is `BRACE.sure` standard deviations.
        """
        if self._robot.description.calibration is None:
            return np.zeros(len(self._eq.contacts))
        slopes = self._eq.force_gradients
        squares = self._pressures(self._errors.covariance)
        variances = np.einsum("ci,ij,cj->c", slopes, squares, slopes)
        return np.asarray(BRACE.sure * np.sqrt(np.maximum(variances, 0.0)))

    @property
    def grip(self) -> float:
        """Share of the push that loses a sticking contact which is left if forces are smaller.

        To first order, such a push is in proportion to the normal force; the least share counts.
        """
        lost = np.max(self.forces / self._eq.normal_forces, initial=0.0)
        return max(1.0 - float(lost), _LEAST_GRIP)

    def least_stiffness(self, measure: StiffnessMeasure, task: Task) -> float:
        """Return the least stiffness that one standard deviation of the tip leaves; 0 if none.

        The tip's errors go one such deviation each way along their three axes, and contacts stay.
        """
        given = _arguments(measure, task)
        least = self._eq.stiffness(*given)
        if self._robot.description.calibration is None:
            return least
        squares, axes = np.linalg.eigh(self._errors.covariance)
        for change in (self._per_tip @ (np.sqrt(np.maximum(squares, 0.0)) * axes)).T:
            for sign in (1.0, -1.0):
                try:
                    least = min(least, self._eq.shifted(sign * change).stiffness(*given))
                except EquilibriumError:
                    return 0.0
        return least

    def stiffness_interval(self, measure: StiffnessMeasure, task: Task) -> tuple[float, float]:
        """Return the 95 % interval of a stiffness of the task's answer, in N/m or N m/rad.

        On a logarithmic scale, and for contacts that stay.
        """
        given = _arguments(measure, task)
        k, known = self._eq.stiffness(*given), self._robot.description.calibration
        if known is None:
            return k, k
        errors = self._errors
        squares = self._pressures(errors.hysteresis + errors.discrepancy + errors.residual)
        slope = self._eq.stiffness_gradient(*given) / k
        parameters = [Parameter(fitted.key) for fitted in known.parameters]
        covariance = known.covariance[: len(parameters), : len(parameters)]
        own, deviations = np.zeros(len(parameters)), np.sqrt(np.diag(covariance))
        for i in np.flatnonzero(deviations):
            step = _STEP * float(deviations[i])
            low, high = (self._varied(task, parameters[i], end) for end in (-step, step))
            own[i] = math.log(high.stiffness(*given) / low.stiffness(*given)) / (2 * step)
        variance = float(slope @ squares @ slope + own @ covariance @ own)
        ratio = math.exp(NORMAL_QUANTILE * math.sqrt(max(variance, 0.0)))
        return k / ratio, k * ratio

    def _varied(self, task: Task, parameter: Parameter, coordinate: float) -> ContactEquilibrium:
        """Return the equilibrium with another parameter, or the known one if nothing is touched.

        Raises `EquilibriumError`: there is none.
        """
        assert task.scene is not None
        assert task.brace is not None
        robot = Manipulator(varied(self._robot.description, [parameter], [coordinate]))
        robot, scene = task.loaded(robot), leant_on(task.scene, task.brace)
        eq = robot.contact_equilibrium(self._eq.pressures, scene, approach=task.brace.approach)
        return eq if eq.contacts else self._eq
