"""Life cycle of the control loop: its states and transitions, its events and alarms."""

from __future__ import annotations

import threading
from collections import deque
from contextlib import ExitStack

from stiffopt.control.state import Alarm, Event, Severity, State
from stiffopt.errors import CommandError
from stiffopt.model.compiler import held_off

ARMED = frozenset({State.ACTIVE, State.HOLDING})
"""States in which there may be pressure."""

_TRANSITIONS = {
    State.UNCONFIGURED: {State.INACTIVE, State.FAULT},
    State.INACTIVE: {State.ACTIVE, State.FAULT},
    State.ACTIVE: {State.HOLDING, State.INACTIVE, State.FAULT},
    State.HOLDING: {State.ACTIVE, State.INACTIVE, State.FAULT},
    State.FAULT: {State.INACTIVE},
}

_REQUESTS = {
    "configure": {State.UNCONFIGURED, State.INACTIVE},
    "arm": {State.INACTIVE},
    "set a task": ARMED,
    "set a target": ARMED,
    "follow a trajectory": ARMED,
    "hold": ARMED,
    "disarm": {State.UNCONFIGURED, State.INACTIVE, *ARMED},
    "reset": {State.FAULT},
}

_ADVICE = {
    State.UNCONFIGURED: "configure first, or wait until that is done",
    State.INACTIVE: "it is vented; arm first",
    State.ACTIVE: "disarm first",
    State.HOLDING: "disarm first",
    State.FAULT: "it is vented; find the reason, then reset",
}


class Lifecycle:
    """The state of a control loop.

    With `in_real_time`, ticks have deadlines, so no code is compiled in the background while the
    loop is armed.
    """

    def __init__(self, *, in_real_time: bool = False) -> None:
        self.in_real_time = in_real_time
        self.state = State.UNCONFIGURED
        self.reason = ""  # for a state that nobody requested
        self._no_compiler = ExitStack()  # open while the arm is armed

    @property
    def armed(self) -> bool:
        """Whether there may be pressure."""
        return self.state in ARMED

    def change(self, state: State, reason: str = "") -> None:
        """Change the state; `CommandError` if there is no such transition."""
        if state not in _TRANSITIONS[self.state]:
            raise CommandError(f"{state} cannot follow {self.state}")
        was_armed = self.armed
        self.state, self.reason = state, reason
        if self.armed and not was_armed and self.in_real_time:
            self._no_compiler.enter_context(held_off())
        elif not self.armed:
            self._no_compiler.close()

    def permit(self, request: str) -> None:
        """Refuse a request that the state does not permit, with advice."""
        if self.state not in _REQUESTS[request]:
            advice = _ADVICE[self.state] if request != "reset" else "there is no fault"
            why = f" ({self.reason})" if self.state is State.FAULT else ""
            raise CommandError(f"cannot {request} while {self.state}{why}: {advice}")


class EventBuffer:
    """The latest `size` events, in order; safe for threads."""

    def __init__(self, size: int = 10_000) -> None:
        self._events: deque[Event] = deque(maxlen=size)
        self._count = 0
        self._lock = threading.Lock()

    def add(self, time: float, kind: str, text: str, severity: Severity = Severity.INFO) -> None:
        """Append an event; see `Event`."""
        with self._lock:
            self._events.append(Event(time, kind, text, severity))
            self._count += 1

    def since(self, index: int) -> tuple[list[Event], int]:
        """Return the events from an index on that the buffer still has, and the next index.

        The first index is 0; later ones are those that the last call returned.
        """
        with self._lock:
            new = min(max(self._count - index, 0), len(self._events))
            events = list(self._events)[len(self._events) - new :] if new else []
            return events, self._count


class Alarms:
    """The present alarms (`now`), one of each kind; setting or clearing one is an event.

    Safe for threads.
    """

    def __init__(self, events: EventBuffer) -> None:
        self._events = events
        self._standing: dict[str, Alarm] = {}
        self._lock = threading.Lock()
        self.now: tuple[Alarm, ...] = ()

    def set(
        self, time: float, kind: str, text: str, severity: Severity | None = Severity.WARNING
    ) -> None:
        """Set the alarm of a kind, or change its text; None: without an event."""
        with self._lock:
            before = self._standing.get(kind)
            if before is not None and before.text == text:
                return
            since = time if before is None else before.since
            self._standing[kind] = Alarm(kind, text, since)
            self.now = tuple(self._standing.values())
        if before is None and severity is not None:
            self._events.add(time, kind, text, severity)

    def clear(self, time: float, kind: str) -> None:
        """Clear the alarm of a kind, if it is set."""
        if kind not in self._standing:
            return
        with self._lock:
            gone = self._standing.pop(kind, None)
            self.now = tuple(self._standing.values())
        if gone is not None:
            what, _, _ = gone.text.partition(";")
            self._events.add(time, f"{kind}-over", f"no longer: {what}")
