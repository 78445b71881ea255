"""Endpoints: one name for each device, whichever of its addresses a rig file gives.

A supply is claimed by its endpoint. So all addresses of a device must give the same endpoint: a
link in ``/dev/serial/by-id`` and its port, a host name and its IP address.
"""

from __future__ import annotations

import os
import socket
import stat
from contextlib import suppress

from stiffopt.errors import DeviceError

_THIS_MACHINE = "this machine"


def tcp_endpoints(host: str, port: int) -> tuple[str, ...]:
    """Return the endpoints of a TCP port, one for each address of its host.

    All addresses of this machine are one host: a server on it usually listens on all of them.

    Raises `DeviceError`: the host has no address.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise DeviceError(f"the host '{host}' cannot be found: {error}") from None
    return tuple(sorted({f"tcp {_host(str(address[0]))}:{port}" for *_, address in found}))


def _host(address: str) -> str:
    """Return an address, or the same word for all addresses of this machine."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    plain = address.removeprefix("::ffff:") if "." in address else address
    if plain != address:
        family = socket.AF_INET
    with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.bind((plain, 0))  # only works with an address of this machine
        return _THIS_MACHINE
    return plain


def serial_endpoints(port: str) -> tuple[str, ...]:
    """Return the endpoint of a serial port: its device number if the system has one."""
    path = os.path.realpath(port)
    with suppress(OSError):
        found = os.stat(path)
        if stat.S_ISCHR(found.st_mode):
            return (f"serial {os.major(found.st_rdev)}:{os.minor(found.st_rdev)}",)
    return (f"serial {path}",)
