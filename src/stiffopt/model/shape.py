"""Symbolic pose, Jacobian and compliance of a point of the arm.

`FreeShape` (here, closed form without loads) and `Chain` (`stiffopt.model.shooting`, equilibrium
under loads) implement the interface `Shape`, so formulas of a shape work for both.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import casadi as ca

from stiffopt import lie
from stiffopt.model.actuation import Section
from stiffopt.model.compliance import (
    Boundary,
    Frame,
    Kind,
    carry_compliance,
    directional_stiffness,
    segment_compliance,
    segment_flexibility,
)
from stiffopt.model.description import RobotDescription
from stiffopt.model.kinematics import Actuation, connector, segment_jacobian, segment_pose


class Shape(Protocol):
    """Symbolic pose, Jacobian and compliance of a station of the arm, its tip by default."""

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

    @property
    def pressures(self) -> ca.SX | ca.MX:
        """Channel pressures (n,)."""

    def station(self, at: float) -> "PointOfArm":
        """Return another point of the same arm, at arc length `at` (m, at rest, from the base)."""

    def flexibility(self, wrench: ca.SX | ca.MX) -> ca.SX | ca.MX:
        """Return ``w' C w`` of a wrench (6,) at the station, in its own axes."""

    def total_jacobian(self, values: ca.SX | ca.MX) -> ca.SX | ca.MX:
        """Return the derivative (k, n) of values (k,) of this shape by the pressures."""


@dataclass(frozen=True)
class PointOfArm:
    """Position and axes of a point of the arm.

    `position`: in the base frame, (3,). `rotation`: axes (3, 3) of the section in the base frame.
    """

    position: ca.SX | ca.MX
    rotation: ca.SX | ca.MX


@dataclass(frozen=True)
class ShapePiece:
    """A soft piece of constant strain, or a rigid one."""

    motion: ca.SX  # pose (4, 4) of its far end in its near end
    half: ca.SX  # pose of its far end in its middle
    pressures: ca.SX  # pressures (c,) that it depends on
    section: Section | None  # None if it is rigid
    length: ca.SX | float  # at rest, in m


@dataclass(frozen=True)
class FreeShape:
    """The unloaded arm: a product of exponentials (eq. 7) and its compliance (eq. 17).

    `pressures`: pressures (n,) of the whole arm. `pieces`: from the base to the station.
    """

    pressures: ca.SX
    pieces: tuple[ShapePiece, ...]

    @classmethod
    def of(
        cls, description: RobotDescription, actuation: Actuation, at: float | None = None
    ) -> "FreeShape":
        """Return the shape at arc length `at` at rest, from the base (None: the tip)."""
        left = at
        pieces, start = [], 0
        for segment, section in zip(description.segments, actuation.sections, strict=True):
            own = actuation.pressures[start : start + segment.n_channels]
            start += segment.n_channels
            soft, rigid = segment.length, segment.connector
            if left is not None:
                soft = min(soft, left)
                rigid = min(rigid, left - soft)
                left -= soft + rigid
            if _may_be_positive(soft):
                motion, half = segment_pose(section, soft), segment_pose(section, soft / 2)
                pieces.append(ShapePiece(motion, half, own, section, soft))
            if _may_be_positive(rigid):
                pieces.append(
                    ShapePiece(connector(rigid), connector(rigid / 2), own[:0], None, rigid)
                )
        return cls(actuation.pressures, tuple(pieces))

    @property
    def inputs(self) -> tuple[ca.SX, ...]:
        """The pressures (n,)."""
        return (self.pressures,)

    @cached_property
    def transform(self) -> ca.SX:
        """Pose (4, 4) of the station in the base frame."""
        T = ca.SX.eye(4)
        for piece in self.pieces:
            T = T @ piece.motion
        return T

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
        J = ca.SX(6, 0)
        for piece in self.pieces:
            J = lie.adjoint(lie.inverse(piece.motion)) @ J
            if piece.section is not None:
                own = segment_jacobian(piece.section, piece.length, piece.pressures)
                J = ca.horzcat(J, own)
        missing = self.pressures.numel() - J.shape[1]
        return ca.horzcat(J, ca.SX.zeros(6, missing))

    @cached_property
    def compliance(self) -> ca.SX:
        """Compliance (6, 6) of the station in its own axes."""
        C = ca.SX.zeros(6, 6)
        for piece in self.pieces:
            C = carry_compliance(C, lie.inverse(piece.motion))
            if piece.section is not None:
                C += segment_compliance(piece.section, piece.length, piece.half)
        return C

    def station(self, at: float) -> PointOfArm:
        """See `Shape.station`."""
        T, left = ca.SX.eye(4), ca.SX(at)
        for piece in self.pieces:
            length = ca.fmax(ca.fmin(left, piece.length), 0)
            left -= piece.length
            own = (
                connector(length) if piece.section is None else segment_pose(piece.section, length)
            )
            T = T @ own
        return PointOfArm(T[:3, 3], T[:3, :3])

    def flexibility(self, wrench: ca.SX) -> ca.SX:
        """Return ``w' C w`` of a wrench (6,) at the station: twice its strain energy."""
        total = ca.SX(0)
        for piece in reversed(self.pieces):
            wrench = _moved_back(piece.half, wrench)
            if piece.section is not None:
                total += segment_flexibility(piece.section, piece.length, wrench)
            wrench = _moved_back(piece.half, wrench)
        return total

    def total_jacobian(self, values: ca.SX) -> ca.SX:
        """Return the derivative (k, n) of values (k,) by the pressures."""
        return ca.jacobian(values, self.pressures)


def stiffness_along(
    shape: Shape,
    direction: ca.SX | ca.MX,
    frame: Frame,
    kind: Kind,
    boundary: Boundary,
) -> ca.SX | ca.MX:
    """Return the stiffness of a shape along (or about) a unit direction.

    See `directional_stiffness`.  For a free tip it is computed from the strain energy of a unit
    load, which is several times cheaper than the 6x6 compliance.
    """
    if boundary == "free":
        d = shape.rotation.T @ direction if frame == "base" else direction
        none = ca.DM.zeros(3)
        wrench = ca.vertcat(d, none) if kind == "translation" else ca.vertcat(none, d)
        return 1 / shape.flexibility(wrench)
    return directional_stiffness(
        shape.compliance, shape.rotation, direction, frame=frame, kind=kind, boundary=boundary
    )


def _may_be_positive(length: ca.SX | float) -> bool:
    return isinstance(length, ca.SX) or length > 0


def _moved_back(T: ca.SX, wrench: ca.SX) -> ca.SX:
    """Transform a wrench (6,) by T to the frame of T, without the zeros of `coadjoint`."""
    force, moment = T[:3, :3] @ wrench[:3], T[:3, :3] @ wrench[3:]
    return ca.vertcat(force, moment + ca.cross(T[:3, 3], force))
