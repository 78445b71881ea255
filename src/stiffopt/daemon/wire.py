"""HTTP between a client and the daemon."""

from __future__ import annotations

from typing import Any
from urllib.parse import urlsplit

from stiffopt.errors import CommandError, InputError, MissingExtraError, ServiceError, StiffoptError

__all__ = ["LEASE_HEADER", "Wire", "error_of"]

LEASE_HEADER = "Stiffopt-Lease"
_LOST = "lease"  # the code of a refusal that says that control is not (any longer) had


class Wire:
    """Asks the daemon, and raises what it refuses.

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


def error_of(status: int, message: str) -> StiffoptError:
    """Return the error that a status of the daemon stands for."""
    if status in (401, 403, 404, 405, 409):
        return CommandError(message)
    if status in (413, 422):
        return InputError(message)
    return ServiceError(message)


def _told(answer: Any) -> tuple[str, str]:
    """Return the code and the message of a refusal, also of one that is not the daemon's."""
    try:
        error = answer.json()["error"]
        return str(error["code"]), str(error["message"])
    except (ValueError, KeyError, TypeError):
        return "", f"what answers is no stiffopt daemon; it says {answer.status_code}"
