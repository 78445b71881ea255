"""Supplies: what sets and reads the pressures, and what no supply may do."""

from __future__ import annotations

import atexit
import sys
import threading
from abc import abstractmethod
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import CommandError, DeviceError, InputError
from stiffopt.rig.device import Clock, Device

__all__ = ["PressureCommand", "PressureLimits", "PressureReading", "PressureSupply"]

Array = NDArray[np.float64]

_FLOAT = np.dtype(float)
_SLACK = 1e-6  # of a channel's range


@dataclass(frozen=True)
class PressureLimits:
    """What may be commanded, for each channel.

    Attributes
    ----------
    low, high : ndarray
        Gauge pressures (n,), in Pa; venting (0 Pa) is always allowed.
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

    @property
    def slack(self) -> Array:
        """By how much (n,) a pressure may be beyond a limit and counts as rounded, in Pa."""
        return _SLACK * (self.high - self.low)

    def check(self, pressures: ArrayLike) -> Array:
        """Return pressures (n,) if they may be commanded.

        Raises
        ------
        CommandError
            Wrong number, not finite or out of range; it names the channel.
        """
        within = self._copy_within(pressures)
        if within is not None:
            return within
        try:
            given = np.asarray(pressures)
        except ValueError:  # ragged
            given = np.array("")
        if given.dtype.kind not in "fiu":  # text and booleans are no pressures
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
        """Return what is nearest within the limits; 0 stays, and what is not finite becomes 0."""
        within = self._copy_within(pressures)
        if within is not None:
            return within
        p = np.asarray(pressures, dtype=float)
        p = np.where(np.isfinite(p), p, 0.0)
        return np.where(p == 0, 0.0, np.clip(p, self.low, self.high))

    def _copy_within(self, pressures: ArrayLike) -> Array | None:
        """Return a copy of pressures (n,) of which nothing is to be refused or changed.

        None if that is not plain: this is what each tick does three times, and no more than that.
        """
        if type(pressures) is not np.ndarray or pressures.dtype != _FLOAT:
            return None
        if pressures.shape != self.low.shape:
            return None
        p: Array = pressures + 0.0  # makes 0 of -0; the copy is looked at, which nobody changes
        for value, (low, high) in zip(p.tolist(), self._bounds, strict=True):
            if not (low <= value <= high or value == 0):  # NaN is not either
                return None
        return p


@dataclass(frozen=True)
class PressureReading:
    """What a supply measures.

    Attributes
    ----------
    time : float
        When it was read.
    pressures : ndarray
        Gauge pressures (n,), in Pa; NaN where the device measures none.
    """

    time: float
    pressures: Array


@dataclass(frozen=True)
class PressureCommand:
    """What a supply shall do, and until when: commands expire.

    Attributes
    ----------
    pressures : ndarray
        Gauge pressures (n,), in Pa.
    time : float
        When it was given.
    valid_for : float
        Seconds after which a command that was not repeated holds no longer.
    """

    pressures: Array
    time: float
    valid_for: float = 0.5

    def expired(self, now: float) -> bool:
        """Say whether the command is too old to be carried out."""
        return not 0 <= now - self.time <= self.valid_for


class PressureSupply(Device):
    """Sets and reads the pressures of all channels.

    Nothing reaches a device that is out of range or not finite: `command` refuses it, and what is
    handed to the driver's `_write` has been clamped once more. A supply vents when it is opened,
    when it is closed, also by an exception, and when the interpreter exits; once vented it takes
    no pressure until it is armed. Any thread may call any method.
    """

    def __init__(self, limits: PressureLimits, clock: Clock | None = None) -> None:
        super().__init__(clock)
        self.limits = limits
        self._commanded: Array = np.zeros(limits.n)
        self._armed = False
        self._lock = threading.RLock()  # what was checked is written before anything else happens

    @property
    def n(self) -> int:
        """Number of channels."""
        return self.limits.n

    @property
    def commanded(self) -> Array:
        """What was last written (n,), in Pa; a copy."""
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
            The device did not take the command to vent; it is disconnected all the same, and
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
        """Set the pressures (n,), in Pa.

        Raises
        ------
        CommandError
            Wrong number, not finite, out of range, expired, or the supply is not armed: nothing
            was written.
        DeviceError
            The device did not take it.
        """
        with self._lock:
            self._write_clamped(self._checked(pressures))

    def exchange(self, pressures: ArrayLike | PressureCommand) -> PressureReading:
        """Set the pressures and read the measured ones, in one exchange where the device can.

        Raises
        ------
        CommandError
            As for `command`: nothing was written.
        DeviceError
            The device did not take it or does not answer.
        """
        with self._lock:
            last = self.limits.clamp(self._checked(pressures))
            values = self._exchange(last)
            if values is None:
                self._write_clamped(last)
                return self.read()
            self._commanded = last
            return self._reading(values)

    def read(self) -> PressureReading:
        """Read the measured pressures.

        Raises
        ------
        DeviceError
            The device does not answer.
        """
        with self._lock:
            self._must_be_open()
            return self._reading(self._read())

    def vent(self) -> None:
        """Open the dump valve, where there is one, and set all channels to 0 Pa.

        Raises
        ------
        DeviceError
            The device did not take it.
        """
        with self._lock:
            self._must_be_open()
            self._armed = False
            try:
                self._dump(open_valve=True)  # first: it needs no regulator
            finally:
                self._write_clamped(np.zeros(self.n))

    @property
    def has_dump_valve(self) -> bool:
        """Whether `vent` also opens a valve that needs no regulator's cooperation."""
        return False

    @property
    def armed(self) -> bool:
        """Whether commands of pressure are taken; not so after `open` and `vent`."""
        return self._armed

    def arm(self) -> None:
        """Take commands from now on, and close the dump valve, which `vent` opens.

        All set-points are 0 then: that was written before the valve closed.

        Raises
        ------
        DeviceError
            The device did not take it; the supply is not armed.
        """
        with self._lock:
            self._must_be_open()
            if not self._armed:
                self._write_clamped(np.zeros(self.n))
            self._dump(open_valve=False)
            self._armed = True

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

    @abstractmethod
    def _write(self, pressures: Array) -> None:
        """Write set-points (n,), in Pa, and check by reading them back where the device can."""

    @abstractmethod
    def _read(self) -> ArrayLike:
        """Return measured pressures (n,), in Pa; NaN for channels that measure none."""

    def _exchange(self, pressures: Array) -> ArrayLike | None:
        """Write set-points and return measured pressures at once; None: the device cannot.

        With None nothing was written, and `_write` and `_read` are called instead.
        """
        return None

    def _dump(self, *, open_valve: bool) -> None:
        """Open or close the dump valve, where there is one."""


_not_known_to_be_vented: set[PressureSupply] = set()  # held, so that none is forgotten


@atexit.register
def _vent_all() -> None:
    for supply in list(_not_known_to_be_vented):
        try:
            supply.open()  # which vents; does nothing if it is open
            supply.close()
        except BaseException as error:  # the other supplies must be vented too, also after Ctrl-C
            print(f"A SUPPLY COULD NOT BE VENTED: {error}", file=sys.stderr)
