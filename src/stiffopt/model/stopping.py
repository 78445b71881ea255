"""Stop long computations: after a time, or when the caller cancels.

`giving_up` sets the limits of everything called in its context.  Python code checks them in
`checkpoint`, machine code by the flag of `stop_flag`, between two evaluations of the model.
"""

import ctypes
import math
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass
from numbers import Real
from time import monotonic
from typing import Protocol

from stiffopt.errors import CancelledError, InputError, OutOfTimeError, shown

_LOOK_AGAIN = 0.01  # s between two polls of `cancel`


class Settable(Protocol):
    """Interface that `threading.Event` and `multiprocessing.Event` share."""

    def is_set(self) -> bool:
        """Return whether it is set."""


Cancel = Callable[[], object] | Settable
"""An event that is set, or a function that returns true, when the answer is no longer wanted."""


class StopFlag(ctypes.Structure):
    """Structure `Stop` of optimise/native/program.h."""

    _fields_ = (("seconds", ctypes.c_double), ("cancel", ctypes.c_int64))


@dataclass(frozen=True)
class _Limits:
    timeout: float
    deadline: float
    questions: tuple[Callable[[], object], ...]

    @property
    def is_cancelled(self) -> bool:
        return any(question() for question in self.questions)

    def check(self) -> None:
        if self.is_cancelled:
            raise CancelledError("cancelled before there was an answer")
        if monotonic() > self.deadline:
            raise OutOfTimeError(f"no answer within the {self.timeout:g} s")


_NO_LIMITS, _NO_FLAG = nullcontext(), nullcontext(0)  # for most calls, which have no limits
_limits: ContextVar[_Limits | None] = ContextVar("limits", default=None)


def giving_up(
    timeout: float | None = None, cancel: Cancel | None = None
) -> AbstractContextManager[None]:
    """Stop computations in this context after a time (s) or as soon as `cancel` asks for it.

    An outer context of this kind remains in force.

    Raises `InputError` if the timeout is not a positive number, or `cancel` neither an event nor
    callable.
    """
    return _NO_LIMITS if timeout is None and cancel is None else _giving_up(timeout, cancel)


@contextmanager
def _giving_up(timeout: float | None, cancel: Cancel | None) -> Iterator[None]:
    outer = _limits.get()
    seconds = deadline = math.inf
    questions: tuple[Callable[[], object], ...] = ()
    if outer is not None:
        seconds, deadline, questions = outer.timeout, outer.deadline, outer.questions
    if timeout is not None:
        own = _checked_timeout(timeout)
        if monotonic() + own < deadline:
            seconds, deadline = own, monotonic() + own
    if cancel is not None:
        questions = (*questions, _question(cancel))
    token = _limits.set(_Limits(seconds, deadline, questions))
    try:
        yield
    finally:
        _limits.reset(token)


def checkpoint() -> None:
    """Raise `OutOfTimeError` or `CancelledError` if the limits are exceeded."""
    limits = _limits.get()
    if limits is not None:
        limits.check()


def stop_flag() -> AbstractContextManager[int]:
    """Provide the address of a `StopFlag` for a call of machine code; 0 without limits.

    If there is a `cancel`, another thread polls it during the context.
    """
    limits = _limits.get()
    return _NO_FLAG if limits is None else _stop_flag(limits)


@contextmanager
def _stop_flag(limits: _Limits) -> Iterator[int]:
    flag = StopFlag(limits.deadline - monotonic(), 0)
    if not limits.questions:
        yield ctypes.addressof(flag)
        return
    ended = threading.Event()
    failures: list[BaseException] = []

    def watch() -> None:
        while not flag.cancel:
            try:
                flag.cancel = int(limits.is_cancelled)
            except BaseException as error:  # of the caller's function: raise it in their thread
                failures.append(error)
                flag.cancel = 1
            if ended.wait(_LOOK_AGAIN):
                return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield ctypes.addressof(flag)
    finally:
        ended.set()
        watcher.join()
        if failures:
            raise failures[0]


def _checked_timeout(timeout: float) -> float:
    if isinstance(timeout, bool) or not isinstance(timeout, Real) or not timeout > 0:
        raise InputError(f"timeout must be a positive number of seconds; got {shown(timeout)}")
    return float(timeout)


def _question(cancel: Cancel) -> Callable[[], object]:
    is_set = getattr(cancel, "is_set", cancel)
    if not callable(is_set):
        raise InputError(
            f"cancel must be an event or a function without arguments; got {shown(cancel)}"
        )
    return is_set
