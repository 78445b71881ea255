"""`ContactProblem`: equilibria of an arm among surfaces, by an active set and continuation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.contact.native import CONVERGED, LOST, MOST_CONTACTS, NativeContacts
from stiffopt.model.contact.rod import (
    MOMENT,
    TURN,
    Condition,
    Rod,
    RodMesh,
    RodNodes,
    RodSections,
    interpolated,
    turned,
)
from stiffopt.model.contact.surface import ContactSurface
from stiffopt.model.contact.system import Contacts, ContactSystem, LeaningArm, Touch

Vector = NDArray[np.float64]

_LARGEST_TURN = 0.5  # rad, largest turn of a part of the arm in one correction
_LARGEST_SLIDE = 0.02  # m, largest motion of a contact along the arm in one correction
_TURN_LEFT, _SLIDE_LEFT = 1e-6, 1e-7  # rad and m; quadratic convergence: the error is 1e-12
_MAX_ITERATIONS = 14
_MAX_MESHES = 8  # rebuilt as contacts move from range to range
_MAX_SETS = 10  # sets of contacts that are tried in a step
_DEEPEST = 0.3  # largest penetration of a surface in a step, over the body's radius
_ENTERED = 2e-3  # m, wanted penetration after a step that went too deep
_TILT = 0.5  # rad, largest turn of a contact's normal in a step
_PENETRATION = 2e-6  # m, allowed penetration
_SPACING = 4e-3  # m along the arm between stations at which gaps are evaluated
_FINE_STATIONS = 17  # stations about a local minimum of a gap
_SEEN_FROM = 2e-4  # m; a larger gap at a coarse minimum excludes a contact
_SWEPT = 1.0  # motion of a station in a step that is always allowed, over the body's radius
_AS_NEAR = 1e-5  # m, allowed penetration next to a contact
_BESIDE = 1e-3  # m along the arm, least neighbourhood of a contact
_SAME_CONTACT = 2e-4  # m; closer contacts on a surface are merged
_INSET = 1e-5  # m, least distance of a contact from the end of a range
_MAX_CROSSINGS = 3  # of an end of a range, after which a contact is pinned there
_APART = 1e-4  # m between an arm and surfaces that are moved back from it
_SHORTEST_STEP = 1e-4  # share of the path from rest; below it the path has ended


class ContactProblem:
    """An arm among surfaces."""

    def __init__(self, rod: Rod, surfaces: tuple[ContactSurface, ...]) -> None:
        self.rod, self.surfaces = rod, surfaces
        self._in_c: NativeContacts | None = None
        self._deepest: tuple[int, float] | None = None  # surface and gap of a step that failed
        count = int(np.ceil(rod.arm.length / _SPACING))
        self.stations = np.linspace(0.0, rod.arm.length, count + 1)

    # -- Newton's method --------------------------------------------------------------------

    def correct(self, state: Contacts) -> LeaningArm | None:
        """Find the equilibrium in which exactly the given contacts are closed; None if not near."""
        sections = self.rod.sections(state.condition)
        native = self._native
        if native is not None and len(state.touches) <= MOST_CONTACTS:
            return self._correct_in_c(native, state, sections)
        previous = np.inf
        for iteration in range(_MAX_ITERATIONS):
            system = ContactSystem(self, state, sections)
            try:
                solution = system.solution()
            except np.linalg.LinAlgError:
                return None
            changes, _ = system.along(solution)
            turns = changes[:, TURN, 0]
            size = float(np.sqrt((turns**2).sum(axis=1).max()))
            if not size <= _LARGEST_TURN or (iteration > 3 and size > previous):  # NaN too
                return None
            q = turned(state.nodes.quaternion, turns)
            nodes = RodNodes(q, state.nodes.moment + changes[:, MOMENT, 0])
            touches, slide = self._moved(state, system, solution[:, 0])
            is_same = _is_same(touches, state.touches)
            before, stations = (
                np.array([t.station for t in each]) for each in (state.touches, touches)
            )
            mesh = self.rod.moved(state.mesh, stations - before) if is_same else None
            if mesh is None:
                mesh = self.rod.mesh(stations)
                nodes = interpolated(nodes, _at_moved(state, touches), mesh)
                previous = np.inf
            else:
                previous = max(size, _TURN_LEFT)
            state = Contacts(state.condition, mesh, nodes, touches)
            if is_same and size < _TURN_LEFT and slide < _SLIDE_LEFT:
                system.state = state
                return system
        return None

    @property
    def _native(self) -> NativeContacts | None:
        """Newton's method in C, if there is machine code and every surface has a formula."""
        if self._in_c is None and not any(each.is_interpolated for each in self.surfaces):
            code = self.rod.step.code
            self._in_c = None if code is None else NativeContacts(code, self.rod, self.surfaces)
        return self._in_c

    def _correct_in_c(
        self, native: NativeContacts, state: Contacts, sections: RodSections
    ) -> LeaningArm | None:
        for _ in range(_MAX_MESHES):
            outcome, moved, shape, rows, stable = native.correct(state, sections)
            if outcome == CONVERGED:
                found = LeaningArm(self, moved, shape, rows)
                found.minimum = stable if state.condition.is_conservative else None
                return found
            if outcome == LOST:
                return None
            touches = tuple(each if each.pinned else self._within(each) for each in moved.touches)
            mesh = self.rod.mesh(np.array([touch.station for touch in touches]))
            nodes = interpolated(moved.nodes, _at_moved(moved, touches), mesh)
            state = Contacts(state.condition, mesh, nodes, touches)
        return None

    def _moved(
        self, state: Contacts, system: ContactSystem, solution: Vector
    ) -> tuple[tuple[Touch, ...], float]:
        """Return the contacts after a correction, and how far along the arm they should move."""
        u = system.linear.unknowns
        touches, slides = [], [0.0]
        for j, touch in enumerate(state.touches):
            first = 3 + 7 * j
            slides.append(float(np.clip(solution[first + 6], -_LARGEST_SLIDE, _LARGEST_SLIDE)))
            moved = replace(
                touch,
                force=touch.force + solution[first : first + 3],
                normal_force=touch.normal_force + float(solution[u + j]),
                station=touch.station + slides[-1],
            )
            touches.append(moved if touch.pinned else self._within(moved))
        return tuple(touches), float(np.abs(slides).max())

    def _within(self, touch: Touch) -> Touch:
        """Return a contact in the range that it has reached, or pinned at an end of its own."""
        ranges = self.rod.ranges
        here = ranges[touch.range]
        if here.start < touch.station < here.end:
            return touch
        up = touch.station >= here.end
        edge = here.end if up else here.start
        other = touch.range + (1 if up else -1)
        if other < 0:
            return replace(touch, station=here.start + _INSET)
        if other == len(ranges):
            return replace(touch, station=edge, pinned=True)
        radii = [self.rod.radius(index) for index in (touch.range, other)]
        if touch.crossings >= _MAX_CROSSINGS or radii[1] < radii[0] - 1e-9:
            return replace(touch, station=edge, pinned=True)
        station = edge + (_INSET if up else -_INSET)
        return replace(touch, range=other, station=station, crossings=touch.crossings + 1)

    # -- active set -------------------------------------------------------------------------

    def settle(self, state: Contacts) -> LeaningArm | None:
        """Find the equilibrium near a state, with the set of contacts that is consistent.

        No contact pulls and none is missing.  None if it is not near.
        """
        touches = tuple(replace(touch, crossings=0) for touch in state.touches)
        start = state = state._replace(touches=touches)
        for _ in range(_MAX_SETS):
            found = self.correct(state)
            if found is None or self.is_far(start, found):
                return None
            changed = self._changed(found)
            if changed is None:
                missed = self.missed(found)
                if missed is None:
                    return None
                if not missed:
                    return found
                changed = (*found.state.touches, *missed)
            state = self.with_touches(found.state, changed)
        return None

    def is_far(self, start: Contacts, arm: LeaningArm) -> bool:
        """Return whether the normal of a contact has turned too much for a step."""
        for old, new, row in zip(start.touches, arm.state.touches, arm.rows, strict=False):
            if old.surface != new.surface:
                return False  # another set of contacts; those before were checked
            size = float(np.linalg.norm(old.force))
            if size > 1e-6 and old.force @ row.point.normal < np.cos(_TILT) * size:
                return True
        return False

    def with_touches(self, state: Contacts, touches: tuple[Touch, ...]) -> Contacts:
        """Return a state with other contacts, to start from."""
        mesh = self.rod.mesh(np.array([touch.station for touch in touches]))
        return Contacts(state.condition, mesh, interpolated(state.nodes, state.mesh, mesh), touches)

    def _changed(self, arm: LeaningArm) -> tuple[Touch, ...] | None:
        """Return the contacts without the strongest pulling one, or with one freed or merged."""
        touches = list(arm.state.touches)
        pull = [touch.normal_force for touch in touches]
        if touches and min(pull) < 0:
            del touches[pull.index(min(pull))]
            return tuple(touches)
        for j, (touch, row) in enumerate(zip(touches, arm.rows, strict=True)):
            here = self.rod.ranges[touch.range]
            up = touch.station > (here.start + here.end) / 2
            inwards = row.slope if up else -row.slope
            if touch.pinned and touch.crossings < _MAX_CROSSINGS and inwards > 1e-9:
                station = here.end - 1e-4 if up else here.start + 1e-4
                crossings = touch.crossings + 1
                touches[j] = replace(touch, station=station, pinned=False, crossings=crossings)
                return tuple(touches)
            for i, other in enumerate(touches[:j]):
                near = abs(touch.station - other.station) < _SAME_CONTACT
                if near and touch.surface == other.surface:
                    force = touch.force + other.force
                    normal_force = touch.normal_force + other.normal_force
                    touches[i] = replace(other, force=force, normal_force=normal_force)
                    del touches[j]
                    return tuple(touches)
        return None

    def missed(self, arm: LeaningArm) -> list[Touch] | None:
        """Return open contacts that should be closed; None if a surface is entered too deeply."""
        found = []
        arm.gaps = self.gaps(arm, self.stations) + arm.state.condition.retreat[:, None]
        for index, gaps in enumerate(arm.gaps):
            if gaps.min() > _SEEN_FROM:
                continue
            own = [j for j, touch in enumerate(arm.state.touches) if touch.surface == index]
            for i in dips(gaps):
                if gaps[i] > _SEEN_FROM:
                    continue
                ends = self.stations[[i - 1, min(i + 1, len(gaps) - 1)]]
                around = np.linspace(ends[0], ends[1], _FINE_STATIONS)
                closely = self.gaps(arm, around, index)[0] + arm.state.condition.retreat[index]
                s, gap = float(around[closely.argmin()]), float(closely.min())
                if gap > -_PENETRATION or any(self._is_of(arm, j, s, gap) for j in own):
                    continue
                if gap < -_DEEPEST * arm.shape.sections.radius.min():
                    self._deepest = (index, gap)
                    return None
                found.append(self._touch(index, s))
        return found

    def _is_of(self, arm: LeaningArm, j: int, s: float, gap: float) -> bool:
        """Return whether a penetration belongs to a contact that is closed."""
        touch = arm.state.touches[j]
        if abs(s - touch.station) < _BESIDE and gap > -_AS_NEAR:
            return True
        depth, reach = arm.kink(j)
        allowed = 2 * depth + _AS_NEAR
        allowed += self.surfaces[touch.surface].softness * touch.normal_force
        return abs(s - touch.station) < 1.5 * reach + _BESIDE and gap > -allowed

    def _touch(self, surface: int, s: float) -> Touch:
        """Return an open contact at an arc length."""
        index = next(i for i, each in enumerate(self.rod.ranges) if s <= each.end + _INSET)
        here, length = self.rod.ranges[index], self.rod.arm.length
        pinned = s >= length - 1e-6
        inside = min(max(s, here.start + _INSET), here.end - _INSET)
        none = np.zeros(3)
        return Touch(surface, index, length if pinned else inside, pinned, none, 0.0, none)

    def gaps(self, arm: LeaningArm, at: Vector, only: int | None = None) -> Vector:
        """Return gaps (surfaces, k) of all surfaces or of one at arc lengths (k,), in m."""
        points, radii = self.body(arm, at)
        code = None if self._native is None else self._native.code
        found = []
        for surface in self.surfaces if only is None else self.surfaces[only : only + 1]:
            own = surface.distances(points, code) - radii
            own[at < surface.begin] = np.inf
            found.append(own)
        return np.array(found).reshape(len(found), len(at))

    def body(self, system: LeaningArm, at: Vector) -> tuple[Vector, Vector]:
        """Return points (k, 3) of the centre line at arc lengths (k,), and radii (k,) there."""
        shape, marks = system.shape, system.shape.mesh.at
        i = np.clip(np.searchsorted(-marks, -at, side="right") - 1, 0, len(marks) - 2)
        h = shape.h[i, None]
        x = (marks[i] - at)[:, None] / h
        start, first = shape.position[i], -h * shape.near[i]
        end, last = shape.position[i + 1], -h * shape.far[i]
        way = end - start
        points = start + x * (
            first + x * (3 * way - 2 * first - last + x * (first + last - 2 * way))
        )
        return points, shape.sections.radius[shape.mesh.segment[i]]

    # -- continuation -----------------------------------------------------------------------

    def follow(self, start: LeaningArm, end: Condition) -> tuple[LeaningArm, float]:
        """Follow the equilibrium straight to a condition; return the last and its share."""
        arm, share, step, halved = start, 0.0, 1.0, False
        while share < 1.0:
            target = min(1.0, share + step)
            condition = start.state.condition.towards(end, target)
            self._deepest = None
            found = self.settle(self._guess(arm.state, condition))
            if found is None or self._leaves(arm, found):
                step = (target - share) * (0.5 if found else self._share_to_touch(arm))
                halved = True
                if step < _SHORTEST_STEP:
                    break
                continue
            arm, share = found, target
            step, halved = (step if halved else 2 * step), False
        return arm, share

    def _share_to_touch(self, arm: LeaningArm) -> float:
        """Return the share of a failed step to try next: half, or up to a light touch."""
        if self._deepest is None:
            return 0.5
        index, gap = self._deepest
        before = float(arm.gaps[index].min())
        return float(np.clip((before + _ENTERED) / (before - gap), 0.1, 0.9))

    def _leaves(self, before: LeaningArm, after: LeaningArm) -> bool:
        """Return whether stability is lost, or the body may have passed through a surface."""
        if not after.is_stable:
            return True
        if not self.surfaces:
            return False
        (old, radii), (new, _) = (self.body(each, self.stations) for each in (before, after))
        ways = np.linalg.norm(new - old, axis=1)
        # gaps change by no more than the path, which is nearly straight
        least = (before.gaps + after.gaps - 1.05 * ways) / 2
        least[:, ways < _SWEPT * radii] = np.inf
        least[[touch.surface for touch in before.state.touches]] = np.inf
        return bool((least < -_DEEPEST * radii).any())

    def _guess(self, state: Contacts, condition: Condition) -> Contacts:
        """Return a state to start from at a condition."""
        loaded = (condition.dead, condition.follower, condition.gravity, state.nodes.moment)
        if state.touches or any(each.any() for each in loaded):
            return state._replace(condition=condition)
        return Contacts(condition, state.mesh, self.rod.free(condition, state.mesh), ())

    def straight(self, like: Condition) -> LeaningArm:
        """Return the unpressurised arm without weight, clear of all surfaces."""
        mesh = self.rod.mesh(np.zeros(0))
        q = np.tile([1.0, 0.0, 0.0, 0.0], (len(mesh.at), 1))
        zero = Condition(*(np.zeros_like(each) for each in like))
        nodes = RodNodes(q, np.zeros((len(mesh.at), 3)))
        found = self.correct(Contacts(zero, mesh, nodes, ()))
        assert found is not None  # the state is already an equilibrium
        return self.clear(found)

    def clear(self, arm: LeaningArm) -> LeaningArm:
        """Return the arm without contacts, with surfaces that would touch it moved back."""
        least = (_APART - self.gaps(arm, self.stations)).max(axis=1, initial=0.0)
        retreat = np.where(least > _APART, least, 0.0)
        state = arm.state._replace(condition=arm.state.condition._replace(retreat=retreat))
        found = LeaningArm(self, state, arm.shape, [])
        self.missed(found)
        return found


def _is_same(touches: tuple[Touch, ...], before: tuple[Touch, ...]) -> bool:
    """Return whether contacts are still on their former ranges."""
    return all(
        new.range == old.range and new.pinned == old.pinned
        for new, old in zip(touches, before, strict=True)
    )


def _at_moved(state: Contacts, touches: tuple[Touch, ...]) -> RodMesh:
    """Return a state's mesh with the nodes of contacts moved, as far as neighbours allow."""
    at = state.mesh.at.copy()
    for node, touch in zip(state.mesh.node, touches, strict=True):
        at[node] = np.clip(touch.station, at[min(node + 1, len(at) - 1)], at[max(node - 1, 0)])
    return state.mesh._replace(at=at)


def dips(gaps: Vector) -> list[int]:
    """Return the local minima of gaps along an arm, except at its base."""
    low = np.isfinite(gaps[:-1]) & (gaps[:-1] > gaps[1:])
    low[:-1] &= gaps[1:-1] <= gaps[2:]
    return [int(i) for i in np.flatnonzero(low) + 1]
