"""`ContactProblem`: equilibria of an arm among surfaces, by an active set and continuation."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.contact.lines import SPACINGS, ContactLines
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

_LARGEST_TURN = 0.5  # rad, largest turn of a part of the arm in one correction; the rest is cut
_FARTHEST_TURN = 1.5  # rad; if more were wanted, the equilibrium is not near
_LARGEST_SLIDE = 0.02  # m, largest motion of a contact along the arm in one correction
_TURN_LEFT, _SLIDE_LEFT = 1e-6, 1e-7  # rad and m; quadratic convergence: the error is 1e-12
_MAX_ITERATIONS = 40
_MAX_MESHES = 8  # rebuilt as contacts move from range to range
_MAX_SETS = 40  # sets of contacts that are tried in a step
_DEEPEST = 0.3  # largest penetration of a surface in a step, over the body's radius
_ENTERED = 2e-3  # m, wanted penetration after a step that went too deep
_TILT = 0.5  # rad, largest turn of a contact's normal in a step
_PENETRATION = 2e-6  # m, allowed penetration
_SPACING = 4e-3  # m along the arm between stations at which gaps are evaluated
_FINE_STATIONS = 17  # stations about a local minimum of a gap
_SEEN_FROM = 2e-4  # m; a larger gap at a coarse minimum excludes a contact
_SAG = 1e-4  # m; largest penetration on a line of contacts
_SCANNED = 0.5  # motion of a free arm between two looks at the gaps, over the body's radius
_MOST_LOOKS, _CLOSER_LOOKS = 24, 8  # along the motion, and where it first enters a surface
_SWEPT = 1.0  # motion of a station in a step that is always allowed, over the body's radius
_AS_NEAR = 1e-5  # m, allowed penetration next to a contact
_BESIDE = 1e-3  # m along the arm, least neighbourhood of a contact
_SAME_CONTACT = 2e-4  # m; closer contacts on a surface are merged
_INSET = 1e-5  # m, least distance of a contact from the end of a range
_MAX_CROSSINGS = 3  # of an end of a range, after which a contact is pinned there
_APART = 1e-4  # m between an arm and surfaces that are moved back from it
_MOST_STEPS = 500  # of a path, with those that are repeated
_SHORTEST_STEP = 1e-4  # share of the path from rest; below it the path has ended


class ContactProblem:
    """An arm among surfaces; `spacing` of contacts on lines, over the least outer radius."""

    def __init__(
        self, rod: Rod, surfaces: tuple[ContactSurface, ...], spacing: float = SPACINGS[0]
    ) -> None:
        self.rod, self.surfaces = rod, surfaces
        self._in_c: NativeContacts | None = None
        self._deepest: tuple[int, float] | None = None  # surface and gap of a step that failed
        count = int(np.ceil(rod.arm.length / _SPACING))
        self.stations = np.linspace(0.0, rod.arm.length, count + 1)
        self.lines = ContactLines(rod, spacing)

    # -- Newton's method --------------------------------------------------------------------

    def correct(self, state: Contacts, sticking: Collection[int] = ()) -> LeaningArm | None:
        """Find the equilibrium in which exactly the given contacts are closed; None if not near.

        The points of the body at sticking contacts do not slip on the way there, to first order.
        """
        sections = self.rod.sections(state.condition)
        native = self._native
        if native is not None and len(state.touches) <= MOST_CONTACTS and not sticking:
            return self._correct_in_c(native, state, sections)
        previous = np.inf
        for iteration in range(_MAX_ITERATIONS):
            with np.errstate(over="ignore", invalid="ignore"):  # where it diverges; refused below
                system = ContactSystem(self, state, sections, sticking=sticking)
                try:
                    solution = system.solution()
                except np.linalg.LinAlgError:
                    return None
                changes, _ = system.along(solution)
                size = float(np.sqrt((changes[:, TURN, 0] ** 2).sum(axis=1).max()))
            if not size <= _FARTHEST_TURN or (iteration > 3 and size > previous):  # NaN too
                return None
            share = min(1.0, _LARGEST_TURN / max(size, _TURN_LEFT))
            state, slide, is_same = self._stepped(
                system, share * changes[..., 0], share * solution[:, 0]
            )
            previous = max(size, _TURN_LEFT) if is_same else np.inf
            if is_same and size < _TURN_LEFT and slide < _SLIDE_LEFT:
                system.state = state
                return system
        return None

    def _stepped(
        self, system: ContactSystem, changes: Array, solution: Array
    ) -> tuple[Contacts, float, bool]:
        """Return the state after changes (N + 1, 9) of nodes and (u,) of the unknowns.

        Also how far contacts should move along the arm, and whether the mesh is still the same.
        """
        state = system.state
        q = turned(state.nodes.quaternion, changes[:, TURN])
        nodes = RodNodes(q, state.nodes.moment + changes[:, MOMENT])
        touches, slide = self._moved(state, system, solution)
        before, stations = (
            np.array([t.station for t in each]) for each in (state.touches, touches)
        )
        is_same = _is_same(touches, state.touches)
        mesh = self.rod.moved(state.mesh, stations - before) if is_same else None
        if mesh is None:
            is_same, mesh = False, self.rod.mesh(stations)
            nodes = interpolated(nodes, _at_moved(state, touches), mesh)
        return Contacts(state.condition, mesh, nodes, touches), slide, is_same

    def pushed(self, system: ContactSystem, solution: Array, push: Array) -> LeaningArm | None:
        """Find the equilibrium after a small push (6,) at the tip, with contacts that stick.

        Parameters
        ----------
        system, solution : the equations for forces at the tip, and their solution (u, 6).
        """
        changes, _ = system.along(solution)
        state, _, _ = self._stepped(system, changes @ push, solution @ push)
        condition = state.condition._replace(dead=state.condition.dead + push)
        return self.correct(state._replace(condition=condition), system.sticking)

    @property
    def _native(self) -> NativeContacts | None:
        """Newton's method in C, if there is machine code and every surface has a formula."""
        if self._in_c is None and not any(each.is_interpolated for each in self.surfaces):
            code = self.rod.step.code
            if code is not None:
                self._in_c = NativeContacts(code, self.rod, self.surfaces)
                for name in ("straight", "hanging", "alone"):
                    vars(self).pop(name, None)
        return self._in_c

    def _correct_in_c(
        self, native: NativeContacts, state: Contacts, sections: RodSections
    ) -> LeaningArm | None:
        for _ in range(_MAX_MESHES):
            outcome, moved, shape, rows = native.correct(state, sections)
            if outcome == CONVERGED:
                return LeaningArm(self, moved, shape, rows)
            if outcome == LOST:
                return None
            touches = tuple(each if each.pinned else self._within(each) for each in moved.touches)
            mesh = self.rod.mesh(np.array([touch.station for touch in touches]))
            nodes = interpolated(moved.nodes, _at_moved(moved, touches), mesh)
            state = Contacts(state.condition, mesh, nodes, touches)
        return None

    def _moved(
        self, state: Contacts, system: ContactSystem, solution: Array
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
                moment=touch.moment + solution[first + 3 : first + 6],
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
            return replace(touch, station=here.start + _INSET, pinned=True)
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
            if changed is not None:
                start = state = self.with_touches(found.state, changed)
                continue
            missed = self.missed(found)
            if missed is None:
                return None
            if not missed:
                return found
            state = self.with_touches(found.state, (*found.state.touches, *missed))
        return None

    def is_far(self, start: Contacts, arm: LeaningArm) -> bool:
        """Return whether the normal of a contact has turned too much for a step."""
        pairs = list(zip(arm.state.touches, arm.rows, strict=True))
        has_lines = any(touch.line for touch in (*start.touches, *arm.state.touches))
        for old, (new, row) in zip(start.touches, pairs, strict=False):
            if has_lines:  # contacts come and go; the nearest one has nearly the same normal
                own = [each for each in pairs if each[0].surface == old.surface]
                if not own:
                    continue
                new, row = min(own, key=lambda each: abs(each[0].station - old.station))
                if abs(new.station - old.station) > self.lines.spacing:
                    continue
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
            if touches[pull.index(min(pull))].line:
                return tuple(each for each in touches if not each.line or each.normal_force >= 0)
            del touches[pull.index(min(pull))]
            return tuple(touches)
        changed = self.lines.changed(arm)
        if changed is not None:
            return changed
        for j, touch in enumerate(touches):
            if self.lines.is_held(touch):
                continue
            if touch.pinned and touch.crossings < _MAX_CROSSINGS and arm.is_let_go(j):
                here = self.rod.ranges[touch.range]
                up = touch.station > (here.start + here.end) / 2
                station = here.end - 1e-4 if up else here.start + 1e-4
                crossings = touch.crossings + 1
                touches[j] = replace(touch, station=station, pinned=False, crossings=crossings)
                return tuple(touches)
            for i, other in enumerate(touches[:j]):
                near = abs(touch.station - other.station) < _SAME_CONTACT and not touch.line
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
        for index, gaps in enumerate(arm.gaps):
            if gaps.min() > _SEEN_FROM:
                continue
            own = [j for j, touch in enumerate(arm.state.touches) if touch.surface == index]
            lines = [
                touch.station
                for touch in arm.state.touches
                if touch.surface == index and touch.line
            ]
            for i in dips(gaps):
                if gaps[i] > _SEEN_FROM:
                    continue
                inside = i < len(gaps) - 1  # at the tip, the line goes up to the tip
                if inside and gaps[i] > -_SAG and self.lines.is_beside(self.stations[i], lines):
                    continue
                ends = self.stations[[i - 1, min(i + 1, len(gaps) - 1)]]
                around = np.linspace(ends[0], ends[1], _FINE_STATIONS)
                retreat = arm.state.condition.retreat[index]
                closely = self._gaps_of(index, *arm.shape.body(around), around) + retreat
                s, gap = float(around[closely.argmin()]), float(closely.min())
                if gap > -_PENETRATION or any(self._is_of(arm, j, s, gap) for j in own):
                    continue
                if gap < -_DEEPEST * arm.shape.sections.radius.min():
                    self._deepest = (index, gap)
                    return None
                new = self._touch(index, s)
                if any(abs(s - each) < self.lines.spacing for each in lines):
                    new = replace(new, line=True, pinned=True)
                found.append(new)
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

    def gaps(self, points: Array, radii: Array) -> Array:
        """Return gaps (surfaces, k) to a body with points (k, 3) at the stations."""
        found = [self._gaps_of(j, points, radii, self.stations) for j in range(len(self.surfaces))]
        return np.array(found).reshape(len(found), len(points))

    def _gaps_of(self, index: int, points: Array, radii: Array, at: Array) -> Array:
        """Return gaps (..., k) of a surface to bodies with points (..., k, 3)."""
        surface, native, rows = self.surfaces[index], self._native, points.reshape(-1, 3)
        values = surface.distances(rows) if native is None else native.distances(index, rows)
        found: Array = values.reshape(points.shape[:-1]) - radii
        found[..., at < surface.begin] = np.inf
        return found

    # -- continuation -----------------------------------------------------------------------

    def follow(self, start: LeaningArm, end: Condition) -> tuple[LeaningArm, float]:
        """Follow the equilibrium straight to a condition; return the last and its share."""
        arm, share, step, halved = start, 0.0, 1.0, False
        for _ in range(_MOST_STEPS):
            if share >= 1.0:
                break
            target = min(1.0, share + step)
            guess = self._guess(arm.state, start.state.condition.towards(end, target))
            self._deepest = None
            way, found = self._lean(arm, guess) if arm.state.touches else self._move(arm, guess)
            if found is None or not found.is_stable:
                step = way * (target - share) * self._share_to_touch(arm)
                halved = True
                if step < _SHORTEST_STEP:
                    break
                continue
            arm, share = found, target if way == 1.0 else share + way * (target - share)
            step, halved = (step if halved else 2 * step), False
        return arm, share

    def _lean(self, before: LeaningArm, guess: Contacts) -> tuple[float, LeaningArm | None]:
        """Return 1 and the next equilibrium of an arm with contacts, if it is near."""
        found = self.settle(guess)
        touched = [touch.surface for touch in before.state.touches]
        if found and self._may_have_passed(before.body[0], before.gaps, touched, found):
            return 1.0, None
        return 1.0, found

    def _move(self, before: LeaningArm, guess: Contacts) -> tuple[float, LeaningArm | None]:
        """Return how far an arm without contacts comes, and the equilibrium there if it is near.

        The arm moves freely until it would enter a surface too deeply for a step.  It goes back to
        where it has just entered it, and leans on it there.
        """
        after = self.correct(guess)
        if after is None or not self.surfaces:
            return 1.0, after
        way, points, gaps = self._until_entered(before, after)
        touched = np.flatnonzero(gaps.min(axis=1) < -_PENETRATION).tolist()
        touches: list[Touch] | None
        if way == 1.0:
            state, touches = after.state, self.missed(after)
        else:
            pairs = zip(before.state.nodes, after.state.nodes, strict=True)
            nodes = RodNodes(*((1 - way) * a + way * b for a, b in pairs))
            condition = before.state.condition.towards(after.state.condition, way)
            state = after.state._replace(condition=condition, nodes=nodes)
            deepest = self.stations[gaps.argmin(axis=1)].tolist()
            touches = [self._touch(index, deepest[index]) for index in touched]
        if touches is None:
            return way, None
        found = self.settle(self.with_touches(state, tuple(touches))) if touches else after
        if not (before.shape.is_native and after.shape.is_native):  # only its ends are exact
            points, gaps, touched = before.body[0], before.gaps, []
        if found and self._may_have_passed(points, gaps, touched, found):
            return way, None
        return way, found

    def _until_entered(self, before: LeaningArm, after: LeaningArm) -> tuple[float, Array, Array]:
        """Return how far an arm moves freely, and its points and gaps there, as `gaps` does."""
        radii, at = after.body[1], self.stations
        too_deep = -_DEEPEST * radii.min()
        retreat = [each.state.condition.retreat[:, None, None] for each in (before, after)]
        way = np.linalg.norm(after.body[0] - before.body[0], axis=1).max()
        way += np.abs(retreat[1] - retreat[0]).max()
        looks, row = int(np.clip(way / (_SCANNED * radii.min()), 1, _MOST_LOOKS)), -1
        low, high = 0.0, 1.0
        for scan in range(2):
            shares = np.linspace(low, high, looks + 1)
            points = before.shape.between(after.shape, shares, at)
            x, every = shares[:, None], range(len(self.surfaces))
            gaps = np.array([self._gaps_of(index, points, radii, at) for index in every])
            gaps += (1 - x) * retreat[0] + x * retreat[1]
            least = gaps.min(axis=(0, 2))
            if scan == 0 and least.min() >= too_deep:
                break
            row = int(np.argmax(least < too_deep))
            low, high, looks = shares[row - 1], shares[row], _CLOSER_LOOKS
        return float(high), points[row], gaps[:, row]

    def _share_to_touch(self, arm: LeaningArm) -> float:
        """Return the share of a failed step to try next: half, or up to a light touch."""
        if self._deepest is None or not arm.state.touches:
            return 0.5
        index, gap = self._deepest
        before = float(arm.gaps[index].min())
        return float(np.clip((before + _ENTERED) / (before - gap), 0.1, 0.9))

    def _may_have_passed(
        self, points: Array, gaps: Array, touched: Sequence[int], after: LeaningArm
    ) -> bool:
        """Return whether the body may have passed through a surface that it did not touch.

        Points (k, 3) and gaps (surfaces, k) are those before.
        """
        ways = np.linalg.norm(after.body[0] - points, axis=1)
        radius = after.shape.sections.radius.min()
        # gaps change by no more than the path, which is nearly straight
        least = (gaps + after.gaps - 1.05 * ways) / 2
        least[:, ways < _SWEPT * radius] = np.inf
        least[touched] = np.inf
        return bool((least < -_DEEPEST * radius).any())

    def _guess(self, state: Contacts, condition: Condition) -> Contacts:
        """Return a state to start from at a condition."""
        loaded = (condition.dead, condition.follower, condition.gravity, state.nodes.moment)
        if state.touches or any(each.any() for each in loaded):
            return state._replace(condition=condition)
        return Contacts(condition, state.mesh, self.rod.free(condition, state.mesh), ())

    @cached_property
    def alone(self) -> ContactProblem:
        """The arm without surfaces."""
        return ContactProblem(self.rod, ())

    @cached_property
    def hanging(self) -> tuple[LeaningArm, float]:
        """The arm under its own weight and payload alone, as `follow` returns it."""
        gravity, none = np.array(self.rod.arm.description.gravity), np.zeros(len(self.surfaces))
        condition = self.straight.state.condition._replace(gravity=gravity, retreat=none)
        return self.follow(self.straight, condition)

    @cached_property
    def straight(self) -> LeaningArm:
        """The unpressurised arm without weight, clear of all surfaces."""
        mesh = self.rod.mesh(np.zeros(0))
        q = np.tile([1.0, 0.0, 0.0, 0.0], (len(mesh.at), 1))
        sizes = self.rod.arm.n_pressures, 6, 6, 3, len(self.surfaces)
        zero = Condition(*(np.zeros(size) for size in sizes))
        nodes = RodNodes(q, np.zeros((len(mesh.at), 3)))
        found = self.correct(Contacts(zero, mesh, nodes, ()))
        assert found is not None  # the state is already an equilibrium
        return self.clear(found)

    def clear(self, arm: LeaningArm) -> LeaningArm:
        """Return the arm without contacts, with surfaces that would touch it moved back."""
        least = (_APART - self.gaps(*arm.body)).max(axis=1, initial=0.0)
        retreat = np.where(least > _APART, least, 0.0)
        state = arm.state._replace(condition=arm.state.condition._replace(retreat=retreat))
        return LeaningArm(self, state, arm.shape, [])


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


def dips(gaps: Array) -> list[int]:
    """Return the local minima of gaps along an arm, except at its base."""
    low = np.isfinite(gaps[:-1]) & (gaps[:-1] > gaps[1:])
    low[:-1] &= gaps[1:-1] <= gaps[2:]
    return [int(i) for i in np.flatnonzero(low) + 1]
