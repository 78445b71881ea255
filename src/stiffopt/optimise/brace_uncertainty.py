"""Uncertainty of contact forces and braced stiffness by a calibration, to first order.

A calibration states the covariance of the free tip.  It is expressed as that of the pressures (of
least norm) that would move the tip as much, and carried on to contact forces and stiffness.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.contact.equilibrium import ContactEquilibrium, Grip
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.uncertainty import NORMAL_QUANTILE
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.settings import BRACE

Vector = NDArray[np.float64]

_LEAST_GRIP = 0.05  # where the contact itself is in doubt; its normal force is a demand of its own


class BraceUncertainty:
    """The uncertainty of an equilibrium in contact that remains after the arm's calibration.

    All of it is zero for a robot that is not calibrated.
    """

    def __init__(self, robot: Manipulator, eq: ContactEquilibrium) -> None:
        self._robot, self._eq = robot, eq

    @cached_property
    def pressures(self) -> Vector:
        """Mean square (n, n) of pressures with the errors of the free tip, in Pa^2."""
        robot, p = self._robot, self._eq.pressures
        if robot.description.calibration is None:
            return np.zeros((len(p), len(p)))
        R = robot.tip_pose(p)[:3, :3]
        per_tip = np.linalg.pinv(R @ robot.tip_jacobian(p)[:3])
        return np.asarray(per_tip @ robot.tip_uncertainty(p).covariance @ per_tip.T)

    @cached_property
    def forces(self) -> Vector:
        """By how much normal forces (contacts,) may be smaller or larger, in N.

        That is `BRACE.sure` standard deviations.
        """
        if self._robot.description.calibration is None:
            return np.zeros(len(self._eq.contacts))
        slopes = self._eq.force_gradients
        variances = np.einsum("ci,ij,cj->c", slopes, self.pressures, slopes)
        return np.asarray(BRACE.sure * np.sqrt(np.maximum(variances, 0.0)))

    @property
    def grip(self) -> float:
        """Share of the push that loses a sticking contact which is left if forces are smaller.

        To first order, such a push is in proportion to the normal force; the least share counts.
        """
        lost = np.max(self.forces / self._eq.normal_forces, initial=0.0)
        return max(1.0 - float(lost), _LEAST_GRIP)

    def stiffness_interval(self, measure: StiffnessMeasure, contacts: Grip) -> tuple[float, float]:
        """Return the 95 % interval of a braced stiffness, in N/m or N m/rad.

        On a logarithmic scale, and for contacts that stay.
        """
        given = (measure.direction, measure.kind, measure.boundary, measure.frame, contacts)
        k, slope = self._eq.stiffness(*given), self._eq.stiffness_gradient(*given)
        variance = float(slope @ self.pressures @ slope)
        ratio = float(np.exp(NORMAL_QUANTILE * np.sqrt(max(variance, 0.0)) / k))
        return k / ratio, k * ratio
