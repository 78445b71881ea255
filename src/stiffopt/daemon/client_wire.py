"""The client's side of the network: requests over HTTP, states and targets over a WebSocket."""

from __future__ import annotations

import itertools
import json
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import urlsplit

from stiffopt.control.state import Snapshot
from stiffopt.daemon.messages import TargetMessage
from stiffopt.daemon.reports import LEASE_HEADER, error_of, record_of
from stiffopt.errors import InputError, MissingExtraError, ServiceError, StiffoptError
from stiffopt.optimise.target import Target

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

__all__ = [
    "ClientStream",
    "Wire",
]

_LOST = "lease"  # the code of a refusal that says that control is not (any longer) had


class Wire:
    """Sends HTTP requests to the daemon; a refusal is raised as an exception.

    Parameters
    ----------
    url :
        Of the daemon.
    token :
        Or None.
    timeout :
        Seconds after which an answer is given up.
    """

    def __init__(self, url: str, token: str | None, timeout: float) -> None:
        try:
            import httpx
        except ModuleNotFoundError as error:
            raise MissingExtraError("httpx", "daemon") from error
        try:
            parts = urlsplit(url)
            good = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
        except ValueError:
            good = False
        if not good:
            raise InputError(f"'{url}' is no URL of a daemon; one is http://127.0.0.1:8470")
        if token is not None and not (token.isascii() and token.isprintable()):
            raise InputError("the token has characters that no token has")
        self.url = url.rstrip("/")
        self.token = token
        self.lease: str | None = None
        self._httpx = httpx
        # No proxy of the environment: it would see the token.
        self._http = httpx.Client(trust_env=False, timeout=timeout, follow_redirects=False)

    @property
    def headers(self) -> dict[str, str]:
        """What shows who this is."""
        headers = {} if self.token is None else {"Authorization": f"Bearer {self.token}"}
        return headers if self.lease is None else {**headers, LEASE_HEADER: self.lease}

    def close(self) -> None:
        """Disconnect."""
        self._http.close()

    def ask(
        self,
        method: str,
        path: str,
        *,
        body: Any = None,
        query: dict[str, Any] | None = None,
        timeout: float | None = None,
    ) -> Any:
        """Return the daemon's answer.

        Raises
        ------
        CommandError
            It refuses: no control, no token, or not now.
        InputError
            What was asked for makes no sense.
        ServiceError
            It cannot be reached, does not answer in time, or fails.
        """
        lease = self.lease
        try:
            answer = self._http.request(
                method,
                f"{self.url}/v1/{path}",
                json=body,
                params=query,
                headers=self.headers,
                timeout=self._httpx.USE_CLIENT_DEFAULT if timeout is None else timeout,
            )
        except (self._httpx.HTTPError, RuntimeError) as error:  # RuntimeError: it was closed
            raise ServiceError(
                f"the daemon at {self.url} cannot be reached: {error or type(error).__name__}"
            ) from None
        if answer.is_success:
            return answer.json() if answer.content else None
        code, message = _told(answer)
        if code == _LOST and self.lease == lease:
            self.lease = None
        raise error_of(answer.status_code, message)


def _told(answer: Any) -> tuple[str, str]:
    """Return the code and the message of a refusal, also of one that is not the daemon's."""
    try:
        error = answer.json()["error"]
        return str(error["code"]), str(error["message"])
    except (ValueError, KeyError, TypeError):
        return "", f"what answers is no stiffopt daemon; it says {answer.status_code}"


_STATUS = {"input": 422, "too-long": 413, "no-answer": 503, "busy": 503, "internal": 500}


class ClientStream:
    """A WebSocket that carries targets to the daemon and states back; see `Client.stream`.

    Targets are sent without waiting for the answers. One that is refused raises `CommandError`,
    or `InputError`, at the next `send` or `state`, but for a target that a newer one has
    overtaken: that is what happens if they come faster than the arm takes them, and does no harm.
    """

    def __init__(self, wire: Wire, rate: float) -> None:
        self._wire = wire
        self._rate = rate
        self._open = ExitStack()
        self._socket: ClientConnection | None = None
        self._numbers = itertools.count()
        self._news = threading.Condition()
        self._state: Snapshot | None = None
        self._refused: StiffoptError | None = None
        self._ended: StiffoptError | None = None
        self._lease: str | None = None
        self.accepted = 0
        """Targets that the daemon has accepted so far."""
        self.superseded = 0
        """Targets that a newer one has overtaken so far."""

    def __enter__(self) -> Self:
        """Connect; raise `ServiceError` if the daemon does not answer."""
        try:
            from websockets.exceptions import WebSocketException
            from websockets.sync.client import connect
        except ModuleNotFoundError as error:
            raise MissingExtraError("websockets", "daemon") from error
        url = "ws" + self._wire.url.removeprefix("http") + f"/v1/stream?rate={self._rate:g}"
        self._lease = self._wire.lease
        try:
            self._socket = self._open.enter_context(
                connect(
                    url,
                    additional_headers=self._wire.headers,
                    compression=None,
                    proxy=None,  # it would see the token
                    open_timeout=5,
                    close_timeout=2,
                )
            )
        except (OSError, WebSocketException) as error:
            raise ServiceError(f"no stream from {self._wire.url}: {error}") from None
        threading.Thread(
            target=self._listen, args=(self._socket,), name="stream", daemon=True
        ).start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._open.close()

    def send(
        self, target: Target | None = None, *, position: Sequence[float | None] | None = None
    ) -> None:
        """Go to a target, or to a position in m, from now on.

        Raises
        ------
        CommandError, InputError
            An earlier target was refused.
        ServiceError
            The stream has ended.
        """
        self._raise_refusal()
        message = TargetMessage.of(target or Target(position=position)).model_dump()
        if self._wire.lease != self._lease:  # control was taken after the stream began
            self._lease = self._wire.lease
            if self._lease is not None:
                self._send({"lease": self._lease})
        self._send({"target": message, "seq": next(self._numbers)})

    def state(self, timeout: float = 5.0) -> Snapshot:
        """Return the newest state that has not been returned yet, waiting for it if need be.

        Raises
        ------
        CommandError, InputError
            A target was refused.
        ServiceError
            None came in time, or the stream has ended.
        """
        with self._news:
            there = self._news.wait_for(
                lambda: self._state is not None or self._ended or self._refused, timeout
            )
            if there and self._state is not None:
                state, self._state = self._state, None
                if self._refused is None:
                    return state
        self._raise_refusal()
        raise ServiceError(f"no state came within {timeout:g} s")

    def _raise_refusal(self) -> None:
        with self._news:
            refused, self._refused = self._refused, None
            error = refused or self._ended
        if error is not None:
            raise error

    def _send(self, message: dict[str, Any]) -> None:
        from websockets.exceptions import ConnectionClosed

        if self._socket is None:
            raise ServiceError("the stream is not open; use it in a 'with' block")
        try:
            self._socket.send(json.dumps(message))
        except ConnectionClosed as error:
            raise ServiceError(f"the stream has ended: {error}") from None

    def _listen(self, socket: ClientConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        reason = "the daemon sends what no daemon sends"
        try:
            while True:
                message = json.loads(socket.recv())
                with self._news:
                    self._take(message)
                    self._news.notify_all()
        except ConnectionClosed as error:
            reason = str(error)
        except Exception as error:  # whatever it is, whoever waits must be told
            reason = f"{reason} ({type(error).__name__})"
        with self._news:
            self._ended = ServiceError(f"the stream has ended: {reason}")
            self._news.notify_all()

    def _take(self, message: dict[str, Any]) -> None:
        if message["type"] == "state":
            self._state = record_of(Snapshot, message["state"])
        elif message["type"] == "answer" and message["accepted"]:
            self.accepted += 1
        elif "error" in message:
            error = message["error"]
            if error["code"] == "superseded":
                self.superseded += 1
            else:
                self._refused = error_of(_STATUS.get(error["code"], 409), error["message"])
