"""The tracker watch: samples that are missing, late, out of order or rejected."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from stiffopt.control.interface import SampleCounts
from stiffopt.control.noticing_tuning import TrackerTuning
from stiffopt.control.tracker_watch import Sight, TrackerWatch
from stiffopt.rig.interface import PoseSample
from stiffopt.rig.settings import Safety

PERIOD = 0.01
SAFETY = Safety()


class Watched:
    """A tracker of 40 Hz that is 25 ms late, and what a controller makes of it."""

    def __init__(self, interval: float = 0.025, latency: float = 0.025) -> None:
        self.watch = TrackerWatch(SAFETY, PERIOD)
        self.interval, self.latency = interval, latency
        self.ticks = self.frame = 0
        self.latest = -math.inf
        self.used = True
        self.armed = False

    @property
    def t(self) -> float:
        return self.ticks * PERIOD

    def tick(self, **changes: Any) -> Sight:
        self.ticks += 1
        samples = []
        while (captured := (self.frame + 1) * self.interval) + self.latency <= self.t + 1e-9:
            self.frame += 1
            sample = {
                "time": captured,
                "received": self.t,
                "frame": self.frame,
                "position": np.array([0.0, 0.0, 0.1]),
                "quaternion": None,
                **changes,
            }
            if changes.get("time", 0.0) is not None:
                samples.append(PoseSample(**sample))
        fresh = self.watch.new(samples)
        seen = [s for s in fresh if s.visible and self.used]
        for sample in seen:
            self.latest = max(self.latest, sample.time)
        rejected = 0 if self.used else len(fresh)
        self.watch.update(self.t, SampleCounts(len(seen), rejected, self.latest))
        if not self.armed:
            self.watch.learn(self.t, fresh)
        return self.watch.sight(self.t)

    def ready(self) -> Watched:
        while self.watch.samples < 20:
            self.tick()
        self.armed = True
        return self

    def until(self, sight: Sight, **changes: Any) -> float:
        """Seconds until it is so, since the last frame that was seen arrived."""
        begin = self.latest + self.latency
        for _ in range(200):
            if self.tick(**changes) is sight:
                return self.t - begin
        raise AssertionError(f"it was never {sight}")


NOTHING = {"time": None}
NAN = {"position": np.full(3, np.nan)}


@pytest.mark.parametrize("changes", [NOTHING, NAN, {"frame": 7}])
def test_1_2_3_missing_after_three_frames_and_lost_after_the_timeout(changes: Any) -> None:
    watched = Watched().ready()
    if "frame" in changes:
        changes = {"frame": watched.frame}
    assert 0.075 < watched.until(Sight.MISSING, **changes) <= 0.075 + 0.03
    assert 0.5 <= watched.until(Sight.LOST, **changes) <= 0.5 + 0.03
    assert watched.until(Sight.SEEN) is not None


@pytest.mark.parametrize("missing", [1, 2])
def test_1_fewer_missing_frames_do_not_matter(missing: int) -> None:
    watched = Watched().ready()
    for _ in range(10):
        frame = watched.frame
        while watched.frame < frame + missing:
            assert watched.tick(**NOTHING) is Sight.SEEN
        while watched.frame < frame + missing + 3:
            assert watched.tick() is Sight.SEEN


@pytest.mark.parametrize("bad", [4, 5, 9])
def test_1_one_good_frame_now_and_then_is_not_back_and_not_lost(bad: int) -> None:
    watched = Watched().ready()
    watched.until(Sight.MISSING, **NAN)
    for _ in range(400):
        good = watched.frame % (bad + 1) == 0
        assert watched.tick(**({} if good else NAN)) is Sight.MISSING


@pytest.mark.parametrize("bad", [0, 1, 2])
def test_1_it_is_back_after_a_run_without_three_missing_frames(bad: int) -> None:
    watched = Watched().ready()
    watched.until(Sight.MISSING, **NAN)
    good = 0
    while True:
        frame, is_good = watched.frame, watched.frame % (bad + 1) == 0
        sight = watched.tick(**({} if is_good else NAN))
        good += is_good and watched.frame > frame
        if sight is Sight.SEEN:
            break
        assert good < TrackerTuning().back
    assert good == TrackerTuning().back


@pytest.mark.parametrize(("interval", "latency"), [(0.002, 0.001), (0.01, 0.0), (0.1, 0.3)])
def test_1_other_trackers_have_other_frames(interval: float, latency: float) -> None:
    watched = Watched(interval, latency).ready()
    for _ in range(300):
        assert watched.tick() is Sight.SEEN
    gone = watched.until(Sight.MISSING, **NOTHING)
    assert 3 * interval < gone < 3.25 * interval + 3.1 * PERIOD


@pytest.mark.parametrize("interval", [1 / 6, 0.2, 0.3, 0.4])
def test_1_a_slow_tracker_is_missing_at_the_timeout_and_lost_after_it(interval: float) -> None:
    watched = Watched(interval).ready()
    for _ in range(300):
        assert watched.tick() is Sight.SEEN
    begin = watched.latest + watched.latency
    sights = [watched.tick(**NOTHING) for _ in range(200)]
    first = sights.index(Sight.MISSING)
    assert Sight.LOST not in sights[:first]
    assert sights.index(Sight.LOST) > first
    missing = watched.t - PERIOD * (len(sights) - 1 - first) - begin
    assert missing <= SAFETY.tracker_timeout + 2 * PERIOD


def test_1_a_tracker_slower_than_the_timeout_never_sees_the_tip() -> None:
    watched = Watched(0.8).ready()
    sights = {watched.tick() for _ in range(500)}
    assert Sight.SEEN not in sights


def test_7_samples_that_come_too_late_are_as_good_as_none() -> None:
    watched = Watched().ready()
    watched.latency = 0.3
    assert watched.until(Sight.MISSING) < 0.3
    for _ in range(100):
        sight = watched.tick()
    assert sight is Sight.MISSING  # they come again, but 0.3 s old


def test_7_out_of_order_or_from_the_future_is_not_new() -> None:
    watched = Watched().ready()
    assert watched.until(Sight.MISSING, time=watched.latest - 0.01) < 0.11
    watched = Watched().ready()
    far = watched.t + 100.0
    watched.tick(time=far)
    assert watched.until(Sight.MISSING, time=far) is not None  # that it came once is all


def test_5_rejected_samples_in_a_row() -> None:
    watched = Watched().ready()
    watched.used = False
    while watched.watch.jumps < SAFETY.max_jumps:
        assert not watched.watch.jumping
        watched.tick()
    assert watched.watch.jumping
    watched.used = True
    while watched.watch.jumps:
        watched.tick()
    assert not watched.watch.jumping


def test_what_is_usual_is_learned_from_enough_samples() -> None:
    watched = Watched()
    assert watched.tick(**NOTHING) is Sight.SEEN  # it is given time
    while watched.watch.samples < TrackerTuning().enough:
        watched.tick()
    interval, age = watched.watch.usual
    assert interval == pytest.approx(0.025)
    assert 0.025 <= age <= 0.036
    np.testing.assert_allclose(watched.watch.position, [0.0, 0.0, 0.1])
    watched.watch.forget()
    assert watched.watch.samples == 0
    assert watched.watch.usual == (interval, age)


def test_a_tracker_that_never_sees_anything_is_lost() -> None:
    watched = Watched()
    sights = [watched.tick(**NAN) for _ in range(70)]
    assert sights[10] is Sight.SEEN
    assert sights[-1] is Sight.LOST
