"""What trackers that stream from a thread of their own have in common: sense, counts, an end."""

from __future__ import annotations

import threading
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from stiffopt.registration import Registration
from stiffopt.rig.interface import Clock, PoseTracker, RawPose
from stiffopt.schema import Schema
from stiffopt.units import Duration, Length

__all__ = ["StreamedSettings", "StreamedTracker"]

_NOWHERE = (np.nan, np.nan, np.nan)


class StreamedSettings(Schema):
    """What such trackers are told.

    Attributes
    ----------
    latency : the least time from the capture of a pose to its arrival here, in s.
    range : what is farther from the tracker than this is not believed, in m.
    connect_timeout : what does not answer for this long when it is opened is not there, in s.
    registration : where tracker and sensor are.
    calibrated : whether the robot file's own registration then corrects the poses.
    """

    latency: Annotated[Duration, Field(ge=0, le=1)] = 0.025
    range: Annotated[Length, Field(gt=0, le=100)] = 2.0
    connect_timeout: Annotated[Duration, Field(gt=0, le=60)] = 10.0
    registration: Registration = Registration()
    calibrated: bool = False


class StreamedTracker(PoseTracker):
    """A tracker whose samples a thread delivers.

    Attributes
    ----------
    errors : bad or missing replies, lost connections; they are survived and counted.
    last_error : the last of them, as a sentence; empty before the first.
    out_of_range : samples that were not believed.
    """

    def __init__(
        self,
        longest: float,
        registration: Registration | None = None,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(registration, clock)
        self.errors = 0
        self.last_error = ""
        self.out_of_range = 0
        self._longest = longest
        self._stopping = threading.Event()

    def _count(self, error: str) -> None:
        self.errors += 1
        self.last_error = error

    def _hand_over(
        self, time: float, frame: int, position: ArrayLike, quaternion: ArrayLike | None
    ) -> None:
        """Deliver a pose in m, unless it is out of range; then deliver that nothing was seen."""
        if np.linalg.norm(position) > self._longest:
            self.out_of_range += 1
            position = _NOWHERE
        self._deliver(RawPose(time, frame, position, quaternion))

    def _hand_over_nothing(self, time: float, frame: int) -> None:
        self._deliver(RawPose(time, frame, _NOWHERE, None))
