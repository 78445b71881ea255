"""Local minima of a body's distance from objects, tracked one by one as pressures change.

Searches use the nearest point of each object.  Derivatives of an answer need functions that are
smooth in the pressures, so each local minimum along the body is its own constraint: ``d(p) = min
d(x(s, p)) - r(p)`` for s near its former value.  Its gradient is that at fixed s (the envelope
theorem).  Where the distance has a kink along the body, between cubes of a mesh's grid or straight
pieces of a tube, the gradient is the mean of both sides whose slope along the body is zero.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import DerivativeError
from stiffopt.model.arm_clearance import ArmBody, gradients
from stiffopt.model.clearance import Nearest, range_ends
from stiffopt.model.distances import MeasuredObject
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.stopping import checkpoint
from stiffopt.optimise.obstacles import Obstacles
from stiffopt.optimise.settings import OBSTACLES

_SPACING = 1 / 200  # of stations for finding minima, as a share of the arm's length
_AROUND = 1e-3  # half width of the first interval searched for a minimum, m of arc length
_STATIONS = 33  # in each interval
_EXACT = 1e-13  # precision of a minimum, m of arc length


class LeastDistance(NamedTuple):
    """A local minimum, along the body, of the distance from one object."""

    which: int  # index of the object
    s: float  # arc length at rest, in m
    # low, high: ends of the range of the body that contains it
    low: float
    high: float


@dataclass(frozen=True)
class FollowedObstacles(Obstacles):
    """The objects around one arm, with one row for each local minimum near the clearance.

    `pressures`: (n,), pressures at which the minima were found, in Pa. `least`: the minimum of each
    row.
    """

    arm: Manipulator = field(repr=False, compare=False)
    pressures: Array = field(repr=False, compare=False)
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
            padded = np.concatenate([[np.inf], values, [np.inf]])
            least = (values <= padded[:-2]) & (values < padded[2:])
            least &= values < self.scene.clearance + OBSTACLES.margin
            for i in np.flatnonzero(least).tolist():
                yield LeastDistance(index, float(s[i]), *ends[i].tolist())

    def rows(self, arm: Manipulator, p: Array) -> tuple[Array, Array]:
        """See `Obstacles.rows`."""
        checkpoint()
        body = ArmBody(arm, p)
        found = [_followed(body, self.measured.items[each.which], each) for each in self.least]
        if not found:
            return np.zeros(0), np.zeros((0, len(p)))
        distances = np.array([nearest.distance for nearest in found])
        rows = OBSTACLES.margin - (distances - self.scene.clearance)
        return rows, -gradients(arm, p, found)


class _Profile:
    """Stations of a body with their distances, and the slopes of these along it."""

    def __init__(self, body: ArmBody, item: MeasuredObject, at: Array) -> None:
        self.at = at
        self.positions, tangents, radii = body(at)
        seen = item.distances(self.positions)
        self.values, self.normals = seen.values - radii, seen.normals
        self.slopes = np.einsum("ij,ij->i", self.normals, tangents)

    def minimum(self, s: float) -> int | None:
        """Return the station before the minimum that is nearest to s; None without one."""
        turns = np.flatnonzero((self.slopes[:-1] < 0) & (self.slopes[1:] >= 0))
        return int(turns[np.abs(self.at[turns] - s).argmin()]) if len(turns) else None

    def end(self, least: LeastDistance) -> int | None:
        """Return the end of the range towards which the distance falls; None if not included."""
        ends = (0, len(self.at) - 1)
        falls_to = (
            self.at[0] == least.low and self.slopes[0] >= 0,
            self.at[-1] == least.high and self.slopes[-1] < 0,
        )
        found = [i for i, falls in zip(ends, falls_to, strict=True) if falls]
        return min(found, key=lambda i: abs(float(self.at[i]) - least.s), default=None)

    def nearest(self, i: int, share: float = 0.0) -> Nearest:
        """Return the nearest point at a station, or at a share of the way to the next."""
        parts = (self.values, self.at, self.positions, self.normals)
        value, s, position, normal = (
            of[i] + share * (of[i + 1] - of[i]) if share else of[i] for of in parts
        )
        return Nearest(float(value), float(s), 1.0, position, normal)


def _followed(body: ArmBody, item: MeasuredObject, least: LeastDistance) -> Nearest:
    """Return a local minimum at the pressures of a body, searching from its former place."""
    around = _AROUND
    while True:
        low, high = max(least.low, least.s - around), min(least.high, least.s + around)
        profile = _Profile(body, item, np.linspace(low, high, _STATIONS))
        i = profile.minimum(least.s)
        end = profile.end(least)
        if i is not None:
            break
        if end is not None:
            return profile.nearest(end)
        if low == least.low and high == least.high:
            raise DerivativeError("the place of the arm that is nearest to an object is not clear")
        around *= 4
    while profile.at[i + 1] - profile.at[i] > _EXACT:
        profile = _Profile(body, item, np.linspace(profile.at[i], profile.at[i + 1], _STATIONS))
        i = profile.minimum(least.s) or 0
    return profile.nearest(i, profile.slopes[i] / (profile.slopes[i] - profile.slopes[i + 1]))
