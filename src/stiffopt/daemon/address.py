"""Addresses of servers on this machine: who can reach them, their URLs, and listening on them."""

from __future__ import annotations

import socket
from ipaddress import ip_address

from stiffopt.errors import InputError, os_reason


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a server on a host.

    A name is on loopback if it has addresses and all of them are.
    """
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError:
        return False
    return bool(found) and all(ip_address(place[0]).is_loopback for *_, place in found)


def is_address(name: str) -> bool:
    """Return whether a host is an IP address, not a name."""
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def bracketed(host: str) -> str:
    """Return a host as a URL writes it."""
    return f"[{host}]" if ":" in host else host


def own_host(host: str) -> str:
    """Return the host by which this machine reaches a server that listens on a host."""
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)


def local_url(host: str, port: int) -> str:
    """Return the URL of a server for clients on this machine."""
    return f"http://{bracketed(own_host(host))}:{port}"


def bound_socket(host: str, port: int, backlog: int = 0) -> socket.socket:
    """Return a socket that listens; port 0 is any free one. `InputError`: it cannot be had."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, kind, protocol, _, address = found[0]
        listening = socket.socket(family, kind, protocol)
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind(address)
            listening.listen(backlog)
        except OSError:
            listening.close()
            raise
    except OSError as error:
        raise InputError(
            f"cannot listen on {host} port {port}: {os_reason(error)}; give another host or port"
        ) from None
    return listening
