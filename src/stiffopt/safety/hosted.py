"""The devices that the guard process owns, and the client's access to those of a simulated rig.

The guard owns the supply, behind the gate. A simulated rig in real time is one world together with
its arm, so its tracker and probe are in the guard process too (`HostedDevices`). The client uses
`ForwardedTracker` and `ForwardedProbe` in their place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from stiffopt.errors import CommandError, DeviceError
from stiffopt.model.description import RobotDescription
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription
from stiffopt.rig.interface import (
    ForceProbe,
    ForceSample,
    PoseSample,
    PoseTracker,
    RawPose,
    Rig,
    SystemClock,
)
from stiffopt.safety.gate import SafetyGate, gate_before
from stiffopt.safety.goal import GoalFollower
from stiffopt.safety.vent_line import VentLine

if TYPE_CHECKING:
    from stiffopt.safety.guard_client import GuardLink

_LOOK = 0.005  # s between checks of a moving stage


@dataclass(frozen=True)
class Owned:
    """The objects that a guard owns."""

    gate: SafetyGate  # the gate in front of the supply, not yet open
    follower: GoalFollower  # brings the supply to the goals of programs, through the gate
    timeout: float  # silence of a stream after which the guard vents, in s
    # makes the vent line on which the guard listens for `stiffopt vent`
    line: Callable[[], VentLine]
    epoch: float = 0.0  # time 0 of the rig's clock on `time.monotonic`, in s
    # tracker, probe and truth of a simulated rig; None for real devices
    hosted: HostedDevices | None = None


def owned(description: RigDescription, robot: RobotDescription) -> Owned:
    """Make what the guard of a rig owns, without connecting to anything.

    Raises `MissingExtraError`: a library is not installed.
    """
    simulated = description.supply.simulated
    away = {} if simulated else {"probe": None, "tracker": None}
    rig = make_rig(description.model_copy(update=away), robot, real_time=True)
    safety, period = description.safety, 1 / description.rate
    gate = gate_before(rig, safety, period)
    follower = GoalFollower.before(gate, safety, period, rig.clock)
    if not simulated:
        supply = gate.supply
        return Owned(gate, follower, safety.guard_timeout, lambda: VentLine(supply.endpoints))
    rest = HostedDevices(rig)
    line = partial(VentLine, (simulated_endpoint(description),))
    return Owned(gate, follower, safety.guard_timeout, line, rest.world.epoch, rest)


def simulated_endpoint(description: RigDescription) -> str:
    """Return the name at which guards of a simulated rig listen; several may share it."""
    return f"simulated {description.name}"


class HostedDevices:
    """Tracker, probe and truth of a simulated rig in real time, inside the guard process.

    `rig`: a simulated rig.
    """

    def __init__(self, rig: Rig) -> None:
        self.world: Any = rig.world  # type: ignore[attr-defined]  # no controller has it
        self._tracker, self._probe = rig.tracker, rig.probe

    def poses(self) -> Sequence[PoseSample]:
        """Advance simulated time to the present; return the tracker's new samples."""
        if self._tracker is None:
            return ()
        self._tracker.open()
        with suppress(DeviceError):  # the simulation fails, which the supply reports too
            return self._tracker.read()
        return ()

    def ask(self, word: str, about: dict[str, Any]) -> Any:
        """Carry out the request ``inject``, ``truth``, ``pressures`` or one of a `ForwardedProbe`.

        Raises `DeviceError`: there is no such request, or the probe fails; `InputError`: there is
        no such fault, or the rig file does not allow faults.
        """
        self.world.catch_up()
        match word:
            case "inject":
                self.world.inject(about["device"], about["fault"], about["channel"])
                return None
            case "truth":
                return self.world.plant.tip_pose().tolist()
            case "pressures":
                return self.world.pressures.tolist()
        if self._probe is not None and word.startswith("probe-"):
            return self._use_probe(self._probe, word, about)
        raise DeviceError(f"a simulated rig has no '{word}'")

    def _use_probe(self, probe: ForceProbe, word: str, about: dict[str, Any]) -> Any:
        """Carry out a request of a `ForwardedProbe`; a move only starts here."""
        probe.open()
        match word:
            case "probe-align":
                probe.align(about["direction"])
            case "probe-withdraw":
                probe.withdraw()
            case "probe-move":
                probe.sample()  # a probe that does not answer does not move either
                self.world.stage.move(about["position"], about["speed"])
            case "probe-moving":
                probe.sample()
                return bool(self.world.stage.speed)
            case "probe-stop":
                probe.stop()
            case "probe-sample":
                felt = probe.sample()
                return [felt.force, felt.position]
        return None


class ForwardedTracker(PoseTracker):
    """The client's side of a hosted tracker; its poses are already those of the tip in the base."""

    def __init__(self, link: GuardLink) -> None:
        super().__init__(clock=SystemClock())
        self._link = link

    def _open(self) -> None:
        self._link.take_poses()  # drop old samples

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
    """The client's side of a hosted probe."""

    def __init__(self, link: GuardLink) -> None:
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
        """Move the plate and return when it has arrived; see `ForceProbe.move_to`."""
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
