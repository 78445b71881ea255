"""The rod: shape, derivatives and mass of the simulated arm, and the loads on it.

A geometrically exact Cosserat rod, per reference length. The strain of a segment (linear part
first: shear, stretch; then curvature, twist) is a sum of Legendre polynomials with coefficients q;
the pose obeys ``T' = T (e + strain)^``. Between two nodes it is integrated by the Magnus expansion
of order four (two Gauss points):

    T(b) = T(a) exp(X),   X = h/2 (x1 + x2) + sqrt(3)/12 h^2 [x1, x2].

Loads from outside (`RodLoads`) are the weight, a wrench at one place and the plate of a probe at
the tip. Everything here is compiled and works on arrays that the caller owns.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from stiffopt.plant.jit import jit

Array = Any  # an array of floats; numba infers the rest

_COMMUTATOR = math.sqrt(3) / 12
_SMALL = 0.04  # squared angle below which series are used
_SOFT = 1e-6  # m over which contact sets in: a kink would upset Newton's method


class DiscreteRod(NamedTuple):
    """The discretised rod: the part of an arm that is constant in time.

    There are S segments, n coefficients and N nodes.

    The first node of a segment is its proximal end; the very last node is the tip, after the last
    connector.
    """

    # first, count: index of the first coefficient of each strain component within a segment (6,),
    # and their number (6,)
    first: Array
    count: Array
    per_segment: int  # number of coefficients of a segment
    # length, connector: of the segments (S,), m
    length: Array
    connector: Array
    first_node: Array  # of the segments (S,)
    intervals: Array  # number of intervals between the nodes of a segment (S,)
    interval: Array  # their lengths (S, m), m
    interval_basis: Array  # polynomials at the Gauss points of the intervals (S, m, 2, k)
    # weight, basis: Gauss points for the stresses (g,), and the polynomials there (g, k)
    weight: Array
    basis: Array
    # base_rotation, base_position: of the arm (3, 3), (3,)
    base_rotation: Array
    base_position: Array
    mass: Array  # of each node, over (position, x axis, y axis) (N, 3, 3), kg, kg m, kg m^2
    gravity: Array  # (3,), m/s^2


@jit
def strain_at(rod: DiscreteRod, segment: int, basis: Array, q: Array, out: Array) -> None:
    """Set the strain (6,) at a point with these values of the polynomials; it is 0 at rest."""
    offset = segment * rod.per_segment
    for c in range(6):
        total = 0.0
        first = offset + rod.first[c]
        for k in range(rod.count[c]):
            total += basis[k] * q[first + k]
        out[c] = total


@jit
def _bracket(a: Array, b: Array, out: Array) -> None:
    """Set the Lie bracket [a, b] of twists: linear a_w x b_v - b_w x a_v, angular a_w x b_w."""
    a0, a1, a2, w0, w1, w2 = a[0], a[1], a[2], a[3], a[4], a[5]
    b0, b1, b2, u0, u1, u2 = b[0], b[1], b[2], b[3], b[4], b[5]
    out[0] = w1 * b2 - w2 * b1 - u1 * a2 + u2 * a1
    out[1] = w2 * b0 - w0 * b2 - u2 * a0 + u0 * a2
    out[2] = w0 * b1 - w1 * b0 - u0 * a1 + u1 * a0
    out[3] = w1 * u2 - w2 * u1
    out[4] = w2 * u0 - w0 * u2
    out[5] = w0 * u1 - w1 * u0


@jit
def _exponential_terms(x: float) -> tuple[float, float, float]:
    """Return ``sin t / t``, ``(1 - cos t) / t^2`` and ``(t - sin t) / t^3`` for x = t^2."""
    if x < _SMALL:
        a = 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72)))
        b = 0.5 * (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90))))
        c = (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110)))) / 6
        return a, b, c
    t = math.sqrt(x)
    sine = math.sin(t) / t
    return sine, (1 - math.cos(t)) / x, (1 - sine) / x


@jit
def _exponential(X: Array, R: Array, p: Array) -> None:
    """Set rotation (3, 3) and translation (3,) of exp(X)."""
    w0, w1, w2 = X[3], X[4], X[5]
    x = w0 * w0 + w1 * w1 + w2 * w2
    a, b, c = _exponential_terms(x)
    R[0, 0] = 1 - b * (w1 * w1 + w2 * w2)
    R[1, 1] = 1 - b * (w0 * w0 + w2 * w2)
    R[2, 2] = 1 - b * (w0 * w0 + w1 * w1)
    R[0, 1] = b * w0 * w1 - a * w2
    R[1, 0] = b * w0 * w1 + a * w2
    R[0, 2] = b * w0 * w2 + a * w1
    R[2, 0] = b * w0 * w2 - a * w1
    R[1, 2] = b * w1 * w2 - a * w0
    R[2, 1] = b * w1 * w2 + a * w0
    dot = w0 * X[0] + w1 * X[1] + w2 * X[2]
    p[0] = a * X[0] + b * (w1 * X[2] - w2 * X[1]) + c * dot * w0
    p[1] = a * X[1] + b * (w2 * X[0] - w0 * X[2]) + c * dot * w1
    p[2] = a * X[2] + b * (w0 * X[1] - w1 * X[0]) + c * dot * w2


@jit
def _interval_twist(
    rod: DiscreteRod, s: int, m: int, q: Array, x1: Array, x2: Array, X: Array
) -> None:
    """Set the twist X (6,) over interval m of segment s, and its strains x1, x2 (with e)."""
    h = rod.interval[s, m]
    strain_at(rod, s, rod.interval_basis[s, m, 0], q, x1)
    strain_at(rod, s, rod.interval_basis[s, m, 1], q, x2)
    x1[2] += 1.0
    x2[2] += 1.0
    _bracket(x1, x2, X)
    for i in range(6):
        X[i] = 0.5 * h * (x1[i] + x2[i]) + _COMMUTATOR * h * h * X[i]


@jit
def _compose(R: Array, r: Array, dR: Array, dr: Array, R_out: Array, r_out: Array) -> None:
    for i in range(3):
        r_out[i] = r[i] + R[i, 0] * dr[0] + R[i, 1] * dr[1] + R[i, 2] * dr[2]
        for j in range(3):
            R_out[i, j] = R[i, 0] * dR[0, j] + R[i, 1] * dR[1, j] + R[i, 2] * dR[2, j]


@jit
def poses(rod: DiscreteRod, q: Array, R: Array, r: Array) -> None:
    """Set rotations (N, 3, 3) and positions (N, 3) of the nodes."""
    x1, x2, X = np.empty(6), np.empty(6), np.empty(6)
    dR, dr = np.empty((3, 3)), np.empty(3)
    R[0] = rod.base_rotation
    r[0] = rod.base_position
    node = 0
    for s in range(len(rod.length)):
        for m in range(rod.intervals[s]):
            _interval_twist(rod, s, m, q, x1, x2, X)
            _exponential(X, dR, dr)
            _compose(R[node], r[node], dR, dr, R[node + 1], r[node + 1])
            node += 1
        for i in range(3):  # the connector is rigid
            r[node + 1, i] = r[node, i] + R[node, i, 2] * rod.connector[s]
            for j in range(3):
                R[node + 1, i, j] = R[node, i, j]
        node += 1


@jit
def _exponential_derivative(X: Array, dX: Array, out: Array, work: Array) -> None:
    """Set ``exp(X)^-1 d exp(X)`` (6,) for a change dX (6,).

    The series ``sum (-ad X)^n / (n + 1)! dX`` is reduced to four terms by the minimal polynomial of
    ad X, ``ad (ad^2 + t^2)^2 = 0``.
    """
    x = X[3] * X[3] + X[4] * X[4] + X[5] * X[5]
    if x < _SMALL:
        c1 = -0.5 + x * x / 720 * (1 - x / 28)
        c2 = 1 / 6 - x * x / 5040 * (1 - x / 36)
        c3 = -1 / 24 + x / 360 - x * x / 13440
        c4 = 1 / 120 - x / 2520 + x * x / 120960
    else:
        t = math.sqrt(x)
        sine, cosine = math.sin(t), math.cos(t)
        c1 = (t * sine + 4 * cosine - 4) / (2 * x)
        c2 = (4 * t - 5 * sine + t * cosine) / (2 * x * t)
        c3 = (t * sine + 2 * cosine - 2) / (2 * x * x)
        c4 = (2 * t - 3 * sine + t * cosine) / (2 * x * x * t)
    for i in range(6):
        out[i] = dX[i]
        work[0, i] = dX[i]
    for c in (c1, c2, c3, c4):
        _bracket(X, work[0], work[1])
        for i in range(6):
            out[i] += c * work[1, i]
            work[0, i] = work[1, i]


@jit
def jacobians(rod: DiscreteRod, q: Array, J: Array) -> None:
    """Set the nodes' body Jacobians, transposed (N, n, 6): twist in their own axes per q."""
    x1, x2, X = np.empty(6), np.empty(6), np.empty(6)
    d1, dX, at1, at2 = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    work = np.empty((2, 6))
    dR, dr = np.empty((3, 3)), np.empty(3)
    J[0] = 0.0
    node = 0
    for s in range(len(rod.length)):
        begin = s * rod.per_segment
        end = begin + rod.per_segment
        for m in range(rod.intervals[s]):
            h = rod.interval[s, m]
            _interval_twist(rod, s, m, q, x1, x2, X)
            _exponential(X, dR, dr)
            here, there = J[node], J[node + 1]
            for column in range(end):
                _carry(here[column], dR, dr, there[column])
            for column in range(end, J.shape[1]):
                there[column] = 0.0
            for c in range(6):  # effect of a strain e_c at either Gauss point, then the polynomials
                d1[:] = 0.0
                d1[c] = 1.0
                _bracket(d1, x2, dX)
                for i in range(6):
                    dX[i] *= _COMMUTATOR * h * h
                dX[c] += 0.5 * h
                _exponential_derivative(X, dX, at1, work)
                _bracket(x1, d1, dX)
                for i in range(6):
                    dX[i] *= _COMMUTATOR * h * h
                dX[c] += 0.5 * h
                _exponential_derivative(X, dX, at2, work)
                for k in range(rod.count[c]):
                    b1, b2 = rod.interval_basis[s, m, 0, k], rod.interval_basis[s, m, 1, k]
                    target = there[begin + rod.first[c] + k]
                    for i in range(6):
                        target[i] += b1 * at1[i] + b2 * at2[i]
            node += 1
        length = rod.connector[s]
        for column in range(J.shape[1]):
            here, there = J[node, column], J[node + 1, column]
            for i in range(6):
                there[i] = here[i]
            there[0] += length * here[4]
            there[1] -= length * here[3]
        node += 1


@jit
def _carry(twist: Array, dR: Array, dr: Array, out: Array) -> None:
    """Express a body's twist in the axes and at the origin of a frame (dR, dr) fixed to it."""
    v0 = twist[0] + twist[4] * dr[2] - twist[5] * dr[1]
    v1 = twist[1] + twist[5] * dr[0] - twist[3] * dr[2]
    v2 = twist[2] + twist[3] * dr[1] - twist[4] * dr[0]
    for i in range(3):
        out[i] = dR[0, i] * v0 + dR[1, i] * v1 + dR[2, i] * v2
        out[3 + i] = dR[0, i] * twist[3] + dR[1, i] * twist[4] + dR[2, i] * twist[5]


@jit
def mass_matrix(rod: DiscreteRod, R: Array, J: Array, out: Array) -> None:
    """Set the mass matrix (n, n) of the coefficients."""
    n = len(out)
    out[:] = 0.0
    A = np.empty((6, 6))
    for node in range(1, len(R)):
        m = rod.mass[node]
        A[:] = 0.0
        for i in range(3):
            A[i, i] = m[0, 0]
        A[2, 3], A[2, 4] = m[0, 2], -m[0, 1]  # first moments of mass couple v with w
        A[0, 5], A[1, 5] = -m[0, 2], m[0, 1]
        A[3, 3], A[4, 4] = m[2, 2], m[1, 1]
        A[3, 4] = -m[1, 2]
        A[5, 5] = m[1, 1] + m[2, 2]
        for i in range(6):
            for j in range(i):
                A[i, j] = A[j, i]
        for k in range(n):
            for j in range(k + 1):
                total = 0.0
                for a in range(6):
                    for b in range(6):
                        total += J[node, k, a] * A[a, b] * J[node, j, b]
                out[k, j] += total
    for k in range(n):
        for j in range(k):
            out[j, k] = out[k, j]


class RodLoads(NamedTuple):
    """Loads on the rod from outside."""

    node: int  # node on which the wrench acts
    lever: float  # distance of the wrench beyond the node along its z axis, on a connector, m
    # force, moment: (3,), N and N m
    force: Array
    moment: Array
    follows: bool  # whether they turn with the node's section
    plate: Array  # unit normal of the probe's plate (3,), from the probe towards the tip
    plate_at: float  # position of the plate along its normal, m
    plate_speed: float  # its speed, m/s
    plate_stiffness: float  # N/m; 0 without a plate


@jit
def loads_after(loads: RodLoads, duration: float) -> RodLoads:
    """Return the loads after a duration, in s: the plate moves."""
    return RodLoads(
        loads.node,
        loads.lever,
        loads.force,
        loads.moment,
        loads.follows,
        loads.plate,
        loads.plate_at + duration * loads.plate_speed,
        loads.plate_speed,
        loads.plate_stiffness,
    )


@jit
def depth_of(loads: RodLoads, tip: Array) -> float:
    """Return the depth of the tip behind the plate's face, m; negative if it is clear of it."""
    along: float = loads.plate[0] * tip[0] + loads.plate[1] * tip[1] + loads.plate[2] * tip[2]
    return loads.plate_at - along


@jit
def contact_force(loads: RodLoads, depth: float) -> float:
    """Return the force of the plate on the tip at a depth, N: ``k max(depth, 0)``, rounded at 0."""
    if loads.plate_stiffness == 0:
        return 0.0
    return 0.5 * loads.plate_stiffness * (depth + math.hypot(depth, _SOFT))


@jit
def contact_energy(loads: RodLoads, depth: float) -> float:
    """Return the integral of `contact_force`, J, up to a constant."""
    around = math.hypot(depth, _SOFT)
    energy: float = depth * (depth + around) + _SOFT**2 * math.asinh(depth / _SOFT)
    return 0.25 * loads.plate_stiffness * energy


@jit
def external_forces(
    rod: DiscreteRod, loads: RodLoads, R: Array, r: Array, J: Array, out: Array
) -> None:
    """Set the generalised forces (n,) of gravity and wrench."""
    n = len(out)
    last = len(r) - 1
    out[:] = 0.0
    wrench, down = np.empty(6), np.empty(3)
    for node in range(1, last + 1):
        turn = R[node]
        mass, mx, my = rod.mass[node, 0, 0], rod.mass[node, 0, 1], rod.mass[node, 0, 2]
        for i in range(3):
            down[i] = 0.0
            for j in range(3):
                down[i] += turn[j, i] * rod.gravity[j]
            wrench[i] = mass * down[i]
        wrench[3] = my * down[2]
        wrench[4] = -mx * down[2]
        wrench[5] = mx * down[1] - my * down[0]
        if node == loads.node:
            for i in range(3):
                down[i] = 0.0
                for j in range(3):
                    along = (1.0 if i == j else 0.0) if loads.follows else turn[j, i]
                    down[i] += along * loads.force[j]
                    wrench[3 + i] += along * loads.moment[j]
                wrench[i] += down[i]
            wrench[3] -= loads.lever * down[1]
            wrench[4] += loads.lever * down[0]
        for k in range(n):
            total = 0.0
            for i in range(6):
                total += J[node, k, i] * wrench[i]
            out[k] += total


@jit
def add_contact(loads: RodLoads, depth: float, R: Array, J: Array, out: Array) -> None:
    """Add the plate's generalised forces (n,) on the tip, with axes R (3, 3) and Jacobian J."""
    push = contact_force(loads, depth)
    if push == 0:
        return
    for i in range(3):
        along = push * (
            R[0, i] * loads.plate[0] + R[1, i] * loads.plate[1] + R[2, i] * loads.plate[2]
        )
        for k in range(len(out)):
            out[k] += J[k, i] * along
