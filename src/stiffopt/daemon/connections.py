"""Limits on the connections of clients: how many there may be, and how long they may idle.

Where there are too many, connections that have not shown the token are closed first; they never
take the place of one that has.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from itertools import chain
from typing import Any

from starlette.datastructures import Headers
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

__all__ = [
    "GRACE",
    "MAX_CONNECTIONS",
    "MAX_STREAMS",
    "MEMBER",
    "PATIENCE",
    "BoundedProtocol",
    "Crowd",
    "Member",
    "StreamProtocol",
    "protocols_of",
]

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
    """One connection of a client, from when it is accepted until it is lost.

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
    """The connections of a server, and the rule by which one is closed to make room.

    All methods are for one event loop.

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


PATIENCE = 30.0
"""Seconds in which a connection must have had an answer to a request; else it is closed."""
_BUSY = b'{"error": {"code": "busy", "message": "too many streams without the token"}}'
_REFUSAL = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: application/json\r\nConnection: close\r\n"
    b"Content-Length: %d\r\n\r\n%s" % (len(_BUSY), _BUSY)
)


class BoundedProtocol(H11Protocol):
    """An HTTP connection that counts among the `Crowd` and is closed when it idles.

    Reading needs no token, so that anyone on this machine may connect. Who connects and says
    nothing, dribbles, or comes again and again must not keep others away, for whom it may be urgent
    to vent: see `Crowd`. (uvicorn's own `limit_concurrency` would answer everybody with 503 then.)
    """

    crowd: Crowd

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Be one of the crowd, and begin to count."""
        super().connection_made(transport)
        self.member = Member(self.drop, self._waits_since)
        self._closing: asyncio.TimerHandle | None = None
        self._since = 0.0
        self._is_refused = False
        self._begin_to_wait()
        self.crowd.join(self.member)

    def connection_lost(self, exc: Exception | None) -> None:
        """Count no more."""
        self._stop_waiting()
        self.crowd.leave(self.member)
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        """Begin to count anew."""
        self._begin_to_wait()
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Let it be a stream, which has rules of its own.

        Strangers who come too fast are refused before any work is done for them, and not at once:
        they would only come again.
        """
        self._stop_waiting()
        if not self.member.trusted and not self.crowd.permits_handshake():
            self._is_refused = True
            self.transport.pause_reading()
            self._closing = self.loop.call_later(GRACE, self._refuse)
            return
        self.member.is_stream = True
        self.member.drop = self.transport.abort
        self.app_state = {**self.app_state, MEMBER: self.member}
        super().handle_websocket_upgrade(event)

    def drop(self) -> None:
        """Close it at once."""
        self.connections.discard(self)  # it is gone; its socket is closed in the next round
        self.transport.abort()

    def shutdown(self) -> None:
        """End when the server does."""
        if self._is_refused:  # h11 waits for an answer that never comes
            self.drop()
        else:
            super().shutdown()

    def _should_upgrade(self) -> bool:
        """Look at the headers of a request, which have just come."""
        if not self.member.trusted and self.crowd.trusts(Headers(raw=self.headers)):
            self.crowd.trust(self.member)
        return super()._should_upgrade()

    def _refuse(self) -> None:
        self.transport.write(_REFUSAL)
        self.transport.close()

    def _waits_since(self) -> float | None:
        """Return since when it waits for its client; None if the client waits for an answer."""
        cycle = self.cycle
        waits = cycle is None or cycle.response_complete or cycle.more_body
        return self._since if waits else None

    def _begin_to_wait(self) -> None:
        self._stop_waiting()
        self._since = self.loop.time()
        self._closing = self.loop.call_later(PATIENCE, self.drop)

    def _stop_waiting(self) -> None:
        if self._closing is not None:
            self._closing.cancel()
            self._closing = None


class StreamProtocol(WebSocketsSansIOProtocol):
    """A WebSocket connection that leaves the `Crowd` when it is lost."""

    crowd: Crowd

    def connection_lost(self, exc: Exception | None) -> None:
        """Be no longer one of the crowd."""
        self.crowd.leave(self.app_state[MEMBER])
        super().connection_lost(exc)


def protocols_of(crowd: Crowd) -> tuple[type[BoundedProtocol], type[StreamProtocol]]:
    """Return the protocols of the connections and streams of a crowd."""
    return (
        type("Connection", (BoundedProtocol,), {"crowd": crowd}),
        type("Stream", (StreamProtocol,), {"crowd": crowd}),
    )
