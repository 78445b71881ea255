"""What `stiffopt run` does: start the daemon, show it, end it in good order."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import FrameType
from typing import TYPE_CHECKING, Any

from stiffopt.cli.console import report_error
from stiffopt.cli.exits import BAD_INPUT, FAULT, SOLVED
from stiffopt.cli.quantities import quantity
from stiffopt.cli.run_lines import Display, Lines
from stiffopt.control.state import State
from stiffopt.errors import InputError, SlowWarning, StiffoptError
from stiffopt.rig.config import load_rig_description

if TYPE_CHECKING:
    from stiffopt.daemon.daemon import Daemon

__all__ = ["Options", "run"]

_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
_LOOK = 0.05  # s between looks at whether it has ended
_PATIENCE = 5.0  # s beyond the ramp; `Daemon.stop` sees to what hangs
_FAVOURED = -10  # niceness, where permitted: see `_favour`


@dataclass(frozen=True)
class Options:
    """The options of the command.

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


def run(rig: str, options: Options) -> int:
    """Run the daemon of a rig until it is ended; return the exit code."""
    try:
        seconds = _checked(options)
        description = load_rig_description(rig)
        with _Signals().heard() as signals:
            return _run(rig, description.name, options, seconds, signals)
    except StiffoptError as error:
        report_error(str(error))
        return BAD_INPUT


def _checked(options: Options) -> float:
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


def _run(rig: str, name: str, options: Options, seconds: float, signals: _Signals) -> int:
    _favour()
    from stiffopt.daemon.daemon import Daemon

    style = _style(options.style)
    daemon = Daemon(
        rig,
        service=options.service,
        log_folder=options.log_folder,
        json_lines=style == "json",
    )
    watch = _Watch(daemon, _display(style, daemon), signals)
    refused = ""
    with _warnings_shown(watch.display):
        try:
            with signals.interrupting():
                task = None if options.task is None else daemon.read_task(options.task)
                watch.display.say(
                    "starting", f"connecting to {name}; a first start compiles the model"
                )
                daemon.start()
                watch.display.begin(daemon)
                if options.arm:
                    daemon.arm(task)
            watch.go_on(time.monotonic() + seconds, unattended=not options.service)
        except KeyboardInterrupt:
            pass  # before it was ready
        except StiffoptError as error:
            refused = str(error)
        finally:
            watch.wind_up()
            state = daemon.stop()
            watch.show()
            watch.display.end()
    return _verdict(daemon, state, refused)


def _verdict(daemon: Daemon, state: State, refused: str) -> int:
    """Return the exit code, and say what must be known."""
    if refused:
        report_error(refused)
    if daemon.trouble:
        report_error(f"THE ARM MAY BE UNDER PRESSURE: {daemon.trouble}")
        return FAULT
    if daemon.failure is not None:
        kind = type(daemon.failure).__name__
        report_error(f"control ended, vented, by {kind}: {daemon.failure}; please report it")
        return FAULT
    if state is State.FAULT:
        report_error(f"ended in the state fault, vented: {daemon.loop.snapshot().reason}")
        return FAULT
    return BAD_INPUT if refused else SOLVED


class _Watch:
    """Shows what a daemon does until it shall end, and while it ends."""

    def __init__(self, daemon: Daemon, display: Display, signals: _Signals) -> None:
        self.display = display
        self._daemon, self._signals = daemon, signals
        self._next_event = 0

    def show(self) -> None:
        """Show what is new."""
        events, self._next_event = self._daemon.loop.events.since(self._next_event)
        self.display.update(self._daemon.loop.snapshot(), events)

    def go_on(self, end: float, *, unattended: bool) -> None:
        """Show until a signal comes, `end` is over, or control has ended.

        Where no client could ever reset it, a fault is the end too.
        """
        while not (self._signals.count or self._daemon.ended or time.monotonic() > end):
            self.show()
            if unattended and self._daemon.loop.snapshot().state is State.FAULT:
                return
            self._signals.wait(self.display.period)

    def wind_up(self) -> None:
        """Show how the pressures are let down; another signal lets them out at once."""
        self._daemon.begin_stop()
        vented = False
        end = time.monotonic() + self._daemon.description.safety.ramp_time + _PATIENCE
        while not self._daemon.ended and time.monotonic() < end:
            self.show()
            if self._signals.count > 1 and not vented:
                vented = True
                self._daemon.vent("Ctrl-C, twice")
            self._signals.wait(_LOOK)


class _Signals:
    """Signals that end the program, counted; none of them interrupts what is being done.

    Attributes
    ----------
    count : how many have come.
    """

    def __init__(self) -> None:
        self.count = 0
        self._interrupt = False
        self._news = threading.Event()

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
        self._news.wait(seconds)
        self._news.clear()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        self._news.set()
        if self._interrupt:
            self._interrupt = False
            raise KeyboardInterrupt


def _style(asked: str) -> str:
    """Return ``live``, ``plain`` or ``json``."""
    if asked != "auto":
        return asked
    return "live" if sys.stdout is not None and sys.stdout.isatty() else "json"


def _display(style: str, daemon: Daemon) -> Display:
    if style == "live":
        from stiffopt.cli.run_status import LiveStatus

        robot = daemon.robot.description
        names = [robot.channel_name(k) for k in range(robot.n_pressures)]
        return LiveStatus(daemon.description.name, names)
    return Lines(as_json=style == "json")


@contextmanager
def _warnings_shown(display: Display) -> Iterator[None]:
    """Show a `SlowWarning` where the rest is shown."""
    others = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, SlowWarning):
            display.say("slow", str(message))
        else:
            others(message, category, *rest, **more)

    with warnings.catch_warnings():
        warnings.simplefilter("always", SlowWarning)
        warnings.showwarning = show
        yield


def _favour() -> None:
    """Let this process be preferred to others, where that is permitted.

    The control thread is real-time, but must wait for whichever thread has the interpreter; that
    one should not in turn have to wait for other programs.
    """
    with suppress(OSError, AttributeError):
        if os.getpriority(os.PRIO_PROCESS, 0) > _FAVOURED:
            os.setpriority(os.PRIO_PROCESS, 0, _FAVOURED)
