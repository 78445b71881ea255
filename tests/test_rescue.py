"""The watch over a guard: where it is gone or hangs, the supply is vented in its place."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fake_supply import FakeSupply, HandClock
from running import wait_for
from stiffopt.errors import DeviceError
from stiffopt.safety import rescue
from stiffopt.safety.claim import Claim
from stiffopt.safety.rescue import GuardWatch, vent_directly
from stiffopt.safety.settings import CLIENT

pytestmark = pytest.mark.real_time

PATIENCE = 20.0  # s, that a test waits for another thread on a busy machine


class FakeGuard:
    """A guard that lives until it is told otherwise; with a process of its own, if wanted."""

    def __init__(self) -> None:
        self.alive = True
        self.hung = False
        self.pid: int | None = None
        self.pings = 0
        self.killed = 0
        self.process: subprocess.Popen[bytes] | None = None

    def ping(self) -> None:
        self.pings += 1

    def kill(self) -> None:
        self.killed += 1
        self.alive = False


class ProcessGuard(FakeGuard):
    def __init__(self) -> None:
        super().__init__()
        self.process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        self.pid = self.process.pid
        del self.alive

    def __getattr__(self, name: str) -> Any:
        if name == "alive" and self.process is not None:
            return self.process.poll() is None
        raise AttributeError(name)


@pytest.fixture
def supply(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeSupply:
    monkeypatch.setattr(FakeSupply, "endpoints", (f"test {tmp_path}",))
    return FakeSupply(HandClock())


@pytest.fixture
def watching() -> Iterator[Callable[..., GuardWatch]]:
    made: list[GuardWatch] = []

    def one(guard: FakeGuard, supply: FakeSupply | None) -> GuardWatch:
        watch = GuardWatch(guard, supply)
        made.append(watch)
        watch.start()
        return watch

    yield one
    for watch in made:
        watch.stop(PATIENCE)
        assert not watch._thread.is_alive()


def free(supply: FakeSupply) -> bool:
    claim = Claim(lambda: supply.endpoints, wait=0.0)
    try:
        claim.take()
    except DeviceError:
        return False
    claim.release()
    return True


# venting directly --------------------------------------------------------------------------------


def test_to_vent_directly_claims_opens_vents_and_gives_back(supply: FakeSupply) -> None:
    claimed: list[bool] = []
    write = supply._write

    def note(pressures: Any) -> None:
        claimed.append(not free(supply))
        write(pressures)

    supply._write = note  # type: ignore[method-assign]
    vent_directly(supply)
    assert supply.opened == 1
    assert not supply.is_open
    assert len(supply.written) == 2
    assert not any(written.any() for written in supply.written)
    assert claimed == [True, True]
    assert free(supply)


def test_what_somebody_else_has_claimed_is_vented_all_the_same(
    supply: FakeSupply, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rescue, "CLIENT", replace(CLIENT, claim=0.01))
    held = Claim(lambda: supply.endpoints)
    held.take()
    assert not vent_directly(supply)  # it says that somebody else may raise the pressure again
    assert len(supply.written) == 2
    assert not free(supply)
    held.release()
    assert vent_directly(supply)
    assert free(supply)


def test_a_supply_that_does_not_take_it_is_given_back(supply: FakeSupply) -> None:
    supply.dead = "before"
    with pytest.raises(DeviceError, match="does not answer"):
        vent_directly(supply)
    assert not supply.is_open
    assert free(supply)


# the watch ---------------------------------------------------------------------------------------


def asked(watching: Callable[..., GuardWatch], supply: FakeSupply) -> tuple[FakeGuard, GuardWatch]:
    """Return a guard that has been asked whether it lives, and its watch."""
    guard = FakeGuard()
    watch = watching(guard, supply)
    wait_for(lambda: guard.pings)
    return guard, watch


def test_a_guard_that_lives_is_asked_and_left_alone(
    supply: FakeSupply, watching: Callable[..., GuardWatch]
) -> None:
    guard = FakeGuard()
    watch = watching(guard, supply)
    wait_for(lambda: guard.pings >= 3)
    assert not watch.rescued.is_set()
    assert not guard.killed
    assert not supply.opened
    assert watch.error == ""
    assert not watch.wait(0.0)


def test_after_a_guard_that_was_killed_the_supply_is_vented(
    supply: FakeSupply, watching: Callable[..., GuardWatch], monkeypatch: pytest.MonkeyPatch
) -> None:
    # the kernel says so at once
    monkeypatch.setattr(rescue, "CLIENT", replace(CLIENT, ping=1000.0))
    guard = ProcessGuard()
    assert guard.pid is not None
    assert guard.process is not None
    watch = watching(guard, supply)
    os.kill(guard.pid, signal.SIGKILL)
    assert watch.wait(PATIENCE)
    assert watch.rescued.is_set()
    assert not guard.alive
    assert supply.opened == 1
    assert not supply.is_open
    assert not supply.written[-1].any()
    assert watch.error == ""
    assert guard.killed == 0


def test_it_is_noticed_also_where_the_kernel_does_not_tell(
    supply: FakeSupply, watching: Callable[..., GuardWatch], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "pidfd_open")
    monkeypatch.setattr(rescue, "CLIENT", replace(CLIENT, ping=0.01))
    guard, watch = asked(watching, supply)
    guard.alive = False
    assert watch.wait(PATIENCE)
    assert supply.opened == 1


def test_a_guard_that_hangs_is_ended_and_the_supply_vented(
    supply: FakeSupply, watching: Callable[..., GuardWatch]
) -> None:
    guard, watch = asked(watching, supply)
    assert not guard.killed
    guard.hung = True
    assert watch.wait(PATIENCE)
    assert guard.killed == 1
    assert supply.opened == 1


def test_a_guard_that_ends_as_it_should_is_not_replaced(
    supply: FakeSupply, watching: Callable[..., GuardWatch]
) -> None:
    guard, watch = asked(watching, supply)
    before = time.monotonic()
    watch.stop(PATIENCE)
    guard.alive = False
    assert not watch._thread.is_alive()  # stop waits for it
    assert time.monotonic() - before < PATIENCE / 2
    assert not supply.opened
    assert not watch.rescued.is_set()
    assert not watch.wait(PATIENCE)  # which does not wait in vain
    assert time.monotonic() - before < PATIENCE / 2


def test_a_simulated_arm_is_gone_with_its_guard(watching: Callable[..., GuardWatch]) -> None:
    guard = FakeGuard()
    guard.alive = False
    watch = watching(guard, None)
    assert watch.wait(PATIENCE)
    assert watch.error == ""


@pytest.mark.parametrize("error", [DeviceError("not yet"), RuntimeError("a bug"), OSError()])
def test_it_is_tried_until_the_supply_can_be_vented(
    error: Exception,
    supply: FakeSupply,
    watching: Callable[..., GuardWatch],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(rescue, "CLIENT", replace(CLIENT, rescue_retry=1e-3))
    failures = [error] * 5
    told: list[str] = []

    def open_() -> None:
        told.append(watch.error)
        if failures:
            raise failures.pop()

    supply._open = open_  # type: ignore[method-assign]
    guard = FakeGuard()
    watch = watching(guard, supply)
    guard.alive = False
    assert watch.wait(PATIENCE)
    assert told == [""] + [str(error) or "OSError"] * 5
    assert watch.error == ""
    assert not supply.written[-1].any()


def test_it_is_tried_until_nobody_wants_it_any_more(
    supply: FakeSupply, watching: Callable[..., GuardWatch], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rescue, "CLIENT", replace(CLIENT, rescue_retry=0.0))
    supply.dead = "before"
    guard = FakeGuard()
    guard.alive = False
    watch = watching(guard, supply)
    wait_for(lambda: supply.opened > 60)
    assert watch.error == "it does not answer"
    assert not watch.rescued.is_set()
    supply.dead = ""
    assert watch.wait(PATIENCE)


def test_a_thread_that_wants_to_vent_tries_by_itself(
    supply: FakeSupply, watching: Callable[..., GuardWatch], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rescue, "CLIENT", replace(CLIENT, rescue_retry=1e-3))
    watch = GuardWatch(FakeGuard(), supply)
    supply.dead = "before"
    assert not watch.vent(0.01)
    assert watch.error == "it does not answer"
    supply.dead = ""
    assert watch.vent()
    opened = supply.opened
    assert watch.vent()  # once is enough
    assert supply.opened == opened


def test_to_stop_ends_the_attempts(
    supply: FakeSupply, watching: Callable[..., GuardWatch], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rescue, "CLIENT", replace(CLIENT, rescue_retry=1000.0))
    supply.dead = "before"
    guard = FakeGuard()
    guard.alive = False
    watch = watching(guard, supply)
    wait_for(lambda: watch.error)
    watch.stop(PATIENCE)
    assert not watch._thread.is_alive()
    assert not watch.rescued.is_set()
    assert supply.opened == 1


def test_waiting_for_a_rescue_has_an_end(
    supply: FakeSupply, watching: Callable[..., GuardWatch]
) -> None:
    watch = watching(FakeGuard(), supply)
    before = time.monotonic()
    assert not watch.wait(0.02)
    assert 0.02 <= time.monotonic() - before < PATIENCE


@pytest.mark.parametrize("error", [None, DeviceError("no such library"), RuntimeError("a bug")])
def test_what_is_urgent_later_is_prepared_before(
    error: Exception | None, supply: FakeSupply, watching: Callable[..., GuardWatch]
) -> None:
    prepared: list[bool] = []

    def prepare() -> None:
        prepared.append(guard.alive)
        if error is not None:
            raise error

    supply.prepare = prepare  # type: ignore[method-assign]
    guard = FakeGuard()
    watch = watching(guard, supply)
    wait_for(lambda: guard.pings)
    assert prepared == [True]
    guard.alive = False
    assert watch.wait(PATIENCE)


def test_it_leaves_no_descriptor_open(
    supply: FakeSupply, watching: Callable[..., GuardWatch]
) -> None:
    before = set(os.listdir("/proc/self/fd"))
    watch = watching(FakeGuard(), supply)
    watch.stop(PATIENCE)
    assert set(os.listdir("/proc/self/fd")) == before


def test_it_may_be_stopped_from_within(
    supply: FakeSupply, watching: Callable[..., GuardWatch]
) -> None:
    """As by a guard's client that closes when it is told of the end."""
    guard = FakeGuard()
    guard.alive = False
    supply._open = lambda: watch.stop()  # type: ignore[method-assign]
    watch = watching(guard, supply)
    assert watch.wait(PATIENCE)
