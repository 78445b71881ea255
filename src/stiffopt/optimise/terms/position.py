"""Term `position`: the tip's position along the base axes that are not free."""

from collections.abc import Hashable
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, BeforeValidator, PlainSerializer

from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.optimise.term import Nearness, Term, Tolerance, numbers_shown
from stiffopt.schema import JsonSchemaOfFile, Vector
from stiffopt.units import Length, format_quantity, within


def _coordinate(value: Any) -> Any:
    """Convert `free` (None in code), for an axis that does not matter."""
    return None if isinstance(value, str) and value.strip() == "free" else value


def _all_free_is_none(position: tuple[float | None, ...] | None) -> tuple[float | None, ...] | None:
    return None if position is None or all(x is None for x in position) else position


def _write_coordinate(value: float | None) -> str:
    return "free" if value is None else format_quantity(value, "m", "mm")


Coordinate = Annotated[
    Annotated[Length, within(1e3, "m")] | None,
    BeforeValidator(_coordinate),
    JsonSchemaOfFile(lambda length: {"anyOf": [length, {"const": "free"}]}),
    PlainSerializer(_write_coordinate, return_type=str, when_used="json"),
]


class PositionTerm(Term):
    """Difference between the tip's position and the wanted one."""

    key = name = "position"
    annotation = Annotated[Vector[Coordinate] | None, AfterValidator(_all_free_is_none)]
    example: ClassVar[Any] = ["-30 mm", "free", "190 mm"]
    order = 0

    def __init__(self, value: tuple[float | None, ...], tolerance: Tolerance) -> None:
        super().__init__(value, tolerance)
        self.axes = tuple(axis for axis, wanted in enumerate(value) if wanted is not None)
        self.size = len(self.axes)

    @property
    def variant(self) -> Hashable:
        """The axes that are not free."""
        return self.axes

    @property
    def parameters(self) -> tuple[float, ...]:
        """The position along these axes."""
        return tuple(self.value[axis] for axis in self.axes)

    def residual(self, tip: Any, parameters: Any) -> Any:
        """Return ``r - r_wanted`` along these axes; see `Term.residual`."""
        return tip.position[list(self.axes)] - parameters

    def nearness(self, length: float) -> Nearness:
        """Return the distance over the arm's length."""
        x, y, z = self.value
        u, v, w = (x or 0.0) / length, (y or 0.0) / length, (z or 0.0) / length
        one = 1 / length**2
        return Nearness(
            offset=u * u + v * v + w * w,
            linear=(-2 * u / length, -2 * v / length, -2 * w / length),
            square=(one * (x is not None), one * (y is not None), one * (z is not None)),
            root=1.0,
            limit=self.radius / length,
        )

    def condition(self) -> str:
        """See `Term.condition`."""
        unit = display_units().length
        return f"{numbers_shown(self.value, unit)} {unit} within {self.words(self.radius)}"

    @classmethod
    def moved_back(cls, value: Any, offset: Array) -> Any:
        """See `Term.moved_back`."""
        pairs = zip(value, offset[:3], strict=True)
        return tuple(None if axis is None else axis - float(shift) for axis, shift in pairs)
