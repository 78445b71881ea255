"""Newton's method for the shooting problem, with the states on the way as unknowns too.

Integrating a long hanging arm from its tip magnifies the smallest turn there by many orders, and
plain shooting then converges from next door only.  So the states after every step (orientation
and moment) are unknowns of their own, and each step's defect (its end less the state meant to be
there) is driven to zero together with the turn of the base: multiple shooting.  The linear
system is solved at the cost of single shooting by carrying the changes per turn of the tip and
the defects along (the lifted Newton method, J. Albersmeyer and M. Diehl, SIAM J. Optim. 20, 2010).
"""

import casadi as ca

from stiffopt import lie
from stiffopt.model.compliance import inverse_3x3
from stiffopt.model.shooting import SAME_STATION, Shooting

_CARRIED = 4  # changes carried along: three turns of the tip, and the defects


class _Carried:
    """A value with its changes (k, 4) along the carried directions."""

    def __init__(self, value: ca.MX, changes: ca.MX) -> None:
        self.value = value
        self.changes = changes

    def __add__(self, other: "_Carried | ca.MX") -> "_Carried":
        if isinstance(other, _Carried):
            return _Carried(self.value + other.value, self.changes + other.changes)
        return _Carried(self.value + other, self.changes)


def _constant(value: ca.MX) -> _Carried:
    return _Carried(value, ca.MX.zeros(value.size1(), _CARRIED))


def _apply(function: ca.Function, *arguments: _Carried) -> list[_Carried]:
    """Outputs of a function with their changes, by forward differentiation."""
    values = [argument.value for argument in arguments]
    outputs = function.call(values)
    seeds = [argument.changes for argument in arguments]
    changes = function.forward(_CARRIED).call([*values, *outputs, *seeds])
    return [_Carried(value, change) for value, change in zip(outputs, changes, strict=True)]


def _applied_wrench() -> ca.Function:
    """Force and moment in base axes of a dead and a follower wrench (12,) at orientation q."""
    q, load = ca.SX.sym("q", 4), ca.SX.sym("load", 12)
    R = lie.rotation_from_quaternion(q)
    force, moment = load[:3] + R @ load[6:9], load[3:6] + R @ load[9:]
    return ca.Function("applied", [q, load], [force, moment])


def _rigid_step() -> ca.Function:
    """Moment added by a rigid connector of a length at orientation q under a force."""
    q, force, length = ca.SX.sym("q", 4), ca.SX.sym("n", 3), ca.SX.sym("c")
    axis = lie.rotation_from_quaternion(q)[:, 2]
    return ca.Function("rigid", [q, force, length], [length * ca.cross(axis, force)])


def newton_step(shooting: Shooting, at: float | None = None) -> ca.Function:
    """One step of the lifted Newton method, with the load's station at `at` (None: the tip).

    Maps (tip quaternion (4,), states (7, k), pressures, gravity, tip load, station load) to
    (quaternion, states, largest turn of the tip or a state in rad).
    """
    pieces = shooting.pieces([] if at is None else [at])
    count = sum(piece.steps for piece in pieces if not piece.rigid)
    q, states = ca.MX.sym("q", 4), ca.MX.sym("states", 7, count)
    p, gravity = ca.MX.sym("p", shooting.n_variables), ca.MX.sym("g", 3)
    tip, station = ca.MX.sym("tip", 12), ca.MX.sym("station", 12)
    sections = shooting.sections.call([p])
    applied, rigid = _applied_wrench(), _rigid_step()
    steps = [_lifted_step(step) for step in shooting.step]

    per_turn = [lie.quaternion_product(q, ca.DM([0, *row])) / 2 for row in ca.DM.eye(3).full()]
    orientation = _Carried(q, ca.horzcat(*per_turn, ca.MX.zeros(4)))
    force, moment = _apply(applied, orientation, _constant(tip))
    force = force + shooting.description.tip_mass * gravity
    length = shooting.description.length
    met: list[ca.MX] = []  # changes of the states after each step
    for piece in pieces:
        if abs(piece.distal - (length if at is None else at)) <= SAME_STATION * length:
            added_force, added_moment = _apply(applied, orientation, _constant(station))
            force, moment = force + added_force, moment + added_moment
        if piece.rigid:
            (added,) = _apply(rigid, orientation, force, _constant(ca.MX(piece.length)))
            moment = moment + added
            continue
        strain, compliance = sections[2 * piece.segment : 2 * piece.segment + 2]
        weight = shooting.weight(piece.segment) * gravity
        h = piece.length / piece.steps
        for _ in range(piece.steps):
            lifted = states[:, len(met)]
            changes = steps[piece.segment](
                orientation.value, orientation.changes, moment.value, moment.changes,
                force.value, force.changes, strain, compliance, weight, h, lifted,
            )  # fmt: skip
            orientation = _Carried(lifted[:4], changes[:4, :])
            moment = _Carried(lifted[4:], changes[4:, :])
            force = force + h * weight
            met.append(changes)
    base = orientation.changes[1:, :]
    turn = -inverse_3x3(base[:, :3]) @ (orientation.value[1:] + base[:, 3])
    moves = [changes @ ca.vertcat(turn, 1) for changes in met]
    turned = lie.quaternion_product(q, ca.vertcat(1, turn / 2))
    largest = ca.norm_2(turn)
    for move in moves:
        largest = ca.fmax(largest, 2 * ca.norm_2(move[:4]))
    return ca.Function(
        "newton",
        [q, states, p, gravity, tip, station],
        [turned / ca.norm_2(turned), states + ca.horzcat(*moves), largest],
    )


def _lifted_step(step: ca.Function) -> ca.Function:
    """Integration step with changes carried along and the lifted state in place of its end.

    Maps orientation, moment and force, each followed by its changes, the section (strain,
    compliance), weight, length and lifted state (7,) to the changes of the latter: those of the
    step's end, the defect added to the last of them.
    """
    q, m, n = ca.SX.sym("q", 4), ca.SX.sym("m", 3), ca.SX.sym("n", 3)
    dq, dm, dn = (ca.SX.sym("d", size, _CARRIED) for size in (4, 3, 3))
    strain, C = ca.SX.sym("strain", 6), ca.SX.sym("C", step.sparsity_in(2))
    f, h, lifted = ca.SX.sym("f", 3), ca.SX.sym("h"), ca.SX.sym("lifted", 7)
    end = step(ca.vertcat(q, ca.SX.zeros(3), m), strain, C, n, f, h)
    end = ca.vertcat(end[:4], end[7:])
    changes = ca.jtimes(end, ca.vertcat(q, m, n), ca.vertcat(dq, dm, dn))
    changes[:, 3] += end - lifted
    return ca.Function("lifted", [q, dq, m, dm, n, dn, strain, C, f, h, lifted], [changes])
