"""What a description says, key by key, whatever subclass of a known model says it."""

from __future__ import annotations

from typing import Any, TypeVar

from pydantic import BaseModel

from stiffopt.errors import InputError
from stiffopt.schema import Schema

__all__ = ["contents", "differences", "listed", "understood"]

ModelT = TypeVar("ModelT", bound=Schema)

_BESIDE = frozenset({"source"})  # where a description was read, which is no part of what it says
_TOLD = 5  # keys that an error names


def contents(value: Any) -> Any:
    """Return what a model says as plain data, with the fields of subclasses.

    Fields that are None, which says nothing, are left out.
    """
    if isinstance(value, BaseModel):
        fields = {name: getattr(value, name) for name in type(value).model_fields}
        fields |= value.model_extra or {}
        said = {name: field for name, field in fields.items() if field is not None}
        return {name: contents(field) for name, field in said.items() if name not in _BESIDE}
    if isinstance(value, list | tuple):
        return [contents(item) for item in value]
    return value


def differences(one: Any, other: Any, place: str = "") -> list[str]:
    """Return the places at which the contents of two models differ, as dotted keys."""
    if isinstance(one, dict) and isinstance(other, dict):
        return [
            found
            for key in {**one, **other}
            for found in differences(one.get(key), other.get(key), f"{place}.{key}".lstrip("."))
        ]
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        return [
            found
            for index, (a, b) in enumerate(zip(one, other, strict=True))
            for found in differences(a, b, f"{place}[{index}]")
        ]
    return [] if one is other or bool(one == other) else [place]


def listed(places: list[str]) -> str:
    """Return places as an error names them: not more of them than help."""
    more = f" and {len(places) - _TOLD} more" if len(places) > _TOLD else ""
    return ", ".join(places[:_TOLD]) + more


def understood(given: object, model: type[ModelT]) -> ModelT:
    """Return a description as just this model, which must have a word for all that it says.

    Raises
    ------
    InputError
        It is no such description, its values do not serve, or it says more than the model knows;
        the text names the key.
    """
    if not isinstance(given, model):
        raise InputError(f"expected a {model.__name__}, not {type(given).__name__}")
    said = contents(given)
    made = model(**said)
    if different := differences(said, contents(made)):
        raise InputError(f"{model.__name__}: {listed(different)}: not a value that can be had")
    return made
