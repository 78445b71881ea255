"""Least distances of an arm's body from the objects of a scene: exact minima along it.

The body is the union of spheres of the outer radius about the centre line, from base to tip; for an
object on which the arm is mounted, it begins at `Obstacle.begin`. This module implements the method
of native/scene.h in Python, for use without machine code; a test proves that both agree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import asin, inf, isfinite, sqrt
from typing import NamedTuple

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.description import RobotDescription
from stiffopt.model.distances import MeasuredObject

CLEARANCE_ERROR = 4e-6  # m, largest error of a least distance
_SHORTEST = 1e-6  # m of arc length; shorter intervals are not divided
_FINE = 3e-4  # m of arc length, below which any object is treated as convex
_IN_PLANE = 1e-9  # m; heights above a ring's plane below this count as zero
_SHARPENED = 1e-4  # m of arc length, over which a slope's change is measured
_STEEPEST = 1.5  # largest gradient of an interpolated distance
_MORE_CURVED = 1.35  # bound on the curvature, over that of the coarse stations
_SPACING = 1 / 8  # of coarse stations, as a share of the arm's length
_INSET = 1e-9  # m between the end of a range and the beginning of the next

StationOf = Callable[[Array], tuple[Array, Array, Array]]
"""Function from arc lengths (k,) to positions (k, 3), unit tangents (k, 3) and radii (k,)."""


class BodyPoint(NamedTuple):
    """A station of the body."""

    s: float
    position: Array
    tangent: Array
    radius: float


class Nearest(NamedTuple):
    """The point of a body that is nearest to an object."""

    distance: float  # of the body's surface, in m
    s: float  # arc length at rest, in m
    radius_share: float  # 1 if the body's radius was subtracted from the distance, otherwise 0
    position: Array  # of the centre line (3,), in m
    normal: Array  # gradient (3,) of the distance by this position


class Probe(NamedTuple):
    """A station with its distance from an object, and the distance's slope along the body."""

    point: BodyPoint
    value: float
    slope: float
    normal: Array
    piece: int


@dataclass(frozen=True)
class BodyRange:
    """A range of the body on which the radius is constant and the tangent smooth."""

    points: tuple[BodyPoint, ...]  # coarse stations, from one end to the other
    speed: float  # largest arc length per arc length at rest
    turn: float  # largest change of the tangent per arc length at rest, in rad/m


def range_ends(
    robot: RobotDescription, spacing: float = _SPACING
) -> tuple[tuple[float, float, int], ...]:
    """Return the ranges' ends in arc length at rest, and their numbers of coarse stations."""
    ends, start = [], 0.0
    for segment in robot.segments:
        for length in (segment.length, segment.connector):
            if length > 0:
                count = 1 + max(1, int(np.ceil(length / (spacing * robot.length) - 1e-9)))
                ends.append((start + _INSET, start + length - _INSET, count))
            start += length
    (_, first, count), (last, _, other) = ends[0], ends[-1]
    if len(ends) == 1:
        return ((0.0, start, count),)
    return ((0.0, first, count), *ends[1:-1], (last, start, other))


def survey(station: StationOf, ends: Sequence[tuple[float, float, int]]) -> list[BodyRange]:
    """Return the coarse stations of all ranges, with bounds on their speed and turn."""
    arcs = [np.linspace(start, end, count) for start, end, count in ends]
    found = station(np.concatenate(arcs))
    points = [
        BodyPoint(float(s), *row) for s, *row in zip(np.concatenate(arcs), *found, strict=True)
    ]
    ranges = []
    for arc in arcs:
        mine, points = points[: len(arc)], points[len(arc) :]
        speed = turn = 0.0
        for a, b in pairwise(mine):
            half = float(np.linalg.norm(b.tangent - a.tangent)) / 2
            bent = asin(min(half, 1.0)) / min(half, 1.0) if half > 1e-6 else 1.0
            chord = float(np.linalg.norm(b.position - a.position))
            speed = max(speed, bent * chord / (b.s - a.s))
            turn = max(turn, 2 * half * bent / (b.s - a.s))
        ranges.append(BodyRange(tuple(mine), speed, turn))
    return ranges


def nearest_point(station: StationOf, item: MeasuredObject, ranges: Sequence[BodyRange]) -> Nearest:
    """Return the point of a body that is nearest to an object.

    `station`: the body. `ranges`: all of it; for objects other than rings, a part of it is allowed.
    """
    search = _Search(station, item)
    first, *others = ranges
    for each in (search.counted(first), *others):
        search.look_at(each)
    search.sharpen()
    assert search.best is not None  # every range has stations
    return _of_ring(search, ranges) if item.is_ring else search.best


class _Search:
    """Search for the least distance of one object."""

    def __init__(self, station: StationOf, item: MeasuredObject) -> None:
        self.station, self.item = station, item
        self.best: Nearest | None = None
        self._slope = 0.0
        self._within: BodyRange | None = None
        self._steepness = _STEEPEST if item.is_interpolated else 1.0

    def point_at(self, s: float) -> BodyPoint:
        """Return a station of the body."""
        position, tangent, radius = self.station(np.array([s]))
        return BodyPoint(s, position[0], tangent[0], float(radius[0]))

    def counted(self, stretch: BodyRange) -> BodyRange:
        """Return the part of a range from `MeasuredObject.begin` on."""
        points = stretch.points
        if points[0].s >= self.item.begin:
            return stretch
        first = self.point_at(min(self.item.begin, points[-1].s))
        return replace(stretch, points=(first, *(each for each in points if each.s > first.s)))

    def look_at(self, stretch: BodyRange) -> None:
        """Search a range for a distance less than the best so far."""
        points = stretch.points
        probes = [self._probe(points[0], stretch)]
        for index, point in enumerate(points[1:], start=1):
            reach = self._steepness * stretch.speed * (point.s - probes[-1].point.s)
            if index == len(points) - 1 or probes[-1].value - reach <= self._to_beat:
                probes.append(self._probe(point, stretch))
        for a, b in pairwise(probes):
            self._refine(a, b, stretch)

    @property
    def _to_beat(self) -> float:
        return inf if self.best is None else self.best.distance - CLEARANCE_ERROR

    def _probe(self, point: BodyPoint, stretch: BodyRange) -> Probe:
        values, normals, pieces = self.item.distances(point.position[None])
        value, normal = float(values[0]) - point.radius, normals[0]
        if not isfinite(value):
            raise ArithmeticError("a distance is not finite")
        slope = stretch.speed * float(normal @ point.tangent)
        if self.best is None or value < self.best.distance:
            self.best = Nearest(value, point.s, 1.0, point.position, normal)
            self._slope, self._within = slope, stretch
        return Probe(point, value, slope, normal, int(pieces[0]))

    def _least_between(self, a: Probe, b: Probe, stretch: BodyRange) -> float:
        """Return a lower bound of the distance between two probes; derived in scene.h."""
        h = b.point.s - a.point.s
        least = (a.value + b.value - self._steepness * stretch.speed * h) / 2
        m = _MORE_CURVED * stretch.speed * stretch.turn
        if least >= self._to_beat:
            return least
        if self.item.along == "concave":
            return max(least, self._least_of_pieces(a, b) - m * h * h / 8)
        first, second = a.value + a.point.radius, b.value + b.point.radius
        if self.item.along == "any" and first > 0 and second > 0:
            chord = float(np.linalg.norm(b.point.position - a.point.position))
            found = _outside_spheres(chord, first, second) - m * h * h / 8
            least = max(least, found - max(a.point.radius, b.point.radius))
        if self.item.along != "convex" and h > _FINE:
            return least
        down, up = a.slope - m * h / 2, b.slope + m * h / 2
        if down >= 0:
            return max(least, a.value)
        if up <= 0:
            return max(least, b.value)
        u = (b.value - a.value - up * h) / (down - up)
        return max(least, a.value + down * min(max(u, 0.0), h))

    def _least_of_pieces(self, a: Probe, b: Probe) -> float:
        """Return the least, along straight lines, of the larger of the pieces' distances."""
        if a.piece == b.piece:
            return min(a.value, b.value)
        of_a_at_b = self.item.piece_distance(a.piece, b.point.position) - b.point.radius
        of_b_at_a = self.item.piece_distance(b.piece, a.point.position) - a.point.radius
        crossing = a.value - of_b_at_a + b.value - of_a_at_b
        share = (a.value - of_b_at_a) / crossing if crossing > 0 else 0.0
        return min(a.value, b.value, a.value + (of_a_at_b - a.value) * share)

    def _refine(self, a: Probe, b: Probe, stretch: BodyRange) -> None:
        """Divide the interval between two probes as long as it may contain a smaller distance."""
        h, share = b.point.s - a.point.s, 0.5
        if h < _SHORTEST or self._least_between(a, b, stretch) >= self._to_beat:
            return
        if a.slope < 0 < b.slope:
            share = min(max(a.slope / (a.slope - b.slope), 0.1), 0.9)
        middle = self._probe(self.point_at(a.point.s + share * h), stretch)
        self._refine(a, middle, stretch)
        self._refine(middle, b, stretch)

    def sharpen(self) -> None:
        """Move the best point to where the slope is zero, so that its normal is accurate too."""
        stretch, best = self._within, self.best
        if stretch is None or best is None:
            return
        low, high = stretch.points[0].s, stretch.points[-1].s
        step = -_SHARPENED if self._slope > 0 else _SHARPENED
        slope = self._slope
        if not low < best.s + step < high:
            return
        change = slope - self._probe(self.point_at(best.s + step), stretch).slope
        if change == 0 or abs(step * slope / change) >= _FINE:
            return
        if low < best.s + step * slope / change < high:
            self._probe(self.point_at(best.s + step * slope / change), stretch)


def _outside_spheres(chord: float, first: float, second: float) -> float:
    """Return a lower bound of the distance from a chord to points outside two end spheres."""
    x = (chord**2 + first**2 - second**2) / (2 * chord)
    if x <= 0:
        return first
    return second if x >= chord else sqrt(max(first**2 - x**2, 0.0))


def _of_ring(search: _Search, ranges: Sequence[BodyRange]) -> Nearest:
    """Return a ring's distance, that of its circle; negative if the centre line passes outside."""
    assert search.best is not None
    points = [point for stretch in ranges for point in stretch.points]
    seen = search.item.passages(np.stack([point.position for point in points]))
    heights = np.where(np.abs(seen.heights) < _IN_PLANE, 0.0, seen.heights)
    crossed = passed = False
    for index in range(1, len(points)):
        low, high = heights[index - 1], heights[index]
        if high == 0 or low * high > 0:
            continue
        if low == 0:
            inside = bool(seen.beyond[index - 1] <= 0)
        else:
            inside = _passes_between(search, points[index - 1], points[index], low, high)
        crossed, passed = True, passed ^ inside
    best = search.best
    if passed:
        return best
    if crossed:
        radius = search.point_at(best.s).radius
        return best._replace(distance=-best.distance - 2 * radius, normal=-best.normal)
    tip = points[-1]
    return Nearest(-float(seen.from_disc[-1]), tip.s, 0.0, tip.position, -seen.normals[-1])


def _passes_between(search: _Search, a: BodyPoint, b: BodyPoint, low: float, high: float) -> bool:
    """Return whether the centre line crosses the disc between two points."""
    s0, s1, beyond, from_below = a.s, b.s, 0.0, low <= 0
    for turn in range(60):
        if s1 - s0 <= _SHORTEST:
            break
        share = 0.5 if turn % 2 else min(max(low / (low - high), 0.01), 0.99)
        s = s0 + share * (s1 - s0)
        seen = search.item.passages(search.point_at(s).position[None])
        height, beyond = float(seen.heights[0]), float(seen.beyond[0])
        if (height <= 0) == from_below:
            s0, low = s, height
        else:
            s1, high = s, height
    return beyond <= 0
