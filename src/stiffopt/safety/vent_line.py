"""The vent line: a local socket by which every entitled user can make a guard vent.

It needs no network, and no other user can block it. Each guard listens at an abstract socket
address that begins with its supply's endpoint and ends with its process id and a random part, so
that nobody can take the address first; a caller finds all such addresses in the kernel's table. The
kernel also identifies each side to the other: a guard accepts only root and its own user, and
closes all other connections at once; a caller trusts only guards of its own user and root. The
caller sends ``vent`` and gets an answer in JSON once the supply is vented.
"""

from __future__ import annotations

import json
import os
import pwd
import secrets
import socket
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from stiffopt.safety.claim import address_of

_WORD = b"vent"
_BACKLOG = 64
_AT_ONCE = 64  # callers accepted in one step
_WAITING = 8  # callers that have connected and sent nothing yet
_STRANGERS = 32  # guards of other users that root calls
_LEAST = 0.05  # s, minimum time for each guard's answer
_CREDENTIALS = struct.Struct("3i")
_ANSWER = 4096  # bytes


@dataclass(frozen=True)
class SocketPeer:
    """A process at the other end of a local socket."""

    pid: int
    uid: int

    @property
    def name(self) -> str:
        """Process and user, for messages."""
        try:
            user = pwd.getpwuid(self.uid).pw_name
        except KeyError:
            user = str(self.uid)
        return f"process {self.pid} (user {user})"


def _peer(connection: socket.socket) -> SocketPeer:
    packed = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, uid, _ = _CREDENTIALS.unpack(packed)
    return SocketPeer(pid, uid)


class Caller:
    """A connection from a user who is entitled to vent."""

    def __init__(self, connection: socket.socket, peer: SocketPeer) -> None:
        self._connection = connection
        self.peer = peer

    def asks(self) -> bool | None:
        """Return whether the word ``vent`` has arrived; None: nothing has arrived yet."""
        try:
            return self._connection.recv(64).startswith(_WORD)
        except BlockingIOError:
            return None
        except OSError:
            return False

    def answer(self, error: str = "") -> None:
        """Send the outcome (an error, or empty if the supply is vented) and hang up."""
        with suppress(OSError):
            self._connection.send(json.dumps({"error": error}).encode())
        self.hang_up()

    def hang_up(self) -> None:
        """Close the connection."""
        self._connection.close()


class VentLine:
    """The guard's end of the vent line; it never blocks.

    `endpoints`: names of the supply that the guard owns, see `PressureSupply.endpoints`.
    """

    def __init__(self, endpoints: Sequence[str]) -> None:
        self._listening = [_listening(endpoint) for endpoint in endpoints]
        self._callers: list[Caller] = []

    def descriptors(self) -> list[int]:
        """Return the file descriptors that become readable when somebody calls."""
        return [s.fileno() for s in self._listening]

    def wanting_to_vent(self) -> list[Caller]:
        """Return callers since the last call that want to vent; each needs an answer."""
        for listening in self._listening:
            self._accept(listening)
        said = [(caller, caller.asks()) for caller in self._callers]
        silent = [caller for caller, word in said if word is None]
        self._callers = silent[-_WAITING:]
        for caller in silent[:-_WAITING] + [caller for caller, word in said if word is False]:
            caller.hang_up()
        return [caller for caller, word in said if word]

    def close(self) -> None:
        """Stop listening and close all connections."""
        for listening in self._listening:
            listening.close()
        for caller in self._callers:
            caller.hang_up()
        self._listening, self._callers = [], []

    def _accept(self, listening: socket.socket) -> None:
        for _ in range(_AT_ONCE):
            try:
                connection, _ = listening.accept()
            except OSError:
                return
            connection.setblocking(False)
            peer = _peer(connection)
            if peer.uid not in (0, os.getuid()):
                connection.close()
                continue
            self._callers.append(Caller(connection, peer))


def _listening(endpoint: str) -> socket.socket:
    """Return a listening socket at an address that nobody could guess."""
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        place = f"{os.getpid()}-{secrets.token_hex(8)}"
        listening.bind(f"{address_of('vent', endpoint)}/{place}")
        listening.listen(_BACKLOG)
    except OSError:
        listening.close()
        raise
    listening.setblocking(False)
    return listening


# the caller's end --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reply:
    """Reply of a guard that was called to vent, or the lack of one."""

    guard: SocketPeer  # the guard's process
    answered: bool  # whether it answered
    error: str = ""  # why its supply may not be vented; empty if it reports that it is


def trusted(uid: int) -> bool:
    """Return whether to trust the report of a user's guard that a supply is vented.

    Root and this user are trusted, and for root also the user who became root by ``sudo``.
    """
    return uid in (0, os.getuid()) or (os.getuid() == 0 and os.environ.get("SUDO_UID") == str(uid))


def guards_of(endpoint: str) -> list[SocketPeer]:
    """Return the processes, of any user, that listen for an endpoint."""
    found = []
    for peer, line in _lines_of(endpoint):
        found.append(peer)
        if line is not None:
            line.close()
    return found


def ask_to_vent(endpoint: str, patience: float = 5.0) -> list[Reply]:
    """Call all guards of an endpoint that accept this user, and return their replies.

    `endpoint`: name of the supply. `patience`: time for all answers together, in s.
    """
    asked: list[tuple[SocketPeer, socket.socket | None]] = []
    strangers = 0
    for peer, line in _lines_of(endpoint):
        if not trusted(peer.uid):
            strangers += 1
            if os.getuid() != 0 or strangers > _STRANGERS:
                if line is not None:
                    line.close()
                continue
        if line is not None:
            with suppress(OSError):
                line.send(_WORD)
        asked.append((peer, line))
    end = time.monotonic() + patience
    asked.sort(
        key=lambda one: not trusted(one[0].uid)
    )  # other users' guards have the time that is left
    return [_reply(peer, line, end) for peer, line in asked]


def _reply(peer: SocketPeer, line: socket.socket | None, end: float) -> Reply:
    if line is None:
        return Reply(peer, answered=False, error="the guard accepts no calls")
    with line:
        try:
            line.settimeout(max(_LEAST, end - time.monotonic()))
            told = line.recv(_ANSWER)
        except OSError as error:
            return Reply(peer, answered=False, error=f"the guard does not answer: {error}")
    try:
        return Reply(peer, answered=True, error=str(json.loads(told)["error"]))
    except (ValueError, LookupError, TypeError):
        return Reply(peer, answered=False, error="the guard has hung up without an answer")


def _lines_of(endpoint: str) -> Iterator[tuple[SocketPeer, socket.socket | None]]:
    """Yield the guards of an endpoint, each with a connection if it accepts one at once.

    A guard that hangs may accept none; then its address names its process, which is checked.
    """
    shown = address_of("vent", endpoint).replace("\0", "@") + "/"
    try:
        table = Path("/proc/net/unix").read_text(encoding="utf-8", errors="replace")
    except OSError:  # not Linux: no guard either
        return
    rows = (row.split() for row in table.splitlines() if shown in row)
    for name in sorted({row[-1] for row in rows if row[-1].startswith(shown)}):
        line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        line.setblocking(False)
        try:
            line.connect("\0" + name[1:])
        except BlockingIOError:
            line.close()
            peer = _process_of(name.removeprefix(shown))
            if peer is not None:
                yield peer, None
        except OSError:  # it has ended in the meantime
            line.close()
        else:
            yield _peer(line), line


def _process_of(place: str) -> SocketPeer | None:
    """Return the process that an address names, with its user according to the kernel."""
    number = place.partition("-")[0]
    if not number.isdecimal():
        return None
    try:
        return SocketPeer(int(number), os.stat(f"/proc/{number}").st_uid)
    except OSError:
        return None
