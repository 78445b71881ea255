"""The interface between the control loop's supervisor and the controller that it runs.

The supervisor keeps the arm safe whatever the controller does. The controller decides on pressures;
it needs no knowledge of states, faults or devices. `TipController` implements it, and so do the
baselines of the closed-loop benchmark.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from stiffopt.arrays import Array, Flags
from stiffopt.control.state import ControllerStatus, Severity
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.paths.trajectory import Trajectory
from stiffopt.rig.interface import PoseSample, PressureReading


@dataclass(frozen=True)
class SampleCounts:
    """How many of a tick's tracker samples were used."""

    used: int  # plausible samples, late ones included
    rejected: int  # samples too far away for any motion of the arm
    latest: float  # capture time of the newest used so far, in s; minus infinity before any


@dataclass(frozen=True)
class ControlOutput:
    """The command that a controller computes in a tick."""

    pressures: Array  # (n,), in Pa
    valid: bool  # False: the solver failed, and the pressures are the last ones
    saturated: Flags  # channels (n,) at a limit that keeps the tip from its target
    # effective pressures (n,) to which the command leads, in Pa; None: the command
    posture: Array | None = None
    leans: bool = False  # whether the arm may touch objects: then the brace checks its contacts


@dataclass(frozen=True)
class Notice:
    """A message of the controller, which becomes an alarm or an event."""

    kind: str  # a word for programs
    text: str  # a sentence for people
    severity: Severity = Severity.WARNING  # how bad it is
    standing: bool = False  # an alarm while the controller repeats it; otherwise an event
    hold: bool = False  # whether to hold the pressures until there is a new task
    undo: float = 1.0  # share of the latest motion that this hold undoes


class Controller(Protocol):
    """Decides on pressures. Called from the control thread, one call at a time."""

    def check(self) -> None:
        """Compile the model; raise `InputError` if model or settings do not permit control."""

    def begin(self, now: float) -> None:
        """Restart with a vented arm and no task: the pressures stay."""

    def set_task(self, task: Task) -> None:
        """Pursue a task from now on; raise `InputError`, changing nothing, if it is invalid."""

    def set_target(self, target: Target) -> None:
        """Go to another target, with the stiffness goal and limits of the task; the same errors."""

    def follow(self, trajectory: Trajectory, now: float) -> None:
        """Follow a trajectory that begins now; the same errors."""

    def set_channels(self, without: Sequence[int]) -> None:
        """Take exactly these channels, counted from 0, out of use."""

    def check_ahead(self, request: Task | Target | Trajectory) -> None:
        """Raise `InputError` if the way there is not clear of the rig's scene.

        The client's thread calls this before it hands the request over.
        """

    def resume(self, now: float) -> None:
        """Resume control, without a jump, after others have commanded the pressures."""

    def observe(
        self,
        now: float,
        commanded: Array,
        reading: PressureReading,
        samples: Sequence[PoseSample],
    ) -> SampleCounts:
        """Take in set-points (n,) since the last tick, pressures and samples; in every tick."""

    def compute(self, now: float) -> ControlOutput:
        """Return the next command, within all limits; only in ticks in the state `active`."""

    def stop(self, now: float) -> Array | None:
        """Return the next command (n,) of a doubted motion on its way to rest; None once it rests.

        In ticks of a hold for a doubt, in place of `compute`.
        """

    def status(self, now: float) -> ControllerStatus:
        """Return the controller's part of the state."""

    def notices(self) -> tuple[Notice, ...]:
        """Return standing alarms, and events since the last call."""

    def close(self) -> None:
        """End the processes of the controller."""
