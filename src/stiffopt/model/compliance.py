"""Compliance of the unloaded arm and what is read from it (eqs 11 to 17).

A compliance is 6x6, linear part first: twist = C wrench, both in the axes of the frame where
it is meant.  `C_a = X C_b X^T` with ``X = adjoint(T_ab)`` is eq. 16, since
``adjoint = coadjoint^-T``.
"""

from typing import Literal

import casadi as ca
import numpy as np

from stiffopt import lie
from stiffopt.model.actuation import Section

Frame = Literal["base", "tip"]
Kind = Literal["translation", "rotation"]
Boundary = Literal["free", "guided", "clamped"]

QUADRATURE_POINTS = 8
"""Gauss points per segment.

The integrand of eq. 17 is an entire function of arc length whose fastest oscillation has
twice the bending angle; eight points leave a relative error below 1e-10 for segments that
bend by up to 170 degrees, and below 1e-6 at a full circle.
"""


def segment_compliance(section: Section, arc_length: ca.SX | float) -> ca.SX:
    """Compliance (6, 6) of the first `arc_length` of a segment, in its far end's frame.

    ``int X C_S X^T dS`` with X the adjoint from the far end to S (eq. 17).
    """
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE_POINTS)
    C = ca.SX.zeros(6, 6)
    for node, weight in zip((1 + nodes) / 2, weights / 2, strict=True):
        X = lie.adjoint(lie.exp(section.strain * (-node * arc_length)))
        C += weight * (X @ section.compliance @ X.T)
    return C * arc_length


def carry_compliance(C: ca.SX, T: ca.SX) -> ca.SX:
    """Compliance C of frame b as seen in frame a, with ``T = T_ab`` (eq. 16)."""
    X = lie.adjoint(T)
    return X @ C @ X.T


def directional_stiffness(
    compliance: ca.SX,
    rotation: ca.SX,
    direction: ca.SX,
    frame: Frame,
    kind: Kind,
    boundary: Boundary,
) -> ca.SX:
    """Stiffness along (or about) a unit direction, in N/m (or N m/rad).

    Parameters
    ----------
    compliance : (6, 6)
        Compliance in the frame of the point that is loaded.
    rotation : (3, 3)
        Axes of that frame in the base frame.
    direction : (3,)
        Unit vector in base axes (`frame` "base") or in the point's own ("tip").
    frame, kind, boundary
        ``free``: ``1 / (d'C_vv d)``; ``guided``: the other two translations are held,
        ``d'C_vv^-1 d``; ``clamped``: rotation is held too, ``d'(C^-1)_vv d``.  With `kind`
        "rotation" the blocks of translation and rotation change places.
    """
    d = rotation.T @ direction if frame == "base" else direction
    if boundary == "free":
        block = compliance[:3, :3] if kind == "translation" else compliance[3:, 3:]
        return 1 / (d.T @ block @ d)
    return d.T @ stiffness_block(compliance, kind, boundary) @ d


def stiffness_block(compliance: ca.SX, kind: Kind, boundary: Boundary) -> ca.SX:
    """3x3 stiffness of translation or rotation, the other part free or held ("clamped")."""
    vv, vw = compliance[:3, :3], compliance[:3, 3:]
    wv, ww = compliance[3:, :3], compliance[3:, 3:]
    if kind == "rotation":
        vv, vw, wv, ww = ww, wv, vw, vv
    if boundary == "clamped":
        vv = vv - vw @ inverse_3x3(ww) @ wv  # (C^-1)_vv by its Schur complement
    return inverse_3x3(vv)


def inverse_3x3(matrix: ca.SX | ca.MX) -> ca.SX | ca.MX:
    """Inverse by cofactors, which CasADi has for SX alone."""
    if isinstance(matrix, ca.MX):
        A = ca.SX.sym("A", 3, 3)
        return ca.Function("inverse", [A], [ca.inv_minor(A)])(matrix)
    return ca.inv_minor(matrix)
