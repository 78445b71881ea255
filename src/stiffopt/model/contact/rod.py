"""A rod with point forces, linearised about a state: the lifted Newton method.

The arm is integrated from its tip to its base, as in `stiffopt.model.shooting`, with mesh nodes at
the contacts.  The unknowns are the turn of the tip and, for each contact, force, moment and
station. The orientation and moment at every node of the mesh are unknowns too, which are eliminated
at once (`stiffopt.model.equilibrium`).
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.model.actuation import SectionGeometry
from stiffopt.model.arm import Arm
from stiffopt.model.batch import InterpretedFunction
from stiffopt.model.codegen import dense
from stiffopt.model.contact.steps import STEP_LENGTH, StepFunction
from stiffopt.model.shooting import mass_per_length

_STRETCHED = 1.3  # largest step before the mesh is rebuilt, over the longest of a new mesh

TURN, MOMENT, FORCE = slice(0, 3), slice(3, 6), slice(6, 9)
"""Rows of the changes along the rod."""


class Condition(NamedTuple):
    """Pressures, loads and surfaces of an equilibrium.

    Attributes
    ----------
    pressures : (n,), in Pa.
    dead, follower : wrenches (6,) at the tip, in base axes and in its own.
    gravity : (3,), in m/s^2.
    retreat : distance by which each surface is moved back, (objects,), in m.
    """

    pressures: Array
    dead: Array
    follower: Array
    gravity: Array
    retreat: Array

    @property
    def is_conservative(self) -> bool:
        """Whether all loads are dead forces, which have a potential."""
        return not (self.follower.any() or self.dead[3:].any())

    def towards(self, other: "Condition", share: float) -> "Condition":
        """Return the condition at a share of the straight path to another one."""
        return Condition(*((1 - share) * a + share * b for a, b in zip(self, other, strict=True)))


@dataclass(frozen=True)
class RodRange:
    """A soft segment or a rigid connector, between two arc lengths at rest."""

    start: float
    end: float
    segment: int
    rigid: bool


class RodMesh(NamedTuple):
    """Integration steps from the tip to the base.

    Attributes
    ----------
    at : arc lengths (N + 1,) of the nodes, at rest.
    segment : index of each step's segment, (N,).
    rigid : which steps are rigid, (N,).
    per_station : change (N, k) of the steps' lengths by the stations of contacts.
    node : node of each contact, (k,).
    """

    at: Array
    segment: NDArray[np.int64]
    rigid: NDArray[np.bool_]
    per_station: Array
    node: NDArray[np.int64]


class RodNodes(NamedTuple):
    """Orientation (N + 1, 4) and moment (N + 1, 3) at the nodes, on their distal sides."""

    quaternion: Array
    moment: Array


@dataclass(frozen=True)
class RodSections:
    """Sections of S segments: strains (S, 6), compliances (S, 6, 6), radii and weights (S, 3)."""

    strain: Array
    compliance: Array
    radius: Array
    weight: Array


class Rod:
    """An arm, ready to be divided into integration steps."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        description = arm.description
        ranges, start = [], 0.0
        for index, segment in enumerate(description.segments):
            for length, rigid in ((segment.length, False), (segment.connector, True)):
                if length > 0:
                    ranges.append(RodRange(start, start + length, index, rigid))
                start += length
        self.ranges = tuple(ranges)
        self.longest = np.array(
            [STEP_LENGTH * each.outer_radius / arm.resolution for each in description.segments]
        )
        self.mass = np.array([mass_per_length(each) for each in description.segments])
        geometries = [SectionGeometry.of(each) for each in description.segments]
        self.centroid = np.array([each.centroid for each in geometries])
        sections = arm._actuation.sections
        sparsity = sections[0].compliance.sparsity()
        for section in sections[1:]:
            sparsity = sparsity + section.compliance.sparsity()
        self.step = StepFunction(
            sparsity, any(description.gravity), any(each.is_eccentric for each in geometries)
        )

    @cached_property
    def _sections(self) -> InterpretedFunction:
        p, values = self._symbols
        return InterpretedFunction(dense(ca.Function("sections", [p], [values])))

    @cached_property
    def _section_slopes(self) -> InterpretedFunction:
        p, values = self._symbols
        slopes = ca.densify(ca.jacobian(values, p))
        return InterpretedFunction(dense(ca.Function("slopes", [p], [slopes])))

    @property
    def _symbols(self) -> tuple[ca.SX, ca.SX]:
        """Pressures, and strains, compliances and radii of the segments in one column."""
        actuation = self.arm._actuation
        parts = [section.strain for section in actuation.sections]
        parts += [ca.vec(section.compliance) for section in actuation.sections]
        return actuation.pressures, ca.densify(ca.vertcat(*parts, actuation.radii))

    def sections(self, condition: Condition) -> RodSections:
        """Return the sections at a condition."""
        count = self.arm.n_segments
        values = self._sections(condition.pressures)[0][:, 0]
        return RodSections(
            values[: 6 * count].reshape(count, 6),
            values[6 * count : 42 * count].reshape(count, 6, 6),
            values[42 * count :],
            self.mass[:, np.newaxis] * condition.gravity,
        )

    def section_slopes(self, p: Array) -> tuple[Array, Array, Array]:
        """Return derivatives of strains (S, 6, n), compliances (S, 6, 6, n) and radii (S, n)."""
        count = self.arm.n_segments
        found = self._section_slopes(p)[0]
        return (
            found[: 6 * count].reshape(count, 6, -1),
            found[6 * count : 42 * count].reshape(count, 6, 6, -1),  # symmetric
            found[42 * count :],
        )

    def radius(self, index: int) -> float:
        """Return the outer radius at rest of a range, in m."""
        return self.arm.description.segments[self.ranges[index].segment].outer_radius

    def free(self, condition: Condition, mesh: RodMesh) -> RodNodes:
        """Return the nodes of the unloaded arm."""
        strain = self.sections(condition).strain[mesh.segment, 3:]
        turns = np.where(mesh.rigid[:, None], 0.0, strain * (mesh.at[:-1] - mesh.at[1:])[:, None])
        angles = np.linalg.norm(turns, axis=1)
        shares = np.sinc(angles / (2 * np.pi)) / 2
        steps = np.concatenate([np.cos(angles / 2)[:, None], shares[:, None] * turns], axis=1)
        q = [[1.0, 0.0, 0.0, 0.0]]
        for step in reversed(steps.tolist()):
            q.append(lie.quaternion_product(q[-1], step).tolist())
        return RodNodes(np.array(q[::-1]), np.zeros((len(mesh.at), 3)))

    def moved(self, mesh: RodMesh, slides: Array) -> RodMesh | None:
        """Return the mesh after contacts (k,) have moved along the arm; None if it no longer fits.

        The number of steps is kept as long as possible, so that it does not change at every
        correction.
        """
        h = mesh.at[:-1] - mesh.at[1:] + mesh.per_station @ slides
        longest = np.where(mesh.rigid, np.inf, _STRETCHED * self.longest[mesh.segment])
        if (h <= 0).any() or (h > longest).any():
            return None
        at = self.arm.length - np.concatenate([[0.0], np.cumsum(h)])
        return mesh._replace(at=at)

    def mesh(self, stations: Array) -> RodMesh:
        """Return a mesh with nodes at stations (k,)."""
        at, segment, rigid, per_station = [self.arm.length], [], [], []
        node = np.zeros(len(stations), dtype=np.int64)
        slack = 1e-12
        for each in reversed(self.ranges):
            inside = [
                j for j, s in enumerate(stations) if each.start + slack < s < each.end - slack
            ]
            inside.sort(key=lambda j: -stations[j])
            marks = [(each.end, -1), *((float(stations[j]), j) for j in inside), (each.start, -1)]
            for (far, first), (near, last) in pairwise(marks):
                longest = np.inf if each.rigid else self.longest[each.segment]
                steps = max(1, int(np.ceil((far - near) / longest - 1e-9)))
                change = np.zeros(len(stations))
                if first >= 0:
                    change[first] += 1 / steps
                if last >= 0:
                    change[last] -= 1 / steps
                at.extend(far - (far - near) * np.arange(1, steps + 1) / steps)
                segment += [each.segment] * steps
                rigid += [each.rigid] * steps
                per_station += [change] * steps
        nodes = np.array(at)
        for j, s in enumerate(stations):
            node[j] = int(np.argmin(np.abs(nodes - s)))
        return RodMesh(nodes, np.array(segment), np.array(rigid),
                    np.array(per_station).reshape(len(segment), len(stations)), node)  # fmt: skip


def interpolated(nodes: RodNodes, old: RodMesh, new: RodMesh) -> RodNodes:
    """Interpolate nodes from one mesh to another, as a start of Newton's method."""
    values = np.concatenate([nodes.quaternion, nodes.moment], axis=1)
    i = np.clip(np.searchsorted(-old.at, -new.at, side="right") - 1, 0, len(old.at) - 2)
    x = ((old.at[i] - new.at) / np.maximum(old.at[i] - old.at[i + 1], 1e-12))[:, None]
    found = (1 - x) * values[i] + x * values[i + 1]
    q = found[:, :4]
    return RodNodes(q / np.sqrt((q * q).sum(axis=1, keepdims=True)), found[:, 4:].copy())


class PointLoads(NamedTuple):
    """Forces (k, 3) on the centre line at the contacts, and moments (k, 3), in base axes."""

    force: Array
    moment: Array


class RodShape:
    """Positions, forces and moments of a rod.

    Attributes
    ----------
    h : lengths of the steps at rest, (N,), in m.
    position : of the nodes, (N + 1, 3).
    near, far : tangents (N, 3) of the centre line at starts and ends of the steps.
    force_far, moment_far : at the nodes, (N + 1, 3), on their distal sides.
    J : changes (N, 9, 10) of the steps' ends, see `stiffopt.model.contact.steps`.
    is_native : whether it was computed by machine code.
    """

    is_native = False
    mesh: RodMesh
    nodes: RodNodes
    sections: RodSections
    h: Array
    position: Array
    near: Array
    far: Array
    force_far: Array
    moment_far: Array
    J: Array

    @cached_property
    def rotation(self) -> Array:
        """Axes (N + 1, 3, 3) of the nodes."""
        return rotations(self.nodes.quaternion)

    def is_stable(self) -> bool | None:
        """Return whether it is stable under dead forces, where machine code can tell."""
        return None

    def tangent(self) -> Array | None:
        """Return changes (6 + contacts, 6) along a wrench on the tip, where machine code can.

        Of the tip's place and turn in base axes, and of the normal forces; contacts slide.
        """
        return None

    def body(self, at: Array) -> tuple[Array, Array]:
        """Return points (k, 3) of the centre line at arc lengths (k,), and radii (k,) there."""
        marks = self.mesh.at
        i = np.clip(np.searchsorted(-marks, -at, side="right") - 1, 0, len(marks) - 2)
        h = self.h[i, None]
        x = (marks[i] - at)[:, None] / h
        start, first = self.position[i], -h * self.near[i]
        end, last = self.position[i + 1], -h * self.far[i]
        way = end - start
        points = start + x * (
            first + x * (3 * way - 2 * first - last + x * (first + last - 2 * way))
        )
        return points, self.sections.radius[self.mesh.segment[i]]

    def between(self, other: "RodShape", shares: Array, at: Array) -> Array:
        """Return points (m, k, 3) of bodies at shares (m,) of the way to another shape.

        Both have the same mesh.  Without machine code, points move on straight lines.
        """
        first, last = self.body(at)[0], other.body(at)[0]
        return first + shares[:, None, None] * (last - first)


class LinearRod(RodShape):
    """The rod at a state, and its linear changes about it.

    Columns of changes are first the unknowns (turn of the tip; force, moment and station of each
    contact), then the extras: "defects", "tip wrench" or "pressures".

    Attributes
    ----------
    changes : (N + 1, 9, c) of turn, moment and force at the nodes, on their distal sides.
    moves : (N + 1, 3, c) of the positions.
    """

    def __init__(
        self, rod: Rod, condition: Condition, sections: RodSections, mesh: RodMesh, nodes: RodNodes,
        loads: PointLoads, extras: str,
    ) -> None:  # fmt: skip
        self.rod, self.mesh, self.nodes, self.sections = rod, mesh, nodes, sections
        count, k = len(mesh.segment), len(mesh.node)
        h = mesh.at[:-1] - mesh.at[1:]
        self.h = h
        n = len(condition.pressures)
        width = {"defects": 1, "tip wrench": 6, "pressures": n}[extras]
        self.unknowns = 3 + 7 * k
        self.section_slopes = (
            rod.section_slopes(condition.pressures) if extras == "pressures" else None
        )
        columns = self.unknowns + width

        # forces
        weight = sections.weight[mesh.segment]
        weight[mesh.rigid] = 0
        R0 = self.rotation[0]
        follower_force, follower_moment = R0 @ condition.follower[:3], R0 @ condition.follower[3:]
        tip_force = condition.dead[:3] + follower_force
        tip_force = tip_force + rod.arm.description.tip_mass * condition.gravity
        self.tip_moment = condition.dead[3:] + follower_moment
        jumps = np.zeros((count + 1, 3))
        twists = np.zeros((count + 1, 3))
        np.add.at(jumps, mesh.node, loads.force)
        np.add.at(twists, mesh.node, loads.moment)
        gained = np.cumsum(jumps, axis=0)
        carried = np.concatenate([np.zeros((1, 3)), np.cumsum(weight * h[:, None], axis=0)])
        self.force_near = tip_force + gained + carried
        self.force_far = self.force_near - jumps
        moment_far = nodes.moment.copy()
        moment_far[0] = self.tip_moment
        self.moment_far = moment_far
        moment_near = moment_far + twists

        # steps
        end, J, near, far = self._steps(moment_near, weight)
        self.J = J
        way = end[:, 4:7]
        position = np.zeros((count + 1, 3))
        position[:-1] = -np.cumsum(way[::-1], axis=0)[::-1]
        self.position = position
        self.near, self.far = near, far

        # changes
        X = np.zeros((9, columns))
        X[TURN, :3] = np.eye(3)
        X[FORCE, :3] = -hat(follower_force)
        X[MOMENT, :3] = -hat(follower_moment)
        defects = np.zeros((count, 9, width))
        if extras == "defects":
            turn = turns_between(nodes.quaternion[1:], end[:, :4])
            defects[:, :3, 0] = turn
            defects[:, 6:, 0] = end[:, 7:] - nodes.moment[1:]
        elif extras == "tip wrench":
            X[FORCE, self.unknowns : self.unknowns + 3] = np.eye(3)
            X[MOMENT, self.unknowns + 3 :] = np.eye(3)
        else:
            defects = self._per_pressure(condition, moment_near, weight)
        touched: dict[int, list[int]] = {}
        for j in range(k):
            touched.setdefault(int(mesh.node[j]), []).append(j)
        self.changes = np.empty((count + 1, 9, columns))
        ways = np.empty((count, 3, columns))
        identity = np.eye(3)
        for i in range(count):
            self.changes[i] = X
            if i in touched:
                X = X.copy()
                for j in touched[i]:
                    first = 3 + 7 * j
                    X[FORCE, first : first + 3] += identity
                    X[MOMENT, first + 3 : first + 6] += identity
            Y = J[i, :, :9] @ X
            for j in np.flatnonzero(mesh.per_station[i]).tolist():
                share = mesh.per_station[i, j]
                Y[:, 9 + 7 * j] += share * J[i, :, 9]
            Y[:, self.unknowns :] += defects[i]
            ways[i] = Y[3:6]
            N = X[FORCE]
            if k and weight[i].any():
                N = N.copy()
                for j in np.flatnonzero(mesh.per_station[i]).tolist():
                    N[:, 9 + 7 * j] += mesh.per_station[i, j] * weight[i]
            X = np.concatenate([Y[:3], Y[6:], N])
        self.changes[count] = X
        self.moves = np.zeros((count + 1, 3, columns))
        self.moves[:-1] = -np.cumsum(ways[::-1], axis=0)[::-1]

    def _steps(self, moment: Array, weight: Array) -> tuple[Array, Array, Array, Array]:
        """Return ends (N, 10), their changes (N, 9, 10), and tangents (N, 3) at starts and ends."""
        mesh, sections, q = self.mesh, self.sections, self.nodes.quaternion[:-1]
        count = len(mesh.segment)
        soft = ~mesh.rigid
        force = self.force_near[:-1]
        s = mesh.segment
        arguments = (q, moment[:-1], force, sections.strain[s], sections.compliance[s],
                     self.rod.centroid[s], weight, self.h[:, None])  # fmt: skip
        if soft.all():
            end, tangents, J = self.rod.step(*arguments)
            return end[..., 0], J, tangents[..., 0], tangents[..., 1]
        end, J, tangents = np.zeros((count, 10)), np.zeros((count, 9, 10)), np.zeros((count, 3, 2))
        found, tangents[soft], J[soft] = self.rod.step(*(each[soft] for each in arguments))
        end[soft] = found[..., 0]
        for i in np.flatnonzero(mesh.rigid):
            axis, length, n = self.rotation[i][:, 2], self.h[i], force[i]
            end[i] = [*q[i], *(-length * axis), *(moment[i] + length * np.cross(axis, n))]
            tangents[i] = axis[:, None]
            J[i, :3, :3] = J[i, 6:, 3:6] = np.eye(3)
            J[i, 3:6, :3] = length * hat(axis)
            J[i, 6:, :3] = length * hat(n) @ hat(axis)
            J[i, 6:, 6:9] = length * hat(axis)
            J[i, 3:6, 9] = -axis
            J[i, 6:, 9] = np.cross(axis, n)
        return end, J, tangents[..., 0], tangents[..., 1]

    def tangent_change(
        self, j: int, loads: PointLoads, segment: int, rigid: bool
    ) -> tuple[Array, Array]:
        """Return the mean (3,) of the tangents on both sides of a contact, and its change (3, c).

        Shear causes a kink of the centre line at a point force; the force does no work on a motion
        along the mean of both tangents.
        """
        node = self.mesh.node[j]
        R, X = self.rotation[node], self.changes[node]
        if rigid:
            axis = R[:, 2]
            return axis, -hat(axis) @ X[TURN]
        C, strain = self.sections.compliance[segment], self.sections.strain[segment]
        n = self.force_far[node] + loads.force[j] / 2
        m = self.moment_far[node] + loads.moment[j] / 2
        own = R @ C[:3, :3] @ R.T
        crossed = R @ C[:3, 3:] @ R.T
        mean = R @ strain[:3] + own @ n + crossed @ m
        dn, dm = X[FORCE].copy(), X[MOMENT].copy()
        first = 3 + 7 * j
        dn[:, first : first + 3] += np.eye(3) / 2
        dm[:, first + 3 : first + 6] += np.eye(3) / 2
        turned = -hat(mean) + own @ hat(n) + crossed @ hat(m)
        change = turned @ X[TURN] + own @ dn + crossed @ dm
        if self.section_slopes is not None:
            strains, compliances, _ = self.section_slopes
            wrench = np.concatenate([R.T @ n, R.T @ m])
            by_section = strains[segment, :3] + np.einsum(
                "ijp,j->ip", compliances[segment, :3], wrench
            )
            change[:, self.unknowns :] += R @ by_section
        return mean, change

    def bending(self, j: int, loads: PointLoads, segment: int) -> Array:
        """Return the turn (3,) of the section per arc length at a contact, in base axes."""
        node = self.mesh.node[j]
        R, C = self.rotation[node], self.sections.compliance[segment]
        n = self.force_far[node] + loads.force[j] / 2
        wrench = np.concatenate([R.T @ n, R.T @ self.moment_far[node]])
        return R @ (self.sections.strain[segment] + C @ wrench)[3:]

    def _per_pressure(self, condition: Condition, moment: Array, weight: Array) -> Array:
        """Return changes (N, 9, n) of the steps' ends by pressures, by finite differences."""
        assert self.section_slopes is not None
        strain, compliance, _ = self.section_slopes
        soft = np.flatnonzero(~self.mesh.rigid)
        s = self.mesh.segment[soft]
        found = np.zeros((len(self.mesh.segment), 9, len(condition.pressures)))
        q = self.nodes.quaternion[:-1][soft]
        for k in range(len(condition.pressures)):
            own = np.abs(strain[:, :, k]).sum(1) + np.abs(compliance[:, :, :, k]).sum((1, 2)) > 0
            rows = own[s]
            if not rows.any():
                continue
            ends = []
            step = 10.0  # Pa
            for sign in (1, -1):
                end, _, _ = self.rod.step(
                    q[rows], moment[:-1][soft][rows], self.force_near[:-1][soft][rows],
                    (self.sections.strain + sign * step * strain[:, :, k])[s[rows]],
                    (self.sections.compliance + sign * step * compliance[..., k])[s[rows]],
                    self.rod.centroid[s[rows]], weight[soft][rows], self.h[soft][rows][:, None],
                )  # fmt: skip
                ends.append(end[..., 0])
            found[soft[rows], :3, k] = turns_between(ends[1][:, :4], ends[0][:, :4]) / (2 * step)
            found[soft[rows], 3:, k] = (ends[0] - ends[1])[:, 4:] / (2 * step)
        return found


# -- small algebra --------------------------------------------------------------------------------


def hat(v: Array) -> Array:
    """Return the skew matrix of a vector (3,)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def rotations(q: Array) -> Array:
    """Return the rotations (k, 3, 3) of quaternions (k, 4) of any length."""
    w, x, y, z = q.T / np.linalg.norm(q, axis=1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def turns_between(first: Array, second: Array) -> Array:
    """Return rotation vectors (k, 3), in base axes, between nearby quaternions (k, 4)."""
    w, v = first[:, :1], first[:, 1:]
    a, b = second[:, :1], second[:, 1:]
    real = (a * w)[:, 0] + (b * v).sum(1)
    imaginary = w * b - a * v - np.cross(b, v)
    return 2 * imaginary / real[:, None]


def turned(q: Array, turn: Array) -> Array:
    """Return unit quaternions (k, 4) turned by rotation vectors (k, 3) in base axes."""
    half = turn / 2
    w, v = q[:, :1], q[:, 1:]
    real = w[:, 0] - (half * v).sum(1)
    found = np.concatenate([real[:, None], v + w * half + np.cross(half, v)], axis=1)
    return found / np.linalg.norm(found, axis=1, keepdims=True)
