"""Shows a run as lines on stdout: JSON for programs, plain text for people."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Protocol

from stiffopt.control.state import Event, Severity, Snapshot, State
from stiffopt.control.state_fields import entries
from stiffopt.daemon.state_json import plain
from stiffopt.errors import printable
from stiffopt.safety.messages import json_line

if TYPE_CHECKING:
    from stiffopt.daemon.daemon import Daemon

__all__ = ["Lines", "RunDisplay"]

_LONGEST = 500  # characters of a text: a pipe takes 4096 bytes at once or not at all


class RunDisplay(Protocol):
    """A way to show a run: as lines or as a live status; updated every `period`, in s."""

    period: float

    def say(self, kind: str, text: str, severity: Severity = Severity.INFO) -> None:
        """Show something that is no event of the loop."""

    def begin(self, daemon: Daemon) -> None:
        """Show what was started."""

    def update(self, now: Snapshot, events: list[Event]) -> None:
        """Show how things stand, and what has happened since the last call."""

    def end(self) -> None:
        """Show no more."""


class Lines:
    """Writes a line to stdout for each event and each change of state.

    Nothing here waits or fails: a line that nobody takes, because the reader has stopped or is
    gone, is left out, for the arm is more important.

    Parameters
    ----------
    as_json :
        As an object with ``time`` (of day, UTC), ``level``, ``kind`` and ``text``; else for people.
    now :
        Time on the rig's clock, in s.
    """

    period = 0.05

    def __init__(self, *, as_json: bool, now: Callable[[], float] = time.monotonic) -> None:
        self._as_json, self._now = as_json, now
        self._told: dict[str, Any] = {}

    def say(self, kind: str, text: str, severity: Severity = Severity.INFO) -> None:
        """Write a line about this moment."""
        self._line(self._now(), str(severity), kind, text)

    def begin(self, daemon: Daemon) -> None:
        """Write where everything is."""
        found: dict[str, Any] = {
            "url": daemon.url,
            "token_file": None if daemon.token_file is None else str(daemon.token_file),
            "recording": daemon.recording,
            "foxglove_port": daemon.foxglove_port,
        }
        told = {key: value for key, value in found.items() if value is not None}
        words = ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in told.items())
        self._line(self._now(), "info", "started", f"runs; {words or 'no ports'}", **told)

    def update(self, now: Snapshot, events: list[Event]) -> None:
        """Write what is new."""
        for event in events:
            self._line(event.time, str(event.severity), event.kind, event.text)
        shown = [entry for entry in entries(type(now)) if entry.shown.line]
        told = {entry.json[0]: plain(getattr(now, entry.name), entry) for entry in shown}
        if told != self._told:
            self._told = told
            text = f"{now.state}: {now.reason}" if now.reason else str(now.state)
            level = "error" if now.state is State.FAULT else "info"
            self._line(now.time, level, "state", text, **told)

    def end(self) -> None:
        """Nothing is left to be done."""

    def _line(self, moment: float, level: str, kind: str, text: str, **more: Any) -> None:
        text = text[:_LONGEST]
        stamp = datetime.fromtimestamp(time.time() - (self._now() - moment), UTC)
        if self._as_json:
            line = json_line(level, kind, text, stamp, **more)
        else:
            mark = "" if level == "info" else f"{level.upper()}: "
            clock = stamp.astimezone().strftime("%H:%M:%S")
            line = f"{clock} {mark}{printable(text)} [{kind}]"
        self._write(line)

    def _write(self, line: str) -> None:
        data = f"{line}\n".encode(errors="backslashreplace")
        with suppress(OSError, ValueError, AttributeError):  # gone, closed, or never there
            stream = sys.stdout.fileno()
            ready = select.poll()
            ready.register(stream, select.POLLOUT)
            if ready.poll(0):
                os.write(stream, data)
