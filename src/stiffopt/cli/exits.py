"""How a command ends: exit codes, errors and Ctrl-C."""

from __future__ import annotations

import _thread
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import Any

from stiffopt.cli.console import report_error
from stiffopt.errors import StiffoptError

SOLVED = 0
BAD_INPUT = 2
UNREACHABLE = 3
FAILED = 4
FAULT = 5
"""The rig failed; it was vented."""
INTERRUPTED = 130
"""Ctrl-C."""
CLOSED_PIPE = 141
"""Whoever read the output has had enough (as a shell reports it for other programs)."""

OF_STATUS = {"solved": SOLVED, "unreachable": UNREACHABLE, "failed": FAILED}

_MOST_SERIOUS_FIRST = (BAD_INPUT, FAILED, UNREACHABLE)
_REPEAT = 0.02  # s, between two repetitions of an interrupt
_ENDING_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)

Handler = Callable[[int, FrameType | None], None]


class RigFaultError(StiffoptError):
    """The rig failed while a command used it; it was vented, or the message says otherwise."""


def most_serious(codes: Iterable[int]) -> int:
    """Return the code that speaks for all: 2, then 4, then 3, then 0."""
    seen = set(codes)
    return next((code for code in _MOST_SERIOUS_FIRST if code in seen), SOLVED)


def exit_code(work: Callable[[], object]) -> int:
    """Do the work of a command, report the error that ends it, and return its exit code."""
    try:
        work()
    except KeyboardInterrupt:
        return INTERRUPTED
    except StiffoptError as error:
        report_error(str(error))
        return FAULT if isinstance(error, RigFaultError) else BAD_INPUT
    return SOLVED


@contextmanager
def handled(handlers: Mapping[int, Handler]) -> Iterator[None]:
    """Context in which signals are handled so; in a thread other than the main one, nothing is.

    A signal that was ignored stays ignored: the program runs under nohup.
    """
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        heard = (n for n in handlers if signal.getsignal(n) is not signal.SIG_IGN)
        before = {number: signal.signal(number, handlers[number]) for number in heard}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Interruptible:
    """Context in which Ctrl-C raises KeyboardInterrupt for certain.

    CasADi clears Python errors while it converts its arguments, a KeyboardInterrupt among them: the
    work would go on, or stumble over a value that is missing. So the interrupt is repeated until it
    has got through.
    """

    def __init__(self) -> None:
        self._pressed = False
        self._over = threading.Event()
        self._handling = handled({})

    def __enter__(self) -> Interruptible:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            self._handling = handled({signal.SIGINT: self._handle})
        self._handling.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._over.set()
        self._handling.__exit__(None, None, None)

    def check(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C was pressed and has not got through yet."""
        if self._pressed:
            raise KeyboardInterrupt

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._over.is_set():
            return
        if not self._pressed:
            self._pressed = True
            threading.Thread(target=self._repeat, daemon=True).start()
        raise KeyboardInterrupt

    def _repeat(self) -> None:
        while not self._over.wait(_REPEAT):
            _thread.interrupt_main()


class InterruptBetweenSteps:
    """Turns signals that end a program into one KeyboardInterrupt between two steps of its work.

    The first signal is raised by `check`, which the work calls at each step; a second does not wait
    for that. While a rig is closed none is raised: the arm is vented first.

    Parameters
    ----------
    signals :
        Their numbers; by default all that ask a program to end.
    """

    def __init__(self, signals: Iterable[int] = _ENDING_SIGNALS) -> None:
        self._signals = tuple(signals)
        self._pressed = False
        self._at_once = False
        self._held = False

    @contextmanager
    def handled(self) -> Iterator[None]:
        """Context in which signals are handled so."""
        with handled(dict.fromkeys(self._signals, self._handle)):
            yield

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal has come."""
        if self._pressed:
            raise KeyboardInterrupt

    def hold(self) -> None:
        """Raise nothing from now on."""
        self._held = True

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Context of what waits for a person: there a signal does not wait for a step."""
        self.check()
        self._at_once = True
        try:
            yield
        finally:
            self._at_once = False

    def _handle(self, number: int, frame: FrameType | None) -> None:
        impatient = self._pressed or self._at_once
        self._pressed = True
        if impatient and not self._held:
            raise KeyboardInterrupt
