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
from stiffopt.control.state import Severity, State
from stiffopt.errors import InputError, SlowWarning, StiffoptError
from stiffopt.rig.config import load_rig_description

if TYPE_CHECKING:
    from stiffopt.daemon.daemon import Daemon

__all__ = ["Options", "run"]

_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
_LOOK = 0.05  # s between looks at what has happened
_SHOWN = 0.25  # s between two pictures of a live status
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
    display = _display(options.style, rig, name)
    daemon: Daemon | None = None
    code = SOLVED
    with _warnings_shown(display):
        try:
            with signals.interrupting():
                from stiffopt.daemon.daemon import Daemon

                display.say("starting", f"connecting to {name}")
                daemon = Daemon(rig, service=options.service, log_folder=options.log_folder)
                task = None if options.task is None else daemon.read_task(options.task)
                daemon.start()
                display.begin(daemon)
                if options.arm:
                    daemon.arm(task)
            _Watch(daemon, display, signals, options).until(time.monotonic() + seconds)
        except KeyboardInterrupt:
            pass  # before it was ready
        except StiffoptError as error:
            code = BAD_INPUT
            display.end()
            report_error(str(error))
        finally:
            if daemon is not None:
                state = daemon.stop()
                events, _ = daemon.loop.events.since(0)
                del events
            display.end()
    if daemon is None:
        return code
    return _verdict(daemon, state, code)


def _verdict(daemon: Daemon, state: State, code: int) -> int:
    """Return the exit code, and say what must be known."""
    if daemon.trouble:
        report_error(f"THE ARM MAY BE UNDER PRESSURE: {daemon.trouble}")
        return FAULT
    if daemon.failure is not None:
        report_error(
            f"control ended by {type(daemon.failure).__name__}: {daemon.failure}; vented; "
            "please report it"
        )
        return FAULT
    if state is State.FAULT:
        report_error(f"ended in the state fault, vented: {daemon.loop.snapshot().reason}")
        return FAULT
    return code
