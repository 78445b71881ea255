"""The state machine of the control loop: the work of a tick in each state, and the transitions.

It has no threads and no clock of its own: `ControlLoop` makes its calls one at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.control.arming import (
    check_commissioned,
    check_rig,
    check_vented_arm,
    late_ticks,
    uncommissioned,
)
from stiffopt.control.checks import highest_pressures, refusing
from stiffopt.control.gauge_watch import GaugeWatch
from stiffopt.control.holding import HoldReason, Holds, Ramp, RecentCommands
from stiffopt.control.interface import Controller, ControlOutput
from stiffopt.control.lifecycle import Alarms, EventBuffer, Lifecycle
from stiffopt.control.noticing_tuning import SupervisionTuning
from stiffopt.control.state import Severity, State
from stiffopt.control.tracker_watch import Sight, TrackerWatch
from stiffopt.control.ways import ClearanceWatch
from stiffopt.errors import CommandError, DeviceError, GuardTripped, InputError, StiffoptError
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.paths.trajectory import Trajectory
from stiffopt.rig.interface import PoseSample, PressureCommand, PressureReading, Rig, SystemClock
from stiffopt.rig.settings import ControlSettings, Safety
from stiffopt.safety.expected_pressure import Regulation
from stiffopt.safety.gate import Outlet, let_down
from stiffopt.safety.monitors import PressureMonitor, Trouble
from stiffopt.safety.realtime import load_of_processors


class Supervisor:
    """Supervises a controller: state, faults, holds, letting down and venting.

    A refused request raises `InputError` with the reason and changes nothing. A failure while
    something changes is a fault. `ControlLoop` has checked the requests' arguments. `now` is the
    time on the rig's clock, in s. The `clearance` watch keeps commands clear of the scene; None
    without a scene.
    """

    def __init__(
        self,
        rig: Rig,
        controller: Controller,
        outlet: Outlet,
        safety: Safety,
        period: float,
        tuning: SupervisionTuning,
        clearance: ClearanceWatch | None = None,
    ) -> None:
        self.rig, self.controller, self.outlet = rig, controller, outlet
        self._tuning, self._clearance = tuning, clearance
        self._clock, self._safety = rig.clock, safety
        self.lifecycle = Lifecycle(in_real_time=isinstance(rig.clock, SystemClock))
        self.events = EventBuffer()
        self.alarms = Alarms(self.events)
        control = ControlSettings() if rig.settings is None else rig.settings.control
        n = outlet.limits.n
        regulation = Regulation.slowest(rig.robot, control, n)
        self._monitor = PressureMonitor(outlet.limits, safety, regulation, rig.slew)
        self._tracker = TrackerWatch(safety, period)
        self._gauges = GaugeWatch()
        self._no_channels: Flags = np.zeros(n, dtype=bool)
        self._reported_saturated = self._monitor.saturated
        self._reported_unsupervised: tuple[int, ...] = ()
        self._zero: Array = np.zeros(n)
        self.commanded: Array = self._zero  # set-points (n,) of the supply, in Pa
        self._requested: Array = self._zero  # the same before the outlet limited them
        self._recent = RecentCommands(n, period, tuning)
        self._held: Array | None = None
        self._stops = False  # whether the controller has begun to stop a doubted motion
        # the latest reading; NaN before the first one, and for implausible values
        self.reading = PressureReading(float("nan"), np.full(n, np.nan))
        self.samples: tuple[PoseSample, ...] = ()  # delivered since the last tick
        self.rejected = 0  # number of these samples that were rejected
        self.saturated = self._no_channels  # (n,) at a limit that keeps them from their goal
        self._returned_reading: PressureReading | None = None  # of the last command
        self._holds = Holds(tuning)
        self._ramp: Ramp | None = None
        self.vented = True  # the supply's last accepted command was to vent
        self._trouble: Trouble | None = None
        self._failures = 0  # of the controller, in succession
        self._leans = False  # whether the arm may touch objects of the scene
        self._force_limited_at = -np.inf
        self._alarm_kinds: frozenset[str] = frozenset()
        self._ticked_at = self._clock.now()

    # -- a tick ---------------------------------------------------------------------------------

    def tick(self, now: float, serve: Callable[[], None]) -> None:
        """Measure, serve requests, command. An error becomes a fault, never an exception."""
        if self.lifecycle.state is not State.UNCONFIGURED:
            self._guarded(self._measure, now)
        serve()
        if self.lifecycle.state is not State.UNCONFIGURED:
            self._guarded(self._actuate, now)
            self._guarded(self._report_notices, now)
        self._ticked_at = self._clock.now()

    def overran(self, now: float, in_a_row: int) -> None:
        """React to a number of successive ticks that took too long."""
        if self.lifecycle.armed and in_a_row >= self._safety.max_overruns:
            self.fault(now, "overruns", f"{in_a_row} ticks in a row took too long")

    def fault(self, now: float, kind: str, text: str) -> None:
        """Vent, and stay vented until a reset."""
        if self.lifecycle.state is not State.FAULT:
            self.lifecycle.change(State.FAULT, text)
            self._holds.clear()
            self._ramp = None
            self.vented = False
            self.events.add(now, kind, text, Severity.ERROR)
        if not self.vented:
            self._try_to_vent(now)

    def _guarded(self, action: Callable[[float], None], now: float) -> None:
        try:
            action(now)
        except GuardTripped as error:
            self.fault(now, "guard", str(error))
        except DeviceError as error:
            self.fault(now, "device", f"a device fails: {error}")
        except Exception as error:
            self.fault(now, "internal", f"unexpected {type(error).__name__}: {error}")

    def _try_to_vent(self, now: float) -> None:
        try:
            self.outlet.vent()
        except Exception as error:  # the next tick tries again, whatever the error
            self.vented = False
            self.alarms.set(
                now,
                "not-vented",
                f"the supply does not accept the command to vent ({error}); it is repeated, and "
                "the device's own watchdog vents if it has one",
                Severity.ERROR,
            )
        else:
            self.vented = True
            self._note_commanded(now, self._zero)
            self.alarms.clear(now, "not-vented")
            self.alarms.clear(now, "force-limit")
        self._returned_reading = None
        self._failures = 0
        self.saturated = self._no_channels

    def _note_commanded(self, now: float, pressures: Array) -> None:
        self.commanded = pressures
        self._recent.add(pressures)
        self._monitor.tell(now, pressures)

    def _measure(self, now: float) -> None:
        """Read pressures and tracker, check them, and pass them to the controller."""
        pause = now - self._ticked_at
        if self.lifecycle.armed and not pause <= self._safety.command_timeout:
            self.fault(now, "stalled", f"the loop stood still for {pause:.3g} s")
        reading, self._returned_reading = self._returned_reading, None
        if reading is None:
            reading = self.outlet.read()
        tracker = self.rig.tracker
        arrived: Sequence[PoseSample] = () if tracker is None else tracker.read()
        self.samples = samples = tuple(self._tracker.new(arrived)) if arrived else ()
        self._trouble = trouble = self._monitor.update(now, reading)
        if trouble is not None:
            reading = self._monitor.believable(reading)
            if self.lifecycle.state is State.FAULT:
                self.alarms.set(now, trouble.kind, trouble.text, Severity.ERROR)
            else:
                self.fault(now, trouble.kind, trouble.text)
        self.reading = reading
        seen = self.controller.observe(now, self.commanded, reading, samples)
        self.rejected = seen.rejected
        if not self.lifecycle.armed:
            self._gauges.learn(reading)
            if samples:
                self._tracker.learn(now, samples)
        self._tracker.update(now, seen)
        self._update_alarms(now)

    def _update_alarms(self, now: float) -> None:
        """Set and clear the alarms that follow from measurements."""
        monitor = self._monitor
        if monitor.saturated is not self._reported_saturated:
            self._reported_saturated = saturated = monitor.saturated
            text = "stays below its command: no more pressure, or a leak"
            self._set_channel_alarm(now, "saturated", np.flatnonzero(saturated), text)
        if monitor.unsupervised is not self._reported_unsupervised:
            self._reported_unsupervised = monitor.unsupervised
            text = "has no gauge: leaks and stuck regulators are not seen there"
            self._set_channel_alarm(now, "unsupervised", monitor.unsupervised, text)
        if self._tracker.sight(now) is Sight.SEEN:
            self.alarms.clear(now, "tracker-missing")
        else:
            self.alarms.set(now, "tracker-missing", "the tracker does not see the tip")

    def _set_channel_alarm(self, now: float, kind: str, channels: Iterable[int], text: str) -> None:
        if names := ", ".join(str(channel + 1) for channel in channels):
            self.alarms.set(now, kind, f"channel {names} {text}")
        else:
            self.alarms.clear(now, kind)

    def _actuate(self, now: float) -> None:
        """Command the pressures that the present state requires."""
        if self.lifecycle.state is State.FAULT and not self.vented:
            self._try_to_vent(now)
        if self.lifecycle.armed:
            self._check_tracker(now)
        if self.lifecycle.state is State.ACTIVE:
            self._control(now)
        elif self.lifecycle.state is State.HOLDING:
            self._hold_or_ramp(now)

    def _check_tracker(self, now: float) -> None:
        """Hold, let down or continue, by whether the tracker sees the tip."""
        if self._tracker.jumping:
            self.fault(
                now,
                "tracker-jumps",
                f"the tip seems to have jumped {self._tracker.jumps} times in a row; the tracker "
                "is disturbed, or its sensor has come off",
            )
            return
        sight = self._tracker.sight(now)
        if sight is Sight.SEEN:
            if self._holds.remove("tracker"):
                self._resume(now)
        elif sight is Sight.MISSING:
            self._hold(now, "tracker", "the tracker does not see the tip")
        else:
            self._let_down(now, "tracker-lost", "the tracker has lost the tip")

    def _control(self, now: float) -> None:
        """Command what the controller decides."""
        output = self.controller.compute(now)
        p = output.pressures
        if not output.valid or not self._makes_sense(p):
            self._count_failure(now, "the solver has no answer")
            self._command(now, self.commanded)
        elif too_near := self._too_near(output):
            self._command(now, self.commanded)
            self._hold(now, "clearance", too_near)
        elif self._command(now, p, controlled=True):
            self._failures = 0
            self.alarms.clear(now, "solver")
            self.saturated = self.saturated | output.saturated

    def _makes_sense(self, pressures: Array) -> bool:
        return pressures.shape == self._zero.shape and bool(np.isfinite(pressures).all())

    def _too_near(self, output: ControlOutput) -> str:
        """Return why a command would bring the body too near to the scene; empty if it is clear."""
        self._leans = output.leans
        if self._clearance is None or output.leans:
            return ""
        posture = output.pressures if output.posture is None else output.posture
        return self._clearance.too_near(posture)

    def _count_failure(self, now: float, text: str) -> None:
        """Count successive failures of the controller; hold the pressures after some of them."""
        self._failures += 1
        if self._failures >= self._tuning.max_failures:
            self.alarms.set(now, "solver", f"{text}, {self._failures} times in a row")
            self._hold(now, "solver", text)

    def _hold_or_ramp(self, now: float) -> None:
        """Command the held pressures, or those of the ramp."""
        self._end_a_long_hold(now)
        ramp = self._ramp
        if ramp is None:
            if self._held is None and (stopping := self._stopping_pressures(now)) is not None:
                self._command(now, stopping)
                return
            if self._held is None:  # only once: a late reading must not change them
                undo = 0.0 if self._holds.doubt is None else self._holds.doubt.undo
                stopping = self._recent.stopping(self.reading.pressures, self._requested, undo)
                self._held = self.commanded if self._stops else stopping
            self._command(now, self._held)
            return
        if not ramp.progress(now) < 1 - 1e-9:
            self._stop(now, ramp.reason)
            return
        self._command(now, let_down(ramp.pressures, ramp.share(now), self.outlet.limits))

    def _stopping_pressures(self, now: float) -> Array | None:
        """Return pressures (n,) that bring a doubted motion to rest; None where it rests."""
        if not self._holds.may_stop(now):
            return None
        pressures = self.controller.stop(now)
        if pressures is None or not self._makes_sense(pressures):
            return None
        self._stops = True
        return pressures

    def _end_a_long_hold(self, now: float) -> None:
        """Let down after `Safety.hold_timeout`, unless a client asked for the hold."""
        limit = self._safety.hold_timeout
        if self._ramp is None and (reason := self._holds.exceeded(now, limit)) is not None:
            self._let_down(now, "hold-timeout", f"held for {limit:g} s, and still: {reason}")

    def _command(self, now: float, pressures: Array, *, controlled: bool = False) -> bool:
        """Hand pressures (n,) to the outlet; return whether it accepted them."""
        timeout = self._safety.command_timeout
        self._requested = pressures
        applied = self.outlet.apply(PressureCommand(pressures, now, timeout))
        self._note_commanded(now, applied.pressures)
        self._returned_reading = applied.reading
        self.saturated = self._monitor.saturated
        if applied.refused:
            text = f"a command was refused: {applied.refused}"
            if controlled:
                self._count_failure(now, text)
            else:  # these pressures were accepted before, so the supply's state is unknown
                self.fault(now, "refused", text)
            return False
        if applied.limited:
            self.saturated = self.saturated | (applied.pressures != pressures)
        self._set_force_alarm(now, applied.force_limited)
        return True

    def _set_force_alarm(self, now: float, limited: bool) -> None:
        """Set an alarm while the limit of force reduces commands, and for a while after."""
        if limited:
            self._force_limited_at = now
            text = "commands are shortened: more would be above safety.max_force, the total force"
            self.alarms.set(now, "force-limit", text)
        elif now - self._force_limited_at > self._tuning.force_alarm:
            self.alarms.clear(now, "force-limit")

    def _report_notices(self, now: float) -> None:
        """Turn the controller's notices into alarms and events.

        An alarm that comes with an event of its kind is not reported twice.
        """
        notices = self.controller.notices()
        standing = frozenset(n.kind for n in notices if n.standing)
        told = frozenset(n.kind for n in notices if not n.standing)
        for notice in notices:
            if notice.standing:
                severity = None if notice.kind in told else notice.severity
                self.alarms.set(now, notice.kind, notice.text, severity)
            else:
                self.events.add(now, notice.kind, notice.text, notice.severity)
            if notice.hold and self.lifecycle.armed and self._holds.doubt is None:
                self._hold(now, "doubt", notice.text, undo=notice.undo)
                if self._holds.doubted(now):
                    self._let_down(now, "doubt-again", f"again: {notice.text}")
        for kind in self._alarm_kinds - standing:
            self.alarms.clear(now, kind)
        self._alarm_kinds = standing

    # -- transitions --------------------------------------------------------------------------

    def _hold(
        self, now: float, kind: str, reason: str, *, lasting: bool = False, undo: float = 0.0
    ) -> None:
        if self._holds.add(now, kind, HoldReason(reason, lasting, undo)):
            self.events.add(now, f"hold-{kind}", f"pressures are held: {reason}", Severity.WARNING)
        if self.lifecycle.state is State.ACTIVE:
            self._held, self._stops = None, False
            self.lifecycle.change(State.HOLDING, reason)

    def _resume(self, now: float) -> None:
        """Control again if no reason to hold remains."""
        if self._ramp is not None or self.lifecycle.state is not State.HOLDING:
            return
        if (reason := self._holds.reason) is not None:
            self.lifecycle.reason = reason
            return
        self.controller.resume(now)
        self._failures = 0
        self.lifecycle.change(State.ACTIVE)
        self.events.add(now, "active", "steering again")

    def _let_down(self, now: float, kind: str, reason: str) -> None:
        """Begin to let the pressures down, unless a ramp is under way."""
        if self._ramp is not None:
            return
        stages, warning = np.array([self._zero + 1, self._zero]), ""
        if self._clearance is not None and not self._leans:  # a braced arm scales all together
            stages, warning = self._clearance.way_down(self.commanded)
        self._ramp = Ramp(now, self._safety.ramp_time, self.commanded, reason, stages)
        if self.lifecycle.state is State.ACTIVE:
            self.lifecycle.change(State.HOLDING, f"letting down: {reason}")
        else:
            self.lifecycle.reason = f"letting down: {reason}"
        self.events.add(now, kind, f"pressures are let down: {reason}", Severity.WARNING)
        if warning:
            self.events.add(
                now, "way-down", f"{warning}; they are let down all the same", Severity.WARNING
            )

    def _stop(self, now: float, reason: str) -> None:
        """Vent and become inactive."""
        self._holds.clear()
        self._ramp = None
        self._try_to_vent(now)
        if not self.vented:
            self.fault(now, "device", "the supply does not accept the command to vent")
            return
        if self.lifecycle.armed:
            self.lifecycle.change(State.INACTIVE, reason)
            self._tracker.forget()
            self.alarms.clear(now, "solver")
        self.events.add(now, "vented", f"vented: {reason}")

    # -- requests -------------------------------------------------------------------------------

    def carry_out(self, request: Callable[[float], None]) -> None:
        """Carry out a request; errors are raised as `InputError`."""
        now = self._clock.now()
        try:
            request(now)
        except InputError:
            raise
        except StiffoptError as error:
            raise CommandError(str(error)) from error
        except Exception as error:
            self.fault(now, "internal", f"unexpected {type(error).__name__}: {error}")
            raise CommandError(self.lifecycle.reason) from error

    def configure(self, now: float) -> None:
        """Connect and check; see `ControlLoop.configure`."""
        self.lifecycle.permit("configure")
        with refusing("configuration"):
            try:
                if self.rig.tracker is not None:
                    self.rig.tracker.open()
                self.outlet.open()
                problems = list(check_rig(self.rig, self.outlet, self.controller))
                if self._clearance is not None:
                    self._clearance.prepare()
                reading = self.outlet.read()  # after the checks, which may compile the model
            except StiffoptError as error:
                raise CommandError(f"devices: {error}") from error
            trouble = self._monitor.implausible(self._clock.now(), reading)
        if trouble is not None:
            problems.append(f"pressures: {trouble.text}")
        if problems:
            raise CommandError("; ".join(problems))
        if self.lifecycle.state is State.UNCONFIGURED:
            self.controller.begin(self._clock.now())
            self.lifecycle.change(State.INACTIVE)
            self.events.add(self._clock.now(), "configured", "everything answers; vented")

    def arm(
        self, now: float, unwanted: Callable[[], bool] = lambda: False, lateness: float = 0.0
    ) -> None:
        """Check the arm and arm it; see `ControlLoop.arm`.

        After the checks, `unwanted` says whether the client has given up. `lateness` is how late
        ticks began lately, in s.
        """
        self.lifecycle.permit("arm")
        with refusing("arming"):
            reading = self.outlet.read()
            problems = list(check_rig(self.rig, self.outlet, self.controller))
            problems += check_vented_arm(
                now, self.rig, self.controller, self._monitor, reading, self._tracker,
                self._tuning.vented_offset,
            )  # fmt: skip
            problems += check_commissioned(self.rig, self._gauges, self._tracker, reading)
            unknown = ""
            if not problems:
                unknown = uncommissioned(now, self.rig, self.controller, self._tracker)
            load = load_of_processors() if self.lifecycle.in_real_time else 0.0
            late = late_ticks(lateness, self._safety.guard_timeout, load)
            if lateness >= self._safety.guard_timeout:
                problems.append(late)
        if problems:
            raise CommandError("; ".join(problems))
        if unwanted():
            raise CommandError("the checks took longer than the client waited; arm again")
        now = self._clock.now()  # checks take time
        self.vented = False
        try:
            self.outlet.arm()
            self.controller.begin(now)
            if self._clearance is not None:
                self._clearance.begin()
        except BaseException as error:
            self._try_to_vent(now)
            if not self.vented:
                self.fault(now, "device", f"the supply could not be armed: {error}")
            raise
        self._note_commanded(now, self._zero)
        self._monitor.clear()
        self._gauges.forget()
        self._tracker.begin(now)
        self._returned_reading, self._failures, self._ticked_at = None, 0, now
        self._holds.forget()
        self._leans = False
        self.lifecycle.change(State.ACTIVE)
        self.events.add(now, "armed", "armed: pressures may change from now on")
        if late:
            self.events.add(now, "timing", late, Severity.WARNING)
        if unknown:
            self.events.add(now, "uncommissioned", unknown, Severity.WARNING)

    def disarm(self, now: float, reason: str = "disarmed") -> None:
        """Begin to let down; see `ControlLoop.disarm`."""
        self.lifecycle.permit("disarm")
        if self.lifecycle.armed:
            self._let_down(now, "disarming", reason)

    def set_task(self, now: float, task: Task) -> None:
        """Pursue a task; see `ControlLoop.set_task`."""
        self._permit_motion("set a task")
        highest = highest_pressures(task, self.outlet.limits)
        self.controller.set_task(task)
        self._recent.forget()
        try:
            self.outlet.restrict(highest)
        except DeviceError as error:  # the controller has the task, but the gate does not
            self.fault(now, "device", f"a device fails: {error}")
            raise
        self._go_on(now, "task", "there is a new task")

    def set_target(self, now: float, target: Target) -> None:
        """Go to a target; see `ControlLoop.set_target`."""
        self._permit_motion("set a target")
        self.controller.set_target(target)
        self._go_on(now, "target", "")  # targets may come in a stream: no event for each

    def follow_trajectory(self, now: float, trajectory: Trajectory) -> None:
        """Follow a trajectory; see `ControlLoop.follow_trajectory`."""
        self._permit_motion("follow a trajectory")
        self.controller.follow(trajectory, now)
        self._go_on(now, "trajectory", "there is a new trajectory")

    def _permit_motion(self, request: str) -> None:
        self.lifecycle.permit(request)
        if self._ramp is not None:
            raise CommandError(f"cannot {request} while {self.lifecycle.reason}; arm again then")

    def _go_on(self, now: float, event: str, text: str) -> None:
        if text:
            self.events.add(now, event, text)
        self._holds.remove("asked", "solver", "clearance")
        if event != "target":  # a stream of targets must not end a doubt
            self._holds.remove("doubt")
        try:
            self._resume(now)
        except Exception as error:  # too late to refuse: the request is already pursued
            self.fault(now, "internal", f"unexpected {type(error).__name__}: {error}")
            raise CommandError(self.lifecycle.reason) from error

    def hold(self, now: float, reason: str, *, lasting: bool = True) -> None:
        """Keep the pressures; see `ControlLoop.hold`."""
        self._permit_motion("hold")
        if not isinstance(reason, str):
            raise CommandError(f"expected text as the reason, not {type(reason).__name__}")
        self._hold(now, "asked", reason, lasting=lasting)
        self.lifecycle.reason = reason

    def vent(self, now: float, reason: str) -> None:
        """Vent at once; see `ControlLoop.vent`."""
        if self.lifecycle.state is State.UNCONFIGURED:
            self.outlet.vent()
        else:
            self._stop(now, reason)
            if not self.vented:
                raise CommandError(self.lifecycle.reason)

    def vent_while_starting(self) -> None:
        """Vent while another thread configures; the configuration continues."""
        try:
            self.outlet.vent()
        except StiffoptError as error:
            raise CommandError(
                f"it is still starting, and the supply cannot be told to vent now ({error}); it is "
                "vented when it is connected"
            ) from error

    def finish(self, now: float) -> None:
        """Vent for good, in several attempts if necessary."""
        for _ in range(self._tuning.vent_attempts):
            if self.lifecycle.armed or not self.vented:
                self._stop(now, "stopped")

    def reset(self, now: float) -> None:
        """Leave a fault whose reason has gone; see `ControlLoop.reset`."""
        self.lifecycle.permit("reset")
        left = ""
        try:
            self.outlet.vent()
            self.vented = True
            self._note_commanded(now, self._zero)
            self.alarms.clear(now, "not-vented")
            self._measure(now)
        except Exception as error:  # in a tick this would be a fault
            left = str(error)
        if not left:
            trouble = self._trouble
            left = self._monitor.under_pressure(self.reading) if trouble is None else trouble.text
        if not left and self._tracker.jumping:
            left = "the tip still seems to jump"
        if left:
            raise CommandError(f"the reason for the fault is still there: {left}")
        self._monitor.clear()
        for kind in ("pressure-reading", "leak", "regulator-stuck", "solver"):
            self.alarms.clear(now, kind)
        self._tracker.forget()
        self.controller.begin(now)
        self.lifecycle.change(State.INACTIVE)
        self.events.add(now, "reset", "reset after a fault; vented")
