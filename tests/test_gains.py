"""Damping feedback: against the recursion that defines it, and in a loop in continuous time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from stiffopt.control.feedback import GainSchedule, lqr_gains

LAG, DAMPING, PERIOD = 0.06, 0.04, 0.01
HANGING = (6.0, 10.0, 14.0)  # rad/s, of the arms there are


def continuous(omega, damping=DAMPING, lag=LAG):
    """The axis: lag, then a mode, driven by its static position."""
    A = np.array([[-1 / lag, 0, 0], [0, 0, 1], [omega**2, -(omega**2), -2 * damping * omega]])
    return A, np.array([[1 / lag], [0.0], [0.0]])


def discrete(omega, duration, **others):
    """By the exponential, as a sampled system has it."""
    A, B = continuous(omega, **others)
    whole = expm(duration * np.block([[A, B], [np.zeros((1, 4))]]))
    return whole[:3, :3], whole[:3, 3:]


def poles(omega, gain, dead_steps, *, period=PERIOD, damping=DAMPING, lag=LAG):
    """Of the sampled loop whose command takes effect some whole periods later."""
    F, G = discrete(omega, period, damping=damping, lag=lag)
    n = 3 + dead_steps
    whole = np.zeros((n, n))
    whole[:3, :3] = F
    if dead_steps == 0:
        whole[:3, :3] -= G @ gain[None, :]
    else:
        whole[:3, 3:4] = G
        for k in range(dead_steps - 1):
            whole[3 + k, 4 + k] = 1.0
        whole[-1, :3] = -gain
    return np.linalg.eigvals(whole)


def damping_of(found, period=PERIOD):
    """Smallest share of critical damping of oscillating poles."""
    s = np.log(found.astype(complex)[np.abs(found) > 1e-9]) / period
    swinging = np.abs(s.imag) > 1e-3
    return float(np.min(-s.real[swinging] / np.abs(s[swinging]), initial=1.0))


@pytest.mark.parametrize("omega", [2.5, 10.0, 60.0, 150.0])
@pytest.mark.parametrize("period", [0.002, 0.01, 0.02])
def test_riccati_equation_by_running_the_recursion(omega, period):
    F, G = discrete(omega, period)
    Q, weight = np.diag([0.0, 1.0, 0.0]), 1.0
    S = Q.copy()
    for _ in range(200_000):
        K = (G.T @ S @ F) / (weight + (G.T @ S @ G))
        after = F.T @ S @ (F - G @ K) + Q
        done = np.abs(after - S).max() < 1e-13 * np.abs(S).max()
        S = after
        if done:
            break
    found = lqr_gains(omega, DAMPING, LAG, period, weight)
    assert found == pytest.approx(K[0], rel=1e-5, abs=1e-8)


@pytest.mark.parametrize("omega", [2.5, 6.0, 10.0, 14.0, 30.0])
def test_damping_increases(omega):
    gains = GainSchedule(PERIOD, LAG, DAMPING, 1.0)
    with_ = damping_of(poles(omega, gains.at(omega), 0))
    without = damping_of(poles(omega, np.zeros(3), 0))
    assert without == pytest.approx(DAMPING, rel=0.01)
    assert with_ > 3 * without


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("period", "dead_steps"), [(0.01, 1), (0.002, 5)])
@pytest.mark.parametrize("omega", HANGING)
@pytest.mark.parametrize("off", [0.8, 1.0, 1.2])
@pytest.mark.parametrize("lag", [0.06, 0.03, 0.12])
def test_stays_stable_with_dead_time_and_wrong_models(period, dead_steps, omega, off, lag):
    """Without any prediction; even then, the swing is damped better than by itself."""
    gain = GainSchedule(period, LAG, DAMPING, 1.0).at(omega)
    found = poles(omega * off, gain, dead_steps, period=period, lag=lag)
    assert np.abs(found).max() < 1
    assert damping_of(found, period) > 1.3 * DAMPING


def test_tables_in_between_are_the_regulator_itself():
    gains = GainSchedule(PERIOD, LAG, DAMPING, 1.0)
    for omega in (2.0, 3.7, 11.3, 47.0, 199.0):
        assert gains.at(omega) == pytest.approx(
            lqr_gains(omega, DAMPING, LAG, PERIOD, 1.0), rel=0.02, abs=2e-3
        )


def test_outside_the_table_the_nearest_counts():
    gains = GainSchedule(PERIOD, LAG, DAMPING, 1.0)
    assert np.array_equal(gains.at(0.1), gains.at(2.0))
    assert np.array_equal(gains.at(1e4), gains.at(200.0))


def test_cheaper_effort_is_stronger():
    mild, strong = (lqr_gains(10.0, DAMPING, LAG, PERIOD, weight) for weight in (10.0, 0.1))
    assert np.linalg.norm(strong) > 2 * np.linalg.norm(mild)


def test_regulators_without_lag():
    gain = GainSchedule(PERIOD, 0.0, DAMPING, 1.0).at(10.0)
    assert np.isfinite(gain).all()
    assert np.abs(poles(10.0, gain, 1, lag=1e-3)).max() < 1
