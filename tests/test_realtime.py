"""The real-time set-up: what is permitted is done, what is not is told, all is undone."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stiffopt.safety import realtime
from stiffopt.safety.realtime import RealTimeReport, real_time, tidy

LIMITS = (65536, 65536)


class FakeC:
    """A C library without effect on this process."""

    def __init__(self, error: int = 0) -> None:
        self.error = error
        self.slack = 50000
        self.locked: int | None = None

    def mlockall(self, flags: int) -> int:
        if self.error:
            ctypes.set_errno(self.error)
            return -1
        self.locked = flags
        return 0

    def munlockall(self) -> int:
        self.locked = None
        return 0

    def prctl(self, option: int, value: Any, *_: int) -> int:
        if option == 30:
            return self.slack
        assert option == 29
        self.slack = value.value
        return 0


@pytest.fixture
def system(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    """A system that permits everything, and remembers; nothing real is changed."""
    state = SimpleNamespace(
        c=FakeC(),
        policy=os.SCHED_OTHER,
        priority=0,
        limits=(-1, -1),
        capable=False,
        nice={},
    )

    def set_scheduler(pid: int, policy: int, param: Any) -> None:
        assert pid == 0
        state.policy, state.priority = policy, param.sched_priority

    def set_nice(which: int, thread: int, nice: int) -> None:
        assert which == os.PRIO_PROCESS
        state.nice[thread] = nice

    monkeypatch.setattr(os, "getpriority", lambda which, thread: state.nice.get(thread, 0))
    monkeypatch.setattr(os, "setpriority", set_nice)
    monkeypatch.setattr(os, "sched_getscheduler", lambda pid: state.policy)
    monkeypatch.setattr(os, "sched_getparam", lambda pid: os.sched_param(state.priority))
    monkeypatch.setattr(os, "sched_setscheduler", set_scheduler)
    monkeypatch.setattr(resource, "getrlimit", lambda what: state.limits)
    monkeypatch.setattr(
        resource, "setrlimit", lambda what, limits: setattr(state, "limits", limits)
    )
    monkeypatch.setattr(realtime, "_libc", lambda: state.c)
    monkeypatch.setattr(realtime, "_may_lock", lambda: state.capable)
    interval, enabled = sys.getswitchinterval(), gc.isenabled()
    yield state
    assert sys.getswitchinterval() == interval
    assert gc.isenabled() == enabled
    assert gc.get_freeze_count() == 0
    assert (state.policy, state.priority) == (os.SCHED_OTHER, 0)
    assert not any(state.nice.values())
    if state.c is not None:
        assert state.c.locked is None
        assert state.c.slack == 50000


def test_all_that_is_permitted_is_done(system: SimpleNamespace) -> None:
    with real_time(70) as report:
        assert (system.policy, system.priority) == (os.SCHED_FIFO, 70)
        assert system.c.locked == 7  # now, in future, once it is used
        assert system.c.slack == 1
        assert set(system.nice.values()) == {-10}
        assert not gc.isenabled()
        assert gc.get_freeze_count() > 0
        assert sys.getswitchinterval() == pytest.approx(5e-4)
    assert report == RealTimeReport(
        ("SCHED_FIFO 70", "other threads favoured", "memory locked", "garbage collector held"), ()
    )
    assert report.notice.startswith("real-time: SCHED_FIFO 70, other threads favoured, memory")


def test_a_thread_that_ends_meanwhile_is_left_out(
    system: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads = os.listdir("/proc/self/task")

    def nice_of(which: int, thread: int) -> int:
        if thread == 2**30:
            raise ProcessLookupError(3, "No such process")
        return system.nice.get(thread, 0)

    monkeypatch.setattr(os, "getpriority", nice_of)
    monkeypatch.setattr(os, "listdir", lambda path: [str(2**30), *threads])
    with real_time(70) as report:
        assert set(system.nice) == set(map(int, threads))
    assert "other threads favoured" in report.granted


def test_what_is_not_permitted_is_told(
    system: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "setpriority", refuse)
    system.limits = LIMITS
    with real_time() as report:
        assert not gc.isenabled()
        assert system.c.locked is None
    assert report.granted == ("garbage collector held",)
    assert report.notice.startswith(
        "not real-time: SCHED_FIFO is not permitted (EPERM); allow it by LimitRTPRIO=99 in the "
        "systemd unit, or"
    )
    assert "; its other threads get no priority over other programs (EPERM)" in report.notice
    assert "; memory cannot be locked (only 64 KiB may be); allow it by LimitMEM" in report.notice


def test_a_system_without_these_calls(
    system: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "sched_getscheduler")
    system.c = None
    with real_time() as report:
        pass
    assert len(report.denied) == 2
    assert "(the C library has no mlockall)" in report.notice


@pytest.mark.parametrize(("limits", "capable"), [((65536, -1), False), (LIMITS, True)])
def test_memory_is_locked_where_no_limit_can_be_run_into(
    system: SimpleNamespace, limits: tuple[int, int], capable: bool
) -> None:
    system.limits, system.capable = limits, capable
    with real_time() as report:
        assert system.c.locked == 7
    assert report.denied == ()
    assert system.limits == limits


def test_memory_that_cannot_be_locked(system: SimpleNamespace) -> None:
    system.c = FakeC(error=12)
    with real_time() as report:
        pass
    assert report.notice.startswith("not real-time: memory cannot be locked (ENOMEM); allow")


def test_the_last_of_several_threads_undoes_what_is_the_process_s(system: SimpleNamespace) -> None:
    with real_time() as outer:
        with real_time(60) as inner:
            assert system.priority == 60
        assert system.priority == 80
        assert not gc.isenabled()
        assert system.c.locked == 7
    assert "memory locked" in outer.granted
    assert "memory locked" in inner.granted


def test_all_is_undone_after_an_error(system: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match="bug"), real_time():
        raise ValueError("bug")


def test_a_collector_that_was_held_before_stays_so(system: SimpleNamespace) -> None:
    gc.disable()
    try:
        with real_time():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_garbage_is_collected_on_demand(system: SimpleNamespace) -> None:
    class Node:
        count = 0

        def __del__(self) -> None:
            Node.count += 1

    def garbage() -> None:
        node = Node()
        node.self = node  # type: ignore[attr-defined]

    with real_time():
        garbage()
        assert Node.count == 0
        tidy(thoroughly=False)
        assert Node.count == 1
        garbage()
        tidy(thoroughly=True)
        assert Node.count == 2


def test_on_this_system_all_is_as_before() -> None:
    before = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    limits = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    with real_time(10) as report:
        fifo = os.sched_getscheduler(0) == os.SCHED_FIFO
        locked = "VmLck:\t       0 kB" not in Path("/proc/self/status").read_text()
        assert ("SCHED_FIFO 10" in report.granted) == fifo
        assert ("memory locked" in report.granted) == locked
    assert (os.sched_getscheduler(0), os.sched_getparam(0).sched_priority) == before
    assert resource.getrlimit(resource.RLIMIT_MEMLOCK) == limits
    assert "VmLck:\t       0 kB" in Path("/proc/self/status").read_text()
    assert report.notice
