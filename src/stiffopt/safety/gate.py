"""The safety gate: every command to a supply passes its checks and limits, whoever sends it.

`Outlet` is the interface through which streams of commands reach a supply. It has two
implementations: `SafetyGate`, in front of a supply of this process, and
`stiffopt.safety.guard_client.GuardLink`, which sends commands to the guard process and its gate.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import CommandError, InputError
from stiffopt.rig.interface import (
    Clock,
    PressureCommand,
    PressureLimits,
    PressureReading,
    PressureSupply,
    Rig,
    total_force,
)
from stiffopt.rig.settings import Safety
from stiffopt.safety.claim import Claim
from stiffopt.safety.settings import COMMANDS
from stiffopt.safety.vent_line import guards_of


@dataclass(frozen=True)
class Applied:
    """Outcome of a command."""

    pressures: Array  # set-points (n,) of the supply, in Pa
    reading: PressureReading  # newest measured pressures, with the time of the measurement
    # whether the set-points differ from the command, because of its rate or force
    limited: bool = False
    refused: str = ""  # why the command was refused; empty if it was carried out
    force_limited: bool = False  # whether it was reduced because of the total force


class Outlet(Protocol):
    """Interface that passes a stream of commands to a supply, through the safety gate."""

    limits: PressureLimits

    def open(self) -> None:
        """Connect to the supply, which vents it."""

    def close(self) -> None:
        """Vent and disconnect."""

    def arm(self) -> None:
        """Accept commands from now on; set-points are 0 at first."""

    def restrict(self, high: Array) -> None:
        """Let no channel rise above a task's limits (n,), in Pa, until the next call or `arm`."""

    def vent(self) -> None:
        """Let all pressure out at once; refuse commands until `arm`."""

    def apply(self, command: PressureCommand) -> Applied:
        """Carry out a command as far as allowed; raise `DeviceError` if the supply fails."""

    def read(self) -> PressureReading:
        """Return the measured pressures; raise `DeviceError` if the supply does not answer."""


def let_down(pressures: Array, share: float | Array, limits: PressureLimits) -> Array:
    """Return the share (clipped to 0 to 1) of pressures (n,), in Pa, that is left on a ramp.

    The share is one for all channels, or (n,). A channel that would fall below a low limit above 0
    goes to 0.
    """
    down: Array = pressures * np.minimum(np.maximum(share, 0.0), 1.0)
    low = limits.low
    return np.where((low > 0) & (down < low), 0.0, down)


class SafetyGate:
    """Checks range, rate of change, total force and age of commands, and passes them to a supply.

    A command that is malformed, not finite, out of range, expired or from the future is refused,
    and the last set-points stay. A command that changes too fast, or needs too great a force, is
    carried out as far as the limits allow. Rates are limited from one write to the next, for rising
    and falling pressures alike; only venting is immediate. If a rise would take the total force
    above its limit, it is reduced by the same share in all channels; falling always passes.

    A channel whose low limit is above 0 has no set-points between 0 and that limit: it stays at 0
    for as long as a rise from 0 to the limit takes, then steps to the limit.

    Raises `InputError`: an argument does not fit the number of channels, or is not a positive
    number.

    Parameters
    ----------
    supply : the supply; nothing else may command it while the gate is in use.
    slew : greatest rate of change, one value or one per channel (n,), in Pa/s.
    safety : limits of pressure, force and age.
    force_per_pressure : chamber area of each channel (n,), in m^2, see
        `RobotDescription.channel_areas`; needed if `safety` limits the force.
    clock : clock of the rig.
    period : time between commands, in s. After a pause longer than `CommandRules.pause_periods` of
        them, a step is no larger than these periods allow.

    Attributes
    ----------
    limits : limits of the commands: the supply's, tightened by those of `safety`.
    """

    def __init__(
        self,
        supply: PressureSupply,
        *,
        slew: ArrayLike,
        safety: Safety,
        force_per_pressure: ArrayLike | None,
        clock: Clock,
        period: float = 0.01,
    ) -> None:
        self.supply = supply
        self.clock = clock
        n = supply.n
        self.limits = _tightened(supply.limits, safety)
        supply.restrict(self.limits)  # so that its driver rounds towards these
        self._slew = _positive("slew", slew, n)
        if not period > 0:
            raise InputError(f"the period must be above 0 s, not {period:g} s")
        self._longest = COMMANDS.pause_periods * period
        self._timeout = safety.command_timeout
        self._max_force = safety.max_force
        if force_per_pressure is not None:
            self._areas = _positive("force_per_pressure", force_per_pressure, n)
        elif self._max_force is not None:
            raise InputError("a limit of the force needs the chambers' areas: force_per_pressure")
        self._task_high: Array = self.limits.high
        self._jumps_to_low = bool((self.limits.low > 0).any())
        self._safety = safety
        self._claim = Claim(lambda: supply.endpoints, _who_has)
        self._lock = threading.RLock()
        self._armed = False
        self._vent_failed = False
        self._ramp: Array  # rate-limited pressures (n,), in Pa
        self._told: Array  # set-points (n,): the same, but 0 below low limits above 0
        self._forget(clock.now())

    @property
    def armed(self) -> bool:
        """Whether commands are accepted."""
        return self._armed

    def open(self) -> None:
        """Claim the supply and connect to it, which vents it.

        Raises `DeviceError`: another program commands it, or it does not answer.
        """
        with self._lock:
            self._claim.take()
            try:
                self.supply.open()
            except BaseException:
                self._claim.release()
                raise

    def close(self) -> None:
        """Vent, disconnect and give up the claim.

        Raises `DeviceError`: venting failed, see `PressureSupply.close`. The supply stays claimed,
        because closing is tried again when the interpreter exits.
        """
        with self._lock:
            self._armed = False
            self.supply.close()
            self._claim.release()

    def arm(self) -> None:
        """Accept commands from now on; the set-points are 0 at first.

        Raises `CommandError`: no rate of change is set, or nothing would vent the arm if this
        computer failed and the rig file does not accept that; `DeviceError`: the supply failed.
        """
        with self._lock:
            self.check_arming()
            self.supply.arm()
            self._forget(self.clock.now())
            self._armed = True

    def check_arming(self) -> None:
        """Raise `CommandError` if this supply may never be armed; see `arm`."""
        if not np.isfinite(self._slew).all():
            raise CommandError(
                "there is no limit to how fast pressures may rise; set safety.max_slew in the "
                "rig file, or pressure.slew in the robot file"
            )
        check_protection(self.supply, self._safety)

    def restrict(self, high: ArrayLike) -> None:
        """Let no channel rise above a task's limits (n,), in Pa, until the next call or `arm`.

        A channel that is already above its limit may stay there, or fall.

        Raises `InputError`: they are not one finite pressure for each channel.
        """
        given = np.array(high, dtype=float)
        if given.shape != self.limits.high.shape or not np.isfinite(given).all():
            raise InputError("expected one highest pressure in Pa for each channel")
        with self._lock:
            self._task_high = np.minimum(given, self.limits.high)

    def vent(self) -> None:
        """Let all pressure out at once; refuse commands until `arm`.

        Raises `DeviceError`: the supply failed: try again; `expire` does so too.
        """
        with self._lock:
            self._armed = False
            self._vent_failed = True
            self.supply.vent()
            self._vent_failed = False
            self._forget(self.clock.now())

    def expire(self, now: float) -> bool:
        """Vent if no valid command came for too long, or if venting failed before; call it often.

        `now`: time on the rig's clock, in s. Returns True if it vented. Raises `DeviceError`: the
        supply failed; the next call tries again.
        """
        with self._lock:
            kept = not self._armed or now - self._valid_at <= self._timeout
            if kept and not self._vent_failed:
                return False
            self.vent()
            return True

    def read(self) -> PressureReading:
        """Return the measured pressures; raise `DeviceError` if the supply does not answer."""
        return self.supply.read()

    def apply(self, command: PressureCommand) -> Applied:
        """Carry out a command as far as the limits allow, or refuse it.

        Raises `DeviceError`: the supply does not answer; whether it has the new set-points is
        unknown.
        """
        with self._lock:
            now = self.clock.now()
            if self.expire(now):
                return self._refused(
                    f"no command came for {self._timeout:g} s, so the supply was vented; arm it"
                )
            try:
                wanted = self._checked(command, now)
            except CommandError as error:
                return self._refused(str(error))
            self._valid_at = now
            near = self._within_rate(self._within_task(wanted), now)
            ramp = self._within_force(near)
            before, self._written_at = self._ramp, now
            self._ramp = np.minimum(
                ramp, before
            )  # the least that is certain, should the write fail
            told = self._writable(ramp)
            try:
                reading = self.supply.exchange(told)
            except CommandError as error:
                self._ramp = before
                if not self.supply.armed:  # somebody else vented it
                    self._armed = False
                    self._forget(now)
                return self._refused(str(error))
            self._ramp, self._told = ramp, told
            limited = told.tolist() != wanted.tolist()
            return Applied(told, reading, limited, force_limited=ramp is not near)

    def _checked(self, command: PressureCommand, now: float) -> Array:
        """Return the pressures (n,) of a valid command; raise `CommandError` for others."""
        if not self._armed:
            raise CommandError("the supply is vented and takes no command; arm it first")
        age = now - command.time
        if age < 0:
            raise CommandError(f"the command is from the future, by {-age:.3g} s")
        if not age <= min(command.valid_for, self._timeout):  # NaN is too old as well
            raise CommandError(f"the command has expired; it is {age:.3g} s old")
        return self.limits.check(command.pressures)

    def _within_task(self, wanted: Array) -> Array:
        """Return the pressures (n,) nearest to a command that keep the task's limits."""
        return np.minimum(wanted, np.maximum(self._task_high, self._ramp))

    def _within_rate(self, wanted: Array, now: float) -> Array:
        """Return the pressures (n,) nearest to a command that the slew limit now allows."""
        elapsed = min(max(now - self._written_at, 0.0), self._longest)
        reach = self._slew * elapsed
        nearest: Array = np.minimum(np.maximum(wanted, self._ramp - reach), self._ramp + reach)
        if self._jumps_to_low:
            low = self.limits.low
            nearest = np.where((self._told == 0) & (low > 0), np.minimum(nearest, low), nearest)
        return nearest

    def _within_force(self, wanted: Array) -> Array:
        """Reduce the rising part of a step to `wanted` (n,) so that the force keeps its limit."""
        if self._max_force is None:
            return wanted
        most = self._force(wanted)
        if most <= self._max_force:
            return wanted
        fallen = np.minimum(wanted, self._ramp)
        least = self._force(fallen)
        if most <= least:
            return wanted
        # the force is convex along the step, so this share of it never exceeds the limit
        share = max(0.0, self._max_force - least) / (most - least)
        return fallen + share * (wanted - fallen)

    def _force(self, pressures: Array) -> float:
        return total_force(pressures, self._areas)

    def _writable(self, ramp: Array) -> Array:
        """Return valid set-points (n,): none lies between 0 and a low limit above 0."""
        if not self._jumps_to_low:
            return ramp
        return np.where((ramp > 0) & (ramp < self.limits.low), 0.0, ramp)

    def _refused(self, reason: str) -> Applied:
        return Applied(self._told, self.supply.read(), refused=reason)

    def _forget(self, now: float) -> None:
        """Start over with a vented supply."""
        self._ramp = self._told = np.zeros(self.limits.n)
        self._task_high = self.limits.high
        self._written_at = self._valid_at = now


def effective_slew(rig: Rig) -> Array:
    """Return the slew limits (n,) in Pa/s; `CommandRules.default_slew` where the rig has none."""
    return np.where(np.isfinite(rig.slew), rig.slew, COMMANDS.default_slew)


def gate_before(rig: Rig, safety: Safety, period: float) -> SafetyGate:
    """Return the gate for the supply of a rig of bare devices.

    Parameters
    ----------
    rig : rig without a gate, as `stiffopt.rig.assembly.make_rig` returns it.
    safety : limits of pressure, force and age.
    period : time between commands, in s.
    """
    if not isinstance(rig.supply, PressureSupply):
        raise InputError("this rig's supply has a gate before it already")
    return SafetyGate(
        rig.supply,
        slew=effective_slew(rig),
        safety=safety,
        force_per_pressure=rig.robot.channel_areas,
        clock=rig.clock,
        period=period,
    )


def check_protection(supply: PressureSupply, safety: Safety) -> None:
    """Refuse a supply that nothing vents when this computer fails, unless that is accepted.

    Raises `CommandError`: the supply is real and has neither a watchdog nor a dump valve.
    """
    protected = supply.is_simulated or supply.has_watchdog or supply.has_dump_valve
    if not protected and safety.unprotected_supply != "accepted":
        raise CommandError(
            "this supply has neither a watchdog nor a dump valve: nothing lets the pressure out "
            "when this computer fails; name one in the rig file's supply block, or accept that "
            "with safety: {unprotected_supply: accepted}"
        )


def _who_has(endpoint: str) -> str:
    return ", ".join(guard.name for guard in guards_of(endpoint)) or "another program"


def _tightened(limits: PressureLimits, safety: Safety) -> PressureLimits:
    if safety.max_pressure is None:
        return limits
    most = _per_channel("safety.max_pressure", safety.max_pressure, limits.n)
    return PressureLimits(limits.low, np.minimum(limits.high, most))


def _positive(name: str, value: ArrayLike, n: int) -> Array:
    """Return a value per channel (n,); raise `InputError` unless all are above 0."""
    given = _per_channel(name, value, n)
    if not (given > 0).all():
        raise InputError(f"{name}: expected values above 0")
    return given


def _per_channel(name: str, value: ArrayLike, n: int) -> Array:
    given = np.asarray(value, dtype=float)
    if given.shape not in ((), (n,)):
        raise InputError(f"{name}: expected one value, or {n}, not an array of shape {given.shape}")
    return np.broadcast_to(given, n).copy()
