"""Compliance of the unloaded arm, and stiffnesses derived from it (eqs 11 to 17).

A compliance is 6x6, linear part first: twist = C wrench, both in the axes of the frame to which
it refers.  `C_a = X C_b X^T` with ``X = adjoint(T_ab)`` is eq. 16, since
``adjoint = coadjoint^-T``.
"""

from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
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


@dataclass(frozen=True)
class NodePair:
    """Two Gauss points, at ``-s`` and ``+s`` from the middle of a segment.

    The motion from the middle to them is ``(even +- odd)``, in rotation and in position.
    """

    weight: float  # of each point, times the length
    rotation: tuple[ca.SX, ca.SX]  # (3, 3), even and odd in s
    position: tuple[ca.SX, ca.SX]  # (3,)


def node_pairs(section: Section, arc_length: float) -> list[NodePair]:
    """Return the Gauss points of a segment of constant strain and this length."""
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE_POINTS)
    pairs = []
    for node, weight in zip(nodes, weights, strict=True):
        if node <= 0:
            continue  # the points are symmetric, and of even number
        twist = section.strain * (0.5 * arc_length * node)
        v, w = twist[:3], twist[3:]
        first, second, third = lie.exponential_coefficients(ca.sumsqr(w))
        W = lie.hat(w)
        W2 = W @ W
        pairs.append(
            NodePair(
                0.5 * arc_length * weight,
                (ca.SX.eye(3) + second * W2, first * W),
                (second * (W @ v), v + third * (W2 @ v)),
            )
        )
    return pairs


def segment_compliance(section: Section, arc_length: float, half: ca.SX) -> ca.SX:
    """Return the compliance (6, 6) of a segment's first `arc_length`, in its far end's frame.

    It is ``int X C_S X^T dS`` with X the adjoint from the far end to S (eq. 17), taken about the
    middle; `half` (4, 4) is the motion from there to the far end.
    """
    C = ca.SX.zeros(6, 6)
    for pair in node_pairs(section, arc_length):
        R, odd_R = pair.rotation
        p, odd_p = (lie.hat(position) for position in pair.position)
        even = _upper_triangular(R, p @ R + odd_p @ odd_R)
        odd = _upper_triangular(odd_R, p @ odd_R + odd_p @ R)
        own = section.compliance
        C += (2 * pair.weight) * (_congruent(even, own) + _congruent(odd, own))
    return carry_compliance(C, lie.inverse(half))


def segment_flexibility(section: Section, arc_length: float, wrench: ca.SX) -> ca.SX:
    """Return twice the strain energy of a wrench (6,) at the middle of a segment, in its axes.

    It is ``int w' C_S w dS`` with w the wrench that the section at S carries.
    """
    force, moment = wrench[:3], wrench[3:]
    total = ca.SX(0)
    for pair in node_pairs(section, arc_length):
        R, odd_R = pair.rotation
        p, odd_p = pair.position
        here, odd = moment - ca.cross(p, force), ca.cross(odd_p, force)
        # (R + odd_R)' (here - odd), with R symmetric and odd_R skew
        parts = (
            ca.vertcat(R @ force, R @ here + odd_R @ odd),
            ca.vertcat(odd_R @ force, odd_R @ here + R @ odd),  # up to the sign
        )
        energies = (part.T @ section.compliance @ part for part in parts)
        total += (2 * pair.weight) * sum(energies)
    return total


def _upper_triangular(diagonal: ca.SX, corner: ca.SX) -> ca.SX:
    return ca.vertcat(ca.horzcat(diagonal, corner), ca.horzcat(ca.SX(3, 3), diagonal))


def carry_compliance(C: ca.SX, T: ca.SX) -> ca.SX:
    """Return compliance C of frame b as seen in frame a, with ``T = T_ab`` (eq. 16)."""
    return _congruent(lie.adjoint(T), C)


def _congruent(X: ca.SX, C: ca.SX) -> ca.SX:
    """Return ``X C X'`` of a symmetric C, computing only half of it."""
    XC = X @ C
    upper = ca.SX(*C.shape)
    for row in range(C.shape[0]):
        for column in range(row, C.shape[1]):
            upper[row, column] = ca.dot(XC[row, :], X[column, :])
    return ca.triu2symm(upper)


def directional_stiffness(
    compliance: ca.SX,
    rotation: ca.SX,
    direction: ca.SX,
    frame: Frame,
    kind: Kind,
    boundary: Boundary,
) -> ca.SX:
    """Return the stiffness along (or about) a unit direction, in N/m (or N m/rad).

    Parameters
    ----------
    compliance : (6, 6), compliance in the frame of the loaded point.
    rotation : (3, 3), axes of that frame in the base frame.
    direction : (3,), unit vector in base axes (`frame` "base") or in the point's own ("tip").
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


def stiffness_of(C: Array, d: Array, kind: Kind, boundary: Boundary) -> Array:
    """Return `directional_stiffness` (...) of compliances (..., 6, 6) that are known as numbers.

    The unit directions d (..., 3) are in the axes of the compliances.
    """
    own, other = slice(0, 3), slice(3, 6)
    if kind == "rotation":
        own, other = other, own
    block, d = C[..., own, own], d[..., None]
    if boundary == "free":
        flexibility: Array = np.sum(d * (block @ d), axis=(-2, -1))
        return 1 / flexibility
    if boundary == "clamped":
        reaction = np.linalg.solve(C[..., other, other], C[..., other, own])
        block = block - C[..., own, other] @ reaction
    return np.sum(d * np.linalg.solve(block, d), axis=(-2, -1))


def held_stiffness(
    compliance: ca.SX, direction: ca.SX, is_rotation: ca.SX, is_clamped: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Return the "guided" or "clamped" stiffness along a unit direction (3,).

    The direction is in the axes of the compliance.  The conditions are symbols, 0 or 1.  The second
    result is the wrench (6,) that moves the held point by one unit in this direction.
    """
    vv, vw = compliance[:3, :3], compliance[:3, 3:]
    wv, ww = compliance[3:, :3], compliance[3:, 3:]

    def chosen(rotation: ca.SX, translation: ca.SX) -> ca.SX:
        return ca.if_else(is_rotation, rotation, translation)

    reaction = -is_clamped * inverse_3x3(chosen(vv, ww)) @ chosen(vw, wv)  # per own force
    own = inverse_3x3(chosen(ww, vv) + chosen(wv, vw) @ reaction) @ direction
    held = reaction @ own
    return ca.dot(direction, own), ca.vertcat(chosen(held, own), chosen(own, held))


def stiffness_block(compliance: ca.SX, kind: Kind, boundary: Boundary) -> ca.SX:
    """Return the 3x3 stiffness of translation or rotation, the other free or held ("clamped")."""
    vv, vw = compliance[:3, :3], compliance[:3, 3:]
    wv, ww = compliance[3:, :3], compliance[3:, 3:]
    if kind == "rotation":
        vv, vw, wv, ww = ww, wv, vw, vv
    if boundary == "clamped":
        vv = vv - vw @ inverse_3x3(ww) @ wv  # (C^-1)_vv by its Schur complement
    return inverse_3x3(vv)


def inverse_3x3(matrix: ca.SX | ca.MX) -> ca.SX | ca.MX:
    """Return the inverse by cofactors, which CasADi has only for SX."""
    if isinstance(matrix, ca.MX):
        A = ca.SX.sym("A", 3, 3)
        return ca.Function("inverse", [A], [ca.inv_minor(A)])(matrix)
    return ca.inv_minor(matrix)
