"""The end of a command: exit codes, errors, Ctrl-C and other signals."""

from __future__ import annotations

import _thread
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from functools import wraps
from types import FrameType
from typing import Any, ParamSpec

import typer

from stiffopt.cli.console import ProgressBar, report_error, warnings_as_notes
from stiffopt.errors import CancelledError, StiffoptError

SOLVED = 0
BAD_INPUT = 2
UNREACHABLE = 3
FAILED = 4
FAULT = 5
"""The rig failed; it was vented."""
MISFIT = 6
"""The rig does not fit its files; the report says what to change."""
INTERRUPTED = 130
"""Ctrl-C."""
CLOSED_PIPE = 141
"""The reader of the output closed it; the shell's code for the signal SIGPIPE."""

OF_STATUS = {"solved": SOLVED, "unreachable": UNREACHABLE, "failed": FAILED}
ENDING_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that ask a program to end."""

_MOST_SERIOUS_FIRST = (BAD_INPUT, FAILED, UNREACHABLE)
_REPEAT = 0.02  # s, period at which an interrupt is repeated

Handler = Callable[[int, FrameType | None], None]
Progress = Callable[[float, float, str], None]
"""Called with the work done, the total and a description."""
P = ParamSpec("P")


class RigFaultError(StiffoptError):
    """The rig failed while a command used it; it was vented unless the message says otherwise."""


def most_serious(codes: Iterable[int]) -> int:
    """Return the most serious exit code: 2, then 4, 3 and 0."""
    seen = set(codes)
    return next((code for code in _MOST_SERIOUS_FIRST if code in seen), SOLVED)


def with_exit_code(command: Callable[P, int | None]) -> Callable[P, None]:
    """Make a typer command exit with the code that it returns (None is 0).

    An error is reported and gives its own code.
    """

    @wraps(command)
    def run(*arguments: P.args, **options: P.kwargs) -> None:
        try:
            code = command(*arguments, **options) or SOLVED
        except KeyboardInterrupt:
            code = INTERRUPTED
        except StiffoptError as error:
            report_error(str(error))
            code = FAULT if isinstance(error, RigFaultError) else BAD_INPUT
        raise typer.Exit(code)

    return run


@contextmanager
def handled(handlers: Mapping[int, Handler]) -> Iterator[None]:
    """Context that handles signals, by their numbers; it has no effect outside the main thread.

    A signal that was ignored stays ignored, as under nohup.
    """
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        changed = [n for n in handlers if signal.getsignal(n) is not signal.SIG_IGN]
        before = {number: signal.signal(number, handlers[number]) for number in changed}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def interruptible() -> Iterator[Callable[[], None]]:
    """Context in which Ctrl-C reliably raises KeyboardInterrupt.

    CasADi clears Python errors, also a KeyboardInterrupt, while it converts arguments: the work
    would go on, or fail because a value is missing. So the interrupt is repeated until the context
    is left. The context yields a function that raises KeyboardInterrupt if Ctrl-C was pressed.
    """
    is_pressed, over = False, threading.Event()

    def check() -> None:
        if is_pressed:
            raise KeyboardInterrupt

    def repeat() -> None:
        while not over.wait(_REPEAT):
            _thread.interrupt_main()

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal is_pressed
        if over.is_set():
            return
        if not is_pressed:
            is_pressed = True
            threading.Thread(target=repeat, daemon=True).start()
        raise KeyboardInterrupt

    is_default = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with handled({signal.SIGINT: handle} if is_default else {}):
        try:
            yield check
        finally:
            over.set()


@contextmanager
def interruptible_work(*, quiet: bool) -> Iterator[Progress]:
    """Context of work that Ctrl-C ends, with warnings as notes; yields a progress function."""
    with (
        interruptible() as check,
        ProgressBar(quiet=quiet) as bar,
        warnings_as_notes(quiet=quiet),
    ):

        def progress(done: float, total: float, text: str) -> None:
            check()
            bar.report(done, total, text)

        yield progress


@contextmanager
def stoppable_work(*, quiet: bool) -> Iterator[Progress]:
    """Context of work that keeps its results at the first Ctrl-C; a second one ends it.

    It yields a progress function, which raises `CancelledError` once after the first Ctrl-C. Work
    without results lets the error pass, and ends as interrupted.
    """
    interrupt, is_reported = InterruptBetweenSteps(), False
    with interrupt.handled(), ProgressBar(quiet=quiet) as bar, warnings_as_notes(quiet=quiet):

        def progress(done: float, total: float, text: str) -> None:
            nonlocal is_reported
            if interrupt.pressed and not is_reported:
                is_reported = True
                bar.report(done, total, "interrupted: keeping the best so far")
                raise CancelledError("interrupted")
            bar.report(done, total, text)

        try:
            yield progress
        except CancelledError:
            raise KeyboardInterrupt from None


class InterruptBetweenSteps:
    """Turns signals into a KeyboardInterrupt between two steps of the work.

    After the first signal, `check`, which the work calls at each step, raises it; a second signal
    raises it at once. After `hold` nothing is raised, so that a rig can be vented and closed.
    """

    def __init__(self, signals: Iterable[int] = ENDING_SIGNALS) -> None:
        self._signals = tuple(signals)
        self._pressed = False
        self._at_once = False
        self._held = False

    def handled(self) -> AbstractContextManager[None]:
        """Context in which the signals are handled."""
        return handled(dict.fromkeys(self._signals, self._handle))

    @property
    def pressed(self) -> bool:
        """Whether a signal was received."""
        return self._pressed

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal was received."""
        if self._pressed:
            raise KeyboardInterrupt

    def hold(self) -> None:
        """Raise nothing from now on."""
        self._held = True

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Context in which a signal interrupts at once, while a person is asked for something."""
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
