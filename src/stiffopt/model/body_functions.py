"""Small symbolic functions of an arm's body, for loops over stations in C or NumPy.

A piece is a soft segment or a rigid connector, counted from the base.  Its strain is constant, and
a connector has that of a straight line, so the same functions serve both.  Strains are the rows
(m,) of a strain that are not zero in the layout (`strain_rows`).  A pose (15,) is the position, the
axes by columns and the unit tangent of a station, in the base frame.

For arms without loads, with p the pressures (n,):

* ``frames``: (p, numbers) to the least margin of the strain laws and, a column for each piece,
  strains (m, k), starts (12, k) and radii (k,);
* ``moving_frames``: the same, and for each pressure the change of its piece's strain (m, n), the
  twist of everything beyond that piece, about the base and in its axes (6, n), and the
  change of the radius (n,);
* ``along``: (start, strain, s) to the pose at s from the start of a piece;
* ``moving_along``: the same, and the twist of that station in base axes per strain (6, m);
* ``gathering``: (p, numbers) to section compliances (36, k) and the sums of compliances before each
  piece (36, k), which are integrals about the base in its axes, see `stiffopt.model.body`;
* ``gathered``: (start, strain, section compliance, s) to that of the first s of a piece (6, 6).

For arms under loads, in addition to the functions of `stiffopt.model.rod`:

* ``radii``: (p, numbers) to radii (k,) and their changes (n,);
* ``between``: share of a step to the weights of its slopes (5,) and their derivatives, see `DENSE`;
* ``axes``: quaternion of any length to axes (9,) by columns, and the turn in base axes per change
  of the quaternion (3, 4).
"""

import casadi as ca
import numpy as np

from stiffopt import lie
from stiffopt.model.actuation import Section
from stiffopt.model.codegen import dense, function_of
from stiffopt.model.compliance import carry_compliance, segment_compliance
from stiffopt.model.kinematics import segment_jacobian, segment_pose
from stiffopt.model.layout import Layout, SymbolicArm, symbolic_arm
from stiffopt.model.shooting import LOBATTO


def _dense_output() -> np.ndarray:
    """Return coefficients (5, 6), constants first, of the integrals of Lagrange's polynomials."""
    rows = []
    for node in LOBATTO:
        others = np.array([other for other in LOBATTO if other != node])
        basis = np.polynomial.polynomial.polyfromroots(others) / np.prod(node - others)
        rows.append(np.polynomial.polynomial.polyint(basis))
    return np.array(rows)


DENSE = _dense_output()
"""The integrator's dense output: a state at the share x of a step of length h is
``y + h sum_i b_i(x) y'_i``, where row i holds the coefficients of ``b_i`` and the slopes are those
at the Lobatto points.  It is of order five: errors are tenths of a micrometre at most."""


def strain_rows(layout: Layout) -> list[int]:
    """Return the rows of a strain (6,) that are not zero in all segments of a layout."""
    found = {2}  # the row of a connector
    for section in symbolic_arm(layout).actuation.sections:
        found |= set(ca.sparsify(section.strain).sparsity().row())
    return sorted(found)


def free_body_functions(layout: Layout) -> list[ca.Function]:
    """Return the functions of the body of all free arms of a layout."""
    arm, rows = symbolic_arm(layout), strain_rows(layout)
    p, numbers = arm.tip.pressures, arm.numbers
    strains, starts = _pieces(arm, rows)
    radii, radius_slopes = _radii(arm)
    slopes = [
        ca.jacobian(piece.section.strain[rows], piece.pressures)
        for piece in arm.tip.pieces
        if piece.section is not None
    ]
    twists = lie.adjoint(arm.tip.transform) @ arm.tip.jacobian
    frames = [ca.mmin(arm.actuation.margin), strains, starts, radii]

    start, s = ca.SX.sym("start", 12), ca.SX.sym("s")
    strain = ca.SX.sym("strain", len(rows))
    whole = ca.SX(6, 1)
    whole[rows] = strain
    section = Section(whole, ca.SX.sym("C", 6, 6))
    T = _transform(start) @ segment_pose(section, s)
    R = T[:3, :3]
    tangent = R @ (whole[:3] / ca.norm_2(whole[:3]))
    pose = ca.vertcat(T[:3, 3], ca.vec(R), tangent)
    moves = ca.diagcat(R, R) @ segment_jacobian(section, s, strain)
    own = segment_compliance(section, s, segment_pose(section, s / 2))
    return [
        _function("frames", [p, numbers], frames),
        _function(
            "moving_frames", [p, numbers], [*frames, ca.horzcat(*slopes), twists, radius_slopes]
        ),
        _function("along", [start, strain, s], [pose]),
        _function("moving_along", [start, strain, s], [pose, moves]),
        _function("gathering", [p, numbers], _gathering(arm)),
        _function(
            "gathered", [start, strain, section.compliance, s], [carry_compliance(own, T)]
        ),
    ]  # fmt: skip


def free_moving_functions(layout: Layout) -> list[ca.Function]:
    """Return those that native/body.h uses."""
    names = ("frames", "moving_frames", "along", "moving_along")
    return [each for each in free_body_functions(layout) if each.name() in names]


def loaded_body_functions(layout: Layout) -> list[ca.Function]:
    """Return the functions of the body of all arms of a layout under loads."""
    arm = symbolic_arm(layout)
    x, q = ca.SX.sym("x"), ca.SX.sym("q", 4)
    weights = ca.vertcat(*(ca.polyval(ca.SX(row[::-1]), x) for row in DENSE))
    unit = q / ca.norm_2(q)
    R = lie.rotation_from_quaternion(unit)
    conjugate = ca.vertcat(unit[0], -unit[1:])
    units = ca.horzsplit(ca.SX.eye(4))
    changes = [lie.quaternion_product(conjugate, change)[1:] for change in units]
    return [
        _function("radii", [arm.tip.pressures, arm.numbers], list(_radii(arm))),
        _function("between", [x], [weights, ca.jacobian(weights, x)]),
        _function("axes", [q], [ca.vec(R), 2 * R @ ca.horzcat(*changes)]),
    ]


def _function(name: str, inputs: list[ca.SX], outputs: list[ca.SX]) -> ca.Function:
    return dense(function_of(name, inputs, outputs))


def _transform(start: ca.SX) -> ca.SX:
    return lie.transform(ca.reshape(start[3:], 3, 3), start[:3])


def _pieces(arm: SymbolicArm, rows: list[int]) -> tuple[ca.SX, ca.SX]:
    """Return strains (m, k) and starts (12, k) of the pieces."""
    straight = ca.SX([0, 0, 1, 0, 0, 0])
    strains, starts, T = [], [], ca.SX.eye(4)
    for piece in arm.tip.pieces:
        strain = straight if piece.section is None else piece.section.strain
        strains.append(strain[rows])
        starts.append(ca.vertcat(T[:3, 3], ca.vec(T[:3, :3])))
        T = T @ piece.motion
    return ca.horzcat(*strains), ca.horzcat(*starts)


def _radii(arm: SymbolicArm) -> tuple[ca.SX, ca.SX]:
    """Return the radius (k,) of each piece, and the change (n,) by each pressure of its own."""
    segment, radii, slopes = -1, [], []
    for piece in arm.tip.pieces:
        if piece.section is not None:
            segment += 1
            slopes.append(ca.jacobian(arm.actuation.radii[segment], piece.pressures).T)
        radii.append(arm.actuation.radii[segment])
    return ca.vertcat(*radii), ca.vertcat(*slopes)


def _gathering(arm: SymbolicArm) -> list[ca.SX]:
    """Return compliances of the sections, and sums of those before each piece (36, k)."""
    sections, before = [], []
    T, C = ca.SX.eye(4), ca.SX.zeros(6, 6)
    for piece in arm.tip.pieces:
        before.append(ca.vec(C))
        T = T @ piece.motion
        sections.append(ca.SX.zeros(36))
        if piece.section is not None:
            sections[-1] = ca.vec(ca.densify(piece.section.compliance))
            C += carry_compliance(segment_compliance(piece.section, piece.length, piece.half), T)
    return [ca.horzcat(*sections), ca.horzcat(*before)]
