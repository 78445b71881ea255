"""Runs calls that may hang in threads of their own, and waits for them for a limited time."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from stiffopt.control.request_queue import Requester, requested_by
from stiffopt.daemon.reports import RefusalError

__all__ = [
    "LoopCalls",
    "Part",
]


class Part:
    """A call that runs in a daemon thread, so that the process can end even if it hangs.

    Parameters
    ----------
    name :
        Of the thread.
    work :
        Is begun at once.

    Attributes
    ----------
    error : what the work has raised, if anything.
    """

    def __init__(self, name: str, work: Callable[[], Any]) -> None:
        self.name = name
        self.error: BaseException | None = None
        self._work = work
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def ends_within(self, seconds: float) -> bool:
        """Wait for some time at most; return whether the work has ended."""
        self._thread.join(max(seconds, 0.0))
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._work()
        except BaseException as error:
            self.error = error


_WAITING = 8  # calls at once; more than a lively client needs


class LoopCalls:
    """Calls the control loop from asyncio: in a thread per call, and with a time limit.

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
        RefusalError
            It does not return in time, or too many calls are waiting already.
        """
        if self._running >= _WAITING and not urgent:
            raise RefusalError(503, "busy", "the control loop has too much to do; try again")
        requester = Requester()
        answer = start(function, *args, requester=None if lasting else requester)
        self._running += 1
        answer.add_done_callback(self._ended)
        try:
            await asyncio.wait([answer], timeout=self._patience)
        finally:  # also where the client has gone
            never = not answer.done() and requester.give_up()
        if answer.done():
            return answer.result()
        if lasting:
            outcome = "this is done as soon as it can be"
        elif never:
            outcome = "it will not do this any more; look at the state, and ask again"
        else:
            outcome = "whether it will still do this is not known: look at the state, or vent"
        late = f"the control loop did not answer within {self._patience:g} s"
        raise RefusalError(503, "no-answer", f"{late}; {outcome}")

    def _ended(self, answer: asyncio.Future[Any]) -> None:
        self._running -= 1
        if not answer.cancelled():
            answer.exception()  # also of calls that were given up: that it was looked at


def start(
    function: Callable[..., Any], *args: Any, requester: Requester | None = None
) -> asyncio.Future[Any]:
    """Call a function in a thread of its own, which does not keep the process from ending.

    Parameters
    ----------
    function, args :
        What to call.
    requester :
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
            with requested_by(requester or Requester()):
                result = function(*args)
        except Exception as raised:
            error = raised
        with suppress(RuntimeError):  # the service has ended meanwhile
            events.call_soon_threadsafe(tell, result, error)

    threading.Thread(target=work, name="command", daemon=True).start()
    return answer
