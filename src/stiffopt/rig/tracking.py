"""Trackers: devices that measure the pose of the tip, with the time of each capture."""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from stiffopt.arrays import Array
from stiffopt.registration import Registration
from stiffopt.rig.device import Clock, Device, DeviceSettings
from stiffopt.units import Duration, Length

_QUEUED = 4096  # samples that a tracker keeps until they are read; the oldest are dropped first
_NORM_SLACK = 0.05  # by which the norm of a tracker's quaternion may differ from 1
_NOWHERE = (np.nan, np.nan, np.nan)


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
        return all(map(math.isfinite, self.position))


@dataclass(frozen=True)
class RawPose:
    """Pose of the sensor in the tracker's frame, as a driver delivers it.

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


class TrackerSettings(DeviceSettings):
    """Base of a tracker's settings in a rig file.

    Attributes
    ----------
    registration : placement of tracker and sensor.
    calibrated : whether the robot file's own registration corrects the poses in addition.
    """

    registration: Registration = Registration()
    calibrated: bool = False

    def device(self, clock: Clock | None = None) -> PoseTracker:
        """Return the tracker, not yet open."""
        raise NotImplementedError(f"{type(self).__name__} makes no tracker")


class PoseTracker(Device):
    """Base of trackers.

    A driver calls `_deliver` with each sample of the device, from any thread. This class handles
    registration, sign of the quaternion and plausibility. `read` never waits: if a device is
    silent, only the age of the latest sample shows it.

    `registration`: turns the device's readings into poses of the tip in the base frame.
    """

    def __init__(
        self, registration: Registration | None = None, clock: Clock | None = None
    ) -> None:
        super().__init__(clock)
        self.registration = registration or Registration()
        self._arrived: deque[PoseSample] = deque(maxlen=_QUEUED)
        self._latest: PoseSample | None = None
        self._latest_visible: PoseSample | None = None

    def open(self) -> None:
        """Connect; drop earlier samples."""
        if not self._is_open:
            self._arrived.clear()
            self._latest = self._latest_visible = None
            super().open()

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
        """Return the time since the latest capture that saw the tool, in s; infinite before it."""
        self._poll()
        latest = self._latest_visible
        return self.clock.now() - latest.time if latest else float("inf")

    def _poll(self) -> None:
        """Deliver arrived samples, in drivers without a thread for that."""

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
        seen = position.shape == (3,) and all(map(math.isfinite, position.tolist()))
        if raw.quaternion is not None:
            quaternion = np.array(raw.quaternion, dtype=float).reshape(-1)
            norm = math.hypot(*quaternion.tolist()) if quaternion.shape == (4,) else math.nan
            seen = seen and abs(norm - 1) <= _NORM_SLACK  # NaN fails too
            quaternion = quaternion / norm if seen else None
        if not seen:
            nowhere = np.full(3, np.nan)
            return PoseSample(raw.time, received, raw.frame, nowhere, None)
        position, quaternion = self.registration.tip_in_base(position, quaternion)
        return PoseSample(raw.time, received, raw.frame, position, quaternion)


class StreamedSettings(TrackerSettings):
    """Base of the settings of a tracker that streams poses.

    Attributes
    ----------
    latency : shortest time from the capture of a pose to its arrival here, in s.
    range : distance from the tracker beyond which poses count as not seen, in m.
    connect_timeout : longest wait for the first answer when the tracker is opened, in s.
    """

    latency: Annotated[Duration, Field(ge=0, le=1)] = 0.025
    range: Annotated[Length, Field(gt=0, le=100)] = 2.0
    connect_timeout: Annotated[Duration, Field(gt=0, le=60)] = 10.0


class StreamedTracker(PoseTracker):
    """A tracker whose samples are delivered by a thread.

    Attributes
    ----------
    errors : number of bad or missing replies and lost connections so far.
    last_error : the last of them, as a sentence; empty before the first.
    out_of_range : number of samples beyond `StreamedSettings.range`.
    """

    def __init__(self, settings: StreamedSettings, clock: Clock | None = None) -> None:
        super().__init__(settings.registration, clock)
        self.errors = 0
        self.last_error = ""
        self.out_of_range = 0
        self._longest = settings.range
        self._stopping = threading.Event()

    def _count(self, error: str) -> None:
        self.errors += 1
        self.last_error = error

    def _hand_over(
        self, time: float, frame: int, position: ArrayLike, quaternion: ArrayLike | None
    ) -> None:
        """Deliver a pose in m; if it is out of range, deliver that nothing was seen."""
        if np.linalg.norm(position) > self._longest:
            self.out_of_range += 1
            position = _NOWHERE
        self._deliver(RawPose(time, frame, position, quaternion))

    def _hand_over_nothing(self, time: float, frame: int) -> None:
        self._deliver(RawPose(time, frame, _NOWHERE, None))
