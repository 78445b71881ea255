"""Lines of contact: an arm that lies along a flat surface.

A point contact stands where the gap is least along the arm.  Where the body lies along a surface
that is nearly as straight as the arm, that place is undetermined, as the gap's second derivative
vanishes.  The force is then carried by several contacts about one outer radius apart.  Those at the
ends of the line slide to where the slope of the gap is zero, as every contact does.  Those between
them are pinned if the gap hardly curves, and so is one at the tip.  Between contacts, shear bends
the centre line into the surface by some micrometres.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from stiffopt.model.contact.rod import Rod
from stiffopt.model.contact.system import Touch

if TYPE_CHECKING:
    from stiffopt.model.contact.system import LeaningArm

SPACINGS = (1.0, 1.5, 0.5)  # of the contacts, over the least outer radius; tried in this order
_CLOSEST, _FARTHEST = 0.4, 1.3  # distances of neighbours on a line, over the spacing
_BESIDE = 0.65  # over the spacing; the body may enter the surface a little so near to a line
_CURVED = 0.1  # 1/m beyond that of a flat line, with which contacts inside a line slide too
_SHORTER = 0.7  # reach over the spacing, below which two contacts become one
_LONG = 2.0  # reach over the spacing, with which an end is too undetermined to begin to slide
_LIGHT, _HOLE = 0.25, 0.3  # force at the tip over its neighbour's, and free length over the spacing
_MAX_SPLITS = 3  # of a point; then it stays one


class ContactLines:
    """How points of contact become lines, and lines points, along an arm.

    Attributes
    ----------
    share : spacing of the contacts of a line, over the least outer radius.
    spacing : the same in m.
    """

    def __init__(self, rod: Rod, share: float = SPACINGS[0]) -> None:
        self.share = share
        self.spacing = share * min(rod.radius(index) for index in range(len(rod.ranges)))
        self._rod, self._length = rod, rod.ranges[-1].end

    def is_beside(self, station: float, lines: list[float]) -> bool:
        """Return whether a station belongs to a contact of a line."""
        near = _BESIDE * self.spacing
        return bool(lines) and (
            station < _CLOSEST * self.spacing or any(abs(station - each) < near for each in lines)
        )

    def is_held(self, touch: Touch) -> bool:
        """Return whether a contact is pinned inside a line, or as its end at the tip."""
        here = self._rod.ranges[touch.range]
        inside = here.start < touch.station < here.end or touch.station >= self._length
        return touch.line and touch.pinned and inside

    def changed(self, arm: LeaningArm) -> tuple[Touch, ...] | None:
        """Return the contacts after one change that makes lines consistent; None if they are."""
        touches = arm.state.touches
        for j, touch in enumerate(touches):
            if touch.line:
                continue
            own = [each for each in touches if each.line and each.surface == touch.surface]
            if any(abs(each.station - touch.station) < self.spacing for each in own):
                return _with(touches, {j: replace(touch, line=True)})
            reach = arm.reach(j)
            if reach > self.spacing and touch.crossings < _MAX_SPLITS:
                if not touch.pinned and arm.bend(j) <= 0:
                    return _with(touches, {j: replace(touch, line=True, pinned=True)})
                if not touch.pinned:
                    return (*_with(touches, {j: None}), *self._split(touch, reach))
                if touch.station >= self._length and arm.is_let_go(j):
                    return _with(touches, {j: replace(touch, line=True)})
        for run in self._runs(touches):
            changes = self._consistent(arm, run)
            if changes:
                return _with(touches, changes)
        return None

    def _split(self, touch: Touch, reach: float) -> list[Touch]:
        """Return the two ends of a line that replace a point."""
        offset = min(reach, 2 * self.spacing) / 4
        found = []
        for station in (touch.station - offset, touch.station + offset):
            new = replace(
                touch,
                station=min(station, self._length),
                force=touch.force / 2,
                normal_force=touch.normal_force / 2,
                crossings=touch.crossings + 1,
                line=True,
            )
            found.append(self._placed(new))
        return found

    def _placed(self, touch: Touch) -> Touch:
        """Return a contact with the range that its station is in; at the tip it is pinned."""
        for index, each in enumerate(self._rod.ranges):
            if each.start < touch.station < each.end:
                return replace(touch, range=index)
        return replace(touch, pinned=True)

    def _joined(self, touch: Touch, other: Touch) -> Touch:
        """Return a contact that carries another one's force too; if it slides, between them."""
        forces = touch.normal_force, other.normal_force
        mean = float(np.average([touch.station, other.station], weights=forces))
        found = replace(
            touch,
            force=touch.force + other.force,
            normal_force=sum(forces),
            crossings=max(touch.crossings, other.crossings),
        )
        return found if touch.pinned else self._placed(replace(found, station=mean))

    def _runs(self, touches: tuple[Touch, ...]) -> list[list[int]]:
        """Return the contacts of each line, from the base to the tip."""
        lines = [j for j, touch in enumerate(touches) if touch.line]
        lines.sort(key=lambda j: (touches[j].surface, touches[j].station))
        runs: list[list[int]] = []
        for j in lines:
            last = touches[runs[-1][-1]] if runs else None
            far = _FARTHEST * self.spacing
            own = touches[j]
            if last and last.surface == own.surface and own.station - last.station < far:
                runs[-1].append(j)
            else:
                runs.append([j])
        return runs

    def _consistent(self, arm: LeaningArm, run: list[int]) -> dict[int, Touch | None]:
        """Return the contacts of a line that change, or are dropped (None)."""
        touches = arm.state.touches
        first, last = run[0], run[-1]
        if touches[first].station < _CLOSEST * self.spacing:
            return {first: None}  # the base carries it
        if len(run) == 1:
            own = touches[first]
            if own.station >= self._length and arm.is_let_go(first):
                return {}
            if own.pinned and arm.reach(first) > _LONG * self.spacing:
                return {}
            point = replace(own, line=False)
            return {first: point if own.station >= self._length else replace(point, pinned=False)}
        for i, j in pairwise(run):
            if touches[j].station - touches[i].station < _CLOSEST * self.spacing:
                keep, drop = (j, i) if j == last else (i, j)
                return {keep: self._joined(touches[keep], touches[drop]), drop: None}
        if touches[last].station >= self._length:
            before, end = run[-2], touches[run[-2]].station
            is_light = touches[last].normal_force < _LIGHT * touches[before].normal_force
            if is_light and end + arm.reach(before) / 2 < self._length - _HOLE * self.spacing:
                return {last: None}  # the line ends before the tip
        if len(run) == 2 and not touches[last].station >= self._length:
            bend = (arm.bend(first) + arm.bend(last)) / 2
            if arm.shear(first) + arm.shear(last) < _SHORTER * self.spacing * bend:
                pair = [replace(touches[j], pinned=False, line=False) for j in run]
                return {first: self._joined(*pair), last: None}
        changes: dict[int, Touch | None] = {}
        for j in run:
            touch = touches[j]
            is_end, bend = j in (first, last), arm.bend(j)
            more = 1.0 if touch.pinned else 0.5  # to begin to slide than to go on
            if is_end:  # neither on a crest nor where its place is nearly undetermined
                slides = arm.reach(j) < _LONG * self.spacing / more
            else:
                slides = bend > more * _CURVED + 1.25 * arm.sag(j)
            slides = slides and touch.station < self._length
            if slides and self.is_held(touch):
                changes[j] = replace(touch, pinned=False)
            elif not slides and not touch.pinned:
                changes[j] = replace(touch, pinned=True)
        return changes


def _with(touches: tuple[Touch, ...], changes: dict[int, Touch | None]) -> tuple[Touch, ...]:
    """Return contacts of which some are replaced, or dropped (None)."""
    found = [changes.get(j, touch) for j, touch in enumerate(touches)]
    return tuple(each for each in found if each is not None)
