"""Equilibria of an arm that touches surfaces: an active set, and continuation from rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.contact.rod import (
    MOMENT,
    TURN,
    Condition,
    Rod,
    RodMesh,
    RodNodes,
    interpolated,
    turned,
)
from stiffopt.model.contact.stability import is_stable
from stiffopt.model.contact.surface import ContactSurface
from stiffopt.model.contact.system import Contacts, ContactSystem, Touch

Vector = NDArray[np.float64]

_LARGEST_TURN = 0.5  # rad, by which one correction may turn a part of the arm
_LARGEST_SLIDE = 0.02  # m, by which one may move a contact along the arm
_TURN_LEFT, _SLIDE_LEFT = 1e-6, 1e-7  # rad and m; convergence being quadratic, 1e-12 is left
_MOST_ITERATIONS = 14
_MOST_SETS = 10  # of contacts that are tried in a step
_DEEPEST = 0.3  # of the body's radius, by which a step may enter a surface
_TILT = 0.5  # rad, by which a step may turn a normal
_PENETRATION = 2e-6  # m, which no one minds
_SEEN_FROM = 2e-4  # m of clearance at the places that are looked at, some millimetres apart
_SWEPT = 0.5  # of the body's radius, by which the body may move in a step
_AS_NEAR = 1e-5  # m of penetration beside a contact, which its neighbourhood may have
_BESIDE = 1e-3  # m along the arm from a contact that belong to it at least
_ONE = 2e-4  # m between contacts of a surface that are one
_INSET = 1e-5  # m that a contact is away from where a range ends, or more
_MOST_CROSSINGS = 3  # of an end of a range, after which a contact is pinned there
_APART = 1e-4  # m between an arm and surfaces that are moved back from it
_SHORTEST_STEP = 1e-4  # of the way from rest; less means that it has ended

Found = tuple[Contacts, ContactSystem]


class ContactProblem:
    """An arm among surfaces."""

    def __init__(self, rod: Rod, surfaces: tuple[ContactSurface, ...]) -> None:
        self.rod, self.surfaces = rod, surfaces

    # -- Newton's method --------------------------------------------------------------------

    def correct(self, state: Contacts) -> Found | None:
        """Equilibrium in which just the given contacts are closed; None if it is not near."""
        sections = self.rod.sections(state.condition)
        previous = np.inf
        for iteration in range(_MOST_ITERATIONS):
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
                return state, system
        return None

    def _moved(
        self, state: Contacts, system: ContactSystem, solution: Vector
    ) -> tuple[tuple[Touch, ...], float]:
        """Contacts after a correction, and how far along the arm they were to move."""
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
        """The contact in the range that it has come to, or pinned at an end of its own."""
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
        if touch.crossings >= _MOST_CROSSINGS or radii[1] < radii[0] - 1e-9:
            return replace(touch, station=edge, pinned=True)
        station = edge + (_INSET if up else -_INSET)
        return replace(touch, range=other, station=station, crossings=touch.crossings + 1)

    # -- active set -------------------------------------------------------------------------

    def settle(self, state: Contacts) -> Found | None:
        """Equilibrium near a state where no contact pulls and none is missed; None if not near."""
        touches = tuple(replace(touch, crossings=0) for touch in state.touches)
        start = state = state._replace(touches=touches)
        for _ in range(_MOST_SETS):
            found = self.correct(state)
            if found is None or self.is_far(start, *found):
                return None
            settled, system = found
            changed = self._changed(settled, system)
            if changed is None:
                missed = self.missed(settled, system)
                if missed is None:
                    return None
                if not missed:
                    return found
                changed = (*settled.touches, *missed)
            state = self.with_touches(settled, changed)
        return None

    def is_far(self, start: Contacts, state: Contacts, system: ContactSystem) -> bool:
        """Whether the normal of a contact has turned too much for a step."""
        for old, new, row in zip(start.touches, state.touches, system.rows, strict=False):
            if old.surface != new.surface:
                return False  # another set of contacts: what is left of them was looked at
            size = float(np.linalg.norm(old.force))
            if size > 1e-6 and old.force @ row.point.normal < np.cos(_TILT) * size:
                return True
        return False

    def with_touches(self, state: Contacts, touches: tuple[Touch, ...]) -> Contacts:
        """A state to begin at with other contacts."""
        mesh = self.rod.mesh(np.array([touch.station for touch in touches]))
        return Contacts(state.condition, mesh, interpolated(state.nodes, state.mesh, mesh), touches)

    def _changed(self, state: Contacts, system: ContactSystem) -> tuple[Touch, ...] | None:
        """Contacts without the one that pulls most, or with one that is set free or merged."""
        touches = list(state.touches)
        pull = [touch.normal_force for touch in touches]
        if touches and min(pull) < 0:
            del touches[pull.index(min(pull))]
            return tuple(touches)
        for j, (touch, row) in enumerate(zip(touches, system.rows, strict=True)):
            here = self.rod.ranges[touch.range]
            up = touch.station > (here.start + here.end) / 2
            inwards = row.slope if up else -row.slope
            if touch.pinned and touch.crossings < _MOST_CROSSINGS and inwards > 1e-9:
                station = here.end - 1e-4 if up else here.start + 1e-4
                crossings = touch.crossings + 1
                touches[j] = replace(touch, station=station, pinned=False, crossings=crossings)
                return tuple(touches)
            for i, other in enumerate(touches[:j]):
                near = abs(touch.station - other.station) < _ONE
                if near and touch.surface == other.surface:
                    force = touch.force + other.force
                    normal_force = touch.normal_force + other.normal_force
                    touches[i] = replace(other, force=force, normal_force=normal_force)
                    del touches[j]
                    return tuple(touches)
        return None

    def missed(self, state: Contacts, system: ContactSystem) -> list[Touch] | None:
        """Contacts that are open and should not be; None if a surface is entered too deeply."""
        found = []
        at, points, radii = self.body(system)
        for index, surface in enumerate(self.surfaces):
            gaps = surface.distances(points) - radii + state.condition.retreat[index]
            gaps[at < surface.begin] = np.inf
            system.clearances[index] = gaps.min()
            if gaps.min() > _SEEN_FROM:
                continue
            own = [j for j, touch in enumerate(state.touches) if touch.surface == index]
            for s, gap in minima(at, gaps):
                if gap > -_PENETRATION or any(self._is_of(state, system, j, s, gap) for j in own):
                    continue
                if gap < -_DEEPEST * radii.min():
                    return None
                found.append(self._touch(index, s))
        return found

    def _is_of(self, state: Contacts, system: ContactSystem, j: int, s: float, gap: float) -> bool:
        """Whether what seems to be a contact belongs to one that is closed."""
        touch = state.touches[j]
        depth, reach = system.kink(j)
        allowed = 2 * depth + _AS_NEAR
        allowed += self.surfaces[touch.surface].softness * touch.normal_force
        return abs(s - touch.station) < 1.5 * reach + _BESIDE and gap > -allowed

    def _touch(self, surface: int, s: float) -> Touch:
        """An open contact at an arc length."""
        index = next(i for i, each in enumerate(self.rod.ranges) if s <= each.end + _INSET)
        here, length = self.rod.ranges[index], self.rod.arm.length
        pinned = s >= length - 1e-6
        inside = min(max(s, here.start + _INSET), here.end - _INSET)
        none = np.zeros(3)
        return Touch(surface, index, length if pinned else inside, pinned, none, 0.0, none)

    def retreat(self, system: ContactSystem) -> Vector:
        """By how much surfaces (k,) are moved back to be clear of an arm."""
        at, points, radii = self.body(system)
        found = []
        for surface in self.surfaces:
            gaps = (surface.distances(points) - radii)[at >= surface.begin]
            found.append(_APART - gaps.min() if gaps.min() < 0 else 0.0)
        return np.array(found)

    def body(self, system: ContactSystem, samples: int = 5) -> tuple[Vector, Vector, Vector]:
        """Arc lengths (k,), points (k, 3) and radii (k,) along the arm, from above its base."""
        linear = system.linear
        at = linear.mesh.at[:-1, None] - linear.h[:, None] * np.arange(samples) / samples
        x = (np.arange(samples) / samples)[:, None]
        h = linear.h[:, None, None]
        start, end = linear.position[:-1, None], linear.position[1:, None]
        first, last = -h * linear.near[:, None], -h * linear.far[:, None]
        points = (
            (1 + 2 * x) * (1 - x) ** 2 * start
            + x * (1 - x) ** 2 * first
            + x**2 * (3 - 2 * x) * end
            + x**2 * (x - 1) * last
        )
        radii = np.repeat(linear.sections.radius[linear.mesh.segment], samples)
        up = slice(None, None, -1)
        return at.ravel()[up], points.reshape(-1, 3)[up], radii[up]

    # -- continuation -----------------------------------------------------------------------

    def follow(self, start: Contacts, end: Condition) -> tuple[Contacts, ContactSystem, float]:
        """Equilibrium reached on the straight way to another condition, and at what share of it."""
        state, share, step, halved = start, 0.0, 1.0, False
        system = ContactSystem(self, start, self.rod.sections(start.condition))
        self.missed(start, system)
        while share < 1.0:
            target = min(1.0, share + step)
            found = self.settle(self._guess(state, start.condition.towards(end, target)))
            if found is None or self._leaves(state, system, *found):
                step, halved = step / 2, True
                if step < _SHORTEST_STEP:
                    break
                continue
            (state, system), share = found, target
            step, halved = (step if halved else 2 * step), False
        return state, system, share

    def _leaves(
        self, start: Contacts, before: ContactSystem, state: Contacts, system: ContactSystem
    ) -> bool:
        """Whether stability is lost, or the body may have passed through a surface in a step."""
        if not is_stable(self, state, system):
            return True
        at, points, _ = self.body(before)
        new, others, radii = self.body(system)
        there = np.stack([np.interp(at, new, column) for column in others.T], axis=1)
        way = float(np.linalg.norm(there - points, axis=1).max())
        if way < _SWEPT * radii.min():
            return False
        clearances = before.clearances + system.clearances
        for touch in (*start.touches, *state.touches):
            clearances[touch.surface] = np.inf
        return bool((clearances < 1.2 * way).any())  # ways are not quite straight

    def _guess(self, state: Contacts, condition: Condition) -> Contacts:
        """A state near which the equilibrium at a condition may be."""
        loaded = (condition.dead, condition.follower, condition.gravity, state.nodes.moment)
        if state.touches or any(each.any() for each in loaded):
            return state._replace(condition=condition)
        return Contacts(condition, state.mesh, self.rod.free(condition, state.mesh), ())

    def straight(self, like: Condition) -> Contacts:
        """The unpressurised arm without weight, clear of all surfaces."""
        mesh = self.rod.mesh(np.zeros(0))
        q = np.tile([1.0, 0.0, 0.0, 0.0], (len(mesh.at), 1))
        zero = Condition(*(np.zeros_like(each) for each in like))
        state = Contacts(zero, mesh, RodNodes(q, np.zeros((len(mesh.at), 3))), ())
        retreat = self.retreat(ContactSystem(self, state, self.rod.sections(zero)))
        return state._replace(condition=zero._replace(retreat=retreat))


def _is_same(touches: tuple[Touch, ...], before: tuple[Touch, ...]) -> bool:
    """Whether contacts are on the ranges that they were on."""
    return all(
        new.range == old.range and new.pinned == old.pinned
        for new, old in zip(touches, before, strict=True)
    )


def _at_moved(state: Contacts, touches: tuple[Touch, ...]) -> RodMesh:
    """A state's mesh, its nodes moved with the contacts as far as that matters."""
    at = state.mesh.at.copy()
    for node, touch in zip(state.mesh.node, touches, strict=True):
        at[node] = np.clip(touch.station, at[min(node + 1, len(at) - 1)], at[max(node - 1, 0)])
    return state.mesh._replace(at=at)


def minima(at: Vector, gaps: Vector) -> list[tuple[float, float]]:
    """Stations and values of the local minima of gaps along an arm, but for one at its base."""
    found = []
    for i in range(1, len(at)):
        if not gaps[i - 1] > gaps[i] or np.isinf(gaps[i - 1]):
            continue
        if i == len(at) - 1:
            found.append((float(at[i]), float(gaps[i])))
            continue
        if gaps[i] > gaps[i + 1]:
            continue
        a, b = at[i] - at[i - 1], at[i + 1] - at[i]
        first, second = (gaps[i] - gaps[i - 1]) / a, (gaps[i + 1] - gaps[i]) / b
        bend, slope = 2 * (second - first) / (a + b), (first * b + second * a) / (a + b)
        shift = float(np.clip(-slope / bend, -a, b))
        found.append((float(at[i] + shift), float(gaps[i] + slope * shift + bend * shift**2 / 2)))
    return found
