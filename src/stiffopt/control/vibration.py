"""The arm's first bending mode, of which a model of its statics knows nothing.

A hanging arm vibrates like a cantilever with a mass at its end. In the first mode, of shape phi
with phi(tip) = 1, the tip moves by eta in the plane in which it is soft::

    eta'' + 2 zeta omega eta' + omega^2 (eta - s) = 0,      omega^2 = k / m

k is the lateral stiffness of the tip and m the modal mass ``int phi^2 dm``. s is the projection of
the static shape x(S), to which pressures bend the arm, on the mode: ``int phi x dm / m``. For a
segment near the tip it is less than the displacement of the tip itself; the rest of that
displacement does not excite this mode and follows at once.

For s, phi and x are those of the straight arm, which bends against its stiffness and against the
weight that pulls at it. The weight straightens phi: with it, a segment near the tip takes part by
half and not by three quarters, as in the simulated arm. For m, phi is the shape of the cantilever
under a force at its tip: modal masses from frequencies and stiffnesses of the simulated arm, over
many configurations, lie within 4 % of each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from stiffopt.model.actuation import SectionGeometry
from stiffopt.model.description import RobotDescription

Array = NDArray[np.float64]
Symbols = Any  # of CasADi

_PIECES = 30  # of each segment
_SILICONE = 1070.0  # kg/m^3, where the robot file gives no density


@dataclass(frozen=True)
class BendingMode:
    """The first bending mode of an arm."""

    mass: float  # modal mass, in kg, of a mode shape that is 1 at the tip
    # share (n,) of the tip's displacement by each channel that the mode takes part in
    participation: Array

    @classmethod
    def of(cls, robot: RobotDescription) -> BendingMode:
        """Compute from the drawing of the straight arm, and the weight that pulls at it."""
        beam = _Beam.of(robot)
        phi = beam.first_mode()
        inertia = float(np.sum(beam.masses * phi**2))
        shares = []
        for index, segment in enumerate(robot.segments):
            x = beam.bent_by(np.where(beam.owners == index, 1.0, 0.0))
            share = float(np.sum(beam.masses * phi * x / x[-1])) / inertia
            shares += [share] * segment.n_channels
        return cls(float(np.sum(beam.masses * beam.pushed() ** 2)), np.array(shares))

    def frequency(self, stiffness: float) -> float:
        """Angular frequency, in rad/s, at a lateral stiffness of the tip in N/m."""
        return float(np.sqrt(max(stiffness, 0.0) / self.mass))

    def at_frequency(self, omega: float, stiffness: float) -> BendingMode:
        """Return this mode with the mass that gives it a frequency, in rad/s, at a stiffness."""
        return BendingMode(stiffness / omega**2, self.participation)


def lateral_stiffness(compliances: Any) -> float:
    """Lateral stiffness of a tip, in N/m, by its principal compliances (3,), the least first."""
    return 2 / float(compliances[1] + compliances[2])


def transition(omega: Symbols, damping: float, duration: Symbols) -> Symbols:
    """Transition matrix (2, 2) of a free vibration and its speed.

    omega is in rad/s, the duration in s; it may be negative.
    """
    damped = omega * (1 - damping**2) ** 0.5
    decay = ca.exp(-damping * omega * duration)
    c, s = decay * ca.cos(damped * duration), decay * ca.sin(damped * duration) / damped
    return ca.blockcat([[c + damping * omega * s, s], [-(omega**2) * s, c - damping * omega * s]])


@dataclass(frozen=True)
class _Beam:
    """The straight arm in small bending, in pieces of constant curvature (m,)."""

    owners: NDArray[np.int64]  # segments of the pieces
    moments: Array  # of bending by the curvatures, times the pieces' lengths, in N m^3
    shapes: Array  # (m + 1, m): displacements of the pieces' middles and of the tip by curvatures
    masses: Array  # (m + 1,) there, in kg
    stiffness: Array  # (m, m) by curvatures, of bending and of the weight that pulls at the arm

    @classmethod
    def of(cls, robot: RobotDescription) -> _Beam:
        rows = []  # of each piece: segment, length, mass, bending stiffness, rigid length behind
        for index, segment in enumerate(robot.segments):
            geometry = SectionGeometry.of(segment)
            modulus = segment.material.youngs_modulus
            if segment.compensation is not None:
                modulus *= segment.compensation.stiffness
            length = segment.length / _PIECES
            mass = (segment.material.density or _SILICONE) * geometry.area * length
            bending = modulus * float(np.trace(geometry.second_moment)) / 2
            gaps = [0.0] * (_PIECES - 1) + [segment.connector]
            rows += [(index, length, mass, bending, gap) for gap in gaps]
        owners, length, mass, bending, gap = np.array(rows).T
        end = np.cumsum(length + gap)
        middle = end - gap - length / 2
        before = np.tril(np.ones((len(rows), len(rows))), -1)
        own = np.eye(len(rows))
        at_middle = before * (middle[:, None] - middle) * length + own * length**2 / 8
        shapes = np.vstack([at_middle, length * (end[-1] - middle)])
        behind = robot.tip_mass + np.cumsum(mass[::-1])[::-1] - mass
        stiffness = np.diag(bending * length)
        for slopes, pull, over in (  # a slope shortens the arm, and lifts what hangs behind
            ((before + own / 2) * length, behind + mass / 2, length),
            ((before + own) * length, behind, gap),
        ):
            tension = float(robot.gravity[2]) * pull * over
            stiffness = stiffness + slopes.T @ (tension[:, None] * slopes)
        masses = np.append(mass, robot.tip_mass)
        return cls(owners.astype(int), bending * length, shapes, masses, stiffness)

    def first_mode(self) -> Array:
        """Shape (m + 1,) of the first mode, 1 at the tip."""
        inertia = self.shapes.T @ (self.masses[:, None] * self.shapes)
        last = len(inertia) - 1
        _, curvature = eigh(inertia, self.stiffness, subset_by_index=(last, last))
        shape = self.shapes @ curvature[:, 0]
        return np.asarray(shape / shape[-1])

    def bent_by(self, curvatures: Array) -> Array:
        """Shape (m + 1,) of the arm that its pressures bend by curvatures (m,)."""
        return np.asarray(self.shapes @ np.linalg.solve(self.stiffness, self.moments * curvatures))

    def pushed(self) -> Array:
        """Shape (m + 1,) of the weightless arm under a lateral force on its tip, 1 there."""
        shape = self.shapes @ (self.shapes[-1] / self.moments)
        return np.asarray(shape / shape[-1])
