"""What is asked of the tip's stiffness: the part ``stiffness`` of the task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    ValidationInfo,
    field_serializer,
    field_validator,
    model_validator,
)

from stiffopt.directions import Direction, Frame
from stiffopt.errors import InputError
from stiffopt.schema import BadKeyError, Items, Schema, Vector
from stiffopt.units import (
    Number,
    Ratio,
    finite_number,
    format_quantity,
    parse_quantity,
    read_from_file,
)

__all__ = ["AtLeast", "MatchMatrix", "MatchValue", "StiffnessGoal", "StiffnessMeasure"]

Kind = Literal["translation", "rotation"]
Boundary = Literal["free", "guided", "clamped"]

_STIFFNESS_UNITS = {"translation": "N/m", "rotation": "N*m/rad"}

MeasureT = TypeVar("MeasureT")


def _as_items(value: Any, info: ValidationInfo) -> Any:
    """Let one mapping stand for a list of one; refuse an empty list in a file."""
    if isinstance(value, Mapping | StiffnessMeasure):
        return (value,)
    if read_from_file(info) and not value:
        raise InputError("is empty; expected at least one mapping with a direction")
    return value


def _match_kind(value: Any) -> str:
    """Tell a stiffness matrix to match from a value to match."""
    matrix = "matrix" in value if isinstance(value, Mapping) else isinstance(value, MatchMatrix)
    return "<matrix>" if matrix else "<value>"


OneOrMore = Annotated[Items[MeasureT], BeforeValidator(_as_items)]


class StiffnessMeasure(Schema):
    """One directional stiffness of the tip.

    Attributes
    ----------
    direction : unit vector of the force or, for a rotation, axis of the moment.
    frame : the axes in which `direction` is given.
    kind : stiffness against translation or rotation.
    boundary : free, the rest of the tip may move; guided, it may not translate (for a rotation:
        not rotate) otherwise; clamped, it may not move otherwise at all.
    """

    direction: Direction
    frame: Frame = "base"
    kind: Kind = "translation"
    boundary: Boundary = "free"

    @property
    def unit(self) -> Literal["N/m", "N*m/rad"]:
        """Unit of the stiffness."""
        return "N/m" if self.kind == "translation" else "N*m/rad"


class _ValuedMeasure(StiffnessMeasure):
    value: Annotated[float, Field(gt=0)]

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
    """A stiffness that shall not be less than `value` (N/m, for a rotation N m/rad)."""


class MatchValue(_ValuedMeasure):
    """A stiffness that shall be `value` (N/m, for a rotation N m/rad).

    Attributes
    ----------
    tolerance : relative deviation that is near enough.
    """

    tolerance: Annotated[Ratio, Field(gt=0, lt=1)] = 0.01


class MatchMatrix(Schema):
    """A translational stiffness matrix that the tip shall have.

    Attributes
    ----------
    matrix : 3x3, symmetric and positive definite, in N/m whatever unit it was given in.
    unit : N/m.
    frame : the axes in which the matrix is given.
    boundary : guided, rotation is free; clamped, it is held.
    tolerance : relative Frobenius distance that is near enough.
    """

    unit: Literal["N/m"] = "N/m"
    matrix: Vector[Vector[Number]]
    frame: Frame = "base"
    boundary: Literal["guided", "clamped"] = "guided"
    tolerance: Annotated[Ratio, Field(gt=0, lt=1)] = 0.01

    @model_validator(mode="before")
    @classmethod
    def _to_si(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, Mapping):
            return data
        if "value" in data:
            raise BadKeyError("value", "cannot be combined with matrix; remove one of the two")
        unit = data.get("unit")
        if unit is None:
            if read_from_file(info):
                raise ValueError("the key 'unit' is missing; expected a unit such as 'N/m'")
            return data
        try:
            factor = parse_quantity(f"1 {unit}", "N/m", "stiffness")
        except InputError:
            raise BadKeyError(
                "unit", f"'{unit}' is not a unit of stiffness; expected one such as 'N/m'"
            ) from None
        return {**data, "unit": "N/m", "matrix": _scaled(data.get("matrix"), factor)}

    @model_validator(mode="after")
    def _check(self) -> MatchMatrix:
        matrix = np.array(self.matrix)
        if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0):
            raise BadKeyError("matrix", "is not symmetric; a stiffness matrix is")
        if np.linalg.eigvalsh(matrix)[0] <= 0:
            raise BadKeyError("matrix", "is not positive definite; a stable stiffness is")
        return self


class StiffnessGoal(Schema):
    """What is asked of the tip's stiffness.

    Attributes
    ----------
    maximise : the smallest of these is maximised.
    at_least : none of these may be less than its value.
    match : stiffness to have, instead of one to maximise.
    """

    maximise: OneOrMore[StiffnessMeasure] = ()
    at_least: OneOrMore[AtLeast] = ()
    match: (
        Annotated[
            Annotated[MatchValue, Tag("<value>")] | Annotated[MatchMatrix, Tag("<matrix>")],
            Discriminator(_match_kind),
        ]
        | None
    ) = None

    @model_validator(mode="after")
    def _check(self) -> StiffnessGoal:
        if not self.maximise and not self.at_least and self.match is None:
            raise ValueError("asks for nothing; expected maximise, at_least or match")
        if self.maximise and self.match is not None:
            raise BadKeyError("match", "cannot be combined with maximise; remove one of the two")
        if len({measure.kind for measure in self.maximise}) > 1:
            raise BadKeyError(
                "maximise",
                "mixes translation (N/m) and rotation (N*m/rad), whose smallest has no meaning; "
                "ask for one of the kinds with at_least",
            )
        return self


def _scaled(matrix: Any, factor: float) -> Any:
    """Return numbers in nested lists times a factor; leave alone what is no number."""
    if isinstance(matrix, np.ndarray):
        matrix = matrix.tolist()
    if isinstance(matrix, Sequence) and not isinstance(matrix, str):
        return [_scaled(item, factor) for item in matrix]
    if isinstance(matrix, int | float) and not isinstance(matrix, bool) and factor != 1:
        return matrix * factor
    return matrix
