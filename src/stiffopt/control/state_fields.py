"""The metadata of a field of the control loop's state (`Shown`), and its reader (`entries`).

The fields themselves are in `stiffopt.control.state`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from stiffopt.arrays import Flags
from stiffopt.units import unit_suffix

_DECIMALS = {"s": 6, "Pa": 1, "m": 7, "rad": 7, "": 7, "N/m": 4, "N": 5}
"""Decimals in the log by unit: finer than any sensor."""


@dataclass(frozen=True)
class Shown:
    """The meaning of a field of the state, and how each interface shows it."""

    about: str  # its meaning
    # SI unit; the JSON name ends in it. If there are several, the field `unit_field` says which one
    # applies, and each has its own JSON name
    unit: str | tuple[str, ...] = ""
    unit_field: str = ""
    size: int = 0  # of an array; 0: one value per channel
    # name in the HTTP interface, by default the field's name with the unit. Several names share the
    # elements of an array; no name: the interface does not have the field
    json: str | tuple[str, ...] | None = None
    topic: str = ""  # of telemetry, live and recorded; empty: not logged
    key: str = ""  # name in the topic's messages, by default the one in the HTTP interface
    decimals: int | None = None  # in the log; by default those of the unit
    # name for Prometheus after ``stiffopt_``; an integer is a counter, other values are gauges
    metric: str = ""
    # value of the metric's label ``kind``, to distinguish fields that share a metric
    label: str = ""
    row: str = ""  # of the status on the terminal
    armed_only: bool = True  # whether to hide that row while the arm is vented
    unknown: str = "-"  # text of the row for NaN
    line: bool = False  # whether `stiffopt run --json` writes a line when it changes


class Kind(Enum):
    """The kinds of values that a field may have; in JSON, null stands for NaN."""

    NUMBER = "number"
    COUNT = "integer"
    FLAG = "boolean"
    TEXT = "string"
    NUMBERS = "numbers"
    COUNTS = "counts"
    FLAGS = "flags"
    RECORD = "record"
    RECORDS = "records"


@dataclass(frozen=True)
class Entry:
    """A field's definition, completed by the defaults."""

    name: str  # of the field
    kind: Kind  # of its value
    type: Any  # of the value; of a record, or the items of `RECORDS`, the dataclass
    optional: bool  # whether the value may be None
    in_array: bool  # whether several values are an array, not a tuple
    shown: Shown  # its definition
    # alternatives, of which `Shown.unit_field` names the one that applies; empty if there are none
    units: tuple[str, ...]
    # names in the HTTP interface, in the order of `units` or of the array's parts
    json: tuple[str, ...]
    key: str  # in the topic's messages
    decimals: int  # in the log


_READ: dict[type, tuple[Entry, ...]] = {}


def entries(record: type) -> tuple[Entry, ...]:
    """Return the documented fields of a dataclass; its own come before those of its bases."""
    if record not in _READ:
        _READ[record] = tuple(_entries(record))
    return _READ[record]


def _entries(record: type) -> Iterator[Entry]:
    hints = get_type_hints(record, include_extras=True)
    order = {
        name: (depth, place)
        for depth, base in reversed(list(enumerate(record.__mro__)))
        for place, name in enumerate(vars(base).get("__annotations__", ()))
    }
    for each in sorted(dataclasses.fields(record), key=lambda each: order[each.name]):
        hint = hints[each.name]
        shown = next((part for part in get_args(hint)[1:] if isinstance(part, Shown)), None)
        if shown is not None:
            yield _entry(each.name, get_args(hint)[0], shown)


def _entry(name: str, hint: Any, shown: Shown) -> Entry:
    units = shown.unit if isinstance(shown.unit, tuple) else (shown.unit,)
    json = tuple(name + unit_suffix(unit) for unit in units) if shown.json is None else shown.json
    json = (json,) if isinstance(json, str) else json
    optional = type(None) in get_args(hint)
    if optional:
        hint = next(part for part in get_args(hint) if part is not type(None))
    kind, item = _kind(hint)
    return Entry(
        name=name,
        kind=kind,
        type=item,
        optional=optional,
        in_array=get_origin(hint) is np.ndarray,
        shown=shown,
        units=units if len(units) > 1 else (),
        json=json,
        key=shown.key or (json[0] if json else name),
        decimals=_DECIMALS.get(units[0], 7) if shown.decimals is None else shown.decimals,
    )


def _kind(hint: Any) -> tuple[Kind, Any]:
    """Return the kind of a type, and the type itself or that of its items."""
    if get_origin(hint) in (Union, UnionType):
        raise TypeError(f"a field of the state cannot be {hint}")
    if get_origin(hint) is tuple:
        item = get_args(hint)[0]
        many = {float: Kind.NUMBERS, int: Kind.COUNTS, bool: Kind.FLAGS}
        return many.get(item, Kind.RECORDS), item
    if get_origin(hint) is np.ndarray:
        return (Kind.FLAGS, np.bool_) if hint == Flags else (Kind.NUMBERS, np.float64)
    if dataclasses.is_dataclass(hint):
        return Kind.RECORD, hint
    if issubclass(hint, str):
        return Kind.TEXT, hint
    return {float: Kind.NUMBER, int: Kind.COUNT, bool: Kind.FLAG}[hint], hint
