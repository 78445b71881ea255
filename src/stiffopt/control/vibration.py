"""The arm's first bending vibration, of which the statics know nothing.

A hanging arm swings like a cantilever with a mass at its end.  In its first mode, of shape phi with
phi(tip) = 1, the tip moves by eta, in the plane in which the tip is soft::

    eta'' + 2 zeta omega eta' + omega^2 (eta - s) = 0,      omega^2 = k / m

k is the lateral stiffness of the tip, m the modal mass ``int phi^2 dm``, and s what the mode has of
the static shape: where pressure bends the arm to x(S), it is ``int phi x dm / m``.  Of a segment
near the tip that is less than what the tip itself moves by; the rest of the static motion follows
at once, as far as this mode is concerned.

The shape is that of the straight cantilever under a force at its tip.  A measure of how good that
is: modal masses from frequencies and stiffnesses of the simulated arm, over many configurations,
lie within 4 % of each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.actuation import SectionGeometry
from stiffopt.model.description import RobotDescription

__all__ = ["Vibration"]

Array = NDArray[np.float64]

_POINTS = 200  # along each segment
_SILICONE = 1070.0  # kg/m^3, where the robot file knows no weight


@dataclass(frozen=True)
class Vibration:
    """The first bending mode of an arm.

    Attributes
    ----------
    mass : float
        Modal mass, in kg, for a shape that is 1 at the tip.
    participation : ndarray
        Of each channel (n,): how much of what it moves the tip by, the mode has.
    """

    mass: float
    participation: Array

    @classmethod
    def of(cls, robot: RobotDescription) -> Vibration:
        """Compute from the drawing of the straight arm."""
        station, weight, flexibility, owner = _beam(robot)
        length = station[-1]
        phi = _deflection(station, flexibility * (length - station))
        mass = weight * phi**2
        total = float(mass.sum()) + robot.tip_mass
        shares = []
        for index, segment in enumerate(robot.segments):
            x = _deflection(station, np.where(owner == index, 1.0, 0.0))
            share = (float(np.sum(weight * phi * x)) + robot.tip_mass) / total
            shares += [share] * segment.n_channels
        return cls(total, np.array(shares))

    def frequency(self, stiffness: float) -> float:
        """Angular frequency, in rad/s, at a lateral stiffness of the tip in N/m."""
        return float(np.sqrt(max(stiffness, 0.0) / self.mass))


def _beam(robot: RobotDescription) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Stations, masses, flexibilities in bending and segments (-1: a connector) of pieces (m,)."""
    stations, masses, flexibilities, owners = [0.0], [0.0], [0.0], [-1]
    for index, segment in enumerate(robot.segments):
        geometry = SectionGeometry.of(segment)
        step = segment.length / _POINTS
        density = segment.material.density or _SILICONE
        modulus = segment.material.youngs_modulus
        if segment.compensation is not None:
            modulus *= segment.compensation.stiffness
        for _ in range(_POINTS):
            stations.append(stations[-1] + step)
            masses[-1] += 0.5 * density * geometry.area * step
            masses.append(0.5 * density * geometry.area * step)
            flexibilities.append(1 / (modulus * float(np.trace(geometry.second_moment)) / 2))
            owners.append(index)
        if segment.connector > 0:
            stations.append(stations[-1] + segment.connector)
            masses.append(0.0)
            flexibilities.append(0.0)
            owners.append(-1)
    return np.array(stations), np.array(masses), np.array(flexibilities), np.array(owners)


def _deflection(station: Array, curvature: Array) -> Array:
    """Lateral displacement (m,) of a cantilever with these curvatures (m,), 1 at its end."""
    steps = np.diff(station, prepend=station[0])
    slope = np.cumsum(curvature * steps)
    x = np.cumsum((slope - curvature * steps / 2) * steps)
    result: Array = x / x[-1]
    return result
