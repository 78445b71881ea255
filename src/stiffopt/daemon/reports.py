"""The daemon's answers as JSON: units end the names, null is what is not known.

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
from stiffopt.errors import CommandError, InputError, ServiceError, StiffoptError, printable

LEASE_HEADER = "Stiffopt-Lease"
"""Header in which a client shows that it has control."""
_LONGEST = 1000  # characters of a message

__all__ = [
    "LEASE_HEADER",
    "DoneReport",
    "ErrorReport",
    "EventsReport",
    "GrantReport",
    "LeaseReport",
    "RefusalError",
    "RobotReport",
    "StateReport",
    "TaskReport",
    "error_of",
    "json_of",
    "plain",
    "record_of",
    "refusal_of",
]

RecordT = TypeVar("RecordT")

Values = list[float | None]
Text = Annotated[str, BeforeValidator(printable)]  # a file's name, say, need not be valid Unicode


# From the definitions of the state ---------------------------------------------------------------


def json_of(record: Any) -> dict[str, Any]:
    """Return a record of the state, such as a `Snapshot` or an `Event`, as JSON."""
    found: dict[str, Any] = {}
    for entry in entries(type(record)):
        names = entry.json
        if not names:
            continue
        value = plain(getattr(record, entry.name), entry)
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


def record_of(record: type[RecordT], given: Mapping[str, Any]) -> RecordT:
    """Return the record from which `json_of` made some JSON; null becomes NaN.

    Unknown keys, as of a newer daemon, are ignored.

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


def plain(value: Any, entry: Entry) -> Any:
    """Return the value of a field as JSON."""
    if value is None:
        return None
    match entry.kind:
        case Kind.NUMBER:
            return float(value) if isfinite(value) else None
        case Kind.NUMBERS:
            numbers = value.tolist() if entry.in_array else value
            return [float(x) if isfinite(x) else None for x in numbers]
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
    """Return the pydantic model of the JSON that `json_of` makes of a record."""
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
    """What is being done in a word, the target now, and the last task given here.

    `task` is null where the arm is vented or no client gave one.
    """

    doing: Text
    target: TargetMessage | None
    task: TaskMessage | None


class GrantReport(BaseModel):
    """Control is granted: the lease to send with each command, and how often to renew it."""

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
    """Why a request was refused."""

    error: Mistake


# Refusals ---------------------------------------------------------------------------------------


class RefusalError(StiffoptError):
    """A request is refused.

    Parameters
    ----------
    status :
        The HTTP status.
    code :
        A word for programs.
    message :
        A sentence for people.
    """

    def __init__(self, status: int, code: str, message: str) -> None:
        super().__init__(status, code, message)
        self.status = status
        self.code = code
        self.message = printable(message)[:_LONGEST]

    def __str__(self) -> str:
        return self.message

    @property
    def body(self) -> dict[str, Any]:
        """What the client is sent."""
        return {"error": {"code": self.code, "message": self.message}}


def refusal_of(error: StiffoptError) -> RefusalError:
    """Return the refusal that a client is sent for an error of the control loop."""
    if isinstance(error, RefusalError):
        return error
    if isinstance(error, InputError) and not isinstance(error, CommandError):
        return RefusalError(422, "input", str(error))
    return RefusalError(409, "refused", str(error))


def error_of(status: int, message: str) -> StiffoptError:
    """Return the exception that a client raises for a status of the daemon."""
    if status in (401, 403, 404, 405, 409):
        return CommandError(message)
    if status in (413, 422):
        return InputError(message)
    return ServiceError(message)
