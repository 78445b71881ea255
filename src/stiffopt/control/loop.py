"""The control loop: ticks at its deadlines, serves requests of any thread, and tells how it is."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

import numpy as np

from stiffopt.control.journal import EventLog
from stiffopt.control.machine import Machine
from stiffopt.control.requested import check_target, check_task, check_trajectory
from stiffopt.control.requests import Requests, asking
from stiffopt.control.state import Snapshot, State, SteeringStatus
from stiffopt.control.steering import Steering
from stiffopt.control.timing import Punctuality
from stiffopt.control.trajectory import Trajectory
from stiffopt.errors import CommandError, InputError
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.rig.interface import Rig
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import Outlet

__all__ = ["ControlLoop"]

_LAST_TRIES = 0.5  # s after the ramp in which a supply that cannot be vented is tried again
_STARTING = (
    "not while unconfigured: it is still starting, connects to the rig and checks it, which takes "
    "up to a minute or so; ask again when the state is inactive"
)


class ControlLoop:
    """Steers an arm, tick by tick, and lets nothing happen to it.

    It begins unconfigured; `configure` checks the rig and leaves it inactive, vented; `arm` lets
    it steer. Whatever goes wrong either holds the pressures or is a fault, which vents and lasts
    until `reset`. Requests may come from any thread: the control thread carries them out in its
    next tick, or the caller at once while the loop does not run. They return when that is done, or
    raise `InputError` with the reason; nothing has changed then. While it is configured for the
    first time, which may take long, nothing waits: all is refused at once, but `vent` is done.

    Parameters
    ----------
    rig :
        Robot, tracker and clock; of its supply the limits alone are looked at.
    steering :
        Decides about pressures.
    outlet :
        The only way to the supply.
    safety :
        What is a fault.
    period :
        Between ticks, in s.

    Attributes
    ----------
    events : EventLog
        What happened.
    """

    def __init__(
        self, rig: Rig, steering: Steering, outlet: Outlet, *, safety: Safety, period: float
    ) -> None:
        if not 0 < period < math.inf:
            raise InputError(f"the period must be above 0 s, not {period:g} s")
        self.rig = rig
        self.period = period
        self._machine = Machine(rig, steering, outlet, safety, period)
        self._requests = Requests()
        self._configuring = False
        self._punctuality = Punctuality(period)
        self._ramp_time = safety.ramp_time
        self.events: EventLog = self._machine.events
        self._nothing = SteeringStatus(plan=np.full(outlet.limits.n, np.nan))
        self._snapshot = self._pictured(rig.clock.now())
        self._listeners: list[Callable[[Snapshot], None]] = []

    # Requests ------------------------------------------------------------------------------------

    def configure(self) -> None:
        """Connect supply and tracker, which vents, and check the rig; it is inactive then.

        Raises
        ------
        InputError
            A check failed; the text begins with its name. There may be several.
        """
        self._check_started()
        self._configuring = True
        try:
            self._carry_out(self._machine.configure)
        finally:
            self._configuring = False

    def arm(self) -> None:
        """Check the vented arm, then steer: it stays as it is until there is a task.

        The loop must have ticked for some time before, to learn how often the tracker sees the tip.

        Raises
        ------
        InputError
            A check failed; the text begins with its name. There may be several.
        """
        asker = asking()  # checks may take long
        self._ask(lambda now: self._machine.arm(now, lambda: asker.gone))

    def disarm(self) -> None:
        """Begin to let the pressures down; after `Safety.ramp_time` it is vented and inactive.

        Raises
        ------
        InputError
            It is in fault, and vented.
        """
        self._ask(self._machine.disarm)

    def set_task(self, task: Task) -> None:
        """Pursue a task.

        Raises
        ------
        InputError
            It is not armed, or the task does not suit.
        """
        self._check_started()
        check_task(task, self._machine.outlet.limits)
        self._carry_out(lambda now: self._machine.set_task(now, task))

    def set_target(self, target: Target) -> None:
        """Go to another target; what else the task asks for stays.

        Raises
        ------
        InputError
            It is not armed, or the target does not suit.
        """
        self._check_started()
        check_target(target)
        self._carry_out(lambda now: self._machine.set_target(now, target))

    def follow_trajectory(self, trajectory: Trajectory) -> None:
        """Follow a trajectory that begins now.

        Raises
        ------
        InputError
            It is not armed, or the trajectory does not suit.
        """
        self._check_started()
        check_trajectory(trajectory)  # here, not in the control thread, which has to tick
        self._carry_out(lambda now: self._machine.follow_trajectory(now, trajectory))

    def hold(self, reason: str = "asked to") -> None:
        """Keep the pressures as they are until the next task, target or trajectory.

        Raises
        ------
        InputError
            It is not armed, so that there is nothing to hold.
        """
        self._ask(lambda now: self._machine.hold(now, reason))

    def vent(self, reason: str = "asked to") -> None:
        """Let all pressure out at once; it is inactive then, or still in fault.

        Raises
        ------
        InputError
            The supply does not take it, or is not connected yet: that vents it. If it was
            configured it is in fault then, and tries again in each tick.
        """
        if self._starting:  # the supply itself can be told: nothing else commands it yet
            self._machine.vent_beside()
            return
        self._ask(lambda now: self._machine.vent(now, reason))

    def reset(self) -> None:
        """Leave the fault; it is inactive then.

        Raises
        ------
        InputError
            The reason for the fault is still there, or there is no fault.
        """
        self._ask(self._machine.reset)

    def add_alarm(self, kind: str, text: str) -> None:
        """Let something that others found be wrong; it does not touch control."""
        self._machine.alarms.set(self.rig.clock.now(), kind, text)

    def clear_alarm(self, kind: str) -> None:
        """Let it be well again."""
        self._machine.alarms.clear(self.rig.clock.now(), kind)

    def snapshot(self) -> Snapshot:
        """Return how things stood at the end of the last tick."""
        return self._snapshot

    def listen(self, listener: Callable[[Snapshot], None]) -> None:
        """Have a function told how things stand at the end of each tick, in the control thread.

        It must not wait. What it raises is an alarm and does not touch control.
        """
        self._listeners.append(listener)

    @property
    def _starting(self) -> bool:
        return self._configuring and self._machine.lifecycle.state is State.UNCONFIGURED

    def _check_started(self) -> None:
        """Refuse what would wait until all is connected, and come as a surprise then."""
        if self._starting:
            raise CommandError(_STARTING)

    def _ask(self, request: Callable[[float], None]) -> None:
        self._check_started()
        self._carry_out(request)

    def _carry_out(self, request: Callable[[float], None]) -> None:
        def carry() -> None:
            try:
                self._machine.carry_out(request)
            finally:
                self._snapshot = self._pictured(self.rig.clock.now())

        self._requests.make(carry)

    # Time ----------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Do what is to be done now, once."""
        self._tick(None)

    def run(self, stop: threading.Event) -> None:
        """Tick until `stop` is set, then let the pressures down and vent.

        It returns within `Safety.ramp_time` and a second or so, whatever the devices do, as long as
        time goes on. Ticks for which it is too late are left out.
        """
        self._requests.begin()
        try:
            due = self._ticked(self.rig.clock.now())
            while not stop.is_set():
                due = self._ticked(due)
            self._let_down(due)
        finally:
            try:
                self._vent_at_the_end()
            finally:
                self._requests.end()

    def close(self) -> None:
        """Vent, disconnect supply and tracker, and end what runs beside.

        Raises
        ------
        DeviceError
            The supply does not take the command to vent.
        """
        machine = self._machine
        try:
            machine.outlet.close()
        finally:
            if machine.rig.tracker is not None:
                machine.rig.tracker.close()
            machine.steering.close()

    def _ticked(self, due: float) -> float:
        """Tick when it is due; return when the next tick is."""
        clock = self.rig.clock
        try:
            clock.sleep_until(due)
        except Exception as error:  # a simulated arm that cannot be followed any more
            text = f"unexpected {type(error).__name__}: {error}"
            self._machine.fault(clock.now(), "internal", text)
            time.sleep(self.period)
        self._tick(due)
        return self._punctuality.next_due(due, clock.now())

    def _tick(self, due: float | None) -> None:
        began = time.perf_counter()
        clock, machine, punctuality = self.rig.clock, self._machine, self._punctuality
        with self._requests.turn:
            now = clock.now()
            punctuality.begin(due, now)
            machine.tick(now, self._requests.serve)
            ended = clock.now()
            punctuality.end(now if due is None else due, ended, time.perf_counter() - began)
            if punctuality.overruns_in_a_row:
                machine.overran(ended, punctuality.overruns_in_a_row)
            self._snapshot = self._pictured(now)
        for listener in self._listeners:
            try:
                listener(self._snapshot)
            except Exception as error:
                self.add_alarm("listener", f"unexpected {type(error).__name__}: {error}")

    def _let_down(self, due: float) -> None:
        """Tick on until the pressures are let down, for a bounded time and number of ticks."""
        machine = self._machine
        if machine.lifecycle.armed:
            machine.carry_out(lambda now: machine.disarm(now, "stopping"))
        patience = self._ramp_time + _LAST_TRIES
        end = self.rig.clock.now() + patience
        for _ in range(math.ceil(patience / self.period)):
            if machine.vented or self.rig.clock.now() > end:
                break
            due = self._ticked(due)

    def _vent_at_the_end(self) -> None:
        with self._requests.turn:
            now = self.rig.clock.now()
            if self._machine.lifecycle.state is not State.UNCONFIGURED:
                self._machine.shut(now)
            self._snapshot = self._pictured(now)

    # Snapshot ------------------------------------------------------------------------------------

    def _pictured(self, now: float) -> Snapshot:
        """Return how things stand; a steering that cannot tell keeps nobody from knowing."""
        machine = self._machine
        limits, reading = machine.outlet.limits, machine.reading
        standing = self._nothing
        if machine.lifecycle.state is not State.UNCONFIGURED:
            try:
                standing = machine.steering.standing(now)
            except Exception as error:
                text = f"unexpected {type(error).__name__}: {error}"
                machine.fault(now, "internal", text)
        return Snapshot(
            time=now,
            state=machine.lifecycle.state,
            reason=machine.lifecycle.reason,
            commanded=machine.commanded,
            measured=reading.pressures,
            measured_time=reading.time,
            low=limits.low,
            high=limits.high,
            saturated=machine.saturated,
            samples=machine.samples,
            rejected=machine.rejected,
            alarms=machine.alarms.now,
            timing=self._punctuality.timing(),
            **vars(standing),
        )
