"""The operations behind the HTTP interface: check who has control, then call the control loop."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt import units
from stiffopt.control.loop import ControlLoop
from stiffopt.control.state import Snapshot, State
from stiffopt.daemon.calls import LoopCalls, start
from stiffopt.daemon.lease import ControlLease
from stiffopt.daemon.messages import TargetMessage, TaskMessage, task_of
from stiffopt.daemon.reports import (
    LEASE_HEADER,
    DoneReport,
    GrantReport,
    LeaseReport,
    RefusalError,
    RobotReport,
    TaskReport,
    json_of,
    refusal_of,
)
from stiffopt.errors import CommandError, StiffoptError
from stiffopt.model.description import RobotDescription
from stiffopt.rig.interface import Clock

__all__ = ["Operations"]

_VENTED = (State.UNCONFIGURED, State.INACTIVE, State.FAULT)
_log = logging.getLogger(__name__)


class Operations:
    """The daemon's interface without HTTP: reading, control and commands.

    All methods are for one event loop.

    Parameters
    ----------
    loop :
        The control loop.
    robot :
        The arm that it steers.
    heartbeat :
        A client that was not heard for this long, in s, loses control, and the arm is held.
    clock :
        That of the rig.
    patience :
        Seconds after which a command to the loop is given up.
    """

    def __init__(
        self,
        loop: ControlLoop,
        robot: RobotDescription,
        heartbeat: float,
        clock: Clock,
        patience: float,
    ) -> None:
        units.get_ready()  # not when a task comes: the control loop shares the interpreter
        self.loop = loop
        self.robot = robot
        self.lease = ControlLease(heartbeat, clock)
        self._clock = clock
        self._call = LoopCalls(patience)
        self._task: TaskMessage | None = None  # the last that was accepted, while it matters
        self._told: tuple[Snapshot, dict[str, Any]] | None = None  # the last state as JSON
        self._settling: asyncio.Task[None] | None = None

    def state(self) -> dict[str, Any]:
        """Return the state of the loop and who has control, as `StateReport` describes it."""
        holder = self.lease.holder
        lease = None
        if holder is not None:
            lease = LeaseReport(client=holder.client, expires_in_s=holder.expires_in)
        now = self.loop.snapshot()
        if self._told is None or self._told[0] is not now:  # streams mostly want the same one
            self._told = (now, json_of(now))
        return {**self._told[1], "lease": None if lease is None else lease.model_dump()}

    def robot_report(self) -> RobotReport:
        """Return what arm this is."""
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
        """Return what is being done."""
        now = self.loop.snapshot()
        wanted = {
            "position_m": now.target_position,
            "orientation_wxyz": _whole(now.target_quaternion),
            "pointing": _whole(now.target_pointing),
        }
        told = {
            key: [x if isfinite(x) else None for x in value.tolist()]
            for key, value in wanted.items()
            if value is not None
        }
        target = TargetMessage.model_validate(told) if told else None
        given = None if now.state in _VENTED else self._task
        return TaskReport(doing=now.task, target=target, task=given)

    # Control ----------------------------------------------------------------------------------

    async def take(self, client: str) -> GrantReport:
        """Give a client control; raise `RefusalError` if another has it."""
        await self.watch()  # who had it may be gone
        with _of_lease():
            identity = self.lease.take(client)
        beat = self.lease.heartbeat
        return GrantReport(lease=identity, heartbeat_s=beat, renew_every_s=beat / 4)

    def renew(self, identity: str | None) -> None:
        """Note that a client was heard; raise `RefusalError` if it does not have control."""
        with _of_lease():
            self.lease.renew(_shown(identity))

    def release(self, identity: str | None) -> None:
        """Take control back; raise `RefusalError` if the client does not have it."""
        with _of_lease():
            self.lease.release(_shown(identity))

    async def watch(self) -> None:
        """Hold the arm if who had control is not heard any more; to be called again and again."""
        client = self.lease.check(self._clock.now())
        if client is None:
            return
        if self._settling is None or self._settling.done():
            self._settling = asyncio.create_task(self._settle(client))
        await asyncio.wait([self._settling], timeout=1.0)

    async def _settle(self, client: str) -> None:
        """Hold; nobody else gets control before the loop has done so or has said why not."""
        try:
            await start(self.loop.hold, f"nothing was heard from '{client}', which had control")
        except StiffoptError as refused:  # such as: there is nothing to hold
            _log.info("'%s' has lost control; not held: %s", client, refused)
        except Exception:
            _log.exception("'%s' has lost control, and the arm could not be held", client)
            return  # `watch` tries again
        self.lease.settle()

    # Commands ---------------------------------------------------------------------------------

    async def arm(self, identity: str | None) -> DoneReport:
        """Arm."""
        return await self._forgetting(identity, self.loop.arm)

    async def disarm(self, identity: str | None) -> DoneReport:
        """Let the pressures down, vent and disarm."""
        return await self._forgetting(identity, self.loop.disarm)

    async def reset(self, identity: str | None) -> DoneReport:
        """Leave the state fault."""
        return await self._forgetting(identity, self.loop.reset)

    async def vent(self) -> DoneReport:
        """Vent at once, whoever has control; rather late than never."""
        await self._asked(self.loop.vent, "a client asked for it", urgent=True, lasting=True)
        self._task = None
        return self._done()

    async def hold(self, identity: str | None, reason: str) -> DoneReport:
        """Keep the pressures as they are."""
        with self._control(identity):
            await self._asked(self.loop.hold, reason, urgent=True)
        return self._done()

    async def set_task(self, identity: str | None, given: Any) -> DoneReport:
        """Pursue a task, given as the JSON of a `TaskRequest`."""

        def pursue() -> TaskMessage:
            task = task_of(given, self.robot.name)
            message = TaskMessage.of(task, robot=self.robot.name)  # what clients are told later
            self.loop.set_task(task)
            return message

        with self._control(identity):
            self._task = await self._asked(pursue)
        return self._done()

    async def command(
        self, identity: str | None, function: Callable[[Any], None], what: Callable[[], Any]
    ) -> DoneReport:
        """Call a command of the loop with the description that `what` returns.

        `what` may raise `InputError`. It is called in another thread, as it may take long, and
        other clients must be answered meanwhile.
        """
        with self._control(identity):
            await self._asked(lambda: function(what()))
        return self._done()

    async def _forgetting(self, identity: str | None, function: Callable[[], None]) -> DoneReport:
        """Call a command of the loop after which there is no task."""
        with self._control(identity):
            await self._asked(function)
            self._task = None
        return self._done()

    async def _asked(self, function: Callable[..., Any], *args: Any, **how: bool) -> Any:
        with _as_refusals():
            return await self._call(function, *args, **how)

    def _done(self) -> DoneReport:
        snapshot = self.loop.snapshot()
        return DoneReport(state=snapshot.state, reason=snapshot.reason)

    @contextmanager
    def _control(self, identity: str | None) -> Iterator[None]:
        """Do what is in the body for a client that has control, and only for that."""
        with ExitStack() as stack:
            with _of_lease():
                stack.enter_context(self.lease.used(_shown(identity)))
            yield


@contextmanager
def _as_refusals() -> Iterator[None]:
    try:
        yield
    except StiffoptError as error:
        raise refusal_of(error) from None


@contextmanager
def _of_lease() -> Iterator[None]:
    try:
        yield
    except CommandError as error:
        raise RefusalError(409, "lease", str(error)) from None


def _shown(identity: str | None) -> str:
    if identity is None:
        raise RefusalError(
            409, "lease", f"this needs control; take it, and show the lease in '{LEASE_HEADER}'"
        )
    return identity


def _whole(values: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Return the values if all are known."""
    return values if values is not None and np.isfinite(values).all() else None
