"""Force probes: devices that push the tip along one axis and measure the force."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass

from stiffopt.rig.device import Clock, Device, DeviceSettings


@dataclass(frozen=True)
class ForceSample:
    """One measurement of a probe.

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


class ProbeSettings(DeviceSettings):
    """Base of a probe's settings in a rig file."""

    def device(self, clock: Clock | None = None) -> ForceProbe:
        """Return the probe, not yet open."""
        raise NotImplementedError(f"{type(self).__name__} makes no probe")


class ForceProbe(Device):
    """Pushes on the tip along one axis and feels the force."""

    @property
    def needs_a_person(self) -> bool:
        """Whether `align` and `withdraw` wait for a person: hold the pressures meanwhile."""
        return False

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
