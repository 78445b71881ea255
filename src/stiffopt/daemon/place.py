"""The rule for the headers Host and Origin that keeps foreign web pages out.

A web page in a browser on this machine can send requests to servers on it. So the header Host must
be an IP address or a known name, which no foreign name server can resolve to this machine (DNS
rebinding). The header Origin, if there is one, must be the server's own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from urllib.parse import urlsplit

from stiffopt.daemon.address import is_address
from stiffopt.daemon.reports import RefusalError


def check_place(
    hosts: Sequence[str],
    origins: Iterable[str],
    known: Iterable[str],
    server: str = "daemon",
    setting: str = "the host of the rig file's service",
) -> None:
    """Raise `RefusalError` unless a request comes from the server's own page, or from no page.

    Parameters
    ----------
    hosts, origins : all Host and Origin headers of the request.
    known : names of this machine besides localhost.
    server, setting : how a refusal calls the server, and the setting of its name.
    """
    names = {"localhost", *(host.lower().rstrip(".") for host in known)} - {""}
    name = _host_name(hosts[0]) if len(hosts) == 1 else ""
    if name not in names and not is_address(name):
        raise RefusalError(
            403,
            "host",
            f"the header Host names no address of this {server}; use its IP address, localhost, "
            f"or {setting}",
        )
    for origin in origins:
        scheme, _, place = origin.partition("://")
        if scheme not in ("http", "https") or place.lower() != hosts[0].lower():
            raise RefusalError(
                403, "origin", f"pages of other sites may not send requests to this {server}"
            )


def _host_name(host: str) -> str:
    try:
        return (urlsplit(f"//{host}").hostname or "").rstrip(".")
    except ValueError:
        return ""
