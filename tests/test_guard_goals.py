"""The guard with goals: they are repeated, expire, and end where a stream begins."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from fake_supply import FakeSupply, HandClock
from guard_scene import TIMEOUT, Clock, FakeChannel, Scene
from stiffopt.errors import DeviceError
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import SafetyGate
from stiffopt.safety.goal import GoalFollower
from stiffopt.safety.guard import Guard
from stiffopt.safety.messages import CommandFrame, GuardAnswer, GuardRequest, Message
from stiffopt.safety.vent_line import SocketPeer

PERIOD, EPOCH = 0.01, 900.0


class LaterClock(HandClock):
    """A clock whose moment 0 is another one's moment `EPOCH`."""

    def __init__(self, clock: HandClock) -> None:
        self.clock = clock
        clock.t = EPOCH + 50.0

    def now(self) -> float:
        return self.clock.t - EPOCH


class GoalScene:
    """A guard with a follower over a gate, and a supply that keeps what it is told."""

    def __init__(self) -> None:
        self.hand = HandClock()  # of all processes
        self.rig_clock = LaterClock(self.hand)
        self.device = FakeSupply(self.rig_clock)
        safety = Safety(ramp_time=0.1)
        self.gate = SafetyGate(
            self.device, slew=1e6, safety=safety, force_per_pressure=None, clock=self.rig_clock
        )
        self.gate.open()
        self.channel = FakeChannel(Clock())
        self.channel._clock = self  # type: ignore[assignment]
        self.line = FakeLine()
        self.guard = Guard(
            self.gate,
            self.channel,  # type: ignore[arg-type]
            TIMEOUT,
            follower=GoalFollower(self.gate, period=PERIOD, ramp_time=0.1, clock=self.rig_clock),
            line=self.line,  # type: ignore[arg-type]
            clock=self.hand.now,
            pause=lambda wait: None,
            epoch=EPOCH,
        )
        self.number = 0

    @property
    def time(self) -> float:
        return self.hand.t

    @time.setter
    def time(self, moment: float) -> None:
        self.hand.t = moment

    def step(self, *messages: Message) -> list[GuardAnswer]:
        self.channel.coming += messages
        before = len(self.channel.sent)
        self.guard.step()
        return [m for m in self.channel.sent[before:] if isinstance(m, GuardAnswer)]

    def ask(self, do: str, **about: Any) -> GuardAnswer:
        self.number += 1
        (answer,) = self.step(GuardRequest(self.number, do, about))
        return answer

    def command(
        self, pressure: float, valid_for: float = 100.0, *, goal: bool = True
    ) -> GuardAnswer:
        self.number += 1
        given = np.full(3, pressure)
        frame = CommandFrame(self.number, self.time, self.time, valid_for, given, goal)
        answers = self.step(frame)
        return next(a for a in answers if a.sequence == self.number)

    def run(self, seconds: float) -> None:
        end = self.hand.t + seconds
        while self.hand.t < end:
            self.guard.step()

    def pressed(self, valid_for: float = 100.0) -> GoalScene:
        """Armed for goals, and arrived at one."""
        assert self.ask("arm", told=0, goals=True).armed
        assert self.command(2e4, valid_for).armed is True
        self.run(0.2)
        assert self.device.commanded.tolist() == [2e4] * 3
        return self


class FakeLine:
    """A vent line on which the test calls."""

    def __init__(self) -> None:
        self.calls: list[FakeCaller] = []
        self.closed = False

    def descriptors(self) -> list[int]:
        return [71, 72]

    def wanting_to_vent(self) -> list[FakeCaller]:
        calls, self.calls = self.calls, []
        return calls

    def close(self) -> None:
        self.closed = True


class FakeCaller:
    def __init__(self) -> None:
        self.peer = SocketPeer(7, 54321)
        self.answers: list[str] = []

    def answer(self, error: str = "") -> None:
        self.answers.append(error)


def test_a_goal_is_repeated_without_being_asked_and_silence_is_no_trip() -> None:
    scene = GoalScene().pressed()
    before = len(scene.device.written)
    scene.run(1.0)
    assert len(scene.device.written) - before == pytest.approx(100, abs=2)
    assert scene.device.commanded.tolist() == [2e4] * 3
    answer = scene.ask("ping")
    assert (answer.armed, answer.tripped, answer.error) == (True, "", "")


def test_an_expired_goal_is_let_down_and_vented_and_is_no_trip() -> None:
    scene = GoalScene().pressed(valid_for=1.0)
    scene.run(0.85)  # and a bit: nothing reaches the rig but through ticks
    answer = scene.ask("ping")
    assert (answer.commanded < 2e4).all()
    assert answer.armed
    scene.run(0.1)
    answer = scene.ask("ping")
    assert not answer.commanded.any()
    assert not answer.armed
    assert not answer.tripped
    assert not scene.device.armed
    assert "no command came for as long as" in scene.command(2e4).refused
    assert scene.ask("arm", told=0, goals=True).armed


def test_nothing_is_left_of_a_goal_when_a_stream_begins() -> None:
    scene = GoalScene().pressed()
    before = len(scene.device.written)
    assert scene.ask("arm", told=0).armed
    scene.run(0.3)  # until the first command comes nothing rises
    for _ in range(20):
        scene.hand.t += 0.3 * PERIOD
        answer = scene.command(0.0, 0.1, goal=False)
        assert answer.armed
        assert not answer.refused
    assert not any(written.any() for written in scene.device.written[before:])
    assert scene.guard._follower is not None
    assert scene.guard._follower.due == math.inf


def test_nothing_is_left_of_a_stream_when_goals_begin() -> None:
    scene = GoalScene()
    assert scene.ask("arm", told=0).armed
    scene.hand.t += PERIOD
    scene.command(1e4, goal=False)
    assert scene.device.commanded.all()
    answer = scene.ask("arm", told=0, goals=True)
    assert answer.armed
    assert not answer.commanded.any()
    scene.run(3.0)  # and nobody need be in time
    assert scene.ask("ping").armed
    assert scene.device.armed
    assert not scene.device.commanded.any()
    assert not scene.command(1e4).refused


def test_what_is_not_due_is_not_repeated() -> None:
    scene = GoalScene().pressed()
    scene.run(PERIOD)
    scene.guard.step()
    before = len(scene.device.written)
    for _ in range(5):
        scene.ask("ping")  # which takes no time
    assert len(scene.device.written) <= before + 1


@pytest.mark.parametrize("goals", [False, True])
def test_commands_of_another_kind_are_refused(goals: bool) -> None:
    scene = GoalScene()
    scene.ask("arm", told=0, goals=goals)
    scene.hand.t += PERIOD
    answer = scene.command(1e4, goal=not goals)
    assert "armed for commands of another kind" in answer.refused
    assert answer.armed
    assert not scene.device.commanded.any()


def test_a_tick_that_fails_trips(capsys: pytest.CaptureFixture[str]) -> None:
    scene = GoalScene().pressed()
    scene.device.dead = "before"
    scene.run(0.1)
    scene.device.dead = ""
    scene.run(0.1)
    answer = scene.ask("ping")
    assert answer.tripped == "the supply failed: it does not answer"
    assert (answer.trips, answer.armed) == (1, False)
    assert not scene.device.commanded.any()
    assert "vented after all" in capsys.readouterr().err
    scene.run(1.0)
    assert scene.ask("arm", told=0, goals=True).error.startswith("the guard had vented: ")
    assert scene.ask("arm", told=1, goals=True).armed


def test_a_goal_that_makes_no_sense_is_refused_and_the_last_one_stays() -> None:
    scene = GoalScene().pressed()
    for pressure, valid_for in ((9e9, 1.0), (np.nan, 1.0), (1e4, np.nan), (1e4, 0.0)):
        answer = scene.command(pressure, valid_for)
        assert answer.refused
        assert answer.commanded.tolist() == [2e4] * 3
        assert answer.armed
    scene.run(1.0)
    assert scene.device.commanded.tolist() == [2e4] * 3


def test_the_guard_wakes_for_a_goal_that_is_due_and_for_callers() -> None:
    scene = GoalScene()
    assert scene.channel.woken_for == [71, 72]
    scene.pressed()
    scene.channel.waits.clear()
    scene.run(0.5)
    assert max(scene.channel.waits) == pytest.approx(PERIOD)


def test_a_caller_vents_and_it_is_a_trip(capsys: pytest.CaptureFixture[str]) -> None:
    scene = GoalScene().pressed()
    caller = FakeCaller()
    scene.line.calls = [caller]
    (answer,) = scene.step()
    assert caller.answers == [""]
    assert not scene.device.commanded.any()
    assert answer.tripped == "process 7 (user 54321) called 'stiffopt vent'"
    assert answer.trips == 1
    assert "vented: process 7" in capsys.readouterr().err
    scene.run(1.0)
    assert not scene.device.commanded.any()
    assert not scene.command(2e4).armed


def test_a_caller_vents_what_is_not_armed_and_nothing_is_told() -> None:
    scene = GoalScene()
    caller = FakeCaller()
    before = len(scene.device.written)
    scene.line.calls = [caller]
    assert scene.step() == []
    assert caller.answers == [""]
    assert len(scene.device.written) == before + 1
    assert scene.ask("arm", told=0, goals=True).armed


@pytest.mark.parametrize("armed", [False, True])
def test_a_caller_is_told_that_it_could_not_be_vented(armed: bool) -> None:
    scene = GoalScene()
    if armed:
        scene.pressed()
    scene.device.dead = "before"
    callers = [FakeCaller(), FakeCaller()]
    scene.line.calls = list(callers)
    scene.step()
    assert [caller.answers for caller in callers] == [["it does not answer"]] * 2
    scene.device.dead = ""
    scene.run(0.2)
    assert not scene.device.commanded.any()


def test_at_the_end_the_line_is_closed() -> None:
    scene = GoalScene().pressed()
    scene.channel.closed = True
    assert scene.guard.serve() == 0
    assert scene.line.closed
    assert not scene.device.is_open
    assert not scene.device.written[-1].any()


def test_the_limits_of_a_task_are_passed_on() -> None:
    scene = Scene().pressed()
    (answer,) = scene.step(scene.request("restrict", high=[5e4, 6e4]))
    assert not answer.error
    assert scene.outlet.did == ["restrict [50000.0, 60000.0]"]


def test_a_reading_is_told() -> None:
    scene = Scene(epoch=900.0)
    (answer,) = scene.step(scene.request("read"))
    assert answer.measured.tolist() == [1.0, 1.0]
    assert answer.time == pytest.approx(907.0)
    scene.outlet.fail["read"] = [DeviceError("no answer")]
    (answer,) = scene.step(scene.request("read"))
    assert answer.error == "no answer"
    assert answer.measured.tolist() == [1.0, 1.0]  # the last that is known, with its time
