"""The virtual lab: the devices of a rig file as real protocol peers of a simulated arm."""

from __future__ import annotations

from contextlib import ExitStack
from importlib import import_module
from types import TracebackType
from typing import Any, Self

from stiffopt.lab.bench import Peer
from stiffopt.lab.defaults import with_real_devices
from stiffopt.lab.real_time import RealTimeBench
from stiffopt.model.description import RobotDescription
from stiffopt.plant.settings import PlantSettings
from stiffopt.plant.world import World
from stiffopt.rig.config import LabSettings, RigDescription, limits_of

__all__ = ["VirtualLab"]

_PEERS = {
    "modbus": "modbus_peer:ModbusPeer",
    "nidaq": "nidaq_peer:NidaqPeer",
    "aurora": "aurora_peer:AuroraPeer",
    "openigtlink": "openigtlink_peer:OpenIGTLinkPeer",
    "probe": "probe_peer:ProbePeer",
}


class VirtualLab:
    """A simulated arm in real time behind the protocols of a rig file's devices.

    Parameters
    ----------
    description :
        The rig; where its devices are simulated, `supply` and `tracker` name the drivers of the
        real ones that take their place.
    robot :
        Its robot.
    supply, tracker :
        ``modbus`` or ``nidaq``, ``aurora`` or ``openigtlink``.
    """

    def __init__(
        self,
        description: RigDescription,
        robot: RobotDescription,
        supply: str = "modbus",
        tracker: str = "aurora",
    ) -> None:
        self.description = with_real_devices(description, robot, supply, tracker)
        lab = self.description.lab or LabSettings()
        seen = lab.tracker
        if self.description.tracker is not None:
            registration = self.description.tracker.registration
            seen = seen.model_copy(update={"registration": registration})
        plant = self.description.plant or PlantSettings()
        limits = limits_of(self.description, robot)
        world = World(robot, limits, plant, lab.supply, seen, lab.probe, real_time=True)
        self.bench = RealTimeBench(world)
        self._peers: list[Peer[Any]] = []

    @property
    def world(self) -> World:
        """What is true, and where faults are injected."""
        return self.bench.world

    def start(self) -> RigDescription:
        """Start time and all peers.

        Returns
        -------
        The rig file's content with the peers' addresses, which drives them with the real drivers.

        Raises
        ------
        DeviceError
            An address is in use.
        MissingExtraError
            A library is not installed.
        """
        addressed: dict[str, Any] = {"plant": None, "lab": None}
        with ExitStack() as stack:
            stack.callback(self.close)
            for name in ("supply", "tracker", "probe"):
                settings = getattr(self.description, name)
                if settings is None:
                    continue
                module, kind = _PEERS[settings.driver].split(":")
                peer_class = getattr(import_module(f"stiffopt.lab.{module}"), kind)
                peer: Peer[Any] = peer_class(settings, self.bench)
                self._peers.append(peer)
                addressed[name] = peer.start()
            self.bench.start()
            stack.pop_all()
        return self.description.model_copy(update=addressed)

    def close(self) -> None:
        """End all peers, then time; to close twice does nothing."""
        with ExitStack() as stack:
            stack.callback(self.bench.close)
            while self._peers:
                stack.callback(self._peers.pop().close)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
