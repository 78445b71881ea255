"""The one interface to pressure, tracking and force, in front of real and simulated devices alike.

A supply sets and reads the pressures of the channels, a tracker tells where the tip is, a probe
pushes on the tip and feels the force. What all devices of a kind must do (refuse, clamp, vent,
check, register) is done here, once; a driver only moves data, in the methods that begin with an
underscore. Everything is in SI: Pa (gauge), m, N, s; poses are those of the tip in the base frame.

All times are seconds on the clock of the rig, which never jumps.
"""

from __future__ import annotations

import atexit
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import CommandError, DeviceError, InputError
from stiffopt.model.description import RobotDescription
from stiffopt.rig.registration import Registration

if TYPE_CHECKING:
    from stiffopt.rig.config import RigDescription

__all__ = [
    "Clock",
    "Device",
    "ForceProbe",
    "ForceSample",
    "Observation",
    "PoseSample",
    "PoseTracker",
    "PressureCommand",
    "PressureLimits",
    "PressureReading",
    "PressureSupply",
    "RawPose",
    "Rig",
    "SystemClock",
]

Array = NDArray[np.float64]

_QUEUED = 4096  # samples that a tracker keeps until they are read; the oldest go first
_NORM_SLACK = 0.05  # by which the norm of a tracker's quaternion may differ from 1


class Clock(ABC):
    """The time of a rig."""

    @abstractmethod
    def now(self) -> float:
        """Time in s; it only grows."""

    @abstractmethod
    def sleep_until(self, moment: float) -> None:
        """Return when `now` has reached `moment`."""

    def sleep(self, duration: float) -> None:
        """Let a duration in s pass."""
        self.sleep_until(self.now() + duration)


class SystemClock(Clock):
    """Real time; changes of the wall clock do not touch it."""

    def now(self) -> float:
        """Time in s since some moment in the past."""
        return time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Sleep until a moment."""
        remaining = moment - time.monotonic()
        if remaining > 0:
            time.sleep(remaining)


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

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            value = np.array(getattr(self, name), dtype=float)
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        if self.low.shape != self.high.shape or self.low.ndim != 1 or not len(self.low):
            raise InputError("expected one low and one high limit for each channel")
        if not np.all(np.isfinite(self.low) & np.isfinite(self.high) & (self.low <= self.high)):
            raise InputError("limits of pressure must be finite, the low one below the high one")

    @property
    def n(self) -> int:
        """Number of channels."""
        return len(self.low)

    def check(self, pressures: ArrayLike) -> Array:
        """Return pressures (n,) if they may be commanded.

        Raises
        ------
        CommandError
            Wrong number, not finite or out of range; it names the channel.
        """
        try:
            p = np.array(pressures, dtype=float)
        except (TypeError, ValueError):
            raise CommandError("expected one pressure in Pa for each channel") from None
        if p.shape != self.low.shape:
            raise CommandError(f"expected {self.n} pressures, not an array of shape {p.shape}")
        for index in np.flatnonzero(~np.isfinite(p)):
            raise CommandError(f"channel {index + 1}: {p[index]} is not a finite pressure")
        slack = 1e-6 * (self.high - self.low)
        outside = (p < self.low - slack) | (p > self.high + slack)
        for index in np.flatnonzero(outside & (p != 0)):
            raise CommandError(
                f"channel {index + 1}: {p[index] * 1e-5:.6g} bar is out of range; the limits are "
                f"{self.low[index] * 1e-5:g} to {self.high[index] * 1e-5:g} bar"
            )
        return self.clamp(p)

    def clamp(self, pressures: Array) -> Array:
        """Return what is nearest within the limits; 0 stays, and what is not finite becomes 0."""
        p = np.asarray(pressures, dtype=float)
        p = np.where(np.isfinite(p), p, 0.0)
        return np.where(p == 0, 0.0, np.clip(p, self.low, self.high))


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


@dataclass(frozen=True)
class PoseSample:
    """The pose of the tip in the base frame, as tracked.

    Attributes
    ----------
    time : float
        When it was captured (not when it arrived).
    received : float
        When it arrived.
    frame : int
        The tracker's frame number.
    position : ndarray
        (3,), in m; NaN where the tool was not seen.
    quaternion : ndarray or None
        (4,), w first, w >= 0; None from trackers of position alone.
    """

    time: float
    received: float
    frame: int
    position: Array
    quaternion: Array | None

    @property
    def visible(self) -> bool:
        """Whether the tool was seen."""
        return bool(np.isfinite(self.position).all())


@dataclass(frozen=True)
class RawPose:
    """What a tracker's driver hands over: the sensor in the tracker's frame.

    Attributes
    ----------
    time : float
        When it was captured, on the rig's clock.
    frame : int
        The device's frame number, or a count.
    position : ndarray
        (3,), in m; anything not finite means that the tool was not seen.
    quaternion : ndarray or None
        (4,), w first, of any sign.
    received : float or None
        When it arrived, if not just now.
    """

    time: float
    frame: int
    position: ArrayLike
    quaternion: ArrayLike | None = None
    received: float | None = None


@dataclass(frozen=True)
class ForceSample:
    """What a probe feels.

    Attributes
    ----------
    time : float
        When it was read.
    force : float
        Force with which the probe pushes the tip along its axis, in N.
    position : float
        Place of the probe along its axis, in m.
    """

    time: float
    force: float
    position: float


@dataclass(frozen=True)
class Observation:
    """Everything that is new on a rig.

    Attributes
    ----------
    time : float
        When it was put together.
    pressure : PressureReading
        The latest reading.
    poses : tuple of PoseSample
        What the tracker has delivered since the last observation, in order of arrival.
    """

    time: float
    pressure: PressureReading
    poses: tuple[PoseSample, ...] = field(default=())


class Device(ABC):
    """Something that is opened once, used and closed.

    A driver's `_open` must leave nothing open when it raises.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        self.clock = clock or SystemClock()
        self._is_open = False

    @property
    def is_open(self) -> bool:
        """Whether the device may be used."""
        return self._is_open

    def open(self) -> None:
        """Connect to the device.

        Raises
        ------
        DeviceError
            It does not answer, or not as expected.
        MissingExtraError
            The library that speaks to it is not installed.
        """
        if not self._is_open:
            self._open()
            self._is_open = True

    def close(self) -> None:
        """Disconnect; to close what is closed does nothing."""
        if self._is_open:
            self._is_open = False
            self._close()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _must_be_open(self) -> None:
        if not self._is_open:
            raise DeviceError(f"{type(self).__name__} is not open")

    @abstractmethod
    def _open(self) -> None:
        """Connect."""

    @abstractmethod
    def _close(self) -> None:
        """Disconnect, whatever state the device is in; raise nothing."""


class PressureSupply(Device):
    """Sets and reads the pressures of all channels.

    Nothing reaches a device that is out of range or not finite: `command` refuses it, and what is
    handed to the driver's `_write` has been clamped once more. A supply vents when it is opened,
    when it is closed, also by an exception, and when the interpreter exits.
    """

    def __init__(self, limits: PressureLimits, clock: Clock | None = None) -> None:
        super().__init__(clock)
        self.limits = limits
        self.commanded: Array = np.zeros(limits.n)
        """What was last written (n,), in Pa."""
        self._valve_open = False

    @property
    def n(self) -> int:
        """Number of channels."""
        return self.limits.n

    def open(self) -> None:
        """Connect, and vent."""
        if self._is_open:
            return
        super().open()
        _open_supplies.add(self)
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
            The device did not take the command to vent; it is disconnected all the same.
        """
        if not self._is_open:
            return
        try:
            self.vent()
        finally:
            _open_supplies.discard(self)
            super().close()

    def command(self, pressures: ArrayLike | PressureCommand) -> None:
        """Set the pressures (n,), in Pa.

        Raises
        ------
        CommandError
            Wrong number, not finite, out of range or expired: nothing was written.
        DeviceError
            The device did not take it.
        """
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
        last = self.limits.clamp(self._checked(pressures))
        values = self._exchange(last)
        if values is None:
            self._write_clamped(last)
            return self.read()
        self.commanded = last
        return self._reading(values)

    def read(self) -> PressureReading:
        """Read the measured pressures.

        Raises
        ------
        DeviceError
            The device does not answer.
        """
        self._must_be_open()
        return self._reading(self._read())

    def _reading(self, pressures: ArrayLike) -> PressureReading:
        values = np.array(pressures, dtype=float)
        if values.shape != (self.n,):
            raise DeviceError(f"the supply reads {values.size} pressures; expected {self.n}")
        return PressureReading(self.clock.now(), values)

    def vent(self) -> None:
        """Set all channels to 0 Pa and, where there is a dump valve, open it.

        Raises
        ------
        DeviceError
            The device did not take it.
        """
        self._must_be_open()
        try:
            self._write_clamped(np.zeros(self.n))
        finally:
            self._valve_open = self.has_dump_valve
            self._dump(open_valve=True)

    @property
    def has_dump_valve(self) -> bool:
        """Whether `vent` also opens a valve that needs no regulator's cooperation."""
        return False

    def arm(self) -> None:
        """Close the dump valve, which `vent` opens: until then commands are refused.

        Without a valve this does nothing.
        """
        self._must_be_open()
        self._dump(open_valve=False)
        self._valve_open = False

    def _checked(self, pressures: ArrayLike | PressureCommand) -> Array:
        """Return the pressures (n,) of a command that may be carried out; refuse all others."""
        self._must_be_open()
        if isinstance(pressures, PressureCommand):
            if pressures.expired(self.clock.now()):
                raise CommandError("the command has expired; nothing was written")
            pressures = pressures.pressures
        checked = self.limits.check(pressures)
        if self._valve_open and checked.any():
            raise CommandError("the dump valve is open and nothing was written; arm the supply")
        return checked

    def _write_clamped(self, pressures: Array) -> None:
        last = self.limits.clamp(pressures)
        self._write(last)
        self.commanded = last

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


_open_supplies: set[PressureSupply] = set()  # held, so that none is forgotten while it is open


@atexit.register
def _vent_what_is_open() -> None:
    for supply in list(_open_supplies):
        try:
            supply.close()
        except Exception as error:  # the other supplies must be vented too
            print(f"a supply could not be vented: {error}")


class PoseTracker(Device):
    """Tells where the tip is.

    A driver calls `_deliver` with what the device sends, from whatever thread; registration, signs
    and sense are seen to here. `read` never waits for the device: a silent device delivers
    nothing, and only the age of the latest sample tells.
    """

    def __init__(
        self, registration: Registration | None = None, clock: Clock | None = None
    ) -> None:
        super().__init__(clock)
        self.registration = registration or Registration()
        self._arrived: deque[PoseSample] = deque(maxlen=_QUEUED)
        self._latest: PoseSample | None = None
        self._latest_visible: PoseSample | None = None

    def read(self) -> tuple[PoseSample, ...]:
        """Return the samples that have arrived since the last call, in order of arrival."""
        self._must_be_open()
        self._poll()
        samples = []
        while self._arrived:
            samples.append(self._arrived.popleft())
        return tuple(samples)

    @property
    def latest(self) -> PoseSample | None:
        """The sample that arrived last."""
        self._poll()
        return self._latest

    def age(self) -> float:
        """Seconds since the latest capture that saw the tool; infinite before the first."""
        self._poll()
        latest = self._latest_visible
        return self.clock.now() - latest.time if latest else float("inf")

    def _poll(self) -> None:
        """Deliver what has arrived, in drivers that have no thread to do so."""

    def _deliver(self, raw: RawPose) -> None:
        """Register a sample of the device and queue it."""
        sample = self._registered(raw)
        self._arrived.append(sample)
        self._latest = sample
        if sample.visible:
            self._latest_visible = sample

    def _registered(self, raw: RawPose) -> PoseSample:
        received = self.clock.now() if raw.received is None else raw.received
        position = np.array(raw.position, dtype=float).reshape(-1)
        quaternion = None
        seen = position.shape == (3,) and bool(np.isfinite(position).all())
        if raw.quaternion is not None:
            quaternion = np.array(raw.quaternion, dtype=float).reshape(-1)
            norm = float(np.linalg.norm(quaternion)) if quaternion.shape == (4,) else np.nan
            seen = seen and bool(abs(norm - 1) <= _NORM_SLACK)  # NaN is not seen either
            quaternion = quaternion / norm if seen else None
        if not seen:
            nowhere = np.full(3, np.nan)
            return PoseSample(raw.time, received, raw.frame, nowhere, None)
        position, quaternion = self.registration.tip_in_base(position, quaternion)
        return PoseSample(raw.time, received, raw.frame, position, quaternion)


class ForceProbe(Device):
    """Pushes on the tip along one axis and feels the force."""

    @abstractmethod
    def align(self, direction: Iterable[float]) -> None:
        """Make a unit vector (3,) in the base frame the axis; on a real rig, ask that it be done.

        The probe is then at position 0, just clear of the tip.
        """

    @abstractmethod
    def move_to(self, position: float, speed: float) -> None:
        """Move to a place along the axis, in m, at a speed in m/s, and return when there."""

    def withdraw(self) -> None:
        """Take the probe out of the arm's way; on a real rig, ask that it be done.

        It has to be aligned before it is used again.
        """

    @abstractmethod
    def stop(self) -> None:
        """Stop at once."""

    @abstractmethod
    def sample(self) -> ForceSample:
        """Read force and position."""


class Rig:
    """An arm with its devices, real or simulated: what controllers and experiments see.

    Parameters
    ----------
    robot :
        What the arm is believed to be.
    supply, tracker, probe :
        The devices; a tracker and a probe need not be there.
    clock :
        Of all of them. Time passes only through it: a simulated rig moves while one sleeps.
    slew :
        Greatest rate of change of a command (n,), in Pa/s, that whoever commands must keep.
    settings :
        The `RigDescription` that the rig was made from, if it was.
    """

    def __init__(
        self,
        robot: RobotDescription,
        supply: PressureSupply,
        tracker: PoseTracker | None = None,
        probe: ForceProbe | None = None,
        *,
        clock: Clock | None = None,
        slew: ArrayLike | None = None,
        settings: RigDescription | None = None,
    ) -> None:
        self.robot = robot
        self.supply = supply
        self.tracker = tracker
        self.probe = probe
        self.clock = clock or SystemClock()
        self.settings = settings
        self.slew = np.broadcast_to(np.inf if slew is None else np.asarray(slew), supply.n)

    @property
    def devices(self) -> tuple[Device, ...]:
        """All devices; the supply comes last, so that nothing moves before the rest is there."""
        return tuple(d for d in (self.tracker, self.probe, self.supply) if d is not None)

    def open(self) -> None:
        """Open all devices; if one fails, close the others.

        Raises
        ------
        DeviceError
            A device does not answer.
        MissingExtraError
            The library that speaks to it is not installed.
        """
        with ExitStack() as opened:
            for device in self.devices:
                opened.enter_context(device)
            opened.pop_all()

    def close(self) -> None:
        """Vent, then close all devices, also those after one that fails."""
        with ExitStack() as stack:
            for device in self.devices:
                stack.callback(device.close)

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def observe(self) -> Observation:
        """Read the pressures and collect what the tracker has delivered since the last call.

        Raises
        ------
        DeviceError
            The supply does not answer.
        """
        pressure = self.supply.read()
        poses = self.tracker.read() if self.tracker is not None else ()
        return Observation(self.clock.now(), pressure, poses)

    def command(self, pressures: ArrayLike | PressureCommand) -> None:
        """Set the pressures (n,), in Pa; see `PressureSupply.command`."""
        self.supply.command(pressures)

    def vent(self) -> None:
        """Let all pressure out at once."""
        self.supply.vent()
