"""Lags of the regulators, adapted to readings: found in motion, kept at rest, bounded, applied."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt.control.lags import LagEstimator
from stiffopt.control.tuning import LagTuning
from stiffopt.rig.settings import ControlSettings
from test_controller import Bench

Array = NDArray[np.float64]

BAR, PERIOD, LAG, SLEW = 1e5, 0.01, 0.06, 5e5
TUNING = LagTuning()
HANGING = "stiff-flop-2-hanging"


class Line:
    """Three regulators with a dead time of one period, and the estimator of their lags."""

    def __init__(self, *lags: float) -> None:
        self.lags, self.p, self.command = np.array(lags), np.zeros(3), np.zeros(3)
        self.estimator = LagEstimator(PERIOD, np.full(3, LAG), PERIOD, np.full(3, SLEW), TUNING)
        self.before, self.noise = np.zeros(3), np.random.default_rng(0)
        self.lost, self.stuck = np.zeros(3, dtype=bool), np.zeros(3, dtype=bool)

    def to(self, *wanted: float, seconds: float = 1.0) -> Array:
        """Go to pressures in bar; return the estimated lags (n,)."""
        for _ in range(round(seconds / PERIOD)):
            for _ in range(10):
                change = (self.before - self.p) * (1 - np.exp(-0.1 * PERIOD / self.lags))
                most = 0.1 * SLEW * PERIOD
                self.p = self.p + np.where(self.stuck, 0.0, np.clip(change, -most, most))
            reading = 1.01 * self.p + 500.0 + self.noise.normal(0, 150, 3)
            self.estimator.advance(self.command, reading, self.lost)
            self.before = self.command
            step = np.array(wanted) * BAR - self.command
            self.command = self.command + np.clip(step, -SLEW * PERIOD, SLEW * PERIOD)
        return self.estimator.lag


def test_lags_are_found_in_motion() -> None:
    true = (0.04, 0.06, 0.1)
    line = Line(*true)
    for goal in ((1.0, 0.6, 0.9), (0.2, 1.2, 0.1), (0.8, 0.3, 1.3)):
        found = line.to(*goal)
    assert found == pytest.approx(true, rel=0.08)
    assert np.all(np.abs(found - true) < 3 * line.estimator.deviation)


def test_a_channel_at_rest_tells_nothing_about_its_lag() -> None:
    line = Line(0.04, 0.1, 0.1)
    line.to(1.0, 0.0, 0.0, seconds=20.0)
    assert line.estimator.lag[1:] == pytest.approx(LAG, rel=1e-3)
    assert line.estimator.deviation[1:] == pytest.approx(0.3 * LAG, rel=1e-3)
    moved = line.estimator.lag[0]
    line.to(1.0, 0.0, 0.0, seconds=20.0)
    assert line.estimator.lag[0] == pytest.approx(moved, rel=0.02)


def test_lags_stay_within_twice_and_half_of_the_rig_files() -> None:
    line = Line(0.005, 0.5, 0.06)
    for goal in ((1.0, 1.0, 1.0), (0.2, 0.2, 0.2)) * 3:
        found = line.to(*goal)
        assert np.all(found <= 2 * LAG + 1e-9)
        assert np.all(found >= LAG / 2 - 1e-9)


def test_a_lost_channel_tells_nothing_and_neither_does_one_without_a_gauge() -> None:
    line = Line(0.1, 0.1, 0.1)
    line.stuck[0] = line.lost[0] = True
    line.to(0.3, 0.3, 0.3)
    assert line.estimator.lag[0] == pytest.approx(LAG)
    silent = LagEstimator(PERIOD, np.full(3, LAG), PERIOD, np.full(3, SLEW), TUNING)
    for k in range(100):
        silent.advance(np.full(3, 1e3 * k), np.full(3, np.nan), np.zeros(3, dtype=bool))
    assert silent.lag == pytest.approx(LAG)


def test_what_is_known_outlasts_a_restart() -> None:
    line = Line(0.1, 0.1, 0.1)
    found = line.to(1.0, 0.5, 0.8)
    line.estimator.begin()
    assert line.estimator.lag == pytest.approx(found)


@pytest.mark.usefixtures("compiled")
def test_the_loop_uses_and_shows_adapted_lags_and_nothing_moves_when_it_begins_to() -> None:
    bench = Bench(HANGING, supply={"lag": 0.11}, control=ControlSettings())
    pressures, controller = bench.controller._arm.pressures, bench.controller
    position, used, last = bench.pose_at(np.full(6, 0.5) * BAR)[:3, 3], pressures.lag, bench.command
    controller.set_task(bench.task(position=tuple(map(float, position))))
    moved = 0.0
    for _ in range(300):
        bench.run(bench.period)
        if pressures.lag != used:
            moved = max(moved, float(np.abs(bench.command - last).max()))
        used, last = pressures.lag, bench.command
    assert pressures.lag == pytest.approx(0.11, rel=0.15)
    assert controller._reference._lag == pressures.lag
    assert 0 < moved < 0.01 * BAR
    told = {number.key: number for number in controller.status(bench.rig.clock.now()).adapted}
    shown = [told[f"regulator_lag[{channel}]"].value for channel in range(6)]
    assert shown == pytest.approx(pressures.lags.lag)
    without = Bench(HANGING, control=ControlSettings(adaptation="none")).controller
    assert without._arm.pressures.lags is None
