"""The line between a `ProcessPlanner` and its process.

A tick of the control loop waits for what is done here, so no more goes over the line than is new:
of a request what differs from the one before (to write a task takes longer than all the rest), of
a plan what the request does not say.
"""

from __future__ import annotations

import pickle
import select
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from stiffopt.control.plans import Plan, Request
from stiffopt.model.manipulator import Manipulator

__all__ = ["PlannerLine", "PlanningLine"]

_CHANGE = ("offset", "beside")
_NEVER_CHANGE = ("serial", "task", "target", "anew")  # but are replaced: so it is seen by identity


class PlannerLine:
    """The end at the control loop. Any method may raise `OSError`: the other end is closed.

    Parameters
    ----------
    handle :
        File descriptor of the connection, which belongs to the line from now on.

    Attributes
    ----------
    has_answer :
        Says whether there is something to receive, if only that the other end is closed.
    """

    def __init__(self, handle: int) -> None:
        self._connection = Connection(handle)
        self.has_answer = _readiness(self._connection)
        self._asked: Request | None = None

    def begin(self, robot: Manipulator) -> None:
        """Send the arm to plan for; the first answer is None."""
        self._connection.send(robot)

    def ask(self, request: Request) -> None:
        """Send a request; the one before must have been answered."""
        before = self._asked
        news: dict[str, Any] = {
            name: getattr(request, name)
            for name in _NEVER_CHANGE
            if before is None or getattr(request, name) is not getattr(before, name)
        }
        for name in _CHANGE:  # arrays take twenty times as long
            news[name] = getattr(request, name).tolist()
        self._connection.send_bytes(pickle.dumps(news, pickle.HIGHEST_PROTOCOL))
        self._asked = request

    def receive(self) -> Plan | str | None:
        """Receive the plan, or why there is none; None when the process is ready.

        Raises
        ------
        EOFError
            The other end is closed.
        """
        answer: dict[str, Any] | str | None = self._connection.recv()
        asked = self._asked
        if asked is None or answer is None or isinstance(answer, str):
            return None if answer is None else str(answer)
        return Plan(
            serial=asked.serial,
            pressures=np.array(answer.pop("pressures")),
            offset=asked.offset,
            target=asked.target,
            **answer,
        )

    def close(self) -> None:
        """Close the line, which ends the process."""
        self._connection.close()


class PlanningLine:
    """The end at the process; `EOFError` and `OSError` say that the other end is closed.

    Parameters
    ----------
    handle :
        File descriptor of the connection.
    """

    def __init__(self, handle: int) -> None:
        self._connection = Connection(handle)
        self._known: dict[str, Any] = {}

    def robot(self) -> Manipulator:
        """Receive the arm to plan for."""
        robot: Manipulator = self._connection.recv()
        return robot

    def request(self) -> Request:
        """Receive a request."""
        self._known.update(self._connection.recv())
        arrays = {name: np.array(self._known[name]) for name in _CHANGE}
        return Request(**{**self._known, **arrays})

    def answer(self, answer: Plan | str | None) -> None:
        """Send the plan for the last request, or why there is none; None to say: ready."""
        if isinstance(answer, Plan):
            self._connection.send(
                {
                    "pressures": answer.pressures.tolist(),
                    "reached": answer.reached,
                    "stiffness": answer.stiffness,
                    "message": answer.message,
                }
            )
        else:
            self._connection.send(answer)


def _readiness(connection: Connection) -> Callable[[], bool]:
    """Return what says whether a connection has something to receive."""
    if not hasattr(select, "poll"):
        return connection.poll  # makes a selector each time, which takes many times as long
    poll = select.poll()
    poll.register(connection.fileno(), select.POLLIN)  # and what goes wrong, without being asked
    return lambda: bool(poll.poll(0))
