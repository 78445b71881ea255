"""`Measure`, the base class of scalars of the tip's compliance that a task bounds or optimises.

Each kind has a file of its own in `stiffopt.optimise.measures`.  A measure is an entry of the task
file and a symbolic formula in one.  It splits into its *structure*, for which functions are
compiled, and its *parameters*, which are arguments of them.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from stiffopt.schema import Schema

if TYPE_CHECKING:
    from stiffopt.model.manipulator import Manipulator

Vector = NDArray[np.float64]
Role = Literal["maximise", "at_least", "match"]


class Measure(Schema):
    """A measure in one of the places of a task's ``stiffness``.

    Attributes
    ----------
    key : str
        By which a task file tells it from others in the same place.
    role : {"maximise", "at_least", "match"}
        The place; a measure that can be in several of them has a class for each.
    unit : str
        Of the stiffness, ``"N/m"`` or ``"N*m/rad"``: a property or a field of each kind.
    """

    key: ClassVar[str]
    role: ClassVar[Role]

    # -- the formula ------------------------------------------------------------------------

    @property
    @abstractmethod
    def structure(self) -> tuple[str, ...]:
        """What the compiled function depends on."""

    @property
    @abstractmethod
    def parameters(self) -> tuple[float, ...]:
        """Arguments (k,) of the formula, always as many for one structure."""

    @abstractmethod
    def formula(self, tip: Any, parameters: Any) -> Any:
        """Symbolic value of a `stiffopt.model.shape.Shape`: logarithm of a positive stiffness."""

    def formula_gradient(self, tip: Any, parameters: Any) -> Any:
        """Symbolic derivative (1, n) of the formula by the pressures."""
        return tip.total_jacobian(self.formula(tip, parameters))

    def mismatch(self, value: Any, parameters: Any) -> tuple[Any, Any]:
        """What a match minimises, as a function of the formula's value, and its derivative."""
        raise NotImplementedError

    # -- in reports -------------------------------------------------------------------------

    @property
    def is_stiffness(self) -> bool:
        """Whether the formula is the logarithm of a stiffness; else it is a squared distance."""
        return True

    def holds(self, value: float) -> bool:
        """Whether a stiffness, or a distance, is as the task requires."""
        return True

    def shortfall(self, value: float) -> str:
        """Message for a value that does not hold: what was required, and the best there is."""
        return ""

    def said(self) -> dict[str, Any]:
        """Its keys and values in the task file, without the required value and tolerance."""
        said = self.model_dump(exclude={"value", "tolerance"})
        return {key: list(v) if isinstance(v, tuple) else v for key, v in said.items()}

    def words(self) -> str:
        """What it measures: ``against translation along (1, 0, 0), base axes, free``."""
        return self.key

    def stiffness_gradient(self, robot: Manipulator, pressures: Vector) -> Vector | None:
        """Derivative (n,) of the stiffness by the pressures (n,), if it is one."""
        return None
