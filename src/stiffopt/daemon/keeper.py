"""What watches a running daemon: systemd's watchdog, events of log records, and a keeper thread."""

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

    The environment tells: ``NOTIFY_SOCKET``, and ``WATCHDOG_USEC`` if it wants signs of life.
    Nothing here waits: what the manager does not take at once is lost. Raises `MissingExtraError`
    if there is a manager and sdnotify is not installed.

    Attributes
    ----------
    watchdog_interval : seconds after which the manager ends a process that has not called
        `watchdog`; None: it does not.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._notifier = _notifier() if os.environ.get("NOTIFY_SOCKET") else None
        self.watchdog_interval = _interval() if self._notifier is not None else None
        self._fed = float("-inf")

    def ready(self) -> None:
        """Say that the start is over."""
        self._say("READY=1")

    def status(self, text: str) -> None:
        """Say what the daemon does, for people."""
        self._say("STATUS=" + " ".join(text.split()))

    def watchdog(self) -> None:
        """Say that the control loop lives; to be called by it alone, in every tick.

        (A timer or another thread would go on when the loop hangs.) One call in half an interval is
        passed on.
        """
        if self.watchdog_interval is None:
            return
        now = self._clock()
        if now - self._fed >= 0.5 * self.watchdog_interval:
            self._fed = now
            self._say("WATCHDOG=1")

    def stopping(self) -> None:
        """Say that the end has begun."""
        self._say("STOPPING=1")

    def close(self) -> None:
        """Say no more."""
        notifier, self._notifier = self._notifier, None
        self.watchdog_interval = None
        if notifier is not None and notifier.socket is not None:
            notifier.socket.close()

    def _say(self, text: str) -> None:
        if self._notifier is not None:
            # sdnotify sends Latin-1 and systemd reads UTF-8: the bytes must be those of the latter
            self._notifier.notify(text.encode().decode("latin-1"))


def _notifier() -> Any:
    require_package("sdnotify", "daemon")
    notifier: Any = import_module("sdnotify").SystemdNotifier()
    if notifier.socket is not None:
        notifier.socket.setblocking(False)
    return notifier


def _interval() -> float | None:
    """Return the watchdog's interval in s, if it is meant for this process."""
    try:
        interval = float(os.environ["WATCHDOG_USEC"]) * 1e-6
        meant_for = int(os.environ.get("WATCHDOG_PID", os.getpid()))
    except (KeyError, ValueError):
        return None
    return interval if interval > 0 and meant_for == os.getpid() else None


_OURS = "stiffopt"
_LOGGERS = (_OURS, "uvicorn", "websockets", "foxglove", "asyncio")
_QUIET = 1.0  # s between two records of the same place in the code
_LONGEST = 300  # characters of a text, part of which a client may have written


class LogEvents(logging.Handler):
    """A logging handler that turns warnings and errors into events of the control loop.

    Clients without the token can provoke records. So that these do not push all else out of the
    events, one record per second is taken from each place in the code; those of libraries are never
    more than warnings.
    """

    def __init__(self, loop: ControlLoop, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(logging.WARNING)
        self._loop, self._clock = loop, clock
        self._taken: dict[tuple[str, str, int], float] = {}

    def attach(self) -> None:
        """Take the records of stiffopt and of the libraries that serve it."""
        for name in _LOGGERS:
            logging.getLogger(name).addHandler(self)

    def detach(self) -> None:
        """Take no more records."""
        for name in _LOGGERS:
            logging.getLogger(name).removeHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Append an event; a malformed record must not fail the code that logs it."""
        with suppress(Exception):
            self._tell(record)

    def _tell(self, record: logging.LogRecord) -> None:
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
    """Return the text of a record, even if its arguments do not fit its format."""
    try:
        lines = record.getMessage().splitlines() or [""]
        return lines[0][:_LONGEST] + _where(record)
    except Exception as error:
        place = f"{Path(record.pathname).name}:{record.lineno}"
        return f"what was logged in {place} cannot be shown ({type(error).__name__})"


def _where(record: logging.LogRecord) -> str:
    """Return the exception of a record, and the line that raised it."""
    error = record.exc_info[1] if record.exc_info else None
    if error is None:
        return ""
    frames = traceback.extract_tb(error.__traceback__)
    where = f", {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
    return f" ({type(error).__name__}: {str(error)[:_LONGEST]}{where})"


_LOOK = 0.1  # s
_AGAIN = 2.0  # s from a failed attempt to start a guard to the next
_GUARD, _SERVICE = "guard", "service"


class Keeper:
    """A thread that watches the guard and the HTTP interface of a running daemon.

    - A guard process that has ended, which is a fault for the loop, is replaced. Its link has
      vented the supply by then, as far as that answers, and has ended a guard that hung.
    - When the control interface ends, the heartbeat of the client in control is no longer checked:
      the arm is held.
    - The service manager gets the state, for people.

    `serving` says whether the control interface serves; None where there is none.
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
        """End; a guard that is just being started is not waited for."""
        self._enough.set()
        if self._thread is not None:
            self._thread.join(timeout)

    def look(self) -> None:
        """Check everything once."""
        self._tell()
        if not self._link.alive:
            self._replace_guard()
        if self._serving is not None and not self._serving() and not self._held:
            self._held = True
            self._loop.add_alarm(_SERVICE, "the control interface has ended; restart the daemon")
            with suppress(StiffoptError):  # there may be nothing to hold
                self._loop.hold("the control interface has ended", lasting=False)

    def _run(self) -> None:
        while not self._enough.wait(_LOOK):
            try:
                self.look()
            except Exception as error:  # the other checks go on
                text = f"unexpected {type(error).__name__}: {error}"
                self._loop.add_alarm("keeper", text)

    def _tell(self) -> None:
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
        with suppress(StiffoptError):  # what it has to say of the old one is known
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
