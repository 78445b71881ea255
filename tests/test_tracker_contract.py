"""The contract of trackers, held by all drivers over their real protocols."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from numpy.typing import ArrayLike

from fake_bench import FakeBench
from stiffopt.rig.drivers.aurora import AuroraSettings
from stiffopt.rig.drivers.openigtlink import OpenIGTLinkSettings
from stiffopt.rig.interface import PoseTracker
from stiffopt.rig.lab.aurora_peer import AuroraPeer
from stiffopt.rig.lab.openigtlink_peer import OpenIGTLinkPeer
from stiffopt.rig.registration import Registration
from tracker_contract import CHECKS, PLACE, TURN, Control, Factory


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


@contextmanager
def aurora(registration: Registration) -> Iterator[tuple[PoseTracker, Control]]:
    bench = FakeBench()
    peer = AuroraPeer(AuroraSettings(driver="aurora", registration=registration), bench)
    tracker = peer.start().device()
    try:
        yield tracker, BenchControl(bench)
    finally:
        tracker.close()
        peer.close()


@contextmanager
def openigtlink(registration: Registration) -> Iterator[tuple[PoseTracker, Control]]:
    bench = FakeBench()
    settings = OpenIGTLinkSettings(driver="openigtlink", registration=registration)
    peer = OpenIGTLinkPeer(settings, bench)
    tracker = peer.start().device()
    try:
        yield tracker, BenchControl(bench)
    finally:
        tracker.close()
        peer.close()


@pytest.mark.parametrize("factory", [aurora, openigtlink])
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__.removeprefix("check_"))
def test_contract(check: Callable[[Factory], None], factory: Factory) -> None:
    check(factory)
