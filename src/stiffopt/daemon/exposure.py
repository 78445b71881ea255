"""Who can reach the control interface, and whether its token is good enough for that."""

from __future__ import annotations

import socket
from ipaddress import ip_address

from stiffopt.errors import InputError

__all__ = ["MIN_TOKEN", "bracketed", "check_exposure", "is_loopback"]

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
    """Return what to warn of before the control interface listens, as kinds and texts of events.

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


def _is_address(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:
        return False
    return True
