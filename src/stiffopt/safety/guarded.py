"""The devices of a rig whose supply a guard process owns, as the control loop sees them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import DeviceError
from stiffopt.rig.interface import (
    PoseSample,
    PoseTracker,
    PressureLimits,
    PressureReading,
    PressureSupply,
    RawPose,
    SystemClock,
)

__all__ = ["ForwardedTracker", "GuardedSupply", "Link"]

Array = NDArray[np.float64]


class Link(Protocol):
    """What these devices use of a `stiffopt.safety.link.GuardLink`."""

    limits: PressureLimits

    def open(self) -> None:
        """Start the guard."""

    def close(self) -> None:
        """End the guard."""

    def vent(self) -> None:
        """Let all pressure out."""

    def read(self) -> PressureReading:
        """Read the pressures."""

    def take_poses(self) -> Sequence[PoseSample]:
        """Return what a simulated tracker has seen since the last call."""


class GuardedSupply(PressureSupply):
    """Stands in a `Rig` for the supply that the guard owns: it is read, vented and closed.

    To arm it and to command pressures is the link's business alone.
    """

    def __init__(self, link: Link) -> None:
        super().__init__(link.limits, SystemClock())
        self._link = link

    def _open(self) -> None:
        self._link.open()

    def _close(self) -> None:
        self._link.close()

    def _write(self, pressures: Array) -> None:
        if pressures.any():
            raise DeviceError("the supply belongs to the guard; command it through its link")
        self._link.vent()

    def _read(self) -> Array:
        return self._link.read().pressures


class ForwardedTracker(PoseTracker):
    """The tracker of a simulated rig that the guard process hosts; its poses are registered."""

    def __init__(self, link: Link) -> None:
        super().__init__(clock=SystemClock())
        self._link = link

    def _open(self) -> None:
        self._link.take_poses()  # what was seen before nobody asked for

    def _close(self) -> None:
        pass

    def _poll(self) -> None:
        for sample in self._link.take_poses():
            self._deliver(
                RawPose(
                    sample.time, sample.frame, sample.position, sample.quaternion, sample.received
                )
            )
