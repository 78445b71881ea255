"""`Target`, the key ``target`` of a task file: conditions on the arm's configuration.

Its keys are those of the terms in `stiffopt.optimise.terms`.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Annotated

from pydantic import create_model, model_validator

from stiffopt.arrays import Array
from stiffopt.optimise.term import Term, Tolerance
from stiffopt.optimise.terms import TERMS
from stiffopt.schema import BadKeyError, Schema

__all__ = ["Target", "Tolerance"]

if TYPE_CHECKING:

    class _Keys(Schema):
        position: tuple[float | None, float | None, float | None] | None = None
        pointing: tuple[float, float, float] | None = None
        orientation: tuple[float, float, float, float] | None = None

else:
    _Keys = create_model(
        "_Keys",
        __base__=Schema,
        **{kind.key: (Annotated[kind.annotation | None, kind], None) for kind in TERMS},
    )


class Target(_Keys):
    """Conditions on the arm's tip and body, in the base frame.

    A subclass may add terms: fields with the term's class in their annotation,
    ``Annotated[MyValue | None, MyTerm]``, and None as default.

    Attributes
    ----------
    position : x, y, z in m, None for an axis that is free; or None if all are.
    pointing : unit vector along which the tip's z axis is to point, or None.
    orientation : unit quaternion (w, x, y, z) with w >= 0, or None.
    above : plane above which the tip stays, or None.
    tolerance : largest errors.
    """

    tolerance: Tolerance = Tolerance()

    @property
    def terms(self) -> tuple[Term, ...]:
        """The target's conditions: the position first, then the angle, then others."""
        given = ((kind, getattr(self, key)) for key, kind in _kinds(type(self)))
        return tuple(kind(value, self.tolerance) for kind, value in given if value is not None)

    def moved_back(self, offset: Array) -> Target:
        """Return the target for the model with which an arm off by an offset meets this target.

        Parameters
        ----------
        offset : (6,)
            Displacement in m and rotation vector in rad, in base axes.
        """
        given = ((key, kind, getattr(self, key)) for key, kind in _kinds(type(self)))
        return self.model_copy(
            update={
                key: kind.moved_back(value, offset)
                for key, kind, value in given
                if value is not None
            }
        )

    def __repr__(self) -> str:
        parts = [f"{term.key} {term.condition()}" for term in self.terms]
        return f"Target({', '.join(parts)})"

    __str__ = __repr__

    @model_validator(mode="after")
    def _check(self) -> Target:
        known: dict[str, str] = {}
        for key, kind in _kinds(type(self)):
            if getattr(self, key) is None:
                continue
            if kind.name in known:
                other = known[kind.name]
                raise BadKeyError(key, f"cannot be combined with {other}; remove one of the two")
            known[kind.name] = key
        if not known:
            *keys, last = (key for key, kind in _kinds(type(self)) if not kind.is_inequality)
            raise ValueError(f"asks for nothing; expected a {', '.join(keys)} or {last}")
        return self


@cache
def _kinds(model: type[Target]) -> tuple[tuple[str, type[Term]], ...]:
    """Return the keys of a target class with their kinds of terms, in the terms' order."""
    found = [
        (key, kind)
        for key, field in model.model_fields.items()
        for kind in field.metadata
        if isinstance(kind, type) and issubclass(kind, Term)
    ]
    return tuple(sorted(found, key=lambda item: item[1].order))
