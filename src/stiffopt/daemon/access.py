"""Access control of the HTTP interface, before a request is parsed: token, host, origin, length."""

from __future__ import annotations

import hmac
from collections.abc import Iterable

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stiffopt.daemon.place import check_place
from stiffopt.daemon.reports import RefusalError
from stiffopt.errors import InputError

MAX_BODY = 1_000_000
"""Bytes of the longest request body."""
_READ_METHODS = ("GET", "HEAD")


class Token:
    """The secret that a client must present to move the arm."""

    def __init__(self, text: str) -> None:
        if not text or not all("!" <= c <= "~" for c in text):
            raise InputError(
                "the token must not be empty and must consist of letters, digits and signs "
                "without spaces"
            )
        self._secret = text.encode()

    def check(self, given: str | None) -> None:
        """Raise `RefusalError` unless this is the token; compared in constant time."""
        if given is None:
            raise RefusalError(
                401, "no-token", "this needs the token: 'Authorization: Bearer TOKEN'"
            )
        if not hmac.compare_digest(given.encode("utf-8", "replace"), self._secret):
            raise RefusalError(403, "wrong-token", "that is not this daemon's token")

    def is_shown(self, headers: Headers) -> bool:
        """Return whether the token is in the header Authorization."""
        try:
            self.check_headers(headers)
        except RefusalError:
            return False
        return True

    def check_headers(self, headers: Headers) -> None:
        """Raise `RefusalError` unless the token is in the header Authorization."""
        given = headers.getlist("authorization")
        kind, _, secret = given[0].partition(" ") if len(given) == 1 else ("", "", "")
        self.check(secret.strip() if kind.lower() == "bearer" else None)


class Access:
    """ASGI middleware that refuses requests without the token and those of foreign web pages.

    - The headers Host and Origin must be those of a page of the daemon, see `check_place`.
    - All methods except GET and HEAD need the token.
    - A body that is too long is refused before it is read completely.

    `hosts` are names of this machine besides localhost.
    """

    def __init__(self, app: ASGIApp, *, token: Token, hosts: Iterable[str] = ()) -> None:
        self._app = app
        self._token = token
        self._hosts = tuple(hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        try:
            check_place(headers.getlist("host"), headers.getlist("origin"), self._hosts)
            if scope["type"] == "http":
                if scope["method"] not in _READ_METHODS:
                    self._token.check_headers(headers)
                receive = await _collected(receive, headers)
            elif "authorization" in headers:
                self._token.check_headers(headers)
        except RefusalError as refusal:
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008})  # before accepting: a 403
                return
            challenge = {"WWW-Authenticate": "Bearer"} if refusal.status == 401 else None
            await JSONResponse(refusal.body, refusal.status, challenge)(scope, receive, send)
            return
        await self._app(scope, receive, send)


async def _collected(receive: Receive, headers: Headers) -> Receive:
    """Read the body, unless it is too long; return a `Receive` that delivers it again."""
    too_long = RefusalError(413, "too-long", f"the body is longer than {MAX_BODY} bytes")
    given = headers.get("content-length", "0")
    if given.isdecimal() and (len(given) > 12 or int(given) > MAX_BODY):
        raise too_long
    parts: list[bytes] = []
    size = 0
    more = True
    while more:
        message = await receive()
        if message["type"] != "http.request":  # the client has disconnected
            return _again(message, receive)
        parts.append(message.get("body", b""))
        size += len(parts[-1])
        if size > MAX_BODY:
            raise too_long
        more = message.get("more_body", False)
    return _again({"type": "http.request", "body": b"".join(parts), "more_body": False}, receive)


def _again(first: Message, receive: Receive) -> Receive:
    messages = [first]

    async def replayed() -> Message:
        return messages.pop() if messages else await receive()

    return replayed
