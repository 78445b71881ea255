"""Force probes: devices that push the tip along one axis and measure the force."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass

from stiffopt.rig.device import Clock, Device, DeviceSettings


@dataclass(frozen=True)
class ForceSample:
    """One measurement of a probe."""

    time: float  # when it was measured
    force: float  # force of the probe on the tip along its axis, in N
    position: float  # position of the probe along its axis, in m


class ProbeSettings(DeviceSettings):
    """Base of a probe's settings in a rig file."""

    def device(self, clock: Clock | None = None) -> ForceProbe:
        """Return the probe, not yet open."""
        raise NotImplementedError(f"{type(self).__name__} makes no probe")


class ForceProbe(Device):
    """Pushes the tip along one axis and measures the force."""

    @property
    def needs_a_person(self) -> bool:
        """Whether `align` and `withdraw` wait for a person: hold the pressures meanwhile."""
        return False

    @abstractmethod
    def align(self, direction: Iterable[float]) -> None:
        """Make a unit vector (3,) in the base frame the axis; a person does it on a real rig.

        The probe is then at position 0, just clear of the tip.
        """

    @abstractmethod
    def move_to(self, position: float, speed: float) -> None:
        """Move to a position along the axis, in m, at a speed in m/s; return on arrival."""

    def withdraw(self) -> None:
        """Take the probe out of the arm's way; a person does it on a real rig.

        It has to be aligned before it is used again.
        """

    @abstractmethod
    def stop(self) -> None:
        """Stop at once."""

    @abstractmethod
    def sample(self) -> ForceSample:
        """Read force and position."""
