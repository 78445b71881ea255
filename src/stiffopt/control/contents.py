"""The contents of schemas as plain data, to compare them and to refuse what would be lost."""

from __future__ import annotations

from typing import Any, TypeVar

from pydantic import BaseModel

from stiffopt.errors import InputError
from stiffopt.schema import Schema

__all__ = ["contents", "differences", "listed", "understood"]

ModelT = TypeVar("ModelT", bound=Schema)

_NOT_CONTENT = frozenset({"source"})  # the file that a description was read from
_LISTED = 5  # keys that an error names


def contents(value: Any) -> Any:
    """Return a schema's fields as plain data, also those of a subclass.

    Fields that are None are left out.
    """
    if isinstance(value, BaseModel):
        fields = {name: getattr(value, name) for name in type(value).model_fields}
        fields |= value.model_extra or {}
        given = {name: field for name, field in fields.items() if field is not None}
        return {name: contents(field) for name, field in given.items() if name not in _NOT_CONTENT}
    if isinstance(value, list | tuple):
        return [contents(item) for item in value]
    return value


def differences(one: Any, other: Any, place: str = "") -> list[str]:
    """Return the keys at which two contents differ, dotted."""
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
    """Return keys as an error names them, a few of them at most."""
    more = f" and {len(places) - _LISTED} more" if len(places) > _LISTED else ""
    return ", ".join(places[:_LISTED]) + more


def understood(given: object, model: type[ModelT]) -> ModelT:
    """Return a description as an instance of exactly this model, without losing a key.

    Raises
    ------
    InputError
        It is no such description, a value is not valid, or it has keys that the model lacks; the
        text names the key.
    """
    if not isinstance(given, model):
        raise InputError(f"expected a {model.__name__}, not {type(given).__name__}")
    plain = contents(given)
    made = model(**plain)
    if different := differences(plain, contents(made)):
        raise InputError(f"{model.__name__}: {listed(different)}: not a value that can be had")
    return made
