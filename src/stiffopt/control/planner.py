"""Runs the planning: inline on a simulated clock, in a separate process in real time.

The control loop hands requests to an `InlinePlanner` or a `ProcessPlanner` and takes the newest
plan. A separate process keeps computing time and Python's lock from delaying a tick; if it dies, it
is restarted. A tick writes to the process, so only news is sent: the fields of a request that
differ from the last one (a task takes longer than all the rest), and the fields of a plan that its
request does not have.
"""

from __future__ import annotations

import math
import os
import pickle
import select
import socket
import subprocess
import sys
import time
import warnings
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from stiffopt.control.interface import Notice
from stiffopt.control.plan import Plan, PlanRequest
from stiffopt.control.planning import Planning
from stiffopt.control.state import Severity
from stiffopt.control.vibration import BentMode
from stiffopt.errors import SlowWarning, StiffoptError
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene

_RESTART_AFTER = 1.0  # s between two starts of the process
_PREPARATION = 0.5  # s; preparing a new task for longer is reported
_NICE = 5  # of the process: the control loop comes first
_IDLE = 1.0  # s without a request until the process compiles code
# fields of a request: arrays are sent every time
_ARRAYS = ("offset", "pressure_offset", "low", "high", "way", "here")
# immutable fields are sent if they are other objects than in the last request
_OBJECTS = ("serial", "task", "target", "search", "stay", "last", "windows", "adapted")


class InlinePlanner:
    """Plans within the request, while simulated time stands still."""

    def __init__(self, robot: Manipulator, scene: Scene | None = None) -> None:
        self._planning = Planning(robot, scene)
        self._plan: Plan | None = None
        self._notices: tuple[Notice, ...] = ()
        self.failures = 0  # requests without an answer

    def request(self, request: PlanRequest) -> None:
        """Make a plan."""
        try:
            self._plan = self._planning.plan(request)
            self._notices = ()
        except StiffoptError as error:
            self.failures += 1
            self._notices = (Notice("planner", f"the planner failed: {error}", standing=True),)

    def latest(self) -> Plan | None:
        """Return the plan."""
        return self._plan

    def notices(self) -> tuple[Notice, ...]:
        """Return whether the last request failed."""
        return self._notices

    def close(self) -> None:
        """Nothing to end."""


class ProcessPlanner:
    """Plans in a separate process, so that the control loop never waits.

    When planning fails unexpectedly or the process dies, the last plan stays, an alarm reports the
    failure, and a new process is started.

    Parameters
    ----------
    robot : the arm.
    scene : objects from which the ways to plans keep clear.
    patience : planning time beyond which there is an alarm, in s. The first task of a kind may have
        to be compiled, which takes seconds.
    """

    def __init__(
        self, robot: Manipulator, scene: Scene | None = None, patience: float = 5.0
    ) -> None:
        self._robot, self._scene, self._patience = robot, scene, patience
        self._waiting: PlanRequest | None = None
        self._serial = -1  # of the last request that was sent
        self._plan: Plan | None = None
        self._failure, self._closed = "", False
        self.failures = 0  # requests without an answer
        self._start()

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "stiffopt.control.planner", str(theirs.fileno())],
                pass_fds=(theirs.fileno(),),
                start_new_session=True,  # a terminal's Ctrl-C must not end it
            )
        _set_batch_policy(self._process.pid)
        self._end = PlannerEnd(ours.detach())
        self._busy_since: float | None = math.inf  # until the process is ready
        self._started_at = time.monotonic()
        self._end.connection.send((self._robot, self._scene))

    def request(self, request: PlanRequest) -> None:
        """Request a plan once the process is free; this replaces a waiting request."""
        if self._waiting is not None and self._waiting.serial == request.serial:
            request = replace(request, search=self._waiting.search or request.search)
        self._waiting = request
        self._exchange()

    def latest(self) -> Plan | None:
        """Return the newest plan."""
        self._exchange()
        return self._plan

    def notices(self) -> tuple[Notice, ...]:
        """Return whether planning has failed or takes too long."""
        self._exchange()  # while pressures are held or the arm leans, nobody asks for plans
        busy_since = self._busy_since
        if self._failure:
            return (Notice("planner", self._failure, standing=True),)
        elapsed = 0.0 if busy_since is None else time.monotonic() - busy_since
        if elapsed > _PREPARATION and (self._plan is None or self._plan.serial != self._serial):
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
        self._closed = True
        self._end.connection.close()  # which ends the process
        try:
            self._process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _exchange(self) -> None:
        """Receive plans; send the waiting request if the process is free."""
        if self._closed or (self._busy_since is None and self._waiting is None):
            return
        try:
            while self._end.has_answer():
                answer = self._end.receive()
                self._busy_since = None
                if isinstance(answer, Plan):
                    self._plan, self._failure = answer, ""
                elif answer is not None:  # None: the process is ready
                    self._failure = f"the planner failed and begins anew: {answer}"
                    self.failures += 1
            if self._waiting is not None and self._busy_since is None:
                self._end.send(self._waiting)
                self._serial = self._waiting.serial
                self._waiting, self._busy_since = None, time.monotonic()
        except (OSError, EOFError, pickle.UnpicklingError):
            self._start_again()

    def _start_again(self) -> None:
        self._failure = "the planner died and is started again; the last plan stays"
        self.failures += 1
        if time.monotonic() - self._started_at < _RESTART_AFTER:
            return
        self._end.connection.close()
        self._process.kill()
        self._process.wait()
        self._start()


def _set_batch_policy(process: int) -> None:
    """Schedule a process as SCHED_BATCH, where the system has that.

    A request wakes the process. Otherwise it would pre-empt the control loop within that tick and
    plan for milliseconds on the same processor. This also drops the loop's priorities, which the
    process inherits.
    """
    with suppress(AttributeError, OSError):
        os.sched_setscheduler(process, os.SCHED_BATCH, os.sched_param(0))
        os.setpriority(os.PRIO_PROCESS, process, max(0, os.getpriority(os.PRIO_PROCESS, process)))


class PlannerEnd:
    """The control loop's end of the connection; calls raise `OSError` if the other is closed."""

    def __init__(self, handle: int) -> None:
        self.connection = Connection(handle)
        self._poll = select.poll()  # `Connection.poll` is slow: it makes a selector each time
        self._poll.register(handle, select.POLLIN)  # errors are always reported
        self._sent: PlanRequest | None = None

    def has_answer(self) -> bool:
        """Whether there is something to receive, or the other end is closed."""
        return bool(self._poll.poll(0))

    def send(self, request: PlanRequest) -> None:
        """Send a request; the last one must have been answered."""
        before = self._sent
        news: dict[str, Any] = {
            name: getattr(request, name)
            for name in _OBJECTS
            if before is None or getattr(request, name) is not getattr(before, name)
        }
        for name in _ARRAYS:  # as lists: pickling an array takes twenty times longer
            news[name] = getattr(request, name).tolist()
        self.connection.send_bytes(pickle.dumps(news, pickle.HIGHEST_PROTOCOL))
        self._sent = request

    def receive(self) -> Plan | str | None:
        """Receive a plan, or the reason for none; None when the process is ready."""
        answer: dict[str, Any] | str | None = self.connection.recv()
        request = self._sent
        if request is None or answer is None or isinstance(answer, str):
            return None if answer is None else str(answer)
        if bent := answer.pop("bent"):
            bent = BentMode(*map(np.array, bent))
        return Plan(
            serial=request.serial,
            pressures=np.array(answer.pop("pressures")),
            bent=bent,
            offset=request.offset,
            target=request.target,
            adapted=request.adapted,
            **answer,
        )


class PlanningEnd:
    """The process's end of the connection; `EOFError` and `OSError`: the other end is closed."""

    def __init__(self, handle: int) -> None:
        self.connection = Connection(handle)
        self._fields: dict[str, Any] = {}

    def request(self) -> PlanRequest:
        """Receive a request."""
        self._fields.update(self.connection.recv())
        arrays = {name: np.array(self._fields[name]) for name in _ARRAYS}
        return PlanRequest(**{**self._fields, **arrays})

    def answer(self, answer: Plan | str | None) -> None:
        """Send the plan for the last request, or the reason for none; None: ready."""
        if isinstance(answer, Plan):
            names = (
                *("reached", "stiffness", "message", "far", "short", "blocked", "doubt"),
                *("deviation", "estimate", "approach", "tip_first"),
            )
            news: dict[str, Any] = {name: getattr(answer, name) for name in names}
            bent = answer.bent  # the tick receives it, so its arrays are lists as well
            modes = bent and [each.tolist() for each in (bent.jacobian, bent.linear, bent.plane)]
            self.connection.send({"pressures": answer.pressures.tolist(), "bent": modes, **news})
        else:
            self.connection.send(answer)


def main(end: PlanningEnd) -> None:
    """Run the process: receive arm and scene, answer None, then serve requests.

    It ends when the other end is closed.
    """
    warnings.simplefilter("ignore", SlowWarning)  # the loop reports that a plan takes long
    robot, scene = end.connection.recv()
    planning = Planning(robot, scene)
    end.answer(None)
    while True:
        while not end.connection.poll(_IDLE):
            planning.ask_for_code()
        request = end.request()
        try:
            end.answer(planning.plan(request))
        except Exception as error:  # the next request may succeed
            end.answer(f"{type(error).__name__}: {error}")
            planning = Planning(robot, scene)


if __name__ == "__main__":
    os.nice(_NICE)
    with suppress(EOFError, OSError, KeyboardInterrupt):
        main(PlanningEnd(int(sys.argv[1])))
