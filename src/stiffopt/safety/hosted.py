"""What the guard process owns: the supply behind its gate, and for a simulated rig all the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from stiffopt.errors import DeviceError
from stiffopt.model.description import RobotDescription
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription
from stiffopt.rig.interface import ForceProbe, PoseSample, Rig
from stiffopt.safety.gate import SafetyGate, gate_before
from stiffopt.safety.goal import GoalFollower
from stiffopt.safety.vent_line import VentLine

__all__ = ["Hosted", "Owned", "SimulatedRest", "owned", "simulated_endpoint"]


class Hosted(Protocol):
    """The rest of a simulated rig, which lives where its supply does. Times are the rig's."""

    def poses(self) -> Sequence[PoseSample]:
        """Return what its tracker has delivered since the last call."""

    def ask(self, word: str, about: dict[str, Any]) -> Any:
        """Do something that only a simulation can; raise `StiffoptError` if this one cannot."""


@dataclass(frozen=True)
class Owned:
    """What a guard needs.

    Attributes
    ----------
    gate : in front of the supply, not yet open.
    follower : brings the supply to the goals of programs, through the gate.
    timeout : of the guard, in s.
    line : what the guard listens on for those who want to vent; not yet open.
    epoch : moment 0 of the rig's clock on `time.monotonic`, in s.
    hosted : the rest of a simulated rig.
    """

    gate: SafetyGate
    follower: GoalFollower
    timeout: float
    line: Callable[[], VentLine]
    epoch: float = 0.0
    hosted: Hosted | None = None


def owned(description: RigDescription, robot: RobotDescription) -> Owned:
    """Make what the guard of a rig owns.

    Raises
    ------
    MissingExtraError
        A library is not installed.
    """
    simulated = description.supply.driver == "simulated"
    away = {} if simulated else {"probe": None, "tracker": None}
    rig = make_rig(description.model_copy(update=away), robot, real_time=True)
    safety, period = description.safety, 1 / description.rate
    gate = gate_before(rig, safety, period)
    follower = GoalFollower.before(gate, safety, period, rig.clock)
    if not simulated:
        supply = gate.supply
        return Owned(gate, follower, safety.guard_timeout, lambda: VentLine(supply.endpoints))
    rest = SimulatedRest(rig)
    line = partial(VentLine, (simulated_endpoint(description),))
    return Owned(gate, follower, safety.guard_timeout, line, rest.world.epoch, rest)


def simulated_endpoint(description: RigDescription) -> str:
    """Return the name under which the guards of a simulated rig listen; several may have it."""
    return f"simulated {description.name}"


class SimulatedRest:
    """Tracker, probe and truth of a simulated rig in real time.

    Parameters
    ----------
    rig :
        A simulated one.
    """

    def __init__(self, rig: Rig) -> None:
        self.world: Any = rig.world  # type: ignore[attr-defined]  # no controller has it
        self._tracker, self._probe = rig.tracker, rig.probe

    def poses(self) -> Sequence[PoseSample]:
        """Let the world reach the present and return what its tracker has delivered."""
        if self._tracker is None:
            return ()
        self._tracker.open()
        with suppress(DeviceError):  # an arm that cannot be followed: its supply says so too
            return self._tracker.read()
        return ()

    def ask(self, word: str, about: dict[str, Any]) -> Any:
        """Answer to ``inject`` (`device`, `fault`, `channel`), ``truth``, ``pressures``, and probe.

        Raises
        ------
        DeviceError
            There is no such word, or the probe fails.
        InputError
            There is no such fault, or the rig file does not allow faults.
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
        raise DeviceError(f"a simulated rig knows nothing of '{word}'")

    def _use_probe(self, probe: ForceProbe, word: str, about: dict[str, Any]) -> Any:
        """Do what a `ForwardedProbe` asks for; a move is begun, and `moving` tells when it ends."""
        probe.open()
        match word:
            case "probe-align":
                probe.align(about["direction"])
            case "probe-withdraw":
                probe.withdraw()
            case "probe-move":
                probe.sample()  # a probe that does not answer does not move either
                self.world.move_stage(about["position"], about["speed"])
            case "probe-moving":
                probe.sample()
                return bool(self.world.stage_moving)
            case "probe-stop":
                probe.stop()
            case "probe-sample":
                felt = probe.sample()
                return [felt.force, felt.position]
        return None
