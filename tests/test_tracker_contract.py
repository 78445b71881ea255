"""The contract of trackers, held by all drivers over their real protocols."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fake_bench import FakeBench
from stiffopt.lab.aurora_peer import AuroraPeer
from stiffopt.lab.openigtlink_peer import OpenIGTLinkPeer
from stiffopt.model.robot_files import load_description
from stiffopt.plant.devices import simulated_rig
from stiffopt.plant.world import World
from stiffopt.registration import Registration
from stiffopt.rig.config import RigDescription, limits_of
from stiffopt.rig.drivers.aurora import AuroraSettings
from stiffopt.rig.drivers.openigtlink import OpenIGTLinkSettings
from stiffopt.rig.interface import PoseTracker
from stiffopt.rig.registry import driver_names
from tracker_contract import CHECKS, PLACE, TURN, Control, Factory

pytestmark = pytest.mark.real_time


class BenchControl:
    """What the sensor on a bench does."""

    def __init__(self, bench: FakeBench) -> None:
        self.bench = bench
        self.resume()

    def show(self, position: ArrayLike, quaternion: ArrayLike) -> None:
        self.bench.position, self.bench.quaternion = position, quaternion

    def drop(self) -> None:
        self.bench.position = (np.nan, np.nan, np.nan)

    def spoil(self) -> None:
        self.bench.quaternion = (np.nan, np.nan, np.nan, np.nan)

    def freeze(self) -> None:
        frame = self.bench.frame()
        assert frame is not None
        self.bench.frozen = frame.number

    def silence(self) -> None:
        self.bench.faults["tracker"] = "off"

    def resume(self) -> None:
        self.bench.frozen = None
        self.bench.faults.clear()
        self.show(PLACE, TURN)


def aurora(registration: Registration) -> AbstractContextManager[tuple[PoseTracker, Control]]:
    return with_peer(AuroraPeer, AuroraSettings(driver="aurora", registration=registration))


def openigtlink(registration: Registration) -> AbstractContextManager[tuple[PoseTracker, Control]]:
    settings = OpenIGTLinkSettings(driver="openigtlink", registration=registration)
    return with_peer(OpenIGTLinkPeer, settings)


@contextmanager
def with_peer(kind: Any, settings: Any) -> Iterator[tuple[PoseTracker, Control]]:
    bench = FakeBench()
    peer = kind(settings, bench)
    tracker = peer.start().device()
    try:
        yield tracker, BenchControl(bench)
    finally:
        tracker.close()
        peer.close()


class WorldControl:
    """What the sensor in a simulated world does."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.show((0.01, -0.02, -0.15), (1.0, 0.0, 0.0, 0.0))

    def show(self, position: ArrayLike, quaternion: ArrayLike) -> None:
        w, x, y, z = np.asarray(quaternion, dtype=float)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), position
        assert self.world.camera is not None
        self.world.camera._noisy = lambda pose, noise: T  # type: ignore[method-assign]
        self.world.inject("tracker", "flip" if w < 0 else "ok")

    def drop(self) -> None:
        self.world.inject("tracker", "missing")

    def spoil(self) -> None:
        self.world.inject("tracker", "garbage")

    def freeze(self) -> None:
        self.world.inject("tracker", "stuck")

    def silence(self) -> None:
        self.world.inject("tracker", "off")

    def resume(self) -> None:
        self.world.inject("tracker", "ok")


@contextmanager
def simulated(registration: Registration) -> Iterator[tuple[PoseTracker, Control]]:
    description = RigDescription(
        robot="stiff-flop-1",
        supply={"driver": "simulated"},
        tracker={"driver": "simulated", "registration": registration},
        plant={"faults": True, "dynamics": "quasi-static"},
    )
    robot = load_description("stiff-flop-1")
    rig = simulated_rig(description, robot, limits_of(description, robot))
    assert rig.tracker is not None
    yield rig.tracker, WorldControl(rig.world)


FACTORIES = {"aurora": aurora, "openigtlink": openigtlink, "simulated": simulated}


def test_every_tracker_is_held_to_the_contract() -> None:
    assert set(FACTORIES) >= set(driver_names("tracker"))


@pytest.mark.parametrize("factory", FACTORIES.values(), ids=FACTORIES)
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__.removeprefix("check_"))
def test_contract(check: Callable[[Factory], None], factory: Factory) -> None:
    check(factory)
