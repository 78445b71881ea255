"""What the control loop does in a tick, without threads or time of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stiffopt.control.journal import Alarms, EventLog
from stiffopt.control.lifecycle import Lifecycle
from stiffopt.control.state import Severity, State
from stiffopt.control.steering import Steering
from stiffopt.control.tracker_watch import Sight, TrackerWatch
from stiffopt.errors import DeviceError, GuardTripped
from stiffopt.rig.interface import PoseSample, PressureCommand, PressureReading, Rig
from stiffopt.rig.settings import ControlSettings, Safety
from stiffopt.safety.expected_pressure import Regulation
from stiffopt.safety.gate import Outlet, let_down
from stiffopt.safety.monitors import PressureMonitor, Trouble

__all__ = ["Ticking"]

Array = NDArray[np.float64]

_CALM = 0.5  # s without a command that was too much, after which that is no alarm any more
_UNSOUND = 3  # moves in a row that are no answer, after which the pressures are held


@dataclass(frozen=True)
class _Ramp:
    """Pressures (n,) that are let down from a moment on within a duration, in s, and why."""

    begin: float
    duration: float
    pressures: Array
    reason: str

    def share(self, now: float) -> float:
        """Return what is left of the pressures at a moment: from 1 down to 0.

        A request begins its ramp while a tick is under way, and so later than that tick's `now`:
        the ramp never asks for more than it began with.
        """
        return min(max(1 - (now - self.begin) / self.duration, 0.0), 1.0)


class Ticking:
    """The loop's state, and what follows from what is measured and moved.

    One thread at a time; `now` is the time on the rig's clock, in s.

    Attributes
    ----------
    lifecycle, events, alarms :
        State and history.
    commanded : ndarray
        What the supply was last told (n,), in Pa.
    reading : PressureReading
        The latest; NaN before the first, and for what cannot be.
    samples : tuple of PoseSample
        That came since the last tick, and of these `rejected` were not believed.
    saturated : ndarray
        Channels (n,) that cannot do what they should.
    """

    def __init__(
        self, rig: Rig, steering: Steering, outlet: Outlet, safety: Safety, period: float
    ) -> None:
        self.rig, self.steering, self.outlet = rig, steering, outlet
        self._clock, self._safety = rig.clock, safety
        self.lifecycle = Lifecycle()
        self.events = EventLog()
        self.alarms = Alarms(self.events)
        control = ControlSettings() if rig.settings is None else rig.settings.control
        n = outlet.limits.n
        regulation = Regulation.slowest(rig.robot, control, n)
        self._pressures = PressureMonitor(outlet.limits, safety, regulation, rig.slew)
        self._tracker = TrackerWatch(safety, period)
        self._none: NDArray[np.bool_] = np.zeros(n, dtype=bool)
        self._flagged = self._pressures.saturated
        self._unsupervised: tuple[int, ...] = ()
        self._zero: Array = np.zeros(n)
        self.commanded: Array = self._zero
        self._asked: Array = self._zero
        self._kept: Array | None = None  # what is held
        self.reading = PressureReading(float("nan"), np.full(n, np.nan))
        self.samples: tuple[PoseSample, ...] = ()
        self.rejected = 0
        self.saturated = self._none
        self._exchanged: PressureReading | None = None  # came with the last command
        self._holds: dict[str, str] = {}
        self._ramp: _Ramp | None = None
        self._vented = True
        self._trouble: Trouble | None = None
        self._unsound = 0
        self._forced = -np.inf  # when a command was last shortened for the total force
        self._noticed: frozenset[str] = frozenset()
        self._last = self._clock.now()

    @property
    def vented(self) -> bool:
        """Whether the supply has taken the command to vent, and none of pressure since."""
        return self._vented

    # A tick --------------------------------------------------------------------------------------

    def tick(self, now: float, serve: Callable[[], None]) -> None:
        """Observe, serve requests, act; what goes wrong is a fault, never an exception."""
        if self.lifecycle.state is not State.UNCONFIGURED:
            self._guarded(self._look, now)
        serve()
        if self.lifecycle.state is not State.UNCONFIGURED:
            self._guarded(self._act, now)
            self._guarded(self._listen, now)
        self._last = self._clock.now()

    def overran(self, now: float, in_a_row: int) -> None:
        """Take in that ticks in a row took too long."""
        if self.lifecycle.armed and in_a_row >= self._safety.max_overruns:
            self.fault(now, "overruns", f"{in_a_row} ticks in a row took too long")

    def fault(self, now: float, kind: str, text: str) -> None:
        """Vent, and do nothing else until a reset."""
        if self.lifecycle.state is not State.FAULT:
            self.lifecycle.change(State.FAULT, text)
            self._holds.clear()
            self._ramp = None
            self._vented = False
            self.events.add(now, kind, text, Severity.ERROR)
        if not self._vented:
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
        except Exception as error:  # whatever it is, the next tick tries again
            self._vented = False
            self.alarms.set(
                now,
                "not-vented",
                f"the supply does not take the command to vent ({error}); it is repeated, and "
                "the device's own watchdog vents if it has one",
                Severity.ERROR,
            )
        else:
            self._vented = True
            self._told(now, self._zero)
            self.alarms.clear(now, "not-vented")
            self.alarms.clear(now, "force-limit")
        self._exchanged = None
        self._unsound = 0
        self.saturated = self._none

    def _told(self, now: float, pressures: Array) -> None:
        self.commanded = pressures
        self._pressures.tell(now, pressures)

    def _look(self, now: float) -> None:
        """Read everything, judge it, and let the steering know."""
        armed, paused = self.lifecycle.armed, now - self._last
        if armed and not paused <= self._safety.command_timeout:
            self.fault(now, "stalled", f"the loop stood still for {paused:.3g} s")
        reading, self._exchanged = self._exchanged, None
        if reading is None:
            reading = self.outlet.read()
        tracker = self.rig.tracker
        arrived: Sequence[PoseSample] = () if tracker is None else tracker.read()
        self.samples = samples = tuple(self._tracker.new(arrived)) if arrived else ()
        self._trouble = trouble = self._pressures.update(now, reading)
        if trouble is not None:
            reading = self._pressures.believable(reading)
            if self.lifecycle.state is State.FAULT:
                self.alarms.set(now, trouble.kind, trouble.text, Severity.ERROR)
            else:
                self.fault(now, trouble.kind, trouble.text)
        self.reading = reading
        seen = self.steering.observe(now, self.commanded, reading, samples)
        self.rejected = seen.rejected
        if samples and not self.lifecycle.armed:
            self._tracker.learn(now, samples)
        self._tracker.update(now, seen)
        self._warn(now)

    def _warn(self, now: float) -> None:
        """Set alarms for what is measured, and clear them."""
        pressures = self._pressures
        if pressures.saturated is not self._flagged:
            self._flagged = pressures.saturated
            text = "stays below its command: no more pressure, or a leak"
            self._warn_of(now, "saturated", np.flatnonzero(self._flagged), text)
        if pressures.unsupervised is not self._unsupervised:
            self._unsupervised = pressures.unsupervised
            text = "has no gauge: leaks and stuck regulators are not seen there"
            self._warn_of(now, "unsupervised", self._unsupervised, text)
        if self._tracker.sight(now) is Sight.SEEN:
            self.alarms.clear(now, "tracker-missing")
        else:
            self.alarms.set(now, "tracker-missing", "the tracker does not see the tip")

    def _warn_of(self, now: float, kind: str, channels: Iterable[int], text: str) -> None:
        if names := ", ".join(str(channel + 1) for channel in channels):
            self.alarms.set(now, kind, f"channel {names} {text}")
        else:
            self.alarms.clear(now, kind)

    def _act(self, now: float) -> None:
        """Command what the state asks for."""
        if self.lifecycle.state is State.FAULT and not self._vented:
            self._try_to_vent(now)
        if self.lifecycle.armed:
            self._decide(now)
        if self.lifecycle.state is State.ACTIVE:
            self._steer(now)
        elif self.lifecycle.state is State.HOLDING:
            self._keep(now)

    def _decide(self, now: float) -> None:
        """Hold, let down or go on, by what the tracker sees."""
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
            if self._holds.pop("tracker", None) is not None:
                self._resume(now)
        elif sight is Sight.MISSING:
            self._hold(now, "tracker", "the tracker does not see the tip")
        else:
            self._let_down(now, "tracker-lost", "the tracker has lost the tip")

    def _steer(self, now: float) -> None:
        move = self.steering.move(now)
        p, n = move.pressures, len(self._zero)
        if not move.sound or p.shape != (n,) or not np.isfinite(p).all():
            self._spoil(now, "the solver has no answer")
            self._command(now, self.commanded)
        elif self._command(now, p, steered=True):
            self._unsound = 0
            self.alarms.clear(now, "solver")
            self.saturated = self.saturated | move.saturated

    def _spoil(self, now: float, text: str) -> None:
        """Count moves that cannot be carried out; after some the pressures are held."""
        self._unsound += 1
        if self._unsound >= _UNSOUND:
            self.alarms.set(now, "solver", f"{text}, {self._unsound} times in a row")
            self._hold(now, "solver", text)

    def _keep(self, now: float) -> None:
        ramp = self._ramp
        if ramp is None:
            if self._kept is None:  # once: an answer that is late must not move what is held
                self._kept = np.minimum(self._asked, self.commanded)
            self._command(now, self._kept)
            return
        share = ramp.share(now)
        if not share > 1e-9:
            self._end(now, ramp.reason)
            return
        self._command(now, let_down(ramp.pressures, share, self.outlet.limits))

    def _command(self, now: float, pressures: Array, *, steered: bool = False) -> bool:
        """Hand pressures (n,) to the outlet; return whether it took them."""
        timeout = self._safety.command_timeout
        self._asked = pressures
        applied = self.outlet.apply(PressureCommand(pressures, now, timeout))
        self._told(now, applied.pressures)
        self._exchanged = applied.reading
        self.saturated = self._pressures.saturated
        if applied.refused:
            text = f"a command was refused: {applied.refused}"
            if steered:
                self._spoil(now, text)
            else:  # not even what was commanded before may be: nobody knows what is there
                self.fault(now, "refused", text)
            return False
        if applied.limited:
            self.saturated = self.saturated | (applied.pressures != pressures)
        self._warn_of_force(now, applied.force_limited)
        return True

    def _warn_of_force(self, now: float, limited: bool) -> None:
        """Let it be an alarm that commands are shortened, until for a while none was."""
        if limited:
            self._forced = now
            text = "commands are shortened: more would be above safety.max_force, the total force"
            self.alarms.set(now, "force-limit", text)
        elif now - self._forced > _CALM:
            self.alarms.clear(now, "force-limit")

    def _listen(self, now: float) -> None:
        """Make alarms and events of what the steering has to say."""
        notices = self.steering.notices()
        standing = frozenset(n.kind for n in notices if n.standing)
        for notice in notices:
            if notice.standing:
                self.alarms.set(now, notice.kind, notice.text, notice.severity)
            else:
                self.events.add(now, notice.kind, notice.text, notice.severity)
        for kind in self._noticed - standing:
            self.alarms.clear(now, kind)
        self._noticed = standing

    # Changes of state ----------------------------------------------------------------------------

    def _hold(self, now: float, kind: str, reason: str) -> None:
        if kind not in self._holds:
            self.events.add(now, f"hold-{kind}", f"pressures are held: {reason}", Severity.WARNING)
        self._holds[kind] = reason
        if self.lifecycle.state is State.ACTIVE:
            self._kept = None
            self.lifecycle.change(State.HOLDING, reason)

    def _resume(self, now: float) -> None:
        """Steer again if nothing is left that speaks against it."""
        if self._ramp is not None or self.lifecycle.state is not State.HOLDING:
            return
        if self._holds:
            self.lifecycle.reason = next(iter(self._holds.values()))
            return
        self.steering.resume(now)
        self._unsound = 0
        self.lifecycle.change(State.ACTIVE)
        self.events.add(now, "active", "steering again")

    def _let_down(self, now: float, kind: str, reason: str) -> None:
        """Begin to let the pressures down, once; what was begun is finished."""
        if self._ramp is not None:
            return
        self._ramp = _Ramp(now, self._safety.ramp_time, self.commanded, reason)
        if self.lifecycle.state is State.ACTIVE:
            self.lifecycle.change(State.HOLDING, f"letting down: {reason}")
        else:
            self.lifecycle.reason = f"letting down: {reason}"
        self.events.add(now, kind, f"pressures are let down: {reason}", Severity.WARNING)

    def _end(self, now: float, reason: str) -> None:
        """Vent, and be inactive."""
        self._holds.clear()
        self._ramp = None
        self._try_to_vent(now)
        if not self._vented:
            self.fault(now, "device", "the supply does not take the command to vent")
            return
        if self.lifecycle.armed:
            self.lifecycle.change(State.INACTIVE, reason)
            self._tracker.forget()
            self.alarms.clear(now, "solver")
        self.events.add(now, "vented", f"vented: {reason}")
