"""The model of the regulators against the same equations in much finer steps."""

from __future__ import annotations

import numpy as np
import pytest

from stiffopt.control.regulators import RegulatorModel

BAR = 1e5
NAN = np.full(2, np.nan)


class Fine:
    """Dead time, lag, slew and a highest pressure, in steps of 0.1 ms."""

    STEP = 1e-4

    def __init__(self, lag, dead_time, slew, highest=np.inf, shift=0.0) -> None:
        self.lag, self.slew, self.highest, self.shift = lag, slew, highest, shift
        self.pressures = np.zeros(2)
        self.queue = [np.zeros(2)] * round(dead_time / self.STEP)

    def run(self, commanded, duration):
        for _ in range(round(duration / self.STEP)):
            self.queue.append(commanded)
            wanted = np.minimum(self.queue.pop(0) + self.shift, self.highest)
            rate = np.clip((wanted - self.pressures) / self.lag, -self.slew, self.slew)
            self.pressures = self.pressures + self.STEP * rate
        return self.pressures


def commands(n, period, seed=3):
    """Steps that are held for a while."""
    rng = np.random.default_rng(seed)
    held = max(1, round(0.15 / period))
    return np.repeat(rng.uniform(0, 1.2 * BAR, (n // held + 1, 2)), held, axis=0)[:n]


@pytest.mark.parametrize("period", [0.002, 0.01])
@pytest.mark.parametrize(("lag", "dead_time"), [(0.06, 0.01), (0.03, 0.04)])
def test_open_loop_follows_lag_and_dead_time(period, lag, dead_time):
    slew = np.full(2, 100 * BAR)
    model = RegulatorModel(period, lag, dead_time, slew)
    fine = Fine(lag, dead_time, slew)
    for command in commands(round(1.0 / period), period):
        truth = fine.run(command, period)
        assert model.advance(command, NAN) == pytest.approx(truth, abs=2e-3 * BAR)


def test_slew_limits_the_way():
    """The limit acts on whole steps: off by no more than the step in which it ceases."""
    slew = np.array([2 * BAR, 5 * BAR])
    model, fine = RegulatorModel(0.01, 0.06, 0.01, slew), Fine(0.06, 0.01, slew)
    before = np.zeros(2)
    for command in commands(100, 0.01):
        truth = fine.run(command, 0.01)
        found = model.advance(command, NAN)
        assert np.all(np.abs(found - before) <= slew * 0.01 * (1 + 1e-9))
        assert found == pytest.approx(truth, abs=0.02 * BAR)
        before = found


def test_each_channel_has_its_own_lag():
    model = RegulatorModel(0.01, [0.02, 0.2], 0.0, np.full(2, 100 * BAR))
    for _ in range(4):
        found = model.advance(np.full(2, BAR), NAN)
    assert found == pytest.approx(BAR * (1 - np.exp([-2.0, -0.2])), rel=1e-9)


def test_no_lag_is_no_lag():
    model = RegulatorModel(0.01, 0.0, 0.0, np.full(2, 1000 * BAR))
    assert model.advance(np.array([BAR, 0.5 * BAR]), NAN) == pytest.approx([BAR, 0.5 * BAR])


def test_ahead_is_where_the_pressures_are_a_dead_time_later_whatever_comes():
    model = RegulatorModel(0.01, 0.06, 0.03, np.full(2, 5 * BAR))
    given = commands(60, 0.01)
    expected = []
    for k, command in enumerate(given):
        model.advance(command, NAN)
        expected.append(model.ahead)
        if k >= 3:
            assert model.pressures == pytest.approx(expected[k - 3], abs=1e-6)
    # the last three, with other commands than before
    for _ in range(3):
        model.advance(np.full(2, 1.4 * BAR), NAN)
    assert model.pressures == pytest.approx(expected[-1], abs=1e-6)


def test_readings_correct_a_regulator_that_saturates():
    """It is known to be where it is; without readings it would be taken for 0.4 bar higher."""
    slew = np.full(2, 5 * BAR)
    model, fine = RegulatorModel(0.01, 0.06, 0.01, slew), Fine(0.06, 0.01, slew, 0.8 * BAR)
    command = np.array([1.2 * BAR, 0.5 * BAR])
    for _ in range(200):
        truth = fine.run(command, 0.01)
        model.advance(command, truth)
    assert model.pressures == pytest.approx([0.8 * BAR, 0.5 * BAR], abs=1e-3 * BAR)
    assert model.offset == pytest.approx([-0.4 * BAR, 0.0], abs=2e-3 * BAR)
    # once it is off its limit, it is found again within half a second
    command = np.array([0.6 * BAR, 0.5 * BAR])
    worst = 0.0
    for k in range(200):
        truth = fine.run(command, 0.01)
        found = model.advance(command, truth)
        if k >= 50:
            worst = max(worst, float(np.abs(found - truth).max()))
    assert worst < 0.02 * BAR
    assert model.offset == pytest.approx(0.0, abs=2e-3 * BAR)


def test_offset_of_a_regulator_is_learned_and_the_prediction_then_unbiased():
    slew, rng = np.full(2, 5 * BAR), np.random.default_rng(0)
    shift = np.array([0.03 * BAR, -0.02 * BAR])
    model, fine = RegulatorModel(0.01, 0.06, 0.01, slew), Fine(0.06, 0.01, slew, shift=shift)
    errors = []
    for command in commands(400, 0.01) * 0.5 + 0.2 * BAR:
        truth = fine.run(command, 0.01)
        reading = truth + rng.normal(0, 0.0015 * BAR, 2)
        errors.append(model.advance(command, reading) - truth)
    assert model.offset == pytest.approx(shift, abs=0.006 * BAR)
    late = np.array(errors)[200:]
    assert np.abs(late.mean(axis=0)).max() < 0.003 * BAR
    assert np.sqrt((late**2).mean()) < 0.005 * BAR


def test_readings_that_are_not_there_change_nothing():
    slew = np.full(2, 5 * BAR)
    with_, without = (RegulatorModel(0.01, 0.06, 0.01, slew) for _ in range(2))
    for k, command in enumerate(commands(50, 0.01)):
        reading = np.array([np.nan, np.inf if k % 2 else -np.inf])
        kept = reading.copy()
        found = with_.advance(command, reading)
        assert np.array_equal(reading, kept, equal_nan=True)
        assert found == pytest.approx(without.advance(command, NAN), rel=1e-12)
    # one channel that is read does not touch the other
    one = np.array([0.9 * BAR, np.nan])
    a, b = with_.advance(command, one), without.advance(command, NAN)
    assert a[0] != b[0]
    assert a[1] == b[1]


def test_begin_forgets():
    model = RegulatorModel(0.01, 0.06, 0.02, np.full(2, 5 * BAR))
    for command in commands(30, 0.01):
        model.advance(command, np.full(2, 0.3 * BAR))
    start = np.array([0.2 * BAR, 0.7 * BAR])
    model.begin(start)
    assert np.array_equal(model.ahead, start)
    for _ in range(20):
        assert model.advance(start, NAN) == pytest.approx(start, rel=1e-12)
