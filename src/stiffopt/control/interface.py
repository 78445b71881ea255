"""The interface between the supervisor of the control loop and the controller that it runs.

The supervisor keeps the arm safe whatever the controller does; the controller decides on pressures
and need not know of states, faults or devices. `TipController` implements it, and so do the
baselines of the closed-loop benchmark.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stiffopt.control.state import ControllerStatus, Severity
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.paths.trajectory import Trajectory
from stiffopt.rig.interface import PoseSample, PressureReading

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SampleCounts:
    """How many of a tick's tracker samples were used."""

    used: int  # plausible samples, late ones included
    rejected: int  # samples to which no arm could have moved
    latest: float  # capture time of the newest used so far, in s; minus infinity before it


@dataclass(frozen=True)
class ControlOutput:
    """The command that a controller computes in a tick."""

    pressures: Array  # (n,), in Pa
    valid: bool  # whether they are a solution; else the solver failed and they are the last ones
    saturated: NDArray[np.bool_]  # channels (n,) at a limit that keeps the tip from its target
    # effective pressures (n,) to which the command leads, in Pa; None: the command
    posture: Array | None = None
    leans: bool = False  # whether the arm may touch objects of the scene: a brace's own checks hold


@dataclass(frozen=True)
class Notice:
    """A message of the controller, which becomes an alarm or an event."""

    kind: str  # a word for programs
    text: str  # a sentence for people
    severity: Severity = Severity.WARNING  # how bad it is
    standing: bool = False  # an alarm while the controller repeats it; otherwise an event
    hold: bool = False  # whether the pressures are to be held until there is a new task


class Controller(Protocol):
    """Decides on pressures. Called from the control thread, one call at a time."""

    def check(self) -> None:
        """Compile the model; raise `InputError` if model or settings do not permit control."""

    def begin(self, now: float) -> None:
        """Start anew with a vented arm and without a task, which means to keep the pressures."""

    def set_task(self, task: Task) -> None:
        """Pursue a task from now on; raise `InputError`, changing nothing, if it is not valid."""

    def set_target(self, target: Target) -> None:
        """Go to another target, with the stiffness goal and limits of the task; the same errors."""

    def follow(self, trajectory: Trajectory, now: float) -> None:
        """Follow a trajectory that begins now; the same errors."""

    def set_channels(self, without: Sequence[int]) -> None:
        """Do without some channels, counted from 0, from now on, and without no others."""

    def check_ahead(self, request: Task | Target | Trajectory) -> None:
        """Raise `InputError` if the way there is not clear of the rig's scene.

        Called from the threads of those who ask, before the request is handed over.
        """

    def resume(self, now: float) -> None:
        """Control again after others have commanded the pressures, without a jump."""

    def observe(
        self,
        now: float,
        commanded: Array,
        reading: PressureReading,
        samples: Sequence[PoseSample],
    ) -> SampleCounts:
        """Take in the set-points (n,) since the last tick, pressures and samples; in every tick."""

    def compute(self, now: float) -> ControlOutput:
        """Return the next command, within all limits; in the ticks in which it is active."""

    def status(self, now: float) -> ControllerStatus:
        """Return the controller's part of the state."""

    def notices(self) -> tuple[Notice, ...]:
        """Return the alarms that stand, and the events since the last call."""

    def close(self) -> None:
        """End the processes of the controller."""
