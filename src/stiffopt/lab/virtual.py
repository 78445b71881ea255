"""The virtual lab: a simulated arm in real time behind the protocols of a rig file's devices."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any, Self

from stiffopt.errors import InputError
from stiffopt.lab.bench import Bench, DevicePeer
from stiffopt.model.description import RobotDescription
from stiffopt.plant.settings import LabSettings, plant_of
from stiffopt.plant.world import World
from stiffopt.rig.config import RigDescription, limits_of
from stiffopt.rig.device import DeviceSettings
from stiffopt.rig.registry import driver_class, driver_names, load, one_of
from stiffopt.rig.settings import CommissioningSettings


def with_real_devices(
    description: RigDescription, robot: RobotDescription, **drivers: str
) -> RigDescription:
    """Return a rig whose simulated devices are replaced by real ones on this machine.

    `description`, `robot`: the rig and its robot. `drivers`: drivers that replace a simulated
    `supply`, `tracker` and `probe`. Raises `InputError`: there is no such driver, or no peer for
    it.
    """
    real: dict[str, Any] = {}
    lab: dict[str, Any] = {}
    for kind, driver in drivers.items():
        model = driver_class(kind, driver)
        if model.simulated:
            known = one_of(name for name in driver_names(kind) if name != driver)
            raise InputError(f"the driver '{driver}' is simulated itself; expected {known}")
        settings = getattr(description, kind)
        if settings is not None and settings.simulated:
            lab[kind] = settings
            real[kind] = _peer_class(model).stand_in(settings, robot.n_pressures)
    if not real:
        return description
    before = description.lab.model_dump() if description.lab else {}
    fields = {**{name: getattr(description, name) for name in RigDescription.model_fields}, **real}
    return RigDescription(**{**fields, "lab": {**before, **lab}})


def _peer_class(settings: type[DeviceSettings]) -> type[DevicePeer[Any]]:
    """Return the class of the peer for a device's settings."""
    if not settings.peer:
        raise InputError(
            f"the driver of {settings.__name__} cannot be used in the virtual lab: it has no peer"
        )
    return load(settings.peer)


class VirtualLab:
    """A simulated arm in real time, and a peer for each device of a rig file.

    Parameters
    ----------
    description : the rig. If its devices are simulated, `supply`, `tracker` and `probe` name the
        drivers of the real ones that replace them.
    robot : its robot.
    supply, tracker, probe : drivers with a peer.
    """

    def __init__(
        self,
        description: RigDescription,
        robot: RobotDescription,
        supply: str = "modbus",
        tracker: str = "aurora",
        probe: str = "probe",
    ) -> None:
        drivers = {"supply": supply, "tracker": tracker, "probe": probe}
        self.description = with_real_devices(description, robot, **drivers)
        given = self.description.lab
        lab = given if isinstance(given, LabSettings) else LabSettings()
        seen = lab.tracker
        if self.description.tracker is not None:
            registration = self.description.tracker.registration
            seen = seen.model_copy(update={"registration": registration})
        plant, limits = plant_of(self.description), limits_of(self.description, robot)
        world = World(robot, limits, plant, lab.supply, seen, lab.probe, real_time=True)
        self.bench = Bench(world)
        self._peers: list[DevicePeer[Any]] = []

    @property
    def world(self) -> World:
        """The simulated truth, and the place to inject faults."""
        return self.bench.world

    def start(self) -> RigDescription:
        """Start time and all peers.

        Returns the rig file's content with the peers' addresses, for the real drivers. Raises
        `DeviceError`: an address is in use; `MissingExtraError`: a library is not installed;
        `InputError`: there is no peer for a driver.
        """
        # a simulated arm needs no commissioning
        free = CommissioningSettings(required=False)
        addressed: dict[str, Any] = {"plant": None, "lab": None, "commissioning": free}
        with ExitStack() as stack:
            stack.callback(self.close)
            for name in ("supply", "tracker", "probe"):
                settings = getattr(self.description, name)
                if settings is None:
                    continue
                peer = _peer_class(type(settings))(settings, self.bench)
                self._peers.append(peer)
                self.world.known_faults[name] += peer.faults
                addressed[name] = peer.start()
            self.bench.start()
            stack.pop_all()
        return self.description.model_copy(update=addressed)

    def close(self) -> None:
        """End all peers, then time; a second call does nothing."""
        with ExitStack() as stack:
            stack.callback(self.bench.close)
            while self._peers:
                stack.callback(self._peers.pop().close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
