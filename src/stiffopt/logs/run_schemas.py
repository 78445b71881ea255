"""Topics of a daemon's telemetry, live and recorded, and the JSON schemas that describe them.

Foxglove reads no union types in a schema (``["number", "null"]`` makes it refuse the topic), so a
schema says what a field is when it is there: of what is missing a scalar is left out, and an item
of an array is null.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

__all__ = ["FORMAT", "METADATA", "STATES", "missing_left_out", "plain", "plain_list", "run_schemas"]

METADATA = "stiffopt-run"
"""Name of the metadata record of a run."""
FORMAT = "stiffopt-run/1"
STATES = ("unconfigured", "inactive", "active", "holding", "fault")
"""Their index is `state_number`, which can be plotted."""

_NUMBER = {"type": "number"}
_COUNT = {"type": "integer"}
_NUMBERS = {"type": "array", "items": _NUMBER}
_COUNTS = {"type": "array", "items": _COUNT}
_YES_OR_NO = {"type": "boolean"}
_TEXT = {"type": "string"}
_STATE = {
    "type": "integer",
    "oneOf": [{"title": name, "const": number} for number, name in enumerate(STATES)],
}
_ALARMS = {
    "type": "array",
    "items": {"type": "object", "properties": {"kind": _TEXT, "text": _TEXT, "since_s": _NUMBER}},
}

_FIELDS: Mapping[str, Mapping[str, Any]] = {
    "/pressure": {
        "time_s": _NUMBER,
        "measured_time_s": _NUMBER,
        "commanded_pa": _NUMBERS,
        "measured_pa": _NUMBERS,
        "plan_pa": _NUMBERS,
        "saturated": {"type": "array", "items": _YES_OR_NO},
    },
    "/limits": {"time_s": _NUMBER, "low_pa": _NUMBERS, "high_pa": _NUMBERS},
    "/tip": {
        "time_s": _NUMBER,
        "position_m": _NUMBERS,
        "quaternion_wxyz": _NUMBERS,
        "target_position_m": _NUMBERS,
        "target_quaternion_wxyz": _NUMBERS,
        "target_pointing": _NUMBERS,
        "position_error_m": _NUMBER,
        "angle_error_rad": _NUMBER,
        "stiffness": _NUMBER,
        "best_stiffness": _NUMBER,
        "disturbance_m": _NUMBERS,
        "wrench": _NUMBERS,
        "seen_age_s": _NUMBER,
    },
    "/tracker": {
        "time_s": _NUMBER,
        "received_s": _NUMBER,
        "frame": _COUNT,
        "position_m": _NUMBERS,
        "quaternion_wxyz": _NUMBERS,
        "doubted": _YES_OR_NO,
    },
    "/state": {
        "time_s": _NUMBER,
        "state": _TEXT,
        "state_number": _STATE,
        "reason": _TEXT,
        "task": _TEXT,
        "alarms": _ALARMS,
    },
    "/timing": {
        "time_s": _NUMBER,
        "ticks": _COUNT,
        "overruns": _COUNT,
        "tick_time_s": _NUMBER,
        "lateness_edges_s": _NUMBERS,
        "lateness_counts": _COUNTS,
        "dropped": _COUNT,
    },
    "/event": {"time_s": _NUMBER, "kind": _TEXT, "text": _TEXT, "severity": _TEXT},
}


def run_schemas() -> dict[str, dict[str, Any]]:
    """Return the JSON schema of each topic."""
    return {
        topic: {
            "title": f"stiffopt{topic.replace('/', '.')}",
            "type": "object",
            "properties": dict(fields),
        }
        for topic, fields in _FIELDS.items()
    }


def missing_left_out(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return a message without what is None."""
    return {key: value for key, value in fields.items() if value is not None}


def plain(value: float, digits: int) -> float | None:
    """Return a number for JSON, rounded; None if it is not finite."""
    return round(value, digits) if isfinite(value) else None


def plain_list(values: list[float], digits: int) -> list[float | None]:
    """Return numbers for JSON, rounded; None for what is not finite."""
    return [round(value, digits) if isfinite(value) else None for value in values]
