"""Stiffness along a direction, or about it."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

import casadi as ca
from pydantic import Field, ValidationInfo, field_serializer, field_validator

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.directions import Direction, Frame
from stiffopt.display import display_units
from stiffopt.model.compliance import Boundary, Kind, held_stiffness
from stiffopt.model.shape import FreeShape, stiffness_along
from stiffopt.optimise.measure import Measure, Role
from stiffopt.schema import JsonSchemaOfFile
from stiffopt.units import (
    Ratio,
    finite_number,
    format_quantity,
    parse_quantity,
    quantity_schema,
    read_from_file,
)

_STIFFNESS_UNITS = {"translation": "N/m", "rotation": "N*m/rad"}


class StiffnessMeasure(Measure):
    """One directional stiffness of the tip.

    Attributes
    ----------
    direction : unit vector of the force or, for a rotation, axis of the moment.
    frame : the axes in which `direction` is given.
    kind : stiffness against translation or rotation.
    boundary : "free": the tip may also move in other ways; "guided": it may not translate (for a
        rotation: not rotate) otherwise; "clamped": it may not move otherwise at all.
    """

    key: ClassVar[str] = "direction"
    role: ClassVar[Role] = "maximise"

    direction: Direction
    frame: Frame = "base"
    kind: Kind = "translation"
    boundary: Boundary = "free"

    @property
    def unit(self) -> Literal["N/m", "N*m/rad"]:
        """Unit of the stiffness."""
        return "N/m" if self.kind == "translation" else "N*m/rad"

    @property
    def structure(self) -> tuple[str, ...]:
        """Kind, frame and boundary."""
        return ("direction", self.kind, self.frame, self.boundary)

    @property
    def parameters(self) -> tuple[float, ...]:
        """The unit direction (3,)."""
        return self.direction

    def formula(self, tip: Any, parameters: Any) -> Any:
        """Return ``log k``; see `stiffopt.model.compliance.directional_stiffness`."""
        k = stiffness_along(tip, parameters[:3], self.frame, self.kind, self.boundary)
        return ca.log(k)

    def formula_gradient(self, tip: Any, parameters: Any) -> Any:
        """Return the derivative of the value; see `Measure.formula_gradient`.

        For a guided or clamped tip, ``k = d' K d``, and the wrench W moves the tip by d.  Then
        ``dk = -W' dC W``, in axes in which d does not turn: the derivative of a flexibility, which
        takes a third of the operations.
        """
        if self.boundary == "free" or not isinstance(tip, FreeShape):
            return super().formula_gradient(tip, parameters)
        turn = tip.rotation.T if self.frame == "base" else ca.SX.eye(3)
        stiffness, wrench = held_stiffness(
            tip.compliance,
            turn @ parameters[:3],
            self.kind == "rotation",
            self.boundary == "clamped",
        )
        still = ca.SX.sym("wrench", 6)
        slope = tip.total_jacobian(tip.flexibility(lie.rotate_blocks(turn) @ still))
        return -ca.substitute(slope, still, lie.rotate_blocks(turn.T) @ wrench) / stiffness

    def words(self) -> str:
        """Direction, frame, kind and boundary."""
        way = "along" if self.kind == "translation" else "about"
        vector = ", ".join(f"{round(value, 3) + 0.0:g}" for value in self.direction)
        return f"against {self.kind} {way} ({vector}), {self.frame} axes, {self.boundary}"

    def stiffness_gradient(self, robot: Any, pressures: Array) -> Array | None:
        """See `Measure.stiffness_gradient`."""
        return robot.stiffness_gradient(
            pressures, self.direction, self.kind, self.boundary, self.frame
        )


class _ValuedMeasure(StiffnessMeasure):
    value: Annotated[
        float,
        Field(gt=0),
        JsonSchemaOfFile(lambda _: quantity_schema("stiffness", "1.3 N/m", "0.2 N*m/rad")),
    ]

    @field_validator("value", mode="before")
    @classmethod
    def _read_value(cls, value: Any, info: ValidationInfo) -> float:
        if not isinstance(value, str) and not read_from_file(info):
            return finite_number(value)
        kind = info.data.get("kind", "translation")
        return parse_quantity(value, _STIFFNESS_UNITS[kind], f"stiffness against {kind}")

    @field_serializer("value", when_used="json")
    def _write_value(self, value: float) -> str:
        return format_quantity(value, self.unit)


class AtLeast(_ValuedMeasure):
    """A stiffness with a lower bound `value` (N/m, for a rotation N m/rad)."""

    role: ClassVar[Role] = "at_least"

    def holds(self, value: float) -> bool:
        """See `Measure.holds`."""
        return value >= self.value

    def shortfall(self, value: float) -> str:
        """See `Measure.shortfall`."""
        unit = display_units().of_si(self.unit)
        return f"at least {unit.text(self.value)} asked for, {unit.number(value)} is the most"


class MatchValue(_ValuedMeasure):
    """A stiffness to be matched, `value` (N/m, for a rotation N m/rad).

    Attributes
    ----------
    tolerance : largest relative deviation.
    """

    role: ClassVar[Role] = "match"

    tolerance: Annotated[Ratio, Field(gt=0, lt=1)] = 0.01

    @property
    def parameters(self) -> tuple[float, ...]:
        """The unit direction (3,) and the logarithm of the value."""
        return (*self.direction, math.log(self.value))

    @property
    def structure(self) -> tuple[str, ...]:
        """Kind, frame and boundary of what is matched."""
        return ("match", *super().structure)

    def mismatch(self, value: Any, parameters: Any) -> tuple[Any, Any]:
        """Return ``(log k - log value)^2`` and its derivative."""
        return (value - parameters[3]) ** 2, 2 * (value - parameters[3])

    def holds(self, value: float) -> bool:
        """See `Measure.holds`."""
        return abs(value / self.value - 1) <= self.tolerance

    def shortfall(self, value: float) -> str:
        """See `Measure.shortfall`."""
        unit = display_units().of_si(self.unit)
        return f"{unit.text(self.value)} asked for, {unit.number(value)} is nearest"
