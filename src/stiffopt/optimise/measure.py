"""`Measure`, the base class of scalars of the tip's compliance that a task bounds or optimises.

Each kind has its own file in `stiffopt.optimise.measures`.  A measure is both an entry of the task
file and a symbolic formula.  It splits into its *structure*, for which functions are compiled, and
its *parameters*, which are arguments of them.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from stiffopt.arrays import Array
from stiffopt.schema import Schema

if TYPE_CHECKING:
    from stiffopt.model.manipulator import Manipulator

Role = Literal["maximise", "at_least", "match"]


class Measure(Schema):
    """A stiffness measure in one role of a task's ``stiffness``.

    Attributes
    ----------
    key : str
        Key by which a task file distinguishes it from others of the same role.
    role : {"maximise", "at_least", "match"}
        A measure that can have several roles has a class for each.
    unit : str
        Unit of the stiffness, ``"N/m"`` or ``"N*m/rad"``: a property or a field of each kind.
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
        """Arguments (k,) of the formula; their number is fixed by the structure."""

    @abstractmethod
    def formula(self, tip: Any, parameters: Any) -> Any:
        """Return the symbolic value for a `stiffopt.model.shape.Shape`: the log of a stiffness."""

    def formula_gradient(self, tip: Any, parameters: Any) -> Any:
        """Return the symbolic derivative (1, n) of the formula by the pressures."""
        return tip.total_jacobian(self.formula(tip, parameters))

    def mismatch(self, value: Any, parameters: Any) -> tuple[Any, Any]:
        """Return a match's objective as a function of the formula's value, and its derivative."""
        raise NotImplementedError

    # -- in reports -------------------------------------------------------------------------

    @property
    def is_stiffness(self) -> bool:
        """Whether the formula is the log of a stiffness; otherwise it is a squared distance."""
        return True

    def holds(self, value: float) -> bool:
        """Return whether a stiffness, or a distance, meets the task's demand."""
        return True

    def shortfall(self, value: float) -> str:
        """Return the message for a value that does not hold: the demand and the best value."""
        return ""

    def task_keys(self) -> dict[str, Any]:
        """Return its keys and values in the task file, without the required value and tolerance."""
        keys = self.model_dump(exclude={"value", "tolerance"})
        return {key: list(v) if isinstance(v, tuple) else v for key, v in keys.items()}

    def words(self) -> str:
        """Describe the measure: ``against translation along (1, 0, 0), base axes, free``."""
        return self.key

    def stiffness_gradient(self, robot: Manipulator, pressures: Array) -> Array | None:
        """Return the derivative (n,) of the stiffness by pressures (n,); None for a distance."""
        return None
