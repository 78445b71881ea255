"""Lines of contact: an arm that lies along a flat surface.

A point contact stands where the gap is least along the arm.  Where the body lies along a surface
that is nearly as straight as the arm, that place is undetermined, as the gap's second derivative
vanishes.  The force is then carried by contacts that are pinned to fixed stations one outer radius
apart.  Each acts for its share of the line; between them, shear bends the centre line into the
surface by some micrometres.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.contact.rod import Rod
from stiffopt.model.contact.system import Touch

if TYPE_CHECKING:
    from stiffopt.model.contact.system import LeaningArm

Vector = NDArray[np.float64]

_SPACING = float(__import__("os").environ.get("SP","1"))  # of the stations, over the least outer radius
_SHORTER = 0.7  # reach over the spacing, below which two stations become a point again
_SNAPPED = 0.1  # of the spacing; stations that are nearer to an end of a range lie on it
_MAX_CHANGES = 3  # from a point to a line, after which it stays one


class ContactLines:
    """The stations that carry lines of contact along an arm.

    Attributes
    ----------
    spacing : distance of the stations, in m.
    stations : (k,), from the base, where there is none, to the tip.
    """

    def __init__(self, rod: Rod) -> None:
        length, ends = rod.arm.length, np.array([each.end for each in rod.ranges])
        radius = min(rod.radius(index) for index in range(len(rod.ranges)))
        count = max(1, round(length / (_SPACING * radius)))
        self.spacing = length / count
        stations = length * np.arange(1, count + 1) / count
        nearest = ends[np.abs(stations[:, None] - ends).argmin(axis=1)]
        close = np.abs(nearest - stations) < _SNAPPED * self.spacing
        self.stations = np.where(close, nearest, stations)
        self._rod, self._ends = rod, set(ends.tolist())

    def touch(self, surface: int, station: float, force: Vector | float = 0.0) -> Touch:
        """Return a contact of a line, with a force (3,) along its normal."""
        ranges = self._rod.ranges
        inside = [i for i, each in enumerate(ranges) if each.start <= station <= each.end]
        index = max(inside, key=lambda i: (self._rod.radius(i), not ranges[i].rigid))
        vector = np.zeros(3) + force
        size = float(np.linalg.norm(vector))
        return Touch(surface, index, station, True, vector, size, np.zeros(3), line=True)

    def is_beside(self, station: float, others: list[float]) -> bool:
        """Return whether a station is within a spacing of another one."""
        return any(abs(station - other) < 1.2 * self.spacing for other in others)

    def next_to(self, touches: tuple[Touch, ...], surface: int) -> Vector:
        """Return the open stations next to those of a surface's lines."""
        closed = {touch.station for touch in touches if touch.surface == surface}
        lines = [touch.station for touch in touches if touch.surface == surface and touch.line]
        return np.array(
            [s for s in self.stations.tolist() if s not in closed and self.is_beside(s, lines)]
        )

    def changed(self, arm: LeaningArm) -> tuple[Touch, ...] | None:
        """Return the contacts with one that became a line, or is a point again; None if none."""
        touches = arm.state.touches
        for j, touch in enumerate(touches):
            if touch.line:
                beside = self._beside(touches, j)
                if touch.crossings >= _MAX_CHANGES or len(beside) > 1:
                    continue
                if not beside and touch.station in self._ends and arm.is_let_go(j):
                    continue
                if not beside:
                    return (*touches[:j], self._point([touch]), *touches[j + 1 :])
                (i,) = beside
                if i < j or len(self._beside(touches, i)) > 1:
                    continue
                pair = [touch, touches[i]]
                bend = (arm.bend(j) + arm.bend(i)) / 2
                if arm.shear(j) + arm.shear(i) < _SHORTER * self.spacing * bend:
                    rest = [each for k, each in enumerate(touches) if k not in (i, j)]
                    return (*rest, self._point(pair))
            elif self._beside(touches, j):
                return self._spread(touches, j)
            elif arm.reach(j) > self.spacing and (not touch.pinned or arm.is_let_go(j)):
                return self._spread(touches, j)
        return None

    def _beside(self, touches: tuple[Touch, ...], j: int) -> list[int]:
        """Return the contacts of a line on the same surface next to a contact."""
        own = touches[j]
        return [
            i
            for i, each in enumerate(touches)
            if i != j
            and each.line
            and each.surface == own.surface
            and abs(each.station - own.station) < 1.2 * self.spacing
        ]

    def _point(self, line: list[Touch]) -> Touch:
        """Return the contact at a point that replaces those of a line."""
        total = sum(each.normal_force for each in line)
        station = sum(each.normal_force * each.station for each in line) / total
        inside = [i for i, each in enumerate(self._rod.ranges) if each.start < station < each.end]
        one = replace(
            line[0],
            station=station,
            force=np.sum([each.force for each in line], axis=0),
            normal_force=total,
            crossings=max(each.crossings for each in line) + 1,
            line=False,
        )
        return replace(one, range=inside[0], pinned=False) if inside else one

    def _spread(self, touches: tuple[Touch, ...], j: int) -> tuple[Touch, ...]:
        """Replace a contact by those of the stations on both of its sides."""
        own, stations = touches[j], self.stations
        after = int(np.searchsorted(stations, own.station - 1e-9))
        chosen = {after: 1.0}
        if after > 0 and own.station < stations[after] - 1e-9:
            before = stations[after - 1]
            share = (own.station - before) / (stations[after] - before)
            chosen = {after - 1: 1 - share, after: share}
        rest = [each for i, each in enumerate(touches) if i != j]
        for index, share in chosen.items():
            new = self.touch(own.surface, float(stations[index]), share * own.force)
            new = replace(new, crossings=own.crossings)
            same = [i for i, each in enumerate(rest) if each.surface == own.surface
                    and each.station == new.station]  # fmt: skip
            if same:
                old = rest[same[0]]
                force, normal_force = old.force + new.force, old.normal_force + new.normal_force
                rest[same[0]] = replace(new, force=force, normal_force=normal_force)
            else:
                rest.append(new)
        return tuple(rest)
