"""What the client of a guard does when the guard is gone: it vents the supply itself, at once."""

from __future__ import annotations

import logging
import os
import select
import threading
import time
from contextlib import ExitStack, suppress
from typing import Protocol

from stiffopt.errors import DeviceError
from stiffopt.rig.interface import PressureSupply
from stiffopt.safety.claim import Claim

__all__ = ["PING_PERIOD", "GuardWatch", "vent_directly"]

PING_PERIOD = 0.1
"""Seconds between two looks at a guard."""
_AGAIN = 0.1  # s between attempts to vent
_log = logging.getLogger(__name__)
_CLAIM = 0.2  # s for which a claim may still be that of a guard that is just ending


class Watched(Protocol):
    """What is watched: the client's end of a guard."""

    @property
    def pid(self) -> int | None:
        """Number of the guard's process."""

    @property
    def alive(self) -> bool:
        """Whether the guard's process is there."""

    @property
    def hung(self) -> bool:
        """Whether it has not answered for so long that it never may."""

    def ping(self) -> None:
        """Ask for a sign of life; a guard that gives none is hung after some time."""

    def kill(self) -> None:
        """End it; the kernel takes its devices and its claim."""


def vent_directly(supply: PressureSupply) -> bool:
    """Vent a supply, and return whether nobody else commands it.

    To vent is allowed also where another program has claimed the supply, who may raise the pressure
    again.

    Raises
    ------
    DeviceError
        The supply does not take it.
    """
    claim = Claim(lambda: supply.endpoints, wait=_CLAIM)
    try:
        claim.take()
        alone = True
    except DeviceError:
        alone = False
    try:
        with supply:  # to open it vents it, and so does to close it
            pass
    finally:
        claim.release()
    return alone


class GuardWatch:
    """Watches a guard in a thread of its own, and vents in its place when it is gone or hangs.

    Parameters
    ----------
    guard :
        What is watched.
    supply :
        Another object for the guard's supply, not open; None: it is gone with the guard.

    Attributes
    ----------
    rescued : threading.Event
        Set when the supply has been vented directly.
    error : str
        Why it could not be so far; empty if it was, or need not be.
    """

    def __init__(self, guard: Watched, supply: PressureSupply | None) -> None:
        self.rescued = threading.Event()
        self.error = ""
        self._guard, self._supply = guard, supply
        self._ended = threading.Event()
        self._venting = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="guard watch", daemon=True)

    def start(self) -> None:
        """Begin to watch."""
        self._thread.start()

    def stop(self, timeout: float = 1.0) -> None:
        """Watch no more, for the guard is about to end as it should."""
        self._ended.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout)

    def wait(self, timeout: float) -> bool:
        """Wait until the supply of a lost guard is vented; return whether it is."""
        end = time.monotonic() + timeout
        while not self.rescued.wait(0.01):
            if self._over.is_set() or time.monotonic() > end:
                break
        return self.rescued.is_set()

    def vent(self, timeout: float = 0.0) -> bool:
        """Vent the supply of a lost guard from this thread; return whether it is vented.

        It is tried once, and again until `timeout` s are over.
        """
        end = time.monotonic() + timeout
        while not self._try() and time.monotonic() < end:
            time.sleep(_AGAIN)
        return self.rescued.is_set()

    def _run(self) -> None:
        try:
            if self._supply is not None:
                with suppress(Exception):  # nothing keeps this from watching
                    self._supply.prepare()
            self._watch()
            if not self._ended.is_set():
                self._rescue()
        finally:
            self._over.set()

    def _watch(self) -> None:
        """Return when the guard has ended, or nobody needs it any more."""
        poll = select.poll()
        with ExitStack() as stack:
            with suppress(OSError, AttributeError):  # systems without these look more slowly
                end = os.pidfd_open(self._guard.pid or 0)
                stack.callback(os.close, end)
                poll.register(end, select.POLLIN)
            while self._guard.alive and not self._ended.is_set():
                poll.poll(PING_PERIOD * 1e3)
                if self._guard.alive and not self._ended.is_set():
                    self._guard.ping()
                    if self._guard.hung:
                        self._guard.kill()

    def _rescue(self) -> None:
        """Vent, however long it takes until the supply answers."""
        told = False
        while not self._try():
            if not told:
                told = True
                _log.error("the guard is gone and the supply is NOT VENTED yet: %s", self.error)
            if self._ended.wait(_AGAIN):
                return
        if self._supply is not None:
            _log.warning("the guard is gone; the supply was vented directly")

    def _try(self) -> bool:
        """Vent the supply unless that is done; return whether it is."""
        with self._venting:
            if self.rescued.is_set():
                return True
            try:
                if self._supply is not None:  # a simulated arm is gone with its guard
                    vent_directly(self._supply)
            except Exception as error:  # a driver's bug is no reason not to try again
                self.error = str(error) or type(error).__name__
                return False
            self.error = ""
            self.rescued.set()
            return True
