"""The HTTP server of the daemon: uvicorn in a thread, with limits on the clients' connections.

Limited are the numbers of connections and of streams (WebSockets), and the time that a connection
may idle. If there are too many, connections without the token are closed first; they never take the
place of one with the token.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
import time
from collections.abc import Callable
from itertools import chain
from typing import Any

from starlette.datastructures import Headers

from stiffopt.daemon.address import bound_socket, local_url
from stiffopt.daemon.messages import MAX_MESSAGE
from stiffopt.errors import MissingExtraError, ServiceError

try:
    import uvicorn
    import websockets  # noqa: F401  # which uvicorn needs for the stream
    from uvicorn.protocols.http.h11_impl import H11Protocol
    from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
except ModuleNotFoundError as error:
    raise MissingExtraError(error.name or "uvicorn", "daemon") from error

MAX_CONNECTIONS = 128
"""Connections without the token, streams included; and as many with it, without streams. Each is an
open file; a process may have about a thousand."""
MAX_STREAMS = 16
"""Streams without the token, and as many with it; a hundred would delay the control loop."""
GRACE = 1.0
"""Time in s in which a stream beyond the limit may show the token."""
CONNECTION = "connection"
"""Key of a WebSocket's `LimitedConnection` in the state of its scope."""
_HANDSHAKES = 50.0
"""Rate, in 1/s, of streams without the token; each takes some milliseconds of computing."""
PATIENCE = 30.0
"""Time in s in which a connection must have had an answer to a request, or be closed."""
_BUSY = b'{"error": {"code": "busy", "message": "too many streams without the token"}}'
_REFUSAL = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: application/json\r\nConnection: close\r\n"
    b"Content-Length: %d\r\n\r\n%s" % (len(_BUSY), _BUSY)
)
_STARTING = 10.0  # s
_CONNECTIONS = 1024  # that wait to be accepted
_AT_ONCE = 16  # connections accepted before others are served; too few to push out any other
_IDLE = 10  # s; longer than clients keep an unused connection
_CLOSING = 1  # s to finish answers when the server stops
_log = logging.getLogger(__name__)


class Server:
    """Serves an ASGI application on a port until it is stopped; port 0 is any free one."""

    def __init__(self, app: Any, host: str = "127.0.0.1", port: int = 0) -> None:
        self._app = app
        self._host = host
        self.port = port
        self._server: Any = None
        self._thread: threading.Thread | None = None

    @property
    def url(self) -> str:
        """URL for clients on this machine."""
        return local_url(self._host, self.port)

    @property
    def alive(self) -> bool:
        """Whether the server runs."""
        return self._thread is not None and self._thread.is_alive() and bool(self._server.started)

    def start(self) -> None:
        """Listen; return when clients are answered.

        Raises `InputError`: it cannot listen on the address; `ServiceError`: the server does not
        start.
        """
        limiter = getattr(getattr(self._app, "state", None), "limiter", None) or ConnectionLimiter()
        listening = bound_socket(self._host, self.port, _CONNECTIONS)
        self.port = int(listening.getsockname()[1])
        config = uvicorn.Config(
            self._app,
            http=type("Connection", (BoundedProtocol,), {"limiter": limiter}),
            backlog=_AT_ONCE,
            timeout_keep_alive=_IDLE,
            ws=type("Stream", (StreamProtocol,), {"limiter": limiter}),
            ws_max_size=8 * MAX_MESSAGE,  # a longer message ends the connection
            ws_max_queue=4,
            ws_per_message_deflate=False,  # a small message must not expand to a large one
            lifespan="on",
            log_config=None,
            log_level=logging.WARNING,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=_CLOSING,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._run, args=(listening,), name="service", daemon=True
        )
        self._thread.start()
        end = time.monotonic() + _STARTING
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > end:
                self.stop()
                raise ServiceError(f"the control interface does not start at {self.url}")
            time.sleep(0.005)
        listening.listen(_CONNECTIONS)  # uvicorn has set it to `backlog`

    def stop(self, timeout: float = 5.0) -> None:
        """End all connections and stop listening; does nothing if the server does not run."""
        if self._thread is None:
            return
        self._server.should_exit = True
        self._thread.join(timeout)
        if self._thread.is_alive():
            _log.warning("the control interface did not stop within %g s", timeout)

    def _run(self, listening: socket.socket) -> None:
        try:
            self._server.run([listening])
        except BaseException:  # uvicorn leaves by SystemExit too
            _log.exception("the control interface has ended")
        finally:
            listening.close()


class LimitedConnection:
    """One connection of a client, from its acceptance to its loss.

    `drop` closes it at once. `waits_since` returns since when it has waited for its client, in s,
    or None while the client waits for an answer.

    Attributes
    ----------
    trusted : whether it has shown the token.
    is_stream : whether it has become a WebSocket.
    served : whether it is a stream that was admitted.
    """

    def __init__(
        self,
        drop: Callable[[], None] = lambda: None,
        waits_since: Callable[[], float | None] = lambda: None,
    ) -> None:
        self.drop, self.waits_since = drop, waits_since
        self.trusted = self.is_stream = self.served = False


class ConnectionLimiter:
    """The connections of a server, and the rule for closing one to make room.

    If too many have not shown the token, the oldest of them is dropped. One that has shown it makes
    room only for others that have: the one that has waited longest for its client is dropped. All
    methods are for one event loop. `trusts` returns whether the headers of a request show the
    token.
    """

    def __init__(
        self,
        trusts: Callable[[Headers], bool] = lambda headers: False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.trusts = trusts
        self._clock = clock
        self._anonymous: dict[LimitedConnection, None] = {}  # dicts serve as ordered sets
        self._trusted: dict[LimitedConnection, None] = {}
        self._handshakes, self._counted = 0.0, clock()

    def add(self, connection: LimitedConnection) -> None:
        """Add a connection that has not shown the token."""
        self._anonymous[connection] = None
        if len(self._anonymous) > MAX_CONNECTIONS:
            self._drop(next(iter(self._anonymous)))

    def remove(self, connection: LimitedConnection) -> None:
        """Forget a lost connection; a second call does nothing."""
        self._anonymous.pop(connection, None)
        self._trusted.pop(connection, None)

    def trust(self, connection: LimitedConnection) -> bool:
        """Note that a connection has shown the token; return False if it is a stream too many."""
        if connection.trusted:
            return True
        if connection.served and self._count_streams(trusted=True) >= MAX_STREAMS:
            return False
        self._anonymous.pop(connection, None)
        connection.trusted = True
        self._trusted[connection] = None
        if not connection.is_stream:
            self._make_room_for(connection)
        return True

    def distrust(self, connection: LimitedConnection) -> None:
        """Note that a connection has shown a wrong token."""
        if connection.trusted:
            connection.trusted = False
            self._trusted.pop(connection, None)
            self.add(connection)

    def admit_stream(self, connection: LimitedConnection) -> bool:
        """Admit a stream; return False if there are too many of its kind."""
        if not connection.served and self._count_streams(trusted=connection.trusted) < MAX_STREAMS:
            connection.served = True
        return connection.served

    def permits_handshake(self) -> bool:
        """Count a handshake without the token; return False if there were too many lately."""
        now = self._clock()
        passed, self._counted = now - self._counted, now
        self._handshakes = max(self._handshakes - passed * _HANDSHAKES, 0.0)
        if self._handshakes >= _HANDSHAKES:
            return False
        self._handshakes += 1
        return True

    def _count_streams(self, *, trusted: bool) -> int:
        connections = chain(self._anonymous, self._trusted)
        return sum(c.served and c.trusted is trusted for c in connections)

    def _make_room_for(self, newest: LimitedConnection) -> None:
        """Drop one of too many with the token: the newest, if none waits for its client."""
        plain = [c for c in self._trusted if not c.is_stream]
        if len(plain) > MAX_CONNECTIONS:
            since = {c: c.waits_since() for c in plain if c is not newest}
            waiting = {c: moment for c, moment in since.items() if moment is not None}
            self._drop(min(waiting, key=waiting.__getitem__, default=newest))

    def _drop(self, connection: LimitedConnection) -> None:
        self.remove(connection)
        connection.drop()


class BoundedProtocol(H11Protocol):
    """An HTTP connection under a `ConnectionLimiter`; it is closed when it idles.

    Reading needs no token, so anyone on this machine may connect. Clients that send nothing, send
    slowly or reconnect all the time must not keep out one that wants to vent. (uvicorn's own
    `limit_concurrency` would then answer all clients with 503.)
    """

    limiter: ConnectionLimiter

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Add the connection to the limiter, and start its idle time."""
        super().connection_made(transport)
        self.connection = LimitedConnection(self.drop, self._waits_since)
        self._closing: asyncio.TimerHandle | None = None
        self._since = 0.0
        self._is_refused = False
        self._begin_to_wait()
        self.limiter.add(self.connection)

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection from the limiter."""
        self._stop_waiting()
        self.limiter.remove(self.connection)
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        """Restart the idle time."""
        self._begin_to_wait()
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Turn the connection into a stream.

        Too frequent handshakes without the token are refused before any work is done for them, and
        after a delay, because such a client would try again at once.
        """
        self._stop_waiting()
        if not self.connection.trusted and not self.limiter.permits_handshake():
            self._is_refused = True
            self.transport.pause_reading()
            self._closing = self.loop.call_later(GRACE, self._refuse)
            return
        self.connection.is_stream = True
        self.connection.drop = self.transport.abort
        self.app_state = {**self.app_state, CONNECTION: self.connection}
        super().handle_websocket_upgrade(event)

    def drop(self) -> None:
        """Close the connection at once."""
        self.connections.discard(self)  # now; the event loop closes the socket later
        self.transport.abort()

    def shutdown(self) -> None:
        """Close the connection when the server stops."""
        if self._is_refused:  # h11 waits for an answer that never comes
            self.drop()
        else:
            super().shutdown()

    def _should_upgrade(self) -> bool:
        """Check the headers of a request, which have just arrived, for the token."""
        if not self.connection.trusted and self.limiter.trusts(Headers(raw=self.headers)):
            self.limiter.trust(self.connection)
        return super()._should_upgrade()

    def _refuse(self) -> None:
        self.transport.write(_REFUSAL)
        self.transport.close()

    def _waits_since(self) -> float | None:
        """Return since when it waits for its client; None while the client waits for it."""
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
    """A WebSocket connection under a `ConnectionLimiter`."""

    limiter: ConnectionLimiter

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection from the limiter."""
        self.limiter.remove(self.app_state[CONNECTION])
        super().connection_lost(exc)
