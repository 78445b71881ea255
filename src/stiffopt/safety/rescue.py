"""Venting without a guard: when the guard has ended, its client vents the supply at once."""

from __future__ import annotations

import logging
import os
import select
import threading
import time
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING

from stiffopt.errors import DeviceError
from stiffopt.rig.interface import PressureSupply
from stiffopt.safety.claim import Claim
from stiffopt.safety.settings import CLIENT

if TYPE_CHECKING:
    from stiffopt.safety.guard_client import GuardLink

_log = logging.getLogger(__name__)


def vent_directly(supply: PressureSupply) -> bool:
    """Vent a supply; return False if another program has claimed it.

    Even then it is vented, but that program may raise the pressure again.

    Raises `DeviceError`: the supply does not answer.
    """
    claim = Claim(lambda: supply.endpoints, wait=CLIENT.claim)
    try:
        claim.take()
        alone = True
    except DeviceError:
        alone = False
    try:
        with supply:  # opening and closing both vent
            pass
    finally:
        claim.release()
    return alone


class GuardWatch:
    """Watches a guard in a separate thread and vents the supply when the guard has ended or hangs.

    Parameters
    ----------
    guard : the client's link to the guard.
    supply : another object for the guard's supply, not open; None: the supply is simulated and ends
        with the guard.

    Attributes
    ----------
    rescued : threading.Event
        Set when the supply has been vented directly.
    error : str
        Why venting has failed so far; empty if it has not.
    """

    def __init__(self, guard: GuardLink, supply: PressureSupply | None) -> None:
        self.rescued = threading.Event()
        self.error = ""
        self._guard, self._supply = guard, supply
        self._ended = threading.Event()
        self._venting = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="guard watch", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self, timeout: float = 1.0) -> None:
        """Stop watching, because the guard is about to end regularly."""
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

        It is tried at least once, and repeated for up to `timeout` s.
        """
        end = time.monotonic() + timeout
        while not self._try() and time.monotonic() < end:
            time.sleep(CLIENT.rescue_retry)
        return self.rescued.is_set()

    def _run(self) -> None:
        try:
            if self._supply is not None:
                with suppress(Exception):  # whatever fails, the watch must go on
                    self._supply.prepare()
            self._watch()
            if not self._ended.is_set():
                self._rescue()
        finally:
            self._over.set()

    def _watch(self) -> None:
        """Return when the guard has ended, or after `stop`."""
        poll = select.poll()
        with ExitStack() as stack:
            with suppress(OSError, AttributeError):  # without pidfd, polling alone must do
                end = os.pidfd_open(self._guard.pid or 0)
                stack.callback(os.close, end)
                poll.register(end, select.POLLIN)
            while self._guard.alive and not self._ended.is_set():
                poll.poll(CLIENT.ping * 1e3)
                if self._guard.alive and not self._ended.is_set():
                    self._guard.ping()
                    if self._guard.hung:
                        self._guard.kill()

    def _rescue(self) -> None:
        """Vent; repeat until the supply answers."""
        told = False
        while not self._try():
            if not told:
                told = True
                _log.error("the guard is gone and the supply is NOT VENTED yet: %s", self.error)
            if self._ended.wait(CLIENT.rescue_retry):
                return
        if self._supply is not None:
            _log.warning("the guard is gone; the supply was vented directly")

    def _try(self) -> bool:
        """Vent the supply unless it is already vented; return whether it is vented."""
        with self._venting:
            if self.rescued.is_set():
                return True
            try:
                if self._supply is not None:  # a simulated arm ends with its guard
                    vent_directly(self._supply)
            except Exception as error:  # even a driver's bug is followed by another attempt
                self.error = str(error) or type(error).__name__
                return False
            self.error = ""
            self.rescued.set()
            return True
