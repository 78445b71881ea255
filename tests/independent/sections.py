"""Sections by boundary integrals: areas, moments, and the laws of the paper and of neo-Hooke."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from independent.arms import Tube
from independent.motions import Vector, shift, wrench_map


@dataclass(frozen=True)
class Integrals:
    """``int dA``, ``int r dA`` (2,) and ``int r r^T dA`` (2, 2) about the axis."""

    area: float
    first: Vector
    second: Vector

    def __add__(self, other: Integrals) -> Integrals:
        return Integrals(
            self.area + other.area, self.first + other.first, self.second + other.second
        )

    def __neg__(self) -> Integrals:
        return Integrals(-self.area, -self.first, -self.second)

    @property
    def centroid(self) -> Vector:
        """Centroid (2,)."""
        return self.first / self.area

    @property
    def about_centroid(self) -> Vector:
        """``int (r - c)(r - c)^T dA`` (2, 2)."""
        return self.second - np.outer(self.first, self.first) / self.area


def disc(x: float, y: float, radius: float) -> Integrals:
    """Integrals over a disc by Green's theorem along its edge (exact with 16 points)."""
    t = 2 * np.pi * np.arange(16) / 16
    X, Y = x + radius * np.cos(t), y + radius * np.sin(t)
    dy = radius * np.cos(t) * 2 * np.pi / 16
    xx, xy, yy = X**3 / 3 @ dy, X**2 * Y / 2 @ dy, X * Y**2 @ dy
    return Integrals(
        float(X @ dy), np.array([X**2 / 2 @ dy, X * Y @ dy]), np.array([[xx, xy], [xy, yy]])
    )


def bores(tube: Tube) -> list[Integrals]:
    """Integrals over each chamber."""
    return [
        disc(tube.offset * np.cos(a), tube.offset * np.sin(a), tube.chamber_radius)
        for a in np.radians(tube.angles)
    ]


def silicone(tube: Tube) -> Integrals:
    """Integrals over the solid part of the section."""
    whole = disc(0, 0, tube.outer_radius)
    if tube.inner_radius:
        whole = whole + -disc(0, 0, tube.inner_radius)
    for bore in bores(tube):
        whole = whole + -bore
    return whole


def pressure_resultant(tube: Tube, p: Vector) -> tuple[float, Vector]:
    """Force ``sum P A_c`` and ``sum P int r dA`` (2,) of the pressures about the axis."""
    chambers = bores(tube)
    pairs = [
        (value, chambers[number - 1])
        for value, channel in zip(p, tube.channels, strict=True)
        for number in channel
    ]
    force = sum(value * bore.area for value, bore in pairs)
    return float(force), np.sum([value * bore.first for value, bore in pairs], axis=0)


@dataclass(frozen=True)
class CentroidSection:
    """A section as its centroid line sees it.

    Attributes
    ----------
    centroid : (2,) off the axis, in the deformed section.
    stretch : of the centroid line per length at rest.
    curvature : (kappa_x, kappa_y) per deformed length.
    flexibility : (6, 6) per deformed length, about the centroid.
    """

    centroid: Vector
    stretch: float
    curvature: Vector
    flexibility: Vector


def _bending(second: Vector) -> Vector:
    """Moments (M_x, M_y) / E of unit curvatures, from ``int r r^T dA``."""
    (xx, xy), (_, yy) = second
    return np.array([[yy, -xy], [-xy, xx]])


def _flexibility(shear: float, axial: float, bending: Vector, torsion: float) -> Vector:
    C = np.diag([1 / shear, 1 / shear, 1 / axial, 0.0, 0.0, 1 / torsion])
    C[3:5, 3:5] = np.linalg.inv(bending)
    return C


def paper_section(tube: Tube, p: Vector) -> CentroidSection:
    """Eqs 8-10 with lambda, about the centroid where force and moment do not mix."""
    slope, area_factor, inertia_factor = tube.factors or (0.0, 1.0, 1.0)
    solid = silicone(tube)
    E = tube.youngs_modulus + slope * float(np.sqrt(np.sum(p**2)))
    G = E / (2 * (1 + tube.poisson_ratio))
    A, second = area_factor * solid.area, inertia_factor * solid.about_centroid
    force, lever = pressure_resultant(tube, p)
    x, y = lever - force * solid.centroid
    bending = E * _bending(second)
    return CentroidSection(
        centroid=solid.centroid,
        stretch=1 + force / (E * A),
        curvature=np.linalg.solve(bending, [y, -x]),
        flexibility=_flexibility(G * A, E * A, bending, G * np.trace(second)),
    )


def neo_hookean_section(tube: Tube, p: Vector) -> CentroidSection:
    """The incompressible neo-Hookean section, its stretch found by bisection."""
    mu, solid = tube.youngs_modulus / 3, silicone(tube)
    force, lever = pressure_resultant(tube, p)
    load = force / (mu * solid.area)
    stretch = float(brentq(lambda L: L - L**-2 - load, 0.3, 50.0, xtol=1e-15, rtol=1e-15))
    shrink = stretch**-0.5
    tangent = mu * (1 + 2 * stretch**-3)
    x, y = shrink * (lever - force * solid.centroid)
    second = shrink**2 * solid.about_centroid
    bending = tangent * _bending(second)
    flexibility = _flexibility(
        mu * solid.area, tangent * solid.area, bending, mu * np.trace(second)
    )
    return CentroidSection(
        centroid=shrink * solid.centroid,
        stretch=stretch,
        curvature=np.linalg.solve(bending, [y, -x]) / stretch,
        flexibility=flexibility / stretch,
    )


def section(tube: Tube, p: Vector) -> CentroidSection:
    """Section by the segment's law."""
    return (paper_section if tube.law == "paper" else neo_hookean_section)(tube, p)


@dataclass(frozen=True)
class RodSection:
    """Constitutive law of a segment per length at rest, about the axis."""

    strain: Vector  # (6,)
    compliance: Vector  # (6, 6)
    weight: Vector  # (3,) per length
    centroid: Vector  # (3,) where the weight acts, at rest


def rod_section(tube: Tube, p: Vector, gravity: ArrayLike) -> RodSection:
    """Move a section to the axis and to lengths at rest."""
    law = section(tube, p)
    x, y = law.centroid
    kx, ky = law.curvature
    inverse = np.linalg.inv(wrench_map(shift(x, y, 0)))
    strain = law.stretch * np.array([0, 0, 1 + ky * x - kx * y, kx, ky, 0])
    solid = silicone(tube)
    return RodSection(
        strain=strain,
        compliance=law.stretch * inverse.T @ law.flexibility @ inverse,
        weight=tube.density * solid.area * np.asarray(gravity, dtype=float),
        centroid=np.append(solid.centroid, 0.0),
    )
