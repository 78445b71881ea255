"""The rod's equations as small symbolic functions, for the integrator in C.

`stiffopt.model.shooting` writes out whole chains of integration steps, which takes a compiler a
minute.  Here the equations at one point of the rod are separate functions, one set for each kind
of section; ``rod.h`` loops over the steps and propagates derivatives along them.

Orientation and moment are y = (q, m) (7,), padded to eight rows; position, which does not feed
back, and a zero are four more.  Functions of kind k:

* ``slope{k}``: (y, n, f, a) to (y', r') (12,);
* ``newton{k}``: (y, n, f, a) to y' (8,) and its derivatives by y (8, 7) and n (8, 3);
* ``linear{k}``: (y, n, f, a, da) to (y', r') (12,) and their derivatives by y (12, 7), n (12, 3)
  and the section's pressures (12, c);
* ``adjoint{k}``: (y, n, f, a, da, dy, dn, l, dl) to the derivatives of ``l'y' + dl'(y', r')_dot``
  by y (8,), n (3,), pressures (c,) and dy (8,), dn (3,), the dot along (dy, dn).

`a` holds the nonzero entries of the section's strain, compliance and centroid; `da` is its
derivative by the section's own pressures.
"""

from collections.abc import Hashable
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np

from stiffopt import lie
from stiffopt.model.codegen import function_of
from stiffopt.model.description import RobotDescription
from stiffopt.model.layout import Layout, symbolic_arm
from stiffopt.model.shooting import mass_per_length, pieces_of, slopes

MOST_KINDS = 4
"""Largest number of kinds of sections in the integrator in C; mirrors ``rod.h``."""


class RodPiece(NamedTuple):
    """A piece of the arm; mirrors ``rod.h``, which documents it."""

    kind: int
    parts: int
    slopes: int
    channel: int
    channels: int
    steps: int
    length: float
    mass: float


class _SectionPlace(NamedTuple):
    """Kind of a segment's section, and where it begins in a, in da and in p."""

    kind: int
    parts: int
    slopes: int
    channel: int
    channels: int


class RodFunctions(NamedTuple):
    """Functions of a layout for the integrator, and the place of each segment's section."""

    functions: list[ca.Function]
    places: list[_SectionPlace]
    parts: int
    slopes: int


@lru_cache(maxsize=64)
def rod_functions(layout: Layout) -> RodFunctions | None:
    """Return the equations of the arms of a layout; None if it has more than `MOST_KINDS` sections.

    The arm's numbers follow the pressures in the functions' inputs.
    """
    arm = symbolic_arm(layout)
    kinds: dict[Hashable, int] = {}
    functions: list[ca.Function] = []
    places: list[_SectionPlace] = []
    parts, derivatives = [], []
    n_parts = n_slopes = start = 0
    segments = layout.example.segments
    for segment, section, at in zip(segments, arm.actuation.sections, arm.centroids, strict=True):
        own = arm.actuation.pressures[start : start + segment.n_channels]
        patterns = [ca.sparsify(part) for part in (section.strain, section.compliance, at)]
        a = ca.vertcat(*(value for part in patterns for value in part.nonzeros()))
        shapes = [(tuple(part.sparsity().row()), tuple(part.sparsity().colind()))
                  for part in patterns]  # fmt: skip
        key = (*shapes, segment.n_channels)
        if key not in kinds:
            if len(kinds) == MOST_KINDS:
                return None
            kinds[key] = len(kinds)
            sparsities = [part.sparsity() for part in patterns]
            functions += _kind(kinds[key], sparsities, segment.n_channels)
        places.append(_SectionPlace(kinds[key], n_parts, n_slopes, start, segment.n_channels))
        parts.append(a)
        derivatives.append(ca.vec(ca.densify(ca.jacobian(a, own))))
        n_parts += a.numel()
        n_slopes += a.numel() * segment.n_channels
        start += segment.n_channels
    inputs = [arm.actuation.pressures, arm.numbers]
    sections = function_of("sections", inputs, [ca.vertcat(*parts), ca.vertcat(*derivatives)])
    least = function_of("margin", inputs, [ca.mmin(arm.actuation.margin)])
    return RodFunctions([sections, least, *functions, *_ends()], places, n_parts, n_slopes)


def rod_pieces(
    description: RobotDescription, resolution: int, functions: RodFunctions
) -> list[RodPiece]:
    """Return the pieces of an arm from its tip to its base."""
    pieces = []
    for piece in pieces_of(description, resolution):
        if piece.rigid:
            pieces.append(RodPiece(-1, 0, 0, 0, 0, 0, piece.length, 0.0))
            continue
        step = piece.length / piece.steps
        mass = mass_per_length(description.segments[piece.segment])
        pieces.append(RodPiece(*functions.places[piece.segment], piece.steps, step, mass))
    return pieces


def _kind(kind: int, patterns: list[ca.Sparsity], channels: int) -> list[ca.Function]:
    """Return the functions of a kind of section: of a sparsity of strain, compliance, centroid."""
    y, n, f = ca.SX.sym("y", 7), ca.SX.sym("n", 3), ca.SX.sym("f", 3)
    ends = np.cumsum([0, *(pattern.nnz() for pattern in patterns)])
    a, da = ca.SX.sym("a", ends[-1]), ca.SX.sym("da", ends[-1], channels)
    strain, compliance, centroid = (
        ca.SX(pattern, a[int(start) : int(end)])
        for pattern, (start, end) in zip(patterns, pairwise(ends), strict=True)
    )
    turning, tangent, moment = slopes(y[:4], y[4:], n, f, strain, compliance, centroid)
    none = ca.SX.zeros(1)
    short = ca.vertcat(turning, moment, none)
    long = ca.vertcat(short, tangent, none)
    newton = [short, ca.jacobian(short, y), ca.jacobian(short, n)]
    linear = [long, ca.jacobian(long, y), ca.jacobian(long, n), ca.jacobian(long, a) @ da]
    dy, dn, lam, dlam = (
        ca.SX.sym("dy", 7), ca.SX.sym("dn", 3), ca.SX.sym("l", 8), ca.SX.sym("dl", 12)
    )  # fmt: skip
    dot = ca.jtimes(long, y, dy) + ca.jtimes(long, n, dn)
    h = ca.dot(lam, short) + ca.dot(dlam, dot)
    by_y, by_n, by_a, by_dy, by_dn = (ca.gradient(h, x) for x in (y, n, a, dy, dn))
    adjoint = [ca.vertcat(by_y, none), by_n, da.T @ by_a, ca.vertcat(by_dy, none), by_dn]
    return [
        function_of(f"slope{kind}", [y, n, f, a], [long]),
        function_of(f"newton{kind}", [y, n, f, a], newton),
        function_of(f"linear{kind}", [y, n, f, a, da], linear),
        function_of(f"adjoint{kind}", [y, n, f, a, da, dy, dn, lam, dlam], adjoint),
    ]


def _ends() -> list[ca.Function]:
    """Return the functions of the loaded tip and of rigid connectors.

    * ``tip``: (q, load, weight) to y (8,), n (3,), their derivatives by a turn of the tip (8, 3)
      and (3, 3), and the rotation (3, 3);
    * ``tip_adjoint``: (q, load, turn, wrench, l, ln, dl, dln, left) to the derivative by a turn
      of the tip (3,) of ``l'y + ln'n + dl'y_dot + dln'n_dot + left'(0, R turn)``, the dot along
      the turn (in body axes) and the added wrench;
    * ``rigid``: (y, n, length) to the increments of (y, r) (12,), and derivatives (12, 7), (12, 3);
    * ``rigid_adjoint``: (y, n, length, dy, dn, l, dl) to derivatives as in ``adjoint``.
    """
    q, load, weight, delta = (ca.SX.sym("x", size) for size in (4, 12, 3, 3))
    turned = lie.quaternion_product(q, ca.vertcat(1, delta / 2))
    turned = turned / ca.norm_2(turned)
    R = lie.rotation_from_quaternion(turned)
    n = load[:3] + R @ load[6:9] + weight
    y = ca.vertcat(turned, load[3:6] + R @ load[9:], 0)
    here = [ca.SX.zeros(3)]

    def at_rest(*values: ca.SX) -> list[ca.SX]:
        return list(ca.substitute(list(values), [delta], here))

    tip = function_of(
        "tip", [q, load, weight],
        at_rest(y, n, ca.jacobian(y, delta), ca.jacobian(n, delta), R),
    )  # fmt: skip
    turn, wrench, lam, lam_n, dlam, dlam_n, left = (
        ca.SX.sym("x", size) for size in (3, 6, 8, 3, 8, 3, 6)
    )
    q_dot = lie.quaternion_product(turned, ca.vertcat(0, turn / 2))
    q0 = ca.SX.sym("q0", 4)
    R0 = lie.rotation_from_quaternion(q0)
    follower = ca.vertcat(R0 @ load[6:9], R0 @ load[9:])
    (follower_dot,) = ca.substitute([ca.jacobian(follower, q0)], [q0], [turned])
    change = follower_dot @ q_dot + wrench
    total = (
        ca.dot(lam, y) + ca.dot(lam_n, n) + ca.dot(dlam, ca.vertcat(q_dot, change[3:], 0))
        + ca.dot(dlam_n, change[:3]) + ca.dot(left[3:], R @ turn)
    )  # fmt: skip
    tip_adjoint = function_of(
        "tip_adjoint", [q, load, turn, wrench, lam, lam_n, dlam, dlam_n, left],
        at_rest(ca.gradient(total, delta)),
    )  # fmt: skip

    y, n, length = ca.SX.sym("y", 7), ca.SX.sym("n", 3), ca.SX.sym("L")
    reach = length * lie.rotation_from_quaternion(y[:4])[:, 2]
    gain = ca.vertcat(ca.SX.zeros(4), ca.cross(reach, n), 0, reach, 0)
    rigid = function_of("rigid", [y, n, length], [gain, ca.jacobian(gain, y), ca.jacobian(gain, n)])
    dy, dn, lam, dlam = (ca.SX.sym("x", size) for size in (7, 3, 8, 12))
    dot = ca.jtimes(gain, y, dy) + ca.jtimes(gain, n, dn)
    h = ca.dot(lam, gain[:8]) + ca.dot(dlam, dot)
    by_y, by_n, by_dy, by_dn = (ca.gradient(h, x) for x in (y, n, dy, dn))
    rigid_adjoint = function_of(
        "rigid_adjoint", [y, n, length, dy, dn, lam, dlam],
        [ca.vertcat(by_y, 0), by_n, ca.vertcat(by_dy, 0), by_dn],
    )  # fmt: skip
    return [tip, tip_adjoint, rigid, rigid_adjoint]
