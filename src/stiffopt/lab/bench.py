"""What the protocol peers of the virtual lab see of the simulated arm."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from stiffopt.schema import Schema

__all__ = ["Bench", "Peer", "TrackerFrame"]

Array = NDArray[np.float64]
SettingsT = TypeVar("SettingsT", bound=Schema)


@dataclass(frozen=True)
class TrackerFrame:
    """What the tracker's hardware sees in one frame.

    Attributes
    ----------
    number : of the frame.
    time : of its capture, on `time.monotonic`.
    position : of the sensor in the tracker's frame (3,), in m; NaN where it is not seen.
    quaternion : (4,), w first, of any sign, with the tracker's noise.
    """

    number: int
    time: float
    position: Array
    quaternion: Array


class Bench(ABC):
    """The simulated arm and its devices in real time. Every method may be called by any thread.

    Peers carry its faults over to the wire: when `fault` of their device is ``off`` they do not
    answer at all, when it is ``slow`` they answer late. All other faults (``stuck``, ``garbage``,
    ``wrong``) show in what the methods return.
    """

    @property
    @abstractmethod
    def n(self) -> int:
        """Number of channels."""

    @abstractmethod
    def command(self, channel: int, pressure: float) -> None:
        """Give a regulator (counted from 0) its set-point, in Pa."""

    @abstractmethod
    def measured(self) -> Array:
        """Pressures (n,) that the regulators report, in Pa."""

    @abstractmethod
    def dump(self, *, open_valve: bool) -> None:
        """Open or close the dump valve: open, it empties all chambers."""

    @abstractmethod
    def frame(self) -> TrackerFrame | None:
        """Return the newest frame that has left the tracker, or None before the first."""

    @abstractmethod
    def fault(self, device: str) -> str:
        """Fault of ``supply``, ``tracker`` or ``probe``: ``ok``, ``off``, ``slow`` and others."""

    @property
    @abstractmethod
    def stage_position(self) -> float:
        """Where the probe's stage is, in m."""

    @property
    @abstractmethod
    def stage_moving(self) -> bool:
        """Whether it moves."""

    @abstractmethod
    def stage_move(self, position: float, speed: float) -> None:
        """Let the stage start to move, m and m/s."""

    @abstractmethod
    def stage_stop(self) -> None:
        """Stop it."""

    @abstractmethod
    def force(self) -> float:
        """Force that the probe's sensor feels, in N."""


class Peer(ABC, Generic[SettingsT]):
    """A device as others see it: it speaks the real protocol, and the bench is behind it.

    Parameters
    ----------
    settings :
        Of the real driver, as they are in the rig file; the peer follows them (register map,
        scales, channels), so that a lab can rehearse with its own file.
    bench :
        What is behind it.
    """

    def __init__(self, settings: SettingsT, bench: Bench) -> None:
        self.settings = settings
        self.bench = bench

    @abstractmethod
    def start(self) -> SettingsT:
        """Listen on loopback, on a free port or pseudo-terminal.

        Returns
        -------
        The settings with the address put in, with which the real driver reaches this peer.

        Raises
        ------
        DeviceError
            The address that the settings ask for is in use.
        MissingExtraError
            The library that speaks the protocol is not installed.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop listening and end every thread; to close twice does nothing."""
