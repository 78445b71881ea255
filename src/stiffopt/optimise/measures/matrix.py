"""Match of the tip's translational stiffness matrix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import casadi as ca
import numpy as np
from pydantic import Field, ValidationInfo, model_validator

from stiffopt.directions import Frame
from stiffopt.errors import InputError
from stiffopt.model.compliance import stiffness_block
from stiffopt.optimise.measure import Measure, Role
from stiffopt.schema import BadKeyError, JsonSchemaOfFile, Vector
from stiffopt.units import Number, Ratio, parse_quantity, read_from_file


class MatchMatrix(Measure):
    """A translational stiffness matrix to be matched by the tip.

    Attributes
    ----------
    matrix : 3x3, symmetric and positive definite, in N/m (converted from the unit in a file).
    unit : N/m.
    frame : the axes in which the matrix is given.
    boundary : "guided": rotation is free; "clamped": it is held.
    tolerance : largest relative Frobenius distance.
    """

    key: ClassVar[str] = "matrix"
    role: ClassVar[Role] = "match"

    unit: Annotated[Literal["N/m"], JsonSchemaOfFile(lambda _: {"type": "string"})] = "N/m"
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

    @property
    def structure(self) -> tuple[str, ...]:
        """Frame and boundary."""
        return ("matrix", self.frame, self.boundary)

    @property
    def parameters(self) -> tuple[float, ...]:
        """Entries of the wanted matrix (9,)."""
        return tuple(entry for row in self.matrix for entry in row)

    def formula(self, tip: Any, parameters: Any) -> Any:
        """Return the squared relative Frobenius distance ``|K - K_wanted|^2 / |K_wanted|^2``."""
        K = stiffness_block(tip.compliance, "translation", self.boundary)
        if self.frame == "base":
            K = tip.rotation @ K @ tip.rotation.T
        return ca.sumsqr(ca.vec(K) - parameters) / ca.sumsqr(parameters)

    def mismatch(self, value: Any, parameters: Any) -> tuple[Any, Any]:
        """Return the squared distance itself."""
        return value, 1

    @property
    def is_stiffness(self) -> bool:
        """False: the value is a distance."""
        return False

    def holds(self, value: float) -> bool:
        """See `Measure.holds`."""
        return value <= self.tolerance

    def shortfall(self, value: float) -> str:
        """See `Measure.shortfall`."""
        return (
            f"the nearest stiffness matrix is {value:.3g} away (relative Frobenius distance, "
            f"{self.tolerance:.3g} allowed)"
        )


def _scaled(matrix: Any, factor: float) -> Any:
    """Multiply the numbers in nested lists by a factor; leave other values alone."""
    if isinstance(matrix, np.ndarray):
        matrix = matrix.tolist()
    if isinstance(matrix, Sequence) and not isinstance(matrix, str):
        return [_scaled(item, factor) for item in matrix]
    if isinstance(matrix, int | float) and not isinstance(matrix, bool) and factor != 1:
        return matrix * factor
    return matrix
