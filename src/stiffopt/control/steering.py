"""What the loop asks of that which steers: the interface between safety and control."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stiffopt.control.state import Severity, SteeringStatus
from stiffopt.control.trajectory import Trajectory
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.rig.interface import PoseSample, PressureReading

__all__ = ["Move", "Notice", "Seen", "Steering"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Seen:
    """What became of the tracker's samples in a tick.

    Attributes
    ----------
    used : samples that were plausible, late ones included.
    rejected : samples that no arm could have moved to.
    latest : capture time of the newest that was used, in s; minus infinity before the first.
    """

    used: int
    rejected: int
    latest: float


@dataclass(frozen=True)
class Move:
    """What to command next.

    Attributes
    ----------
    pressures : ndarray
        (n,), in Pa.
    sound : bool
        Whether they are an answer; if not, the solver failed and they are those of the last tick.
    saturated : ndarray
        Channels (n,) at a limit that keeps the tip from where it should go.
    """

    pressures: Array
    sound: bool
    saturated: NDArray[np.bool_]


@dataclass(frozen=True)
class Notice:
    """Something that whoever steers wants known; `standing` means that it is an alarm until gone.

    Attributes
    ----------
    kind : a word for programs.
    text : a sentence for people.
    severity : how bad it is.
    standing : whether it is still so; False: it happened and is over.
    """

    kind: str
    text: str
    severity: Severity = Severity.WARNING
    standing: bool = False


class Steering(Protocol):
    """Decides about pressures. Called from the control thread alone, one call at a time."""

    def check(self) -> None:
        """Get ready (compile, plan); raise `InputError` if the model or settings do not serve."""

    def begin(self, now: float) -> None:
        """Start anew with a vented arm, without a task: it is to stay as it is."""

    def set_task(self, task: Task) -> None:
        """Pursue a task from now on; raise `InputError`, changing nothing, if it does not suit."""

    def set_target(self, target: Target) -> None:
        """Go to another target, with the stiffness goal and limits of the task; the same errors."""

    def follow(self, trajectory: Trajectory, now: float) -> None:
        """Follow a trajectory that begins now; the same errors."""

    def resume(self, now: float) -> None:
        """Steer again after a time in which others commanded, without a jump."""

    def observe(
        self,
        now: float,
        commanded: Array,
        reading: PressureReading,
        samples: Sequence[PoseSample],
    ) -> Seen:
        """Take in what was commanded (n,) since the last tick, read and seen; in every tick."""

    def move(self, now: float) -> Move:
        """Return the next pressures, within all limits; in ticks in which it steers."""

    def standing(self, now: float) -> SteeringStatus:
        """Return what it knows of the state."""

    def notices(self) -> tuple[Notice, ...]:
        """Return what stands, and once what has happened since the last call."""

    def close(self) -> None:
        """End whatever runs beside."""
