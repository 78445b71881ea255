"""The arm's first bending mode, which a model of its statics does not contain.

A hanging arm vibrates like a cantilever with a mass at its end. In the first mode, of shape phi
with phi(tip) = 1, the tip moves by eta in the plane in which it is soft::

    eta'' + 2 zeta omega eta' + omega^2 (eta - s) = 0,      omega^2 = k / m

k is the lateral stiffness of the tip and m the modal mass ``int phi^2 dm``. s is the projection on
the mode of the static shape x(S) to which pressures bend the arm: ``int phi x dm / m``. For a
segment near the tip, s is less than the tip's displacement; the rest of that displacement does not
excite this mode and follows at once.

For s, phi and x are those of the straight arm, which bends against its stiffness and against the
weight that pulls at it. The weight straightens phi: with it, a segment near the tip takes part with
a half instead of three quarters, as in the simulated arm. For m, phi is the shape of the cantilever
under a force at its tip: over many configurations, the modal masses from frequencies and
stiffnesses of the simulated arm are within 4 % of each other.

A bent arm differs: where the segment near the tip stands out sideways, the other segment takes part
with up to one and a half times the tip's displacement. `BentMode` has the modes of the equilibrium.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from stiffopt.arrays import Array
from stiffopt.model.actuation import SectionGeometry
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator

Symbols = Any  # of CasADi

_PIECES = 30  # per segment
_STATIONS = 3  # per segment of a bent arm; more change the shares by a few per cent
_LEAST_MASS = 1e-6  # kg, at the tip
_SILICONE = 1070.0  # kg/m^3, if the robot file gives no density


@dataclass(frozen=True)
class BendingMode:
    """The first bending mode of an arm."""

    mass: float  # modal mass, in kg, of a mode shape that is 1 at the tip
    # share (n,) of each channel's displacement of the tip in which the mode takes part
    participation: Array

    @classmethod
    def of(cls, robot: RobotDescription) -> BendingMode:
        """Compute the mode of the straight arm, with the weight that pulls at it."""
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
        """Return the angular frequency, in rad/s, at a lateral stiffness of the tip, in N/m."""
        return math.sqrt(max(stiffness, 0.0) / self.mass)

    def at_frequency(self, omega: float, stiffness: float) -> BendingMode:
        """Return this mode with the mass for a frequency, in rad/s, at a stiffness, in N/m."""
        return BendingMode(stiffness / omega**2, self.participation)


def lateral_stiffness(compliances: Any) -> float:
    """Return a tip's lateral stiffness, in N/m, from its principal compliances (3,), ascending."""
    return 2 / float(compliances[1] + compliances[2])


def transition(omega: Symbols, damping: float, duration: Symbols) -> Symbols:
    """Return the transition matrix (2, 2) of a free vibration and its speed.

    `omega` is in rad/s; `duration`, in s, may be negative.
    """
    damped = omega * (1 - damping**2) ** 0.5
    decay = ca.exp(-damping * omega * duration)
    c, s = decay * ca.cos(damped * duration), decay * ca.sin(damped * duration) / damped
    return ca.blockcat([[c + damping * omega * s, s], [-(omega**2) * s, c - damping * omega * s]])


@dataclass(frozen=True)
class BentMode:
    """The two first bending modes of an arm in equilibrium, which have about the same frequency.

    With C the compliance between stations along the arm, which includes the effect of loads, and m
    their masses, the modes are the eigenvectors of ``C m`` of the two largest eigenvalues.

    Attributes
    ----------
    jacobian : (3, n), displacement of the tip in these modes per pressure, at rest, in m/Pa, base
        axes.
    linear : (3, n), the whole displacement of the tip per pressure there.
    plane : (3, 3), projection on the plane in which the modes move the tip.
    """

    jacobian: Array
    linear: Array
    plane: Array

    @classmethod
    def of(cls, robot: Manipulator, pressures: Array) -> BentMode:
        """Compute the modes at pressures (n,), in Pa.

        `EquilibriumError` or `PressureError` if the arm has no equilibrium there.
        """
        at, masses = _stations(robot.description)
        k, root = len(at), np.sqrt(np.repeat(masses, 3))[:, None]
        rotations = robot.pose(pressures, at)[:, :3, :3]
        shapes = (rotations @ robot.body_jacobian(pressures, at)[:, :3]).reshape(3 * k, -1)
        first, second = (grid.ravel() for grid in np.meshgrid(at, at, indexing="ij"))
        blocks = robot.compliance_between(pressures, first, second)[:, :3, :3]
        C = blocks.reshape(k, k, 3, 3).swapaxes(1, 2).reshape(3 * k, 3 * k)
        _, vectors = np.linalg.eigh(root * (C + C.T) / 2 * root.T)
        modes = vectors[:, -2:]  # of unit modal mass, times the root of the masses
        tips = modes[-3:] / root[-1]
        axes = np.linalg.svd(tips)[0][:, :2]
        return cls(tips @ modes.T @ (root * shapes), shapes[-3:], axes @ axes.T)

    def excess(self, participation: Array) -> Array:
        """Return by how much the Jacobian (3, n) exceeds that by shares (n,) of a straight arm."""
        return self.jacobian - self.plane @ (self.linear * participation)


def _stations(robot: RobotDescription) -> tuple[Array, Array]:
    """Return arc lengths (k,) of an arm's masses, the last one at the tip, and the masses (k,)."""
    start, rows = 0.0, []
    for segment in robot.segments:
        length = segment.length / _STATIONS
        area = SectionGeometry.of(segment).area
        mass = (segment.material.density or _SILICONE) * area * length
        rows += [(start + (index + 0.5) * length, mass) for index in range(_STATIONS)]
        start += segment.length + segment.connector
    at, masses = np.array([*rows, (start, max(robot.tip_mass, _LEAST_MASS))]).T
    return at, masses


@dataclass(frozen=True)
class _Beam:
    """The straight arm in small bending, in pieces of constant curvature (m,)."""

    owners: NDArray[np.int64]  # each piece's segment
    moments: Array  # bending stiffness times length of each piece, in N m^3
    shapes: Array  # (m + 1, m): displacements of the pieces' middles and the tip per curvature
    masses: Array  # (m + 1,) there, in kg
    stiffness: Array  # (m, m) for curvatures, from bending and from the weight that pulls

    @classmethod
    def of(cls, robot: RobotDescription) -> _Beam:
        rows = []  # of each piece: segment, length, mass, bending stiffness, rigid length after it
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
        for slopes, pull, over in (  # a slope shortens the arm and lifts what hangs below it
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
        """Return the shape (m + 1,) of the arm if pressures bend it by curvatures (m,)."""
        return np.asarray(self.shapes @ np.linalg.solve(self.stiffness, self.moments * curvatures))

    def pushed(self) -> Array:
        """Return the shape (m + 1,) of the weightless arm under a lateral tip force, 1 there."""
        shape = self.shapes @ (self.shapes[-1] / self.moments)
        return np.asarray(shape / shape[-1])
