"""What must be seen to while a daemon runs, and by nobody who steers or serves."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from stiffopt.control.loop import ControlLoop
from stiffopt.daemon.notify import ServiceManager
from stiffopt.errors import StiffoptError

__all__ = ["Guarded", "Keeper"]

_LOOK = 0.1  # s
_AGAIN = 2.0  # s from a failed attempt to start a guard to the next
_GUARD, _SERVICE = "guard", "service"


class Guarded(Protocol):
    """The link to a guard."""

    @property
    def alive(self) -> bool:
        """Whether the guard is there."""

    def open(self) -> None:
        """Start a guard, which connects to the supply and vents it."""

    def close(self) -> None:
        """End it."""


class Keeper:
    """Looks after a running daemon, in a thread of its own.

    - A guard process that has ended, which is a fault for the loop, is replaced. Its link has
      vented the supply by then, as far as that answers, and has ended a guard that hung.
    - When the control interface ends, nobody watches any more whether who has control is alive:
      the arm is held.
    - The service manager is told the state.

    Parameters
    ----------
    loop :
        The control loop.
    link :
        To its guard.
    manager :
        Is told how things stand.
    serving :
        Says whether the control interface serves; None where there is none.
    clock :
        Time in s.
    """

    def __init__(
        self,
        loop: ControlLoop,
        link: Guarded,
        manager: ServiceManager,
        serving: Callable[[], bool] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._loop, self._link, self._manager = loop, link, manager
        self._serving, self._clock = serving, clock
        self._told = ""
        self._guard_at = -float("inf")
        self._held = False
        self._enough = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Look again and again until `stop`."""
        self._thread = threading.Thread(target=self._run, name="keeper", daemon=True)
        self._thread.start()

    def stop(self, timeout: float = 2.0) -> None:
        """Look no more; a guard that is just being started is not waited for."""
        self._enough.set()
        if self._thread is not None:
            self._thread.join(timeout)

    def look(self) -> None:
        """See to everything once."""
        self._tell()
        if not self._link.alive:
            self._replace_guard()
        if self._serving is not None:
            self._look_at_service(self._serving())

    def _run(self) -> None:
        while not self._enough.wait(_LOOK):
            try:
                self.look()
            except Exception as error:  # the others must be looked after all the same
                text = f"unexpected {type(error).__name__}: {error}"
                self._loop.add_alarm("keeper", text)

    def _tell(self) -> None:
        now = self._loop.snapshot()
        text = f"{now.state}: {now.reason}" if now.reason else str(now.state)
        if text != self._told:
            self._told = text
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

    def _look_at_service(self, serves: bool) -> None:
        if serves:
            return
        if not self._held:
            self._held = True
            self._loop.add_alarm(_SERVICE, "the control interface has ended; restart the daemon")
            with suppress(StiffoptError):  # there may be nothing to hold
                self._loop.hold("the control interface has ended")
