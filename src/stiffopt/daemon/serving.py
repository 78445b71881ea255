"""Runs the HTTP interface in uvicorn, in a thread of its own."""

from __future__ import annotations

import logging
import socket
import threading
import time
from typing import Any

from stiffopt.daemon.messages import MAX_MESSAGE
from stiffopt.daemon.secret import bracketed
from stiffopt.errors import InputError, MissingExtraError, ServiceError

__all__ = ["Server"]

_STARTING = 10.0  # s
_CONNECTIONS = 1024  # that have not been accepted yet
_AT_ONCE = 16  # of these are accepted, then others are heard; far fewer than make anyone give way
_IDLE = 10  # s; longer than clients keep a connection that they do not use
_CLOSING = 1  # s for requests that are being answered when the server stops
_log = logging.getLogger(__name__)


class Server:
    """Serves an application on a port until it is stopped.

    Parameters
    ----------
    app :
        An ASGI application.
    host, port :
        Where to listen; port 0 is any free one.
    """

    def __init__(self, app: Any, host: str = "127.0.0.1", port: int = 0) -> None:
        self._app = app
        self._host = host
        self._port = port
        self._server: Any = None
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> int:
        """The port that it listens on; the one asked for, before it does."""
        return self._port

    @property
    def url(self) -> str:
        """Where clients of this machine reach it."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self._host, self._host)
        return f"http://{bracketed(host)}:{self.port}"

    @property
    def alive(self) -> bool:
        """Whether it serves."""
        return self._thread is not None and self._thread.is_alive() and bool(self._server.started)

    def start(self) -> None:
        """Listen, and return when clients are answered.

        Raises
        ------
        InputError
            The address cannot be listened on.
        MissingExtraError
            uvicorn or websockets is not installed.
        ServiceError
            The server does not start.
        """
        try:
            import uvicorn
            import websockets  # noqa: F401  # which uvicorn needs for the stream
        except ModuleNotFoundError as error:
            raise MissingExtraError(error.name or "uvicorn", "daemon") from error
        from stiffopt.daemon.connections import Crowd, protocols_of

        crowd = getattr(getattr(self._app, "state", None), "crowd", None) or Crowd()
        connection, stream = protocols_of(crowd)
        listening = self._listen()
        self._port = int(listening.getsockname()[1])
        config = uvicorn.Config(
            self._app,
            http=connection,
            backlog=_AT_ONCE,
            timeout_keep_alive=_IDLE,
            ws=stream,
            ws_max_size=8 * MAX_MESSAGE,  # what is longer ends the connection
            ws_max_queue=4,
            ws_per_message_deflate=False,  # a small message must not become a large one
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
        listening.listen(_CONNECTIONS)  # `backlog` has made it less

    def stop(self, timeout: float = 5.0) -> None:
        """End all connections and stop listening; to stop what does not run does nothing."""
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

    def _listen(self) -> socket.socket:
        try:
            found = socket.getaddrinfo(
                self._host, self._port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )
            family, kind, protocol, _, address = found[0]
            listening = socket.socket(family, kind, protocol)
        except OSError as error:
            raise self._cannot(error) from None
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind(address)
            listening.listen(_CONNECTIONS)
        except OSError as error:
            listening.close()
            raise self._cannot(error) from None
        return listening

    def _cannot(self, error: OSError) -> InputError:
        return InputError(
            f"cannot listen on {self._host} port {self._port}: {(error.strerror or '').lower()}; "
            "give another host or port"
        )
