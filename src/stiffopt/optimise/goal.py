"""`StiffnessGoal`, the key ``stiffness`` of a task file: what the tip's stiffness should be.

It combines the measures in `stiffopt.optimise.measures`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar

from pydantic import BeforeValidator, Discriminator, Tag, ValidationInfo, model_validator

from stiffopt.errors import InputError
from stiffopt.optimise.measure import Measure, Role
from stiffopt.optimise.measures import measures_of
from stiffopt.optimise.measures.directional import AtLeast, MatchValue, StiffnessMeasure
from stiffopt.optimise.measures.matrix import MatchMatrix
from stiffopt.schema import BadKeyError, Items, JsonSchemaOfFile, Schema
from stiffopt.units import read_from_file

__all__ = ["AtLeast", "MatchMatrix", "MatchValue", "StiffnessGoal", "StiffnessMeasure"]

MeasureT = TypeVar("MeasureT")
MIXED = "mixes translation (N/m) and rotation (N*m/rad), whose smallest has no meaning"


def _as_items(value: Any, info: ValidationInfo) -> Any:
    """Convert one mapping to a list of one; reject an empty list in a file."""
    if isinstance(value, Mapping | Measure):
        return (value,)
    if read_from_file(info) and not value:
        raise InputError("is empty; expected at least one mapping with a direction")
    return value


def _either(role: Role) -> Any:
    """Return the type of the measures that may have this role."""
    kinds = measures_of(role)
    if len(kinds) == 1:
        return kinds[0]

    def which(value: Any) -> str:
        for kind in reversed(kinds):
            if kind.key in value if isinstance(value, Mapping) else isinstance(value, kind):
                return f"<{kind.key}>"
        return f"<{kinds[0].key}>"

    tagged = [Annotated[kind, Tag(f"<{kind.key}>")] for kind in kinds]
    return Annotated[reduce(or_, tagged), Discriminator(which)]


if TYPE_CHECKING:
    _Maximised: TypeAlias = StiffnessMeasure
    _Floor: TypeAlias = AtLeast
    _Match: TypeAlias = MatchValue | MatchMatrix
else:
    _Maximised, _Floor, _Match = map(_either, ("maximise", "at_least", "match"))
OneOrMore = Annotated[
    Items[MeasureT],
    BeforeValidator(_as_items),
    JsonSchemaOfFile(lambda listed: {"anyOf": [listed["items"], listed]}),
]
"""A list; a file may have one mapping instead of a list of one."""


class StiffnessGoal(Schema):
    """Stiffnesses to maximise, to match and to keep above a value.

    Attributes
    ----------
    maximise : measures; the smallest of these stiffnesses is maximised.
    at_least : measures with a lower bound each.
    match : a stiffness to attain, instead of maximising one.
    """

    maximise: OneOrMore[_Maximised] = ()
    at_least: OneOrMore[_Floor] = ()
    match: _Match | None = None

    def __repr__(self) -> str:
        places = (("maximise", self.maximise), ("match", self.first[len(self.maximise) :]),
                  ("at least", self.at_least))  # fmt: skip
        parts = [f"{place} {measure.words()}" for place, found in places for measure in found]
        return f"StiffnessGoal({'; '.join(parts)})"

    __str__ = __repr__

    @property
    def first(self) -> tuple[Measure, ...]:
        """The maximised measures, or the matched one."""
        return (*self.maximise, *(() if self.match is None else (self.match,)))

    @model_validator(mode="after")
    def _check(self) -> StiffnessGoal:
        if not self.maximise and not self.at_least and self.match is None:
            raise ValueError("asks for nothing; expected maximise, at_least or match")
        if self.maximise and self.match is not None:
            raise BadKeyError("match", "cannot be combined with maximise; remove one of the two")
        if len({measure.unit for measure in self.maximise}) > 1:
            raise BadKeyError("maximise", f"{MIXED}; ask for one of the kinds with at_least")
        return self
