"""A line of a log for programs."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any

__all__ = ["JSON", "json_line"]

JSON = "json"
"""Argument of a process that shall speak so."""


def json_line(level: str, kind: str, text: str, when: datetime | None = None, **more: Any) -> str:
    """Return a JSON object with ``time`` (of day, UTC), ``level``, ``kind``, ``text`` and more.

    Parameters
    ----------
    level, kind, text :
        How bad it is (``info``, ``warning``, ``error``), a word for programs, words for people.
    when :
        With its time zone; None: now.
    """
    moment = (when or datetime.now(UTC)).astimezone(UTC)
    stamp = moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
    told = {"time": stamp, "level": level, "kind": kind, "text": text, **more}
    return json.dumps(told, ensure_ascii=True)
