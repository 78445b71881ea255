"""The equations of an arm in contact with surfaces, linearised about a state."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.contact.rod import (
    TURN,
    Condition,
    LinearRod,
    PointLoads,
    RodMesh,
    RodNodes,
    RodSections,
    RodShape,
    hat,
)
from stiffopt.model.contact.stability import is_stable
from stiffopt.model.contact.surface import SurfacePoint

if TYPE_CHECKING:
    from stiffopt.model.contact.solve import ContactProblem


LEAST_COMPLIANCE = 1e-3  # allowed below zero, as a share of the largest: that of contacts on lines
_FLATTEST = 1e-3  # 1/m; with less, a contact's place is undetermined
_LEAST_SLOPE = 1e-9  # of the gap; with less, a pinned contact stays where it is
_LIGHT = 1e-5  # N; a contact with less force is a point
_FLAT = 0.5  # 1/m, least second derivative of a gap in the estimate of a contact's length


@dataclass(frozen=True)
class Touch:
    """A contact while it is solved for.

    Attributes
    ----------
    surface : index of the surface.
    range : index of the rod's range on which it lies.
    station : arc length at rest, in m.
    pinned : whether it stays there: at the tip, or where two segments meet.
    force : on the arm (3,), in N.
    normal_force : in N.
    drag : friction's force (3,) per normal force, for a sliding contact.
    moment : on the centre line (3,), in N m, of a force that a sticking contact has at the surface.
    crossings : how often it moved from one range to the next during the search.
    line : whether it is one of the pinned contacts of a line along which the body lies.
    """

    surface: int
    range: int
    station: float
    pinned: bool
    force: Array
    normal_force: float
    drag: Array
    moment: Array = field(default_factory=lambda: np.zeros(3))
    crossings: int = 0
    line: bool = False


class Contacts(NamedTuple):
    """A state with its contacts: an equilibrium, or a guess of one."""

    condition: Condition
    mesh: RodMesh
    nodes: RodNodes
    touches: tuple[Touch, ...]


@dataclass(frozen=True)
class ContactRow:
    """Quantities of a contact in the equations."""

    point: SurfacePoint
    radius: float
    gap: float
    mean: Array
    slope: float


class LeaningArm:
    """An arm in contact: its state and shape, and quantities of its contacts.

    Attributes
    ----------
    rows : of each contact.
    """

    def __init__(
        self,
        problem: ContactProblem,
        state: Contacts,
        shape: RodShape,
        rows: list[ContactRow],
    ) -> None:
        self.problem, self.state, self.shape, self.rows = problem, state, shape, rows
        self._pushed: dict[tuple[int, ...], tuple[ContactSystem, Array]] = {}

    @cached_property
    def is_stable(self) -> bool:
        """Whether the energy is at a minimum, see `stiffopt.model.contact.stability`."""
        conservative = self.state.condition.is_conservative
        quickly = self.shape.is_stable() if conservative else None
        if not (is_stable(self) if quickly is None else quickly):
            return False
        if not conservative or not self._is_flat:
            return True
        C = self.tangent[:3, :3]
        values = np.linalg.eigvalsh((C + C.T) / 2)
        return bool(values[0] > -LEAST_COMPLIANCE * values[-1])

    @property
    def _is_flat(self) -> bool:
        """True if a contact's place along the arm is nearly undetermined.

        The matrix of `stiffopt.model.contact.stability` is then too coarse to tell alone.
        """
        touches = enumerate(self.state.touches)
        return any(self.bend(j) < 2 * _FLAT for j, touch in touches if not touch.pinned)

    @cached_property
    def tangent(self) -> Array:
        """Changes (6 + contacts, 6) along a wrench on the tip while contacts slide.

        Of the tip's place and turn and of the normal forces; all in base axes.
        """
        quickly = self.shape.tangent()
        if quickly is not None:
            return quickly
        system, solution = self.pushed(())
        return system.of_tip(solution)

    def pushed(self, sticking: Collection[int]) -> tuple[ContactSystem, Array]:
        """Return the equations for a wrench on the tip, and their solution (u, 6).

        The contacts `sticking` roll without slipping. They are the same for all directions of a
        push, so they are kept.
        """
        key = tuple(sticking)
        if key not in self._pushed:
            system = ContactSystem(self.problem, self.state, self.shape.sections, "tip wrench", key)
            self._pushed[key] = system, system.solution()
        return self._pushed[key]

    @cached_property
    def body(self) -> tuple[Array, Array]:
        """Points (k, 3) and radii (k,) of the body at the problem's stations, in m."""
        return self.shape.body(self.problem.stations)

    @cached_property
    def gaps(self) -> Array:
        """Gaps of the surfaces (surfaces, k) at these stations, in m."""
        return self.problem.gaps(*self.body) + self.state.condition.retreat[:, None]

    def bend(self, j: int) -> float:
        """Return the second derivative of the gap along the arm at a contact, in 1/m."""
        shape, touch, row = self.shape, self.state.touches[j], self.rows[j]
        here, n, t = self.problem.rod.ranges[touch.range], row.point.normal, row.mean
        own = float(t @ row.point.curvature @ t)
        if here.rigid:
            return own
        node = self.state.mesh.node[j]
        R, C = shape.rotation[node], shape.sections.compliance[here.segment]
        force = R.T @ (shape.force_far[node] + touch.force / 2)
        moment = R.T @ shape.moment_far[node]
        xi = shape.sections.strain[here.segment] + C @ np.concatenate([force, moment])
        v, u = xi[:3], xi[3:]
        weight = R.T @ shape.sections.weight[here.segment]  # reduces the force towards the tip
        slope = np.concatenate(
            [-np.cross(u, force) - weight, -np.cross(v, force) - np.cross(u, moment)]
        )
        return own + float(n @ R @ (np.cross(u, v) + C[:3] @ slope))

    def sag(self, j: int) -> float:
        """Return the part in 1/m of `bend` that is the shear by the arm's own weight."""
        segment = self.problem.rod.ranges[self.state.touches[j].range].segment
        sections, R = self.shape.sections, self.shape.rotation[self.state.mesh.node[j]]
        weight = R.T @ sections.weight[segment]
        n = self.rows[j].point.normal
        return max(0.0, -float(n @ R @ sections.compliance[segment, :3, :3] @ weight))

    def kink(self, j: int) -> tuple[float, float]:
        """Return depth and length, in m, of the centre line's kink at a point force.

        Shear bends the line into the surface on both sides of the force.  In reality the
        force is distributed over this length, along which the line follows the surface.
        """
        if self.problem.rod.ranges[self.state.touches[j].range].rigid:
            return 0.0, 0.0
        shear = self.shear(j)
        bend = max(self.bend(j), _FLAT)
        return shear**2 / (8 * bend), shear / bend

    def reach(self, j: int) -> float:
        """Return the length in m along which the body really lies on a surface at a contact."""
        bend, touch = self.bend(j), self.state.touches[j]
        if touch.normal_force < _LIGHT:
            return 0.0
        if bend < _FLATTEST:
            return np.inf
        return 0.0 if self.problem.rod.ranges[touch.range].rigid else self.shear(j) / bend

    def is_let_go(self, j: int) -> bool:
        """Return whether a contact at an end of its range would slide into the range."""
        touch = self.state.touches[j]
        here = self.problem.rod.ranges[touch.range]
        up = touch.station > (here.start + here.end) / 2
        return (self.rows[j].slope if up else -self.rows[j].slope) > _LEAST_SLOPE

    def shear(self, j: int) -> float:
        """Return the angle of the centre line's kink at a contact on a soft range."""
        touch, shape = self.state.touches[j], self.shape
        d = shape.rotation[self.state.mesh.node[j]].T @ self.rows[j].point.normal
        C = shape.sections.compliance[self.problem.rod.ranges[touch.range].segment]
        return touch.normal_force * float(d @ C[:3, :3] @ d)


class ContactSystem(LeaningArm):
    """The linear equations about a state: of the rod and of its contacts.

    The unknowns are those of `LinearRod` and the normal forces.

    Parameters
    ----------
    sticking : contacts that roll without slipping, as those with friction do at first; the others
        slide.

    Attributes
    ----------
    matrix, right : of the equations, (u, u) and (u, e) for each extra.
    """

    def __init__(
        self,
        problem: ContactProblem,
        state: Contacts,
        sections: RodSections,
        extras: str = "defects",
        sticking: Collection[int] = (),
    ) -> None:
        touches, k = state.touches, len(state.touches)
        forces = np.array([touch.force for touch in touches]).reshape(k, 3)
        moments = np.array([touch.moment for touch in touches]).reshape(k, 3)
        self.loads = PointLoads(forces, moments)
        self.linear = linear = LinearRod(
            problem.rod, state.condition, sections, state.mesh, state.nodes, self.loads, extras
        )
        u = linear.unknowns
        size, width = u + k, linear.changes.shape[2] - u
        self._seeks, self.sticking = extras == "defects", sticking
        self.matrix, self.right = np.zeros((size, size)), np.zeros((size, width))
        super().__init__(problem, state, linear, [])
        changes = []
        for j in range(k):
            row, change = self._row(j)
            self.rows.append(row)
            changes.append(change)
        self._require(slice(0, 3), linear.changes[-1, TURN])
        for j, (touch, row) in enumerate(zip(touches, self.rows, strict=True)):
            surface = problem.surfaces[touch.surface]
            node, first = int(state.mesh.node[j]), 3 + 7 * j
            n, H = row.point.normal, row.point.curvature
            dc = linear.moves[node]
            force, moment = slice(first, first + 3), slice(first + 3, first + 6)
            self._require(force, -touch.normal_force * H @ dc)
            self.matrix[force, force] += np.eye(3)
            self.matrix[force, u + j] = -(n + touch.drag)
            self.matrix[moment, moment] = np.eye(3)
            if touch.pinned:
                self.matrix[first + 6, first + 6] = 1
            else:
                self._require(first + 6, row.mean @ H @ dc + n @ changes[j])
            self._require(u + j, n @ dc)
            self.matrix[u + j, u + j] = surface.softness
            if linear.section_slopes is not None:
                here = problem.rod.ranges[touch.range]
                self.right[u + j] += linear.section_slopes[2][here.segment]
            if self._seeks:
                self.right[force, 0] += touch.normal_force * (n + touch.drag) - touch.force
                self.right[moment, 0] -= touch.moment
                self.right[first + 6, 0] -= 0 if touch.pinned else row.slope
                self.right[u + j, 0] -= row.gap
            if j in sticking:
                self._stick(j)

    def _row(self, j: int) -> tuple[ContactRow, Array]:
        """Return a contact's quantities, and the change (3, c) of the mean tangent."""
        state, linear = self.state, self.linear
        touch = state.touches[j]
        here, surface = self.problem.rod.ranges[touch.range], self.problem.surfaces[touch.surface]
        point = surface.at(linear.position[state.mesh.node[j]])
        mean, change = linear.tangent_change(j, self.loads, here.segment, here.rigid)
        radius = float(linear.sections.radius[here.segment])
        gap = point.distance - radius + float(state.condition.retreat[touch.surface])
        gap += surface.softness * touch.normal_force
        return ContactRow(point, radius, gap, mean, float(point.normal @ mean)), change

    def _require(self, at: Any, change: Array) -> None:
        """Add equations that a change (..., c) is zero."""
        u = self.linear.unknowns
        self.matrix[at, :u] = change[..., :u]
        self.right[at] = -change[..., u:]

    def _stick(self, j: int) -> None:
        """Replace the equations of a contact by those of a body point that does not slip."""
        linear, touch, row = self.linear, self.state.touches[j], self.rows[j]
        node, first, u = int(self.state.mesh.node[j]), 3 + 7 * j, linear.unknowns
        here = self.problem.rod.ranges[touch.range]
        n, H, lever = row.point.normal, row.point.curvature, -row.radius * row.point.normal
        dc, turn = linear.moves[node].copy(), linear.changes[node, TURN].copy()
        # changes of the material section, along which the station moves
        bending = np.zeros(3) if here.rigid else linear.bending(j, self.loads, here.segment)
        dc[:, first + 6] -= row.mean
        turn[:, first + 6] -= bending
        slip = dc - hat(lever) @ turn
        across = np.linalg.svd(n[None])[2][1:]
        force, moment = slice(first, first + 3), slice(first + 3, first + 6)
        self.matrix[force], self.matrix[moment] = 0, 0
        self.right[force], self.right[moment] = 0, 0
        # the normal force is the component along the normal, which turns
        along = touch.force @ H @ linear.moves[node]
        self._require(first, along)
        self.matrix[first, force] += n
        self.matrix[first, u + j] = -1
        self._require(slice(first + 1, first + 3), across @ slip)
        # the force acts at the surface
        turning = -row.radius * hat(touch.force) @ H @ linear.moves[node]
        self._require(moment, turning)
        self.matrix[moment, moment] += np.eye(3)
        self.matrix[moment, force] -= hat(lever)
        if self._seeks:
            self.right[first, 0] += touch.normal_force - n @ touch.force
            self.right[moment, 0] += np.cross(lever, touch.force) - touch.moment

    def solution(self) -> Array:
        """Return the unknowns (u, e) for each extra."""
        return np.asarray(np.linalg.solve(self.matrix, self.right))

    def of_tip(self, solution: Array) -> Array:
        """Return the changes (6 + contacts, e) of the tip's place and turn and normal forces."""
        changes, moves = self.along(solution)
        return np.concatenate([moves[0], changes[0, TURN], solution[self.linear.unknowns :]])

    def along(self, solution: Array) -> tuple[Array, Array]:
        """Return changes (N + 1, 9, e) and moves (N + 1, 3, e) of the nodes."""
        linear, u = self.linear, self.linear.unknowns
        found = linear.changes[:, :, :u] @ solution[:u] + linear.changes[:, :, u:]
        moves = linear.moves[:, :, :u] @ solution[:u] + linear.moves[:, :, u:]
        return found, moves
