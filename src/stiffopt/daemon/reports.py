"""The daemon's answers over HTTP, as models of their JSON, and its refusals.

The models of the loop's state and events are generated from `stiffopt.control.state`.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, Field, create_model

from stiffopt.control.state import Event, Snapshot, State
from stiffopt.control.state_fields import Kind, entries
from stiffopt.daemon.messages import TargetMessage, TaskMessage
from stiffopt.errors import CommandError, InputError, ServiceError, StiffoptError, printable

LEASE_HEADER = "Stiffopt-Lease"
"""Header in which a client sends the lease that proves its control."""
_LONGEST = 1000  # characters of a message


Values = list[float | None]
Text = Annotated[str, BeforeValidator(printable)]  # e.g. a file's name may be invalid Unicode


def _report_model(name: str, record: type, **more: Any) -> type[BaseModel]:
    """Return the pydantic model of the JSON that `json_of` makes from a record."""
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
    """A request is refused: an HTTP status, a word for programs, and a sentence for people."""

    def __init__(self, status: int, code: str, message: str) -> None:
        super().__init__(status, code, message)
        self.status = status
        self.code = code
        self.message = printable(message)[:_LONGEST]

    def __str__(self) -> str:
        return self.message

    @property
    def body(self) -> dict[str, Any]:
        """JSON to send to the client."""
        return {"error": {"code": self.code, "message": self.message}}


def refusal_of(error: StiffoptError) -> RefusalError:
    """Return the refusal to send to a client for an error of the control loop."""
    if isinstance(error, RefusalError):
        return error
    if isinstance(error, InputError) and not isinstance(error, CommandError):
        return RefusalError(422, "input", str(error))
    return RefusalError(409, "refused", str(error))


def error_of(status: int, message: str) -> StiffoptError:
    """Return the exception that the client raises for an HTTP status of the daemon."""
    if status in (401, 403, 404, 405, 409):
        return CommandError(message)
    if status in (413, 422):
        return InputError(message)
    return ServiceError(message)
