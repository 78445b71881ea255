"""Goals: what a program that commands now and then wants, and the outlet that keeps to it.

A control loop commands in each of its ticks and must not fall silent. A script commands once and
sleeps. Its command is a *goal*: `GoalFollower` approaches it through the safety gate, repeats it
for as long as it is valid, and then lets the pressures down and vents.
"""

from __future__ import annotations

import math
import threading
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import CommandError, DeviceError
from stiffopt.rig.interface import (
    Clock,
    PressureCommand,
    PressureLimits,
    PressureReading,
    Supply,
)
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import SafetyGate
from stiffopt.safety.outlet import Applied, let_down

__all__ = ["LONGEST", "GoalFollower", "GoalOutlet", "GoalSupply", "TickingClock"]

Array = NDArray[np.float64]

LONGEST = 3600.0
"""Seconds for which a goal may be valid: longer, nobody may be there any more."""
_LATE = 1.5  # periods after a command until it is repeated: whoever commands in each is in time
_REPEATS = 4  # of a goal, at least, within the time after which the gate finds a command too old
_EXPIRED = (
    "no command came for as long as the last one was valid, so the pressures were let down and "
    "vented; arm the supply again, and give commands a longer valid_for"
)


class GoalOutlet(Protocol):
    """Takes goals to a supply, in this process or in that of a guard."""

    limits: PressureLimits

    @property
    def armed(self) -> bool:
        """Whether commands are taken."""

    @property
    def commanded(self) -> Array:
        """The set-points (n,) that the supply has been told, in Pa."""

    @property
    def has_dump_valve(self) -> bool:
        """Whether to vent also opens a valve."""

    def check_arming(self) -> None:
        """Raise `CommandError` if this supply may never be armed."""

    def open(self) -> None:
        """Connect; the supply is vented then."""

    def close(self) -> None:
        """Vent and disconnect."""

    def arm_for_goals(self) -> None:
        """Take goals from now on."""

    def vent(self) -> None:
        """Let all pressure out at once; no goal is taken until it is armed."""

    def pursue(self, goal: PressureCommand) -> Applied:
        """Take a goal, and make the first step towards it."""

    def read(self) -> PressureReading:
        """Return the newest measured pressures."""


def check_goal(goal: PressureCommand, now: float, limits: PressureLimits) -> Array:
    """Return the pressures (n,) of a goal that may be pursued.

    Raises
    ------
    CommandError
        They are not within the limits, or the goal has expired, or is valid for too long.
    """
    if isinstance(goal.valid_for, str):
        raise CommandError("expected a number of seconds for valid_for, not text")
    if not 0 < goal.valid_for <= LONGEST:  # NaN is not either
        raise CommandError(
            f"a command must be valid for more than 0 s and at most {LONGEST:g} s, not "
            f"{goal.valid_for:g} s"
        )
    if goal.expired(now):
        raise CommandError("the command has expired; nothing was written")
    return limits.check(goal.pressures)


class GoalFollower:
    """Brings a supply to a goal and keeps it there, tick by tick, while the goal is valid.

    Whoever owns it calls `tick` when it is `due`. Any thread may call any method.

    Parameters
    ----------
    gate :
        The gate before the supply.
    period :
        Between ticks, in s.
    ramp_time :
        In which the pressures are let down once a goal has expired, in s.
    clock :
        The rig's.

    Attributes
    ----------
    due : float
        When the next tick is, on the rig's clock; inf while nothing is to be done.
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
        self._failure = ""  # of a tick, which nobody waited for

    @classmethod
    def before(cls, gate: SafetyGate, safety: Safety, period: float, clock: Clock) -> GoalFollower:
        """Return the follower for a rig, which repeats goals before the gate finds them too old."""
        often = min(period, safety.command_timeout / _REPEATS)
        return cls(gate, period=often, ramp_time=safety.ramp_time, clock=clock)

    @property
    def armed(self) -> bool:
        """Whether goals are taken."""
        return self._gate.armed

    @property
    def commanded(self) -> Array:
        """The set-points (n,) that the supply has been told, in Pa; a copy."""
        return self._told.copy()

    @property
    def has_dump_valve(self) -> bool:
        """Whether to vent also opens a valve."""
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
        """Take goals from now on; until the first one comes all set-points are 0.

        Raises
        ------
        CommandError, DeviceError
            As `SafetyGate.arm`.
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
        """Take a goal in the place of the last one, and make the first step towards it.

        Raises
        ------
        CommandError
            It is refused, and the last goal stays. So it does where the answer says `refused`.
        DeviceError
            The supply does not answer.
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
                self.due = now + _LATE * self._period
                if applied.refused:  # whoever is told so must not find the arm there later
                    self._goal, self._until, self._let_down_from = before
            return applied

    def tick(self) -> None:
        """Repeat the goal, or let the pressures down if it has expired.

        Raises
        ------
        DeviceError
            The supply does not answer.
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
        """Vent after a tick that failed, as far as that is possible; the next command tells why."""
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
        """Have nothing to do: the supply is vented."""
        self.due, self._until = math.inf, math.inf
        self._goal = self._told = self._nothing
        self._let_down_from = None
        self._why_vented = why


class GoalSupply(Supply):
    """The supply of a rig as programs see it: a command is a goal, and limits always hold.

    Commands are approached within the limits of slew and force of robot and rig, and repeated until
    they expire: a `PressureCommand` says when, plain pressures hold for 0.5 s. Then the pressures
    are let down within `Safety.ramp_time` and vented. In real time a guard process sees to that,
    which vents at once when this process ends; a simulated rig does it on its own clock.
    """

    def __init__(self, outlet: GoalOutlet, clock: Clock) -> None:
        super().__init__(clock)
        self.limits = outlet.limits
        self._outlet = outlet

    @property
    def commanded(self) -> Array:
        """The set-points (n,) that the supply has now, on their way to the goal, in Pa."""
        return self._outlet.commanded

    @property
    def armed(self) -> bool:
        """Whether commands of pressure are taken; not so after `open`, `vent` and expiry."""
        return self.is_open and self._outlet.armed

    @property
    def has_dump_valve(self) -> bool:
        """Whether `vent` also opens a valve that needs no regulator's cooperation."""
        return self._outlet.has_dump_valve

    def check_arming(self) -> None:
        """Raise `CommandError` if this supply may never be armed; it need not be open."""
        self._outlet.check_arming()

    def arm(self) -> None:
        """Take commands from now on; all set-points are 0 then.

        Raises
        ------
        CommandError
            No rate of change is set, or the supply is unprotected; see `SafetyGate.arm`.
        DeviceError
            The device did not take it; the supply is not armed.
        """
        self._must_be_open()
        self._outlet.arm_for_goals()

    def command(self, pressures: ArrayLike | PressureCommand) -> None:
        """Have the pressures go to (n,), in Pa, and stay there until the command expires.

        Raises
        ------
        CommandError
            Wrong number, not finite, out of range, expired, or the supply is not armed: nothing
            has changed.
        DeviceError
            The device or the guard does not answer.
        """
        self._pursue(pressures)

    def exchange(self, pressures: ArrayLike | PressureCommand) -> PressureReading:
        """Command as `command` does, and return the measured pressures.

        Raises
        ------
        CommandError, DeviceError
            As for `command`.
        """
        return self._pursue(pressures).reading

    def read(self) -> PressureReading:
        """Read the measured pressures.

        Raises
        ------
        DeviceError
            The device does not answer.
        """
        self._must_be_open()
        return self._outlet.read()

    def vent(self) -> None:
        """Let all pressure out at once.

        Raises
        ------
        DeviceError
            The device did not take it.
        """
        self._must_be_open()
        self._outlet.vent()

    def _pursue(self, pressures: ArrayLike | PressureCommand) -> Applied:
        self._must_be_open()
        now = self.clock.now()
        if isinstance(pressures, PressureCommand):
            goal = pressures
        else:
            goal = PressureCommand(pressures, now)
        check_goal(goal, now, self.limits)  # what is refused does not even leave this process
        applied = self._outlet.pursue(goal)
        if applied.refused:
            raise CommandError(applied.refused)
        return applied

    def _open(self) -> None:
        self._outlet.open()

    def _close(self) -> None:
        self._outlet.close()


class TickingClock(Clock):
    """The clock of a simulated rig, on which an outlet ticks while time passes.

    Parameters
    ----------
    clock :
        Lets time pass.
    follower :
        Is ticked whenever it is due.
    """

    def __init__(self, clock: Clock, follower: GoalFollower) -> None:
        self._clock, self._follower = clock, follower

    def now(self) -> float:
        """Time in s."""
        return self._clock.now()

    def sleep_until(self, moment: float) -> None:
        """Let time pass until a moment."""
        while self._follower.due < moment:
            self._clock.sleep_until(self._follower.due)
            self._tick()
        self._clock.sleep_until(moment)

    def _tick(self) -> None:
        try:
            self._follower.tick()
        except DeviceError as error:
            self._follower.fail(error)
