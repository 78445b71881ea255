"""From channel pressures to the strain and the compliance of a section (eqs 8-10).

A strain law says what a segment does without any load: the strain of its backbone and the
compliance of its section, both constant along the segment.  Laws use different length
conventions on paper; here both results are **per reference length**, so that the rest of the
model need not know.  To add a law, subclass `StrainLaw` and enter it in `STRAIN_LAWS`.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.model.description import Segment

NORM_SMOOTHING = 0.01
"""Rounding of the cone sqrt(p.p) at zero pressure, in Pa (see `smooth_norm`)."""


@dataclass(frozen=True)
class Section:
    """What a strain law answers for one segment, per reference length.

    Attributes
    ----------
    strain : casadi.SX
        Backbone strain (6,), linear part first: the pose obeys ``dT/dS = T strain^``.
    compliance : casadi.SX
        Section compliance (6, 6): extra strain per internal wrench, in section axes.
    """

    strain: ca.SX
    compliance: ca.SX


@dataclass(frozen=True)
class SectionGeometry:
    """Area properties of the silicone of a section and the lever arms of its channels.

    Attributes
    ----------
    area : float
        Silicone area A, wall less core less chambers, in m^2.
    centroid : ndarray
        Centroid (2,) in section axes, in m; zero for symmetric layouts.
    second_moment : ndarray
        ``int r r^T dA`` (2, 2) about the centroid, in m^4; its [1, 1] entry is I_x of eq. 10.
    channel_force : ndarray
        Chamber area of each channel (c,), in m^2: axial force per unit pressure.
    channel_moment : ndarray
        ``int r dA`` over each channel's chambers (c, 2), in m^3.
    """

    area: float
    centroid: NDArray[np.float64]
    second_moment: NDArray[np.float64]
    channel_force: NDArray[np.float64]
    channel_moment: NDArray[np.float64]

    @classmethod
    def of(cls, segment: Segment) -> "SectionGeometry":
        """Integrate over the section of a segment (eqs 8 and 10)."""
        chambers = segment.chambers
        angles = np.asarray(chambers.angles)
        centres = chambers.offset * np.stack([np.cos(angles), np.sin(angles)], axis=1)  # (m, 2)
        hole = np.pi * chambers.radius**2
        area = np.pi * (segment.outer_radius**2 - segment.inner_radius**2) - len(angles) * hole
        first_moment = -hole * centres.sum(axis=0)
        annulus = np.pi / 4 * (segment.outer_radius**4 - segment.inner_radius**4)
        own = len(angles) * np.pi / 4 * chambers.radius**4
        about_axis = (annulus - own) * np.eye(2) - hole * centres.T @ centres
        centroid = first_moment / area
        members = [[number - 1 for number in channel] for channel in segment.channels]
        return cls(
            area=area,
            centroid=np.where(np.abs(centroid) < 1e-12 * segment.outer_radius, 0.0, centroid),
            second_moment=_without_rounding(about_axis - area * np.outer(centroid, centroid)),
            channel_force=np.array([hole * len(chamber) for chamber in members]),
            channel_moment=np.array([hole * centres[chamber].sum(axis=0) for chamber in members]),
        )


def _without_rounding(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Drop off-diagonal entries that are only rounding, to keep the model's graph sparse."""
    return np.where(np.abs(matrix) < 1e-12 * np.abs(matrix).max(), 0.0, matrix)


def smooth_norm(p: ca.SX) -> ca.SX:
    """``sqrt(p.p + e^2) - e``: the norm of the pressures without its kink at p = 0."""
    return ca.sqrt(ca.sumsqr(p) + NORM_SMOOTHING**2) - NORM_SMOOTHING


def onset(p: ca.SX, dead_band: ca.SX | float) -> ca.SX:
    """Pressure less a dead band: ``w ln((1 + e^((p - b) / w)) / (1 + e^(-b / w)))``.

    Monotone, zero at p = 0, and its slope rises from 0.12 to 1; the width w is half the band b.
    """
    w = dead_band / 2
    z = (p - dead_band) / w
    # ln(1 + e^z) without overflow
    return w * (ca.fmax(z, 0) + ca.log1p(ca.exp(-ca.fabs(z))) - np.log1p(np.exp(-2.0)))


def _bending(second_moment: ca.SX) -> ca.SX:
    """Turn ``int r r^T dA`` into the matrix that maps (kappa_x, kappa_y) to (M_x, M_y) / E.

    The strain of a fibre at (x, y) is ``y kappa_x - x kappa_y`` and it adds ``(y, -x)`` to
    the moment.
    """
    quarter_turn = ca.DM([[0, 1], [-1, 0]])
    return quarter_turn @ second_moment @ quarter_turn.T


def _limited(kappa: ca.SX, radius: ca.SX | float) -> tuple[ca.SX, ca.SX]:
    """Curvature (2,) that approaches 1 / radius, and the root (2, 2) of its slope by the old one.

    The slope is ``((1 - n n') / (1 + z)^(1/2) + n n' / (1 + z)^(3/2))`` with z = R^2 |kappa|^2
    and n along kappa; its root, applied from both sides, keeps a flexibility symmetric.
    """
    root = ca.sqrt(1 + radius**2 * ca.sumsqr(kappa))
    along = radius**2 / (root * (1 + root)) * (kappa @ kappa.T)
    return kappa / root, (ca.SX.eye(2) - along) / ca.sqrt(root)


class StrainLaw(ABC):
    """Free strain and compliance of one segment's section as a function of its pressures."""

    limit: str
    """What goes wrong where `margin` is not positive, as the end of a sentence."""

    def __init__(self, segment: Segment) -> None:
        self.segment = segment
        self.geometry = SectionGeometry.of(segment)

    @abstractmethod
    def section(self, p: ca.SX) -> Section:
        """Section for the channel pressures p (c,) of this segment, in Pa."""

    @abstractmethod
    def margin(self, p: ca.SX) -> ca.SX:
        """Scalar that is positive where the law holds at pressures p (c,)."""

    def _acting(self, p: ca.SX) -> ca.SX:
        """Pressures (c,) that act in the chambers: ``gain onset(p) + offset``."""
        corrections = self.segment.corrections
        if corrections is None:
            return p
        if not ca.SX(corrections.dead_band).is_zero():
            p = onset(p, corrections.dead_band)
        if len(corrections.gain):
            p = p * ca.vertcat(*corrections.gain)
        if len(corrections.offset):
            p = p + ca.vertcat(*corrections.offset)
        return p

    def _axial_force(self, acting: ca.SX) -> ca.SX:
        """Force of the acting pressures on the section, ``f_z = sum P A_c``, in N."""
        return ca.dot(ca.DM(self.geometry.channel_force), acting)

    def _moment_about_centroid(self, acting: ca.SX) -> ca.SX:
        """Moment (M_x, M_y) of the acting pressures about the section's centroid, in N m."""
        geometry, corrections = self.geometry, self.segment.corrections
        lever = ca.SX(ca.sparsify(ca.DM(geometry.channel_moment.T)))  # (2, c): int r dA
        if corrections is not None and len(corrections.azimuth):
            turn = ca.vertcat(*corrections.azimuth).T
            c, s = ca.cos(turn), ca.sin(turn)
            lever = ca.vertcat(c * lever[0, :] - s * lever[1, :], s * lever[0, :] + c * lever[1, :])
        if geometry.centroid.any():
            lever -= ca.DM(np.outer(geometry.centroid, geometry.channel_force))
        first = lever @ acting  # (2,): int r P dA
        return ca.vertcat(first[1], -first[0])

    def _compliance_about_centroid(
        self, shear: ca.SX, axial: ca.SX, flexibility: ca.SX, torsion: ca.SX
    ) -> ca.SX:
        """``diag(GA, GA, EA, EI_x, EI_y, GJ)^-1`` with a full block (2, 2) of flexibility."""
        return ca.diagcat(1 / shear, 1 / shear, 1 / axial, flexibility, 1 / torsion)

    def _about_axis(self, compliance: ca.SX, centroid: ca.SX) -> ca.SX:
        """Move a compliance from the centroid to the backbone axis (eq. 16)."""
        if not self.geometry.centroid.any():
            return compliance
        A = lie.adjoint(lie.transform(ca.SX.eye(3), ca.vertcat(centroid, 0)))
        return ca.sparsify(A @ compliance @ A.T)


class PaperLaw(StrainLaw):
    """The paper's law: linear, per deformed length, with compensation coefficients lambda.

    ``lambda_E = E + slope |p|``, ``lambda_A = a A``, ``lambda_I = i I``; elongation
    ``f_z l / (E A)``; curvature ``M / (E I)`` per *deformed* length, and the compliance of
    eq. 17 integrated over deformed length (slip 8 of the notes).  Where the centroid is off the
    axis, which the paper does not treat, all this holds for the line of centroids, and the
    compensated second moment is that about the centroid.

    Loads meet the modulus ``stiffness (E + softening slope |p|)``, the paper's own where both
    factors are 1.  Where there is a least bending radius R, the curvature is
    ``kappa / sqrt(1 + R^2 |kappa|^2)`` instead, and loads meet the derivative of that by the
    moment.  See `stiffopt.model.description.Compensation`.
    """

    limit = "the pressure drives the compensated modulus of this segment to zero"

    def _modulus(self, acting: ca.SX, softening: Any = 1.0) -> ca.SX:
        modulus = self.segment.material.youngs_modulus
        compensation = self.segment.compensation
        if compensation is None:
            return ca.SX(modulus)
        slope = ca.SX(softening * compensation.modulus_per_pressure)
        return ca.SX(modulus) if slope.is_zero() else modulus + slope * smooth_norm(acting)

    def _loaded_modulus(self, acting: ca.SX) -> ca.SX:
        """Modulus with which the section gives way to loads."""
        compensation = self.segment.compensation
        if compensation is None:
            return self._modulus(acting)
        return compensation.stiffness * self._modulus(acting, compensation.softening)

    def margin(self, p: ca.SX) -> ca.SX:
        """Compensated modulus over a thousandth of the nominal one, less one."""
        return self._modulus(self._acting(p)) / (1e-3 * self.segment.material.youngs_modulus) - 1

    def section(self, p: ca.SX) -> Section:
        """Section of eqs 8-10; see `StrainLaw.section`."""
        compensation = self.segment.compensation
        scale_area = compensation.area if compensation else 1.0
        scale_inertia = compensation.inertia if compensation else 1.0
        radius = compensation.bending_radius if compensation else 0.0
        lengthening = compensation.lengthening if compensation else 0.0
        geometry = self.geometry
        area = scale_area * geometry.area
        inertia = scale_inertia * ca.DM(geometry.second_moment)
        acting = self._acting(p)
        E = self._modulus(acting)
        loaded = self._loaded_modulus(acting)
        G = loaded / (2 * (1 + self.segment.material.poisson_ratio))
        force, moment = self._axial_force(acting), self._moment_about_centroid(acting)
        kappa = ca.inv_minor(_bending(ca.SX(inertia))) @ moment / E
        flexibility = ca.inv_minor(loaded * _bending(inertia))
        if not ca.SX(radius).is_zero():
            kappa, less = _limited(kappa, radius)
            flexibility = less @ flexibility @ less
        per_deformed_length = self._about_axis(
            self._compliance_about_centroid(
                shear=G * area,
                axial=loaded * area,
                flexibility=flexibility,
                torsion=G * ca.trace(inertia),
            ),
            ca.SX(geometry.centroid),
        )
        c = geometry.centroid
        stretch = 1 + force / (E * area)  # of the line of centroids
        if not ca.SX(lengthening).is_zero():
            stretch += lengthening * self.segment.outer_radius**2 * ca.sumsqr(kappa)
        strain = stretch * ca.vertcat(0, 0, 1 + kappa[1] * c[0] - kappa[0] * c[1], kappa, 0)
        return Section(strain, stretch * per_deformed_length)


class NeoHookeanLaw(StrainLaw):
    """Incompressible neo-Hookean section, per reference length.

    With ``mu = E / 3`` and chambers of constant bore (fibre-reinforced), the pressure force N
    stretches the section by the positive root of ``lambda - lambda^-2 = N / (mu A)``.  The
    section shrinks by ``a = lambda^-1/2``, the lever arms of the chambers with it.  About that
    state the section has (per reference length, in shrunk axes)

    * axial stiffness ``E_t A`` with the tangent modulus ``E_t = mu (1 + 2 lambda^-3)``,
    * bending stiffness ``E_t I a^2``, moment ``a sum P A_c r``,
    * shear stiffness ``mu A`` and torsional stiffness ``mu J a^2``,

    exact for the strain to first order in curvature, and for the compliance where the segment
    is straight; the coupling of stretch and bending that grows with curvature is left out.
    """

    limit = "the pressure compresses this segment beyond the neo-Hookean law's range"
    _lowest_load = -1.8  # the closed-form root below is real down to -3 / 2^(2/3) = -1.89

    def _shear_modulus(self) -> float:
        return self.segment.material.youngs_modulus / 3

    def margin(self, p: ca.SX) -> ca.SX:
        """Distance of the axial load N / (mu A) from the largest compression."""
        load = self._axial_force(self._acting(p)) / (self._shear_modulus() * self.geometry.area)
        return load - self._lowest_load

    def section(self, p: ca.SX) -> Section:
        """Section about the stretched state; see `StrainLaw.section`."""
        geometry = self.geometry
        mu = self._shear_modulus()
        acting = self._acting(p)
        load = self._axial_force(acting) / (mu * geometry.area)
        stretch = neo_hookean_stretch(load)
        tangent_modulus = mu * (1 + 2 * stretch**-3)
        shrink = 1 / ca.sqrt(stretch)
        bending = tangent_modulus * _bending(ca.DM(geometry.second_moment)) / stretch
        centroid = shrink * ca.SX(geometry.centroid)
        compliance = self._about_axis(
            self._compliance_about_centroid(
                shear=mu * geometry.area,
                axial=tangent_modulus * geometry.area,
                flexibility=ca.inv_minor(bending),
                torsion=mu * np.trace(geometry.second_moment) / stretch,
            ),
            centroid,
        )
        omega = ca.inv_minor(bending) @ (shrink * self._moment_about_centroid(acting))
        axis_stretch = stretch + omega[1] * centroid[0] - omega[0] * centroid[1]
        return Section(ca.vertcat(0, 0, axis_stretch, omega, 0), compliance)


def neo_hookean_stretch(load: ca.SX) -> ca.SX:
    """Stretch of an incompressible neo-Hookean bar: ``lambda - lambda^-2 = load``.

    The one positive root of ``lambda^3 - load lambda^2 - 1 = 0`` by Cardano's formula, real
    for ``load > -3 / 2^(2/3)``.
    """
    third = load / 3
    half_q = third**3 + 0.5
    root = half_q + ca.sqrt(third**3 + 0.25)
    u = root ** (1 / 3)
    return third + u + third**2 / u


STRAIN_LAWS: dict[str, type[StrainLaw]] = {"paper": PaperLaw, "neo-hookean": NeoHookeanLaw}


def strain_law(segment: Segment) -> StrainLaw:
    """Strain law that a segment's description names."""
    return STRAIN_LAWS[segment.strain_law](segment)
