"""The vent line: a way to have a guard vent that needs no network, and that no stranger can block.

Each guard listens under an abstract socket address made of its supply's endpoint. The kernel tells
who calls: only root and the guard's own user are heard, all others are hung up on at once. Whoever
is heard says ``vent`` and is answered, as JSON, once that is done.
"""

from __future__ import annotations

import json
import os
import pwd
import socket
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from stiffopt.safety.claim import address_of

__all__ = ["Caller", "VentLine", "ask_to_vent", "guard_behind"]

_WORD = b"vent"
_BACKLOG = 64
_AT_ONCE = 64  # callers that are looked at in one step
_WAITING = 8  # callers of this user that have not said their word yet
_SHARED = 16  # guards of simulated rigs of one name
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
    shared :
        Whether several guards may have these endpoints: simulated rigs of one name.
    """

    def __init__(self, endpoints: Sequence[str], *, shared: bool = False) -> None:
        places = range(_SHARED if shared else 1)
        found = (_listening(endpoint, places) for endpoint in endpoints)
        self._listening = [s for s in found if s is not None]
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


def _listening(endpoint: str, places: range) -> socket.socket | None:
    """Return a listening socket, or None if all places are taken: the rig works without one."""
    for place in places:
        listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            listening.bind(_address(endpoint, place))
            listening.listen(_BACKLOG)
        except OSError:
            listening.close()
            continue
        listening.setblocking(False)
        return listening
    return None


def _address(endpoint: str, place: int) -> str:
    return address_of("vent", f"{endpoint}#{place}")


def guard_behind(endpoint: str, place: int = 0) -> Peer | None:
    """Return the process that listens for an endpoint; None: nobody does, or nobody accepts."""
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line:
        line.settimeout(1.0)
        line.connect(_address(endpoint, place))
        return _peer(line)
    return None


def ask_to_vent(
    endpoint: str, *, shared: bool = False, patience: float = 5.0
) -> list[tuple[Peer, str]]:
    """Have all guards of an endpoint vent.

    Returns
    -------
    For each guard that was reached: which process it is, and what went wrong; empty where it says
    that its supply is vented.
    """
    answers = []
    for place in range(_SHARED if shared else 1):
        answer = _ask(endpoint, place, patience)
        if answer is not None:
            answers.append(answer)
    return answers


def _ask(endpoint: str, place: int, patience: float) -> tuple[Peer, str] | None:
    end = time.monotonic() + patience
    line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    with line:
        line.settimeout(patience)
        try:
            line.connect(_address(endpoint, place))
        except (ConnectionRefusedError, FileNotFoundError):
            return None
        except OSError as error:
            return Peer(0, 0), f"the guard cannot be reached: {error}"
        peer = _peer(line)
        try:
            line.settimeout(max(0.1, end - time.monotonic()))
            line.send(_WORD)
            told = line.recv(_ANSWER)
        except OSError as error:
            return peer, f"the guard does not answer: {error}"
    if not told:
        return peer, "the guard hangs up: it belongs to another user; ask that user, or root"
    if os.getuid() not in (0, peer.uid) and peer.uid != 0:  # no guard, for it would have hung up
        return peer, "a program of another user answers in the guard's place"
    try:
        return peer, str(json.loads(told)["error"])
    except (ValueError, LookupError, TypeError):
        return peer, "what answers makes no sense, and is no guard"
