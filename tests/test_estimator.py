"""The estimator of the tip: on a truth of just the form it assumes, and against a plain filter.

The plain filter is run again from the beginning for every sample, in order of capture; it has the
state (xi, w, d) of each axis in one vector and matrices in place of what the estimator carries on.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag, expm

from conftest import is_long
from stiffopt import lie
from stiffopt.control.estimator import TipEstimator
from stiffopt.control.tuning import EstimatorTuning
from stiffopt.control.vibration import BendingMode
from stiffopt.optimise.tip import TipAt
from stiffopt.rig.interface import PoseSample

PERIOD, OMEGA, ZETA = 0.01, 10.0, 0.04
MASS = 0.04
BASE = np.array([0.01, 0.0, 0.18])
# m/Pa: the first channel moves the tip along x, the second along y and a little along z
J = np.array([[3e-7, 0.0], [0.0, 3e-7], [0.0, 0.5e-7]])
SHARES = np.array([0.9, 0.6])
SWINGING = BendingMode(MASS, SHARES)
PLAIN = EstimatorTuning(
    model_error=0.0, excitation_error=0.0, frequency_error=0.0, damping=ZETA,
    frequency_offset=0.0, frequency_deviation=0.0,
)  # fmt: skip


def tip_at(p, rotation=None):
    """A tip that is linear in the pressures, soft in x and y."""
    R = np.eye(3) if rotation is None else rotation
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R, BASE + J @ p
    jacobian = np.zeros((6, 2))
    jacobian[:3] = R.T @ J
    soft = 1 / (MASS * OMEGA**2)
    linear = R.T @ np.diag([soft, soft, soft / 1e9]) @ R
    return TipAt(pose, jacobian, block_diag(linear, np.eye(3)))


def sample(time, position, quaternion=None, frame=0):
    return PoseSample(time, time, frame, np.array(position, dtype=float), quaternion)


def mode(omega=OMEGA):
    return np.array([[0, 1], [-(omega**2), -2 * ZETA * omega]])


class Truth:
    """Swing in x and y, driven by what the pressures move, and an offset, in steps of 1 ms."""

    STEP = 1e-3

    def __init__(self, seed=0, offset=(3e-3, -2e-3, 1e-3), agitation=0.0, drift=0.0):
        self.rng = np.random.default_rng(seed)
        self.offset = np.array(offset)
        self.eta = np.zeros((2, 2))  # swing and speed, x and y
        self.p, self.agitation, self.drift = np.zeros(2), agitation, drift
        self.F = expm(self.STEP * mode())
        self.positions = [self.position]

    @property
    def position(self):
        return BASE + J @ self.p + np.array([*self.eta[0], 0.0]) + self.offset

    def run(self, p, duration):
        """Pressures go straight to p (2,)."""
        n = round(duration / self.STEP)
        for k in range(n):
            now = self.p + (p - self.p) / (n - k)
            driven = (J[:2] * SHARES) @ (now - self.p)
            self.p = now
            self.eta[0] -= 0.5 * driven
            self.eta = self.F @ self.eta
            self.eta[0] -= 0.5 * driven
            root = math.sqrt(self.STEP)
            self.eta[1] += self.agitation * root * self.rng.normal(size=2)
            self.offset = self.offset + self.drift * root * self.rng.normal(size=3)
            self.positions.append(self.position)


def test_frequency_where_the_tip_is_that_of_the_model():
    estimator = TipEstimator(PERIOD, 2, SWINGING, PLAIN)
    estimator.set_frequency(1.3 * OMEGA, tip_at(np.zeros(2)))
    estimator.advance(0.0, np.zeros(2), tip_at(np.zeros(2)))
    assert estimator.omega == pytest.approx(1.3 * OMEGA, rel=1e-9)


def pressures(k):
    """A wandering command, smooth enough to be read each tick."""
    t = k * PERIOD
    return 4e4 * np.array([np.sin(1.7 * t), np.sin(1.1 * t)]) * min(1.0, t)


def follow(estimator, truth, ticks, noise, latency, every=0.025, jitter=0.0, seed=1, spoil=None):
    """Let both run; return errors (ticks, 3) of the estimated position."""
    estimator.learns = True
    rng = np.random.default_rng(seed)
    waiting, errors, due, frame = [], [], every, 0
    for k in range(1, ticks + 1):
        truth.run(pressures(k), PERIOD)
        now = k * PERIOD
        while due <= now:
            seen = truth.positions[round(due / truth.STEP)] + noise * rng.normal(size=3)
            arrives = due + latency + jitter * rng.uniform()
            waiting.append((arrives, sample(round(due / truth.STEP) * truth.STEP, seen)))
            due, frame = due + every, frame + 1
        arrived = [s for a, s in waiting if a <= now]
        waiting = [(a, s) for a, s in waiting if a > now]
        estimator.advance(now, truth.p, tip_at(truth.p))
        estimator.take([spoil(s, frame) if spoil else s for s in arrived])
        errors.append(estimator.estimate.position - truth.position)
    return np.array(errors)


# -- on truth ---------------------------------------------------------------------------------


def test_late_and_jittered_samples_give_truth_without_noise():
    estimator, truth = TipEstimator(PERIOD, 2, SWINGING, PLAIN), Truth()
    errors = follow(estimator, truth, 600, 0.0, 0.025, jitter=0.02)
    assert np.abs(truth.eta[0]).max() > 1e-4  # there is a swing to be estimated
    assert np.abs(errors[300:]).max() < 3e-5
    assert estimator.estimate.offset == pytest.approx(truth.offset, abs=3e-5)
    assert estimator.estimate.vibration[:2] == pytest.approx(truth.eta[0], abs=3e-5)
    assert estimator.estimate.speed[:2] == pytest.approx(truth.eta[1], abs=3e-4)
    assert estimator.omega == pytest.approx(OMEGA, rel=1e-9)


def test_ticks_that_come_late_give_truth_too():
    """A loop that takes half as long again as it should, and now and then ten times."""
    estimator, truth = TipEstimator(PERIOD, 2, SWINGING, PLAIN), Truth()
    rng, now, due, waiting, errors = np.random.default_rng(5), 0.0, 0.025, [], []
    while now < 7.0:
        duration = truth.STEP * round((100 if rng.uniform() < 0.01 else 15) + rng.integers(-4, 5))
        now += duration
        truth.run(pressures(now / PERIOD), duration)
        while due <= now:
            waiting.append(sample(due, truth.positions[round(due / truth.STEP)]))
            due += 0.025
        estimator.advance(now, truth.p, tip_at(truth.p))
        arrived = [s for s in waiting if s.time + 0.025 <= now]
        waiting = [s for s in waiting if s.time + 0.025 > now]
        estimator.take(arrived)
        errors.append(estimator.estimate.position - truth.position)
    assert np.abs(truth.eta[0]).max() > 1e-4
    assert np.quantile(np.abs(errors[-200:]).max(axis=1), 0.9) < 8e-5


def test_errors_are_as_small_as_the_theory_allows():
    """Noise and drift as assumed: unbiased, and with the deviation of the Kalman filter."""
    settings = PLAIN
    every, latency = 0.025, 0.025
    # covariance of (xi, w, d) right after a sample, iterated; then carried on to the present
    F = block_diag(expm(every * mode()), 1.0)
    fine, Q = block_diag(expm(1e-3 * mode()), 1.0), np.zeros((3, 3))
    own = 1e-3 * np.diag([0.0, settings.agitation**2, settings.drift**2])
    for _ in range(25):
        Q = fine @ Q @ fine.T + own
    row, P = np.array([1.0, 0.0, 1.0]), np.diag([1e-2, 2.5e-3, 1e-2])
    for _ in range(2000):
        P = F @ P @ F.T + Q
        gain = P @ row / (row @ P @ row + settings.noise**2)
        P = P - np.outer(gain, row @ P)
    ages = np.arange(0.025, 0.05, 0.01)  # of the last sample, at a tick
    variances = []
    for age in ages:
        later = P.copy()
        for _ in range(round(age / 1e-3)):
            later = fine @ later @ fine.T + own
        variances.append(row @ later @ row)
    best = math.sqrt(np.mean(variances))
    errors = []
    for seed in range(3 if is_long() else 2):
        truth = Truth(seed, agitation=settings.agitation, drift=settings.drift)
        estimator = TipEstimator(PERIOD, 2, SWINGING, settings)
        errors.append(follow(estimator, truth, 1200, settings.noise, latency, seed=seed)[400:, :2])
    found = np.concatenate(errors)
    rms = math.sqrt((found**2).mean())
    assert 0.8 * best < rms < 1.25 * best
    assert np.abs(found.mean(axis=0)).max() < 0.3 * best


def test_arm_that_does_not_swing():
    truth = Truth()
    truth.F = np.zeros((2, 2))
    estimator = TipEstimator(PERIOD, 2, None, EstimatorTuning())
    rng = np.random.default_rng(4)
    errors = []
    for k in range(1, 500):
        p = pressures(k)
        estimator.advance(k * PERIOD, p, tip_at(p))
        true = BASE + J @ p + truth.offset
        if k % 3 == 0:
            late = BASE + J @ pressures(k - 3) + truth.offset + rng.normal(0, 5e-5, 3)
            estimator.take([sample((k - 3) * PERIOD, late)])
        errors.append(estimator.estimate.position - true)
    assert not estimator.estimate.vibration.any()
    assert np.sqrt((np.array(errors)[200:] ** 2).mean()) < 6e-5
    assert estimator.omega == math.inf


def test_pressures_and_model_at_the_capture_of_a_sample_between_ticks():
    estimator = TipEstimator(PERIOD, 2, None, EstimatorTuning())
    for k in range(1, 60):
        p = pressures(k)
        estimator.advance(k * PERIOD, p, tip_at(p))
        if k % 3 == 0:
            estimator.take([sample((k - 3.4) * PERIOD, BASE + J @ pressures(k - 3.4))])
    between = 0.4 * pressures(53) + 0.6 * pressures(54)  # at the last capture, tick 53.6
    assert estimator.captured == pytest.approx(between, rel=1e-9)
    assert estimator.predicted == pytest.approx(BASE + J @ between, abs=1e-12)


@pytest.mark.parametrize("softness", [np.inf, -1.0, 1e30])
def test_an_arm_that_has_no_stiffness_left_does_no_harm(softness):
    """About to buckle, say; an omega of 0 would be for ever after."""
    estimator, truth, now = settled()
    limp = tip_at(truth.p)._replace(compliance=np.diag([softness] * 3 + [1.0] * 3))
    if not np.isfinite(softness):
        limp = tip_at(truth.p)._replace(compliance=np.diag([1e300, 1e300, 1.0, 1, 1, 1]))
    for k in range(1, 12):
        estimator.advance(now + k * PERIOD, truth.p, limp)
        estimator.take([sample(now + k * PERIOD, truth.position)])
    assert estimator.omega > 0
    assert np.isfinite(state(estimator)).all()
    for k in range(12, 80):
        estimator.advance(now + k * PERIOD, truth.p, tip_at(truth.p))
        estimator.take([sample(now + k * PERIOD, truth.position)])
    assert estimator.estimate.position == pytest.approx(truth.position, abs=1e-3)


# -- frequency and viscosity --------------------------------------------------------------------


@pytest.mark.parametrize("modelled", [0.93, 1.0, 1.06])
def test_a_frequency_that_is_modelled_wrongly_is_learned_in_motion(modelled):
    settings = replace(PLAIN, frequency_offset=-0.025, frequency_deviation=0.05)
    estimator, truth = TipEstimator(PERIOD, 2, SWINGING, settings), Truth()
    estimator.set_frequency(modelled * OMEGA, tip_at(np.zeros(2)))
    estimator.advance(0.0, np.zeros(2), tip_at(np.zeros(2)))
    begun = settings.frequency_offset
    assert estimator.omega == pytest.approx((1 + begun) * modelled * OMEGA, rel=1e-9)
    errors = follow(estimator, truth, 1000, 5e-5, 0.025)
    assert estimator.omega == pytest.approx(OMEGA, rel=0.01)
    error, variance = estimator.detuning
    assert error == pytest.approx(1 / modelled - 1, abs=0.01)
    assert 0 < variance < (0.6 * settings.frequency_deviation) ** 2
    assert np.sqrt((errors[600:] ** 2).mean()) < 1e-4


def test_a_frequency_that_is_far_off_stays_within_its_bound():
    settings = replace(PLAIN, frequency_deviation=0.05, frequency_bound=0.03)
    estimator = TipEstimator(PERIOD, 2, SWINGING, settings)
    estimator.set_frequency(1.1 * OMEGA, tip_at(np.zeros(2)))
    follow(estimator, Truth(), 1000, 5e-5, 0.025)
    assert -settings.frequency_bound <= estimator.detuning[0] < -0.9 * settings.frequency_bound
    assert estimator.omega >= (1 - settings.frequency_bound) * 1.1 * OMEGA


def test_what_shakes_the_arm_does_not_change_its_frequency_while_it_is_to_rest():
    settings = replace(PLAIN, frequency_deviation=0.05)
    for learns in (True, False):
        estimator = TipEstimator(PERIOD, 2, SWINGING, settings)
        estimator.set_frequency(OMEGA, tip_at(np.zeros(2)))
        follow(estimator, Truth(), 200, 5e-5, 0.025)
        estimator.learns, known = learns, estimator.detuning[0]
        for k in range(201, 1200):
            estimator.advance(k * PERIOD, pressures(200), tip_at(pressures(200)))
            shaken = np.array([2e-3 * math.sin(0.5 * OMEGA * k * PERIOD), 0.0, 0.0])
            estimator.take([sample(k * PERIOD, BASE + J @ pressures(200) + shaken)])
        assert (estimator.frequency_off == 1.0) is learns
        assert (estimator.detuning[0] == known) is not learns


def test_a_model_of_another_frequency_keeps_what_samples_have_told_of_it():
    """Independent: two normal likelihoods of the frequency, one of the prior, one of samples."""
    settings = replace(PLAIN, frequency_offset=-0.025, frequency_deviation=0.03)
    for told, ratio in [(0.0, 0.9), (0.01, 0.9), (0.01, 1.05)]:  # deviation by samples, in parts
        estimator = TipEstimator(PERIOD, 2, SWINGING, settings)
        prior, seen = np.array([settings.frequency_offset, 0.03**-2]), np.array([-0.06, 0.0])
        if told:
            seen[1] = told**-2
        precision = prior[1] + seen[1]
        mean = (prior[0] * prior[1] + seen[0] * seen[1]) / precision
        estimator.detuning = np.array([mean, 1 / precision])
        estimator.change_frequency(OMEGA, ratio * OMEGA)
        seen[0] = (1 + seen[0]) / ratio - 1  # the same frequency
        expected = (prior[0] * prior[1] + seen[0] * seen[1]) / precision
        assert estimator.detuning == pytest.approx([expected, 1 / precision], abs=2e-3)


@pytest.mark.parametrize("lag", [0.02, 0.06])
def test_a_shape_that_viscosity_makes_late_while_the_mode_is_not(lag):
    """The truth: x = s(late) + m - s_v(late), with m the mode's response to the pressures."""
    step, known = 1e-3, TipEstimator(PERIOD, 2, SWINGING, PLAIN)
    plain = TipEstimator(PERIOD, 2, SWINGING, PLAIN)
    A, moves = mode(), J[:2] * SHARES
    F, state, late, errors = expm(step * A), np.zeros((2, 2)), np.zeros(2), []
    for k in range(1, 800):
        for fine in range(10):
            p = pressures(k - 1 + (fine + 1) / 10)
            late = late + (1 - math.exp(-step / lag)) * (p - late)
            rest = np.array([moves @ p, np.zeros(2)])
            state = rest + F @ (state - rest)
        position = BASE + J @ late + np.append(state[0] - moves @ late, 0.0)
        known.advance(k * PERIOD, late, tip_at(late), p - late)
        plain.advance(k * PERIOD, p, tip_at(p))
        for estimator in (known, plain):
            estimator.take([sample(k * PERIOD, position)])
        errors.append([e.estimate.offset for e in (known, plain)])
    errors = np.abs(np.array(errors)[200:]).max(axis=(0, 2))
    assert errors[0] < 0.2 * errors[1]


# -- against a filter that is run again ---------------------------------------------------------


class Replay:
    """Ticks and samples are kept; the answer is a filter over all of them in order of time."""

    def __init__(self, settings):
        self.s, self.events = settings, []

    def tick(self, time, p):
        self.events.append((time, 0, p.copy()))

    def see(self, time, position):
        self.events.append((time, 1, position))

    def answer(self):
        """State (9,): xi x y z, w x y z, d x y z, at the last tick."""
        s = self.s
        mean = np.zeros(9)
        # x, y: xi, w, d; z: d alone
        P = np.diag([1e-2, 1e-2, 0, 2.5e-3, 2.5e-3, 0, 1e-2, 1e-2, 1e-2])
        H = np.hstack([np.diag([1.0, 1.0, 0.0]), np.zeros((3, 3)), np.eye(3)])
        B = np.diag([1.0, 1.0, 0.0]) @ (J * SHARES)
        at, p, last_seen, static = None, None, None, None
        events = sorted(self.events, key=lambda e: (e[0], e[1]))
        for time, kind, value in events:
            if at is not None and time > at:
                F = self.matrix(time - at)
                if kind == 0 and p is not None:
                    mean[:3] -= 0.5 * B @ (value - p)
                mean = F @ mean
                if kind == 0 and p is not None:
                    mean[:3] -= 0.5 * B @ (value - p)
            at = time
            if kind == 0:
                p, static = value, BASE + J @ value
                continue
            if last_seen is not None:
                elapsed = time - last_seen
                F = self.matrix(elapsed)
                grown = [0, 0, 0] + [s.agitation**2] * 2 + [0] + [s.drift**2] * 3
                P = F @ P @ F.T + elapsed * np.diag(grown)
            last_seen = time
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + s.noise**2 * np.eye(3))
            mean = mean + K @ (value - static - H @ mean)
            P = (np.eye(9) - K @ H) @ P
        return mean

    @staticmethod
    def matrix(duration):
        F = np.eye(9)
        F[np.ix_([0, 3], [0, 3])] = F[np.ix_([1, 4], [1, 4])] = expm(duration * mode())
        F[2, 2] = 1.0
        return F


@pytest.mark.parametrize("late", [1, 3, 7])
def test_carrying_corrections_on_is_a_replay(late):
    """Samples of ticks, delivered some ticks later, give the same as a filter run again."""
    estimator, truth = TipEstimator(PERIOD, 2, SWINGING, PLAIN), Truth(3)
    replay, rng = Replay(PLAIN), np.random.default_rng(8)
    seen = {}
    for k in range(1, 90):
        truth.run(pressures(k), PERIOD)
        now = k * PERIOD
        estimator.advance(now, truth.p, tip_at(truth.p))
        replay.tick(now, truth.p)
        if k == 1:
            estimator._update_mode(tip_at(truth.p))
        if k % 3 == 0:
            seen[k] = truth.position + rng.normal(0, 5e-5, 3)
        if k - late in seen:
            before = estimator.sample
            estimator.take([sample((k - late) * PERIOD, seen[k - late])])
            if estimator.sample is not before:
                replay.see((k - late) * PERIOD, seen[k - late])
        if k % 11 == 0 and k > 30:
            e = estimator.estimate
            found = np.concatenate([e.vibration, e.speed, e.offset])
            assert found == pytest.approx(replay.answer(), abs=1e-9)


def test_samples_between_ticks_are_nearly_a_replay():
    """There, the swing is taken on the straight way between ticks."""
    estimator, truth = TipEstimator(PERIOD, 2, SWINGING, PLAIN), Truth(3)
    errors = follow(estimator, truth, 500, 0.0, 0.03, every=0.017, jitter=0.01)
    assert np.abs(errors[250:]).max() < 3e-5


def test_two_samples_within_a_tick():
    """A tracker faster than the loop: the second sample knows of the first."""
    twice, once = (TipEstimator(PERIOD, 2, SWINGING, PLAIN) for _ in range(2))
    truth = Truth(3)
    for k in range(1, 40):
        truth.run(np.zeros(2), PERIOD)
        now = k * PERIOD
        for estimator in (twice, once):
            estimator.advance(now, np.zeros(2), tip_at(np.zeros(2)))
        if k > 20 and k % 3 == 0:
            positions = truth.positions[-8], truth.positions[-5]
            times = now - 7e-3, now - 4e-3
            twice.take([sample(t, x) for t, x in zip(times, positions, strict=True)])
            once.take([sample(times[1], positions[1])])
            # the arm is at rest with an offset: all of it is seen, at once and without noise
            for estimator in (twice, once) if k > 24 else ():
                assert estimator.estimate.position == pytest.approx(truth.position, abs=2e-4)


# -- what is not believed -----------------------------------------------------------------------


def settled(ticks=200, settings=PLAIN, vibration=SWINGING):
    estimator, truth = TipEstimator(PERIOD, 2, vibration, settings), Truth()
    follow(estimator, truth, ticks, 0.0, 0.025)
    return estimator, truth, ticks * PERIOD


def state(estimator):
    e = estimator.estimate
    return np.concatenate([e.vibration, e.speed, e.offset, e.turn])


def test_old_samples_are_left_out():
    estimator, truth, now = settled()
    before = state(estimator)
    seen = estimator.take([sample(now - 0.1, truth.position), sample(now - 2.0, truth.position)])
    assert (seen.used, seen.rejected) == (0, 0)
    assert np.array_equal(state(estimator), before)


def test_older_after_newer_is_left_out():
    estimator, truth, now = settled()
    newer, older = sample(now, truth.position), sample(now - 0.01, truth.position)
    assert estimator.take([newer, older]).used == 1
    assert estimator.sample is newer


@pytest.mark.parametrize("time", [1e3, math.nan, math.inf, -math.inf])
def test_samples_of_no_sensible_time_do_no_harm(time):
    estimator, truth, now = settled()
    before = state(estimator)
    assert estimator.take([sample(time, truth.position)]).used == 0
    assert np.array_equal(state(estimator), before)
    assert estimator.take([sample(now, truth.position)]).used == 1


def test_pose_that_was_not_seen_is_ignored():
    estimator, _, now = settled()
    before = state(estimator)
    seen = estimator.take([sample(now, [np.nan, 0, 0]), sample(now, [np.nan] * 3)])
    assert (seen.used, seen.rejected) == (0, 0)
    assert np.array_equal(state(estimator), before)


def test_jump_is_rejected_and_stays_so():
    estimator, truth, now = settled()
    before = state(estimator)
    jumped = truth.position + np.array([0.2, 0, 0])
    for k in range(1, 30):
        estimator.advance(now + k * PERIOD, truth.p, tip_at(truth.p))
        seen = estimator.take([sample(now + k * PERIOD, jumped)])
        assert (seen.used, seen.rejected) == (0, 1)
        assert seen.latest < now
    # the swing runs on; the offset has learned nothing
    assert state(estimator)[6:] == pytest.approx(before[6:], abs=0)
    # and where the tip is expected, it is believed again
    assert estimator.take([sample(now + 0.3, estimator.estimate.position)]).used == 1


@pytest.mark.parametrize("jump", [0.02, 0.028, 0.04])
def test_small_jump_that_stays_is_not_believed_after_a_while(jump):
    """What is rejected does not make the next one more plausible."""
    estimator, truth, now = settled(settings=replace(PLAIN, max_speed=0.6))
    assert estimator.take([sample(now, truth.position)]).used == 1
    jumped = truth.position + np.array([jump, 0, 0])
    for k in range(1, 12):
        time = now + 0.025 * k
        estimator.advance(time, truth.p, tip_at(truth.p))
        assert estimator.take([sample(time, jumped)]).rejected == 1


def test_frozen_pose_with_a_counting_frame_number_is_as_missing():
    """While the model moves the tip; at rest a tracker may well say the same twice."""
    estimator, truth, now = settled()
    stuck, p = truth.position.copy(), truth.p.copy()
    used = []
    for k in range(1, 30):
        p = p + 500.0
        estimator.advance(now + k * PERIOD, p, tip_at(p))
        moved = np.linalg.norm(tip_at(p).pose[:3, 3] - tip_at(truth.p).pose[:3, 3])
        seen = estimator.take([sample(now + k * PERIOD, stuck, frame=k)])
        assert seen.rejected == 0
        used.append(seen.used)
        assert not (moved > 3e-3 and seen.used)
    assert used[0] == 1
    assert used[-1] == 0


def test_outliers_among_good_samples_make_no_difference():
    good, bad = (TipEstimator(PERIOD, 2, SWINGING, PLAIN) for _ in range(2))
    follow(good, Truth(), 300, 5e-5, 0.025)
    rng = np.random.default_rng(0)
    errors = follow(
        bad, Truth(), 300, 5e-5, 0.025,
        spoil=lambda s, frame: sample(s.time, s.position + 0.3) if rng.uniform() < 0.2 else s,
    )  # fmt: skip
    assert np.abs(errors[150:]).max() < 5e-4
    assert bad.estimate.offset == pytest.approx(good.estimate.offset, abs=2e-4)


def test_wrong_first_sample_does_not_make_all_others_wrong():
    estimator, truth = TipEstimator(PERIOD, 2, SWINGING, PLAIN), Truth()
    rejected = 0
    for k in range(1, 40):
        truth.run(np.zeros(2), PERIOD)
        estimator.advance(k * PERIOD, np.zeros(2), tip_at(np.zeros(2)))
        shift = 0.3 if k == 1 else 0.0
        rejected += estimator.take([sample(k * PERIOD, truth.position + shift)]).rejected
    assert rejected <= 1
    assert estimator.estimate.position == pytest.approx(truth.position, abs=2e-4)


# -- orientation --------------------------------------------------------------------------------


def turned(vector):
    return lie.exp(np.concatenate([np.zeros(3), vector]))[:3, :3]


def quaternion(R):
    return lie.quaternion_from_rotation(R)


def test_offset_of_the_orientation_is_found_and_its_sign_does_not_matter():
    off = turned(np.array([0.05, -0.08, 0.03]))
    answers = []
    for signs in ([1.0], [-1.0], [1.0, -1.0]):
        estimator, truth = TipEstimator(PERIOD, 2, SWINGING, EstimatorTuning()), Truth()
        for k in range(1, 80):
            truth.run(np.zeros(2), PERIOD)
            estimator.advance(k * PERIOD, np.zeros(2), tip_at(np.zeros(2)))
            q = quaternion(off) * signs[k % len(signs)]
            estimator.take([sample(k * PERIOD, truth.position, q)])
        assert estimator.estimate.rotation == pytest.approx(off, abs=1e-3)
        assert estimator.estimate.turn == pytest.approx([0.05, -0.08, 0.03], abs=1e-3)
        assert estimator.turned == pytest.approx([0.05, -0.08, 0.03], abs=1e-9)
        answers.append(state(estimator))
    assert answers[1] == pytest.approx(answers[0], abs=1e-12)
    assert answers[2] == pytest.approx(answers[0], abs=1e-12)


def test_tracker_of_positions_alone():
    estimator, truth, _ = settled()
    assert estimator.estimate.turn == pytest.approx(np.zeros(3), abs=0)
    assert np.isfinite(estimator.estimate.rotation).all()
    assert estimator.estimate.position == pytest.approx(truth.position, abs=5e-5)


def test_begin_forgets():
    estimator, truth, now = settled()
    estimator.begin()
    p = np.zeros(2)
    estimator.advance(now, p, tip_at(p))
    assert not state(estimator).any()
    assert estimator.take([sample(now - 0.02, truth.position)]).used == 0


@pytest.mark.parametrize(("ratio", "share"), [(1e-9, 1.0), (0.01, 0.8), (0.05, 0.0), (0.11, 0.0)])
def test_only_a_direction_that_hardly_gives_is_a_stiff_axis(ratio: float, share: float) -> None:
    """By the ratio of its compliance to the largest one; feedback corrects it without averaging."""
    estimator = TipEstimator(PERIOD, 2, SWINGING, PLAIN)
    tip = tip_at(np.zeros(2))
    tip.compliance[2, 2] = ratio * tip.compliance[0, 0]
    estimator.advance(0.0, np.zeros(2), tip)
    assert estimator.stiff_axis == pytest.approx(np.diag([0.0, 0.0, share]), abs=1e-6)


def test_a_tip_that_objects_hold_in_two_directions_turns_with_the_third_alone() -> None:
    estimator = TipEstimator(PERIOD, 2, SWINGING, PLAIN)
    p, held = np.zeros(2), tip_at(np.zeros(2))
    held.compliance[:3, :3] = np.diag([0.0, 2e-3, 0.0])
    held.compliance[5, 1] = 0.01  # rad/N
    estimator.advance(0.0, p, held)
    estimator.take([sample(0.0, BASE + np.array([0.0, 1e-3, 0.0]), (1.0, 0.0, 0.0, 0.0))])
    estimator.advance(PERIOD, p, held)
    assert np.isfinite(state(estimator)).all()
    assert estimator._lean[2, 1] == pytest.approx(5.0)  # rad/m
    assert np.abs(np.delete(estimator._lean, 7)).max() < 1e-12
