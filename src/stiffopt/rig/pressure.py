"""Pressure supplies: their commands, their limits, and how they vent."""

from __future__ import annotations

import atexit
import math
import sys
import threading
from abc import abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import CommandError, DeviceError, InputError
from stiffopt.rig.device import Clock, Device, DeviceSettings

_FLOAT = np.dtype(float)
_LOOK = 0.05  # s between checks whether another program commands the device
_SLACK = 1e-6  # of a channel's range


@dataclass(frozen=True)
class PressureLimits:
    """Lowest and highest pressure that may be commanded, for each channel.

    `low`, `high`: gauge pressures (n,), in Pa; venting (0 Pa) is always allowed.
    """

    low: Array
    high: Array
    _bounds: tuple[tuple[float, float], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            value = np.array(getattr(self, name), dtype=float)
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        if self.low.shape != self.high.shape or self.low.ndim != 1 or not len(self.low):
            raise InputError("expected one low and one high limit for each channel")
        if not np.all(np.isfinite(self.low) & np.isfinite(self.high) & (self.low <= self.high)):
            raise InputError("limits of pressure must be finite, the low one below the high one")
        bounds = tuple(zip(self.low.tolist(), self.high.tolist(), strict=True))
        object.__setattr__(self, "_bounds", bounds)

    @property
    def n(self) -> int:
        """Number of channels."""
        return len(self.low)

    def within(self, other: PressureLimits) -> PressureLimits:
        """Return the limits that allow what both allow.

        Raises `InputError`: the other has another number of channels, or leaves a channel no
        pressure.
        """
        if other.n != self.n:
            raise InputError(f"there are {self.n} channels, but limits for {other.n}")
        low, high = np.maximum(self.low, other.low), np.minimum(self.high, other.high)
        for index in np.flatnonzero(low > high):
            raise InputError(f"channel {index + 1}: its limits leave no pressure to command")
        return PressureLimits(low, high)

    @property
    def slack(self) -> Array:
        """Excess of a pressure (n,) over a limit that counts as rounding, in Pa."""
        return _SLACK * (self.high - self.low)

    def check(self, pressures: ArrayLike) -> Array:
        """Return pressures (n,) if they are permitted.

        Raises `CommandError`: wrong number, not finite or out of range; it names the channel.
        """
        within = self._copy_within(pressures)
        if within is not None:
            return within
        try:
            given = np.asarray(pressures)
        except ValueError:  # ragged
            given = np.array("")
        if given.dtype.kind not in "fiu":  # neither text nor booleans
            raise CommandError("expected one pressure in Pa for each channel")
        p = given.astype(float)
        if p.shape != self.low.shape:
            raise CommandError(f"expected {self.n} pressures, not an array of shape {p.shape}")
        for index in np.flatnonzero(~np.isfinite(p)):
            raise CommandError(f"channel {index + 1}: {p[index]} is not a finite pressure")
        slack = self.slack
        outside = (p < self.low - slack) | (p > self.high + slack)
        for index in np.flatnonzero(outside & (p != 0)):
            raise CommandError(
                f"channel {index + 1}: {p[index] * 1e-5:.6g} bar is out of range; the limits are "
                f"{self.low[index] * 1e-5:g} to {self.high[index] * 1e-5:g} bar"
            )
        return self.clamp(p)

    def clamp(self, pressures: Array) -> Array:
        """Return the nearest pressures within the limits; 0 stays; NaN and inf become 0."""
        within = self._copy_within(pressures)
        if within is not None:
            return within
        p = np.asarray(pressures, dtype=float)
        p = np.where(np.isfinite(p), p, 0.0)
        return np.where(p == 0, 0.0, np.clip(p, self.low, self.high))

    def _copy_within(self, pressures: ArrayLike) -> Array | None:
        """Return a copy of pressures (n,) that need neither refusal nor change; otherwise None.

        A quick check, since each tick makes it three times.
        """
        if type(pressures) is not np.ndarray or pressures.dtype != _FLOAT:
            return None
        if pressures.shape != self.low.shape:
            return None
        p: Array = pressures + 0.0  # turns -0 into 0; the copy cannot change during the check
        for value, (low, high) in zip(p.tolist(), self._bounds, strict=True):
            if not (low <= value <= high or value == 0):  # NaN fails too
                return None
        return p


@dataclass(frozen=True)
class PressureReading:
    """Pressures that a supply has measured.

    `time`: when it was read. `pressures`: gauge pressures (n,), in Pa; NaN where the device
    measures none.
    """

    time: float
    pressures: Array


@dataclass(frozen=True)
class PressureCommand:
    """Pressures to set, and for how long: commands expire.

    Attributes
    ----------
    pressures : array_like
        Gauge pressures (n,), in Pa.
    time : float
        When it was given.
    valid_for : float
        Time after which the command expires unless it is repeated, in s.
    """

    pressures: ArrayLike
    time: float
    valid_for: float = 0.5

    def expired(self, now: float) -> bool:
        """Return whether the command is too old, or from the future."""
        return not 0 <= now - self.time <= self.valid_for


def total_force(pressures: ArrayLike, areas: ArrayLike) -> float:
    """Return the sum of pressure (n,) times chamber area (n,), in N; a vacuum counts as 0."""
    return float(np.asarray(areas) @ np.maximum(np.asarray(pressures, dtype=float), 0.0))


class Supply(Device):
    """Interface of every object that sets and reads the pressures of the channels.

    Attributes
    ----------
    limits : limits of the commands.
    """

    limits: PressureLimits

    @property
    def n(self) -> int:
        """Number of channels."""
        return self.limits.n

    @property
    @abstractmethod
    def commanded(self) -> Array:
        """Set-points (n,) of the device, in Pa; a copy."""

    @property
    @abstractmethod
    def armed(self) -> bool:
        """Whether commands of pressure are accepted; not after `open` and `vent`."""

    @property
    @abstractmethod
    def has_dump_valve(self) -> bool:
        """Whether `vent` also opens a valve that works without the regulators."""

    def check_arming(self) -> None:
        """Raise `CommandError` if this supply may never be armed; it need not be open."""

    @abstractmethod
    def arm(self) -> None:
        """Accept commands from now on; all set-points are 0 at first.

        Raises
        ------
        CommandError
            This supply may not be armed, see `check_arming`.
        DeviceError
            The device did not accept it; the supply is not armed.
        """

    @abstractmethod
    def command(self, pressures: ArrayLike | PressureCommand) -> None:
        """Set the pressures (n,), in Pa.

        Raises
        ------
        CommandError
            Wrong number, not finite, out of range, expired, or the supply is not armed; nothing
            has changed.
        DeviceError
            The device did not accept it, or had other set-points than were last written.
        """

    @abstractmethod
    def exchange(self, pressures: ArrayLike | PressureCommand) -> PressureReading:
        """Set pressures (n,), in Pa, and read the measured ones; raises as `command`."""

    @abstractmethod
    def read(self) -> PressureReading:
        """Read the measured pressures; raise `DeviceError` if the device does not answer."""

    @abstractmethod
    def vent(self) -> None:
        """Let all pressure out at once; refuse pressures until `arm`.

        Raises
        ------
        DeviceError
            The device did not accept it.
        """


class SupplySettings(DeviceSettings):
    """Base of a supply's settings in a rig file: how to reach it, and its channels.

    A subclass has the key ``channels`` with an item for each channel of the robot. If such an item
    has ``min`` or ``max``, in Pa, no supply from `device` commands less or more, whatever its
    driver does.

    Attributes
    ----------
    simulator : for a `simulated` supply, the ``module:function`` that makes the rig of the whole
        simulated arm, see `stiffopt.rig.assembly.make_rig`.
    vents_within : for a device that always vents when commands stop, whatever the file says: the
        time until then, in s.
    """

    simulator: ClassVar[str] = ""
    vents_within: ClassVar[float] = math.inf

    @property
    def exchange_time(self) -> float:
        """Least time between two commands on a slow line, in s; 0: the line is fast."""
        return 0.0

    def device(self, limits: PressureLimits, clock: Clock | None = None) -> PressureSupply:
        """Return the supply, not yet open, limited to the range of rig and channels.

        Raises
        ------
        InputError
            Another number of channels than `limits` has, or limits that leave no pressure.
        """
        allowed = self.limits_within(limits)
        supply = self._make(allowed, clock)
        supply.restrict(allowed)
        return supply

    def limits_within(self, limits: PressureLimits) -> PressureLimits:
        """Return the limits, tightened by those of the channels and the reach of the hardware.

        Raises
        ------
        InputError
            As for `device`.
        """
        channels = getattr(self, "channels", None)
        if channels is None:
            return limits
        if len(channels) != limits.n:
            raise InputError(f"there are {len(channels)} channels, but limits for {limits.n}")
        low, high = limits.low.copy(), limits.high.copy()
        for index, channel in enumerate(channels):
            lowest, highest = self._reach(index)
            least, most = getattr(channel, "min", None), getattr(channel, "max", None)
            if not all(bound is None or np.isfinite(bound) for bound in (least, most)):
                raise InputError(f"channel {index + 1}: its limits must be finite")
            low[index] = max(low[index], lowest, -np.inf if least is None else least)
            high[index] = min(high[index], highest, np.inf if most is None else most)
            if low[index] > high[index]:
                raise InputError(f"channel {index + 1}: its limits leave no pressure to command")
        return PressureLimits(low, high)

    def measures(self, channel: int) -> bool:
        """Whether a channel (from 0) has a gauge; drivers of supplies without one override it."""
        return True

    def _make(self, limits: PressureLimits, clock: Clock | None) -> PressureSupply:
        """Return the supply, not yet open, with these limits."""
        raise NotImplementedError(f"{type(self).__name__} makes no supply")

    def _reach(self, channel: int) -> tuple[float, float]:
        """Return the lowest and highest pressure that the hardware can represent, in Pa."""
        return -np.inf, np.inf


class PressureSupply(Supply):
    """A device that sets and reads the pressures of all channels: the base of all drivers.

    No pressure that is out of range or not finite reaches a device: `command` refuses it, and
    values for the driver's `_write` are clamped once more. A supply vents when it is opened, when
    it is closed, even by an exception, and when the interpreter exits; once vented it refuses
    pressures until it is armed. Any thread may call any method.

    It knows nothing of rates, forces and other programs: `stiffopt.safety`, in front of it, handles
    those.

    Attributes
    ----------
    is_simulated : whether it cannot hurt anybody.
    has_watchdog : whether the device vents on its own when commands stop.
    has_dump_valve : whether `vent` also opens a valve that works without the regulators.
    patience : longest time of one call, in s, while the device answers within its timeout.
    """

    is_simulated: bool = False
    has_watchdog: bool = False
    has_dump_valve: bool = False
    patience: float = 1.0

    def __init__(self, limits: PressureLimits, clock: Clock | None = None) -> None:
        super().__init__(clock)
        self._limits = limits
        self._commanded: Array = np.zeros(limits.n)
        self._armed = False
        self._looked_at = 0.0  # time of the last check for another program, in s
        self._lock = threading.RLock()  # a checked command is written before anything else happens

    # hardware -------------------------------------------------------------------------------------

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Names by which the supply is claimed, so that no two programs command it; may be empty.

        A driver returns the names of its device from `stiffopt.rig.endpoints`. By default all
        supplies of a class count as one device.

        Raises
        ------
        DeviceError
            The address cannot be resolved.
        """
        return (f"{type(self).__module__}.{type(self).__qualname__}",)

    @property
    def limits(self) -> PressureLimits:
        """Limits of the commands; setting them may tighten them, but never widens them."""
        return self._limits

    @limits.setter
    def limits(self, limits: PressureLimits) -> None:
        self._limits = self._limits.within(limits)

    def restrict(self, limits: PressureLimits) -> None:
        """Tighten the limits; they are never widened again."""
        self.limits = limits

    def prepare(self) -> None:
        """Import the libraries for connecting in advance, in case it becomes urgent."""

    # commands -------------------------------------------------------------------------------------

    @property
    def commanded(self) -> Array:
        """Last written set-points (n,), in Pa; a copy."""
        return self._commanded.copy()

    def open(self) -> None:
        """Connect, and vent."""
        with self._lock:
            if self._is_open:
                return
            super().open()
            _not_known_to_be_vented.add(self)
            try:
                self.vent()
            except BaseException:
                self.close()
                raise

    def close(self) -> None:
        """Vent and disconnect.

        Raises
        ------
        DeviceError
            The device did not accept the command to vent. It is disconnected all the same, and
            venting is tried again when the interpreter exits.
        """
        with self._lock:
            if not self._is_open:
                return
            try:
                try:
                    self.vent()
                except DeviceError:
                    self.vent()  # once more
                except BaseException:  # Ctrl-C does not keep an arm under pressure
                    self.vent()
                    _not_known_to_be_vented.discard(self)
                    raise
                _not_known_to_be_vented.discard(self)
            finally:
                super().close()

    def command(self, pressures: ArrayLike | PressureCommand) -> None:
        """Set pressures (n,), in Pa, until they are set again: a device does not expire them."""
        with self._lock:
            checked = self._checked(pressures)
            self._look_for_others()
            self._write_clamped(checked)

    def exchange(self, pressures: ArrayLike | PressureCommand) -> PressureReading:
        """Set the pressures and read the measured ones, in one exchange if the device can."""
        with self._lock:
            last = self.limits.clamp(self._checked(pressures))
            self._look_for_others()
            values = self._exchange(last)
            if values is None:
                self._write_clamped(last)
                return self.read()
            self._commanded = last
            return self._reading(values)

    def read(self) -> PressureReading:
        """Read the measured pressures (n,), in Pa."""
        with self._lock:
            self._must_be_open()
            return self._reading(self._read())

    def vent(self) -> None:
        """Open the dump valve, if there is one, and set all channels to 0 Pa."""
        with self._lock:
            self._must_be_open()
            self._armed = False
            try:
                self._dump(open_valve=True)  # first: it needs no regulator
            finally:
                self._write_clamped(np.zeros(self.n))

    @property
    def armed(self) -> bool:
        """Whether commands of pressure are accepted; not after `open` and `vent`."""
        return self._armed

    def arm(self) -> None:
        """Accept commands from now on, and close the dump valve, which `vent` opens.

        All set-points are 0, written before the valve closes.
        """
        with self._lock:
            self._must_be_open()
            if not self._armed:
                self._write_clamped(np.zeros(self.n))
            self._dump(open_valve=False)
            self._armed = True
            self._looked_at = self.clock.now()

    def _reading(self, pressures: ArrayLike) -> PressureReading:
        values = np.array(pressures, dtype=float)
        if values.shape != (self.n,):
            raise DeviceError(f"the supply reads {values.size} pressures; expected {self.n}")
        return PressureReading(self.clock.now(), values)

    def _checked(self, pressures: ArrayLike | PressureCommand) -> Array:
        """Return the pressures (n,) of a command that may be carried out; refuse all others."""
        self._must_be_open()
        if isinstance(pressures, PressureCommand):
            if pressures.expired(self.clock.now()):
                raise CommandError("the command has expired; nothing was written")
            pressures = pressures.pressures
        checked = self.limits.check(pressures)
        if not self._armed and checked.any():
            raise CommandError("the supply is vented and nothing was written; arm it first")
        return checked

    def _write_clamped(self, pressures: Array) -> None:
        last = self.limits.clamp(pressures)
        self._write(last)
        self._commanded = last

    def _look_for_others(self) -> None:
        """Check now and then, before a command, that no other program commands the device."""
        now = self.clock.now()
        if self._armed and now - self._looked_at >= _LOOK:
            self._looked_at = now
            self._check_held()

    def _check_held(self) -> None:
        """Raise `DeviceError` if the device has other set-points than were last written.

        Then another program commands it, or its own watchdog has run out. Called every 50 ms before
        a command of an armed supply; a driver that can read its set-points back overrides this.
        """

    @abstractmethod
    def _write(self, pressures: Array) -> None:
        """Write set-points (n,), in Pa, and verify them by reading back if the device can."""

    @abstractmethod
    def _read(self) -> ArrayLike:
        """Return measured pressures (n,), in Pa; NaN for channels without a gauge."""

    def _exchange(self, pressures: Array) -> ArrayLike | None:
        """Write set-points and return measured pressures at once; None: the device cannot.

        With None nothing was written, and `_write` and `_read` are called instead.
        """
        return None

    def _dump(self, *, open_valve: bool) -> None:
        """Open or close the dump valve, if there is one."""


_not_known_to_be_vented: set[PressureSupply] = set()  # keeps them alive until they are vented


def vent_at_exit(supply: PressureSupply) -> None:
    """Vent a supply when the interpreter exits, because nothing could vent it so far."""
    _not_known_to_be_vented.add(supply)


@atexit.register
def _vent_all() -> None:
    for supply in list(_not_known_to_be_vented):
        try:
            supply.open()  # which vents; does nothing if it is open
            supply.close()
        except BaseException as error:  # even Ctrl-C must not keep the others from being vented
            print(f"A SUPPLY COULD NOT BE VENTED: {error}", file=sys.stderr)
