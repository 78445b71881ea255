"""Integration steps of a rod with their derivatives, for meshes whose nodes move.

Contacts move along the arm, so the steps between them keep changing their lengths.  The classical
Runge-Kutta method of order four is sufficient: with steps of
`STEP_LENGTH` outer radii the tip is within some micrometres of that of `stiffopt.model.shooting`.
"""

from functools import partial

import casadi as ca

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.model.batch import BatchFunction, InterpretedFunction
from stiffopt.model.codegen import dense
from stiffopt.model.compiled import Library, library
from stiffopt.model.compiler import NATIVE
from stiffopt.model.contact.surface import surface_functions
from stiffopt.model.obstacles import OBSTACLES
from stiffopt.model.shooting import slopes

STEP_LENGTH = 1.5
"""Longest step, in outer radii of the segment at rest."""

_NAME = "contact_step"
_SOURCES = (str(NATIVE / "contact.c"),)
_LOOKED_FOR_AGAIN = 64  # calls between looks at the cache, while machine code is being made
_STAGES = ((0.0, 1 / 6), (0.5, 1 / 3), (0.5, 1 / 3), (1.0, 1 / 6))  # share of the step, weight


class StepFunction:
    """The integration step for the sections of one arm, in machine code once there is any.

    Parameters
    ----------
    sparsity : of a section's compliance (6, 6).
    weighted : whether the arm has a weight.
    eccentric : whether a centroid lies off the axis.
    """

    def __init__(self, sparsity: ca.Sparsity, weighted: bool, eccentric: bool) -> None:
        self._key = (tuple(sparsity.row()), tuple(sparsity.colind()), weighted, eccentric)
        self._code: Library | None = None
        self._interpreted: BatchFunction | None = None
        self._calls = 0

    @property
    def code(self) -> Library | None:
        """Machine code of the step, of all surfaces and of native/contact.c; None without it."""
        if self._code is None and self._calls % _LOOKED_FOR_AGAIN == 0:
            self._code = library(
                ("contacts of a rod", *self._key), partial(contact_functions, *self._key), _SOURCES
            )
        self._calls += 1
        return self._code

    def __call__(self, *arguments: Array) -> list[Array]:
        """Take many steps; the arguments are those of `step_function`, with a leading axis."""
        if self.code is not None:
            return self.code.function(_NAME).many(*arguments, threads=1)
        if self._interpreted is None:
            self._interpreted = InterpretedFunction(dense(contact_functions(*self._key)[0]))
        return self._interpreted.many(*arguments)


def contact_functions(
    rows: tuple[int, ...], starts: tuple[int, ...], weighted: bool, eccentric: bool
) -> list[ca.Function]:
    """Return the step of some sections, and the surfaces of all kinds of objects with a formula."""
    step = step_function(ca.Sparsity(6, 6, starts, rows), weighted, eccentric)
    kinds = [kind for kind in OBSTACLES.values() if not kind.is_interpolated]
    return [step, *(each for kind in kinds for each in surface_functions(kind))]


def step_function(sparsity: ca.Sparsity, weighted: bool, eccentric: bool) -> ca.Function:
    """Return one integration step towards the base.

    It maps quaternion (4,), moment (3,) and force (3,) that the distal part exerts, in base axes,
    the section's strain (6,), compliance (6, 6) and centroid (2,), weight per length (3,) and the
    step's length to

    * the quaternion, the displacement (3,) and the moment at the end, (10,); * the tangents (3, 2)
    of the centre line at start and end, per length at rest; * changes (9, 10) of turn, displacement
    and moment at the end, along turn, moment and force at the
      start and the length; turns are rotation vectors in base axes.
    """
    q, m, n = ca.SX.sym("q", 4), ca.SX.sym("m", 3), ca.SX.sym("n", 3)
    strain, C = ca.SX.sym("strain", 6), ca.SX.sym("C", 6, 6)
    centroid, f, h = ca.SX.sym("c", 2), ca.SX.sym("f", 3), ca.SX.sym("h")
    kept = ca.project(C, sparsity)
    weight = f if weighted else ca.SX(3, 1)
    offset = centroid if weighted and eccentric else ca.SX(2, 1)

    def derivative(state: ca.SX, tau: ca.SX | float) -> ca.SX:
        turning, tangent, moment = slopes(
            state[:4], state[7:], n + weight * tau, weight, strain, kept, offset
        )
        return ca.vertcat(turning, -tangent, moment)

    start = ca.vertcat(q, ca.SX.zeros(3), m)
    end, slope = start, ca.SX.zeros(10)
    first = None
    for share, by in _STAGES:
        slope = derivative(start + share * h * slope, share * h)
        first = slope if first is None else first
        end = end + by * h * slope
    assert first is not None

    # without weight, turning everything at the start turns everything at the end
    turns = 3 if weighted else 0
    zero = partial(ca.SX.zeros)
    units = ca.SX.eye(3)
    per_turn = [_turned(units[:, k], q) for k in range(turns)]
    seeds = ca.vertcat(
        ca.horzcat(zero(4, 6), *per_turn, zero(4, 1)),
        ca.horzcat(units, zero(3, 4 + turns)),
        ca.horzcat(zero(3, 3), units, zero(3, 1 + turns)),
        ca.horzcat(zero(1, 6 + turns), 1),
    )
    found = ca.jtimes(end, ca.vertcat(q, m, n, h), seeds)
    last = derivative(end, h)
    back = ca.vertcat(end[0], -end[1:4])
    rotated = [2 * lie.quaternion_product(found[:4, k], back)[1:] for k in range(found.shape[1])]
    found = ca.vertcat(ca.horzcat(*rotated), found[4:, :])
    per_moment, per_force = found[:, :3], found[:, 3:6]
    if weighted:
        by_turn = found[:, 6:9]
    else:
        by_turn = ca.vertcat(units, -lie.hat(end[4:7]), -lie.hat(end[7:]))
        by_turn += per_moment @ lie.hat(m) + per_force @ lie.hat(n)
    changes = ca.horzcat(by_turn, per_moment, per_force, found[:, -1])
    tangents = ca.horzcat(-first[4:7], -last[4:7])
    outputs = ca.cse([ca.densify(each) for each in (end, tangents, changes)])
    return ca.Function(_NAME, [q, m, n, strain, C, centroid, f, h], outputs)


def _turned(turn: ca.SX, q: ca.SX) -> ca.SX:
    """Return the change of a quaternion by a rotation vector in base axes."""
    return lie.quaternion_product(ca.vertcat(0, turn / 2), q)
