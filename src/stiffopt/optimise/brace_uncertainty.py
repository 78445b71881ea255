"""Uncertainty of contact forces and braced stiffness by a calibration, to first order.

A calibration states the covariance of the free tip.  It is expressed as that of the pressures (of
least norm) that would move the tip as much, and carried on to contact forces and stiffness.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.contact.equilibrium import ContactEquilibrium, Grip
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.uncertainty import NORMAL_QUANTILE
from stiffopt.optimise.goal import StiffnessMeasure
from stiffopt.optimise.settings import BRACE

Vector = NDArray[np.float64]


def wrong_pressures(robot: Manipulator, p: Vector) -> Vector:
    """Return the mean square (n, n) of pressures with the errors of the free tip, in Pa^2.

    Zero for a robot that is not calibrated.
    """
    if robot.description.calibration is None:
        return np.zeros((len(p), len(p)))
    R = robot.tip_pose(p)[:3, :3]
    per_tip = np.linalg.pinv(R @ robot.tip_jacobian(p)[:3])
    return np.asarray(per_tip @ robot.tip_uncertainty(p).covariance @ per_tip.T)


def forces_in_doubt(robot: Manipulator, eq: ContactEquilibrium) -> Vector:
    """Return by how much the normal forces (contacts,) may be smaller, in N.

    That is `BRACE.sure` standard deviations.
    """
    if robot.description.calibration is None:
        return np.zeros(len(eq.contacts))
    slopes = eq.force_gradients
    variances = np.einsum("ci,ij,cj->c", slopes, wrong_pressures(robot, eq.pressures), slopes)
    return np.asarray(BRACE.sure * np.sqrt(np.maximum(variances, 0.0)))


def stiffness_interval(
    robot: Manipulator, eq: ContactEquilibrium, measure: StiffnessMeasure, contacts: Grip
) -> tuple[float, float]:
    """Return the 95 % interval of a braced stiffness, in N/m or N m/rad.

    On a logarithmic scale, and for contacts that stay.
    """
    given = (measure.direction, measure.kind, measure.boundary, measure.frame, contacts)
    k, slope = eq.stiffness(*given), eq.stiffness_gradient(*given)
    variance = float(slope @ wrong_pressures(robot, eq.pressures) @ slope)
    ratio = float(np.exp(NORMAL_QUANTILE * np.sqrt(max(variance, 0.0)) / k))
    return k / ratio, k * ratio
