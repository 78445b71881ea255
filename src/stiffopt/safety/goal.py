"""Goals: commands that stay valid for a while, and the follower that carries them out.

A control loop commands in every tick and must not fall silent. A script commands once and sleeps.
Its command is a *goal*: `GoalFollower` approaches it through the safety gate, repeats it while it
is valid, and then lets the pressures down and vents. Programs use a `GoalSupply`; its goals go to a
follower in this process or, through a `GuardLink`, in the guard.
"""

from __future__ import annotations

import math
import threading
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import CommandError, DeviceError
from stiffopt.rig.interface import (
    Clock,
    PressureCommand,
    PressureLimits,
    PressureReading,
    Supply,
)
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import Applied, SafetyGate, let_down
from stiffopt.safety.settings import COMMANDS

if TYPE_CHECKING:
    from stiffopt.safety.guard_client import GuardLink


_EXPIRED = (
    "no command came for as long as the last one was valid, so the pressures were let down and "
    "vented; arm the supply again, and give commands a longer valid_for"
)


def check_goal(goal: PressureCommand, now: float, limits: PressureLimits) -> Array:
    """Return the pressures (n,) of a valid goal, in Pa.

    Raises `CommandError`: they are outside the limits, or the goal has expired or is valid for too
    long.
    """
    if isinstance(goal.valid_for, str):
        raise CommandError("expected a number of seconds for valid_for, not text")
    if not 0 < goal.valid_for <= COMMANDS.longest_goal:  # NaN is not either
        raise CommandError(
            "a command must be valid for more than 0 s and at most "
            f"{COMMANDS.longest_goal:g} s, not {goal.valid_for:g} s"
        )
    if goal.expired(now):
        raise CommandError("the command has expired; nothing was written")
    return limits.check(goal.pressures)


class GoalFollower:
    """Brings a supply to a goal and keeps it there, tick by tick, while the goal is valid.

    Its owner calls `tick` whenever it is `due`. Any thread may call any method.

    Parameters
    ----------
    gate : the gate in front of the supply.
    period : time between ticks, in s.
    ramp_time : duration of letting the pressures down after a goal has expired, in s.
    clock : clock of the rig.

    Attributes
    ----------
    due : time of the next tick on the rig's clock, in s; inf while there is nothing to do.
    """

    def __init__(self, gate: SafetyGate, *, period: float, ramp_time: float, clock: Clock) -> None:
        self.limits = gate.limits
        self.due = math.inf
        self._gate, self._clock = gate, clock
        self._period, self._ramp_time = period, ramp_time
        self._lock = threading.RLock()
        self._nothing: Array = np.zeros(gate.limits.n)
        self._goal: Array = self._nothing
        self._until = math.inf
        self._let_down_from: Array | None = None  # pressures when the goal expired
        self._told: Array = self._nothing
        self._why_vented = ""
        self._failure = ""  # of a tick, told to the next command

    @classmethod
    def before(cls, gate: SafetyGate, safety: Safety, period: float, clock: Clock) -> GoalFollower:
        """Return a follower that repeats goals well before they are too old for the gate."""
        often = min(period, safety.command_timeout / COMMANDS.repeats)
        return cls(gate, period=often, ramp_time=safety.ramp_time, clock=clock)

    @property
    def armed(self) -> bool:
        """Whether goals are accepted."""
        return self._gate.armed

    @property
    def commanded(self) -> Array:
        """Set-points (n,) of the supply, in Pa; a copy."""
        return self._told.copy()

    @property
    def has_dump_valve(self) -> bool:
        """Whether venting also opens a valve."""
        return self._gate.supply.has_dump_valve

    def check_arming(self) -> None:
        """Raise `CommandError` if this supply may never be armed; see `SafetyGate.arm`."""
        self._gate.check_arming()

    def open(self) -> None:
        """Connect to the supply, which vents it; see `SafetyGate.open`."""
        self._gate.open()

    def close(self) -> None:
        """Vent and disconnect; see `SafetyGate.close`."""
        with self._lock:
            self._rest("")
            self._gate.close()

    def arm_for_goals(self) -> None:
        """Accept goals from now on; all set-points are 0 until the first one.

        Raises `CommandError` or `DeviceError` as `SafetyGate.arm`.
        """
        with self._lock:
            if self._gate.armed:  # it may be under pressure, and arming begins without
                self._gate.vent()
            self._rest("")
            self._failure = ""
            self._gate.arm()
            self._goal, self._until = self._nothing, math.inf
            self.due = self._clock.now() + self._period

    def vent(self) -> None:
        """Let all pressure out at once; see `SafetyGate.vent`."""
        with self._lock:
            self._rest("")
            self._gate.vent()

    def read(self) -> PressureReading:
        """Return the measured pressures; raise `DeviceError` if the supply does not answer."""
        return self._gate.read()

    def pursue(self, goal: PressureCommand) -> Applied:
        """Replace the goal and make the first step towards the new one.

        Raises `CommandError`: the goal is refused and the last one stays, as if `Applied.refused`
        reports it; `DeviceError`: the supply does not answer.
        """
        with self._lock:
            now = self._clock.now()
            pressures = check_goal(goal, now, self.limits)
            if self._failure:
                raise DeviceError(self._failure)
            if not self._gate.armed:
                raise CommandError(
                    self._why_vented or "the supply is vented and nothing was written; arm it first"
                )
            before = self._goal, self._until, self._let_down_from
            self._goal, self._until = pressures, goal.time + goal.valid_for
            self._let_down_from = None
            try:
                applied = self._step(now, pressures)
            except DeviceError as error:
                self.fail(error)
                raise
            if self._gate.armed:
                self.due = now + COMMANDS.repeat_after * self._period
                if applied.refused:  # a refused goal must not be reached later
                    self._goal, self._until, self._let_down_from = before
            return applied

    def tick(self) -> None:
        """Repeat the goal, or let the pressures down if it has expired.

        Raises `DeviceError`: the supply does not answer.
        """
        with self._lock:
            now = self._clock.now()
            if not self._gate.armed:
                self._gate.expire(now)  # which vents again what could not be vented
                self._rest(self._why_vented)
                return
            self.due = now + self._period
            if now <= self._until:
                self._step(now, self._goal)
                return
            if self._let_down_from is None:
                self._let_down_from = self._told
            share = 1 - (now - self._until) / self._ramp_time
            if share > 0 and self._let_down_from.any():
                self._step(now, let_down(self._let_down_from, share, self.limits))
            else:
                self._gate.vent()
                self._rest(_EXPIRED)

    def fail(self, error: DeviceError) -> None:
        """Try to vent after a tick that failed; the next command raises the reason."""
        with self._lock:
            self._rest("")
            self._failure = f"{error}; the supply was vented"
            try:
                self._gate.vent()
            except DeviceError as again:
                self._failure = f"{error}; THE SUPPLY COULD NOT BE VENTED: {again}"
                self.due = self._clock.now() + self._period

    def _step(self, now: float, pressures: Array) -> Applied:
        applied = self._gate.apply(PressureCommand(pressures, now))
        if not self._gate.armed:
            self._rest(applied.refused)
        else:
            self._told = applied.pressures
        return applied

    def _rest(self, why: str) -> None:
        """Drop the goal, because the supply is vented."""
        self.due, self._until = math.inf, math.inf
        self._goal = self._told = self._nothing
        self._let_down_from = None
        self._why_vented = why


class GoalSupply(Supply):
    """The supply of a rig as programs see it: each command is a goal, and all limits apply.

    A goal is approached within the slew and force limits of robot and rig, and repeated until it
    expires: at the time that a `PressureCommand` gives, or after 0.5 s for plain pressures. Then
    the pressures are let down within `Safety.ramp_time` and vented. In real time the guard process
    does all this, and vents at once when this process ends; a simulated rig uses its own clock.

    `outlet`: accepts the goals: a follower in this process, or the link to a guard that has one.
    `clock`: clock of the rig.
    """

    def __init__(self, outlet: GoalFollower | GuardLink, clock: Clock) -> None:
        super().__init__(clock)
        self.limits = outlet.limits
        self._outlet = outlet

    @property
    def commanded(self) -> Array:
        """Present set-points (n,) on their way to the goal, in Pa."""
        return self._outlet.commanded

    @property
    def armed(self) -> bool:
        """Whether goals are accepted; not after `open`, `vent` and expiry."""
        return self.is_open and self._outlet.armed

    @property
    def has_dump_valve(self) -> bool:
        """Whether `vent` also opens a valve that works without the regulators."""
        return self._outlet.has_dump_valve

    def check_arming(self) -> None:
        """Raise `CommandError` if this supply may never be armed; it need not be open."""
        self._outlet.check_arming()

    def arm(self) -> None:
        """Accept commands from now on; all set-points are 0 at first. See `SafetyGate.arm`."""
        self._must_be_open()
        self._outlet.arm_for_goals()

    def command(self, pressures: ArrayLike | PressureCommand) -> None:
        """Bring the pressures to (n,), in Pa, and keep them until the command expires."""
        self._pursue(pressures)

    def exchange(self, pressures: ArrayLike | PressureCommand) -> PressureReading:
        """Command as `command` does, and return the measured pressures."""
        return self._pursue(pressures).reading

    def read(self) -> PressureReading:
        """Read the measured pressures (n,), in Pa."""
        self._must_be_open()
        return self._outlet.read()

    def vent(self) -> None:
        """Let all pressure out at once."""
        self._must_be_open()
        self._outlet.vent()

    def _pursue(self, pressures: ArrayLike | PressureCommand) -> Applied:
        self._must_be_open()
        now = self.clock.now()
        goal = pressures
        if not isinstance(goal, PressureCommand):
            goal = PressureCommand(goal, now)
        check_goal(goal, now, self.limits)  # an invalid goal does not leave this process
        applied = self._outlet.pursue(goal)
        if applied.refused:
            raise CommandError(applied.refused)
        return applied

    def _open(self) -> None:
        self._outlet.open()

    def _close(self) -> None:
        self._outlet.close()


class TickingClock(Clock):
    """Clock of a simulated rig that ticks a goal follower while simulated time passes.

    `clock`: clock that lets simulated time pass. `follower`: ticked whenever it is due.
    """

    def __init__(self, clock: Clock, follower: GoalFollower) -> None:
        self._clock, self._follower = clock, follower

    def now(self) -> float:
        """Time in s."""
        return self._clock.now()

    def sleep_until(self, moment: float) -> None:
        """Let simulated time pass until a moment, in s."""
        while self._follower.due < moment:
            self._clock.sleep_until(self._follower.due)
            self._tick()
        self._clock.sleep_until(moment)

    def _tick(self) -> None:
        try:
            self._follower.tick()
        except DeviceError as error:
            self._follower.fail(error)
