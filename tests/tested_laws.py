"""What tests of strain laws share: tubes, laws with independent formulas, stresses in a section."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from independent.arms import CROSS, FLOP, LOPSIDED, PAIR, SIX, Tube, neo_hookean
from stiffopt.model.laws import strain_law
from stiffopt.model.segment import Segment

Vector = NDArray[np.float64]
TUBES = {"flop": FLOP, "cross": CROSS, "pair": PAIR, "lopsided": LOPSIDED, "six": SIX}
LAWS = {
    "paper": lambda tube: tube,
    "rest-length": lambda tube: replace(tube, law="rest-length"),
    "neo-hookean": neo_hookean,
}


def segment_of(tube: Tube, **compensation: float) -> Segment:
    """Segment of a tube, with some of its compensation replaced."""
    mapping = tube.mapping()
    if compensation:
        mapping["compensation"] = (mapping["compensation"] or {}) | compensation
    return Segment(**mapping)


@cache
def function_of(segment: Segment) -> ca.Function:
    """Strain (6,), compliance (6, 6) and margin of a segment as a function of its pressures."""
    law = strain_law(segment)
    p = ca.SX.sym("p", segment.n_channels)
    part = law.section(p)
    outputs = [part.strain, ca.densify(part.compliance), law.margin(p)]
    return ca.Function("law", [p], outputs)


def law_of(tube: Tube) -> ca.Function:
    return function_of(segment_of(tube))


def evaluated(segment: Segment, p: Vector) -> tuple[Vector, Vector]:
    """Strain (6,) and compliance (6, 6) of a segment."""
    strain, compliance, _ = function_of(segment)(p)
    return strain.full()[:, 0], compliance.full()


def strain_and_compliance(tube: Tube, p: Vector) -> tuple[Vector, Vector]:
    return evaluated(segment_of(tube), p)


def some_pressures(tube: Tube, seed: int = 0, highest: float = 1e5) -> Vector:
    return np.random.default_rng(seed).uniform(0, highest, len(tube.channels))


def scaled(matrix: Vector, size: Vector) -> Vector:
    """A compliance in units of the diagonal of another."""
    return matrix / np.sqrt(np.outer(np.diag(size), np.diag(size)))


def fibres(tube: Tube) -> Tube:
    """The same segment with the law of fibres, and stiffening."""
    return replace(tube, law="fibres", factors=None, poisson_ratio=0.5)


def disc_points(x: float, y: float, radius: float) -> tuple[Vector, Vector]:
    """Points (2, k) and weights (k,) that integrate polynomials over a disc."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    r, t = np.meshgrid(radius * (1 + nodes) / 2, 2 * np.pi * np.arange(24) / 24)
    w = np.outer(np.full(24, 2 * np.pi / 24), radius * weights / 2) * r
    return np.array([x + r * np.cos(t), y + r * np.sin(t)]).reshape(2, -1), w.ravel()


def solid_points(tube: Tube) -> tuple[Vector, Vector]:
    """Points and (signed) weights that integrate over the silicone."""
    discs = [(0.0, 0.0, tube.outer_radius, 1), (0.0, 0.0, tube.inner_radius, -1)]
    for a in np.radians(tube.angles):
        x, y = tube.offset * np.cos(a), tube.offset * np.sin(a)
        discs.append((x, y, tube.chamber_radius, -1))
    parts = [(disc_points(x, y, r), sign) for x, y, r, sign in discs]
    points = np.concatenate([points for (points, _), _ in parts], axis=1)
    return points, np.concatenate([sign * weights for (_, weights), sign in parts])


def resultant(
    tube: Tube, shrink: float, xi: Vector, area: float = 1.0, inertia: float = 1.0
) -> Vector:
    """Force and moment (6,) of the stresses in a neo-Hookean section, strain xi about the axis.

    A fibre at rest at r sits at ``shrink r``.  It is stretched by L and sheared by g; its energy
    ``mu/2 (L^2 + 2 / L + g.g - 3)`` gives the axial stress ``mu (L - L^-2)``.  The section has
    `area` times as much area, and is spread about its centroid to `inertia` times its moments.
    """
    mu = tube.youngs_modulus / 3
    points, weights = solid_points(tube)
    centre = (points @ weights / weights.sum())[:, np.newaxis]
    x, y = shrink * (centre + np.sqrt(inertia / area) * (points - centre))
    gx, gy, L = xi[0] - xi[5] * y, xi[1] + xi[5] * x, xi[2] + xi[3] * y - xi[4] * x
    sx, sy, sz = mu * gx, mu * gy, mu * (L - L**-2)
    return area * np.array([sx, sy, sz, y * sz, -x * sz, x * sy - y * sx]) @ weights
