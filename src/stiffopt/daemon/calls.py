"""Calls to the control loop from the service, which must not wait for it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

from stiffopt.control.request_queue import Requester, requested_by
from stiffopt.control.state import Event, Snapshot
from stiffopt.control.trajectory import Trajectory
from stiffopt.daemon.refusals import RefusedError
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task

__all__ = ["Commanded", "EventLog", "LoopCalls"]

_WAITING = 8  # calls at once; more than a lively client needs


class EventLog(Protocol):
    """What has happened."""

    def since(self, index: int, /) -> tuple[list[Event], int]:
        """Return the events from an index on, and the index after the last one."""


class Commanded(Protocol):
    """What the service needs of a `ControlLoop`; see there.

    The commands return when they are done, or raise `CommandError` or `InputError` and change
    nothing; one that its `Requester` has given up is not begun any more. `snapshot` and `events`
    return at once.
    """

    @property
    def events(self) -> EventLog:
        """What has happened."""

    def arm(self) -> None:
        """Check everything and steer."""

    def disarm(self) -> None:
        """Let the pressures down and vent."""

    def set_task(self, task: Task) -> None:
        """Pursue a task."""

    def set_target(self, target: Target) -> None:
        """Go to another target."""

    def follow_trajectory(self, trajectory: Trajectory) -> None:
        """Go through waypoints."""

    def hold(self, reason: str = ...) -> None:
        """Keep the pressures."""

    def vent(self, reason: str = ...) -> None:
        """Let all pressure out at once."""

    def reset(self) -> None:
        """Leave the state fault."""

    def snapshot(self) -> Snapshot:
        """Say how things stand."""


class LoopCalls:
    """Waits for the control loop in threads of their own, and not for ever.

    Parameters
    ----------
    patience :
        Seconds after which a call is given up; what has not been begun then is not done.
    """

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self._running = 0

    async def __call__(
        self,
        function: Callable[..., Any],
        *args: Any,
        urgent: bool = False,
        lasting: bool = False,
    ) -> Any:
        """Return what the function returns.

        Parameters
        ----------
        function, args :
            What to call.
        urgent :
            Call it however many calls are already waiting: what makes the arm safer.
        lasting :
            Have it done however late, also when nobody waits for it any more.

        Raises
        ------
        RefusedError
            It does not return in time, or too many calls are waiting already.
        """
        if self._running >= _WAITING and not urgent:
            raise RefusedError(503, "busy", "the control loop has too much to do; try again")
        asker = Requester()
        answer = start(function, *args, asker=None if lasting else asker)
        self._running += 1
        answer.add_done_callback(self._ended)
        try:
            await asyncio.wait([answer], timeout=self._patience)
        finally:  # also where the client has gone
            never = not answer.done() and asker.give_up()
        if answer.done():
            return answer.result()
        if lasting:
            outcome = "this is done as soon as it can be"
        elif never:
            outcome = "it will not do this any more; look at the state, and ask again"
        else:
            outcome = "whether it will still do this is not known: look at the state, or vent"
        late = f"the control loop did not answer within {self._patience:g} s"
        raise RefusedError(503, "no-answer", f"{late}; {outcome}")

    def _ended(self, answer: asyncio.Future[Any]) -> None:
        self._running -= 1
        if not answer.cancelled():
            answer.exception()  # also of calls that were given up: that it was looked at


def start(
    function: Callable[..., Any], *args: Any, asker: Requester | None = None
) -> asyncio.Future[Any]:
    """Call a function in a thread of its own, which does not keep the process from ending.

    Parameters
    ----------
    function, args :
        What to call.
    asker :
        Who asks, and may give it up; None: it is done however late.
    """
    events = asyncio.get_running_loop()
    answer: asyncio.Future[Any] = events.create_future()

    def tell(result: Any, error: BaseException | None) -> None:
        if answer.done():
            return
        if error is None:
            answer.set_result(result)
        else:
            answer.set_exception(error)

    def work() -> None:
        result, error = None, None
        try:
            with requested_by(asker or Requester()):
                result = function(*args)
        except Exception as raised:
            error = raised
        with suppress(RuntimeError):  # the service has ended meanwhile
            events.call_soon_threadsafe(tell, result, error)

    threading.Thread(target=work, name="command", daemon=True).start()
    return answer
