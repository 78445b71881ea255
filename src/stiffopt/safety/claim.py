"""Exclusive claims: no two programs command one supply.

A claim is a name in Linux's abstract socket namespace, made from the supply's endpoint. The kernel
gives such a name to one process at a time, whatever its user, and frees it however that process
ends; no file can be left behind, linked or removed. All programs of a machine share the names,
except containers with a network namespace of their own.
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

_WAIT = 1.0  # s; a program that is ending may take some tens of milliseconds to vent
_AGAIN = 0.02  # s between two attempts


def address_of(purpose: str, endpoint: str) -> str:
    """Return the abstract socket address of an endpoint for a purpose: ``claim`` or ``vent``."""
    return f"\0stiffopt/{purpose}/{hashlib.sha256(endpoint.encode()).hexdigest()[:40]}"


class Claim:
    """The right to command a supply, which one process has at a time.

    Parameters
    ----------
    endpoints : returns the names to be claimed (`PressureSupply.endpoints`); called in `take`.
    holder : returns who has claimed an endpoint, for the error message.
    wait : time for which `take` waits for a claim that another process has, in s.
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
        """Whether this object holds the claim; always False for a supply without endpoints."""
        return bool(self._names)

    def take(self) -> None:
        """Claim all endpoints; do nothing if they are already held.

        Raises `DeviceError`: another program has one of them, or this system has no such claims.
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
        """Free all endpoints; do nothing if they are not held."""
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
