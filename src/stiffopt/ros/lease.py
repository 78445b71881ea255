"""Control of the arm for writers on the graph: one at a time, as long as it lives."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from contextlib import suppress

from stiffopt.daemon.client import Client
from stiffopt.errors import CommandError, StiffoptError
from stiffopt.ros.node import Subscription, Writer

_RENEWALS = 4  # per heartbeat


class GraphLease:
    """The daemon's control lease, held for one writer on the graph.

    The writer that sets the arm in motion has control, together with the other writers of its
    process. Control ends with the writer's liveliness: when the writer is gone; when it has not
    asserted its liveliness within the lease that it offers; or, if it offers no lease or one above
    the daemon's `heartbeat`, when its process has written nothing to this node for that time. The
    arm is held then, and let down as after any hold that no client ends. Other commands need
    control only while they are carried out.

    Parameters
    ----------
    client : client of the daemon, with the heartbeat ``manual``.
    heartbeat : heartbeat of the daemon, in s.
    tell : called with the reason why control has ended.
    """

    def __init__(
        self,
        client: Client,
        heartbeat: float,
        tell: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._client, self._heartbeat, self._tell, self._clock = client, heartbeat, tell, clock
        self._lock = threading.Lock()
        self._holder: tuple[Subscription, Writer] | None = None
        self._heard = -math.inf

    @property
    def period(self) -> float:
        """Interval at which to call `look`, in s."""
        return self._heartbeat / _RENEWALS

    @property
    def holder(self) -> str:
        """The process in control, in words; empty if it is not on the graph."""
        holder = self._holder
        return "" if holder is None else f"process {holder[1].participant}"

    def hear(self, writer: Writer) -> None:
        """Note that a writer's process has written something."""
        with self._lock:
            if self._holder is not None and self._holder[1].participant == writer.participant:
                self._heard = self._clock()

    def move(self, source: Subscription, writer: Writer, command: Callable[[], None]) -> None:
        """Set the arm in motion for a writer, which has control from then on.

        Raises `StiffoptError`: another writer has control, or the daemon refuses.
        """
        self._check(writer)
        had = self._holder is not None
        self._client.take_control()
        try:
            command()
        except BaseException:
            if not had:
                self._release()
            raise
        with self._lock:
            self._holder = source, writer
            if not had:
                self._heard = self._clock()

    def once(self, writer: Writer, command: Callable[[], None]) -> None:
        """Carry out a command that needs control only meanwhile; raises as `move`."""
        self._check(writer)
        self._client.take_control()
        try:
            command()
        finally:
            if self._holder is None:
                self._release()

    def look(self) -> None:
        """Renew control while its holder lives; otherwise hold the arm and give control back."""
        holder = self._holder
        if holder is None:
            return
        if not self._client.in_control:
            self._end("the daemon has taken control back")
            return
        reason = self._death(*holder)
        if reason:
            self.end(reason)
            return
        try:
            self._client.renew()
        except CommandError as error:
            self._end(str(error))
        except StiffoptError as error:
            self._tell(f"control could not be renewed: {error}")

    def end(self, reason: str) -> None:
        """Hold the arm and give control back, if a writer on the graph has it."""
        if self._holder is None:
            return
        with suppress(StiffoptError):  # there may be nothing to hold
            self._client.hold(reason)
        self._release()
        self._end(reason)

    def _death(self, source: Subscription, writer: Writer) -> str:
        """Return why the writer in control does not count as alive; empty if it does."""
        if not source.lives(writer):
            return "the writer that had control is gone, or does not say that it lives"
        silent = self._clock() - self._heard
        if writer.lease > self._heartbeat and silent > self._heartbeat:
            return (
                f"the program that had control was silent for {self._heartbeat:g} s; it offers no "
                "lease of liveliness that would speak for it"
            )
        return ""

    def _check(self, writer: Writer) -> None:
        holder = self._holder
        if holder is not None and holder[1].participant != writer.participant:
            raise CommandError("another writer has control; it ends with its liveliness")

    def _release(self) -> None:
        with suppress(StiffoptError):
            self._client.release()

    def _end(self, reason: str) -> None:
        with self._lock:
            self._holder = None
        self._tell(f"control has ended: {reason}")
