"""Times of samples that scatter: poses that are older than they say, or wrong stamps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stiffopt.arrays import Array
from stiffopt.control.time_scatter import TimeScatter
from test_controller import BAR, HANGING, Bench

RATE = 40.0


def way(times: Array, frequency: float) -> Array:
    """Positions (k, 3) of a tip that moves at 40 mm/s and vibrates by 4 mm."""
    swing = 4e-3 * np.sin(2 * math.pi * frequency * times)
    return np.stack([0.04 * times, swing, 0.1 + 0.3 * swing], axis=1)


def watched(
    stamps: Array, captured: Array, *, noise: float = 1e-4, frequency: float = 1.7
) -> TimeScatter:
    """Show the tip as it was when captured, with the stamps, and noise in each axis, in m."""
    found = TimeScatter(noise)
    positions = way(captured, frequency)
    positions += np.random.default_rng(1).normal(0.0, noise, positions.shape)
    for stamp, position in zip(stamps, positions, strict=True):
        found.take(float(stamp), position)
    return found


@pytest.mark.parametrize(("most", "is_large"), [(0.0, False), (0.02, False), (0.1, True)])
def test_poses_that_are_older_than_they_say(most: float, is_large: bool) -> None:
    times = np.arange(60) / RATE
    captured = times - np.random.default_rng(2).uniform(0.0, most, len(times))
    found = watched(times, captured)
    assert found.is_large == is_large
    if most:
        # `uniform` has a deviation of its width over the root of 12
        assert found.scatter == pytest.approx(most / math.sqrt(12), rel=0.7)


def test_stamps_that_scatter_although_poses_are_captured_at_even_intervals() -> None:
    times = np.arange(80) / RATE
    stamps = times + np.random.default_rng(3).uniform(0.0, 0.02, len(times))
    assert watched(stamps, times).scatter == pytest.approx(0.02 / math.sqrt(12), rel=0.6)
    assert watched(stamps, stamps).scatter < 0.004  # uneven, but right


@pytest.mark.parametrize("frequency", [0.8, 1.7, 3.0, 5.0])
@pytest.mark.parametrize("noise", [5e-5, 1.5e-4, 5e-4])
def test_vibration_and_noise_are_no_scatter(frequency: float, noise: float) -> None:
    times = np.arange(120) / RATE
    assert not watched(times, times, noise=noise, frequency=frequency).is_large


@pytest.mark.parametrize("rate", [15.0, 20.0, 22.0])
def test_fast_swings_that_are_sampled_seldom_are_not_judged(rate: float) -> None:
    times = np.arange(120) / rate
    assert math.isnan(watched(times, times, frequency=5.0).scatter)


def test_single_wrong_samples_and_pauses_are_no_scatter() -> None:
    found, times = TimeScatter(1e-4), np.arange(120) / RATE
    for k, (time, position) in enumerate(zip(times, way(times, 1.7), strict=True)):
        aside = np.array([0.02, 0.0, 0.0]) if k % 33 == 20 else np.zeros(3)
        found.take(float(time) + (1.0 if k > 70 else 0.0), position + aside)
    assert found.scatter < 0.015


def test_a_tip_at_rest_says_nothing_and_a_steady_motion_ends_the_alarm() -> None:
    times = np.arange(60) / RATE
    found = watched(times, times - np.random.default_rng(2).uniform(0.0, 0.1, len(times)))
    for k in range(60):
        found.take(times[-1] + (k + 1) / RATE, np.array([0.06, 0.0, 0.1]))
    assert found.is_large
    for k, position in enumerate(way(times, 1.7)):
        found.take(times[-1] + (k + 61) / RATE, position)
    assert not found.is_large


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("oldest", [0, 3])
def test_the_loop_tells_of_samples_that_are_up_to_three_intervals_old(oldest: int) -> None:
    bench = Bench(HANGING, "full")
    camera, rng, poses = bench.rig.world.camera, np.random.default_rng(4), []
    see = camera.sensor_in_tracker

    def older() -> Array:
        poses.append(see())
        return poses[max(-1 - int(rng.integers(oldest + 1)), -len(poses))]

    camera.sensor_in_tracker = older
    place = bench.pose_at(np.array([0.2, 0.9, 0.6, 0.5, 0.3, 0.2]) * BAR)[:3, 3]
    bench.controller.set_task(bench.task(position=tuple(map(float, place))))
    bench.run(3.0)
    kinds = [notice.kind for notice in bench.controller.notices()]
    assert kinds == (["tracker-times"] if oldest else [])
