"""The operations behind the HTTP interface: check who has control, then call the control loop."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from math import isfinite
from typing import Any

import numpy as np

from stiffopt import units
from stiffopt.arrays import Array
from stiffopt.control.loop import ControlLoop
from stiffopt.control.request_queue import Requester, requested_by
from stiffopt.control.state import Snapshot, State
from stiffopt.daemon.calls import call_in_thread
from stiffopt.daemon.lease import ControlLease
from stiffopt.daemon.messages import TargetMessage, TaskMessage, task_of
from stiffopt.daemon.reports import (
    DoneReport,
    GrantReport,
    RefusalError,
    RobotReport,
    TaskReport,
    refusal_of,
)
from stiffopt.daemon.state_json import json_of
from stiffopt.errors import StiffoptError
from stiffopt.model.description import RobotDescription
from stiffopt.rig.interface import Clock

_VENTED = (State.UNCONFIGURED, State.INACTIVE, State.FAULT)
_MAX_CALLS = 8  # calls of the loop at once; more than a lively client needs
_log = logging.getLogger(__name__)


class Operations:
    """The daemon's interface without HTTP: reading, control and commands.

    All methods are for one event loop. They call the control loop in threads, and give up after
    `patience`, in s. A client that was not heard for `heartbeat`, in s, loses control, and the arm
    is held.
    """

    def __init__(
        self,
        loop: ControlLoop,
        robot: RobotDescription,
        heartbeat: float,
        clock: Clock,
        patience: float,
    ) -> None:
        units.get_ready()  # now, not with the first task: the control loop needs the interpreter
        self.loop = loop
        self.robot = robot
        self.lease = ControlLease(heartbeat, clock)
        self._clock = clock
        self._patience = patience
        self._running = 0  # calls of the loop
        self._task: TaskMessage | None = None  # the last accepted, while it matters
        self._reported: tuple[Snapshot, dict[str, Any]] | None = None  # the last state as JSON
        self._holding: asyncio.Task[None] | None = None

    def state(self) -> dict[str, Any]:
        """Return the state of the loop and who has control, as `StateReport` describes it."""
        holder = self.lease.holder
        now = self.loop.snapshot()
        if self._reported is None or self._reported[0] is not now:  # streams share states
            self._reported = (now, json_of(now))
        return {**self._reported[1], "lease": None if holder is None else holder.model_dump()}

    def robot_report(self) -> RobotReport:
        """Return a description of the arm."""
        snapshot, robot = self.loop.snapshot(), self.robot
        return RobotReport(
            name=robot.name,
            n=robot.n_pressures,
            channels=[robot.channel_name(k) for k in range(robot.n_pressures)],
            low_pa=snapshot.low.tolist(),
            high_pa=snapshot.high.tolist(),
            length_m=robot.length,
        )

    def task(self) -> TaskReport:
        """Return the present task and target."""
        now = self.loop.snapshot()
        wanted = {
            "position_m": now.target_position,
            "orientation_wxyz": _whole(now.target_quaternion),
            "pointing": _whole(now.target_pointing),
        }
        known = {
            key: [x if isfinite(x) else None for x in value.tolist()]
            for key, value in wanted.items()
            if value is not None
        }
        target = TargetMessage.model_validate(known) if known else None
        given = None if now.state in _VENTED else self._task
        return TaskReport(doing=now.task, target=target, task=given)

    # Control ----------------------------------------------------------------------------------

    async def take(self, client: str) -> GrantReport:
        """Grant control to a client; raise `RefusalError` if another has it."""
        await self.watch()  # the client that had it may have gone silent
        identity = self.lease.take(client)
        beat = self.lease.heartbeat
        return GrantReport(lease=identity, heartbeat_s=beat, renew_every_s=beat / 4)

    async def release(self, identity: str | None) -> None:
        """End a client's control; a hold then gets a timeout, as no client is left to end it."""
        holder, now = self.lease.holder, self.loop.snapshot()
        self.lease.release(identity)
        if holder is not None and now.state is State.HOLDING:
            reason = f"{now.reason}; '{holder.client}' has given control back"
            with suppress(StiffoptError):  # the pressures are being let down
                await self._call(partial(self.loop.hold, reason, lasting=False), urgent=True)

    async def watch(self) -> None:
        """Hold the arm if the client in control has gone silent; to be called repeatedly."""
        client = self.lease.check(self._clock.now())
        if client is None:
            return
        if self._holding is None or self._holding.done():
            self._holding = asyncio.create_task(self._hold_after(client))
        await asyncio.wait([self._holding], timeout=1.0)

    async def _hold_after(self, client: str) -> None:
        """Hold the arm; control becomes free once the loop has held it or has refused to."""
        reason = f"nothing was heard from '{client}', which had control"
        call = call_in_thread("command", partial(self.loop.hold, reason, lasting=False))
        await _ended(call)
        try:
            call.result()
        except StiffoptError as refused:  # for example because there is nothing to hold
            _log.info("'%s' has lost control; not held: %s", client, refused)
        except Exception:
            _log.exception("'%s' has lost control, and the arm could not be held", client)
            return  # `watch` tries again
        self.lease.settle()

    # Commands ---------------------------------------------------------------------------------

    async def command(
        self,
        identity: str | None,
        function: Callable[[], object],
        *,
        urgent: bool = False,
        ends_task: bool = False,
    ) -> DoneReport:
        """Carry out a command of a client that has control.

        Parameters
        ----------
        identity : the lease that the client sent.
        function : calls the loop. It may raise `InputError`. It runs in another thread, since it
            may take long and other clients must be answered meanwhile.
        urgent : whether it makes the arm safer: then no limit of waiting calls applies.
        ends_task : whether it ends the present task.
        """
        with self.lease.used(identity):
            await self._call(function, urgent=urgent)
        if ends_task:
            self._task = None
        return self._done()

    async def vent(self) -> DoneReport:
        """Vent at once, for any client; the loop does so even if the patience ends before."""
        await self._call(
            partial(self.loop.vent, "a client asked for it"), urgent=True, lasting=True
        )
        self._task = None
        return self._done()

    async def set_task(self, identity: str | None, given: Any) -> DoneReport:
        """Pursue a task, given as the JSON of a `TaskRequest`."""

        def pursue() -> TaskMessage:
            task = task_of(given, self.robot.name)
            message = TaskMessage.of(task, robot=self.robot.name)  # that clients can read later
            self.loop.set_task(task)
            return message

        with self.lease.used(identity):
            self._task = await self._call(pursue)
        return self._done()

    def _done(self) -> DoneReport:
        snapshot = self.loop.snapshot()
        return DoneReport(state=snapshot.state, reason=snapshot.reason)

    async def _call(
        self, function: Callable[[], Any], *, urgent: bool = False, lasting: bool = False
    ) -> Any:
        """Call a function that waits for the control loop, in a thread; return its result.

        With `lasting`, the loop carries it out even after the patience has ended.

        Raises `RefusalError`: it fails, does not return in time, or too many calls are waiting.
        """
        if self._running >= _MAX_CALLS and not urgent:
            raise RefusalError(503, "busy", "the control loop has too much to do; try again")
        requester = Requester()

        def requested() -> Any:
            with requested_by(Requester() if lasting else requester):
                return function()

        call = call_in_thread("command", requested)
        self._running += 1
        ended = asyncio.ensure_future(_ended(call))
        ended.add_done_callback(self._count_down)
        try:
            await asyncio.wait([ended], timeout=self._patience)
        finally:  # also if the client has disconnected
            never = not call.done() and requester.give_up()
        if call.done():
            try:
                return call.result()
            except StiffoptError as error:
                raise refusal_of(error) from None
        if lasting:
            outcome = "this is done as soon as it can be"
        elif never:
            outcome = "it will not do this any more; look at the state, and send it again"
        else:
            outcome = "whether it will still do this is not known: look at the state, or vent"
        late = f"the control loop did not answer within {self._patience:g} s"
        raise RefusalError(503, "no-answer", f"{late}; {outcome}")

    def _count_down(self, _: object) -> None:
        self._running -= 1


async def _ended(call: Future[Any]) -> None:
    """Wait for the end of a call in another thread."""
    events, ended = asyncio.get_running_loop(), asyncio.Event()

    def notify(_: object) -> None:
        with suppress(RuntimeError):  # the event loop has ended
            events.call_soon_threadsafe(ended.set)

    call.add_done_callback(notify)
    await ended.wait()


def _whole(values: Array | None) -> Array | None:
    """Return the values if all are known."""
    return values if values is not None and np.isfinite(values).all() else None
