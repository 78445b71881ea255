"""What the tests of experiments share: short settings, and recordings without full MCAP files."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import stiffopt
from conftest import is_long
from fake_rig import world_of
from stiffopt.experiments import KinematicsSettings, StiffnessSettings
from stiffopt.experiments import folder as folder_module
from stiffopt.experiments.conductor import Conductor
from stiffopt.logs import LogRow, McapLogWriter
from stiffopt.rig.interface import Rig

GOLDEN = {  # bar: stiffness along x, y, z in N/m; reference/paper-notes.md
    0.0: (14.03, 14.03, 730.42),
    0.4: (12.67, 12.13, 222.38),
    1.0: (13.91, 9.33, 31.89),
    1.5: (28.23, 7.24, 11.63),
}


def golden(p: np.ndarray, direction: np.ndarray) -> float:
    """Stiffness at the nearest pressure of the table: it is constant while the arm rests."""
    bar = min(GOLDEN, key=lambda level: abs(level * 1e5 - p[0]))
    return float(GOLDEN[bar][int(np.argmax(np.abs(direction)))])


def short(**given: object) -> KinematicsSettings:
    values = {
        "channels": 3, "pressures": (0.5e5,), "period": 1.0, "repetitions": 2, "poses": 0, **given,
    }  # fmt: skip
    return KinematicsSettings(**values)


def quick(**given: object) -> StiffnessSettings:
    steps = 4 if is_long() else 2
    values = {
        "channels": 3, "pressures": (0.4e5,), "repetitions": 1, "steps": steps, **given,
    }  # fmt: skip
    return StiffnessSettings(**values)


def model() -> stiffopt.Manipulator:
    return stiffopt.load_robot("stiff-flop-1")


class FirstRowAlone(McapLogWriter):
    """Writes one row: most tests look at the recordings in CSV files only."""

    def append(self, row: LogRow) -> None:
        if self._last_time is None:
            super().append(row)


@pytest.fixture
def whole_mcap() -> None:
    """MCAP files get all rows."""


@pytest.fixture
def first_row_alone(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "whole_mcap" not in request.fixturenames:
        monkeypatch.setattr(folder_module, "McapLogWriter", FirstRowAlone)


def assert_gentle(rig: Rig, slew: float, high: float) -> None:
    """All that was ever written: in range, no faster than the slew but for the vents, 0 at last."""
    times = np.array([time for time, _ in world_of(rig).writes])
    values = np.array([value for _, value in world_of(rig).writes])
    assert values.min() >= 0
    assert values.max() <= high
    assert not values[-1].any()
    rise = np.diff(values, axis=0).max(axis=1)
    assert (rise <= slew * np.diff(times) + 1e-6).all()
    ramps = np.diff(values, axis=0)[:-1]
    assert (-ramps <= slew * np.diff(times)[:-1, np.newaxis] + 1e-6).all()


def stop_at(moment: float, rig: Rig) -> Callable[[], None]:
    def check() -> None:
        if world_of(rig).t - 100 > moment:
            raise KeyboardInterrupt

    return check


RATE = 100.0  # Hz


def began(rig: Rig, target: float, rate: float = RATE) -> Conductor:
    """Bring an open rig to a pressure."""
    conductor = Conductor(rig, rate)
    conductor.start()
    conductor.ramp(np.full(3, target))
    conductor.settle(np.full(3, target), lambda rows: False, 1.0)
    return conductor


def stall(rig: Rig, seconds: float) -> None:
    """Let the experiment stand still; what guards the arm goes on."""
    rig.clock.sleep(seconds)


def written(rig: Rig, start: int = 0) -> np.ndarray:
    return np.array([value[0] for _, value in world_of(rig).writes[start:]])
