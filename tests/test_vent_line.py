"""The vent line: who is entitled is heard, whoever else calls; and nobody waits without end."""

from __future__ import annotations

import json
import os
import pwd
import select
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from stiffopt.safety import vent_line as module
from stiffopt.safety.claim import address_of
from stiffopt.safety.vent_line import Caller, Reply, SocketPeer, VentLine, ask_to_vent, guards_of

pytestmark = pytest.mark.real_time

STRANGER = 54321
"""A user who is nobody."""
ME = SocketPeer(os.getpid(), os.getuid())


@pytest.fixture
def name(tmp_path: Path) -> str:
    """An endpoint that nobody else has."""
    return f"test {tmp_path}"


@pytest.fixture
def line(name: str) -> Iterator[VentLine]:
    made = VentLine([name])
    yield made
    made.close()


@pytest.fixture
def call(name: str) -> Iterator[Callable[..., socket.socket]]:
    """Somebody who calls, and says something or nothing."""
    made: list[socket.socket] = []

    def one(word: bytes = b"") -> socket.socket:
        found = addresses(name)
        if not found:
            raise ConnectionRefusedError
        caller = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        caller.connect("\0" + found[0][1:])
        made.append(caller)
        caller.settimeout(5.0)
        if word:
            caller.send(word)
        return caller

    yield one
    for caller in made:
        caller.close()


def hung_up(caller: socket.socket) -> bool:
    caller.settimeout(0.0)
    try:
        return caller.recv(100) == b""
    except BlockingIOError:
        return False
    except ConnectionResetError:
        return True


class Guard:
    """Serves a line in a thread until it is closed."""

    def __init__(self, line: VentLine, error: str = "") -> None:
        self.heard = 0
        self._line, self._error = line, error
        self._end, self._ender = os.pipe()
        self._thread = Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            ready, _, _ = select.select([*self._line.descriptors(), self._end], [], [], 0.01)
            if self._end in ready:
                return
            for caller in self._line.wanting_to_vent():
                self.heard += 1
                caller.answer(self._error)

    def __enter__(self) -> Guard:
        return self

    def __exit__(self, *_: object) -> None:
        os.write(self._ender, b".")
        self._thread.join(10)
        os.close(self._end)
        os.close(self._ender)


# it is asked, and answers ------------------------------------------------------------------------


@pytest.mark.parametrize("error", ["", "the supply does not answer"])
def test_who_asks_is_answered(name: str, line: VentLine, error: str) -> None:
    with Guard(line, error) as guard:
        for _ in range(2):
            assert ask_to_vent(name) == [Reply(ME, answered=True, error=error)]
    assert guard.heard == 2


def test_nobody_is_asked_where_nobody_listens(name: str) -> None:
    assert ask_to_vent(name) == []
    assert guards_of(name) == []


def test_it_is_told_who_listens(name: str, line: VentLine) -> None:
    assert guards_of(name) == [ME]
    assert line.wanting_to_vent() == []  # to look is not to ask


def test_its_descriptors_wake_whoever_waits(
    line: VentLine, call: Callable[..., socket.socket]
) -> None:
    (descriptor,) = line.descriptors()
    assert select.select([descriptor], [], [], 0.0)[0] == []
    call(b"vent")
    assert select.select([descriptor], [], [], 5.0)[0] == [descriptor]


def test_of_several_endpoints_each_has_a_line(name: str) -> None:
    line = VentLine([f"{name} a", f"{name} b"])
    assert len(line.descriptors()) == 2
    with Guard(line):
        for part in "ab":
            assert ask_to_vent(f"{name} {part}") == [Reply(ME, answered=True)]
    line.close()
    assert line.descriptors() == []
    assert ask_to_vent(f"{name} a") == []


def test_without_endpoints_there_is_no_line() -> None:
    line = VentLine([])
    assert line.descriptors() == []
    assert line.wanting_to_vent() == []
    line.close()


def test_a_line_that_is_closed_hangs_up(line: VentLine, call: Callable[..., socket.socket]) -> None:
    silent = call()
    assert line.wanting_to_vent() == []
    assert not hung_up(silent)
    line.close()
    assert hung_up(silent)
    with pytest.raises(ConnectionRefusedError):
        call()


# callers of all kinds ----------------------------------------------------------------------------


def test_a_silent_caller_blocks_nobody(line: VentLine, call: Callable[..., socket.socket]) -> None:
    silent = call()
    assert line.wanting_to_vent() == []
    entitled = call(b"vent")
    (caller,) = line.wanting_to_vent()
    assert caller.peer == SocketPeer(os.getpid(), os.getuid())
    caller.answer("")
    assert json.loads(entitled.recv(100)) == {"error": ""}
    assert entitled.recv(100) == b""
    assert line.wanting_to_vent() == []  # nobody is heard twice
    silent.send(b"vent")  # who says it later is heard later
    (caller,) = line.wanting_to_vent()
    caller.answer("late")
    assert json.loads(silent.recv(100)) == {"error": "late"}


@pytest.mark.parametrize("word", [b"hello", b"ven", b"\0", b"GET / HTTP/1.1\r\n"])
def test_who_says_something_else_is_hung_up_on(
    word: bytes, line: VentLine, call: Callable[..., socket.socket]
) -> None:
    caller = call(word)
    assert line.wanting_to_vent() == []
    assert hung_up(caller)
    assert line._callers == []


def test_who_hangs_up_first_is_forgotten(
    line: VentLine, call: Callable[..., socket.socket]
) -> None:
    call().close()
    assert line.wanting_to_vent() == []
    assert line._callers == []
    call(b"vent").close()  # has asked all the same
    (caller,) = line.wanting_to_vent()
    caller.answer("")


def test_of_too_many_silent_callers_the_oldest_go(
    line: VentLine, call: Callable[..., socket.socket]
) -> None:
    silent = [call() for _ in range(8)]
    assert line.wanting_to_vent() == []
    assert not any(hung_up(caller) for caller in silent)
    silent += [call() for _ in range(3)]
    assert line.wanting_to_vent() == []
    assert [hung_up(caller) for caller in silent] == [True] * 3 + [False] * 8
    silent[-1].send(b"vent")
    (caller,) = line.wanting_to_vent()
    caller.answer("")


def test_who_asks_is_heard_however_many_are_silent(
    line: VentLine, call: Callable[..., socket.socket]
) -> None:
    entitled = call(b"vent")
    silent = [call() for _ in range(40)]
    (caller,) = line.wanting_to_vent()
    caller.answer("")
    assert json.loads(entitled.recv(100)) == {"error": ""}
    assert sum(hung_up(caller) for caller in silent) == 32


def test_many_who_ask_at_once_are_all_heard(
    line: VentLine, call: Callable[..., socket.socket]
) -> None:
    callers = [call(b"vent") for _ in range(60)]
    heard = line.wanting_to_vent()
    assert len(heard) == 60
    for caller in heard:
        caller.answer("")
    assert all(json.loads(caller.recv(100)) == {"error": ""} for caller in callers)


def test_one_step_looks_at_a_bounded_number_of_callers(line: VentLine) -> None:
    accepted = []

    class Endless:
        def accept(self) -> tuple[Any, None]:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
            accepted.append(theirs)
            return ours, None

    line._accept(Endless())  # type: ignore[arg-type]
    assert len(accepted) == 64
    for end in accepted:
        end.close()


# other users -------------------------------------------------------------------------------------


def test_a_connection_that_breaks_has_asked_for_nothing() -> None:
    class Broken:
        def recv(self, _: int) -> bytes:
            raise ConnectionResetError

    assert Caller(Broken(), SocketPeer(1, 0)).asks() is False  # type: ignore[arg-type]


def test_what_went_well_needs_no_word(line: VentLine, call: Callable[..., socket.socket]) -> None:
    asking = call(b"vent")
    (caller,) = line.wanting_to_vent()
    caller.answer()
    assert json.loads(asking.recv(100)) == {"error": ""}


@pytest.mark.parametrize("uid", [0, os.getuid(), STRANGER])
def test_root_and_the_same_user_are_heard_and_nobody_else(
    uid: int,
    line: VentLine,
    call: Callable[..., socket.socket],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "_peer", lambda connection: SocketPeer(9, uid))
    caller = call(b"vent")
    heard = line.wanting_to_vent()
    if uid == STRANGER:
        assert heard == []
        assert hung_up(caller)
        assert line._callers == []
    else:
        (one,) = heard
        assert one.peer == SocketPeer(9, uid)
        one.answer("")


def test_who_is_neither_root_nor_the_user_of_the_guard_is_not_heard(
    line: VentLine, call: Callable[..., socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it is where the guard does not run as root."""
    monkeypatch.setattr(os, "getuid", lambda: STRANGER)
    monkeypatch.setattr(module, "_peer", lambda connection: SocketPeer(9, STRANGER + 1))
    caller = call(b"vent")
    assert line.wanting_to_vent() == []
    assert hung_up(caller)


def test_root_is_heard_by_a_guard_that_does_not_run_as_root(
    line: VentLine, call: Callable[..., socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "getuid", lambda: STRANGER)
    for uid in (0, 1):
        monkeypatch.setattr(module, "_peer", lambda connection, uid=uid: SocketPeer(9, uid))
        call(b"vent")
        heard = line.wanting_to_vent()
        assert len(heard) == (uid == 0)
        for caller in heard:
            caller.answer("")


def test_strangers_do_not_use_up_the_turn_of_who_is_entitled(
    line: VentLine, call: Callable[..., socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    peers = (
        [SocketPeer(1, STRANGER)] * 20
        + [SocketPeer(2, os.getuid())]
        + [SocketPeer(1, STRANGER)] * 20
    )
    monkeypatch.setattr(module, "_peer", lambda connection: peers.pop(0))
    for _ in range(41):
        call(b"vent")
    (caller,) = line.wanting_to_vent()
    assert caller.peer.pid == 2
    caller.answer("")


CALL = """
import os, socket, sys
os.setgid({uid}); os.setuid({uid})
line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
line.settimeout(10)
line.connect(sys.argv[1].replace("@", chr(0)))
line.send(b"vent")
print(line.recv(100))
"""


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become somebody else")
def test_the_kernel_tells_that_somebody_is_another_user(name: str, line: VentLine) -> None:
    (address,) = addresses(name)
    code = CALL.format(uid=STRANGER)
    with Guard(line) as guard:
        done = subprocess.run(
            [sys.executable, "-c", code, address], capture_output=True, text=True, timeout=30
        )
    assert guard.heard == 0
    lost = "ConnectionResetError" in done.stderr or "BrokenPipeError" in done.stderr
    assert done.stdout.strip() == "b''" or lost


def addresses(name: str) -> list[str]:
    """Return the addresses of an endpoint's guards, as the kernel shows them."""
    shown = address_of("vent", name).replace("\0", "@")
    rows = Path("/proc/net/unix").read_text(encoding="utf-8", errors="replace").splitlines()
    return sorted({row.split()[-1] for row in rows if shown in row})


# who listens there -------------------------------------------------------------------------------


def test_nobody_can_take_the_place_of_a_guard(name: str, line: VentLine) -> None:
    """Addresses end with something random, and all guards are asked, of simulated rigs too."""
    before = addresses(name)
    with VentLines(name, 20) as lines:
        assert len(addresses(name)) == 21
        with Guard(lines[3], "no"), Guard(line):
            replies = ask_to_vent(name, patience=0.2)
    assert sorted(reply.error for reply in replies if reply.answered) == ["", "no"]
    assert sum(not reply.answered for reply in replies) == 19
    assert addresses(name) == before


class VentLines:
    """Several guards of one endpoint."""

    def __init__(self, name: str, number: int) -> None:
        self.lines = [VentLine([name]) for _ in range(number)]

    def __enter__(self) -> list[VentLine]:
        return self.lines

    def __exit__(self, *_: object) -> None:
        for line in self.lines:
            line.close()


class Impostor:
    """Listens as a guard does, and answers one caller with something."""

    def __init__(self, name: str, answer: bytes) -> None:
        self._listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listening.bind(f"{address_of('vent', name)}/impostor")
        self._listening.listen()
        self._answer = answer
        self._thread = Thread(target=self._serve)

    def _serve(self) -> None:
        connection, _ = self._listening.accept()
        with connection, suppress(OSError):
            connection.recv(4)
            connection.send(self._answer)

    def __enter__(self) -> Impostor:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.join(10)
        self._listening.close()


@pytest.mark.parametrize("lost", [b"", b"no json", b"[1]", b'"x"', b"{}", b"7", b"\xff"])
def test_an_answer_that_makes_no_sense_is_none(lost: bytes, name: str) -> None:
    with Impostor(name, lost):
        (reply,) = ask_to_vent(name)
    assert not reply.answered
    assert reply.error


@pytest.mark.parametrize(("uid", "believed"), [(STRANGER, True), (0, True), (STRANGER + 1, False)])
def test_another_user_s_word_that_it_is_vented_is_not_believed(
    name: str, monkeypatch: pytest.MonkeyPatch, uid: int, believed: bool
) -> None:
    monkeypatch.setattr(os, "getuid", lambda: STRANGER)
    monkeypatch.setattr(module, "_peer", lambda connection: SocketPeer(9, uid))
    with Impostor(name, b'{"error": ""}'):
        replies = ask_to_vent(name)
    assert replies == ([Reply(SocketPeer(9, uid), answered=True)] if believed else [])


def test_a_hung_guard_is_found_though_its_backlog_is_full(name: str, line: VentLine) -> None:
    held = []
    for _ in range(200):  # nobody accepts
        held += [one for _, one in module._lines_of(name) if one is not None]
    assert ask_to_vent(name) == [Reply(ME, answered=False, error="the guard accepts no calls")]
    for one in held:
        one.close()


def test_who_became_root_may_be_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 0)
    monkeypatch.setenv("SUDO_UID", str(STRANGER))
    assert [module.trusted(uid) for uid in (0, STRANGER, STRANGER + 1)] == [True, True, False]
    monkeypatch.setattr(os, "getuid", lambda: STRANGER + 2)
    assert [module.trusted(uid) for uid in (0, STRANGER, STRANGER + 2)] == [True, False, True]


def test_root_asks_the_guards_of_all_users(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 0)
    monkeypatch.setattr(module, "_peer", lambda connection: SocketPeer(9, STRANGER))
    with Impostor(name, b'{"error": ""}'):
        assert ask_to_vent(name) == [Reply(SocketPeer(9, STRANGER), answered=True)]


def test_a_guard_that_does_not_answer_is_given_up(name: str, line: VentLine) -> None:
    (reply,) = ask_to_vent(name, patience=0.05)
    assert reply == Reply(ME, answered=False, error="the guard does not answer: timed out")


def test_a_guard_that_accepts_nobody_is_not_waited_for(
    name: str, line: VentLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: socket.socket, address: str) -> None:
        raise BlockingIOError("its backlog is full")

    monkeypatch.setattr(socket.socket, "connect", full)
    assert ask_to_vent(name) == [Reply(ME, answered=False, error="the guard accepts no calls")]
    assert guards_of(name) == [ME]


def test_a_process_has_a_name_for_people() -> None:
    mine = pwd.getpwuid(os.getuid()).pw_name
    assert SocketPeer(7, os.getuid()).name == f"process 7 (user {mine})"
    assert SocketPeer(7, STRANGER).name == f"process 7 (user {STRANGER})"


# what may go wrong -------------------------------------------------------------------------------


def test_a_line_that_cannot_be_made_leaves_nothing_open(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: socket.socket, address: str) -> None:
        raise OSError("no")

    monkeypatch.setattr(socket.socket, "bind", full)
    with pytest.raises(OSError, match="no"):
        VentLine([name])


@pytest.mark.parametrize("place", ["x-1", "", "999999999-1"])
def test_an_address_that_names_no_process_is_left_out(
    place: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: socket.socket, address: str) -> None:
        raise BlockingIOError

    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as decoy:
        decoy.bind(f"{address_of('vent', name)}/{place}")
        decoy.listen()
        monkeypatch.setattr(socket.socket, "connect", full)
        assert guards_of(name) == []


def test_who_has_gone_meanwhile_is_left_out(name: str, line: VentLine) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as decoy:
        decoy.bind(f"{address_of('vent', name)}/0-gone")  # it does not listen
        assert guards_of(name) == [ME]


def test_where_the_kernel_has_no_table_there_are_no_guards(
    name: str, line: VentLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(self: Path, **_: Any) -> str:
        raise FileNotFoundError

    monkeypatch.setattr(Path, "read_text", missing)
    assert ask_to_vent(name) == []


def test_strangers_that_accept_nobody_are_left_out(
    name: str, line: VentLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_lines_of", lambda _: iter([(SocketPeer(9, STRANGER), None)] * 40))
    monkeypatch.setattr(os, "getuid", lambda: STRANGER + 1)
    assert ask_to_vent(name) == []
    monkeypatch.setattr(os, "getuid", lambda: 0)
    monkeypatch.delenv("SUDO_UID", raising=False)
    assert len(ask_to_vent(name)) == 32  # root asks some of them
