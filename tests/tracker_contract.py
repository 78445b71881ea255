"""What every tracker must do: one list of checks for drivers and the simulator alike.

A check is a function of a factory, which makes a tracker, not yet open, and the control of what
the tracker sees. All waiting is done on the tracker's own clock.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stiffopt.errors import DeviceError
from stiffopt.registration import Placement, Registration
from stiffopt.rig.interface import PoseSample, PoseTracker

PLACE = (0.0123, -0.0456, -0.1512)  # m
TURN = tuple(np.array([0.2, 0.4, -0.5, 0.7]) / np.sqrt(0.94))  # w first, all different
REGISTRATION = Registration(
    tracker_in_base=Placement(position=(-0.12, 0.04, 0.3), orientation=(0.5, 0.5, -0.5, 0.5)),
    tip_in_sensor=Placement(position=(0.003, -0.002, 0.011), orientation=(0.8, 0.0, 0.6, 0.0)),
)
RESOLUTION = 2e-5  # m, that any tracker's protocol has
SETTLE = 0.15  # s after which nothing of before is under way


class Control(Protocol):
    """What the tracker sees from now on."""

    def show(self, position: ArrayLike, quaternion: ArrayLike) -> None:
        """Put the sensor there, in the tracker's frame, m and w first of any sign."""

    def drop(self) -> None:
        """Take the sensor out of sight."""

    def spoil(self) -> None:
        """Report a place as ever and a turn that is NaN."""

    def freeze(self) -> None:
        """Repeat one frame for ever."""

    def silence(self) -> None:
        """Do not answer at all."""

    def resume(self) -> None:
        """Work as ever."""


Factory = Callable[[Registration], AbstractContextManager[tuple[PoseTracker, Control]]]


def collect(tracker: PoseTracker, n: int, patience: float = 5.0) -> list[PoseSample]:
    """Return the next n samples."""
    samples: list[PoseSample] = []
    end = tracker.clock.now() + patience
    while len(samples) < n:
        assert tracker.clock.now() < end, f"only {len(samples)} samples came"
        tracker.clock.sleep(0.01)
        samples.extend(tracker.read())
    return samples


def drain(tracker: PoseTracker) -> None:
    """Drop what was captured before now."""
    tracker.clock.sleep(SETTLE)
    tracker.read()


def nothing_seen(tracker: PoseTracker, duration: float = 0.2) -> None:
    """Check that the tracker knows for a while that it sees nothing, and never blocks."""
    drain(tracker)
    age = tracker.age()
    end = tracker.clock.now() + duration
    while tracker.clock.now() < end:
        began = time.perf_counter()
        samples = tracker.read()
        assert time.perf_counter() - began < 0.05
        assert not any(sample.visible for sample in samples)
        assert all(np.isnan(sample.position).all() for sample in samples)
        assert all(sample.quaternion is None for sample in samples)
        tracker.clock.sleep(0.02)
    assert tracker.age() >= age + 0.9 * duration


def check_poses_are_in_metres_and_w_is_first(factory: Factory) -> None:
    with factory(Registration()) as (tracker, control):
        control.show(PLACE, TURN)
        with tracker:
            drain(tracker)
            for sample in collect(tracker, 2):
                assert sample.position == pytest.approx(PLACE, abs=RESOLUTION)
                assert sample.quaternion == pytest.approx(TURN, abs=2e-4)


def check_registration_is_applied_once(factory: Factory) -> None:
    def matrix(position: ArrayLike, wxyz: ArrayLike) -> np.ndarray:
        T = np.eye(4)
        w, x, y, z = np.asarray(wxyz, dtype=float)
        T[:3, :3], T[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), position
        return T

    tracker_in_base, tip_in_sensor = REGISTRATION.tracker_in_base, REGISTRATION.tip_in_sensor
    expected = (
        matrix(tracker_in_base.position, tracker_in_base.orientation)
        @ matrix(PLACE, TURN)
        @ matrix(tip_in_sensor.position, tip_in_sensor.orientation)
    )
    with factory(REGISTRATION) as (tracker, control):
        control.show(PLACE, TURN)
        with tracker:
            drain(tracker)
            (sample, *_) = collect(tracker, 1)
    assert sample.quaternion is not None
    measured = matrix(sample.position, sample.quaternion)
    assert measured[:3, 3] == pytest.approx(expected[:3, 3], abs=RESOLUTION)
    assert measured[:3, :3] == pytest.approx(expected[:3, :3], abs=5e-4)


def check_quaternions_keep_their_sign(factory: Factory) -> None:
    with factory(Registration()) as (tracker, control), tracker:
        samples = []
        for sign in (1, -1, 1, -1):
            control.show(PLACE, sign * np.array(TURN))
            drain(tracker)
            samples += collect(tracker, 1)
        for sample in samples:
            assert sample.quaternion is not None
            assert sample.quaternion[0] >= 0
            assert sample.quaternion == pytest.approx(TURN, abs=2e-4)
            assert np.linalg.norm(sample.quaternion) == pytest.approx(1, abs=1e-9)


def check_times_are_of_capture_on_the_clock_of_the_rig(factory: Factory) -> None:
    with factory(Registration()) as (tracker, _), tracker:
        before = tracker.clock.now()
        drain(tracker)
        samples = collect(tracker, 8)
        now = tracker.clock.now()
        for sample in samples:
            assert before - 0.5 < sample.time <= sample.received <= now
            assert sample.received - sample.time < 0.2
        assert np.all(np.diff([sample.time for sample in samples]) > 0)
        age = tracker.age()
        assert 0 <= age <= tracker.clock.now() - samples[-1].time


def check_frames_are_read_once_in_order(factory: Factory) -> None:
    with factory(Registration()) as (tracker, _), tracker:
        tracker.clock.sleep(SETTLE)
        first, at_once = tracker.read(), tracker.read()
        assert len(first) >= 2
        assert len(at_once) <= 1
        numbers = [sample.frame for sample in (*first, *at_once, *collect(tracker, 5))]
        assert np.all(np.diff(numbers) > 0)
        assert tracker.latest is not None
        assert tracker.latest.frame >= numbers[-1]


def check_a_missing_tool_is_not_visible(factory: Factory) -> None:
    with factory(REGISTRATION) as (tracker, control), tracker:
        collect(tracker, 1)
        control.drop()
        nothing_seen(tracker)
        control.resume()
        drain(tracker)
        assert collect(tracker, 1)[0].visible


def check_a_pose_that_is_not_a_number_is_not_visible(factory: Factory) -> None:
    with factory(REGISTRATION) as (tracker, control), tracker:
        collect(tracker, 1)
        control.spoil()
        nothing_seen(tracker)
        control.resume()
        drain(tracker)
        assert collect(tracker, 1)[0].visible


def check_a_frozen_frame_is_not_new(factory: Factory) -> None:
    with factory(Registration()) as (tracker, control), tracker:
        collect(tracker, 1)
        control.freeze()
        drain(tracker)
        age = tracker.age()
        tracker.clock.sleep(0.3)
        assert tracker.read() == ()
        assert tracker.age() >= age + 0.27
        control.resume()
        assert collect(tracker, 1)[0].visible


def check_silence_shows_only_as_age(factory: Factory) -> None:
    with factory(Registration()) as (tracker, control), tracker:
        collect(tracker, 2)
        control.silence()
        nothing_seen(tracker, 0.5)
        assert tracker.read() == ()
        control.resume()
        assert collect(tracker, 1, patience=10)[0].visible
        assert tracker.age() < 0.5


def check_closing_is_prompt_in_silence(factory: Factory) -> None:
    with factory(Registration()) as (tracker, control):
        tracker.open()
        collect(tracker, 1)
        control.silence()
        tracker.clock.sleep(SETTLE)
        began = time.perf_counter()
        tracker.close()
        assert time.perf_counter() - began < 1.5


def check_life_cycle(factory: Factory) -> None:
    with factory(Registration()) as (tracker, _):
        threads = threading.active_count()
        assert not tracker.is_open
        assert tracker.latest is None
        assert tracker.age() == np.inf
        with pytest.raises(DeviceError, match="not open"):
            tracker.read()
        for _ in range(2):
            tracker.open()
            tracker.open()
            reopened = tracker.clock.now()
            assert collect(tracker, 1)[0].time > reopened - 0.5
            tracker.clock.sleep(SETTLE)  # samples wait that nobody reads
            tracker.close()
            tracker.close()
            assert not tracker.is_open
            with pytest.raises(DeviceError, match="not open"):
                tracker.read()
            assert threading.active_count() == threads
            tracker.clock.sleep(0.55)


CHECKS = [check for name, check in dict(globals()).items() if name.startswith("check_")]
