"""The reference and its inverse, driven through regulators and a swing in fine steps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cont2discrete

from stiffopt.control.reference import Reference, VibrationFilter

BAR = 1e5
SLEW = np.array([5 * BAR, 5 * BAR])


def made(period=0.01, lag=0.06, rate=12.0, omega=10.0, damping=0.04, extra=0):
    reference = Reference(period, SLEW, lag, damping, extra)
    reference.rate, reference.omega = rate, omega
    return reference


def swung(commands, period, lag, dead_time, omega, damping, fine=1e-3):
    """What regulators (exact lag and dead time) and a mode make of held commands (k,)."""
    A = np.array([[-1 / lag, 0, 0], [0, 0, 1], [omega**2, -(omega**2), -2 * damping * omega]])
    B = np.array([[1 / lag], [0], [0]])
    F, G, *_ = cont2discrete((A, B, np.eye(3), np.zeros((3, 1))), fine)
    held = np.repeat(commands, round(period / fine))
    held = np.concatenate([np.zeros(round(dead_time / fine)), held])
    x, out = np.zeros(3), []
    for u in held:
        out.append(x[1])
        x = F @ x + G[:, 0] * u
    return np.arange(len(held)) * fine, np.array(out)


@pytest.mark.parametrize(("period", "bound"), [(0.002, 0.001), (0.01, 0.01)])
@pytest.mark.parametrize("omega", [6.0, 10.0, 20.0])
def test_commands_put_the_arm_on_the_path_without_a_swing(period, bound, omega):
    damping, lag, dead_time = 0.04, 0.06, 0.01
    reference = made(period, lag, 1.2 * omega, omega, damping)
    goal = np.array([0.5 * BAR, 0.2 * BAR])
    commands, paths, times = [], [], []
    for k in range(round(40 / omega / period)):
        reference.advance(goal)
        commands.append(reference.command[0])
        paths.append(reference.path[0])
        times.append(k * period)
    t, tip = swung(np.array(commands), period, lag, dead_time, omega, damping)
    # a command is held for a period: on average half a one late
    expected = np.interp(t, np.array(times) + dead_time + 0.5 * period, paths, left=0.0)
    assert np.abs(tip - expected)[: len(expected)].max() < bound * goal[0]
    # the swing left at the end, against that of a step, which is all of it
    assert np.abs(tip[-200:] - goal[0]).max() < 0.3 * bound * goal[0]
    _, raw = swung(np.full(len(commands), goal[0]), period, lag, dead_time, omega, damping)
    late = t > 8 / omega
    assert np.abs(raw[late] - goal[0]).max() > 0.3 * goal[0]


def test_chamber_pressures_are_those_without_the_lag():
    omega, damping = 10.0, 0.04
    reference = made(omega=omega, damping=damping)
    for _ in range(12):
        reference.advance(np.full(2, BAR))
    _, first, second, _ = reference.motion
    expected = reference.path + 2 * damping / omega * first + second / omega**2
    assert reference.chamber == pytest.approx(expected, rel=1e-12)


def test_arm_that_does_not_swing():
    reference = made(omega=np.inf)
    for _ in range(8):
        reference.advance(np.full(2, BAR))
    assert reference.chamber == pytest.approx(reference.path, rel=1e-12)
    assert reference.command == pytest.approx(
        reference.path + 0.06 * reference.motion[1], rel=1e-12
    )


def test_derivatives_are_those_of_the_path():
    period = 1e-4
    reference = made(period, rate=15.0)
    path, given = [], []
    for k in range(6000):
        goal = np.array([np.sin(3 * k * period), np.cos(2 * k * period) - 1]) * 0.05 * BAR
        reference.advance(goal)
        path.append(reference.path.copy())
        given.append(reference.motion[1:].copy())
    path, given = np.array(path), np.array(given)
    for order in range(3):
        path = np.diff(path, axis=0) / period
        middle = given[len(given) - len(path) :, order] * 1.0
        # finite differences lag by half a step for each order
        scale = np.abs(middle).max()
        shift = (order + 1) // 2
        aligned = given[: len(path) + shift, order][shift:]
        assert np.abs(path - aligned)[50:].max() < 0.02 * scale


def test_slew_is_kept_by_path_and_by_all_channels_together():
    """The way between pressures is straight: all channels are at the same share of it."""
    reference = made()
    goal = np.array([1.2 * BAR, -0.3 * BAR])
    before = reference.path.copy()
    for _ in range(120):
        reference.advance(goal)
        now = reference.path.copy()
        assert np.all(np.abs(now - before) <= SLEW * 0.01 * (1 + 1e-9))
        assert now / goal == pytest.approx(np.full(2, now[0] / goal[0]), abs=1e-12)
        before = now
    assert now == pytest.approx(goal, rel=0.02)


def test_neither_the_tip_nor_its_part_by_a_channel_is_faster_than_asked():
    """Channels that move the tip in opposite directions go no faster than one alone."""
    period, speed = 0.01, 0.02
    for jacobian, fastest in (
        ([[3e-7, 2e-7], [0.0, 0.0], [0.0, 0.0]], 1.0),  # the tip: they add up
        ([[3e-7, -3e-7], [0.0, 0.0], [0.0, 0.0]], 1.0),  # the first one; the tip hardly moves
        ([[0.0, 0.0]] * 3, np.inf),
    ):
        reference, J = made(period, omega=np.inf), np.array(jacobian)
        reference.motion_share = J / (speed * period)
        goal, rates = np.array([1.2 * BAR, 0.9 * BAR]), []
        for _ in range(400):
            reference.advance(goal)
            rates.append(reference.motion[1].copy())
        moved = J * np.array(rates)[:, None, :]
        parts = np.linalg.norm(moved, axis=1).max()
        tip = np.linalg.norm(moved.sum(axis=2), axis=1).max()
        if np.isfinite(fastest):
            assert max(parts, tip) == pytest.approx(speed, rel=1e-3)
        else:
            assert np.linalg.norm(rates, axis=1).max() > 4 * speed / 3e-7  # as fast as its lags
        assert reference.path == pytest.approx(goal, rel=1e-3)


def test_what_goes_with_the_pressures_is_on_the_same_way():
    reference = made(extra=1)
    goal = np.array([1.0 * BAR, 0.5 * BAR, 7e-3])
    for _ in range(40):
        reference.advance(goal)
        share = reference.path / goal
        assert share == pytest.approx(np.full(3, share[0]), abs=1e-12)
    assert len(reference.command) == 2


@pytest.mark.parametrize("rate", [5.0, 12.0, 40.0])
def test_delay_is_by_how_much_a_ramp_is_late(rate):
    period = 1e-3
    reference = made(period, rate=rate)
    slope = 0.2 * BAR
    for k in range(4000):
        reference.advance(np.full(2, slope * k * period))
    late = (slope * 3999 * period - reference.path[0]) / slope
    assert late == pytest.approx(reference.delay, abs=5 * period)


def test_begin_is_at_rest():
    reference = made()
    values = np.array([0.3 * BAR, 0.1 * BAR])
    for _ in range(5):
        reference.advance(np.full(2, BAR))
    reference.begin(values)
    assert np.array_equal(reference.path, values)
    assert not np.any(reference.motion[1:])
    reference.advance(values)
    assert reference.command == pytest.approx(values, rel=1e-12)


def test_change_of_rate_leaves_the_path_where_it_is():
    reference = made()
    for _ in range(10):
        reference.advance(np.full(2, BAR))
    path = reference.path.copy()
    reference.rate = 20.0
    assert np.array_equal(reference.path, path)


@pytest.mark.parametrize("period", [0.002, 0.01])
@pytest.mark.parametrize("omega", [6.0, 9.7, 20.0])
def test_average_over_a_vibration_moves_the_mode_on_its_path_and_leaves_no_vibration(period, omega):
    damping, end = 0.04, 2 * np.pi / omega
    averaged = VibrationFilter(period, damping, 1)
    values, paths, rates = [], [], []
    for k in range(round(3 * end / period)):
        averaged.advance(np.array([1.0 if k * period > 0.2 * end else 0.0]), omega)
        values.append(averaged.value[0])
        paths.append(averaged.motion[0, 0])
        rates.append(averaged.motion[1, 0])
    A, B = (
        np.array([[0.0, 1.0], [-(omega**2), -2 * damping * omega]]),
        np.array([[0.0], [omega**2]]),
    )
    F, G, *_ = cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), period)
    x, tip = np.zeros(2), []
    for value in values:
        tip.append(x.copy())
        x = F @ x + G[:, 0] * value
    bound = 3 * omega * period / (2 * np.pi)
    assert np.abs(np.array(tip)[:, 0] - paths).max() < bound
    assert np.abs(np.array(tip)[:, 1] - rates).max() < 2 * omega * bound
    assert paths[-1] == pytest.approx(1.0, abs=1e-9)
    assert values[-1] == pytest.approx(1.0, abs=1e-9)
    # nothing is left when the average has arrived, one vibration after the step
    late = np.arange(len(tip)) * period > 1.2 * end + 2 * period
    assert np.abs(np.array(tip)[late, 0] - 1).max() < 0.3 * bound


def test_average_without_a_vibration_is_the_value_itself():
    averaged = VibrationFilter(0.01, 0.04, 2)
    averaged.begin(np.array([1.0, -1.0]))
    averaged.advance(np.array([2.0, -3.0]), np.inf)
    assert averaged.value == pytest.approx([2.0, -3.0])
    assert averaged.motion[0] == pytest.approx([2.0, -3.0])


def test_average_is_shifted_as_a_whole():
    averaged = VibrationFilter(0.01, 0.04, 1)
    for k in range(80):
        averaged.advance(np.array([np.sin(0.1 * k)]), 9.0)
    before, path = averaged.value.copy(), averaged.motion.copy()
    averaged.shift(np.array([0.5]))
    assert averaged.value == pytest.approx(before + 0.5)
    assert averaged.motion == pytest.approx(path + np.array([[0.5], [0.0]]))
    averaged.advance(np.array([np.sin(8.0) + 0.5]), 9.0)
    assert averaged.value == pytest.approx(before + 0.5, abs=0.05)
