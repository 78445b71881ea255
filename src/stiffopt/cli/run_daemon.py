"""Runs the daemon in the foreground: starts it, shows its state, ends it on a signal."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from types import FrameType
from typing import TYPE_CHECKING, Any

from stiffopt.cli.console import report_error
from stiffopt.cli.exits import BAD_INPUT, FAULT, SOLVED
from stiffopt.cli.quantities import quantity
from stiffopt.cli.run_ending import Backstop, Screen, leave
from stiffopt.cli.run_lines import Lines, RunDisplay
from stiffopt.control.state import State
from stiffopt.errors import InputError, SlowWarning, StiffoptError
from stiffopt.rig.config import load_rig_description

if TYPE_CHECKING:
    from stiffopt.daemon.daemon import Daemon

__all__ = ["RunOptions", "run"]

_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
_LOOK = 0.05  # s between looks at whether it has ended
_LAST_WORDS = 1.0  # s for what is shown at the end
_FAVOURED = -10  # niceness, where permitted: see `_favour`


@dataclass(frozen=True)
class RunOptions:
    """The options of `stiffopt run`.

    Attributes
    ----------
    task : path of a task file.
    arm : whether to arm at once.
    duration : as text with a unit.
    service : whether ports are opened.
    log_folder : instead of the rig file's.
    style : ``auto``, ``plain`` or ``json``.
    """

    task: str | None = None
    arm: bool = False
    duration: str | None = None
    service: bool = True
    log_folder: str | None = None
    style: str = "auto"


def run(rig: str, options: RunOptions) -> int:
    """Run the daemon of a rig until it is ended; return the exit code."""
    try:
        seconds = _checked(options)
        load_rig_description(rig)  # its mistakes are told before anything is loaded
        with _Signals().heard() as signals:
            return _run(rig, options, seconds, signals)
    except StiffoptError as error:
        report_error(str(error))
        return BAD_INPUT


def _checked(options: RunOptions) -> float:
    """Return the duration in s; raise `InputError` if the options contradict each other."""
    if options.task is not None and not options.arm:
        raise InputError("--task needs --arm: a task is pursued once the arm is armed")
    if not options.service and not (options.arm and options.task):
        raise InputError("--no-service needs --arm and --task: nobody else could give them")
    if options.arm and os.environ.get("NOTIFY_SOCKET"):
        raise InputError(
            "a service must not arm by itself, for it would do so whenever it is restarted; let a "
            "client arm ('stiffopt.Client')"
        )
    if options.duration is None:
        return float("inf")
    seconds = quantity("--duration", options.duration, "s", "time")
    if not seconds > 0:
        raise InputError("--duration: expected a time above 0 s")
    return seconds


def _run(rig: str, options: RunOptions, seconds: float, signals: _Signals) -> int:
    _favour()
    from stiffopt.daemon.daemon import TIMES, Daemon

    style = _style(options.style)
    daemon = Daemon(
        rig,
        service=options.service,
        log_folder=options.log_folder,
        json_lines=style == "json",
    )
    screen = Screen()
    watch = _Watch(daemon, _display(style, daemon), signals, screen)
    longest = daemon.description.safety.ramp_time + TIMES.stop
    with Backstop(longest, watch.is_ending), _warnings_shown(watch):
        state, refused = _steered(daemon, watch, options, seconds)
        code = _verdict(daemon, state, refused, watch.report)
        if not screen.finish(_LAST_WORDS) or daemon.hung:
            leave(code)
    return code


def _steered(
    daemon: Daemon, watch: _Watch, options: RunOptions, seconds: float
) -> tuple[State, str]:
    """Run a daemon from its start to its end; return the last state, and why it was refused."""
    refused = ""
    try:
        with watch.signals.interrupting():
            task = None if options.task is None else daemon.read_task(options.task)
            name = daemon.description.name
            watch.say("starting", f"connecting to {name}; a first start compiles the model")
            daemon.start()
            watch.begin()
            if options.arm and not watch.is_ending():
                daemon.arm(task)
        watch.go_on(time.monotonic() + seconds, unattended=not options.service)
    except KeyboardInterrupt:
        pass  # before it was ready
    except StiffoptError as error:
        refused = str(error)
    finally:
        watch.wind_up()
        state = daemon.stop()
        watch.end()
    return state, refused


def _verdict(daemon: Daemon, state: State, refused: str, report: Callable[[str], None]) -> int:
    """Return the exit code; report what went wrong."""
    if refused:
        report(refused)
    if daemon.trouble:
        report(f"THE ARM MAY BE UNDER PRESSURE: {daemon.trouble}")
        return FAULT
    if daemon.failure is not None:
        kind = type(daemon.failure).__name__
        report(f"control ended, vented, by {kind}: {daemon.failure}; please report it")
        return FAULT
    if state is State.FAULT:
        report(f"ended in the state fault, vented: {daemon.loop.snapshot().reason}")
        return FAULT
    return BAD_INPUT if refused else SOLVED


class _Watch:
    """Shows the state of a daemon while it runs and while it ends."""

    def __init__(
        self, daemon: Daemon, display: RunDisplay, signals: _Signals, screen: Screen
    ) -> None:
        self.signals = signals
        self._display, self._daemon, self._screen = display, daemon, screen
        self._next_event = 0
        self._ending = False

    def is_ending(self) -> bool:
        """Whether the end has begun, or was asked for."""
        return self._ending or self.signals.count > 0

    def say(self, kind: str, text: str) -> None:
        """Show something that is no event of the loop."""
        self._screen.post(lambda: self._display.say(kind, text))

    def report(self, text: str) -> None:
        """Show an error on stderr."""
        self._screen.post(lambda: report_error(text))

    def begin(self) -> None:
        """Show what was started."""
        self._screen.post(lambda: self._display.begin(self._daemon))

    def show(self) -> None:
        """Show what is new, unless what was new before is not shown yet."""
        if not self._screen.is_behind:
            self._screen.post(self._update)

    def end(self) -> None:
        """Show what was last, and then no more."""
        self._screen.post(self._update)
        self._screen.post(self._display.end)

    def _update(self) -> None:
        events, self._next_event = self._daemon.loop.events.since(self._next_event)
        self._display.update(self._daemon.loop.snapshot(), events)

    def go_on(self, end: float, *, unattended: bool) -> None:
        """Show until a signal comes, `end` is over, or control has ended.

        Where no client could ever reset it, a fault is the end too.
        """
        while not (self.signals.count or self._daemon.ended or time.monotonic() > end):
            self.show()
            if unattended and self._daemon.loop.snapshot().state is State.FAULT:
                return
            self.signals.wait(self._display.period)

    def wind_up(self) -> None:
        """Show how the pressures are let down; another signal lets them out at once."""
        from stiffopt.daemon.daemon import TIMES

        self._ending = True
        self._daemon.begin_stop()
        vented = False
        end = time.monotonic() + self._daemon.description.safety.ramp_time + TIMES.control
        while not self._daemon.ended and time.monotonic() < end:
            self.show()
            if self.signals.count > 1 and not vented:
                vented = True
                self._daemon.vent("Ctrl-C, twice")
            self.signals.wait(_LOOK)


class _Signals:
    """Counts the signals that are to end the program, without interrupting it.

    Attributes
    ----------
    count : how many have come.
    """

    def __init__(self) -> None:
        self.count = 0
        self._interrupt = False
        self._news: SimpleQueue[None] = SimpleQueue()  # an Event's lock is not for handlers

    @contextmanager
    def heard(self) -> Iterator[_Signals]:
        """Context in which they are."""
        before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            meant = [n for n in _SIGNALS if signal.getsignal(n) is not signal.SIG_IGN]  # nohup
            before = {number: signal.signal(number, self._handle) for number in meant}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    @contextmanager
    def interrupting(self) -> Iterator[None]:
        """Context of what may take long while nothing is under pressure: there one interrupts."""
        if self.count:
            raise KeyboardInterrupt
        self._interrupt = True
        try:
            yield
        finally:
            self._interrupt = False

    def wait(self, seconds: float) -> None:
        """Let some time pass, until the next signal at most."""
        with suppress(Empty):
            self._news.get(timeout=seconds)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        self._news.put(None)
        if self._interrupt:
            self._interrupt = False
            raise KeyboardInterrupt


def _style(asked: str) -> str:
    """Return ``live``, ``plain`` or ``json``."""
    if asked != "auto":
        return asked
    return "live" if sys.stdout is not None and sys.stdout.isatty() else "json"


def _display(style: str, daemon: Daemon) -> RunDisplay:
    if style == "live":
        from stiffopt.cli.run_status import LiveStatus

        robot = daemon.robot.description
        names = [robot.channel_name(k) for k in range(robot.n_pressures)]
        return LiveStatus(daemon.description.name, names)
    return Lines(as_json=style == "json")


@contextmanager
def _warnings_shown(watch: _Watch) -> Iterator[None]:
    """Show a `SlowWarning` where the rest is shown."""
    others = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, SlowWarning):
            watch.say("slow", str(message))
        else:
            others(message, category, *rest, **more)

    with warnings.catch_warnings():
        warnings.simplefilter("always", SlowWarning)
        warnings.showwarning = show
        yield


def _favour() -> None:
    """Raise the priority of this process, where that is permitted.

    The control thread is real-time, but must wait for whichever thread has the interpreter; that
    one should not in turn have to wait for other programs.
    """
    with suppress(OSError, AttributeError):
        if os.getpriority(os.PRIO_PROCESS, 0) > _FAVOURED:
            os.setpriority(os.PRIO_PROCESS, 0, _FAVOURED)
