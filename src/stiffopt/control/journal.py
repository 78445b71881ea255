"""What happened, and what is wrong now: for all threads to read."""

from __future__ import annotations

import threading
from collections import deque

from stiffopt.control.state import Alarm, Event, Severity

__all__ = ["Alarms", "EventLog"]

_KEPT = 10_000  # events; the oldest go first


class EventLog:
    """Events in the order in which they happened; only the latest are kept."""

    def __init__(self, kept: int = _KEPT) -> None:
        self._events: deque[Event] = deque(maxlen=kept)
        self._count = 0
        self._lock = threading.Lock()

    def add(self, time: float, kind: str, text: str, severity: Severity = Severity.INFO) -> None:
        """Append an event; see `Event`."""
        with self._lock:
            self._events.append(Event(time, kind, text, severity))
            self._count += 1

    def since(self, index: int) -> tuple[list[Event], int]:
        """Return events from an index on, as far as they are kept.

        Parameters
        ----------
        index :
            0 at first, then what was returned by the last call.

        Returns
        -------
        events : list of Event
        next_index : int
        """
        with self._lock:
            new = min(max(self._count - index, 0), len(self._events))
            events = list(self._events)[len(self._events) - new :] if new else []
            return events, self._count


class Alarms:
    """What is wrong now; each is an event when it comes and when it goes."""

    def __init__(self, events: EventLog) -> None:
        self._events = events
        self._standing: dict[str, Alarm] = {}
        self._lock = threading.Lock()
        self.now: tuple[Alarm, ...] = ()

    def set(self, time: float, kind: str, text: str, severity: Severity = Severity.WARNING) -> None:
        """Let something be wrong; of one kind there is one alarm, with the latest text."""
        with self._lock:
            before = self._standing.get(kind)
            if before is not None and before.text == text:
                return
            since = time if before is None else before.since
            self._standing[kind] = Alarm(kind, text, since)
            self.now = tuple(self._standing.values())
        if before is None:
            self._events.add(time, kind, text, severity)

    def clear(self, time: float, kind: str) -> None:
        """Let it be well again; to clear what is not there does nothing."""
        if kind not in self._standing:
            return
        with self._lock:
            gone = self._standing.pop(kind, None)
            self.now = tuple(self._standing.values())
        if gone is not None:
            self._events.add(time, f"{kind}-over", f"no longer: {gone.text}")
