"""Least distances of a body from the objects of a scene, followed one by one as pressures change.

Searches take the nearest point of each object.  Derivatives of an answer need functions that are
smooth in the pressures: each local minimum along the body is a condition of its own,
``d(p) = min d(x(s, p)) - r(p)`` for s about where it was.  Its gradient is that with s held (the
envelope theorem).  Where the distance has a kink along the body, between cubes of a mesh's grid or
the straight pieces of a tube, it is that of the mean of both sides that does not change along it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import DerivativeError
from stiffopt.model.arm_clearance import ArmBody, gradients
from stiffopt.model.clearance import Nearest, range_ends
from stiffopt.model.distances import MeasuredObject
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.stopping import checkpoint
from stiffopt.optimise.obstacles import Obstacles
from stiffopt.optimise.settings import OBSTACLES

Vector = NDArray[np.float64]

_SPACING = 1 / 200  # of stations among which minima are seen, as a share of the arm's length
_AROUND = 1e-3  # m of arc length, within which a minimum is looked for first
_STATIONS = 33  # of each look
_EXACT = 1e-13  # m of arc length


class LeastDistance(NamedTuple):
    """A local minimum, along the body, of the distance from one object.

    Attributes
    ----------
    which : number of the object.
    s : arc length at rest, in m.
    low, high : ends of the range of the body that it is in.
    """

    which: int
    s: float
    low: float
    high: float


@dataclass(frozen=True)
class FollowedObstacles(Obstacles):
    """The objects around one arm, by the least distances that are less than a margin too large.

    Attributes
    ----------
    pressures : ndarray (n,)
        At which these were found, in Pa.
    least : tuple of LeastDistance
        One for each row.
    """

    arm: Manipulator = field(repr=False, compare=False)
    pressures: Vector = field(repr=False, compare=False)
    least: tuple[LeastDistance, ...] = field(init=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "least", tuple(self._found()))
        object.__setattr__(self, "row_objects", tuple(each.which for each in self.least))

    def _found(self) -> Iterator[LeastDistance]:
        ranges = range_ends(self.description, _SPACING)
        s = np.concatenate([np.linspace(start, end, count) for start, end, count in ranges])
        ends = np.repeat([each[:2] for each in ranges], [each[2] for each in ranges], axis=0)
        positions, _, radii = ArmBody(self.arm, self.pressures)(s)
        for index, item in enumerate(self.measured.items):
            values = item.distances(positions).values - radii
            beside = np.concatenate([[np.inf], values, [np.inf]])
            least = (values <= beside[:-2]) & (values < beside[2:])
            least &= values < self.scene.clearance + OBSTACLES.margin
            for i in np.flatnonzero(least).tolist():
                yield LeastDistance(index, float(s[i]), *ends[i].tolist())

    def rows(self, arm: Manipulator, p: Vector) -> tuple[Vector, Vector]:
        """See `Obstacles.rows`."""
        checkpoint()
        body = ArmBody(arm, p)
        found = [_followed(body, self.measured.items[each.which], each) for each in self.least]
        if not found:
            return np.zeros(0), np.zeros((0, len(p)))
        distances = np.array([nearest.distance for nearest in found])
        rows = OBSTACLES.margin - (distances - self.scene.clearance)
        return rows, -gradients(arm, p, found)


class _Look:
    """Stations of a body with their distances, and how these change along it."""

    def __init__(self, body: ArmBody, item: MeasuredObject, at: Vector) -> None:
        self.at = at
        self.positions, tangents, radii = body(at)
        seen = item.distances(self.positions)
        self.values, self.normals = seen.values - radii, seen.normals
        self.slopes = np.einsum("ij,ij->i", self.normals, tangents)

    def valley(self, s: float) -> int | None:
        """After which station the distance no longer falls, next to s; None if nowhere."""
        turns = np.flatnonzero((self.slopes[:-1] < 0) & (self.slopes[1:] >= 0))
        return int(turns[np.abs(self.at[turns] - s).argmin()]) if len(turns) else None

    def end(self, least: LeastDistance) -> int | None:
        """Which end of the range the distance falls to, as far as is seen here."""
        ends = (0, len(self.at) - 1)
        falls_to = (
            self.at[0] == least.low and self.slopes[0] >= 0,
            self.at[-1] == least.high and self.slopes[-1] < 0,
        )
        found = [i for i, falls in zip(ends, falls_to, strict=True) if falls]
        return min(found, key=lambda i: abs(float(self.at[i]) - least.s), default=None)

    def nearest(self, i: int, share: float = 0.0) -> Nearest:
        """At a station, or at a share of the way to the next."""
        parts = (self.values, self.at, self.positions, self.normals)
        value, s, position, normal = (
            of[i] + share * (of[i + 1] - of[i]) if share else of[i] for of in parts
        )
        return Nearest(float(value), float(s), 1.0, position, normal)


def _followed(body: ArmBody, item: MeasuredObject, least: LeastDistance) -> Nearest:
    """A local minimum at the pressures of a body."""
    around = _AROUND
    while True:
        low, high = max(least.low, least.s - around), min(least.high, least.s + around)
        look = _Look(body, item, np.linspace(low, high, _STATIONS))
        i = look.valley(least.s)
        end = look.end(least)
        if i is not None:
            break
        if end is not None:
            return look.nearest(end)
        if low == least.low and high == least.high:
            raise DerivativeError("the place of the arm that is nearest to an object is not clear")
        around *= 4
    while look.at[i + 1] - look.at[i] > _EXACT:
        look = _Look(body, item, np.linspace(look.at[i], look.at[i + 1], _STATIONS))
        i = look.valley(least.s) or 0
    return look.nearest(i, look.slopes[i] / (look.slopes[i] - look.slopes[i + 1]))
