"""The control lease: one client at a time may command the arm, as long as it sends heartbeats."""

from __future__ import annotations

import hmac
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from stiffopt.daemon.reports import LEASE_HEADER, LeaseReport, RefusalError
from stiffopt.rig.interface import Clock


@dataclass
class _Grant:
    client: str
    identity: str
    heard: float
    busy: int = 0  # commands in progress
    lost: bool = False


class ControlLease:
    """Control over the arm, granted to one client at a time.

    A client that is not heard for `heartbeat` seconds loses control, and the arm is to be held.
    `check` reports the loss; no client gets control until `settle` is called after it. Requests of
    clients without control raise `RefusalError`. Any thread may call any method.
    """

    def __init__(self, heartbeat: float, clock: Clock) -> None:
        self.heartbeat = heartbeat
        self._clock = clock
        self._lock = threading.Lock()
        self._grant: _Grant | None = None

    @property
    def holder(self) -> LeaseReport | None:
        """The client in control, or None."""
        with self._lock:
            if self._grant is None:
                return None
            return LeaseReport(client=self._grant.client, expires_in_s=self._left(self._grant))

    def take(self, client: str) -> str:
        """Grant control to a client; return the lease to send with each command.

        `RefusalError` if another client has control, or has just lost it and the arm is not yet
        held.
        """
        with self._lock:
            grant = self._grant
            if grant is not None and self._is_lost(grant):
                raise _refused(
                    f"'{grant.client}' has just lost control and the arm is being held; try again"
                )
            if grant is not None:
                raise _refused(
                    f"'{grant.client}' has control; it ends in "
                    f"{self._left(grant):.2f} s unless it is renewed"
                )
            self._grant = _Grant(client, secrets.token_urlsafe(16), self._clock.now())
            return self._grant.identity

    def renew(self, identity: str | None) -> None:
        """Note a heartbeat of the client."""
        with self._lock:
            self._own(identity).heard = self._clock.now()

    def release(self, identity: str | None) -> None:
        """End the control of a client at its own request."""
        with self._lock:
            self._own(identity)
            self._grant = None

    @contextmanager
    def used(self, identity: str | None) -> Iterator[None]:
        """Carry out a client's command in the body; the client counts as heard until its end."""
        with self._lock:
            grant = self._own(identity)
            grant.heard = self._clock.now()
            grant.busy += 1
        try:
            yield
        finally:
            with self._lock:
                grant.heard = self._clock.now()
                grant.busy -= 1

    def check(self, now: float) -> str | None:
        """Return the client that has lost control at a time, in s, until `settle`; or None."""
        with self._lock:
            grant = self._grant
            return grant.client if grant is not None and self._is_lost(grant, now) else None

    def settle(self) -> None:
        """Note that the arm was held after a loss, so that others may take control."""
        with self._lock:
            if self._grant is not None and self._grant.lost:
                self._grant = None

    def _own(self, identity: str | None) -> _Grant:
        grant = self._grant
        if identity is None:
            raise _refused(f"this needs control; take it, and show the lease in '{LEASE_HEADER}'")
        if grant is None:
            raise _refused("you do not have control; take it first")
        if not hmac.compare_digest(grant.identity.encode(), identity.encode()):
            raise _refused(f"you do not have control; '{grant.client}' has it")
        if self._is_lost(grant):
            raise _refused(
                f"control was lost, as nothing was heard for {self.heartbeat:g} s; take it again"
            )
        return grant

    def _is_lost(self, grant: _Grant, now: float | None = None) -> bool:
        """Return whether control is lost, which is permanent."""
        now = self._clock.now() if now is None else now
        if not grant.busy and now - grant.heard > self.heartbeat:
            grant.lost = True
        return grant.lost

    def _left(self, grant: _Grant) -> float:
        """Return the time, in s, after which control is lost in silence; not negative."""
        left = grant.heard + self.heartbeat - self._clock.now()
        return min(max(left, 0.0), self.heartbeat)


def _refused(message: str) -> RefusalError:
    return RefusalError(409, "lease", message)
