"""Exclusive claims: no two programs command one supply.

A claim is a name in Linux's abstract socket namespace, made of the supply's endpoint. The kernel
gives such a name to one process at a time, whoever its user is, and takes it back however that
process ends; there is no file that could be left behind, linked elsewhere or removed. Names are
common to all programs of a machine, but not to containers with a network namespace of their own.
"""

from __future__ import annotations

import errno
import hashlib
import socket
import sys
import time
from collections.abc import Callable, Sequence
from threading import Lock

from stiffopt.errors import DeviceError

__all__ = ["Claim", "address_of"]

_WAIT = 1.0  # s: a program that has just ended still vents for some tens of milliseconds
_AGAIN = 0.02  # s between two attempts


def address_of(purpose: str, endpoint: str) -> str:
    """Return the abstract socket address that stands for an endpoint, for some purpose."""
    return f"\0stiffopt/{purpose}/{hashlib.sha256(endpoint.encode()).hexdigest()[:40]}"


class Claim:
    """The right to command a supply, of one process at a time.

    Parameters
    ----------
    endpoints :
        Returns what is claimed (`PressureSupply.endpoints`); called in `take`.
    holder :
        Says who has an endpoint that is taken, as part of a sentence.
    wait :
        Seconds for which a claim that is taken may still become free.
    """

    def __init__(
        self,
        endpoints: Callable[[], Sequence[str]],
        holder: Callable[[str], str] = lambda endpoint: "another program",
        wait: float = _WAIT,
    ) -> None:
        self._endpoints = endpoints
        self._holder = holder
        self._wait = wait
        self._names: list[socket.socket] = []
        self._lock = Lock()

    @property
    def held(self) -> bool:
        """Whether this object has taken it; a supply without endpoints is never held."""
        return bool(self._names)

    def take(self) -> None:
        """Claim all endpoints; to take what is held already does nothing.

        Raises
        ------
        DeviceError
            Another program has one of them, or this system has no such claims.
        """
        with self._lock:
            if self._names:
                return
            endpoints = self._endpoints()
            if endpoints and not sys.platform.startswith("linux"):
                raise DeviceError("real supplies can be claimed, and so commanded, on Linux alone")
            end = time.monotonic() + self._wait
            try:
                for endpoint in endpoints:
                    self._names.append(self._taken(endpoint, end))
            except BaseException:
                self._give_back()
                raise

    def release(self) -> None:
        """Give all endpoints back; to release what is not held does nothing."""
        with self._lock:
            self._give_back()

    def _give_back(self) -> None:
        while self._names:
            self._names.pop().close()

    def _taken(self, endpoint: str, end: float) -> socket.socket:
        name = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._bind(name, endpoint, end)
        except BaseException:
            name.close()
            raise
        return name

    def _bind(self, name: socket.socket, endpoint: str, end: float) -> None:
        while True:
            try:
                name.bind(address_of("claim", endpoint))
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise DeviceError(f"the supply cannot be claimed: {error}") from None
                if time.monotonic() < end:
                    time.sleep(_AGAIN)
                    continue
                raise DeviceError(
                    f"the supply ({endpoint}) is commanded by {self._holder(endpoint)}; only one "
                    "program may, so end that one first ('stiffopt vent RIG' lets its pressure out)"
                ) from None
            return
