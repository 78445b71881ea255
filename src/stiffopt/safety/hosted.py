"""What the guard process owns: the supply behind its gate, and for a simulated rig all the rest."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from stiffopt.errors import DeviceError
from stiffopt.model.description import RobotDescription
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription
from stiffopt.rig.interface import PoseSample, Rig
from stiffopt.safety.gate import SafetyGate
from stiffopt.safety.outlet import Outlet

__all__ = ["Hosted", "Owned", "SimulatedRest", "owned"]


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
    outlet : the gate in front of the supply, not yet open.
    timeout : of the guard, in s.
    epoch : moment 0 of the rig's clock on `time.monotonic`, in s.
    hosted : the rest of a simulated rig.
    """

    outlet: Outlet
    timeout: float
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
    away = {"probe": None} if simulated else {"probe": None, "tracker": None}
    rig = make_rig(description.model_copy(update=away), robot, real_time=True)
    safety = description.safety
    gate = SafetyGate(
        rig.supply,
        slew=rig.slew,
        safety=safety,
        force_per_pressure=robot.channel_areas,
        clock=rig.clock,
        period=1 / description.rate,
    )
    if not simulated:
        return Owned(gate, safety.guard_timeout)
    rest = SimulatedRest(rig)
    return Owned(gate, safety.guard_timeout, rest.world.epoch, rest)


class SimulatedRest:
    """Tracker and truth of a simulated rig in real time.

    Parameters
    ----------
    rig :
        A simulated one.
    """

    def __init__(self, rig: Rig) -> None:
        self.world: Any = rig.world  # type: ignore[attr-defined]  # no controller has it
        self._tracker = rig.tracker

    def poses(self) -> Sequence[PoseSample]:
        """Let the world reach the present and return what its tracker has delivered."""
        if self._tracker is None:
            return ()
        self._tracker.open()
        with suppress(DeviceError):  # an arm that cannot be followed: its supply says so too
            return self._tracker.read()
        return ()

    def ask(self, word: str, about: dict[str, Any]) -> Any:
        """Answer to ``inject`` (`device`, `fault`, `channel`), ``truth`` and ``pressures``.

        Raises
        ------
        DeviceError
            There is no such word.
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
        raise DeviceError(f"a simulated rig knows nothing of '{word}'")
