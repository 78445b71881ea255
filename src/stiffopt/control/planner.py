"""The re-planner beside the control loop.

Plans are made one at a time by `Planning`: at once (`InlinePlanner`, for simulated time), or in a
process beside the loop (`ProcessPlanner`), which is started again when it dies.
"""

from __future__ import annotations

import math
import os
import pickle
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from typing import Protocol

from stiffopt.control.planner_line import PlannerLine
from stiffopt.control.planning import Planning
from stiffopt.control.plans import Plan, Request
from stiffopt.control.state import Severity
from stiffopt.control.steering import Notice
from stiffopt.errors import StiffoptError
from stiffopt.model.manipulator import Manipulator

__all__ = ["InlinePlanner", "Planner", "ProcessPlanner"]

_RESTART_AFTER = 1.0  # s
_PREPARES = 0.5  # s; a new task that takes longer is worth a word


class Planner(Protocol):
    """Plans for whoever asks, when it is done."""

    def ask(self, request: Request) -> None:
        """Want a plan; one that was asked for before and is not begun is forgotten."""

    def latest(self) -> Plan | None:
        """Return the newest plan."""

    def notices(self) -> tuple[Notice, ...]:
        """What is wrong with the planner; see `Steering.notices`."""

    def close(self) -> None:
        """End."""


class InlinePlanner:
    """Plans at once, where it is asked: time stands still meanwhile, as in a simulation."""

    def __init__(self, robot: Manipulator) -> None:
        self._planning = Planning(robot)
        self._plan: Plan | None = None
        self._trouble: tuple[Notice, ...] = ()

    def ask(self, request: Request) -> None:
        """Plan."""
        try:
            self._plan = self._planning.plan(request)
            self._trouble = ()
        except StiffoptError as error:
            self._trouble = (Notice("planner", f"the planner failed: {error}", standing=True),)

    def latest(self) -> Plan | None:
        """Return the plan."""
        return self._plan

    def notices(self) -> tuple[Notice, ...]:
        """Say whether the last request failed."""
        return self._trouble

    def close(self) -> None:
        """Nothing to end."""


class ProcessPlanner:
    """Plans in a process of its own, so that neither whoever asks nor Python's lock ever waits.

    If planning fails in a way that no one thought of, or the process dies, the last plan stays, an
    alarm says so, and another process is started.

    Parameters
    ----------
    robot :
        The arm.
    patience :
        A plan that takes longer than this is worth an alarm, in s. The first one of a kind may be
        compiled, which takes seconds.
    """

    def __init__(self, robot: Manipulator, patience: float = 5.0) -> None:
        self._robot, self._patience = robot, patience
        self._wanted: Request | None = None
        self._serial = -1  # of what was asked last
        self._plan: Plan | None = None
        self._trouble, self._ended = "", False
        self._start()

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-P",
                    "-m",
                    "stiffopt.control.planner_process",
                    str(theirs.fileno()),
                ],
                pass_fds=(theirs.fileno(),),
                start_new_session=True,  # a terminal's Ctrl-C is not for it
            )
        _let_it_yield(self._process.pid)
        self._line = PlannerLine(ours.detach())
        self._begun: float | None = math.inf  # busy with itself until it says that it is ready
        self._started_at = time.monotonic()
        self._line.begin(self._robot)

    def ask(self, request: Request) -> None:
        """Want a plan."""
        if self._wanted is not None and self._wanted.serial == request.serial:
            request = replace(request, anew=self._wanted.anew or request.anew)
        self._wanted = request
        self._exchange()

    def latest(self) -> Plan | None:
        """Return the newest plan."""
        self._exchange()
        return self._plan

    def notices(self) -> tuple[Notice, ...]:
        """Say whether planning has failed, or takes too long."""
        begun = self._begun
        if self._trouble:
            return (Notice("planner", self._trouble, standing=True),)
        elapsed = 0.0 if begun is None else time.monotonic() - begun
        if elapsed > _PREPARES and (self._plan is None or self._plan.serial != self._serial):
            text = (
                "the optimiser prepares for a new task; the first of a kind is compiled, which "
                "takes seconds, and until then the pressures stay"
            )
            return (Notice("preparing", text, Severity.INFO, standing=True),)
        if elapsed > self._patience:
            return (Notice("planner", "the planner is slow; the last plan stays", standing=True),)
        return ()

    def close(self) -> None:
        """End the process."""
        self._ended = True
        self._line.close()  # which ends it
        try:
            self._process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _exchange(self) -> None:
        """Take what was planned, and hand over what is wanted if the process is free for it."""
        if self._ended or (self._begun is None and self._wanted is None):
            return
        try:
            while self._line.has_answer():
                answer = self._line.receive()
                self._begun = None
                if isinstance(answer, Plan):
                    self._plan, self._trouble = answer, ""
                elif answer is not None:  # None: it is ready
                    self._trouble = f"the planner failed and begins anew: {answer}"
            if self._wanted is not None and self._begun is None:
                self._line.ask(self._wanted)
                self._serial = self._wanted.serial
                self._wanted, self._begun = None, time.monotonic()
        except (OSError, EOFError, pickle.UnpicklingError):
            self._start_again()

    def _start_again(self) -> None:
        self._trouble = "the planner died and is started again; the last plan stays"
        if time.monotonic() - self._started_at < _RESTART_AFTER:
            return
        self._line.close()
        self._process.kill()
        self._process.wait()
        self._start()


def _let_it_yield(process: int) -> None:
    """Let a process not interrupt whoever wakes it, where the system can be told so.

    It is woken by each request, and would plan at once, for milliseconds, on the very processor on
    which the control loop is in the middle of a tick. It also loses the loop's real-time priority,
    which it has got if the loop itself started it.
    """
    with suppress(AttributeError, OSError):
        os.sched_setscheduler(process, os.SCHED_BATCH, os.sched_param(0))
