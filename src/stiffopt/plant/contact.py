"""Contact of the rod's body with the objects of a scene: penalty springs, with friction.

The body is a tube of the outer radius about the centre line; it ends in a hemisphere at the tip.
Points on the centre line, a twentieth of the radius apart, carry springs. A spring at depth d
pushes with ``k max(d, 0)``, rounded at 0, along the gradient of the object's distance. Between two
nodes the centre line is the cubic through their positions along their z axes, so that a force on a
point becomes forces and moments on these nodes. A soft object yields as a whole wherever it is
touched without a gap: by u, where its own stiffness times u is the sum of the springs' forces.

Friction is Coulomb's, regularised by a spring across the normal at each point. The spring moves
with the body's skin and slides when its force is the friction coefficient times the normal force.

Depths, and with them all forces, are those at the end of a step, as in backward Euler, so impacts
lose energy and do not chatter.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from stiffopt.model.description import RobotDescription
from stiffopt.model.scene import Scene
from stiffopt.plant.jit import jit
from stiffopt.plant.rod import DiscreteRod
from stiffopt.plant.settings import BOX, CYLINDER, PLANE, TOUCHABLE, TUBE

Array = Any

_SPACING = 0.05  # between two points, as a share of the body's radius
_SPRING = 8e6  # N/m per m along the arm
_TIP_SHARE = 0.2  # of the radius: length of the arm that the tip's point represents in addition
_ROUNDED = 2e-6  # m of depth over which a spring sets in: a kink would upset Newton's method
_SLACK = 1.25  # bound of the centre line's length between two nodes over their distance
_MAX_ITERATIONS = 50  # for the yield of a soft object; they converge from one side


class Surroundings(NamedTuple):
    """Objects that the body may touch, and the points on it.

    There are k objects, m pieces, P points and N nodes.
    """

    # of the objects (k,): `LINE` (sphere, capsule), `TUBE`, `PLANE`, `CYLINDER` or `BOX`
    kind: Array
    # of the objects (k + 1,); a distance is the largest of the pieces' distances
    first_piece: Array
    numbers: Array  # of the pieces (m, 15), see `stiffopt.model.obstacle.Obstacle.pieces`
    begin: Array  # arc length at rest from which the body counts (k,), m
    friction: Array  # coefficient (k,)
    stiffness: Array  # of the objects (k,), N/m; infinite for rigid ones
    first_point: Array  # first point after each node (N + 1,)
    at: Array  # arc length of the points at rest (P,), m
    share: Array  # position of the points between two nodes (P,), from 0 to 1
    # radius, spring: of the body there (P,), m, and stiffness of the springs, N/m
    radius: Array
    spring: Array


class ContactForces(NamedTuple):
    """Forces of the objects on the arm, and buffers for their computation."""

    wrench: Array  # on the nodes, in base axes (N, 6)
    force: Array  # of each object (k, 3), in base axes, N
    middle: Array  # arc length at rest of the middle of each contact (k,), m
    deepest: Array  # greatest depth of the body in each object (k,), m
    grip: Array  # stretch of the springs across the normals (k, P, 3), m
    energy: Array  # in all springs (1,), J
    # depth, normal: of the points in the present object (P,), m, and (P, 3)
    depth: Array
    normal: Array


def make_surroundings(
    scene: Scene | None, robot: RobotDescription, rod: DiscreteRod
) -> Surroundings:
    """Return the points on the body of a rod, and the scene that they may touch."""
    at, node, share, radius, spring = [], [], [], [], []
    start = 0.0
    for s, segment in enumerate(robot.segments):
        first, m = int(rod.first_node[s]), int(rod.intervals[s])
        cuts = np.concatenate(([0.0], np.cumsum(rod.interval[s, :m]))) / rod.length[s]
        parts = [(segment.length, first, cuts)]
        if segment.connector > 0:
            parts.append((segment.connector, first + m, np.array([0.0, 1.0])))
        for length, begin, ends in parts:
            count = math.ceil(length / (_SPACING * segment.outer_radius))
            places = (np.arange(count) + 0.5) / count
            interval = np.searchsorted(ends, places) - 1
            at += (start + length * places).tolist()
            node += (begin + interval).tolist()
            share += ((places - ends[interval]) / np.diff(ends)[interval]).tolist()
            radius += [segment.outer_radius] * count
            spring += [_SPRING * length / count] * count
            start += length
    at.append(start)
    node.append(node[-1])
    share.append(1.0)
    radius.append(radius[-1])
    spring.append(_SPRING * _TIP_SHARE * radius[-1])
    objects = () if scene is None else scene.objects
    pieces = [item.shape.pieces for item in objects]
    numbers = np.zeros((sum(map(len, pieces)), 15))
    for row, piece in zip(numbers, (piece for own in pieces for piece in own), strict=True):
        centre, rest = piece[:3], piece[3:]
        both = [*centre, *centre, *rest] if len(piece) == 4 else piece  # a sphere: line of length 0
        row[: len(both)] = both
    given = [item.contact for item in objects]
    soft = [np.inf if c is None or c.stiffness is None else c.stiffness for c in given]
    return Surroundings(
        kind=np.array([TOUCHABLE[item.shape.key] for item in objects], dtype=np.int64),
        first_piece=np.cumsum([0, *map(len, pieces)]),
        numbers=numbers,
        begin=np.array([item.shape.begin(radius[0], 0.0) for item in objects]),
        friction=np.array([0.0 if c is None else c.friction for c in given]),
        stiffness=np.array(soft),
        first_point=np.searchsorted(node, np.arange(len(rod.mass) + 1)),
        at=np.array(at),
        share=np.array(share),
        radius=np.array(radius),
        spring=np.array(spring),
    )


@jit
def no_forces(around: Surroundings) -> ContactForces:
    """Return zero forces and empty buffers."""
    k, P = len(around.kind), len(around.at)
    return ContactForces(
        np.zeros((len(around.first_point), 6)),
        np.zeros((k, 3)),
        np.zeros(k),
        np.zeros(k),
        np.zeros((k, P, 3)),
        np.zeros(1),
        np.zeros(P),
        np.zeros((P, 3)),
    )


@jit
def _beyond(excess: Array, weight: Array) -> float:
    """Return a box's distance from the excess of a point over its faces; set its gradient."""
    outside, most = 0.0, 0
    for i in range(len(excess)):
        outside += max(excess[i], 0.0) ** 2
        if excess[i] > excess[most]:
            most = i
        weight[i] = 0.0
    outside = math.sqrt(outside)
    if outside == 0:
        weight[most] = 1.0
        return float(excess[most])
    for i in range(len(excess)):
        weight[i] = max(excess[i], 0.0) / outside
    return outside


@jit
def _piece_distance(kind: int, q: Array, x: Array, normal: Array) -> float:
    """Return the distance of a point (3,) from a piece, m; set its gradient (3,)."""
    if kind == PLANE:
        distance = 0.0
        for i in range(3):
            normal[i] = q[3 + i]
            distance += q[3 + i] * (x[i] - q[i])
        return distance
    if kind == BOX:
        seen, excess, weight = np.empty(3), np.empty(3), np.empty(3)
        for j in range(3):
            seen[j] = 0.0
            for i in range(3):
                seen[j] += q[6 + 3 * j + i] * (x[i] - q[i])
            excess[j] = abs(seen[j]) - 0.5 * q[3 + j]
        distance = _beyond(excess, weight)
        for i in range(3):
            normal[i] = 0.0
            for j in range(3):
                normal[i] += math.copysign(weight[j], seen[j]) * q[6 + 3 * j + i]
        return distance
    length, along = 0.0, 0.0
    for i in range(3):
        length += (q[3 + i] - q[i]) ** 2
        along += (q[3 + i] - q[i]) * (x[i] - q[i])
    length = math.sqrt(length)
    height = along / length if length > 0 else 0.0
    foot = height if kind == CYLINDER else min(max(height, 0.0), length)
    radial = 0.0
    for i in range(3):
        normal[i] = x[i] - q[i] - (foot / length * (q[3 + i] - q[i]) if length > 0 else 0.0)
        radial += normal[i] ** 2
    radial = max(math.sqrt(radial), 1e-12)
    for i in range(3):
        normal[i] /= radial
    if kind == TUBE:
        for i in range(3):
            normal[i] = -normal[i]
        return float(q[6] - radial)
    if kind == CYLINDER:
        excess, weight = np.empty(2), np.empty(2)
        excess[0] = radial - q[6]
        excess[1] = abs(height - 0.5 * length) - 0.5 * length
        distance = _beyond(excess, weight)
        up = math.copysign(weight[1], height - 0.5 * length) / length
        for i in range(3):
            normal[i] = weight[0] * normal[i] + up * (q[3 + i] - q[i])
        return distance
    return float(radial - q[6])


@jit
def distance(around: Surroundings, k: int, x: Array, normal: Array) -> float:
    """Return the distance of a point (3,) from an object, m; set its gradient (3,)."""
    best, own = -np.inf, np.empty(3)
    for piece in range(around.first_piece[k], around.first_piece[k + 1]):
        value = _piece_distance(around.kind[k], around.numbers[piece], x, own)
        if value > best:
            best = value
            normal[:] = own
    return best


@jit
def _cubic(s: float) -> tuple[float, float, float, float]:
    """Return Hermite's cubics of the positions at both ends and of the tangents there."""
    return (1 + 2 * s) * (1 - s) ** 2, s**2 * (3 - 2 * s), s * (1 - s) ** 2, s**2 * (s - 1)


@jit
def _chord(r: Array, node: int) -> float:
    total = 0.0
    for i in range(3):
        total += (r[node + 1, i] - r[node, i]) ** 2
    return math.sqrt(total)


@jit
def _place(R: Array, r: Array, node: int, chord: float, s: float, out: Array) -> None:
    """Set the position (3,) at a share of the way from a node to the next."""
    a, b, c, d = _cubic(s)
    for i in range(3):
        out[i] = a * r[node, i] + b * r[node + 1, i]
        out[i] += chord * (c * R[node, i, 2] + d * R[node + 1, i, 2])


@jit
def _rounded(depth: float) -> float:
    """Return ``max(depth, 0)``, rounded."""
    if depth <= 0:
        return 0.0
    return depth * depth / (2 * _ROUNDED) if depth < _ROUNDED else depth - 0.5 * _ROUNDED


@jit
def _area(depth: float) -> float:
    """Return the integral of `_rounded`."""
    if depth <= 0:
        return 0.0
    if depth < _ROUNDED:
        return depth**3 / (6 * _ROUNDED)
    return 0.5 * (depth - 0.5 * _ROUNDED) ** 2 + _ROUNDED**2 / 24


@jit
def _give_way(around: Surroundings, k: int, depth: Array, energy: Array) -> None:
    """Subtract from the depths (P,) by how much a soft object yields where it is touched."""
    begin, P = 0, len(depth)
    while begin < P:
        end = begin
        while end < P and depth[end] > 0:
            end += 1
        u = 0.0
        for _ in range(_MAX_ITERATIONS if end > begin else 0):
            off, slope = around.stiffness[k] * u, around.stiffness[k]
            for i in range(begin, end):
                off -= around.spring[i] * _rounded(depth[i] - u)
                slope += around.spring[i] * min(max((depth[i] - u) / _ROUNDED, 0.0), 1.0)
            u -= off / slope
            if abs(off) < 1e-12 * slope:
                break
        energy[0] += 0.5 * around.stiffness[k] * u * u
        for i in range(begin, end):
            depth[i] -= u
        begin = end + 1


@jit
def _slip(
    around: Surroundings,
    k: int,
    node: int,
    i: int,
    R: Array,
    r: Array,
    R0: Array,
    r0: Array,
    normal: Array,
    grip: Array,
) -> None:
    """Add the skin's motion across the normal, m, to a spring's stretch (3,)."""
    s, x, x0, along = around.share[i], np.empty(3), np.empty(3), 0.0
    _place(R, r, node, _chord(r, node), s, x)
    _place(R0, r0, node, _chord(r0, node), s, x0)
    for j in range(3):
        grip[j] += x[j] - x0[j]
        for a in range(2):  # the touched point of the skin turns with the sections
            n, weight = node + a, s if a == 1 else 1 - s
            for c in range(3):
                own = 0.0
                for b in range(3):
                    own -= R[n, b, c] * around.radius[i] * normal[b]
                grip[j] += weight * (R[n, j, c] - R0[n, j, c]) * own
        along += grip[j] * normal[j]
    for j in range(3):
        grip[j] -= along * normal[j]


@jit
def _spread(
    around: Surroundings,
    node: int,
    i: int,
    F: Array,
    normal: Array,
    R: Array,
    r: Array,
    wrench: Array,
) -> None:
    """Add the force (3,) on the skin at a point to the nodes' wrenches (N, 6)."""
    s, chord, stretch, arm = around.share[i], _chord(r, node), 0.0, np.empty(3)
    a, b, c, d = _cubic(s)
    for j in range(3):  # the tangents are as long as the chord
        stretch += F[j] * (c * R[node, j, 2] + d * R[node + 1, j, 2]) / chord
    for end in range(2):
        n, weight = node + end, s if end == 1 else 1 - s
        for j in range(3):
            pull = stretch * (r[node + 1, j] - r[node, j])
            wrench[n, j] += b * F[j] + pull if end == 1 else a * F[j] - pull
            arm[j] = chord * (d if end == 1 else c) * R[n, j, 2]
            arm[j] -= weight * around.radius[i] * normal[j]
        wrench[n, 3] += arm[1] * F[2] - arm[2] * F[1]
        wrench[n, 4] += arm[2] * F[0] - arm[0] * F[2]
        wrench[n, 5] += arm[0] * F[1] - arm[1] * F[0]


@jit
def touch(
    around: Surroundings,
    R: Array,
    r: Array,
    R0: Array,
    r0: Array,
    grip: Array,
    rubs: bool,
    out: ContactForces,
) -> None:
    """Compute the forces of the objects in a step that ends at given poses of the nodes.

    Parameters
    ----------
    R, r, R0, r0 : poses of the nodes at its end, (N, 3, 3) and (N, 3), and at its beginning.
    grip : stretch of the springs across the normals at its beginning (k, P, 3), m.
    rubs : whether there is friction.
    """
    x, F, depth, normal = np.empty(3), np.empty(3), out.depth, out.normal
    out.wrench[:] = 0.0
    out.energy[0] = 0.0
    for k in range(len(around.kind)):
        touched = False
        for node in range(len(r) - 1):
            begin, end = around.first_point[node], around.first_point[node + 1]
            if begin == end:
                continue
            chord = _chord(r, node)
            reach = _SLACK * chord + around.radius[begin]
            is_far = distance(around, k, r[node], x) > reach
            for i in range(begin, end):
                depth[i] = -1.0
                if not is_far and around.at[i] >= around.begin[k]:
                    _place(R, r, node, chord, around.share[i], x)
                    depth[i] = around.radius[i] - distance(around, k, x, normal[i])
                    touched = touched or depth[i] > 0
        out.force[k] = 0.0
        out.grip[k] = 0.0
        out.middle[k] = 0.0
        out.deepest[k] = 0.0
        if not touched:
            continue
        if np.isfinite(around.stiffness[k]):
            _give_way(around, k, depth, out.energy)
        total = 0.0
        for node in range(len(r) - 1):
            for i in range(around.first_point[node], around.first_point[node + 1]):
                if depth[i] <= 0:
                    continue
                push = around.spring[i] * _rounded(depth[i])
                out.energy[0] += around.spring[i] * _area(depth[i])
                total += push
                out.middle[k] += push * around.at[i]
                out.deepest[k] = max(out.deepest[k], depth[i])
                for j in range(3):
                    F[j] = push * normal[i, j]
                if around.friction[k] > 0 and rubs:
                    own = out.grip[k, i]
                    own[:] = grip[k, i]
                    _slip(around, k, node, i, R, r, R0, r0, normal[i], own)
                    size = math.sqrt(own[0] ** 2 + own[1] ** 2 + own[2] ** 2)
                    most = around.friction[k] * push / around.spring[i]
                    scale = min(1.0, most / max(size, 1e-15))
                    out.energy[0] += 0.5 * around.spring[i] * (scale * size) ** 2
                    for j in range(3):
                        own[j] *= scale
                        F[j] -= around.spring[i] * own[j]
                for j in range(3):
                    out.force[k, j] += F[j]
                _spread(around, node, i, F, normal[i], R, r, out.wrench)
        out.middle[k] /= max(total, 1e-15)


@jit
def add_wrenches(forces: ContactForces, R: Array, J: Array, out: Array) -> None:
    """Set the generalised forces (n,) of the wrenches, from the nodes' axes and Jacobians."""
    out[:] = 0.0
    for n in range(1, len(R)):
        for half in range(2):
            for i in range(3):
                own = 0.0
                for j in range(3):
                    own += R[n, j, i] * forces.wrench[n, 3 * half + j]
                if own != 0:
                    for k in range(len(out)):
                        out[k] += J[n, k, 3 * half + i] * own
