"""Strain laws: from channel pressures to the strain and compliance of a section (eqs 8-10).

A strain law maps the pressures of a segment to the strain of its unloaded backbone and to the
compliance of its section, both constant along the segment.  Publications give them per length at
rest or per deformed length; here both are **per length at rest**.  The laws themselves are in
`stiffopt.model.laws`, one file each.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.model.calibration import FittedNumber
from stiffopt.model.segment import Compensation, Segment
from stiffopt.schema import BadKeyError, Schema

NORM_SMOOTHING = 0.01
"""Rounding of the cone sqrt(p.p) at zero pressure, in Pa (see `smooth_norm`)."""


@dataclass(frozen=True)
class Section:
    """Free strain and compliance of the section of one segment, per length at rest.

    `strain`: backbone strain (6,), linear part first: the pose obeys ``dT/dS = T strain^``.
    `compliance`: section compliance (6, 6): extra strain per internal wrench, in section axes.
    """

    strain: ca.SX
    compliance: ca.SX


@dataclass(frozen=True)
class SectionGeometry:
    """Area properties of the silicone of a section and the lever arms of its channels.

    All may also be symbols, see `stiffopt.model.layout`.
    """

    area: Any  # silicone area A, without core and chambers, in m^2
    centroid: Any  # centroid (2,) in section axes, in m; zero for symmetric layouts
    # ``int r r^T dA`` (2, 2) about the centroid, in m^4; its [1, 1] entry is I_x of eq. 10
    second_moment: Any
    channel_force: Any  # chamber area of each channel (c,), in m^2: axial force per unit pressure
    channel_moment: Any  # ``int r dA`` over each channel's chambers (c, 2), in m^3

    @property
    def is_eccentric(self) -> bool:
        """Whether the centroid may lie off the axis."""
        return not ca.SX(self.centroid).is_zero()

    def turned(self, azimuth: Array) -> SectionGeometry:
        """Return the same section with the lever arms of its channels turned about the axis.

        `azimuth`: of each channel (c,), from x towards y, in rad; empty for none.
        """
        if not azimuth.any():
            return self
        c, s = np.cos(azimuth), np.sin(azimuth)
        x, y = self.channel_moment.T
        return replace(self, channel_moment=np.stack([c * x - s * y, s * x + c * y], axis=1))

    @classmethod
    def of(cls, segment: Segment) -> SectionGeometry:
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


def _without_rounding(matrix: Array) -> Array:
    """Drop off-diagonal entries that are only rounding, to keep the model's graph sparse."""
    return np.where(np.abs(matrix) < 1e-12 * np.abs(matrix).max(), 0.0, matrix)


def smooth_norm(p: ca.SX) -> ca.SX:
    """Return ``sqrt(p.p + e^2) - e``: the norm of the pressures without its kink at p = 0."""
    return ca.sqrt(ca.sumsqr(p) + NORM_SMOOTHING**2) - NORM_SMOOTHING


def onset(p: ca.SX, dead_band: ca.SX | float) -> ca.SX:
    """Return the pressure less a dead band: ``w ln((1 + e^((p - b) / w)) / (1 + e^(-b / w)))``.

    Smooth, monotone, zero at p = 0; its slope rises from 0.12 to 1.  The width w is half the
    band b.  Far above the band it is ``p - 1.06 b``.  It is meant for positive pressures: below
    zero it is almost flat.
    """
    w = dead_band / 2
    z = (p - dead_band) / w
    # ln(1 + e^z) without overflow; from z = 30 on it equals z up to rounding
    logarithm = ca.if_else(z > 30, z, ca.log1p(ca.exp(ca.fmin(z, 40))))
    return w * (logarithm - np.log1p(np.exp(-2.0)))


def bending_matrix(second_moment: ca.SX) -> ca.SX:
    """Return the matrix from (kappa_x, kappa_y) to (M_x, M_y) / E, given ``int r r^T dA`` (2, 2).

    The strain of a fibre at (x, y) is ``y kappa_x - x kappa_y`` and it adds ``(y, -x)`` to
    the moment.
    """
    quarter_turn = ca.DM([[0, 1], [-1, 0]])
    return quarter_turn @ second_moment @ quarter_turn.T


def _limited(kappa: ca.SX, radius: ca.SX | float) -> tuple[ca.SX, ca.SX]:
    """Return the curvature (2,) limited to 1 / radius, and the square root (2, 2) of its slope.

    The slope is ``((1 - n n') / (1 + z)^(1/2) + n n' / (1 + z)^(3/2))`` with z = R^2 |kappa|^2
    and n along kappa; its root, applied from both sides, keeps a flexibility symmetric.
    """
    root = ca.sqrt(1 + radius**2 * ca.sumsqr(kappa))
    along = radius**2 / (root * (1 + root)) * (kappa @ kappa.T)
    return kappa / root, (ca.SX.eye(2) - along) / ca.sqrt(root)


class StrainLaw(ABC):
    """Free strain and compliance of one segment's section as a function of its pressures.

    A subclass with a `name` is registered when it is defined, and robot files can name it.

    Attributes
    ----------
    name : str
        Name in robot files, ``strain_law: NAME``.
    words : str
        The law's assumptions, in a few words, for reports.
    limit : str
        What fails where `margin` is not positive, as the end of a sentence.
    Keys : type of Schema or None
        Keys of the robot file that only this law has, as ``law: {...}`` of a segment. Those whose
        annotation holds a `FittedNumber` may be fitted by calibration. It starts at their defaults
        when it tries the law on an arm whose file names another.
    fitted_keys : tuple of str
        Keys of a segment's `material` and `compensation` that calibration may fit under this law.
    complexity : int
        Calibration tries simple laws first, and of laws that predict equally well takes the
        simplest.
    """

    name: ClassVar[str]
    words: ClassVar[str]
    limit: ClassVar[str]
    Keys: ClassVar[type[Schema] | None] = None
    fitted_keys: ClassVar[tuple[str, ...]] = (
        "material.youngs_modulus",
        "compensation.area",
        "compensation.stiffness",
        "compensation.modulus_per_pressure",
        "compensation.bending_radius",
        "compensation.lengthening",
    )
    complexity: ClassVar[int] = 3
    registered: ClassVar[dict[str, type[StrainLaw]]] = {}
    """Laws defined so far, by name; `stiffopt.model.laws.strain_laws` returns all."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "name" not in vars(cls):
            return
        for other in cls.registered.values():
            if other.__qualname__ == cls.__qualname__ and other.__module__ == cls.__module__:
                continue  # the module was reloaded
            if other.name == cls.name:
                raise TypeError(f"there are two strain laws of the name {cls.name!r}")
            for key, number in cls.fitted_numbers().items():
                if other.fitted_numbers().get(key, number) != number:
                    raise TypeError(f"the strain laws {cls.name!r} and {other.name!r} share {key}")
        cls.registered[cls.name] = cls

    def __init__(self, segment: Segment, geometry: SectionGeometry | None = None) -> None:
        self.segment = segment
        self.geometry = geometry or SectionGeometry.of(segment)
        self.compensation = segment.compensation or Compensation()
        self.keys: Any = segment.law or (self.Keys() if self.Keys is not None else None)

    @classmethod
    def fitted_numbers(cls) -> dict[str, FittedNumber]:
        """Return the `FittedNumber` of each of the law's own keys, by key."""
        fields = cls.Keys.model_fields if cls.Keys is not None else {}
        return {
            f"law.{key}": number
            for key, field in fields.items()
            for number in field.metadata
            if isinstance(number, FittedNumber)
        }

    @classmethod
    def check(cls, segment: Segment) -> None:
        """Reject a segment that the law cannot describe, when its description is made.

        Raises
        ------
        BadKeyError
            With the key of the segment.
        """
        if cls.Keys is not None and segment.law is None:
            fields = cls.Keys.model_fields.items()
            missing = [key for key, field in fields if field.is_required()]
            if missing:
                raise BadKeyError(
                    "law", f"the strain law '{cls.name}' needs the keys {', '.join(missing)} here"
                )

    @abstractmethod
    def section(self, p: ca.SX) -> Section:
        """Return the section for the channel pressures p (c,) of this segment, in Pa."""

    @abstractmethod
    def margin(self, p: ca.SX) -> ca.SX:
        """Return a scalar that is positive where the law holds at pressures p (c,)."""

    def radius(self, p: ca.SX) -> ca.SX | float:
        """Return the outer radius of the free section at pressures p (c,), in m; default: at rest.

        A law that models swelling or thinning overrides it.
        """
        return self.segment.outer_radius

    def _acting(self, p: ca.SX) -> ca.SX:
        """Return the pressures (c,) that act in the chambers: ``gain onset(p) + offset``."""
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

    def _modulus(self, acting: ca.SX, softening: Any = 1.0) -> ca.SX:
        """Return the compensated modulus ``E + softening slope |p|``, or its exponential, in Pa."""
        modulus = self.segment.material.youngs_modulus
        slope = ca.SX(softening * self.compensation.modulus_per_pressure)
        if slope.is_zero():
            return ca.SX(modulus)
        if self.compensation.modulus_law == "exponential":
            return modulus * ca.exp(slope / modulus * smooth_norm(acting))
        return modulus + slope * smooth_norm(acting)

    def _loaded_modulus(self, acting: ca.SX) -> ca.SX:
        """Return the section's modulus against loads, in Pa."""
        return self.compensation.stiffness * self._modulus(acting, self.compensation.softening)

    def _modulus_margin(self, p: ca.SX) -> ca.SX:
        """Return the compensated modulus over a thousandth of the nominal one, less one."""
        return self._modulus(self._acting(p)) / (1e-3 * self.segment.material.youngs_modulus) - 1

    def _bent(self, omega: ca.SX, flexibility: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return curvature (2,) and flexibility, limited by the least bending radius.

        The flexibility (k, k) may have other rows before its last two, which are those of bending.
        """
        radius = self.compensation.bending_radius
        if ca.SX(radius).is_zero():
            return omega, flexibility
        omega, less = _limited(omega, radius)
        less = ca.diagcat(ca.SX.eye(flexibility.shape[0] - 2), less)
        return omega, less @ flexibility @ less

    def _lengthened(self, stretch: ca.SX, omega: ca.SX) -> ca.SX:
        """Return the stretch of the line of centroids with that due to bending by omega (2,)."""
        lengthening = self.compensation.lengthening
        if ca.SX(lengthening).is_zero():
            return stretch
        return stretch + lengthening * self.segment.outer_radius**2 * ca.sumsqr(omega)

    def _axial_force(self, acting: ca.SX) -> ca.SX:
        """Return the force of the acting pressures on the section, ``f_z = sum P A_c``, in N."""
        return ca.dot(ca.SX(self.geometry.channel_force), acting)

    def _moment_about_centroid(self, acting: ca.SX) -> ca.SX:
        """Return the moment (M_x, M_y) of the acting pressures about the centroid, in N m."""
        geometry, corrections = self.geometry, self.segment.corrections
        lever = ca.sparsify(ca.SX(geometry.channel_moment.T))  # (2, c): int r dA
        if corrections is not None and len(corrections.azimuth):
            turn = ca.vertcat(*corrections.azimuth).T
            c, s = ca.cos(turn), ca.sin(turn)
            lever = ca.vertcat(c * lever[0, :] - s * lever[1, :], s * lever[0, :] + c * lever[1, :])
        if geometry.is_eccentric:
            lever -= ca.SX(geometry.centroid) @ ca.SX(geometry.channel_force).T
        first = lever @ acting  # (2,): int r P dA
        return ca.vertcat(first[1], -first[0])

    def _compliance_about_centroid(
        self, shear: ca.SX, axial: ca.SX, flexibility: ca.SX, torsion: ca.SX
    ) -> ca.SX:
        """Return ``diag(GA, GA, EA, EI_x, EI_y, GJ)^-1`` with a full flexibility block (2, 2)."""
        return ca.diagcat(1 / shear, 1 / shear, 1 / axial, flexibility, 1 / torsion)

    def _about_axis(self, compliance: ca.SX, centroid: ca.SX) -> ca.SX:
        """Move a compliance from the centroid to the backbone axis (eq. 16)."""
        if not self.geometry.is_eccentric:
            return compliance
        A = lie.adjoint(lie.transform(ca.SX.eye(3), ca.vertcat(centroid, 0)))
        return ca.sparsify(A @ compliance @ A.T)
