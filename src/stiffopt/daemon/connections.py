"""The connections of clients as uvicorn has them: how long they may idle, and who makes room."""

from __future__ import annotations

import asyncio
from typing import Any

from starlette.datastructures import Headers
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from stiffopt.daemon.crowd import GRACE, MEMBER, Crowd, Member

__all__ = ["PATIENCE", "BoundedProtocol", "StreamProtocol", "protocols_of"]

PATIENCE = 30.0
"""Seconds in which a connection must have had an answer to a request; else it is closed."""
_BUSY = b'{"error": {"code": "busy", "message": "too many streams without the token"}}'
_REFUSAL = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: application/json\r\nConnection: close\r\n"
    b"Content-Length: %d\r\n\r\n%s" % (len(_BUSY), _BUSY)
)


class BoundedProtocol(H11Protocol):
    """A connection of a client, of which there are only so many.

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
    """A WebSocket, which tells the crowd when it is gone."""

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
