"""The last gate before the supply: what may harm the arm does not pass, whoever commands it."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
from stiffopt.safety.outlet import Applied
from stiffopt.safety.vent_line import guards_of

__all__ = ["DEFAULT_SLEW", "SafetyGate", "check_protection", "effective_slew", "gate_before"]

Array = NDArray[np.float64]

DEFAULT_SLEW = 5e5
"""Rate in Pa/s of a channel for which neither robot nor rig file has a limit."""
_PERIODS = 3  # a pause allows no greater step than this many periods do


class SafetyGate:
    """Passes commands on to a supply: bounds, rates, total force and age are checked here.

    A command that is malformed, not finite, out of range, expired or from the future is refused,
    and the last set-points stay. One that asks for too fast a change, or for too great a force, is
    carried out as far as it may be. Rates are limited from one write to the next: falling ones
    too, only venting is at once. A raise that would take the total force above its limit is
    shortened, in all channels by the same share; what falls always passes.

    A channel whose low limit is above 0 has no set-points between 0 and that limit: it stays at 0
    for as long as a rise from 0 to there takes, then steps to the limit.

    Parameters
    ----------
    supply :
        What is commanded; nothing else may command it while the gate is in use.
    slew :
        Greatest rate of change, one value or one per channel (n,), in Pa/s.
    safety :
        Limits of pressure, force and age.
    force_per_pressure :
        Chamber area of each channel (n,), in m^2, see `RobotDescription.channel_areas`; needed if
        `safety` limits the force.
    clock :
        The rig's.
    period :
        Time between commands, in s. A longer pause than three of them counts as three.

    Attributes
    ----------
    limits : PressureLimits
        What may be commanded: the supply's limits, tightened by those of `safety`.

    Raises
    ------
    InputError
        Something does not fit the number of channels, or is not a positive number.
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
        self._longest = _PERIODS * period
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
        self._ramp: Array  # as far as the rates have let pressures come, in Pa
        self._told: Array  # what was written: the same, but for gaps that a supply has
        self._forget(clock.now())

    @property
    def armed(self) -> bool:
        """Whether commands are taken."""
        return self._armed

    def open(self) -> None:
        """Claim the supply and connect to it, which vents it.

        Raises
        ------
        DeviceError
            Another program commands it, or it does not answer.
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

        Raises
        ------
        DeviceError
            The supply did not take it, see `PressureSupply.close`; it stays claimed, for it is
            tried again when the interpreter exits.
        """
        with self._lock:
            self._armed = False
            self.supply.close()
            self._claim.release()

    def arm(self) -> None:
        """Take commands from now on; the set-points are 0 then.

        Raises
        ------
        CommandError
            No rate of change is set, or nothing would vent the arm if this computer failed and
            the rig file does not accept that.
        DeviceError
            The supply did not take it.
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

        What is above them already may stay, and fall.

        Raises
        ------
        InputError
            They are not one finite pressure for each channel.
        """
        given = np.array(high, dtype=float)
        if given.shape != self.limits.high.shape or not np.isfinite(given).all():
            raise InputError("expected one highest pressure in Pa for each channel")
        with self._lock:
            self._task_high = np.minimum(given, self.limits.high)

    def vent(self) -> None:
        """Let all pressure out at once; no command is taken until `arm`.

        Raises
        ------
        DeviceError
            The supply did not take it: try again. `expire` does so too.
        """
        with self._lock:
            self._armed = False
            self._vent_failed = True
            self.supply.vent()
            self._vent_failed = False
            self._forget(self.clock.now())

    def expire(self, now: float) -> bool:
        """Vent if no valid command came for too long, or venting failed before; call it often.

        Parameters
        ----------
        now :
            Time on the rig's clock, in s.

        Returns
        -------
        Whether it vented.

        Raises
        ------
        DeviceError
            The supply did not take it; the next call tries again.
        """
        with self._lock:
            kept = not self._armed or now - self._valid_at <= self._timeout
            if kept and not self._vent_failed:
                return False
            self.vent()
            return True

    def read(self) -> PressureReading:
        """Return the measured pressures.

        Raises
        ------
        DeviceError
            The supply does not answer.
        """
        return self.supply.read()

    def apply(self, command: PressureCommand) -> Applied:
        """Carry out a command as far as it may be, or refuse it and say why.

        Raises
        ------
        DeviceError
            The supply does not answer; whether it has the new set-points is not known.
        """
        with self._lock:
            now = self.clock.now()
            if self.expire(now):
                return self._refused(
                    f"no command came for {self._timeout:g} s, so the supply was vented; arm it"
                )
            try:
                asked = self._checked(command, now)
            except CommandError as error:
                return self._refused(str(error))
            self._valid_at = now
            near = self._within_rate(self._within_task(asked), now)
            ramp = self._within_force(near)
            before, self._written_at = self._ramp, now
            self._ramp = np.minimum(ramp, before)  # should it fail: no more than this is there
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
            limited = told.tolist() != asked.tolist()
            return Applied(told, reading, limited, force_limited=ramp is not near)

    def _checked(self, command: PressureCommand, now: float) -> Array:
        """Return the pressures (n,) of a command that may be carried out; refuse all others."""
        if not self._armed:
            raise CommandError("the supply is vented and takes no command; arm it first")
        age = now - command.time
        if age < 0:
            raise CommandError(f"the command is from the future, by {-age:.3g} s")
        if not age <= min(command.valid_for, self._timeout):  # NaN is too old as well
            raise CommandError(f"the command has expired; it is {age:.3g} s old")
        return self.limits.check(command.pressures)

    def _within_task(self, asked: Array) -> Array:
        """Return what is nearest to `asked` (n,) and rises no higher than the task allows."""
        return np.minimum(asked, np.maximum(self._task_high, self._ramp))

    def _within_rate(self, asked: Array, now: float) -> Array:
        """Return what is nearest to `asked` (n,) that can be reached by now."""
        elapsed = min(max(now - self._written_at, 0.0), self._longest)
        reach = self._slew * elapsed
        nearest: Array = np.minimum(np.maximum(asked, self._ramp - reach), self._ramp + reach)
        if self._jumps_to_low:
            low = self.limits.low
            nearest = np.where((self._told == 0) & (low > 0), np.minimum(nearest, low), nearest)
        return nearest

    def _within_force(self, wanted: Array) -> Array:
        """Shorten what rises in a step to `wanted` (n,) so that the force keeps its limit."""
        if self._max_force is None:
            return wanted
        most = self._force(wanted)
        if most <= self._max_force:
            return wanted
        fallen = np.minimum(wanted, self._ramp)
        least = self._force(fallen)
        if most <= least:
            return wanted
        # the force is convex along the step: this share of it is never too much
        share = max(0.0, self._max_force - least) / (most - least)
        shortened: Array = fallen + share * (wanted - fallen)
        return shortened

    def _force(self, pressures: Array) -> float:
        return total_force(pressures, self._areas)

    def _writable(self, ramp: Array) -> Array:
        """Return set-points (n,) that the supply has: none between 0 and a low limit above 0."""
        if not self._jumps_to_low:
            return ramp
        return np.where((ramp > 0) & (ramp < self.limits.low), 0.0, ramp)

    def _refused(self, reason: str) -> Applied:
        return Applied(self._told, self.supply.read(), refused=reason)

    def _forget(self, now: float) -> None:
        """Begin anew with a vented supply."""
        self._ramp = self._told = np.zeros(self.limits.n)
        self._task_high = self.limits.high
        self._written_at = self._valid_at = now


def effective_slew(rig: Rig) -> Array:
    """Return the rates (n,) in Pa/s that no set-point exceeds: the rig's, or `DEFAULT_SLEW`."""
    return np.where(np.isfinite(rig.slew), rig.slew, DEFAULT_SLEW)


def gate_before(rig: Rig, safety: Safety, period: float) -> SafetyGate:
    """Return the gate before the supply of a rig of bare devices.

    Parameters
    ----------
    rig :
        Of `stiffopt.rig.assembly.make_rig`.
    safety :
        Limits of pressure, force and age.
    period :
        Time between commands, in s.
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

    Raises
    ------
    CommandError
        The supply is real and has neither a watchdog nor a dump valve.
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
    """Return positive numbers (n,), which need not be finite."""
    given = _per_channel(name, value, n)
    if not (given > 0).all():
        raise InputError(f"{name}: expected values above 0")
    return given


def _per_channel(name: str, value: ArrayLike, n: int) -> Array:
    given = np.asarray(value, dtype=float)
    if given.shape not in ((), (n,)):
        raise InputError(f"{name}: expected one value, or {n}, not an array of shape {given.shape}")
    return np.broadcast_to(given, n).copy()
