"""`Term`, the base class of a task's conditions on the arm's configuration.

A term is a smooth function of the tip, or of stations along the body: a residual r whose length
must not exceed a tolerance, ``|r| <= tolerance``, or inequalities ``g >= 0``.  Each kind of term
has its own file in `stiffopt.optimise.terms` with all that concerns it: its key in task files, its
formula and its texts.

The formula is symbolic.  A term splits into its *structure*, for which functions are compiled, and
its *parameters*, which are arguments of them.
"""

import hashlib
import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping
from copy import copy
from functools import cache
from typing import Annotated, Any, ClassVar, NamedTuple

from pydantic import Field

from stiffopt.arrays import Array
from stiffopt.display import PLAIN, DisplayUnit, display_units
from stiffopt.schema import Schema
from stiffopt.units import Angle, Length


class Tolerance(Schema):
    """Largest errors of the tip.

    Attributes
    ----------
    position : Euclidean norm over the axes that are not free, in m.
    angle : between the axes (pointing) or of the rotation (orientation), in rad.
    """

    position: Annotated[Length, Field(gt=0)] = 1e-4
    angle: Annotated[Angle, Field(gt=0)] = math.radians(1)


class Nearness(NamedTuple):
    """A rough distance of a tip from meeting a term: ``max(0, d - limit)``, with d = v or sqrt(v).

    ``v = max(0, offset + linear . r + square . r^2 + turn . R)`` for the tip's position r and
    rotation R (by columns); d is its root if `root` is 1, v itself if it is 0.  A search starts
    from the samples with the smallest sum over all terms.  To be comparable, d is in lengths of the
    arm or in half turns.
    """

    offset: float = 0.0
    linear: tuple[float, float, float] = (0.0, 0.0, 0.0)
    square: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, ...] = (0.0,) * 9
    root: float = 0.0
    limit: float = 0.0

    @property
    def numbers(self) -> tuple[float, ...]:
        """All 18 numbers in order."""
        return (self.offset, *self.linear, *self.square, *self.turn, self.root, self.limit)


class Term(ABC):
    """One condition of a task; see the module.

    Parameters
    ----------
    value :
        Value of `key` in the task file, in SI.
    tolerance : Tolerance
        The target's tolerance.  A field of the term's name is its radius.

    Attributes
    ----------
    key : str
        Key in task files, under ``target``.
    annotation :
        Pydantic type of the value there: a `Schema`, or one of the types of `stiffopt.units` and
        `stiffopt.directions`, which also define its form in files and messages.
    example :
        A value as in a task file that the built-in arm stiff-flop-2 can meet, for tests.
    name : str
        Name in results: ``<name>_error`` or, for an inequality, ``<name>_margin``.  A task has at
        most one term of a name.
    unit : str
        SI unit of the residual or margin.
    has_stations : bool
        Whether the formula depends on stations.
    is_inequality : bool
        Whether each component of `residual` must be nonnegative, instead of small.
    order : int
        Sort key of the terms.
    size : int
        Number k of components of the residual.
    radius : float
        The tolerance; for an inequality, a scale in `unit`.
    """

    key: ClassVar[str]
    annotation: ClassVar[Any]
    example: ClassVar[Any]
    name: ClassVar[str]
    unit: ClassVar[str] = "m"
    has_stations: ClassVar[bool] = False
    is_inequality: ClassVar[bool] = False
    order: ClassVar[int] = 10
    size: int = 1
    radius: float = 1e-3

    def __init__(self, value: Any, tolerance: Tolerance) -> None:
        self.value = value
        self.radius = getattr(tolerance, self.name, self.radius)

    # -- the formula ------------------------------------------------------------------------

    @abstractmethod
    def residual(self, tip: Any, parameters: Any) -> Any:
        """Return the symbolic residual (k,) for symbolic parameters.

        `tip` is a `stiffopt.model.shape.Shape`: ``tip.position`` (3,) and ``tip.rotation`` (3, 3),
        in base axes; ``tip.station(s)`` has the same at arc length s (m, at rest, from the base).
        """

    @property
    def parameters(self) -> tuple[float, ...]:
        """Arguments of the formula; their number is fixed by the structure."""
        return ()

    @property
    def variant(self) -> Hashable:
        """Further dependencies of the formula, such as numbers of components or arc lengths."""
        return ()

    @property
    def structure(self) -> Hashable:
        """Everything that the compiled function depends on."""
        return (self.key, self.variant, self.is_inequality, self.radius * self.is_inequality,
                _version(type(self)))  # fmt: skip

    def like(self, value: Any) -> "Term":
        """Return the same term with another value."""
        other = copy(self)
        other.value = value
        return other

    # -- for searches and controllers ---------------------------------------------------------

    def nearness(self, length: float) -> Nearness:
        """Return a rough distance from meeting the term, for an arm of this length; default: 0."""
        return Nearness()

    @classmethod
    def moved_back(cls, value: Any, offset: Array) -> Any:
        """Return the value for the model with which an arm off by an offset (6,) meets `value`.

        `offset` is a displacement in m and a rotation vector in rad, in base axes.
        """
        return value

    # -- texts ------------------------------------------------------------------------------

    @property
    def result_name(self) -> str:
        """Name of the error or margin in results: ``position_error``."""
        return f"{self.name}_{'margin' if self.is_inequality else 'error'}"

    def holds(self, value: float) -> bool:
        """Return whether an error or a margin meets the term."""
        return value >= 0 if self.is_inequality else value <= self.radius

    def shown(self, value: float) -> tuple[float, str]:
        """Return a value in its display unit, and that unit."""
        unit = display_units().of_si(self.unit)
        return unit.of(value), unit.name

    def condition(self) -> str:
        """Describe the condition: ``(-30, free, 190) mm within 0.1 mm``.

        By default a mapping, or a list of them, is described as in a task file.
        """
        if isinstance(self.value, tuple) and not isinstance(self.value[0], Schema):
            return f"{numbers_shown(self.value)} within {self.words(self.radius)}"
        return _as_in_file(self.value)

    def words(self, value: float) -> str:
        """Format an error or margin for display: ``0.35 mm``, ``2 mm short in above``."""
        unit, digits = display_units().of_si(self.unit), ".3g" if self.unit == "rad" else ".4g"
        if not self.is_inequality:
            return unit.text(value, digits)
        size = unit.text(abs(value), digits)
        return f"{size} {'to spare' if value >= 0 else 'short'} in {self.name}"


def numbers_shown(values: Any, unit: DisplayUnit = PLAIN) -> str:
    """Format numbers in a display unit: ``(-30, free, 190)``; None is free."""
    digits = 3 + unit.more_decimals
    shown = ("free" if x is None else f"{round(unit.of(x), digits) + 0.0:g}" for x in values)
    return f"({', '.join(shown)})"


def _as_in_file(value: Any) -> str:
    if isinstance(value, Schema):
        value = value.model_dump(mode="json", exclude_none=True)
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_as_in_file(part)}" for key, part in value.items())
    if isinstance(value, list | tuple):
        separator = "; " if value and isinstance(value[0], Schema) else ", "
        return f"({separator.join(map(_as_in_file, value))})"
    return f"{value:g}" if isinstance(value, float) else str(value)


@cache
def _version(kind: type[Term]) -> str:
    """Return the name of a class of terms, with a hash of the source of one not in stiffopt."""
    name = f"{kind.__module__}.{kind.__qualname__}"
    if kind.__module__.startswith("stiffopt."):  # cache keys already include its source
        return name
    return f"{name} {hashlib.sha256(inspect.getsource(kind).encode()).hexdigest()[:16]}"
