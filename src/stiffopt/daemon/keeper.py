"""Supervision of a running daemon: systemd's watchdog, events from log records, a keeper thread."""

from __future__ import annotations

import logging
import os
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from stiffopt.control.loop import ControlLoop
from stiffopt.control.state import Severity
from stiffopt.errors import StiffoptError, require_package
from stiffopt.safety.guard_client import GuardLink


class ServiceManager:
    """Notifies systemd, if it started this process: ready, alive, state, stopping.

    The environment variable ``NOTIFY_SOCKET`` shows that it did, ``WATCHDOG_USEC`` that it wants
    signs of life. Nothing here waits: messages that the manager does not accept at once are lost.
    Raises `MissingExtraError` if there is a manager and sdnotify is not installed.

    `watchdog_interval`: time in s without `watchdog` after which the manager ends the process;
    None: it does not.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._notifier = _notifier() if os.environ.get("NOTIFY_SOCKET") else None
        self.watchdog_interval = _interval() if self._notifier is not None else None
        self._fed = float("-inf")

    def ready(self) -> None:
        """Report that the daemon has started."""
        self._say("READY=1")

    def status(self, text: str) -> None:
        """Report what the daemon does, for people."""
        self._say("STATUS=" + " ".join(text.split()))

    def watchdog(self) -> None:
        """Report that the control loop lives; only the loop itself may call this, in every tick.

        (A timer or another thread would go on when the loop hangs.) At most two calls per interval
        are passed on.
        """
        if self.watchdog_interval is None:
            return
        now = self._clock()
        if now - self._fed >= 0.5 * self.watchdog_interval:
            self._fed = now
            self._say("WATCHDOG=1")

    def stopping(self) -> None:
        """Report that the daemon has begun to stop."""
        self._say("STOPPING=1")

    def close(self) -> None:
        """Send no more notifications."""
        notifier, self._notifier = self._notifier, None
        self.watchdog_interval = None
        if notifier is not None and notifier.socket is not None:
            notifier.socket.close()

    def _say(self, text: str) -> None:
        if self._notifier is not None:
            # sdnotify encodes as Latin-1, systemd expects UTF-8: make the bytes those of UTF-8
            self._notifier.notify(text.encode().decode("latin-1"))


def _notifier() -> Any:
    require_package("sdnotify", "daemon")
    notifier: Any = import_module("sdnotify").SystemdNotifier()
    if notifier.socket is not None:
        notifier.socket.setblocking(False)
    return notifier


def _interval() -> float | None:
    """Return the watchdog's interval in s if it applies to this process."""
    try:
        interval = float(os.environ["WATCHDOG_USEC"]) * 1e-6
        meant_for = int(os.environ.get("WATCHDOG_PID", os.getpid()))
    except (KeyError, ValueError):
        return None
    return interval if interval > 0 and meant_for == os.getpid() else None


_OURS = "stiffopt"
_LOGGERS = (_OURS, "uvicorn", "websockets", "foxglove", "asyncio")
_QUIET = 1.0  # s between two records from the same line of code
_LONGEST = 300  # characters of a text, part of which a client may have written


class LogEvents(logging.Handler):
    """A logging handler that turns warnings and errors into events of the control loop.

    Clients without the token can provoke records. So that these cannot push out all other events,
    only one record per second is taken from each line of code; records of libraries are at most
    warnings.
    """

    def __init__(self, loop: ControlLoop, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(logging.WARNING)
        self._loop, self._clock = loop, clock
        self._taken: dict[tuple[str, str, int], float] = {}

    def attach(self) -> None:
        """Take records of stiffopt and of the libraries that serve its interface."""
        for name in _LOGGERS:
            logging.getLogger(name).addHandler(self)

    def detach(self) -> None:
        """Take no more records."""
        for name in _LOGGERS:
            logging.getLogger(name).removeHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Append an event; a malformed record must not fail the code that logs it."""
        with suppress(Exception):
            self._add(record)

    def _add(self, record: logging.LogRecord) -> None:
        place, now = (record.name, record.pathname, record.lineno), self._clock()
        if now - self._taken.get(place, -_QUIET) < _QUIET:
            return
        self._taken[place] = now
        ours = record.name.partition(".")[0] == _OURS
        bad = ours and record.levelno >= logging.ERROR
        self._loop.events.add(
            self._loop.rig.clock.now(),
            "service",
            _text(record),
            Severity.ERROR if bad else Severity.WARNING,
        )


def _text(record: logging.LogRecord) -> str:
    """Return a record's text, even if its arguments do not fit its format."""
    try:
        lines = record.getMessage().splitlines() or [""]
        return lines[0][:_LONGEST] + _where(record)
    except Exception as error:
        place = f"{Path(record.pathname).name}:{record.lineno}"
        return f"what was logged in {place} cannot be shown ({type(error).__name__})"


def _where(record: logging.LogRecord) -> str:
    """Describe a record's exception and the line that raised it."""
    error = record.exc_info[1] if record.exc_info else None
    if error is None:
        return ""
    frames = traceback.extract_tb(error.__traceback__)
    where = f", {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
    return f" ({type(error).__name__}: {str(error)[:_LONGEST]}{where})"


_CHECK_EVERY = 0.1  # s
_AGAIN = 2.0  # s between a failed attempt to start a guard and the next
_GUARD, _SERVICE = "guard", "service"


class Keeper:
    """A thread that watches the guard and the HTTP interface of a running daemon.

    - If the guard process has ended, which is a fault for the loop, it is replaced. By then its
      link has vented the supply, if that answers, and has ended a guard that hung.
    - If the control interface ends, nothing checks the heartbeat of the client in control any more:
      the arm is held.
    - The service manager gets the state, for people.

    `serving` returns whether the control interface serves; None if there is none.
    """

    def __init__(
        self,
        loop: ControlLoop,
        link: GuardLink,
        manager: ServiceManager,
        serving: Callable[[], bool] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._loop, self._link, self._manager = loop, link, manager
        self._serving, self._clock = serving, clock
        self._status = ""
        self._guard_at = -float("inf")
        self._held = False
        self._enough = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Check repeatedly until `stop`."""
        self._thread = threading.Thread(target=self._run, name="keeper", daemon=True)
        self._thread.start()

    def stop(self, timeout: float = 2.0) -> None:
        """Stop checking; do not wait for a guard that is being started."""
        self._enough.set()
        if self._thread is not None:
            self._thread.join(timeout)

    def look(self) -> None:
        """Check everything once."""
        self._report_state()
        if not self._link.alive:
            self._replace_guard()
        if self._serving is not None and not self._serving() and not self._held:
            self._held = True
            self._loop.add_alarm(_SERVICE, "the control interface has ended; restart the daemon")
            with suppress(StiffoptError):  # there may be nothing to hold
                self._loop.hold("the control interface has ended", lasting=False)

    def _run(self) -> None:
        while not self._enough.wait(_CHECK_EVERY):
            try:
                self.look()
            except Exception as error:  # the other checks must go on
                text = f"unexpected {type(error).__name__}: {error}"
                self._loop.add_alarm("keeper", text)

    def _report_state(self) -> None:
        now = self._loop.snapshot()
        text = f"{now.state}: {now.reason}" if now.reason else str(now.state)
        if text != self._status:
            self._status = text
            self._manager.status(text)

    def _replace_guard(self) -> None:
        now = self._clock()
        if now - self._guard_at < _AGAIN or self._enough.is_set():
            return
        self._loop.add_alarm(
            _GUARD,
            "the guard process has ended; the supply is vented directly, and cannot be armed until "
            "another guard has been started",
        )
        with suppress(StiffoptError):  # errors of the old guard no longer matter
            self._link.close()
        try:
            self._link.open()
        except StiffoptError as error:
            self._loop.add_alarm(_GUARD, f"no guard process can be started: {error}")
        else:
            self._loop.clear_alarm(_GUARD)
            if self._enough.is_set():  # the daemon has ended meanwhile
                self._link.close()
        self._guard_at = self._clock()
