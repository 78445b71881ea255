"""Twists and wrenches as screws: an axis in space, a pitch and a magnitude (eqs 1 and 4)."""

from dataclasses import dataclass
from math import inf
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.errors import InputError, shown
from stiffopt.model.arguments import (
    checked_motion,
    checked_number,
    checked_vector,
    length_and_unit,
)


@dataclass(frozen=True, eq=False)
class _Screw:
    """Six coordinates in some frame; subclasses define which half is along the axis."""

    coordinates: Array

    def __post_init__(self) -> None:
        try:
            coordinates = checked_vector("coordinates", self.coordinates, 6)
        except InputError:
            raise InputError(
                f"a {type(self).__name__.lower()} has six finite coordinates, linear part first; "
                f"got {self.coordinates!r}"
            ) from None
        coordinates.flags.writeable = False
        object.__setattr__(self, "coordinates", coordinates)

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return np.array_equal(self.coordinates, other.coordinates)

    def __hash__(self) -> int:
        return hash((type(self), *self.coordinates.tolist()))

    def _along_and_about(self) -> tuple[Array, Array]:
        """Return the vector along the axis, and the other half of the coordinates."""
        raise NotImplementedError

    @property
    def pitch(self) -> float:
        """Advance along the axis per unit about it, in m; infinite if there is none about it."""
        along, other = self._along_and_about()
        length, unit = length_and_unit(along)
        return float(unit @ other / length) if length > 0 else inf

    @property
    def axis_direction(self) -> Array:
        """Unit vector (3,) along the axis; zero for the zero screw."""
        along, other = self._along_and_about()
        return length_and_unit(along if along.any() else other)[1]

    @property
    def axis_point(self) -> Array:
        """Point (3,) of the axis nearest to the frame's origin, in m."""
        along, other = self._along_and_about()
        length, unit = length_and_unit(along)
        return np.cross(unit, other) / length if length > 0 else np.zeros(3)

    @property
    def magnitude(self) -> float:
        """Length of the vector along the axis, or of the other half where that is zero."""
        along, other = self._along_and_about()
        return length_and_unit(along if along.any() else other)[0]

    @classmethod
    def _from_axis(
        cls, point: ArrayLike, direction: ArrayLike, pitch: float
    ) -> tuple[Array, Array]:
        along = checked_vector("direction", direction)
        moment = np.cross(checked_vector("point", point), along)
        return along, moment + checked_number("pitch", pitch) * along


class Twist(_Screw):
    """Infinitesimal motion (v, omega) of eq. (1): ``v = -omega x S0 + h omega``."""

    @property
    def linear(self) -> Array:
        """Velocity or displacement v (3,) of the point at the frame's origin."""
        return self.coordinates[:3]

    @property
    def angular(self) -> Array:
        """Rotation omega (3,)."""
        return self.coordinates[3:]

    @classmethod
    def from_axis(cls, point: ArrayLike, direction: ArrayLike, pitch: float = 0.0) -> Self:
        """Return the twist about an axis through `point`, ``|direction|`` rad; `pitch` is in m."""
        omega, v = cls._from_axis(point, direction, pitch)
        return cls(np.concatenate([v, omega]))

    def transformed(self, T_ab: Array) -> Self:
        """Return the same motion with coordinates in frame a, given in frame b (eq. 15)."""
        return type(self)(lie.adjoint(checked_motion("T_ab", T_ab)) @ self.coordinates)

    def _along_and_about(self) -> tuple[Array, Array]:
        return self.angular, self.linear


class Wrench(_Screw):
    """Force and moment (F, M) of eq. (4): ``M = S0 x F + h F``."""

    @property
    def force(self) -> Array:
        """Force F (3,) in N."""
        return self.coordinates[:3]

    @property
    def moment(self) -> Array:
        """Moment M (3,) in N m about the frame's origin."""
        return self.coordinates[3:]

    @classmethod
    def from_axis(cls, point: ArrayLike, direction: ArrayLike, pitch: float = 0.0) -> Self:
        """Return the wrench along an axis through `point`, ``|direction|`` N; `pitch` is in m."""
        force, moment = cls._from_axis(point, direction, pitch)
        return cls(np.concatenate([force, moment]))

    def transformed(self, T_ab: Array) -> Self:
        """Return the same wrench with coordinates in frame a, given in frame b (eq. 5)."""
        return type(self)(lie.coadjoint(checked_motion("T_ab", T_ab)) @ self.coordinates)

    def power(self, twist: Twist) -> float:
        """Return the work done on a twist in the same frame: ``F.v + M.omega``."""
        if not isinstance(twist, Twist):
            raise InputError(f"a wrench does work on a Twist, not on {shown(twist)}")
        return float(self.coordinates @ twist.coordinates)

    def _along_and_about(self) -> tuple[Array, Array]:
        return self.force, self.moment


def checked_wrench(value: ArrayLike | Wrench) -> Array:
    """Return the coordinates (6,) of a wrench, force first."""
    return checked_vector("wrench", value.coordinates if isinstance(value, Wrench) else value, 6)
