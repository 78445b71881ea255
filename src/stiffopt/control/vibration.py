"""The arm's first bending mode, of which a model of its statics knows nothing.

A hanging arm vibrates like a cantilever with a mass at its end. In the first mode, of shape phi
with phi(tip) = 1, the tip moves by eta in the plane in which it is soft::

    eta'' + 2 zeta omega eta' + omega^2 (eta - s) = 0,      omega^2 = k / m

k is the lateral stiffness of the tip and m the modal mass ``int phi^2 dm``. s is the projection of
the static shape x(S), to which pressures bend the arm, on the mode: ``int phi x dm / m``. For a
segment near the tip it is less than the displacement of the tip itself; the rest of that
displacement does not excite this mode and follows at once.

phi is the shape of the straight cantilever under a force at its tip. To judge that approximation:
modal masses from frequencies and stiffnesses of the simulated arm, over many configurations, lie
within 4 % of each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.model.actuation import SectionGeometry
from stiffopt.model.description import RobotDescription

Array = NDArray[np.float64]
Symbols = Any  # of CasADi

_PIECES = 200  # of each segment
_SILICONE = 1070.0  # kg/m^3, where the robot file gives no density


@dataclass(frozen=True)
class BendingMode:
    """The first bending mode of an arm."""

    mass: float  # modal mass, in kg, of a mode shape that is 1 at the tip
    # share (n,) of the tip's displacement by each channel that the mode takes part in
    participation: Array

    @classmethod
    def of(cls, robot: RobotDescription) -> BendingMode:
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


def transition(omega: Symbols, damping: float, duration: Symbols) -> Symbols:
    """Transition matrix (2, 2) of a free vibration and its speed.

    omega is in rad/s, the duration in s; it may be negative.
    """
    damped = omega * (1 - damping**2) ** 0.5
    decay = ca.exp(-damping * omega * duration)
    c, s = decay * ca.cos(damped * duration), decay * ca.sin(damped * duration) / damped
    return ca.blockcat([[c + damping * omega * s, s], [-(omega**2) * s, c - damping * omega * s]])


def _beam(robot: RobotDescription) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Stations, masses, bending flexibilities and segments (-1: a connector) of pieces (m,)."""
    stations, masses, flexibilities, owners = [0.0], [0.0], [0.0], [-1]
    for index, segment in enumerate(robot.segments):
        geometry = SectionGeometry.of(segment)
        step = segment.length / _PIECES
        density = segment.material.density or _SILICONE
        modulus = segment.material.youngs_modulus
        if segment.compensation is not None:
            modulus *= segment.compensation.stiffness
        for _ in range(_PIECES):
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
    """Lateral displacement (m,) of a cantilever with curvatures (m,), scaled to 1 at its end."""
    steps = np.diff(station, prepend=station[0])
    slope = np.cumsum(curvature * steps)
    x = np.cumsum((slope - curvature * steps / 2) * steps)
    return np.asarray(x / x[-1])
