"""Devices of a simulated rig that lives in the guard process, as other processes see them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np

from stiffopt.errors import CommandError
from stiffopt.rig.interface import (
    ForceProbe,
    ForceSample,
    PoseSample,
    PoseTracker,
    RawPose,
    SystemClock,
)

__all__ = ["ForwardedProbe", "ForwardedTracker"]

_LOOK = 0.005  # s between two looks at a stage that moves


class Forwarding(Protocol):
    """What these devices use of a `stiffopt.safety.link.GuardLink`."""

    def take_poses(self) -> Sequence[PoseSample]:
        """Return what a simulated tracker has seen since the last call."""

    def ask_world(self, word: str, **about: Any) -> Any:
        """Have the simulated rig do something and return what it answers."""


class ForwardedTracker(PoseTracker):
    """The tracker of a simulated rig in the guard process; its poses are registered already."""

    def __init__(self, link: Forwarding) -> None:
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


class ForwardedProbe(ForceProbe):
    """The probe of a simulated rig in the guard process."""

    def __init__(self, link: Forwarding) -> None:
        super().__init__(SystemClock())
        self._link = link

    def _open(self) -> None:
        pass

    def _close(self) -> None:
        pass

    def align(self, direction: Iterable[float]) -> None:
        """Put the plate just clear of the tip, facing along a unit vector (3,) in the base."""
        self._ask("align", direction=[float(component) for component in direction])

    def withdraw(self) -> None:
        """Take the plate away."""
        self._ask("withdraw")

    def move_to(self, position: float, speed: float) -> None:
        """Move the plate and return when it is there; see `ForceProbe.move_to`."""
        if not (np.isfinite(position) and np.isfinite(speed) and speed > 0):
            raise CommandError("expected a finite position and a speed above 0")
        self._ask("move", position=float(position), speed=float(speed))
        while self._ask("moving"):
            self.clock.sleep(_LOOK)

    def stop(self) -> None:
        """Stop the plate."""
        self._ask("stop")

    def sample(self) -> ForceSample:
        """Read force and position."""
        force, position = self._ask("sample")
        return ForceSample(self.clock.now(), force, position)

    def _ask(self, word: str, **about: Any) -> Any:
        self._must_be_open()
        return self._link.ask_world(f"probe-{word}", **about)
