"""Run the daemon in the foreground: start it, show its state, end it on a signal.

It ends in bounded time, even if the terminal or a thread hangs.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from types import FrameType
from typing import TYPE_CHECKING, Self

from stiffopt.cli.console import report_error, report_note, showing_slow_warnings
from stiffopt.cli.exits import BAD_INPUT, ENDING_SIGNALS, FAULT, SOLVED, handled
from stiffopt.cli.outputs import check_picture
from stiffopt.cli.quantities import quantity
from stiffopt.cli.run_display import Lines, LiveStatus, write_at_once
from stiffopt.control.state import State
from stiffopt.daemon.calls import call_in_thread, ends_within
from stiffopt.errors import FileError, InputError, StiffoptError
from stiffopt.rig.config import load_rig

if TYPE_CHECKING:
    from stiffopt.daemon.daemon import Daemon
    from stiffopt.model.description import RobotDescription
    from stiffopt.model.scene import Scene
    from stiffopt.optimise.task import Task
    from stiffopt.paths.motion_file import MotionTable

_CHECK = 0.2  # s, period of checks whether the end has begun
_LOOK = 0.05  # s, period of checks whether it is over
_LAST_OUTPUT = 1.0  # s, time limit of the last output
_FLUSH = 0.3  # s, time limit of flushing
_LATE = "error: the daemon did not end in time and is left as it is; its guard vents"
_log = logging.getLogger(__name__)


def run(
    rig: str,
    *,
    task: str | None,
    play: str | None,
    arm: bool,
    duration: str | None,
    service: bool,
    log_folder: str | None,
    plot: str | None,
    style: str,
) -> int:
    """Run the daemon of a rig until it is ended; return the exit code.

    `rig`, `task` and `play` are paths of files, `duration` is text with a unit. `service` says
    whether to open ports, `plot` is the path of a figure of the run, and `style` is ``live``,
    ``plain`` or ``json``.
    """
    if task is not None and not arm:
        raise InputError("--task needs --arm: a task is pursued once the arm is armed")
    if play is not None and (task is not None or not arm):
        raise InputError("--play needs --arm, and no --task: a motion is played once it is armed")
    if not service and not (arm and (task or play)):
        raise InputError(
            "--no-service needs --arm and --task or --play: nobody else could give them"
        )
    if arm and os.environ.get("NOTIFY_SOCKET"):
        raise InputError(
            "a service must not arm by itself, for it would do so whenever it is restarted; let a "
            "client arm ('stiffopt.Client')"
        )
    if plot is not None:
        check_picture(plot)
    seconds = float("inf") if duration is None else quantity("--duration", duration, "s", "time")
    if not seconds > 0:
        raise InputError("--duration: expected a time above 0 s")
    from stiffopt.paths.motion_file import read_motion

    description, robot = load_rig(rig)  # reports its mistakes before anything else is loaded
    with _Signals().handled() as signals:
        wanted = None if task is None else _read_task(task, robot, description.scene)
        motion = None if play is None else read_motion(play, robot)
        from stiffopt.daemon.daemon import TIMES, Daemon

        daemon = Daemon(rig, service=service, log_folder=log_folder, json_lines=style == "json")
        screen = Screen()
        watch = _Watch(daemon, _display(style, daemon), signals, screen)
        longest = daemon.description.safety.ramp_time + TIMES.stop
        with Backstop(longest, watch.is_ending), showing_slow_warnings(watch.say_slow):
            state, refused = _steered(
                daemon, watch, wanted, motion, arm=arm, seconds=seconds, unattended=not service
            )
            code = _verdict(daemon, watch, state, refused)
            if not screen.finish(_LAST_OUTPUT) or daemon.hung:
                leave(code)
    if plot is not None:
        _draw(daemon.recording, plot)
    return code


def _read_task(path: str, robot: RobotDescription, scene: Scene | None) -> Task:
    """Read a task file; raise `FileError` if it is wrong, or for another robot or scene."""
    from stiffopt.control.checks import check_scene
    from stiffopt.optimise.task import load_task

    task = load_task(path)
    asked = task.resolve_robot().name
    if asked != robot.name:
        reason = f"is for the robot '{asked}'; this rig has '{robot.name}'"
        raise FileError(path, reason, key="robot")
    check_scene(task, scene)
    return task


def _steered(
    daemon: Daemon,
    watch: _Watch,
    task: Task | None,
    motion: MotionTable | None,
    *,
    arm: bool,
    seconds: float,
    unattended: bool,
) -> tuple[State, str]:
    """Run a daemon from its start to its end; return the last state, and why it did not start."""
    refused = ""
    try:
        with watch.signals.interrupting():
            name = daemon.description.name
            watch.say("starting", f"connecting to {name}; a first start compiles the model")
            daemon.start()
            watch.begin()
            if arm and not watch.is_ending():
                daemon.arm(task, motion)
        watch.go_on(time.monotonic() + seconds, unattended=unattended)
    except KeyboardInterrupt:
        pass  # before it was ready
    except StiffoptError as error:
        refused = str(error)
    finally:
        watch.wind_up()
        state = daemon.stop()
        watch.end()
    return state, refused


def _verdict(daemon: Daemon, watch: _Watch, state: State, refused: str) -> int:
    """Return the exit code; report what went wrong."""
    if refused:
        watch.report(refused)
    if daemon.trouble:
        watch.report(f"THE ARM MAY BE UNDER PRESSURE: {daemon.trouble}")
        return FAULT
    if daemon.failure is not None:
        kind = type(daemon.failure).__name__
        watch.report(f"control ended, vented, by {kind}: {daemon.failure}; please report it")
        return FAULT
    if state is State.FAULT:
        watch.report(f"ended in the state fault, vented: {daemon.loop.snapshot().reason}")
        return FAULT
    return BAD_INPUT if refused else SOLVED


def _draw(recording: str | None, path: str) -> None:
    """Draw a run that has ended, or report why that fails."""
    try:
        from stiffopt.daemon.run_log import read_run
        from stiffopt.plots import save_figure
        from stiffopt.plots.run import plot_run

        if recording is None:
            raise InputError("nothing was recorded")
        save_figure(plot_run(read_run(recording)), path)
        report_note(f"the run is drawn in {path}")
    except StiffoptError as error:
        report_error(f"--plot: {error}")


class _Watch:
    """Shows the state of a daemon while it runs and while it ends."""

    def __init__(
        self, daemon: Daemon, display: LiveStatus | Lines, signals: _Signals, screen: Screen
    ) -> None:
        self.signals = signals
        self._display, self._daemon, self._screen = display, daemon, screen
        self._next_event = 0
        self._ending = False

    def is_ending(self) -> bool:
        """Whether the end has begun or was requested."""
        return self._ending or self.signals.count > 0

    def say(self, kind: str, text: str) -> None:
        """Show a message that is not an event of the loop."""
        self._screen.post(lambda: self._display.say(kind, text))

    def say_slow(self, text: str) -> None:
        """Show a `SlowWarning`."""
        self.say("slow", text)

    def report(self, text: str) -> None:
        """Show an error on stderr."""
        self._screen.post(lambda: report_error(text))

    def begin(self) -> None:
        """Show the daemon that was started."""
        self._screen.post(lambda: self._display.begin(self._daemon))

    def show(self) -> None:
        """Show an update, unless the last one is still waiting."""
        if not self._screen.is_behind:
            self._screen.post(self._update)

    def end(self) -> None:
        """Show the last state, then end the display."""
        self._screen.post(self._update)
        self._screen.post(self._display.end)

    def _update(self) -> None:
        events, self._next_event = self._daemon.loop.events.since(self._next_event)
        self._display.update(self._daemon.loop.snapshot(), events)

    def go_on(self, end: float, *, unattended: bool) -> None:
        """Show updates until a signal, the time `end`, or the end of control.

        If `unattended`, a fault also ends it, since no client can reset the fault.
        """
        while not (self.signals.count or self._daemon.ended or time.monotonic() > end):
            self.show()
            if unattended and self._daemon.loop.snapshot().state is State.FAULT:
                return
            self.signals.wait(self._display.period)

    def wind_up(self) -> None:
        """Let the pressures down and show it; another signal vents at once."""
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
    """Counts signals to end the program, without interrupting it."""

    def __init__(self) -> None:
        self.count = 0
        self._interrupt = False
        self._news: SimpleQueue[None] = SimpleQueue()  # an Event is not safe in a signal handler

    @contextmanager
    def handled(self) -> Iterator[_Signals]:
        """Context in which signals are counted."""
        with handled(dict.fromkeys(ENDING_SIGNALS, self._handle)):
            yield self

    @contextmanager
    def interrupting(self) -> Iterator[None]:
        """Context in which a signal raises KeyboardInterrupt, while nothing is under pressure."""
        if self.count:
            raise KeyboardInterrupt
        self._interrupt = True
        try:
            yield
        finally:
            self._interrupt = False

    def wait(self, seconds: float) -> None:
        """Wait for some time, or until the next signal."""
        with suppress(Empty):
            self._news.get(timeout=seconds)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        self._news.put(None)
        if self._interrupt:
            self._interrupt = False
            raise KeyboardInterrupt


def _display(style: str, daemon: Daemon) -> LiveStatus | Lines:
    if style == "live":
        robot = daemon.robot.description
        names = [robot.channel_name(k) for k in range(robot.n_pressures)]
        return LiveStatus(daemon.description.name, names)
    return Lines(as_json=style == "json")


class Screen:
    """Prints from its own thread, since writing to a terminal may block."""

    def __init__(self) -> None:
        self._waiting: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="screen", daemon=True)
        self._thread.start()

    @property
    def is_behind(self) -> bool:
        """Whether text is waiting to be written."""
        return not self._waiting.empty()

    def post(self, show: Callable[[], object]) -> None:
        """Queue a function that shows something; does not block."""
        self._waiting.put(show)

    def finish(self, seconds: float) -> bool:
        """Show everything queued, then end; return whether that finished in time."""
        self._waiting.put(None)
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (show := self._waiting.get()) is not None:
            try:
                show()
            except Exception:
                _log.exception("something could not be shown")


class Backstop:
    """A watchdog, as a context, that ends the process if its end takes too long.

    It acts `seconds` after `has_begun` first returns true, unless the context was left before.
    """

    def __init__(self, seconds: float, has_begun: Callable[[], bool]) -> None:
        self._seconds, self._has_begun = seconds, has_begun
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="backstop", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()

    def _run(self) -> None:
        while not self._has_begun():
            if self._over.wait(_CHECK):
                return
        if not self._over.wait(self._seconds):
            write_at_once(sys.stderr, _LATE)
            leave(FAULT)


def leave(code: int) -> None:
    """Flush the output and end this process at once, without waiting for any thread."""
    ends_within(_FLUSH, call_in_thread("flush", _flush))
    os._exit(code)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()
