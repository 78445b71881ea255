"""Term `above`: the tip stays on the side of a plane to which its normal points."""

from typing import Annotated, Any, ClassVar

import casadi as ca

from stiffopt.arrays import Array
from stiffopt.directions import Direction
from stiffopt.display import display_units
from stiffopt.optimise.term import Nearness, Term, numbers_shown
from stiffopt.schema import Schema, Vector
from stiffopt.units import Length, within


class Plane(Schema):
    """A plane in the base frame.

    Attributes
    ----------
    point : a point of the plane, in m.
    normal : unit normal, towards the side where the tip stays.
    """

    point: Vector[Annotated[Length, within(1e3, "m")]]
    normal: Direction


class AboveTerm(Term):
    """Height of the tip above a plane; must be nonnegative."""

    key = name = "above"
    annotation = Plane
    example: ClassVar[Any] = {"point": ["0 mm", "0 mm", "185 mm"], "normal": [0.2, 0, 1]}
    is_inequality = True

    @property
    def parameters(self) -> tuple[float, ...]:
        """Normal, and the plane's height along it."""
        return (*self.value.normal, self._height)

    @property
    def _height(self) -> float:
        pairs = zip(self.value.normal, self.value.point, strict=True)
        return float(sum(n * p for n, p in pairs))

    def residual(self, tip: Any, parameters: Any) -> Any:
        """Return ``n . (r - point)``; see `Term.residual`."""
        return ca.dot(parameters[:3], tip.position) - parameters[3]

    def nearness(self, length: float) -> Nearness:
        """Return the depth below the plane over the arm's length."""
        x, y, z = self.value.normal
        return Nearness(self._height / length, (-x / length, -y / length, -z / length))

    def words(self, value: float) -> str:
        """Describe the height above or depth below the plane."""
        height = display_units().length.text(abs(value))
        return f"{height} {'above' if value >= 0 else 'below'} the plane"

    def condition(self) -> str:
        """See `Term.condition`."""
        unit = display_units().length
        point = numbers_shown(self.value.point, unit)
        return f"{point} {unit}, normal {numbers_shown(self.value.normal)}"

    @classmethod
    def moved_back(cls, value: Any, offset: Array) -> Any:
        """See `Term.moved_back`."""
        pairs = zip(value.point, offset[:3], strict=True)
        return value.model_copy(update={"point": tuple(p - float(d) for p, d in pairs)})
