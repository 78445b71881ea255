"""The numbered faults of the tracker, on the simulated rig: each has the stated outcome."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from simulated_loop import TASK, Lab
from stiffopt.control.noticing_tuning import TrackerTuning
from stiffopt.control.state import State
from stiffopt.errors import CommandError
from stiffopt.rig.interface import PoseTracker, RawPose

BACK = TrackerTuning().back

FRAME = 0.025  # s, between samples of the tracker
LATENCY = 0.025  # s


@pytest.mark.parametrize("fault", ["off", "missing", "stuck"])
def test_1_2_3_tracker_missing_not_visible_or_frozen(fault: str) -> None:
    lab = Lab().under_pressure()
    before = lab.loop.snapshot().commanded
    lab.world.inject("tracker", fault)
    assert 3 * FRAME < lab.until(State.HOLDING) < 3 * FRAME + LATENCY + 0.04
    assert "tracker-missing" in lab.alarms
    held = lab.ticks(20)
    assert held.state is State.HOLDING
    np.testing.assert_array_equal(held.commanded, before)
    while "tracker-lost" not in lab.kinds:
        lab.tick()
    begin = lab.now
    assert 0.5 < lab.loop.snapshot().seen_age < 0.5 + FRAME + LATENCY + 0.05
    halfway = lab.ticks(50).commanded
    assert (halfway < 0.55 * before + 1).all()
    assert (halfway > 0.45 * before - 1).all()
    lab.until(State.INACTIVE)
    assert lab.now - begin == pytest.approx(1.0, abs=0.05)
    assert lab.is_vented()
    assert lab.gate.armed is False


def test_1_a_tracker_that_comes_back_in_time_goes_on_by_itself() -> None:
    lab = Lab().under_pressure()
    lab.world.inject("tracker", "off")
    lab.until(State.HOLDING)
    lab.ticks(20)
    lab.world.inject("tracker", "ok")
    assert (BACK - 1) * FRAME < lab.until(State.ACTIVE) < (BACK + 1) * FRAME + LATENCY
    assert "resume" in lab.controller.calls
    assert not lab.alarms


def test_1_a_tracker_that_sees_a_frame_now_and_then_does_not_make_the_loop_steer_now_and_then() -> (
    None
):
    lab = Lab().under_pressure()
    before = lab.loop.snapshot().commanded
    for _ in range(20):
        lab.world.inject("tracker", "off")
        lab.ticks(10)  # 4 frames
        lab.world.inject("tracker", "ok")
        held = lab.ticks(3)
    assert held.state is State.HOLDING
    np.testing.assert_array_equal(held.commanded, before)
    assert lab.kinds.count("hold-tracker") == lab.kinds.count("tracker-missing") == 1
    assert not {"active", "tracker-lost", "tracker-missing-over"} & set(lab.kinds)
    assert lab.until(State.ACTIVE) < (BACK + 1) * FRAME + LATENCY


def test_1_two_missing_frames_do_not_matter() -> None:
    lab = Lab().under_pressure()
    lab.world.inject("tracker", "off")
    lab.ticks(5)  # 50 ms
    lab.world.inject("tracker", "ok")
    for _ in range(30):
        assert lab.tick().state is State.ACTIVE


def test_1_what_was_begun_to_be_let_down_is_let_down() -> None:
    lab = Lab().under_pressure()
    lab.world.inject("tracker", "off")
    while "tracker-lost" not in lab.kinds:
        lab.tick()
    lab.world.inject("tracker", "ok")
    lab.ticks(20)
    assert lab.state is State.HOLDING
    with pytest.raises(CommandError, match="letting down: the tracker has lost the tip"):
        lab.loop.set_task(TASK)
    with pytest.raises(CommandError, match="letting down"):
        lab.loop.hold()
    lab.until(State.INACTIVE)


def test_4_quaternion_sign_flips_do_not_matter() -> None:
    lab = Lab().under_pressure()
    lab.world.inject("tracker", "flip")
    for _ in range(200):
        assert lab.tick().state is State.ACTIVE
    assert lab.controller.seen[-1].quaternion is not None
    assert not lab.alarms


def test_5_a_jump_is_rejected_and_repeated_a_fault() -> None:
    lab = Lab().under_pressure()
    lab.world.inject("tracker", "wrong")
    lab.ticks(4)
    lab.world.inject("tracker", "ok")
    lab.ticks(20)
    assert lab.state is State.ACTIVE
    lab.controller.speed = 1e-3  # no matter how long it stays there
    lab.world.inject("tracker", "wrong")
    assert lab.until(State.FAULT) < 5 * FRAME + LATENCY + 0.03
    assert "tracker-jumps" in lab.kinds
    assert lab.is_vented()
    with pytest.raises(CommandError, match="still seems to jump"):
        lab.loop.reset()
    lab.world.inject("tracker", "ok")
    lab.controller.speed = 0.3
    lab.ticks(10)
    lab.loop.reset()


class BlockedTracker(PoseTracker):
    """Hands over what another tracker sees, until the thread that reads it is blocked."""

    def __init__(self, inner: PoseTracker) -> None:
        super().__init__(inner.registration, inner.clock)
        self.inner = inner
        self.reads = threading.Semaphore(0)
        self.answers = threading.Semaphore(0)
        self.unblocked = threading.Event()
        self.unblocked.set()
        self.ended = False
        self.thread = threading.Thread(target=self._listen, daemon=True)

    def _open(self) -> None:
        self.inner.open()
        self.thread.start()

    def _close(self) -> None:
        self.ended = True
        self.unblocked.set()
        self.reads.release()
        self.thread.join()

    def _poll(self) -> None:
        self.reads.release()
        if self.unblocked.is_set():  # so that the test is the same each time
            self.answers.acquire()

    def _listen(self) -> None:
        while not self.ended:
            self.reads.acquire()
            self.unblocked.wait()  # a serial line on which nothing comes
            for sample in self.inner.read():
                raw = RawPose(sample.time, sample.frame, sample.position, None, sample.received)
                self._deliver(raw)
            self.answers.release()


def test_6_a_tracker_whose_read_blocks_does_not_block_the_loop() -> None:
    lab = Lab(ready=False)
    tracker = BlockedTracker(lab.rig.tracker)  # type: ignore[arg-type]
    lab.rig.tracker = tracker
    lab.arm()
    lab.under_pressure()
    tracker.unblocked.clear()
    begin, longest = lab.now, 0.0
    while lab.now < begin + 5.0:
        longest = max(longest, lab.tick().timing.tick_time)
    timing = lab.loop.snapshot().timing
    assert longest < 1.0  # of a thread that is blocked for good
    assert timing.overruns == 0
    assert lab.state is State.INACTIVE  # as for a tracker that is missing
    assert "tracker-lost" in lab.kinds
    tracker.close()


def test_7_a_late_sample_keeps_its_time() -> None:
    lab = Lab().under_pressure()
    known = len(lab.controller.seen)
    lab.world.inject("tracker", "slow")
    lab.ticks(70)
    late = lab.controller.seen[known + 4 :]
    assert late
    for sample in late:
        assert sample.received - sample.time == pytest.approx(0.525, abs=1e-6)
    assert lab.state is State.HOLDING  # what is half a second old is no basis


def test_7_a_sample_out_of_order_is_passed_on_but_is_not_new() -> None:
    lab = Lab().under_pressure()
    tracker = lab.rig.tracker
    assert tracker is not None
    old = lab.controller.seen[-4]
    lab.world.inject("tracker", "off")
    begin, number = lab.now, 10_000
    while lab.tick().state is State.ACTIVE:
        number -= 1
        tracker._deliver(RawPose(old.time, number, [np.nan] * 3))
        tracker._arrived[-1] = type(old)(old.time, lab.now, number, old.position, old.quaternion)
        assert lab.now < begin + 0.2
    assert lab.state is State.HOLDING
    assert lab.controller.seen[-1].time == old.time
