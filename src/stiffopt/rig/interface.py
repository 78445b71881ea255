"""The rig: one interface to supply, tracker and probe, and everything that a driver imports.

A supply sets and reads the pressures of the channels, a tracker measures the pose of the tip, a
probe pushes the tip and measures the force. Tasks common to all devices of a kind (refuse, clamp,
vent, check, register) are solved here, once. A driver only moves data, in the methods that begin
with an underscore.

Everything is in SI: Pa (gauge), m, N, s; poses are those of the tip in the base frame. All times
are seconds on the clock of the rig, which never jumps.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.errors import CommandError
from stiffopt.model.description import RobotDescription
from stiffopt.rig.device import Clock, Device, Opened, SystemClock
from stiffopt.rig.pressure import (
    PressureCommand,
    PressureLimits,
    PressureReading,
    PressureSupply,
    Supply,
    SupplySettings,
    total_force,
    vent_at_exit,
)
from stiffopt.rig.probing import ForceProbe, ForceSample, ProbeSettings
from stiffopt.rig.tracking import (
    PoseSample,
    PoseTracker,
    RawPose,
    StreamedSettings,
    StreamedTracker,
    TrackerSettings,
)

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
    "ProbeSettings",
    "RawPose",
    "Rig",
    "StreamedSettings",
    "StreamedTracker",
    "Supply",
    "SupplySettings",
    "SystemClock",
    "TrackerSettings",
    "total_force",
    "vent_at_exit",
]


@dataclass(frozen=True)
class Observation:
    """The latest pressures, and the poses since the last observation.

    Attributes
    ----------
    time : float
        When it was made.
    pressure : PressureReading
        The latest reading.
    poses : tuple of PoseSample
        Samples of the tracker since the last observation, in order of arrival.
    """

    time: float
    pressure: PressureReading
    poses: tuple[PoseSample, ...] = field(default=())


class Rig(Opened):
    """An arm with its devices, real or simulated, as controllers and experiments see it.

    Parameters
    ----------
    robot :
        Description of the arm.
    supply, tracker, probe :
        The devices; tracker and probe are optional.
    clock :
        Clock of all devices. Only the clock lets time pass: a simulated rig moves while a program
        sleeps on it.
    slew :
        Greatest rate of change of a set-point (n,), in Pa/s; inf without a limit.
    max_force :
        Greatest sum over the channels of pressure times chamber area, in N; None: no limit.
    settings :
        Source of the rig, such as the content of a rig file, or None.
    """

    def __init__(
        self,
        robot: RobotDescription,
        supply: Supply,
        tracker: PoseTracker | None = None,
        probe: ForceProbe | None = None,
        *,
        clock: Clock | None = None,
        slew: ArrayLike | None = None,
        max_force: float | None = None,
        settings: Any = None,
    ) -> None:
        self.robot = robot
        self.supply = supply
        self.tracker = tracker
        self.probe = probe
        self.clock = clock or SystemClock()
        self.settings = settings
        self.slew = np.broadcast_to(np.inf if slew is None else np.asarray(slew), supply.n)
        self.max_force = max_force

    @property
    def devices(self) -> tuple[Device, ...]:
        """All devices; the supply is last, so that nothing moves before the others are ready."""
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
        """Vent, then close all devices, even if one fails."""
        with ExitStack() as stack:
            for device in self.devices:
                stack.callback(device.close)

    def observe(self) -> Observation:
        """Read the pressures and the tracker's samples since the last call.

        Raises
        ------
        DeviceError
            The supply does not answer.
        """
        pressure = self.supply.read()
        poses = self.tracker.read() if self.tracker is not None else ()
        return Observation(self.clock.now(), pressure, poses)

    def command(
        self, pressures: ArrayLike | PressureCommand, valid_for: float | None = None
    ) -> None:
        """Bring the pressures to (n,), in Pa, and keep them there for `valid_for` seconds.

        On a rig of `stiffopt.open_rig` this is a goal: the set-points approach it within the
        limits of slew and force; when it has expired, they are let down and vented.
        """
        if valid_for is not None:
            if isinstance(pressures, PressureCommand):
                raise CommandError("a PressureCommand contains its own time of validity")
            pressures = PressureCommand(pressures, self.clock.now(), valid_for)
        self.supply.command(pressures)

    def force(self, pressures: ArrayLike) -> float:
        """Return the sum of pressure (n,) times chamber area, in N; a vacuum counts as 0."""
        return total_force(pressures, self.robot.channel_areas)

    def vent(self) -> None:
        """Let all pressure out at once."""
        self.supply.vent()
