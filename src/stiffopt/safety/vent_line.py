"""The vent line: a way to have a guard vent that needs no network, and that no stranger can block.

Each guard listens under an abstract socket address that begins with its supply's endpoint and ends
with something random, so that nobody can take it first; whoever wants to vent finds all such
addresses in the kernel's table. The kernel also tells each side who the other is: a guard hears
only root and its own user, and hangs up on all others at once; a caller believes only those of its
own user and root. Whoever is heard says ``vent`` and is answered, as JSON, once that is done.
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

from stiffopt.safety.claim import address_of

__all__ = ["Caller", "Peer", "Reply", "VentLine", "ask_to_vent", "guards_of"]

_WORD = b"vent"
_BACKLOG = 64
_AT_ONCE = 64  # callers that are looked at in one step
_WAITING = 8  # callers of this user that have not said their word yet
_CREDENTIALS = struct.Struct("3i")
_ANSWER = 4096  # bytes


@dataclass(frozen=True)
class Peer:
    """A process at the other end of a local socket."""

    pid: int
    uid: int

    @property
    def name(self) -> str:
        """For people."""
        try:
            user = pwd.getpwuid(self.uid).pw_name
        except KeyError:
            user = str(self.uid)
        return f"process {self.pid} (user {user})"


def _peer(connection: socket.socket) -> Peer:
    packed = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, uid, _ = _CREDENTIALS.unpack(packed)
    return Peer(pid, uid)


class Caller:
    """Somebody who is entitled to vent and has asked for it."""

    def __init__(self, connection: socket.socket, peer: Peer) -> None:
        self._connection = connection
        self.peer = peer

    def asks(self) -> bool | None:
        """Say whether the word has come; None: not yet."""
        try:
            return self._connection.recv(64).startswith(_WORD)
        except BlockingIOError:
            return None
        except OSError:
            return False

    def answer(self, error: str = "") -> None:
        """Tell what became of it, empty if the supply is vented, and hang up."""
        with suppress(OSError):
            self._connection.send(json.dumps({"error": error}).encode())
        self.hang_up()

    def hang_up(self) -> None:
        """End the connection."""
        self._connection.close()


class VentLine:
    """The guard's end. Nothing here waits for anybody.

    Parameters
    ----------
    endpoints :
        Of the supply that the guard owns.
    """

    def __init__(self, endpoints: Sequence[str]) -> None:
        self._listening = [_listening(endpoint) for endpoint in endpoints]
        self._callers: list[Caller] = []

    def descriptors(self) -> list[int]:
        """Return the descriptors that become readable when somebody calls."""
        return [s.fileno() for s in self._listening]

    def asked(self) -> list[Caller]:
        """Return those who have asked to vent since the last call; each is to be answered."""
        for listening in self._listening:
            self._accept(listening)
        said = [(caller, caller.asks()) for caller in self._callers]
        silent = [caller for caller, word in said if word is None]
        self._callers = silent[-_WAITING:]
        for caller in silent[:-_WAITING] + [caller for caller, word in said if word is False]:
            caller.hang_up()
        return [caller for caller, word in said if word]

    def close(self) -> None:
        """Listen no more."""
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
    """Return a listening socket at an address that nobody could foresee."""
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listening.bind(f"{address_of('vent', endpoint)}/{secrets.token_hex(8)}")
        listening.listen(_BACKLOG)
    except OSError:
        listening.close()
        raise
    listening.setblocking(False)
    return listening


# the caller's end --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reply:
    """What a guard said, or did not say.

    Attributes
    ----------
    guard : the process that listens.
    answered : whether it said anything.
    error : why its supply may not be vented; empty if it says that it is.
    """

    guard: Peer
    answered: bool
    error: str = ""


def guards_of(endpoint: str) -> list[Peer]:
    """Return the processes that listen for an endpoint, whoever their users are."""
    found = []
    for line in _lines_of(endpoint):
        found.append(_peer(line))
        line.close()
    return found


def ask_to_vent(endpoint: str, patience: float = 5.0) -> list[Reply]:
    """Have all guards of an endpoint vent that belong to this user; for root, to any user.

    Parameters
    ----------
    endpoint :
        Of the supply.
    patience :
        Seconds in which each must have answered.
    """
    asked = []
    for line in _lines_of(endpoint):
        peer = _peer(line)
        if os.getuid() != 0 and peer.uid not in (0, os.getuid()):
            line.close()  # a stranger may say what he likes
            continue
        with suppress(OSError):
            line.send(_WORD)
        asked.append((peer, line))
    end = time.monotonic() + patience
    return [_reply(peer, line, end) for peer, line in asked]


def _reply(peer: Peer, line: socket.socket, end: float) -> Reply:
    with line:
        try:
            line.settimeout(max(0.05, end - time.monotonic()))
            told = line.recv(_ANSWER)
        except OSError as error:
            return Reply(peer, answered=False, error=f"the guard does not answer: {error}")
    try:
        return Reply(peer, answered=True, error=str(json.loads(told)["error"]))
    except (ValueError, KeyError, TypeError):
        return Reply(peer, answered=False, error="the guard has hung up without an answer")


def _lines_of(endpoint: str) -> Iterator[socket.socket]:
    """Yield a connection to each process that listens for an endpoint; wait for none of them."""
    shown = address_of("vent", endpoint).replace("\0", "@") + "/"
    with suppress(OSError), open("/proc/net/unix", encoding="utf-8", errors="replace") as table:
        names = {row.split()[-1] for row in table if shown in row}
        for name in sorted(name for name in names if name.startswith(shown)):
            line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            line.setblocking(False)
            try:
                line.connect("\0" + name[1:])
            except OSError:  # gone meanwhile, or it accepts nobody
                line.close()
            else:
                yield line
