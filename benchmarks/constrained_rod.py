"""An independent model of an arm pressed on objects: a discrete rod with inequality constraints.

It does not import stiffopt, and has the calls of `pressed_rod.py`, whose springs are too weak where
an arm lies along a surface. IPOPT minimises the energy of elements of constant strain under the
condition that no node is nearer to a surface than the radius; the multipliers are contact forces.
Pressures and load grow from rest in steps. Then elements are short where contacts begin and end.

Arms are of segments without connectors, whose centroid is on the axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from independent.arms import Arm
from independent.sections import rod_section

Array = Any
Objects = Sequence[tuple[int, Sequence[float]]]  # see `pressed_rod.pressed`

_LENGTH, _FORCE = 0.1, 0.1  # m and N, units of the variables
_COARSE, _FINE, _ABOUT = 1.5e-3, 2.5e-4, 3e-3  # m, elements in the end; the shortest about contacts
_LEAST = 1e-5  # N, of a contact
_ROUND = (
    2.5e-7  # square of a distance from a tube's axis, so that it is smooth where the arm begins
)
_OPTIONS = {
    "print_time": False, "ipopt.print_level": 0, "ipopt.tol": 1e-10, "ipopt.max_iter": 150,
    "ipopt.bound_relax_factor": 0, "ipopt.nlp_scaling_method": "none", "ipopt.mu_init": 1e-5,
    "ipopt.mu_target": 1e-10, "ipopt.compl_inf_tol": 1e-8, "ipopt.warm_start_init_point": "yes",
    "ipopt.warm_start_bound_push": 1e-7, "ipopt.warm_start_slack_bound_push": 1e-7,
    "ipopt.warm_start_mult_bound_push": 1e-7,
}  # fmt: skip


@dataclass(frozen=True)
class Pressed:
    """An equilibrium: tip (3,), and force and mean station of each object."""

    tip: Array
    forces: Array
    at: Array
    values: Array  # of the variables
    multipliers: Array
    rod: _Rod
    force: Array  # at the tip


class _Rod:
    """The program for elements between edges (k + 1,), in m from the base."""

    def __init__(self, arm: Arm, p: Array, objects: Objects, edges: Array) -> None:
        self.arm, self.p, self.objects, self.edges = arm, np.asarray(p), objects, edges
        h, k = np.diff(edges), len(edges) - 1
        ends = np.cumsum([tube.length for tube in arm.tubes])
        self.segment = np.minimum(
            np.searchsorted(ends, (edges[1:] + edges[:-1]) / 2), len(ends) - 1
        )
        xi, x, q = ca.SX.sym("xi", 6, k), ca.SX.sym("x", 3, k + 1), ca.SX.sym("q", 4, k + 1)
        free, share = ca.SX.sym("free", 6, len(ends)), ca.SX.sym("share")
        K = ca.SX.sym("K", 36, len(ends))
        force, gravity = ca.SX.sym("force", 3), ca.DM(arm.gravity)
        energy = -ca.dot(force + share * arm.tip_mass * gravity / _FORCE, x[:, k])
        equal = [x[:, 0], q[:, 0] - ca.DM([1, 0, 0, 0])]
        for i, j in enumerate(self.segment):
            step, weight = h[i] / _LENGTH, rod_section(arm.tubes[j], self._own(0)[j], arm.gravity)
            d = xi[:, i] - free[:, j]
            energy += step / 2 * ca.bilin(ca.reshape(K[:, j], 6, 6), d, d)
            middle = (x[:, i] + x[:, i + 1]) / 2
            energy -= share * h[i] / _FORCE * ca.dot(ca.DM(weight.weight), middle)
            half = _product(q[:, i], _turn(step / 2 * xi[3:, i]))
            equal += [
                q[:, i + 1] - _product(q[:, i], _turn(step * xi[3:, i])),
                x[:, i + 1] - x[:, i] - step * _turned(half, xi[:3, i]),
            ]
        radii = np.array([tube.outer_radius for tube in arm.tubes])[self.segment] / _LENGTH
        clear = [distance(each, x[:, i + 1]) - radii[i] for each in objects for i in range(k)]
        rows = ca.vertcat(*equal)
        self._equal = rows.shape[0]
        program = {
            "x": ca.veccat(xi, x, q), "f": energy, "g": ca.vertcat(rows, *clear),
            "p": ca.veccat(free, K, force, share),
        }  # fmt: skip
        self._solver = ca.nlpsol("rod", "ipopt", program, _OPTIONS)

    def _own(self, share: float) -> list[Array]:
        return self.arm.split(share * self.p)

    def at_rest(self) -> Array:
        """Variables of the straight arm."""
        k = len(self.edges)
        straight = np.column_stack([np.zeros((k, 2)), self.edges / _LENGTH])
        strains = np.tile([0.0, 0, 1, 0, 0, 0], k - 1)
        return np.concatenate([strains, straight.ravel(), np.tile([1.0, 0, 0, 0], k)])

    def on(self, values: Array, other: _Rod) -> Array:
        """Variables of another rod of the same arm at the same shape."""
        k = len(self.edges) - 1
        xi, x, q = np.split(values, [6 * k, 9 * k + 3])
        middles = (other.edges[1:] + other.edges[:-1]) / 2
        row = np.clip(np.searchsorted(self.edges, middles) - 1, 0, k - 1)
        x, q = (
            np.column_stack([np.interp(other.edges, self.edges, col) for col in each.T])
            for each in (x.reshape(-1, 3), q.reshape(-1, 4))
        )
        q /= np.linalg.norm(q, axis=1)[:, None]
        return np.concatenate([xi.reshape(-1, 6)[row].ravel(), x.ravel(), q.ravel()])

    def solved(
        self, values: Array, multipliers: Array | None, share: float, load: float, force: Array
    ) -> Pressed:
        """The equilibrium near some variables at a share of the pressures and of the weight."""
        laws = [
            rod_section(tube, own, self.arm.gravity)
            for tube, own in zip(self.arm.tubes, self._own(share), strict=True)
        ]
        scale = np.array([1.0, 1, 1, _LENGTH, _LENGTH, _LENGTH])  # of strains
        free = [law.strain * scale for law in laws]
        K = [np.linalg.inv(law.compliance) / np.outer(scale, scale) / _FORCE for law in laws]
        parameters = np.concatenate([*free, *(each.ravel() for each in K), force / _FORCE, [load]])
        upper = np.full(self._equal + len(self.objects) * (len(self.edges) - 1), np.inf)
        upper[: self._equal] = 0.0
        known = {} if multipliers is None else {"lam_g0": multipliers}
        found = self._solver(x0=values, lbg=0.0, ubg=upper, p=parameters, **known)
        if not self._solver.stats()["success"]:
            raise ArithmeticError(f"no minimum was found: {self._solver.stats()['return_status']}")
        values, multipliers = (np.array(found[name]).ravel() for name in ("x", "lam_g"))
        k, count = len(self.edges) - 1, len(self.objects)
        pushes = -_FORCE * multipliers[self._equal :].reshape(count, k)
        pushes[pushes < _LEAST / 10] = 0.0
        total = pushes.sum(axis=1)
        at = np.divide(pushes @ self.edges[1:], total, out=np.full(count, np.nan), where=total > 0)
        tip = _LENGTH * values[9 * k : 9 * k + 3]
        return Pressed(tip, total, at, values, multipliers, self, force)

    def refined(self, state: Pressed) -> Array:
        """Edges that are close where contacts begin and end."""
        k, length = len(self.edges) - 1, self.edges[-1]
        pushes = -_FORCE * state.multipliers[self._equal :].reshape(-1, k)
        marks = set(np.linspace(0, length, round(length / _COARSE) + 1))
        for own in pushes:
            rows = np.flatnonzero(own > _LEAST)
            runs = np.split(rows, np.flatnonzero(np.diff(rows) > 2) + 1) if len(rows) else []
            for s in {self.edges[1:][run[end]] for run in runs for end in (0, -1)}:
                marks |= set(np.arange(max(0.0, s - _ABOUT), min(length, s + _ABOUT), _FINE))
        ends = np.cumsum([tube.length for tube in self.arm.tubes])
        edges = [0.0]
        for each in sorted(marks | set(ends)):
            is_end = np.abs(ends - each).min() < 1e-9
            if is_end and len(edges) > 1 and each - edges[-1] < 0.6 * _FINE:
                edges.pop()
            if is_end or each - edges[-1] > 0.6 * _FINE:
                edges.append(each)
        return np.array(edges)


def _product(a: ca.SX, b: ca.SX) -> ca.SX:
    vector = a[0] * b[1:] + b[0] * a[1:] + ca.cross(a[1:], b[1:])
    return ca.vertcat(a[0] * b[0] - ca.dot(a[1:], b[1:]), vector)


def _turned(q: ca.SX, v: ca.SX) -> ca.SX:
    t = 2 * ca.cross(q[1:], v)
    return v + q[0] * t + ca.cross(q[1:], t)


def _turn(w: ca.SX) -> ca.SX:
    """Quaternion of a small turn, by power series."""
    t = ca.dot(w, w) / 4
    return ca.vertcat(1 - t / 2 + t**2 / 24 - t**3 / 720, w / 2 * (1 - t / 6 + t**2 / 120))


def _length(x: ca.SX, rounded: float = 1e-18) -> ca.SX:
    return ca.sqrt(ca.dot(x, x) + rounded)


def distance(item: tuple[int, Sequence[float]], x: ca.SX) -> ca.SX:
    """Of a point from an object, in units of `_LENGTH`."""
    kind, numbers = item
    own = np.array(numbers, float) / _LENGTH
    a, b, radius = own[:3], own[3:6], float(own[6])
    if kind == 0:
        return _from_line(a, b, x) - radius
    axis = np.array(numbers[3:6])
    if kind == 1:
        return ca.dot(x - a, axis)
    if kind == 3:
        height = ca.dot(x - a, axis)
        return ca.sqrt((_length(x - a - height * axis) - radius) ** 2 + height**2)
    return _from_tube(a, b, own[7:], radius, x)


def _from_line(a: Array, b: Array, x: ca.SX, rounded: float = 1e-18) -> ca.SX:
    way = b - a
    share = ca.fmin(1, ca.fmax(0, ca.dot(x - a, way) / max(way @ way, 1e-12)))
    return _length(x - a - share * way, rounded)


def _from_tube(a: Array, b: Array, c: Array, radius: float, x: ca.SX) -> ca.SX:
    """Of a point inside two cylinders with rounded ends, which meet in an ellipse: their ridge."""
    inside = radius - ca.fmin(_from_line(a, b, x, _ROUND), _from_line(b, c, x, _ROUND))
    first, second = (b - a) / np.linalg.norm(b - a), (c - b) / np.linalg.norm(c - b)
    half = np.arccos(np.clip(first @ second, -1, 1)) / 2
    if half < 1e-6:
        return inside
    outwards = (second - first) / np.linalg.norm(second - first)
    along = (first + second) / np.linalg.norm(first + second)
    across, long = np.cross(along, outwards), radius / np.cos(half)
    u, v, w = (ca.dot(x - b, each) for each in (outwards, across, along))
    angle = ca.atan2(v, ca.fmax(u, 1e-3))
    for _ in range(6):  # Newton's method for the nearest point of the ellipse
        cos, sin = ca.cos(angle), ca.sin(angle)
        slope = u * long * sin - v * radius * cos - (long**2 - radius**2) * sin * cos
        bend = u * long * cos + v * radius * sin - (long**2 - radius**2) * (cos**2 - sin**2)
        angle -= slope / ca.if_else(ca.fabs(bend) > 1e-4, bend, 1e-4)
    cos, sin = ca.cos(angle), ca.sin(angle)
    off = ca.sqrt((u - long * cos) ** 2 + (v - radius * sin) ** 2 + w**2 + 1e-18)
    at_ridge = ca.logic_and(u > 0, ca.fabs(w) < off * np.sin(half) * cos)
    at_ridge = ca.logic_and(at_ridge, (u / long) ** 2 + (v / radius) ** 2 < 1)
    return ca.if_else(at_ridge, ca.fmax(off, inside), inside)


def pressed(arm: Arm, p: Array, objects: Objects, force: Array, n: int, steps: int = 8) -> Pressed:
    """The arm after its weight and then pressures and a force at the tip have grown from rest."""
    edges = np.linspace(0, arm.length, n * len(arm.tubes) + 1)
    rod, force = _Rod(arm, p, objects, edges), np.asarray(force, float)
    values, multipliers = rod.at_rest(), None
    weights = np.arange(1, 5) / 4 if any(arm.gravity) else []
    ways = [(0.0, load) for load in weights] + [(s, 1.0) for s in np.arange(1, steps + 1) / steps]
    for share, load in ways:
        state = rod.solved(values, multipliers, share, load, share * force)
        values, multipliers = state.values, state.multipliers
    fine = _Rod(arm, p, objects, rod.refined(state))
    return fine.solved(rod.on(values, fine), None, 1.0, 1.0, force)


def pushed(state: Pressed, objects: Objects, force: Array, steps: int = 1) -> Pressed:
    """The same with one more force at the tip, grown in steps."""
    del objects  # those of the rod
    begin = state.force
    for share in np.arange(1, steps + 1) / steps:
        there = begin + share * np.asarray(force, float)
        state = state.rod.solved(state.values, state.multipliers, 1.0, 1.0, there)
    return state
