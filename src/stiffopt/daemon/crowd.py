"""Who is connected, and who makes room: those without the token, never those with it."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import chain

from starlette.datastructures import Headers

__all__ = ["GRACE", "MAX_CONNECTIONS", "MAX_STREAMS", "MEMBER", "Crowd", "Member"]

MAX_CONNECTIONS = 128
"""Without the token, streams included; and as many with it, beside streams. Each is an open file,
of which a process may have a thousand or so."""
MAX_STREAMS = 16
"""Without the token, and as many with it; a hundred would keep the control loop from its work."""
GRACE = 1.0
"""Seconds in which a stream for which there is no room may show the token."""
MEMBER = "member"
"""Of the state in a WebSocket's scope: the `Member` that it is."""
_HANDSHAKES = 50.0
"""A second, of streams without the token; each takes some milliseconds of computing."""


class Member:
    """A connection, from when it is accepted until it is lost.

    Parameters
    ----------
    drop :
        Closes it at once.
    waits_since :
        Returns since when it waits for its client, in s; None while its client waits for it.

    Attributes
    ----------
    trusted : whether it has shown the token.
    is_stream : whether it has become a WebSocket.
    seated : whether it is one of the streams that are served.
    """

    def __init__(
        self,
        drop: Callable[[], None] = lambda: None,
        waits_since: Callable[[], float | None] = lambda: None,
    ) -> None:
        self.drop, self.waits_since = drop, waits_since
        self.trusted = self.is_stream = self.seated = False


class Crowd:
    """All connections of a server. All methods are for one event loop.

    Who has not shown the token is a stranger. Where strangers are too many, the first to come is
    dropped. Who has shown it makes room only for others who have: the one that has waited longest
    for its client.

    Parameters
    ----------
    trusts :
        Says whether the headers of a request show the token.
    clock :
        Time in s.
    """

    def __init__(
        self,
        trusts: Callable[[Headers], bool] = lambda headers: False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.trusts = trusts
        self._clock = clock
        self._strangers: dict[Member, None] = {}  # as sets that keep the order
        self._trusted: dict[Member, None] = {}
        self._handshakes, self._counted = 0.0, clock()

    def join(self, member: Member) -> None:
        """Take in a stranger."""
        self._strangers[member] = None
        if len(self._strangers) > MAX_CONNECTIONS:
            self._drop(next(iter(self._strangers)))

    def leave(self, member: Member) -> None:
        """Forget one who is gone; to forget twice does nothing."""
        self._strangers.pop(member, None)
        self._trusted.pop(member, None)

    def trust(self, member: Member) -> bool:
        """Note that one has shown the token; return False where a stream finds no seat for it."""
        if member.trusted:
            return True
        if member.seated and self._seats(trusted=True) >= MAX_STREAMS:
            return False
        self._strangers.pop(member, None)
        member.trusted = True
        self._trusted[member] = None
        if not member.is_stream:
            self._make_room_for(member)
        return True

    def distrust(self, member: Member) -> None:
        """Note that one has shown a wrong token; it is a stranger again."""
        if member.trusted:
            member.trusted = False
            self._trusted.pop(member, None)
            self.join(member)

    def seat(self, member: Member) -> bool:
        """Let a stream be served; return False where there are enough of its kind."""
        if not member.seated and self._seats(trusted=member.trusted) < MAX_STREAMS:
            member.seated = True
        return member.seated

    def permits_handshake(self) -> bool:
        """Count another stranger's handshake; return False where there were too many just now."""
        now = self._clock()
        passed, self._counted = now - self._counted, now
        self._handshakes = max(self._handshakes - passed * _HANDSHAKES, 0.0)
        if self._handshakes >= _HANDSHAKES:
            return False
        self._handshakes += 1
        return True

    def _seats(self, *, trusted: bool) -> int:
        everyone = chain(self._strangers, self._trusted)
        return sum(m.seated and m.trusted is trusted for m in everyone)

    def _make_room_for(self, newest: Member) -> None:
        """Drop one of too many with the token: where none waits for its client, the newest."""
        plain = [m for m in self._trusted if not m.is_stream]
        if len(plain) > MAX_CONNECTIONS:
            since = {m: m.waits_since() for m in plain if m is not newest}
            waiting = {m: moment for m, moment in since.items() if moment is not None}
            self._drop(min(waiting, key=waiting.__getitem__, default=newest))

    def _drop(self, member: Member) -> None:
        self.leave(member)
        member.drop()
