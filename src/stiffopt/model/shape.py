"""What the model knows of a point of the arm, symbolically, in closed form.

`FreeShape` (here, no loads) and `Chain` (`stiffopt.model.shooting`, equilibrium under loads)
offer the same things, so that whatever is computed from a shape works for both.
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

    @property
    def pressures(self) -> ca.SX | ca.MX:
        """Channel pressures (n,)."""

    def station(self, at: float) -> "PointOfArm":
        """Another point of the same arm, at arc length `at` (m, at rest, from the base)."""

    def flexibility(self, wrench: ca.SX | ca.MX) -> ca.SX | ca.MX:
        """``w' C w`` of a wrench (6,) at the station, in its own axes: what it does there."""

    def total_jacobian(self, values: ca.SX | ca.MX) -> ca.SX | ca.MX:
        """Derivative (k, n) of values (k,) of this shape by the pressures."""


@dataclass(frozen=True)
class PointOfArm:
    """Where a point of the arm is.

    Attributes
    ----------
    position : in the base frame, (3,).
    rotation : axes (3, 3) of the section in the base frame.
    """

    position: ca.SX | ca.MX
    rotation: ca.SX | ca.MX


@dataclass(frozen=True)
class ShapePiece:
    """A soft stretch of constant strain, or a rigid one.

    Attributes
    ----------
    motion : pose (4, 4) of its far end in its near end.
    half : pose of its far end in its middle.
    pressures : those (c,) that it depends on.
    section : none if it is rigid.
    length : at rest, in m.
    """

    motion: ca.SX
    half: ca.SX
    pressures: ca.SX
    section: Section | None
    length: ca.SX | float


@dataclass(frozen=True)
class FreeShape:
    """The unloaded arm: a chain of exponentials (eq. 7) and its compliance (eq. 17).

    Attributes
    ----------
    pressures : those (n,) of the whole arm.
    pieces : from the base to the station.
    """

    pressures: ca.SX
    pieces: tuple[ShapePiece, ...]

    @classmethod
    def of(
        cls, description: RobotDescription, actuation: Actuation, at: float | None = None
    ) -> "FreeShape":
        """Shape at arc length `at` at rest, from the base (None: the tip)."""
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
        """``w' C w`` of a wrench (6,) at the station: twice the strain energy that it stores."""
        total = ca.SX(0)
        for piece in reversed(self.pieces):
            wrench = _moved_back(piece.half, wrench)
            if piece.section is not None:
                total += segment_flexibility(piece.section, piece.length, wrench)
            wrench = _moved_back(piece.half, wrench)
        return total

    def total_jacobian(self, values: ca.SX) -> ca.SX:
        """Derivative (k, n) of values (k,) by the pressures."""
        return ca.jacobian(values, self.pressures)


def stiffness_along(
    shape: Shape,
    direction: ca.SX | ca.MX,
    frame: Frame,
    kind: Kind,
    boundary: Boundary,
) -> ca.SX | ca.MX:
    """Stiffness of a shape along (or about) a unit direction; see `directional_stiffness`.

    That of a free tip is read from the strain energy of a unit load, which is several times
    cheaper than the 6x6 compliance.
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
    """Wrench (6,) of a frame in the one from which T leads to it, without zeros of `coadjoint`."""
    force, moment = T[:3, :3] @ wrench[:3], T[:3, :3] @ wrench[3:]
    return ca.vertcat(force, moment + ca.cross(T[:3, 3], force))
