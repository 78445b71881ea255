"""What the model knows of a point of the arm, symbolically, in closed form.

`FreeShape` (here, no loads) and `Chain` (`stiffopt.model.shooting`, equilibrium under loads)
offer the same things, so that whatever is computed from a shape works for both.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import casadi as ca

from stiffopt import lie
from stiffopt.model.compliance import carry_compliance, segment_compliance
from stiffopt.model.description import RobotDescription
from stiffopt.model.kinematics import Actuation, body_jacobian, connector, segment_pose


class Shape(Protocol):
    """Pose of a station of the arm (its tip, or a point on the way) and how it gives way."""

    @property
    def inputs(self) -> tuple[ca.SX | ca.MX, ...]:
        """Symbols that a function of this shape takes."""

    @property
    def rotation(self) -> ca.SX | ca.MX:
        """Axes (3, 3) of the station in the base frame."""

    @property
    def position(self) -> ca.SX | ca.MX:
        """Position (3,) of the station in the base frame."""

    @property
    def transform(self) -> ca.SX | ca.MX:
        """Pose (4, 4) of the station in the base frame."""

    @property
    def jacobian(self) -> ca.SX | ca.MX:
        """Body twist (6, n) of the station per unit pressure."""

    @property
    def compliance(self) -> ca.SX | ca.MX:
        """Compliance (6, 6) of the station in its own axes."""

    def total_jacobian(self, values: ca.SX | ca.MX) -> ca.SX | ca.MX:
        """Derivative (k, n) of values (k,) of this shape by the pressures."""


@dataclass(frozen=True)
class FreeShape:
    """The unloaded arm: a chain of exponentials (eq. 7) and its compliance (eq. 17)."""

    pressures: ca.SX
    transform: ca.SX
    compliance: ca.SX

    @classmethod
    def of(
        cls, description: RobotDescription, actuation: Actuation, at: float | None = None
    ) -> "FreeShape":
        """Shape at arc length `at` at rest, from the base (None: the tip)."""
        left = description.length if at is None else at
        T, C = ca.SX.eye(4), ca.SX.zeros(6, 6)
        for segment, section in zip(description.segments, actuation.sections, strict=True):
            soft = min(segment.length, left)
            rigid = min(segment.connector, left - soft)
            left -= soft + rigid
            if soft > 0:
                motion = segment_pose(section, soft)
                T = T @ motion
                C = carry_compliance(C, lie.inverse(motion)) + segment_compliance(section, soft)
            if rigid > 0:
                T = T @ connector(rigid)
                C = carry_compliance(C, lie.inverse(connector(rigid)))
        return cls(actuation.pressures, T, C)

    @property
    def inputs(self) -> tuple[ca.SX, ...]:
        """The pressures (n,)."""
        return (self.pressures,)

    @property
    def rotation(self) -> ca.SX:
        """Axes (3, 3) of the station in the base frame."""
        return self.transform[:3, :3]

    @property
    def position(self) -> ca.SX:
        """Position (3,) of the station in the base frame."""
        return self.transform[:3, 3]

    @cached_property
    def jacobian(self) -> ca.SX:
        """Body twist (6, n) of the station per unit pressure."""
        return body_jacobian(self.transform, self.pressures)

    def total_jacobian(self, values: ca.SX) -> ca.SX:
        """Derivative (k, n) of values (k,) by the pressures."""
        return ca.jacobian(values, self.pressures)
