"""`Press`, the key ``press`` of a task file: the tip presses with a given force."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from stiffopt.arrays import Array
from stiffopt.directions import Direction, Frame
from stiffopt.schema import Schema
from stiffopt.units import Force, Length, Speed, within

SOFT_SHARE = 0.15
"""Compliance, as a share of the largest, below which a direction is too stiff to feel forces."""
LEAST_SHARE = 0.5
"""Squared share of a force that must act in the directions in which the tip is soft."""
POSITION_ERROR = 5e-4
"""Change of the model's tip error along the short path of an approach, in m."""
FELT_SHARE, FELT_FORCE = 0.2, 3e-3
"""Allowed error of a felt force: a share of it, plus a part in N."""
LATE = 0.2
"""Time after a contact in which the approach goes on, in s."""


class Press(Schema):
    """A force with which the tip presses, starting at the target along a direction.

    Attributes
    ----------
    force : in N.
    direction : unit vector in which the tip pushes.
    frame : "base", or "tip": the axes of the tip at the target.
    tolerance : largest error of the estimated force, in N.
    speed : greatest speed of the approach, in m/s.
    travel : greatest travel of the tip along the direction, in m.
    """

    force: Annotated[Force, Field(gt=0), within(1e6, "N")]
    direction: Direction
    frame: Frame = "base"
    tolerance: Annotated[Force, Field(gt=0)] = 3e-3
    speed: Annotated[Speed, Field(gt=0)] = 5e-3
    travel: Annotated[Length, Field(gt=0)] = 0.01

    def direction_in_base(self, rotation: Array) -> Array:
        """Return the direction (3,) in base axes, for a tip with axes (3, 3)."""
        direction = np.array(self.direction)
        return rotation @ direction if self.frame == "tip" else direction

    def __repr__(self) -> str:
        axes = "" if self.frame == "base" else " of the tip"
        return f"Press({1e3 * self.force:g} mN along ({_numbers(self.direction)}){axes})"

    def refusal(self, rotation: Array, compliance: Array) -> str:
        """Return why a force along the direction could not be felt, or "".

        The direction must be soft enough, and the force more than the allowed error of a felt one
        and than what a rigid surface gets before the contact is felt.

        `rotation`: (3, 3), axes of the tip in the base frame. `compliance`: (3, 3), displacement of
        the tip per force in base axes, in m/N.
        """
        felt = Feeling.of(self.direction_in_base(rotation), compliance)
        allowed = FELT_SHARE * self.force + FELT_FORCE
        deviation = felt.deviation(POSITION_ERROR)
        at_once = self.speed * LATE / max(felt.compliance, 1e-12)  # against a rigid surface
        force = f"{1e3 * self.force:.3g} mN"
        if felt.share < LEAST_SHARE or deviation > allowed:
            return (
                f"the arm cannot feel how hard it presses along ({_numbers(self.direction)})"
                f"{' of the tip' if self.frame == 'tip' else ''}: it is too stiff there, "
                f"{1 / felt.compliance:.3g} N/m, so that {1e3 * POSITION_ERROR:g} mm of error look "
                f"like {1e3 * deviation:.3g} mN; press along a softer direction, or harder"
            )
        if self.force <= allowed:
            return (
                f"the arm cannot feel so small a force: with an error of up to "
                f"{100 * FELT_SHARE:g} % + {1e3 * FELT_FORCE:g} mN, {force} may be none at all; "
                f"press with more than {1e3 * FELT_FORCE / (1 - FELT_SHARE):.3g} mN"
            )
        if self.tolerance >= self.force:
            return (
                f"{force} with a tolerance of {1e3 * self.tolerance:.3g} mN may be none at all; "
                "press.tolerance must be less than press.force"
            )
        if at_once > self.force:
            return (
                f"an approach at {1e3 * self.speed:.3g} mm/s may press with {1e3 * at_once:.3g} mN "
                f"before a contact is felt, more than {force}; press.speed must be at most "
                f"{1e3 * self.speed * self.force / at_once:.2g} mm/s there"
            )
        return ""


@dataclass(frozen=True)
class Feeling:
    """How well a force along a direction shows as a displacement of the tip.

    `share`: squared share of the force that acts in the directions in which the tip is soft.
    `compliance`: displacement along the direction per force along it, in m/N.
    """

    share: float
    compliance: float

    @classmethod
    def of(cls, direction: Array, compliance: Array) -> Feeling:
        """Return how well a force along a unit vector (3,) is felt, for a compliance (3, 3)."""
        felt = soft_directions(compliance)
        return cls(float(direction @ felt @ direction), float(direction @ compliance @ direction))

    def deviation(self, error: float) -> float:
        """Return the error of a felt force, in N, due to an error of the tip's position, in m."""
        return error / max(self.compliance, 1e-12)


def _numbers(direction: tuple[float, ...]) -> str:
    return ", ".join(f"{part:.3g}" for part in direction)


def soft_directions(compliance: Array) -> Array:
    """Return the projection (3, 3) on the directions in which a tip of this compliance is soft."""
    sizes, axes = np.linalg.eigh(compliance)
    soft = axes[:, sizes > SOFT_SHARE * sizes[-1]]
    return soft @ soft.T
