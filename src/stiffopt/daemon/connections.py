"""How many connections of clients there may be, and how long they may idle."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

__all__ = ["MAX_CONNECTIONS", "PATIENCE", "BoundedProtocol"]

MAX_CONNECTIONS = 64
"""At once, streams included: each is an open file, of which a process may have a thousand or so."""
PATIENCE = 30.0
"""Seconds in which a connection must have had an answer to a request; else it is closed."""


class BoundedProtocol(H11Protocol):
    """A connection of a client, of which there are only so many.

    Reading needs no token, so that anyone on this machine may connect. Who connects and says
    nothing, or dribbles, must not keep others away, for whom it may be urgent to vent: where there
    are too many connections, the one that has waited longest for its client makes room. (uvicorn's
    own `limit_concurrency` would answer everybody with 503 then.)
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Make room, if there is none, and begin to count."""
        super().connection_made(transport)
        self._closing: asyncio.TimerHandle | None = None
        self._since = 0.0
        self._begin_to_wait()
        if len(self.connections) > MAX_CONNECTIONS:
            others = [c for c in self.connections if isinstance(c, BoundedProtocol)]
            waiting = [c for c in others if c.is_waiting and c is not self]
            min(waiting, key=lambda c: c._since, default=self).drop()

    def connection_lost(self, exc: Exception | None) -> None:
        """Count no more."""
        self._stop_waiting()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        """Begin to count anew."""
        self._begin_to_wait()
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Let it be a stream, which has rules of its own."""
        self._stop_waiting()
        super().handle_websocket_upgrade(event)

    @property
    def is_waiting(self) -> bool:
        """Whether it waits for its client, and not the client for an answer."""
        cycle = self.cycle
        return cycle is None or cycle.response_complete or cycle.more_body

    def drop(self) -> None:
        """Close it at once."""
        self.connections.discard(self)  # it is gone; its socket is closed in the next round
        self.transport.abort()

    def _begin_to_wait(self) -> None:
        self._stop_waiting()
        self._since = self.loop.time()
        self._closing = self.loop.call_later(PATIENCE, self.drop)

    def _stop_waiting(self) -> None:
        if self._closing is not None:
            self._closing.cancel()
            self._closing = None
