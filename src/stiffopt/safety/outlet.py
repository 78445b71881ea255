"""The one way from the control loop to the pressures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stiffopt.rig.interface import PressureCommand, PressureLimits, PressureReading

__all__ = ["Applied", "Outlet", "let_down"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Applied:
    """What became of a command.

    Attributes
    ----------
    pressures : ndarray
        That the supply has been told (n,), in Pa.
    reading : PressureReading
        The newest; its time tells how old it is.
    limited : bool
        Whether it was asked for a faster change, or a greater force, than may be.
    refused : str
        Why nothing new was written; empty where something was.
    force_limited : bool
        Whether it was shortened for the total force.
    """

    pressures: Array
    reading: PressureReading
    limited: bool = False
    refused: str = ""
    force_limited: bool = False


def let_down(pressures: Array, share: float, limits: PressureLimits) -> Array:
    """Return a share, from 0 to 1, of pressures (n,), in Pa, as it can be commanded.

    A channel that would be below a low limit above 0 is at 0.
    """
    down: Array = pressures * min(max(share, 0.0), 1.0)
    low = limits.low
    return np.where((low > 0) & (down < low), 0.0, down)


class Outlet(Protocol):
    """Takes commands to a supply, and lets nothing through that may do harm.

    There are two: the `SafetyGate` in front of a supply of this process, and the `GuardLink` to a
    guard process that owns the supply and has the gate in front of it.
    """

    limits: PressureLimits

    def open(self) -> None:
        """Connect; the supply is vented then."""

    def close(self) -> None:
        """Vent and disconnect."""

    def arm(self) -> None:
        """Take commands from now on."""

    def restrict(self, high: Array) -> None:
        """Let no channel rise above a task's limits (n,), in Pa, until the next call or `arm`."""

    def vent(self) -> None:
        """Let all pressure out at once; no command is taken until `arm`."""

    def apply(self, command: PressureCommand) -> Applied:
        """Pass on what may be passed on; raise `DeviceError` if the supply does not take it."""

    def read(self) -> PressureReading:
        """Return the newest measured pressures; raise `DeviceError` if there are none."""
