"""The control loop: ticks on time, serves requests from any thread, publishes snapshots."""

from __future__ import annotations

import math
import threading
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from stiffopt.control.checks import check_target, check_task, check_trajectory, refusing
from stiffopt.control.interface import Controller
from stiffopt.control.lifecycle import EventBuffer
from stiffopt.control.noticing_tuning import SupervisionTuning
from stiffopt.control.request_queue import RequestQueue, current_requester
from stiffopt.control.state import ControllerStatus, Snapshot, State, Timing
from stiffopt.control.supervisor import Supervisor
from stiffopt.control.ways import ClearanceWatch
from stiffopt.errors import CommandError, InputError
from stiffopt.model.arguments import checked_integer
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.paths.trajectory import Trajectory
from stiffopt.rig.interface import Rig
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import Outlet

_STARTING = (
    "not while unconfigured: it is still starting, connects to the rig and checks it, which takes "
    "up to a minute or so; try again when the state is inactive"
)


class ControlLoop:
    """Runs a controller on a rig, tick by tick, and keeps the arm safe.

    The loop starts unconfigured. `configure` checks the rig and leaves it inactive and vented;
    `arm` activates the controller. Every failure either holds the pressures or is a fault, which
    vents and lasts until `reset`.

    Any thread may make requests. The control thread carries them out in its next tick; while the
    loop does not run, the caller does so at once. A request returns when it has been carried out.
    A refused request raises `InputError` with the reason and changes nothing. The first
    configuration may take long; meanwhile all requests are refused at once, except `vent`, which is
    carried out.

    Parameters
    ----------
    rig : robot, tracker and clock. Only the limits of its supply are used.
    controller : the controller.
    outlet : the only way to the supply.
    safety : limits and timeouts beyond which there is a fault.
    period : time between ticks, in s.
    tuning : tuning of the supervision.
    clearance : keeps commands clear of the rig's scene; None without a scene.
    """

    def __init__(
        self,
        rig: Rig,
        controller: Controller,
        outlet: Outlet,
        *,
        safety: Safety,
        period: float,
        tuning: SupervisionTuning | None = None,
        clearance: ClearanceWatch | None = None,
    ) -> None:
        if not 0 < period < math.inf:
            raise InputError(f"the period must be above 0 s, not {period:g} s")
        self.rig = rig
        self.period = period
        tuning = tuning or SupervisionTuning()
        self._supervisor = Supervisor(rig, controller, outlet, safety, period, tuning, clearance)
        self._requests = RequestQueue()
        self._configuring = False
        self._timing = TickTiming(period)
        self._stop_time = safety.ramp_time + tuning.stop_margin
        self.events: EventBuffer = self._supervisor.events  # the latest
        self._unknown = ControllerStatus(plan=np.full(outlet.limits.n, np.nan))
        self._snapshot = self._current_snapshot(rig.clock.now())
        self._listeners: list[Callable[[Snapshot], None]] = []

    # -- requests -------------------------------------------------------------------------------

    def configure(self) -> None:
        """Connect supply and tracker, which vents, and check the rig; then it is inactive.

        A refusal names each check that failed, then its reason; several may fail.
        """
        self._check_started()
        self._configuring = True
        try:
            self._carry_out(self._supervisor.configure)
        finally:
            self._configuring = False

    def arm(self) -> None:
        """Check the vented arm and activate the controller; pressures stay until there is a task.

        The loop must have run for some time before, to learn the rhythm of the tracker. A refusal
        names the checks that failed, as that of `configure`.
        """
        requester = current_requester()  # checks may take long
        self._request(
            lambda now: self._supervisor.arm(now, lambda: requester.gone, self._timing.latest)
        )

    def disarm(self) -> None:
        """Begin to let the pressures down; after `Safety.ramp_time` it is vented and inactive."""
        self._request(self._supervisor.disarm)

    def set_task(self, task: Task) -> None:
        """Pursue a task; refused unless the loop is armed and the task valid on this rig."""
        self._check_started()
        check_task(task, self._supervisor.outlet.limits)
        self._check_ahead(task)
        self._carry_out(lambda now: self._supervisor.set_task(now, task))

    def set_target(self, target: Target) -> None:
        """Go to another target, with the stiffness goal and limits of the task, if there is one."""
        self._check_started()
        check_target(target)
        self._check_ahead(target)
        self._carry_out(lambda now: self._supervisor.set_target(now, target))

    def follow_trajectory(self, trajectory: Trajectory) -> None:
        """Follow a trajectory that begins now."""
        self._check_started()
        limits = self._supervisor.outlet.limits
        check_trajectory(trajectory, limits, self.rig.slew)
        self._check_ahead(trajectory)
        self._carry_out(lambda now: self._supervisor.follow_trajectory(now, trajectory))

    def _check_ahead(self, request: Task | Target | Trajectory) -> None:
        """Run the controller's slow checks in this thread: the control thread has to tick."""
        if self._supervisor.lifecycle.armed:  # otherwise the control thread refuses the request
            with refusing("request"):
                self._supervisor.controller.check_ahead(request)

    def set_channels(self, without: Sequence[int]) -> None:
        """Take some channels, counted from 0, out of use, and give all others back.

        The controller lets the pressure of such a channel down; plans do without it.
        """
        chosen = [checked_integer("a channel", channel, 0) for channel in without]
        self._request(lambda now: self._supervisor.controller.set_channels(chosen))

    def hold(self, reason: str = "asked to", *, lasting: bool = True) -> None:
        """Keep the pressures as they are until the next task, target or trajectory.

        A hold that is not `lasting`, because no client is left to end it, ends after
        `Safety.hold_timeout`; then the pressures are let down.
        """
        self._request(lambda now: self._supervisor.hold(now, reason, lasting=lasting))

    def vent(self, reason: str = "asked to") -> None:
        """Vent at once; the loop is inactive then, or still in fault.

        If the supply does not accept the command, `InputError` reports it. The loop is then in
        fault and repeats the command in every tick, or still unconfigured; connecting the supply
        vents it.
        """
        if self._starting:  # directly: nothing else commands the supply yet
            self._supervisor.vent_while_starting()
            return
        self._request(lambda now: self._supervisor.vent(now, reason))

    def reset(self) -> None:
        """Leave the fault and become inactive. Refused while the reason for it persists."""
        self._request(self._supervisor.reset)

    def add_alarm(self, kind: str, text: str) -> None:
        """Set an alarm that another part of the program found; it does not affect control."""
        self._supervisor.alarms.set(self.rig.clock.now(), kind, text)

    def clear_alarm(self, kind: str) -> None:
        """Clear an alarm that `add_alarm` set."""
        self._supervisor.alarms.clear(self.rig.clock.now(), kind)

    def snapshot(self) -> Snapshot:
        """Return the state at the end of the last tick."""
        return self._snapshot

    def listen(self, listener: Callable[[Snapshot], None]) -> None:
        """Call a function with the snapshot at the end of each tick, in the control thread.

        The listener must not block. An error that it raises becomes an alarm.
        """
        self._listeners.append(listener)

    @property
    def _starting(self) -> bool:
        return self._configuring and self._supervisor.lifecycle.state is State.UNCONFIGURED

    def _check_started(self) -> None:
        """Refuse a request while the loop starts, rather than carry it out much later."""
        if self._starting:
            raise CommandError(_STARTING)

    def _request(self, request: Callable[[float], None]) -> None:
        self._check_started()
        self._carry_out(request)

    def _carry_out(self, request: Callable[[float], None]) -> None:
        def carry() -> None:
            try:
                self._supervisor.carry_out(request)
            finally:
                self._snapshot = self._current_snapshot(self.rig.clock.now())

        self._requests.submit(carry)

    # -- time -----------------------------------------------------------------------------------

    def run(self, stop: threading.Event) -> None:
        """Tick until `stop` is set, then let the pressures down and vent.

        It returns within `Safety.ramp_time` and about a second, whatever the devices do, as long as
        the clock runs. It skips ticks that are overdue.
        """
        self._requests.begin()
        try:
            due = self._tick_at(self.rig.clock.now())
            while not stop.is_set():
                due = self._tick_at(due)
            self._let_down(due)
        finally:
            try:
                self._vent_at_the_end()
            finally:
                self._requests.end()

    def close(self) -> None:
        """Vent, disconnect supply and tracker, and end the controller.

        `DeviceError` if the supply does not accept the command to vent.
        """
        try:
            self._supervisor.outlet.close()
        finally:
            if self.rig.tracker is not None:
                self.rig.tracker.close()
            self._supervisor.controller.close()

    def _tick_at(self, due: float) -> float:
        """Wait until `due`, tick, and return when the next tick is due."""
        clock = self.rig.clock
        try:
            clock.sleep_until(due)
        except Exception as error:  # a simulated arm that cannot be integrated any more
            text = f"unexpected {type(error).__name__}: {error}"
            self._supervisor.fault(clock.now(), "internal", text)
            time.sleep(self.period)
        self.tick(due)
        return self._timing.next_due(due, clock.now())

    def tick(self, due: float | None = None) -> None:
        """Tick once, now; `due` is when this tick was due, in s."""
        began = time.perf_counter()
        clock, supervisor, timing = self.rig.clock, self._supervisor, self._timing
        with self._requests.turn:
            now = clock.now()
            timing.begin(due, now)
            supervisor.tick(now, self._requests.serve)
            ended = clock.now()
            timing.end(now if due is None else due, ended, time.perf_counter() - began)
            if timing.overruns_in_a_row:
                supervisor.overran(ended, timing.overruns_in_a_row)
            self._snapshot = self._current_snapshot(now)
        for listener in self._listeners:
            try:
                listener(self._snapshot)
            except Exception as error:
                self.add_alarm("listener", f"unexpected {type(error).__name__}: {error}")

    def _let_down(self, due: float) -> None:
        """Continue to tick until the pressures are down, for a limited time and number of ticks."""
        supervisor = self._supervisor
        if supervisor.lifecycle.armed:
            supervisor.carry_out(lambda now: supervisor.disarm(now, "stopping"))
        end = self.rig.clock.now() + self._stop_time
        for _ in range(math.ceil(self._stop_time / self.period)):
            if supervisor.vented or self.rig.clock.now() > end:
                break
            due = self._tick_at(due)

    def _vent_at_the_end(self) -> None:
        with self._requests.turn:
            now = self.rig.clock.now()
            if self._supervisor.lifecycle.state is not State.UNCONFIGURED:
                self._supervisor.finish(now)
            self._snapshot = self._current_snapshot(now)

    def _current_snapshot(self, now: float) -> Snapshot:
        """Return the state now; a controller that cannot report its status is a fault."""
        supervisor = self._supervisor
        limits, reading = supervisor.outlet.limits, supervisor.reading
        status = self._unknown
        if supervisor.lifecycle.state is not State.UNCONFIGURED:
            try:
                status = supervisor.controller.status(now)
            except Exception as error:
                text = f"unexpected {type(error).__name__}: {error}"
                supervisor.fault(now, "internal", text)
        return Snapshot(
            time=now,
            state=supervisor.lifecycle.state,
            reason=supervisor.lifecycle.reason,
            commanded=supervisor.commanded,
            measured=reading.pressures,
            measured_time=reading.time,
            low=limits.low,
            high=limits.high,
            saturated=supervisor.saturated,
            samples=supervisor.samples,
            rejected=supervisor.rejected,
            alarms=supervisor.alarms.now,
            timing=self._timing.statistics(),
            **vars(status),
        )


_EDGES = tuple(float(f"{m}e{e}") for e in range(-6, 0) for m in (1, 2, 5))
"""Upper edges of the histogram of lateness, in s: three per decade, 1 us to 0.5 s."""


_LATENESS_WINDOW = 30.0  # s before arming, in which the lateness of ticks counts


class TickTiming:
    """Schedule and timing statistics of ticks with a period, in s."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._lateness = [0] * (len(_EDGES) + 1)  # the last bin has no upper edge
        self._ticks = self._overruns = 0
        self._tick_time = 0.0
        # lateness of the latest ticks, in s, except of those that followed an overrun
        self._latest: deque[float] = deque(maxlen=round(_LATENESS_WINDOW / period))
        self.overruns_in_a_row = 0  # latest ticks that ended after the next one was due
        self.missed = 0  # overdue ticks that were skipped

    def begin(self, due: float | None, now: float) -> None:
        """Note when a tick begins, and when it was due, if known, in s."""
        if due is not None:
            self._lateness[bisect_left(_EDGES, now - due)] += 1
            if not self.overruns_in_a_row:
                self._latest.append(now - due)

    @property
    def latest(self) -> float:
        """Third largest lateness of recent ticks, in s, which shows how busy the computer is.

        The two largest are left out: single ticks are late when other threads here start.
        """
        return ([0.0, 0.0, 0.0, *sorted(self._latest)])[-3]

    def end(self, due: float, now: float, tick_time: float) -> None:
        """Note when a tick ends, when it was due, and how long it took, in s."""
        self._ticks += 1
        self._tick_time = tick_time
        if now > due + self._period * (1 + 1e-9):
            self._overruns += 1
            self.overruns_in_a_row += 1
        else:
            self.overruns_in_a_row = 0

    def next_due(self, due: float, now: float) -> float:
        """Return when the next tick is due, in s; skip and count ticks that are overdue."""
        due += self._period
        if due < now:
            late = int((now - due) / self._period) + 1
            self.missed += late
            due += late * self._period
        return due

    def statistics(self) -> Timing:
        """Return the statistics so far."""
        counts = tuple(self._lateness)
        return Timing(self._ticks, self._overruns, self._tick_time, _EDGES, counts)
