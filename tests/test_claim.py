"""Claims: one program at a time commands a supply, however the last one ended."""

from __future__ import annotations

import errno
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fake_supply import FakeSupply, HandClock
from stiffopt.errors import DeviceError
from stiffopt.rig.settings import Safety
from stiffopt.safety import claim as claim_module
from stiffopt.safety import gate as gate_module
from stiffopt.safety.claim import Claim, address_of
from stiffopt.safety.gate import SafetyGate
from stiffopt.safety.vent_line import SocketPeer

HOLDER = """
import sys, time
from stiffopt.safety.claim import Claim
claim = Claim(lambda: sys.argv[1:])
claim.take()
print("taken", flush=True)
time.sleep(60)
"""


@pytest.fixture
def name(tmp_path: Path) -> str:
    """An endpoint that nobody else claims."""
    return f"test {tmp_path}"


class Holder:
    """Another process that has claimed something."""

    def __init__(self, *endpoints: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", HOLDER, *endpoints], stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "taken\n"

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def hold() -> Iterator[Callable[..., Holder]]:
    made: list[Holder] = []

    def one(*endpoints: str) -> Holder:
        made.append(Holder(*endpoints))
        return made[-1]

    yield one
    for holder in made:
        holder.kill()


class Time:
    """What the module takes for time: sleeping moves it, and something may happen then."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        self.slept: list[float] = []
        self.then: Callable[[], None] = lambda: None
        monkeypatch.setattr(claim_module, "time", self)

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds
        self.then()


def claim(*endpoints: str, **options: Any) -> Claim:
    return Claim(lambda: endpoints, **{"wait": 0.0, **options})


def free(*endpoints: str) -> bool:
    one = claim(*endpoints)
    try:
        one.take()
    except DeviceError:
        return False
    one.release()
    return True


def test_a_claim_is_exclusive_within_a_process(name: str) -> None:
    one, other = claim(name), claim(name)
    assert not one.held
    one.take()
    one.take()  # once more does nothing
    assert one.held
    with pytest.raises(DeviceError, match=r"is commanded by another program; .*'stiffopt vent"):
        other.take()
    assert not other.held
    other.release()  # which gives back nothing that is not its own
    assert not free(name)
    one.release()
    assert not one.held
    one.release()
    other.take()
    assert other.held
    other.release()


def test_a_claim_is_exclusive_across_processes_and_ends_with_its_process(
    name: str, hold: Callable[..., Holder]
) -> None:
    holder = hold(name)
    mine = claim(name, holder=lambda endpoint: f"whoever has {endpoint}")
    with pytest.raises(DeviceError) as refused:
        mine.take()
    assert str(refused.value).startswith(
        f"the supply ({name}) is commanded by whoever has {name}; only one program may"
    )
    holder.kill()
    mine.take()
    assert mine.held
    mine.release()


def test_of_several_endpoints_all_are_claimed(name: str) -> None:
    one = claim(f"{name} a", f"{name} b", f"{name} c")
    one.take()
    for part in "abc":
        assert not free(f"{name} {part}")
    assert free(f"{name} d")
    one.release()
    assert free(f"{name} a", f"{name} b", f"{name} c")


def test_a_claim_in_part_is_given_back(name: str) -> None:
    held = claim(f"{name} b")
    held.take()
    with pytest.raises(DeviceError, match=f"{name} b"):
        claim(f"{name} a", f"{name} b", f"{name} c").take()
    assert free(f"{name} a")
    assert free(f"{name} c")
    assert held.held
    held.release()


def test_a_claim_in_part_is_given_back_also_at_ctrl_c(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = claim(f"{name} b")
    held.take()

    def interrupt() -> None:
        raise KeyboardInterrupt

    Time(monkeypatch).then = interrupt
    mine = claim(f"{name} a", f"{name} b", wait=1.0)
    with pytest.raises(KeyboardInterrupt):
        mine.take()
    assert not mine.held
    assert free(f"{name} a")
    held.release()


def test_what_has_no_endpoints_is_not_claimed() -> None:
    one, other = claim(), claim()
    one.take()
    other.take()
    assert not one.held
    one.release()


def test_endpoints_are_asked_for_when_it_is_taken(name: str) -> None:
    found = [name]
    one = Claim(lambda: found)
    found[0] = f"{name} later"
    one.take()
    assert free(name)
    assert not free(f"{name} later")
    one.release()


def test_it_waits_for_one_that_becomes_free(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that has just ended still vents for some tens of milliseconds."""
    held = claim(name)
    held.take()
    time_ = Time(monkeypatch)

    def let_go() -> None:
        if len(time_.slept) == 3:
            held.release()

    time_.then = let_go
    mine = Claim(lambda: [name])
    mine.take()
    assert mine.held
    assert time_.slept == [0.02] * 3
    mine.release()


def test_it_waits_for_a_second_and_no_longer(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    held = claim(name)
    held.take()
    time_ = Time(monkeypatch)
    with pytest.raises(DeviceError, match="commanded by"):
        Claim(lambda: [name]).take()
    assert 101.0 <= time_.now <= 101.0 + 0.02 + 1e-9
    held.release()


def test_several_endpoints_share_one_time_of_waiting(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = claim(f"{name} a"), claim(f"{name} b")
    first.take()
    second.take()
    time_ = Time(monkeypatch)

    def let_go() -> None:
        if time_.now > 100.5:
            first.release()

    time_.then = let_go
    with pytest.raises(DeviceError, match=f"{name} b"):
        Claim(lambda: [f"{name} a", f"{name} b"]).take()
    assert time_.now <= 101.0 + 0.02 + 1e-9
    second.release()


class NoSuchSocket(socket.socket):
    made: list[NoSuchSocket] = []  # noqa: RUF012

    def __init__(self, *kind: Any) -> None:
        super().__init__(*kind)
        self.made.append(self)

    def bind(self, address: Any) -> None:
        raise OSError(errno.EPERM, "not permitted")


def test_a_system_that_refuses_names_is_told_at_once(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    time_ = Time(monkeypatch)
    NoSuchSocket.made.clear()
    monkeypatch.setattr(socket, "socket", NoSuchSocket)
    with pytest.raises(DeviceError, match=r"the supply cannot be claimed: .* not permitted"):
        Claim(lambda: [name]).take()
    assert not time_.slept
    assert [made.fileno() for made in NoSuchSocket.made] == [-1]  # closed


def test_other_systems_claim_nothing_and_so_command_nothing(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(claim_module.sys, "platform", "darwin")
    with pytest.raises(DeviceError, match="on Linux alone"):
        claim(name).take()
    claim().take()  # what nobody could command twice may be commanded anywhere


def test_many_threads_take_it_one_after_the_other(name: str) -> None:
    inside, most = [0], [0]
    lock = threading.Lock()

    def work() -> None:
        for _ in range(5):
            mine = Claim(lambda: [name], wait=30.0)
            mine.take()
            with lock:
                inside[0] += 1
                most[0] = max(most[0], inside[0])
            time.sleep(0)
            with lock:
                inside[0] -= 1
            mine.release()

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert most == [1]
    assert free(name)


def test_an_endpoint_has_an_address_for_each_purpose() -> None:
    a, b = address_of("claim", "serial 4:64"), address_of("vent", "serial 4:64")
    assert a.startswith("\0stiffopt/claim/")
    assert b.startswith("\0stiffopt/vent/")
    assert a != address_of("claim", "serial 4:65")
    assert len(address_of("claim", 9000 * "x").encode()) < 108  # what the kernel takes


# the gate claims its supply ----------------------------------------------------------------------


def gate_over(name: str, monkeypatch: pytest.MonkeyPatch) -> tuple[SafetyGate, FakeSupply]:
    clock = HandClock()
    supply = FakeSupply(clock)
    monkeypatch.setattr(FakeSupply, "endpoints", (name,))
    gate = SafetyGate(supply, slew=1e5, safety=Safety(), force_per_pressure=None, clock=clock)
    return gate, supply


def test_a_gate_claims_its_supply_before_it_touches_it(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, supply = gate_over(name, monkeypatch)
    held = claim(name)
    held.take()
    Time(monkeypatch)
    with pytest.raises(DeviceError, match="is commanded by another program"):
        gate.open()
    assert not supply.opened
    assert not supply.is_open
    held.release()
    gate.open()
    assert supply.is_open
    assert not free(name)
    gate.close()
    assert not supply.is_open
    assert free(name)


def test_a_gate_says_which_guard_has_its_supply(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    gate, _ = gate_over(name, monkeypatch)
    held = claim(name)
    held.take()
    Time(monkeypatch)
    asked: list[str] = []

    def guards_of(endpoint: str) -> list[SocketPeer]:
        asked.append(endpoint)
        return [SocketPeer(77, 54321)]

    monkeypatch.setattr(gate_module, "guards_of", guards_of)
    with pytest.raises(DeviceError, match=r"is commanded by process 77 \(user 54321\); only one"):
        gate.open()
    assert asked == [name]
    held.release()


@pytest.mark.parametrize("error", [DeviceError("no answer"), KeyboardInterrupt()])
def test_a_supply_that_does_not_open_is_not_kept_from_others(
    name: str, error: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, supply = gate_over(name, monkeypatch)

    def fail() -> None:
        assert not free(name)
        raise error

    monkeypatch.setattr(supply, "_open", fail)
    with pytest.raises(type(error)):
        gate.open()
    assert free(name)


def test_a_claim_is_kept_until_the_supply_is_vented_and_closed(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, supply = gate_over(name, monkeypatch)
    gate.open()
    order: list[tuple[str, bool]] = []
    close, write = supply._close, supply._write

    def closes() -> None:
        order.append(("close", free(name)))
        close()

    def writes(pressures: Any) -> None:
        order.append(("write", free(name)))
        write(pressures)

    monkeypatch.setattr(supply, "_close", closes)
    monkeypatch.setattr(supply, "_write", writes)
    gate.close()
    assert order == [("write", False), ("close", False)]
    assert free(name)


def test_a_supply_that_cannot_be_vented_stays_claimed(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, supply = gate_over(name, monkeypatch)
    gate.open()
    gate.arm()
    supply.dead = "before"
    with pytest.raises(DeviceError):
        gate.close()
    assert not gate.armed
    assert not free(name)
    supply.dead = ""
    gate._claim.release()
