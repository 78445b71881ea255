"""Time stepping of the rod: one step, and many steps at given pressures.

With inertia, a variational integrator is used. The discrete Lagrangian of a step from q0 to q1 is

    L = 1/(2h) (X1 - X0)' m (X1 - X0) - h V(elastic; (q0 + q1)/2) - h/2 (U(q0) + U(q1))

where X are the positions and section axes of the nodes and U the potential of gravity. The momenta
are p0 = -dL/dq0 and p1 = dL/dq1; forces without a potential are split in the same way. The
integrator has no numerical damping. Elasticity and contact are implicit, gravity and loads are
explicit. Contact along the body is that of the step's end, which damps it
(`stiffopt.plant.contact`). Without inertia, backward Euler is used: stresses, viscosity included,
are in equilibrium with all loads at the end of the step.

Newton's method uses a tangent by finite differences, which is kept over many steps.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from stiffopt.plant.contact import (
    ContactForces,
    Surroundings,
    add_wrenches,
    no_forces,
    touch,
)
from stiffopt.plant.jit import jit
from stiffopt.plant.material import (
    FibreMemory,
    Scheme,
    SectionMaterial,
    internal_forces,
    remember,
)
from stiffopt.plant.rod import (
    DiscreteRod,
    RodLoads,
    add_contact,
    contact_force,
    depth_of,
    external_forces,
    jacobians,
    loads_after,
    poses,
)

Array = Any

_CLOSE = 1e-9  # strain, tolerance of a step
_SLOWEST = 0.3  # share of the last correction; if a correction is larger, renew the tangent
_ITERATIONS = 40
_LONGEST = 0.004  # s; with inertia, longer steps are divided, because weight is explicit
_SHORTEST = 1 / 64  # share of a step; a step that fails is divided down to this
NUDGE = 1e-7  # strain, for the finite differences
_STRIDE = 0.3  # strain, bound of one iteration
_REACH = 0.015  # m; converts curvatures to strains


class RodState(NamedTuple):
    """The rod's state, which changes with time. n coefficients, N nodes."""

    # q, momentum: (n,)
    q: Array
    momentum: Array
    # rate, last_rate: of q during the last two steps (n,), 1/s; the next step's guess extrapolates
    # them
    rate: Array
    last_rate: Array
    # rotations, positions: of the nodes (N, 3, 3), (N, 3), always consistent with q
    rotations: Array
    positions: Array
    inverse: Array  # of the tangent (n, n)
    tangent_of: Array  # step and kind of equations of the tangent (2,); 0 if there is none
    # energy dissipated, work of the pressures, and of loads and the plate, so far, and the present
    # energy in the contact along the body (4,), J
    totals: Array
    memory: FibreMemory  # of the fibres
    # stretch of the contact's springs across the normals, see `ContactForces` (k, P, 3), m
    grip: Array


@jit
def _inertia(
    rod: DiscreteRod, J: Array, R: Array, R0: Array, r0: Array, R1: Array, r1: Array, out: Array
) -> None:
    """Set ``J' m (X1 - X0)`` (n,), with Jacobians J and axes R of one of the two ends."""
    out[:] = 0.0
    d = np.empty((3, 3))  # of position, x axis, y axis
    f = np.empty((3, 3))
    wrench = np.empty(6)
    for node in range(1, len(r0)):
        for i in range(3):
            d[0, i] = r1[node, i] - r0[node, i]
            d[1, i] = R1[node, i, 0] - R0[node, i, 0]
            d[2, i] = R1[node, i, 1] - R0[node, i, 1]
        for a in range(3):
            for i in range(3):
                total = 0.0
                for b in range(3):
                    total += rod.mass[node, a, b] * (
                        d[b, 0] * R[node, 0, i] + d[b, 1] * R[node, 1, i] + d[b, 2] * R[node, 2, i]
                    )
                f[a, i] = total
        for i in range(3):
            wrench[i] = f[0, i]
        wrench[3] = f[2, 2]  # x cross f1 + y cross f2
        wrench[4] = -f[1, 2]
        wrench[5] = f[1, 1] - f[2, 0]
        for k in range(len(out)):
            total = 0.0
            for i in range(6):
                total += J[node, k, i] * wrench[i]
            out[k] += total


@jit
def _invert(A: Array, out: Array) -> bool:
    """Invert a matrix by elimination with pivoting; destroys A. Return False if it is singular."""
    n = len(A)
    out[:] = 0.0
    for i in range(n):
        out[i, i] = 1.0
    for c in range(n):
        pivot = c
        for i in range(c + 1, n):
            if abs(A[i, c]) > abs(A[pivot, c]):
                pivot = i
        if not abs(A[pivot, c]) > 0:
            return False
        if pivot != c:
            for j in range(n):
                A[c, j], A[pivot, j] = A[pivot, j], A[c, j]
                out[c, j], out[pivot, j] = out[pivot, j], out[c, j]
        scale = 1 / A[c, c]
        for j in range(n):
            A[c, j] *= scale
            out[c, j] *= scale
        for i in range(n):
            factor = A[i, c]
            if i != c and factor != 0:
                for j in range(n):
                    A[i, j] -= factor * A[c, j]
                    out[i, j] -= factor * out[c, j]
    return True


class Step(NamedTuple):
    """Everything that determines one step, except the state at its beginning."""

    # rod, around, material, scheme: see there
    rod: DiscreteRod
    around: Surroundings
    material: SectionMaterial
    scheme: Scheme
    loads: RodLoads  # at the end of the step
    inertia: bool  # whether the arm has inertia
    pressures: Array  # in the chambers, constant (n,), Pa


class StepBuffers(NamedTuple):
    """Buffers of a step: Jacobians, poses and forces. Made once per call.

    `touch` belongs to the plate, `body` to the objects along the body.
    """

    jacobian: Array
    rotations: Array
    positions: Array
    inner: Array
    outer: Array
    trial: Array
    residual: Array
    nudged: Array
    tangent: Array
    guess: Array
    touch: Array
    body: Array
    contact: ContactForces


@jit
def residual(step: Step, state: RodState, work: StepBuffers, q: Array, out: Array) -> None:
    """Set the imbalance (n,) of a step that ends at q, in N m or the like."""
    rod, loads, h = step.rod, step.loads, step.scheme.step
    last = len(state.positions) - 1
    poses(rod, q, work.rotations, work.positions)
    internal_forces(
        rod, step.material, step.scheme, state.memory, step.pressures, state.q, q, work.inner
    )
    depth = depth_of(loads, work.positions[last])
    meets = len(step.around.kind) > 0
    if meets:
        touch(
            step.around,
            work.rotations,
            work.positions,
            state.rotations,
            state.positions,
            state.grip,
            step.scheme.history,
            work.contact,
        )
    if step.inertia:  # work.jacobian and work.outer are those of the step's beginning
        _inertia(
            rod,
            work.jacobian,
            state.rotations,
            state.rotations,
            state.positions,
            work.rotations,
            work.positions,
            out,
        )
        work.touch[:] = 0.0
        mean = 0.5 * (depth + depth_of(loads, state.positions[last]) - h * loads.plate_speed)
        add_contact(loads, mean, state.rotations[last], work.jacobian[last], work.touch)
        for k in range(len(q)):
            out[k] = (out[k] / h - state.momentum[k]) * 2 / h + work.inner[k] - work.outer[k]
            out[k] -= work.touch[k]
    else:
        jacobians(rod, q, work.jacobian)
        external_forces(rod, loads, work.rotations, work.positions, work.jacobian, work.outer)
        add_contact(loads, depth, work.rotations[last], work.jacobian[last], work.outer)
        for k in range(len(q)):
            out[k] = work.inner[k] - work.outer[k]
    if meets:
        axes = state.rotations if step.inertia else work.rotations
        add_wrenches(work.contact, axes, work.jacobian, work.body)
        out -= work.body


@jit
def in_strain(rod: DiscreteRod, k: int) -> float:
    """Return the strain that a unit of a coefficient amounts to."""
    return _REACH if k % rod.per_segment >= rod.first[3] else 1.0


@jit
def _correction(rod: DiscreteRod, state: RodState, work: StepBuffers) -> float:
    """Set work.trial to Newton's correction (n,); return its largest element, as a strain."""
    largest = 0.0
    for i in range(len(work.trial)):
        total = 0.0
        for k in range(len(work.trial)):
            total -= state.inverse[i, k] * work.residual[k]
        work.trial[i] = total
        largest = max(largest, abs(total) * in_strain(rod, i))
        if np.isnan(total):
            return np.nan
    return largest


@jit
def _make_tangent(step: Step, state: RodState, work: StepBuffers, q: Array) -> bool:
    """Set the state's inverse of the tangent (n, n) at q; return whether it exists."""
    n = len(q)
    for k in range(n):
        nudge = NUDGE / in_strain(step.rod, k)
        kept = q[k]
        q[k] = kept + nudge
        residual(step, state, work, q, work.nudged)
        q[k] = kept
        for i in range(n):
            work.tangent[i, k] = (work.nudged[i] - work.residual[i]) / nudge
    return _invert(work.tangent, state.inverse)


@jit
def _solve(step: Step, state: RodState, work: StepBuffers, q: Array) -> bool:
    """Iterate q (n,), first a guess, to the end of a step; return whether that succeeded.

    Afterwards, the results of `residual` in `work` belong to q.
    """
    n = len(q)
    h = step.scheme.step
    kind = (2.0 if step.inertia else 1.0) + (4.0 if step.scheme.history else 0.0)
    before = np.inf
    for iteration in range(_ITERATIONS):
        residual(step, state, work, q, work.residual)
        known = state.tangent_of[0] == h and state.tangent_of[1] == kind
        largest = _correction(step.rod, state, work) if known else np.inf
        # An old tangent may no longer do; NaN leads here too.
        if not known or not largest <= _SLOWEST * before:
            if not _make_tangent(step, state, work, q):
                return False
            residual(step, state, work, q, work.residual)
            state.tangent_of[0] = h
            state.tangent_of[1] = kind
            largest = _correction(step.rod, state, work)
            if not np.isfinite(largest):
                state.tangent_of[0] = 0.0
                return False
        if largest < _CLOSE and iteration > 0:  # guesses without a correction would drift
            return True
        scale = min(1.0, _STRIDE / max(largest, _CLOSE))
        for i in range(n):
            q[i] += scale * work.trial[i]
        before = largest
    state.tangent_of[0] = 0.0
    return False


@jit
def make_work(n: int, nodes: int, around: Surroundings) -> StepBuffers:
    """Return the buffers of a step."""
    return StepBuffers(
        np.empty((nodes, n, 6)),
        np.empty((nodes, 3, 3)),
        np.empty((nodes, 3)),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty((n, n)),
        np.empty(n),
        np.empty(n),
        np.zeros(n),
        no_forces(around),
    )


@jit
def take(step: Step, before: RodLoads, state: RodState, work: StepBuffers) -> bool:
    """Take one step; return whether that succeeded.

    `before` are the loads at its beginning, `step.loads` those at its end. With inertia, `work`
    must hold the Jacobians and external forces of the beginning; it then holds those of the end.
    """
    rod, end, h = step.rod, step.loads, step.scheme.step
    n, q = len(state.q), work.guess
    for k in range(n):
        q[k] = state.q[k] + h * (2 * state.rate[k] - state.last_rate[k])
    if not _solve(step, state, work, q):
        q[:] = state.q  # the guess may have been misleading
        if not _solve(step, state, work, q):
            return False
    last = len(state.positions) - 1
    mean = 0.5 * (depth_of(end, work.positions[last]) + depth_of(before, state.positions[last]))
    if not step.inertia:
        mean = depth_of(end, work.positions[last])
    done = contact_force(end, mean) * end.plate_speed * h
    for i in range(3):
        force = end.force[i]
        if end.follows:
            force = 0.0
            for j in range(3):
                turn = state.rotations[end.node, i, j] + work.rotations[end.node, i, j]
                force += 0.5 * turn * end.force[j]
        moved = work.positions[end.node, i] - state.positions[end.node, i]
        turned = work.rotations[end.node, i, 2] - state.rotations[end.node, i, 2]
        done += force * (moved + end.lever * turned)
    meets = len(step.around.kind) > 0
    if meets:
        for k in range(n):
            state.totals[0] -= 0.5 * work.body[k] * (q[k] - state.q[k])
    if step.inertia:
        jacobians(rod, q, work.jacobian)
        _inertia(
            rod,
            work.jacobian,
            work.rotations,
            state.rotations,
            state.positions,
            work.rotations,
            work.positions,
            work.residual,
        )
        external_forces(rod, end, work.rotations, work.positions, work.jacobian, work.outer)
        work.touch[:] = 0.0
        add_contact(end, mean, work.rotations[last], work.jacobian[last], work.touch)
        if meets:
            add_wrenches(work.contact, work.rotations, work.jacobian, work.body)
        for k in range(n):
            force = work.inner[k] - work.outer[k] - work.touch[k] - work.body[k]
            state.momentum[k] = work.residual[k] / h - 0.5 * h * force
    if meets:
        for k in range(n):
            state.totals[0] -= 0.5 * work.body[k] * (q[k] - state.q[k])
        state.totals[0] -= work.contact.energy[0] - state.totals[3]
        state.totals[3] = work.contact.energy[0]
        state.grip[:] = work.contact.grip
    lost, pushed = remember(
        rod, step.material, step.scheme, state.memory, step.pressures, state.q, q
    )
    state.totals[0] += lost
    state.totals[1] += pushed
    state.totals[2] += done
    for k in range(n):
        state.last_rate[k] = state.rate[k]
        state.rate[k] = (q[k] - state.q[k]) / h
    state.q[:] = q
    state.rotations[:] = work.rotations
    state.positions[:] = work.positions
    return True


@jit
def run(
    rod: DiscreteRod,
    around: Surroundings,
    material: SectionMaterial,
    scheme: Scheme,
    loads: RodLoads,
    inertia: bool,
    state: RodState,
    pressures: Array,
) -> int:
    """Take a step at each row of pressures (m, n), divided if it is too long.

    Return the number of successful steps.
    """
    work = make_work(len(state.q), len(state.positions), around)
    if inertia:
        jacobians(rod, state.q, work.jacobian)
        external_forces(rod, loads, state.rotations, state.positions, work.jacobian, work.outer)
    for i in range(len(pressures)):
        left = scheme.step
        h = min(left, _LONGEST) if inertia else left
        while left > 1e-9 * scheme.step:
            part = Scheme(min(h, left), scheme.share, scheme.history)
            end = loads_after(loads, part.step)
            step = Step(rod, around, material, part, end, inertia, pressures[i])
            if take(step, loads, state, work):
                left -= part.step
                loads = end
            elif h > _SHORTEST * scheme.step:
                h *= 0.5
            else:
                return i
    return len(pressures)
