"""Conversion of records of the loop's state to JSON and back, by the definitions of their fields.

Names end in SI units; unknown values are null. See `stiffopt.control.state`.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite, nan
from typing import Any, TypeVar

import numpy as np

from stiffopt.control.state_fields import Entry, Kind, entries
from stiffopt.errors import ServiceError, printable

RecordT = TypeVar("RecordT")


def json_of(record: Any, *, rounded: bool = False) -> dict[str, Any]:
    """Return a record of the state, such as a `Snapshot` or an `Event`, as JSON.

    With `rounded`, numbers have the decimals that their definitions give.
    """
    found: dict[str, Any] = {}
    for entry in entries(type(record)):
        names = entry.json
        if not names:
            continue
        value = plain(getattr(record, entry.name), entry, rounded=rounded)
        if len(names) == 1:
            found[names[0]] = value
        elif entry.units:
            held = getattr(record, entry.shown.unit_field)
            for unit, name in zip(entry.units, names, strict=True):
                found[name] = value if unit == held else None
        else:
            size = len(value) // len(names)
            for part, name in enumerate(names):
                found[name] = value[part * size : (part + 1) * size]
    return found


def plain(value: Any, entry: Entry, *, rounded: bool = False) -> Any:
    """Return the value of a field as JSON."""
    if value is None:
        return None

    def number(x: float) -> float | None:
        if not isfinite(x):
            return None
        return round(x, entry.decimals) if rounded else float(x)

    match entry.kind:
        case Kind.NUMBER:
            return number(value)
        case Kind.NUMBERS:
            return [number(x) for x in (value.tolist() if entry.in_array else value)]
        case Kind.COUNTS | Kind.FLAGS:
            return value.tolist() if entry.in_array else list(value)
        case Kind.TEXT:
            return printable(str(value))
        case Kind.RECORD:
            return json_of(value, rounded=rounded)
        case Kind.RECORDS:
            return [json_of(item, rounded=rounded) for item in value]
    return value


def record_of(record: type[RecordT], given: Mapping[str, Any]) -> RecordT:
    """Return the record from which `json_of` made some JSON; null becomes NaN.

    Unknown keys, as of a newer daemon, are ignored. `ServiceError`: a value is wrong or missing.
    """
    try:
        return _record_of(record, given)
    except (KeyError, TypeError, ValueError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise ServiceError(f"the daemon's {record.__name__.lower()} is none: {reason}") from None


def _record_of(record: type[RecordT], given: Mapping[str, Any]) -> RecordT:
    fields: dict[str, Any] = {}
    for entry in entries(record):
        if not entry.json:
            continue
        values = [given[name] for name in entry.json]
        if entry.units:
            place = next((k for k, value in enumerate(values) if value is not None), 0)
            fields[entry.name] = _value_of(values[place], entry)
            if values[place] is not None:
                fields[entry.shown.unit_field] = entry.units[place]
        else:
            value = values[0] if len(values) == 1 else [x for part in values for x in part]
            fields[entry.name] = _value_of(value, entry)
    return record(**fields)


def _value_of(value: Any, entry: Entry) -> Any:
    if value is None:
        return nan if entry.kind is Kind.NUMBER else None
    match entry.kind:
        case Kind.NUMBERS | Kind.FLAGS if entry.in_array:
            return np.array(value, dtype=entry.type)
        case Kind.NUMBERS | Kind.COUNTS:
            return tuple(map(entry.type, value))
        case Kind.RECORD:
            return _record_of(entry.type, value)
        case Kind.RECORDS:
            return tuple(_record_of(entry.type, item) for item in value)
    return entry.type(value)
