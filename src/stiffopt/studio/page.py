"""The studio's server: viser, behind an authentication of every request.

viser answers any client that reaches its port: it checks neither the headers Host and Origin nor a
secret, so that any web page in a browser on this machine could open its WebSocket. Therefore every
request, for the page, its parts and the WebSocket, is checked first for

- Host and Origin, by the daemon's rules (`stiffopt.daemon.place`);
- the key, which is drawn at each start and is part of the address that the command prints. The
  first request exchanges it for a cookie, so that it does not stay in the address bar.

viser has no hook for such a check, so one is patched into its call of `websockets` while it starts.
Afterwards the studio sends requests without the key to its own port, and stops if one is answered.
"""

from __future__ import annotations

import hmac
import http
import io
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from http.client import HTTPConnection
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from stiffopt.daemon.address import bound_socket, local_url, own_host
from stiffopt.daemon.place import check_place
from stiffopt.daemon.reports import RefusalError
from stiffopt.errors import MissingExtraError, ServiceError

try:
    import viser
    import websockets.asyncio.server as asyncio_server
    from websockets.datastructures import Headers
    from websockets.http11 import Response
except ModuleNotFoundError as error:
    raise MissingExtraError(error.name or "viser", "studio") from error

_HARMLESS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "frame-ancestors 'none'",
}
_TRY = 5.0  # s, time limit of that test
_starting = threading.Lock()


class KeyCheck:
    """Accepts only requests from this studio's page with its key.

    `hosts`: accepted host names, besides addresses and localhost.
    """

    def __init__(self, hosts: tuple[str, ...] = ()) -> None:
        self.key = secrets.token_urlsafe(24)
        self._cookie = f"stiffopt-studio-{secrets.token_hex(4)}"
        self._hosts = hosts

    def __call__(self, path: str, headers: Headers) -> Response | None:
        """Return the answer to a request that is refused or redirected; None to accept it."""
        try:
            hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
            check_place(hosts, origins, self._hosts, "studio", "the name given with --host")
        except RefusalError as refusal:
            return _answer(refusal.message)
        given = parse_qs(urlsplit(path).query).get("key", [""])[-1]
        if given and self._is_key(given):
            kept = f"{self._cookie}={self.key}; HttpOnly; SameSite=Lax; Path=/"
            return _answer("", http.HTTPStatus.SEE_OTHER, {"Location": "/", "Set-Cookie": kept})
        if not self._is_key(self._shown(headers)):
            return _answer("open the address that 'stiffopt studio' prints: it has the key")
        return None

    def _shown(self, headers: Headers) -> str:
        jar: SimpleCookie = SimpleCookie()
        for text in headers.get_all("Cookie"):
            try:
                jar.load(text)
            except CookieError:
                continue
        return jar[self._cookie].value if self._cookie in jar else ""

    def _is_key(self, given: str) -> bool:
        return hmac.compare_digest(given.encode("utf-8", "replace"), self.key.encode())


def _answer(
    text: str,
    status: http.HTTPStatus = http.HTTPStatus.FORBIDDEN,
    more: dict[str, str] | None = None,
) -> Response:
    body = f"{text}\n".encode()
    given = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
    headers = Headers({**given, **_HARMLESS, **(more or {})})
    return Response(status.value, status.phrase, headers, body)


class _PrivateServer(viser.ViserServer):
    """A server without viser's function to share it publicly."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Do nothing: viser would tunnel the page to a public address."""
        return None


class StudioPage:
    """A viser server that only the studio's user can use.

    Raises `InputError`: the address cannot be listened on; `ServiceError`: the check does not work
    with the installed version of viser.

    Parameters
    ----------
    host, port : address to listen on; port 0 takes any free one.
    label : title of the panel.

    Attributes
    ----------
    server : viser.ViserServer
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0, label: str = "stiffopt") -> None:
        self.host, self._check = host, KeyCheck((host,))
        with bound_socket(host, port) as free:  # viser would take the next one
            port = int(free.getsockname()[1])
        with _starting, redirect_stdout(io.StringIO()), _checked(self._check):
            self.server = _PrivateServer(host=host, port=port, label=label, verbose=False)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.main_panel.set_width(400)
        self.port = self.server.get_port()
        if not self._refuses_strangers():
            self.close()
            raise ServiceError(
                "this version of viser does not let stiffopt check who opens the page; "
                "install the one that the extra 'studio' asks for"
            )

    @property
    def url(self) -> str:
        """The address with the key."""
        return f"{local_url(self.host, self.port)}/?key={self._check.key}"

    def close(self) -> None:
        """End all connections and stop listening."""
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def _refuses_strangers(self) -> bool:
        """Whether the page and its WebSocket are refused without the key."""
        upgrade = {
            "Connection": "Upgrade",
            "Upgrade": "websocket",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "c3RpZmZvcHQgc3R1ZGlvIQ==",
        }
        for headers in ({}, upgrade):
            connection = HTTPConnection(own_host(self.host), self.port, timeout=_TRY)
            try:
                connection.request("GET", "/", headers=headers)
                if connection.getresponse().status != http.HTTPStatus.FORBIDDEN:
                    return False
            except OSError:
                return False
            finally:
                connection.close()
        return True


@contextmanager
def _checked(check: KeyCheck) -> Iterator[None]:
    """Context in which servers that `websockets` starts check each request."""
    serve = asyncio_server.serve

    def serve_checked(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            refused = check(request.path, request.headers)
            if refused is None and process_request is not None:
                return process_request(connection, request)
            return refused

        return serve(*arguments, process_request=process, **options)

    replaced: Callable[..., Any] = serve_checked
    asyncio_server.serve = replaced  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        asyncio_server.serve = serve  # type: ignore[misc]
