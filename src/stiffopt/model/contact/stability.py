"""Stability of an arm in contact: whether its energy is at a minimum.

The steps of the rod serve as finite elements: from the changes of a step's end along turn, moment
and force at its start, the wrenches at both ends follow from the poses of both.  This gives a
stiffness matrix of the nodes' poses.  A contact adds the work of its force on the curvature of the
gap, less the gain from moving along the arm,

    -f (dc' H dc - (d slope)^2 / bend),

and rigid surfaces constrain the poses.  The arm is stable if the matrix is positive definite on the
remaining motions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.contact.rod import hat

if TYPE_CHECKING:
    from stiffopt.model.contact.system import LeaningArm


_RIGID = 1e-3  # compliance of rigid pieces, as a share of that of their segment
_FLATTEST = 1e-3  # 1/m, least second derivative of a gap along the arm


def is_stable(arm: LeaningArm) -> bool:
    """Return whether the energy is at a minimum; without a potential, whether nothing diverges."""
    touches = enumerate(arm.state.touches)
    sliding = [j for j, touch in touches if touch.normal_force > 0 and not touch.pinned]
    if any(arm.bend(j) < -_FLATTEST for j in sliding):
        return False  # the body enters the surface on both sides of the contact
    K = stiffness_left(arm)
    if arm.state.condition.is_conservative:
        try:
            np.linalg.cholesky((K + K.T) / 2)
        except np.linalg.LinAlgError:
            return False
        return True
    values = np.linalg.eigvals(K)
    return not (values.real <= -np.abs(values.imag)).any()


def stiffness_left(arm: LeaningArm) -> Array:
    """Return the stiffness (k, k) in N/m of the motions that contacts leave free.

    Turns are scaled by the arm's length.
    """
    problem, state, linear = arm.problem, arm.state, arm.shape
    count, length = len(linear.h), problem.rod.arm.length
    size = 6 * count
    K = np.zeros((size + 6, size + 6))
    responses = []
    for i in range(count):
        J = linear.J[i]
        by_wrench = J[:6, 3:9].copy()
        if linear.mesh.rigid[i]:
            R = linear.rotation[i]
            C = linear.sections.compliance[linear.mesh.segment[i]]
            turn = np.zeros((6, 6))
            turn[:3, :3] = R @ C[3:, 3:] @ R.T
            turn[3:, 3:] = R @ C[:3, :3] @ R.T
            by_wrench -= _RIGID * linear.h[i] * turn
        # in terms of both ends' turns and positions
        known = np.zeros((6, 12))
        known[:3, 6:9] = np.eye(3)
        known[3:, 9:] = np.eye(3)
        known[3:, 3:6] = -np.eye(3)
        known[:, :3] -= J[:6, :3]
        start = np.linalg.solve(by_wrench, known)  # moment and force at the start, (6, 12)
        end = J[6:, 3:9] @ start
        end[:, :3] += J[6:, :3]
        rows, columns = slice(6 * i, 6 * i + 6), slice(6 * i, 6 * i + 12)
        K[rows, columns] += start
        K[6 * i + 6 : 6 * i + 9, columns] -= end
        K[6 * i + 9 : 6 * i + 12, columns] -= start[3:]
        responses.append(start)
    K = K[:size, :size]
    # follower loads at the tip
    follower = state.condition.follower
    R0 = linear.rotation[0]
    K[:3, :3] += hat(R0 @ follower[3:])
    K[3:6, :3] += hat(R0 @ follower[:3])

    held = []
    for j, (touch, row) in enumerate(zip(state.touches, arm.rows, strict=True)):
        node, f = int(state.mesh.node[j]), touch.normal_force
        n, H = row.point.normal, row.point.curvature
        at = slice(6 * node + 3, 6 * node + 6)
        K[at, at] -= f * H
        gap = np.zeros(size)
        gap[at] = n
        softness = problem.surfaces[touch.surface].softness
        if softness > 0:
            K += np.outer(gap, gap) / softness
        else:
            held.append(gap)
        if not touch.pinned:
            slope = _slope_change(arm, j, responses)
            bend = max(arm.bend(j), _FLATTEST)
            K += f / bend * np.outer(slope, slope)
    scale = np.tile(np.r_[np.full(3, 1 / length), np.ones(3)], count)
    K = scale[:, None] * K * scale
    if held:
        A = np.array(held) * scale
        Q, _ = np.linalg.qr(A.T, mode="complete")
        free = Q[:, len(held) :]
        K = free.T @ K @ free
    return np.asarray(K)


def _slope_change(arm: LeaningArm, j: int, responses: list[Array]) -> Array:
    """Return the change of the gap's slope at a contact by the poses of the nodes."""
    state, linear = arm.state, arm.shape
    node = int(state.mesh.node[j])
    size = 6 * len(linear.h)
    touch, row = state.touches[j], arm.rows[j]
    here = arm.problem.rod.ranges[touch.range]
    n, H, mean = row.point.normal, row.point.curvature, row.mean
    found = np.zeros(size + 6)
    at = 6 * node
    found[at + 3 : at + 6] += H @ mean
    R = linear.rotation[node]
    if here.rigid:
        found[at : at + 3] -= n @ hat(R[:, 2])
        return found[:size]
    C = linear.sections.compliance[here.segment]
    own, crossed = R @ C[:3, :3] @ R.T, R @ C[:3, 3:] @ R.T
    force = linear.force_far[node] + touch.force / 2
    found[at : at + 3] += n @ (
        -hat(mean) + own @ hat(force) + crossed @ hat(linear.moment_far[node])
    )
    # by lengths: a step shorter than the contact, at a segment's end, would count too much
    h = linear.h[max(node - 1, 0) : node + 1]
    share, near = h[-1] / h.sum() if node else 0.5, responses[node]
    found[at : at + 12] += n @ (share * own @ near[3:] + crossed @ near[:3])
    if node > 0:  # the force on the distal side equals that at the start of the step before
        found[at - 6 : at + 6] += (1 - share) * n @ own @ responses[node - 1][3:]
    return found[:size]
