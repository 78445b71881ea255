"""Access control of the HTTP interface: the token, the allowed hosts, and who can reach the port.

Requests that a stranger or a foreign web page may not make are refused before they are parsed.
"""

from __future__ import annotations

import hmac
import socket
from collections.abc import Iterable
from ipaddress import ip_address
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stiffopt.daemon.reports import RefusalError
from stiffopt.errors import InputError

__all__ = ["MAX_BODY", "MIN_TOKEN", "Access", "Token", "bracketed", "check_exposure", "is_loopback"]

MAX_BODY = 1_000_000
"""Bytes of the longest request."""
_READING = ("GET", "HEAD")


class Token:
    """The secret that a client shows to be allowed to move the arm.

    Raises
    ------
    InputError
        It is empty, or has characters that a header cannot carry.
    """

    def __init__(self, text: str) -> None:
        if not text or not all("!" <= c <= "~" for c in text):
            raise InputError(
                "the token must not be empty and must consist of letters, digits and signs "
                "without spaces"
            )
        self._secret = text.encode()

    def check(self, given: str | None) -> None:
        """Raise `RefusalError` unless this is the token; the time it takes tells nothing of it."""
        if given is None:
            raise RefusalError(
                401, "no-token", "this needs the token: 'Authorization: Bearer TOKEN'"
            )
        if not hmac.compare_digest(given.encode("utf-8", "replace"), self._secret):
            raise RefusalError(403, "wrong-token", "that is not this daemon's token")

    def is_shown(self, headers: Headers) -> bool:
        """Return whether the token stands in the header Authorization."""
        try:
            self.check_headers(headers)
        except RefusalError:
            return False
        return True

    def check_headers(self, headers: Headers) -> None:
        """Raise `RefusalError` unless the token stands in the header Authorization."""
        given = headers.getlist("authorization")
        kind, _, secret = given[0].partition(" ") if len(given) == 1 else ("", "", "")
        self.check(secret.strip() if kind.lower() == "bearer" else None)


class Access:
    """ASGI middleware that refuses requests of strangers and of foreign web pages.

    - A web page that someone on this machine looks at can send requests here. So the request must
      be addressed to this machine by a name that no stranger's name server can hand out, and if
      it comes from a page, the page must be the daemon's own.
    - Whatever is not plain reading needs the token.
    - A long body is not even collected.

    Parameters
    ----------
    app :
        What is guarded.
    token :
        Of those who may move the arm.
    hosts :
        Names of this machine beside localhost and addresses in digits.
    """

    def __init__(self, app: ASGIApp, *, token: Token, hosts: Iterable[str] = ()) -> None:
        self._app = app
        self._token = token
        self._hosts = {"localhost", *(host.lower().rstrip(".") for host in hosts)} - {""}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        try:
            self._check_place(headers)
            if scope["type"] == "http":
                if scope["method"] not in _READING:
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

    def _check_place(self, headers: Headers) -> None:
        hosts = headers.getlist("host")
        name = _host_name(hosts[0]) if len(hosts) == 1 else ""
        if name not in self._hosts and not _is_address(name):
            raise RefusalError(
                403,
                "host",
                "the header Host names no address of this daemon; use its IP address, localhost, "
                "or the host of the rig file's service",
            )
        for origin in headers.getlist("origin"):
            scheme, _, place = origin.partition("://")
            if scheme not in ("http", "https") or place.lower() != hosts[0].lower():
                raise RefusalError(
                    403, "origin", "pages of other sites may not speak to this daemon"
                )


def _host_name(host: str) -> str:
    try:
        return (urlsplit(f"//{host}").hostname or "").rstrip(".")
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


async def _collected(receive: Receive, headers: Headers) -> Receive:
    """Read the body, if it is not too long, and return what hands it out again."""
    too_long = RefusalError(413, "too-long", f"the body is longer than {MAX_BODY} bytes")
    given = headers.get("content-length", "0")
    if given.isdecimal() and (len(given) > 12 or int(given) > MAX_BODY):
        raise too_long
    parts: list[bytes] = []
    size = 0
    more = True
    while more:
        message = await receive()
        if message["type"] != "http.request":  # the client is gone
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


MIN_TOKEN = 16
"""Characters of a token that is not easily guessed."""


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach what listens on a host.

    A name is on loopback if all its addresses are; one that has no address is not.
    """
    try:
        found = {host} if _is_address(host) else _addresses(host)
    except OSError:
        return False
    return bool(found) and all(ip_address(address).is_loopback for address in found)


def check_exposure(host: str, token: str, *, given: bool) -> list[tuple[str, str]]:
    """Return the warnings due before the control interface listens: kinds and texts of events.

    Parameters
    ----------
    host :
        Where it will listen.
    token :
        Of those who may move the arm.
    given :
        Whether a person chose the token; else it was drawn.

    Raises
    ------
    InputError
        The token is too short for a host that other machines can reach.
    """
    beyond, short = not is_loopback(host), given and len(token) < MIN_TOKEN
    if beyond and short:
        raise InputError(
            f"the token has {len(token)} characters, too few for the host {host}, which other "
            f"machines can reach; give one of at least {MIN_TOKEN}, leave the environment variable "
            "empty so that one is drawn, or listen on 127.0.0.1 (service.token, service.host in "
            "the rig file)"
        )
    if beyond:
        text = (
            f"the control interface listens on {host}, beyond this machine and unencrypted: "
            "whoever can listen in on the network can read the token and move the arm"
        )
        return [("exposed", text)]
    if short:
        text = f"the token is shorter than {MIN_TOKEN} characters; others here may guess it"
        return [("token", text)]
    return []


def bracketed(host: str) -> str:
    """Return a host as it is written in a URL."""
    return f"[{host}]" if ":" in host else host


def _addresses(host: str) -> set[str]:
    found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    return {str(address[0]) for *_, address in found}
