"""`Schema`: base of all descriptions, a frozen pydantic model whose errors are sentences.

One model is both the schema of a kind of file and the description in code.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar, get_args

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from stiffopt.errors import InputError, Loc, dotted, shown
from stiffopt.units import QuantityKind, in_unit_of

ItemT = TypeVar("ItemT")


class BadKeyError(ValueError):
    """Raised by a validator of a whole mapping for a mistake at one of its keys."""

    def __init__(self, key: str, reason: str) -> None:
        super().__init__(reason)
        self.loc: Loc = tuple(int(step) if step.isdigit() else step for step in key.split("."))


class Schema(BaseModel):
    """Base of classes that are both the schema of a file and its frozen description in code.

    In code, quantities are numbers in SI (or text with a unit) and a mistake raises
    `InputError`. In files read by `read_file`, quantities must have units and mistakes raise
    `FileError`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=False)

    def __init__(self, /, **data: Any) -> None:
        try:
            super().__init__(**data)
        except ValidationError as error:
            raise InputError(_sentence(type(self), error)) from None

    # pydantic then still builds nested models itself, so that errors have their locations
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]


@dataclass(frozen=True)
class JsonSchemaOfFile:
    """Annotation of a type whose values have another form in a file.

    `change`: function from the JSON Schema of the type to that of its form in the file.
    """

    change: Callable[[dict[str, Any]], dict[str, Any]]

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        return self.change(handler(schema))


def _as_tuple(value: Any) -> Any:
    """Convert lists and arrays to tuples; reject other iterables."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return tuple(value)
    raise InputError(f"expected a list, not {shown(value)}")


def items_of(n: int) -> Callable[[Any], Any]:
    """Return a validator of a list of exactly `n` items."""

    def read(value: Any) -> Any:
        items = _as_tuple(value)
        if len(items) != n:
            raise InputError(f"expected {n} items, not {len(items)}")
        return items

    return read


Items = Annotated[tuple[ItemT, ...], BeforeValidator(_as_tuple)]
"""A list in the file, a tuple in code."""
Vector = Annotated[tuple[ItemT, ItemT, ItemT], BeforeValidator(items_of(3))]
"""Three items: x, y, z."""
Pair = Annotated[tuple[ItemT, ItemT], BeforeValidator(items_of(2))]
"""Two items: low and high, or two points of a line."""


# pydantic's errors to sentences ------------------------------------------------------------------

_EXPECTED = {
    "bool": "true or false",
    "finite": "a finite number",
    "int": "a whole number",
    "string": "text",
}
"""Words for an expected value. The key is the first word of pydantic's error type: ``int`` of
``int_parsing``."""


def _sentence(model: type[BaseModel], error: ValidationError) -> str:
    """Return the message for mistakes in a call."""
    found = (explain(model, details, None) for details in error.errors())
    return "; also ".join(
        f"{'.'.join(filter(None, (model.__name__, dotted(loc))))}: {reason}"
        for loc, reason in found
    )


def explain(
    model: type[BaseModel], details: ErrorDetails, data: Mapping[str, Any] | None
) -> tuple[Loc, str]:
    """Return a mistake's place, in the file's own terms, and a sentence about it."""
    kind, value, context = details["type"], details["input"], details.get("ctx", {})
    raw: Loc = details["loc"]
    error = context.get("error")
    if isinstance(error, BadKeyError):
        raw = (*raw, *error.loc)
    if kind == "missing":
        loc = _place(raw[:-1], data)
        return loc, f"the key '{raw[-1]}' is missing"
    loc = _place(raw, data)
    if kind == "extra_forbidden":
        return (*loc[:-1], str(raw[-1])), _unknown_key(model, raw)
    if error is not None:
        return loc, str(error)
    if data is not None:
        value = _at(data, loc)
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        return loc, f"expected a mapping, not {shown(value)}"
    if kind == "literal_error":
        return loc, f"{shown(value)} is not one of {context['expected']}"
    if kind in ("greater_than", "greater_than_equal", "less_than", "less_than_equal"):
        bound = next(iter(context.values()))
        relation = kind.replace("greater_than_equal", "at least").replace(
            "less_than_equal", "at most"
        )
        limit = in_unit_of(value, bound, _unit_at(model, raw))
        return loc, f"must be {relation.replace('_', ' ')} {limit}, not {shown(value)}"
    if kind == "string_too_short" or value in ("", [], ()):
        return loc, "must not be empty"
    if kind == "too_long":
        return loc, f"expected at most {context['max_length']} items, not {len(value)}"
    examples = [getattr(each, "examples", None) for each in _types_at(model, raw)]
    if kind == "string_pattern_mismatch" and any(examples):
        return loc, f"{shown(value)} is not a name such as '{next(filter(None, examples))[0]}'"
    expected = _EXPECTED.get(kind.partition("_")[0])
    if expected is not None:
        return loc, f"expected {expected}, not {shown(value)}"
    message = details["msg"]
    return loc, f"{message[:1].lower()}{message[1:]}"


def _place(raw: Loc, data: Mapping[str, Any] | None) -> Loc:
    """Drop steps of pydantic's path that the user did not write: union tags, implied list items."""
    steps = tuple(step for step in raw if not str(step).startswith("<"))
    if data is None:
        return steps
    loc: Loc = ()
    value: Any = data
    for index, step in enumerate(steps):
        if isinstance(value, dict) and isinstance(step, int):
            continue
        if isinstance(value, dict) and step not in value and index < len(steps) - 1:
            continue
        if isinstance(value, str | int | float):  # written for a mapping or a list
            break
        loc = (*loc, step)
        value = _at(data, loc)
    return loc


def _at(data: Any, loc: Loc) -> Any:
    for step in loc:
        try:
            data = data[step]
        except (KeyError, IndexError, TypeError):
            return None
    return data


def _unknown_key(model: type[BaseModel], raw: Loc) -> str:
    """Suggest the valid key nearest to an unknown one, or list all."""
    models = [each for each in _types_at(model, raw[:-1]) if _is_model(each)]
    known = {
        info.alias or name: None
        for each in models
        for name, info in each.model_fields.items()
        if not info.exclude
    }
    near = difflib.get_close_matches(str(raw[-1]), known, n=1)
    hint = f"did you mean '{near[0]}'?" if near else f"the keys here are {', '.join(known)}"
    return f"unknown key; {hint}"


def _unit_at(model: type[BaseModel], raw: Loc) -> str:
    """Return the SI unit of the quantity at a place; "" if it has none."""
    units = (each.unit for each in _types_at(model, raw) if isinstance(each, QuantityKind))
    return next(units, "")


def _types_at(model: type[BaseModel], raw: Loc) -> list[Any]:
    """Return the types that a place may have, with their annotations."""
    types: list[Any] = [model]
    for step in raw:
        if isinstance(step, str) and not step.startswith("<"):
            fields = (each.model_fields.get(step) for each in types if _is_model(each))
            types = [
                part
                for info in fields
                if info is not None
                for part in (info, *info.metadata, *_parts(info.annotation))
            ]
    return types


def _is_model(given: Any) -> bool:
    return isinstance(given, type) and issubclass(given, BaseModel)


def _parts(annotation: Any) -> Iterator[Any]:
    """Yield an annotation, and those in it."""
    yield annotation
    for inner in get_args(annotation):
        yield from _parts(inner)
