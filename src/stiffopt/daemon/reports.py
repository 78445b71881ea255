"""What the daemon answers, as JSON: SI units in the names, null for what is not known.

The reports of the loop's state and of its events follow from the definitions in
`stiffopt.control.state`; the other answers are models of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite, nan
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, Field, create_model

from stiffopt.control.state import Event, Snapshot, State
from stiffopt.control.state_fields import Entry, Kind, entries
from stiffopt.daemon.messages import TargetMessage, TaskMessage
from stiffopt.errors import ServiceError, printable

__all__ = [
    "DoneReport",
    "ErrorReport",
    "EventsReport",
    "GrantReport",
    "LeaseReport",
    "RobotReport",
    "StateReport",
    "TaskReport",
    "json_of",
    "plain",
    "record_of",
    "state_json",
]

RecordT = TypeVar("RecordT")

Values = list[float | None]
Text = Annotated[str, BeforeValidator(printable)]  # a file's name, say, need not be valid Unicode


# From the definitions of the state ---------------------------------------------------------------


def json_of(record: Any) -> dict[str, Any]:
    """Return a record of the state, such as a `Snapshot` or an `Event`, as JSON has it."""
    found: dict[str, Any] = {}
    for entry in entries(type(record)):
        value = plain(getattr(record, entry.name), entry)
        found.update(zip(entry.json, _shares(record, entry, value), strict=True))
    return found


def state_json(now: Snapshot, lease: LeaseReport | None = None) -> dict[str, Any]:
    """Return the state of the loop, and who has control, as `StateReport` describes it."""
    return {**json_of(now), "lease": None if lease is None else lease.model_dump()}


def record_of(record: type[RecordT], given: Mapping[str, Any]) -> RecordT:
    """Return what `json_of` was given; what was not known is NaN. Further keys do no harm.

    Raises
    ------
    ServiceError
        Something is missing, or is none of the values that can be there.
    """
    try:
        return _record_of(record, given)
    except (KeyError, TypeError, ValueError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise ServiceError(f"the daemon's {record.__name__.lower()} is none: {reason}") from None


def _shares(record: Any, entry: Entry, value: Any) -> list[Any]:
    """Return what goes under each of a field's names in JSON."""
    if len(entry.json) < 2:
        return [value] * len(entry.json)
    if entry.units:
        held = getattr(record, entry.shown.unit_field)
        return [value if unit == held else None for unit in entry.units]
    size = len(value) // len(entry.json)
    return [value[k * size : (k + 1) * size] for k in range(len(entry.json))]


def plain(value: Any, entry: Entry) -> Any:
    """Return a value as JSON has it."""
    if value is None:
        return None
    match entry.kind:
        case Kind.NUMBER:
            return float(value) if isfinite(value) else None
        case Kind.NUMBERS:
            numbers = np.asarray(value, dtype=float).tolist()
            return [x if isfinite(x) else None for x in numbers]
        case Kind.COUNTS | Kind.FLAGS:
            values: list[Any] = np.asarray(value).tolist()
            return values
        case Kind.TEXT:
            return printable(str(value))
        case Kind.RECORD:
            return json_of(value)
        case Kind.RECORDS:
            return [json_of(item) for item in value]
    return value


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


def _report_model(name: str, record: type, **more: Any) -> type[BaseModel]:
    """Return the model of what `json_of` gives of a record."""
    fields: dict[str, Any] = {}
    for entry in entries(record):
        kind: Any = {
            Kind.NUMBER: float | None,
            Kind.NUMBERS: Values if entry.in_array else list[float],
            Kind.COUNTS: list[int],
            Kind.FLAGS: list[bool],
        }.get(entry.kind, entry.type)
        if entry.kind in (Kind.RECORD, Kind.RECORDS):
            kind = _report_model(f"{entry.type.__name__}Report", entry.type)
            kind = list[kind] if entry.kind is Kind.RECORDS else kind
        if entry.optional:
            kind = kind | None
        for key in entry.json:
            fields[key] = (kind, Field(description=entry.shown.about))
    return create_model(name, __doc__=(record.__doc__ or "").partition("\n\n")[0], **fields, **more)


class LeaseReport(BaseModel):
    """Who has control."""

    client: Text
    expires_in_s: float


StateReport = _report_model("StateReport", Snapshot, lease=(LeaseReport | None, ...))
_EventReport: Any = _report_model("EventReport", Event)


class EventsReport(BaseModel):
    """Events, and what to ask for as `since` to get those after them."""

    events: list[_EventReport]
    next: int


# Other answers -----------------------------------------------------------------------------------


class RobotReport(BaseModel):
    """The arm, its channels and what may be commanded."""

    name: str
    n: int
    channels: list[str]
    low_pa: Values
    high_pa: Values
    length_m: float


class TaskReport(BaseModel):
    """What is being done in a word, what is asked of the tip now, and the last task given here.

    `task` is null where the arm is vented or no client gave one.
    """

    doing: Text
    target: TargetMessage | None
    task: TaskMessage | None


class GrantReport(BaseModel):
    """Control: what to show with each command, and how often to be heard."""

    lease: str
    heartbeat_s: Annotated[float, Field(description="control is lost after this time of silence")]
    renew_every_s: float


class DoneReport(BaseModel):
    """The command was carried out; the state after it."""

    state: State
    reason: Text


class Mistake(BaseModel):
    """A word for programs and a sentence for people."""

    code: str
    message: str


class ErrorReport(BaseModel):
    """Why a request was not done."""

    error: Mistake
