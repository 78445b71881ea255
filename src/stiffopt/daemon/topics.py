"""Topics of telemetry, live and recorded: the fields of the loop's state as JSON messages.

Which field is in which topic stands in its definition in `stiffopt.control.state`. Foxglove reads
no union types in a schema (``["number", "null"]`` makes it refuse the topic), so a schema says what
a field is when it is there: of what is missing a scalar is left out, and an item of an array is
null.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from math import isfinite
from typing import Any

from stiffopt.control.state import Event, SeenPose, Snapshot, State, Timing
from stiffopt.control.state_fields import Entry, Kind, entries

__all__ = ["FORMAT", "METADATA", "STATES", "encoded", "state_topics", "topic_schemas"]

METADATA = "stiffopt-run"
"""Name of the metadata record of a run."""
FORMAT = "stiffopt-run/1"
STATES = tuple(map(str, State))
"""Their index is `state_number`, which can be plotted."""

_TIME_DECIMALS = 6
_ENCODER = json.JSONEncoder(allow_nan=False, check_circular=False, separators=(",", ":"))
_COUNT = {"type": "integer"}
_FURTHER: Mapping[str, Mapping[str, Any]] = {  # what is no field of the state
    "/state": {
        "state_number": {
            "type": "integer",
            "oneOf": [{"title": name, "const": number} for number, name in enumerate(STATES)],
        }
    },
    "/timing": {"dropped": _COUNT},
}


_LOGGED: dict[tuple[type, str], tuple[Entry, ...]] = {}


def _logged(record: type, topic: str) -> tuple[Entry, ...]:
    """Return the fields of a record that are logged in a topic."""
    if (record, topic) not in _LOGGED:
        found = tuple(entry for entry in entries(record) if entry.shown.topic == topic)
        _LOGGED[record, topic] = found
    return _LOGGED[record, topic]


def state_topics() -> tuple[str, ...]:
    """Return the topics that the fields of a `Snapshot` are logged in."""
    return tuple(dict.fromkeys(filter(None, (e.shown.topic for e in entries(Snapshot)))))


def topic_schemas() -> dict[str, dict[str, Any]]:
    """Return the JSON schema of each topic."""
    records: dict[str, type] = dict.fromkeys(state_topics(), Snapshot)
    records |= {"/tracker": SeenPose, "/timing": Timing, "/event": Event}
    schemas = {}
    for topic, record in records.items():
        fields = {entry.key: _schema(entry) for entry in _logged(record, topic)}
        schemas[topic] = {
            "title": f"stiffopt{topic.replace('/', '.')}",
            "type": "object",
            "properties": {"time_s": {"type": "number"}, **fields, **_FURTHER.get(topic, {})},
        }
    return schemas


def encoded(topic: str, time: float, record: Any, **further: Any) -> bytes:
    """Return the message of a topic that a record of the state gives at a time, in s."""
    message: dict[str, Any] = {"time_s": round(time, _TIME_DECIMALS)}
    for entry in _logged(type(record), topic):
        value = _rounded(getattr(record, entry.name), entry)
        if value is not None:
            message[entry.key] = value
    message.update(further)
    return _ENCODER.encode(message).encode()


def _schema(entry: Entry) -> dict[str, Any]:
    """Return the JSON schema of a field."""
    item: dict[str, Any] | None = {
        Kind.NUMBERS: {"type": "number"},
        Kind.COUNTS: _COUNT,
        Kind.FLAGS: {"type": "boolean"},
    }.get(entry.kind)
    if entry.kind is Kind.RECORDS:
        fields = {inner.key: _schema(inner) for inner in entries(entry.type)}
        item = {"type": "object", "properties": fields}
    return {"type": entry.kind.value} if item is None else {"type": "array", "items": item}


def _rounded(value: Any, entry: Entry) -> Any:
    """Return a value as it is logged; None if it is missing."""
    if value is None:
        return None
    match entry.kind:
        case Kind.NUMBER:
            return round(value, entry.decimals) if isfinite(value) else None
        case Kind.NUMBERS:
            numbers = value.tolist() if entry.in_array else value
            return [round(x, entry.decimals) if isfinite(x) else None for x in numbers]
        case Kind.FLAGS if entry.in_array:
            return value.tolist()
        case Kind.COUNTS | Kind.FLAGS:
            return list(value)
        case Kind.TEXT:
            return str(value)
        case Kind.RECORDS:
            return [
                {e.key: _rounded(getattr(item, e.name), e) for e in entries(type(item))}
                for item in value
            ]
    return value
