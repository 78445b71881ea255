"""Real-time execution: priority, locked memory and exact timers, as far as the system permits."""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import resource
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

_SWITCH_INTERVAL = 5e-4  # s, after which another thread of this interpreter may run
_CURRENT, _FUTURE, _ON_FAULT = 1, 2, 4  # of mlockall
_SET_TIMER_SLACK, _GET_TIMER_SLACK = 29, 30  # of prctl
_CAN_LOCK = 1 << 14  # the capability CAP_IPC_LOCK
_HOWEVER = {
    "priority": "allow it by LimitRTPRIO=99 in the systemd unit, or 'rtprio 99' for this user in "
    "/etc/security/limits.conf",
    "memory": "allow it by LimitMEMLOCK=infinity in the systemd unit, or 'memlock unlimited' for "
    "this user in /etc/security/limits.conf",
    "threads": "allow it by LimitNICE=-10 in the systemd unit, or 'nice -10' for this user in "
    "/etc/security/limits.conf",
}
_NICE = -10  # of the other threads of a process that has a real-time thread


@dataclass(frozen=True)
class RealTimeReport:
    """The real-time privileges of a thread.

    `granted`: privileges that it has, in a few words each. `denied`: privileges that it lacks, why,
    and how to allow them: a sentence each.
    """

    granted: tuple[str, ...]
    denied: tuple[str, ...]

    @property
    def notice(self) -> str:
        """One line for people."""
        if not self.denied:
            return f"real-time: {', '.join(self.granted)}"
        return f"not real-time: {'; '.join(self.denied)}"


@contextmanager
def real_time(priority: int = 80) -> Iterator[RealTimeReport]:
    """Make the calling thread real-time in the body; restore everything at its end.

    The thread gets a `SCHED_FIFO` priority and exact timers. For the whole process, until the last
    such body ends, memory is locked, other threads run before other programs, threads switch more
    often, and only `tidy` collects garbage. What the system does not permit is left out and
    reported; no error is raised.

    `priority`: from 1 to 99; kernel threads that serve interrupts have 50.
    """
    granted: list[str] = []
    denied: list[str] = []
    with ExitStack() as undo:
        undo.enter_context(_shared)
        for name, step in (("", _exact_timers), ("priority", _first_in_first_out(priority))):
            _try(step, name, granted, denied, undo)
        granted += _shared.granted
        denied += _shared.denied
        yield RealTimeReport(tuple(granted), tuple(denied))


def tidy(*, thoroughly: bool) -> None:
    """Collect garbage, which is not automatic while a thread is real-time.

    It takes tens of microseconds; if `thoroughly`, some milliseconds, so only while the arm rests.
    """
    gc.collect(2 if thoroughly else 1)


def load_of_processors() -> float:
    """Return the mean number of runnable processes per processor in the last minute; 0: unknown."""
    try:
        return os.getloadavg()[0] / (os.cpu_count() or 1)
    except (AttributeError, OSError):
        return 0.0


Undo = Callable[[], object]
Step = Callable[[], tuple[str, Undo]]


class _NotPermittedError(Exception):
    """The system does not permit a step; the message says why."""


def _try(step: Step, name: str, granted: list[str], denied: list[str], undo: ExitStack) -> None:
    try:
        text, back = step()
    except _NotPermittedError as error:
        denied.append(f"{error}; {_HOWEVER[name]}" if name in _HOWEVER else str(error))
    else:
        undo.callback(back)
        if text:
            granted.append(text)


class _Process:
    """Settings of the whole process while at least one thread is real-time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._undo = ExitStack()
        self.granted: list[str] = []
        self.denied: list[str] = []

    def __enter__(self) -> None:
        with self._lock:
            self._users += 1
            if self._users == 1:
                self.granted, self.denied = [], []
                for name, step in (
                    ("threads", _favoured_threads),
                    ("memory", _locked_memory),
                    ("", _held_collector),
                    ("", _quick_switches),
                ):
                    _try(step, name, self.granted, self.denied, self._undo)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                self._undo.close()


_shared = _Process()


# the single steps --------------------------------------------------------------------------------


def _first_in_first_out(priority: int) -> Step:
    def step() -> tuple[str, Undo]:
        try:
            policy, before = os.sched_getscheduler(0), os.sched_getparam(0)
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except (AttributeError, OSError) as error:
            raise _NotPermittedError(f"SCHED_FIFO is not permitted ({_why(error)})") from None
        return f"SCHED_FIFO {priority}", lambda: os.sched_setscheduler(0, policy, before)

    return step


def _exact_timers() -> tuple[str, Undo]:
    """Make sleeps end on time instead of up to 50 us later; needs no permission."""
    libc = _libc()
    if libc is None:
        return "", lambda: None
    before = libc.prctl(_GET_TIMER_SLACK, 0, 0, 0, 0)
    libc.prctl(_SET_TIMER_SLACK, ctypes.c_ulong(1), 0, 0, 0)
    return "", lambda: libc.prctl(_SET_TIMER_SLACK, ctypes.c_ulong(before), 0, 0, 0)


def _favoured_threads() -> tuple[str, Undo]:
    """Make the other threads of this process run before other programs.

    A thread that waits for a processor while it has Python's lock delays the real-time thread.
    Threads started by them inherit this.
    """
    before: dict[int, int] = {}
    try:
        for thread in map(int, os.listdir("/proc/self/task")):
            with suppress(ProcessLookupError):  # it has ended
                nice = os.getpriority(os.PRIO_PROCESS, thread)
                os.setpriority(os.PRIO_PROCESS, thread, min(nice, _NICE))
                before[thread] = nice
    except (AttributeError, OSError) as error:
        text = f"its other threads get no priority over other programs ({_why(error)})"
        raise _NotPermittedError(text) from None

    def undo() -> None:
        for thread, nice in before.items():
            with suppress(OSError):  # it has ended
                os.setpriority(os.PRIO_PROCESS, thread, nice)

    return "other threads favoured", undo


def _locked_memory() -> tuple[str, Undo]:
    """Lock memory in use, unless a limit of locked memory could be exceeded later."""
    libc = _libc()
    if libc is None:
        raise _NotPermittedError("memory cannot be locked (the C library has no mlockall)")
    soft, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    unlimited = resource.RLIM_INFINITY
    if hard != unlimited and not _may_lock():
        raise _NotPermittedError(f"memory cannot be locked (only {soft // 1024} KiB may be)")

    def undo() -> None:
        libc.munlockall()
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (soft, hard))

    if hard == unlimited:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (unlimited, unlimited))
    if libc.mlockall(_CURRENT | _FUTURE | _ON_FAULT) != 0:
        number = ctypes.get_errno()
        undo()
        why = errno.errorcode.get(number, str(number))
        raise _NotPermittedError(f"memory cannot be locked ({why})")
    return "memory locked", undo


def _held_collector() -> tuple[str, Undo]:
    if not gc.isenabled():  # another part of the program has disabled it
        return "", lambda: None
    gc.collect()
    gc.freeze()
    gc.disable()

    def undo() -> None:
        gc.enable()
        gc.unfreeze()

    return "garbage collector held", undo


def _quick_switches() -> tuple[str, Undo]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(min(before, _SWITCH_INTERVAL))
    return "", lambda: sys.setswitchinterval(before)


def _may_lock() -> bool:
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return False
    lines = dict(line.split(":", 1) for line in status.splitlines() if ":" in line)
    return bool(int(lines.get("CapEff", "0"), 16) & _CAN_LOCK)


def _libc() -> ctypes.CDLL | None:
    try:
        libc = ctypes.CDLL(None, use_errno=True)
    except OSError:
        return None
    return libc if hasattr(libc, "mlockall") and hasattr(libc, "prctl") else None


def _why(error: Exception) -> str:
    number = getattr(error, "errno", None)
    return errno.errorcode.get(number, str(error)) if number else str(error)
