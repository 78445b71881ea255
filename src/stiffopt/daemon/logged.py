"""What parts of the daemon, and the libraries that it listens with, log: as events of the loop."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from stiffopt.control.loop import ControlLoop
from stiffopt.control.state import Severity

__all__ = ["LogEvents"]

_OURS = "stiffopt"
_LOGGERS = (_OURS, "uvicorn", "websockets", "foxglove", "asyncio")
_QUIET = 1.0  # s in which the same place in the code is not heard again
_LONGEST = 300  # characters of a text, part of which strangers may have written


class LogEvents(logging.Handler):
    """Makes events of what is logged as a warning or worse, so that it is told as all else is.

    What strangers can provoke must not push everything else out of the events: of each place in the
    code one record a second is taken, and that of a library is never more than a warning.

    Parameters
    ----------
    loop :
        Whose events they become.
    clock :
        Time in s.
    """

    def __init__(self, loop: ControlLoop, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(logging.WARNING)
        self._loop, self._clock = loop, clock
        self._heard: dict[tuple[str, str, int], float] = {}

    def attach(self) -> None:
        """Hear from now on."""
        for name in _LOGGERS:
            logging.getLogger(name).addHandler(self)

    def detach(self) -> None:
        """Hear no more."""
        for name in _LOGGERS:
            logging.getLogger(name).removeHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Append an event; what is wrong with a record must not hurt whoever logs."""
        with suppress(Exception):
            self._tell(record)

    def _tell(self, record: logging.LogRecord) -> None:
        place, now = (record.name, record.pathname, record.lineno), self._clock()
        if now - self._heard.get(place, -_QUIET) < _QUIET:
            return
        self._heard[place] = now
        ours = record.name.partition(".")[0] == _OURS
        bad = ours and record.levelno >= logging.ERROR
        self._loop.events.add(
            self._loop.rig.clock.now(),
            "service",
            _text(record),
            Severity.ERROR if bad else Severity.WARNING,
        )


def _text(record: logging.LogRecord) -> str:
    """Return what is told of a record, also of one whose arguments do not fit."""
    try:
        lines = record.getMessage().splitlines() or [""]
        return lines[0][:_LONGEST] + _where(record)
    except Exception as error:
        place = f"{Path(record.pathname).name}:{record.lineno}"
        return f"what was logged in {place} cannot be shown ({type(error).__name__})"


def _where(record: logging.LogRecord) -> str:
    """Return the error that is told of, and where it came from."""
    error = record.exc_info[1] if record.exc_info else None
    if error is None:
        return ""
    frames = traceback.extract_tb(error.__traceback__)
    where = f", {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
    return f" ({type(error).__name__}: {str(error)[:_LONGEST]}{where})"
