"""What the guard decides, step by step: its clock, outlet and channel are ours."""

from __future__ import annotations

import gc
import io
import json
import math
import pickle
import runpy
import signal
import socket
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fake_supply import FakeSupply, HandClock
from stiffopt.errors import CommandError, DeviceError, InputError, MissingExtraError, SlowWarning
from stiffopt.model.robot_files import load_description
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import load_rig_description
from stiffopt.rig.interface import (
    PoseSample,
    PressureCommand,
    PressureLimits,
    PressureReading,
)
from stiffopt.rig.settings import Safety
from stiffopt.safety import guard as guard_module
from stiffopt.safety import hosted
from stiffopt.safety.gate import Applied, SafetyGate
from stiffopt.safety.goal import GoalFollower
from stiffopt.safety.guard import Guard, main
from stiffopt.safety.hosted import HostedDevices, Owned, owned
from stiffopt.safety.messages import (
    CommandFrame,
    GuardAnswer,
    GuardChannel,
    GuardNotice,
    GuardRequest,
    Message,
    TrackedPoses,
    unpack,
)
from stiffopt.safety.settings import GUARD
from stiffopt.safety.vent_line import SocketPeer

TIMEOUT = 0.05
SILENT = "no command had come for 50 ms: the program that commands, or this computer, was late"


class Clock:
    """A time that moves when it is told to."""

    def __init__(self) -> None:
        self.time = 1000.0

    def __call__(self) -> float:
        return self.time


class FakeOutlet:
    """An outlet that remembers; `fail` says what raises, with what."""

    def __init__(self) -> None:
        self.limits = PressureLimits(np.zeros(2), np.full(2, 1e5))
        self.did: list[str] = []
        self.commands: list[PressureCommand] = []
        self.pressures = np.zeros(2)
        self.fail: dict[str, list[BaseException]] = {}
        self.takes = 0.0
        self.clock: Clock | None = None

    def _do(self, what: str) -> None:
        self.did.append(what)
        if self.clock is not None:
            self.clock.time += self.takes
        if self.fail.get(what):
            raise self.fail[what].pop(0)

    def open(self) -> None:
        self._do("open")

    def close(self) -> None:
        self._do("close")

    def arm(self) -> None:
        self._do("arm")

    def vent(self) -> None:
        self._do("vent")
        self.pressures = np.zeros(2)

    def restrict(self, high: Any) -> None:
        self._do(f"restrict {high.tolist()}")

    def apply(self, command: PressureCommand) -> Applied:
        self._do("apply")
        self.commands.append(command)
        self.pressures = command.pressures
        much = bool(command.pressures[0] > 5e4)
        return Applied(self.pressures, self._reading(), limited=much, force_limited=much)

    def read(self) -> PressureReading:
        self._do("read")
        return self._reading()

    def _reading(self) -> PressureReading:
        return PressureReading(7.0, self.pressures + 1.0)


class FakeChannel:
    """A channel whose other end is the test."""

    def __init__(self, clock: Clock) -> None:
        self.closed = False
        self.broken = 0
        self.coming: list[Message] = []
        self.sent: list[Message] = []
        self.waits: list[float] = []
        self.woken_for: list[int] = []
        self._clock = clock

    def wake_for(self, descriptors: Sequence[int]) -> None:
        self.woken_for = list(descriptors)

    def receive(self, wait: float) -> list[Message]:
        self.waits.append(wait)
        if not self.coming:
            self._clock.time += wait
        coming, self.coming = self.coming, []
        return coming

    def send(self, message: Message) -> bool:
        self.sent.append(message)
        return not self.closed

    def close(self) -> None:
        self.closed = True


class Scene:
    """A guard and all around it."""

    def __init__(self, **options: Any) -> None:
        self.clock = Clock()
        self.outlet = FakeOutlet()
        self.outlet.clock = self.clock
        self.channel = FakeChannel(self.clock)
        self.pauses: list[float] = []
        self.guard = Guard(
            self.outlet,
            self.channel,  # type: ignore[arg-type]
            TIMEOUT,
            clock=self.clock,
            pause=self.pauses.append,
            **options,
        )
        self._number = 0

    def request(self, do: str, **about: Any) -> GuardRequest:
        self._number += 1
        return GuardRequest(self._number, do, about)

    def command(self, pressure: float = 2e4, age: float = 0.0) -> CommandFrame:
        self._number += 1
        now = self.clock.time - age
        return CommandFrame(self._number, now, now, 0.1, np.full(2, pressure))

    def step(self, *messages: Message) -> list[GuardAnswer]:
        """Let the guard take messages; return its answers."""
        self.channel.coming += messages
        before = len(self.channel.sent)
        self.guard.step()
        return [m for m in self.channel.sent[before:] if isinstance(m, GuardAnswer)]

    def pressed(self) -> Scene:
        """Armed and under pressure."""
        self.step(self.request("arm"))
        (answer,) = self.step(self.command())
        assert answer.armed
        assert answer.commanded.tolist() == [2e4, 2e4]
        self.outlet.did.clear()
        return self


# commands ----------------------------------------------------------------------------------------


def test_a_command_is_passed_on_and_answered() -> None:
    scene = Scene(epoch=900.0)
    scene.step(scene.request("arm"))
    (answer,) = scene.step(scene.command(6e4))
    (command,) = scene.outlet.commands
    assert command.time == pytest.approx(100.0)  # on the rig's clock
    assert command.valid_for == 0.1
    assert (answer.sequence, answer.armed) == (2, True)
    assert (answer.limited, answer.force_limited) == (True, True)
    assert answer.commanded.tolist() == [6e4, 6e4]
    assert answer.measured.tolist() == [6e4 + 1, 6e4 + 1]
    assert answer.time == pytest.approx(907.0)  # on everybody's
    assert (answer.tripped, answer.refused, answer.error) == ("", "", "")


def test_of_several_commands_only_the_newest_is_passed_on() -> None:
    scene = Scene().pressed()
    (answer,) = scene.step(*[scene.command(p) for p in (1e4, 3e4, 4e4)])
    assert answer.sequence == 5
    assert scene.outlet.pressures.tolist() == [4e4, 4e4]
    assert scene.outlet.did == ["apply"]


def test_what_the_gate_refuses_is_told_and_no_trip() -> None:
    scene = Scene().pressed()
    scene.outlet.fail["apply"] = [CommandError("too high")]
    (answer,) = scene.step(scene.command(9e9))
    assert answer.refused == "too high"
    assert answer.armed
    assert answer.commanded.tolist() == [2e4, 2e4]


def test_a_refused_command_shows_that_the_loop_lives() -> None:
    scene = Scene().pressed()
    for _ in range(20):
        scene.clock.time += 0.01
        scene.outlet.fail["apply"] = [CommandError("too high")]
        scene.step(scene.command(9e9))
    assert "vent" not in scene.outlet.did


@pytest.mark.parametrize("error", [DeviceError("no answer"), RuntimeError("no answer")])
def test_a_supply_that_fails_trips(error: Exception, capsys: pytest.CaptureFixture[str]) -> None:
    scene = Scene().pressed()
    scene.outlet.fail["apply"] = [error]
    answers = scene.step(scene.command())
    assert scene.outlet.did == ["apply", "vent"]
    assert [answer.sequence for answer in answers] == [0, 3]
    assert "no answer" in answers[1].error
    kind = "" if isinstance(error, DeviceError) else "RuntimeError: "
    assert answers[1].tripped == f"the supply failed: {kind}no answer"
    assert answers[1].error == f"{kind}no answer"
    assert answers[1].armed is False
    assert "vented: the supply failed" in capsys.readouterr().err


# silence -----------------------------------------------------------------------------------------


def test_silence_vents_in_time(capsys: pytest.CaptureFixture[str]) -> None:
    scene = Scene().pressed()
    silent_since = scene.clock.time
    while "vent" not in scene.outlet.did:
        scene.step()
        scene.clock.time += 1e-4
    assert TIMEOUT < scene.clock.time - silent_since < TIMEOUT + 2e-3
    (told,) = [m for m in scene.channel.sent if isinstance(m, GuardAnswer) and m.tripped]
    assert (told.sequence, told.tripped, told.trips, told.armed) == (0, SILENT, 1, False)
    assert told.commanded.tolist() == [0, 0]
    assert f"vented: {SILENT}" in capsys.readouterr().err


def test_a_fed_guard_does_not_vent() -> None:
    scene = Scene().pressed()
    for _ in range(100):
        scene.clock.time += 0.9 * TIMEOUT
        scene.step(scene.command())
    assert set(scene.outlet.did) == {"apply"}


def test_nothing_but_commands_feeds() -> None:
    scene = Scene().pressed()
    for _ in range(6):
        scene.clock.time += 0.01
        scene.step(scene.request("read"))
    assert "vent" in scene.outlet.did


def test_the_first_command_may_take_longer_but_not_for_ever() -> None:
    scene = Scene()
    scene.step(scene.request("arm"))
    scene.clock.time += 0.9 * GUARD.first_command
    scene.step()
    assert scene.outlet.did == ["arm"]
    scene.clock.time += 0.2 * GUARD.first_command
    scene.step()
    assert scene.outlet.did == ["arm", "vent"]


@pytest.mark.parametrize("rest", ["nothing", "old", "new"])
def test_a_loop_that_was_stopped_finds_the_trip(rest: str) -> None:
    """Also if guard and loop were stopped together, and the loop went on first."""
    scene = Scene().pressed()
    sent = {"nothing": [], "old": [scene.command()], "new": []}[rest]
    scene.clock.time += 1.0
    sent += [scene.command()] if rest == "new" else []
    answers = scene.step(*sent)
    assert answers[0].tripped == SILENT
    assert scene.outlet.did == ["vent"]
    (answer,) = scene.step(scene.command())
    assert answer.tripped == SILENT
    assert scene.outlet.did == ["vent"]


def test_commands_that_waited_while_the_device_was_slow_count() -> None:
    scene = Scene().pressed()
    frames = []
    for _ in range(20):
        scene.clock.time += 0.01
        frames.append(scene.command())
    scene.step(*frames)
    assert scene.outlet.did == ["apply"]


def test_a_gap_between_commands_that_waited_trips() -> None:
    scene = Scene().pressed()
    first = scene.command()
    scene.clock.time += 2 * TIMEOUT
    scene.step(first, scene.command())
    assert scene.outlet.did == ["vent"]


@pytest.mark.parametrize("sent", [math.nan, 1e12])
def test_a_command_that_was_sent_at_no_time_trips(sent: float) -> None:
    scene = Scene().pressed()
    frame = CommandFrame(9, sent, 0.0, 0.1, np.zeros(2))
    scene.step(frame)
    assert scene.outlet.did == ["vent"]


# what makes no sense -----------------------------------------------------------------------------


def wired() -> tuple[Scene, socket.socket]:
    """A guard with a channel of its own, and the other end of that."""
    scene = Scene()
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.settimeout(5)
    scene.channel = channel = GuardChannel(ours)  # type: ignore[assignment]
    scene.guard._channel = channel  # type: ignore[assignment]
    return scene, theirs


def test_messages_that_make_no_sense_are_refused_and_counted_and_feed_nobody(
    capsys: pytest.CaptureFixture[str],
) -> None:
    scene, loop = wired()
    deep = b"R[1, " + 30000 * b"["
    junk = [deep, b'R["x", "read", {}]', b'R[-1, "arm", {}]', b"", b"C", b"Q" * 9]

    def heard() -> list[GuardAnswer]:
        scene.guard.step()
        answers = [unpack(loop.recv(1 << 16))]
        return [a for a in answers if isinstance(a, GuardAnswer)]

    with loop:
        loop.send(scene.request("arm").pack())
        assert heard()[0].armed
        for packet in junk:
            loop.send(packet)
            loop.send(scene.command().pack())
            (answer,) = heard()
            assert answer.armed
            assert not answer.error
        assert answer.broken == len(junk)
        assert "vent" not in scene.outlet.did
        said = capsys.readouterr().err.splitlines()
        assert said[0] == "stiffopt guard: messages refused so far that make no sense: 1"
        assert len(said) == 3  # of 1, 2 and 4: it is not a word for each
        began = scene.clock.time
        while "vent" not in scene.outlet.did:
            assert scene.clock.time < began + 2 * TIMEOUT
            scene.clock.time += 5e-3
            loop.send(deep)
            scene.guard.step()
        assert scene.clock.time > began + TIMEOUT
        scene.channel.close()


def test_what_is_answered_fits_into_a_packet() -> None:
    scene, loop = wired()
    with loop:
        word = 20_000 * "\N{SNOWMAN}"  # 3 bytes each here, and 6 in the answer
        loop.send(b"R" + json.dumps([7, word, {}], ensure_ascii=False).encode())
        scene.guard.step()
        answer = unpack(loop.recv(1 << 16))
        assert isinstance(answer, GuardAnswer)
        assert answer.sequence == 7
        assert answer.error.startswith("the guard does not know")
        assert not scene.channel.closed
        scene.channel.close()


# arming and venting ------------------------------------------------------------------------------


def test_a_trip_is_latched_until_a_loop_that_knows_of_it_arms() -> None:
    scene = Scene().pressed()
    scene.clock.time += 1.0
    scene.step()
    (answer,) = scene.step(scene.request("arm", told=0))
    assert answer.error == f"the guard had vented: {SILENT}"
    (answer,) = scene.step(scene.request("vent"))
    assert answer.tripped == SILENT
    assert "arm" not in scene.outlet.did
    (answer,) = scene.step(scene.request("arm", told=1))
    assert (answer.error, answer.tripped, answer.armed) == ("", "", True)
    (answer,) = scene.step(scene.command())
    assert answer.commanded.tolist() == [2e4, 2e4]


def test_the_next_trip_must_be_told_too() -> None:
    scene = Scene().pressed()
    for told in (1, 2):
        scene.clock.time += 2.0
        scene.step()
        assert scene.step(scene.request("arm", told=told - 1))[0].error
        assert not scene.step(scene.request("arm", told=told))[0].error


def test_to_vent_comes_first() -> None:
    scene = Scene().pressed()
    arm, command, read = scene.request("arm"), scene.command(), scene.request("read")
    first, last = scene.request("vent"), scene.request("vent")
    answers = scene.step(arm, command, first, read, last, scene.request("read"))
    assert scene.outlet.did == ["vent", "vent", "read", "read"]
    assert [bool(answer.error) for answer in answers] == [True, False, False, False, False]
    assert "overtaken" in answers[0].error
    assert [answer.sequence for answer in answers[:3]] == [
        request.sequence for request in (arm, first, last)
    ]
    assert read.sequence in [answer.sequence for answer in answers[3:]]  # it could wait


def test_a_goal_that_is_overtaken_is_told() -> None:
    scene = Scene()
    scene.step(scene.request("arm"))
    goals = [replace(scene.command(), goal=True) for _ in range(3)]
    answers = scene.step(goals[0], goals[1], scene.request("vent"), goals[2])
    told = {answer.sequence: answer.refused for answer in answers}
    assert told[goals[0].sequence] == "a newer command has overtaken this one"
    assert told[goals[1].sequence] == "a request to vent has overtaken this one"
    assert goals[2].sequence in told


def test_a_request_overtakes_no_command() -> None:
    scene = Scene().pressed()
    answers = scene.step(scene.command(3e4), scene.request("read"))
    assert scene.outlet.did == ["read", "apply"]
    assert scene.outlet.pressures.tolist() == [3e4, 3e4]
    assert not any(answer.error for answer in answers)


def test_a_command_at_the_last_instant_feeds() -> None:
    scene = Scene()
    scene.clock.time = 1024.0  # what follows is exact in binary
    scene.guard._timeout = 2.0**-4
    scene.pressed()
    for _ in range(3):
        scene.clock.time += 2.0**-4
        scene.step(scene.command())
    assert scene.outlet.did == ["apply"] * 3


def test_a_guard_to_which_nothing_has_happened_says_so() -> None:
    scene = Scene()
    (answer,) = scene.step(scene.request("ping"))
    said = (answer.error, answer.tripped, answer.refused, answer.armed, answer.trips, answer.value)
    assert said == ("", "", "", False, 0, None)
    assert np.isnan(answer.measured).all()
    assert answer.measured.dtype == float
    assert scene.step(scene.request("read"))[0].time == 7.0  # the rig's clock is everybody's


@pytest.mark.parametrize("do", ["arm", "vent"])
def test_a_command_from_before_does_not_survive(do: str) -> None:
    scene = Scene().pressed()
    scene.step(scene.command(), scene.request(do))
    assert "apply" not in scene.outlet.did


def test_a_vented_guard_waits_for_no_command() -> None:
    scene = Scene().pressed()
    scene.step(scene.request("vent"))
    scene.clock.time += 5.0
    scene.step()
    assert scene.outlet.did == ["vent"]
    assert not scene.step(scene.request("read"))[0].tripped


def test_to_arm_what_is_armed_begins_without_pressure() -> None:
    scene = Scene().pressed()
    (answer,) = scene.step(scene.request("arm"))
    assert scene.outlet.did == ["vent", "arm"]
    assert answer.commanded.tolist() == [0, 0]


def test_what_cannot_be_armed_is_vented() -> None:
    scene = Scene()
    scene.outlet.fail["arm"] = [DeviceError("valve")]
    (answer,) = scene.step(scene.request("arm"))
    assert (answer.error, answer.armed) == ("valve", False)
    assert scene.outlet.did == ["arm", "vent"]


def test_venting_is_tried_until_it_works(capsys: pytest.CaptureFixture[str]) -> None:
    scene = Scene().pressed()
    scene.outlet.fail["vent"] = [DeviceError("no answer")] * 5
    (answer,) = scene.step(scene.request("vent"))
    assert answer.error == "no answer"
    assert scene.step(scene.request("arm"))[0].error.startswith("the supply could not be vented")
    for _ in range(20):
        scene.step()
    assert scene.outlet.did == ["vent"] * 6
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "stiffopt guard: COULD NOT VENT, and tries again: no answer",
        "stiffopt guard: vented after all",
    ]
    assert not scene.step(scene.request("arm"))[0].error


def test_a_trip_that_cannot_vent_does_not_say_that_it_did(
    capsys: pytest.CaptureFixture[str],
) -> None:
    scene = Scene().pressed()
    scene.outlet.fail["vent"] = [DeviceError("no answer")]
    scene.clock.time += 1.0
    scene.step()
    assert f"vented: {SILENT}" not in capsys.readouterr().err


def test_a_guard_of_a_service_speaks_json(capsys: pytest.CaptureFixture[str]) -> None:
    scene = Scene(as_json=True).pressed()
    scene.outlet.fail["vent"] = [DeviceError("no \N{SNOWMAN}")]
    scene.clock.time += 1.0
    scene.step()
    for _ in range(9):
        scene.step()
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [(line["level"], line["kind"], line["text"]) for line in lines] == [
        ("error", "guard", "COULD NOT VENT, and tries again: no \N{SNOWMAN}"),
        ("warning", "guard", "vented after all"),
    ]
    assert all(line["time"].endswith("Z") for line in lines)


# goals -------------------------------------------------------------------------------------------

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


# callers -----------------------------------------------------------------------------------------


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


# other requests ----------------------------------------------------------------------------------


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


class FakeRest:
    """Hosts a tracker."""

    def __init__(self) -> None:
        self.new: list[PoseSample] = []

    def poses(self) -> Sequence[PoseSample]:
        new, self.new = self.new, []
        return new

    def ask(self, word: str, about: dict[str, Any]) -> Any:
        if word != "truth":
            raise InputError(f"no {word}")
        return [about["n"]]


UNTURNED = np.array([1.0, 0, 0, 0])


def sample(frame: int) -> PoseSample:
    return PoseSample(10.0 + frame, 10.5 + frame, frame, np.full(3, float(frame)), UNTURNED)


def test_the_poses_of_a_hosted_tracker_are_forwarded() -> None:
    rest = FakeRest()
    scene = Scene(epoch=900.0, hosted=rest)
    rest.new = [sample(i) for i in range(450)]
    scene.step()
    packets = [m for m in scene.channel.sent if isinstance(m, TrackedPoses)]
    assert [len(packet.samples) for packet in packets] == [200, 200, 50]
    first = packets[0].samples[0]
    assert (first.time, first.received, first.frame) == (910.0, 910.5, 0)
    last = packets[2].samples[-1]
    assert last.position is not None
    assert last.position.tolist() == [449.0] * 3
    assert last.quaternion is not None
    assert last.quaternion.tolist() == [1.0, 0, 0, 0]
    assert scene.channel.waits[-1] < 0.005
    scene.step()
    assert len([m for m in scene.channel.sent if isinstance(m, TrackedPoses)]) == 3


def test_what_is_not_for_the_guard_is_left() -> None:
    scene = Scene().pressed()
    assert scene.step(GuardNotice("ready"), scene.command())[0].armed


def test_only_a_simulation_knows_the_truth() -> None:
    scene = Scene(hosted=FakeRest())
    assert scene.step(scene.request("truth", n=3))[0].value == [3]
    assert scene.step(scene.request("lie"))[0].error == "no lie"
    scene = Scene()
    assert "does not know 'truth'" in scene.step(scene.request("truth"))[0].error


def test_garbage_is_collected_while_nothing_is_under_pressure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    collected: list[int] = []
    monkeypatch.setattr(gc, "collect", lambda: collected.append(1))
    scene = Scene()
    begin = scene.clock.time
    while scene.clock.time < begin + 35:
        scene.step()
    assert len(collected) == 3
    scene.pressed()
    collected.clear()
    for _ in range(300):
        scene.clock.time += 0.04
        scene.step(scene.command())
    assert not collected


# the end -----------------------------------------------------------------------------------------


def test_the_end_of_the_loop_s_process_vents_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    scene = Scene().pressed()
    scene.channel.closed = True
    before = scene.clock.time
    assert scene.guard.serve() == 0
    assert scene.clock.time - before < TIMEOUT
    assert scene.outlet.did == ["vent", "close"]
    assert "vented: the process that commands has ended" in capsys.readouterr().err


def test_to_close_vents_and_ends_quietly(capsys: pytest.CaptureFixture[str]) -> None:
    scene = Scene().pressed()
    scene.channel.coming = [scene.request("close")]
    assert scene.guard.serve() == 0
    assert scene.outlet.did == ["vent", "vent", "close"]
    assert isinstance(scene.channel.sent[-1], GuardAnswer)
    assert capsys.readouterr().err == ""


def test_a_signal_vents_and_ends() -> None:
    scene = Scene().pressed()
    scene.guard.leave("SIGTERM")
    assert scene.guard.serve() == 0
    assert scene.outlet.did == ["vent", "close"]


def test_a_bug_vents(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    scene = Scene().pressed()

    def fail(wait: float) -> list[Message]:
        raise RuntimeError("bug")

    monkeypatch.setattr(scene.channel, "receive", fail)
    with pytest.raises(RuntimeError, match="bug"):
        scene.guard.serve()
    assert scene.outlet.did == ["vent", "close"]
    assert "vented: the guard failed: RuntimeError: bug" in capsys.readouterr().err


def test_at_the_end_venting_is_tried_again_and_again() -> None:
    scene = Scene().pressed()
    scene.outlet.fail["vent"] = [DeviceError("no answer")] * 7
    scene.channel.closed = True
    assert scene.guard.serve() == 0
    assert scene.outlet.did == ["vent"] * 8 + ["close"]
    assert scene.pauses == [0.05] * 7


def test_the_end_of_what_was_not_armed_is_no_news(capsys: pytest.CaptureFixture[str]) -> None:
    scene = Scene()
    scene.channel.closed = True
    assert scene.guard.serve() == 0
    assert scene.outlet.did == ["vent", "close"]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("what", ["vent", "close"])
def test_what_cannot_be_vented_is_told_loudly(
    what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = Scene().pressed()
    scene.outlet.fail[what] = [DeviceError("no answer")] * 100
    scene.channel.closed = True
    assert scene.guard.serve() == 1
    assert len(scene.outlet.did) < 50
    assert "THE SUPPLY COULD NOT BE VENTED: no answer" in capsys.readouterr().err


@pytest.mark.parametrize("error", [BrokenPipeError(), OSError(), ValueError("closed file")])
def test_a_listener_that_is_gone_keeps_nothing_from_venting(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Gone(io.StringIO):
        def write(self, _: str) -> int:
            raise error

    monkeypatch.setattr(sys, "stderr", Gone())
    scene = Scene().pressed()
    scene.clock.time += 1.0
    scene.step()
    assert scene.outlet.did == ["vent"]


def test_what_is_said_is_said_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    class Listener(io.StringIO):
        heard = ""

        def flush(self) -> None:
            self.heard = self.getvalue()

    listener = Listener()
    monkeypatch.setattr(sys, "stderr", listener)
    scene = Scene().pressed()
    scene.clock.time += 1.0
    scene.step()
    assert SILENT in listener.heard


# the process -------------------------------------------------------------------------------------


class Process:
    """The main function of the guard, with a supply of ours."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.outlet = FakeOutlet()
        self.error: Exception | None = None
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.channel, self._descriptor = GuardChannel(ours), theirs.detach()
        monkeypatch.setattr(guard_module, "owned", self._owned)
        stdin = io.TextIOWrapper(io.BytesIO(pickle.dumps(("rig", "robot"))))
        monkeypatch.setattr(sys, "stdin", stdin)

    def _owned(self, rig: str, robot: str) -> Owned:
        assert (rig, robot) == ("rig", "robot")
        warnings.warn("this takes its time", SlowWarning, stacklevel=1)
        if self.error is not None:
            raise self.error
        return Owned(self.outlet, None, TIMEOUT, lambda: None)  # type: ignore[arg-type]

    def run(self, *messages: Message, more: Sequence[str] = ()) -> tuple[int, list[Message]]:
        for message in messages:
            assert self.channel.send(message)
        code = main([str(self._descriptor), *more])
        said = self.channel.receive()
        self.channel.close()
        return code, said


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Iterator[Process]:
    before = {s: signal.getsignal(s) for s in signal.valid_signals()}
    made = Process(monkeypatch)
    yield made
    for number, handler in before.items():
        with suppress(OSError, ValueError, TypeError):
            signal.signal(number, handler)
    made.channel.close()
    with suppress(OSError):
        socket.close(made._descriptor)


def test_the_process_opens_guards_and_ends(process: Process) -> None:
    code, said = process.run(GuardRequest(1, "arm"), GuardRequest(2, "close"))
    assert code == 0
    assert process.outlet.did == ["open", "arm", "vent", "vent", "close"]
    notice, ready, armed, closed = said
    assert notice == GuardNotice("notice", {"text": "this takes its time"})
    assert isinstance(ready, GuardNotice)
    assert ready.kind == "ready"
    assert "real-time: " in ready.about["real_time"]
    assert isinstance(armed, GuardAnswer)
    assert isinstance(closed, GuardAnswer)
    assert armed.armed
    assert not closed.armed
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


@pytest.mark.parametrize("more", [(), ("json",)])
def test_the_process_says_what_it_has_to_say_as_it_is_told(
    process: Process, more: Sequence[str], capsys: pytest.CaptureFixture[str]
) -> None:
    process.outlet.fail["close"] = [DeviceError("no answer")]
    assert process.run(GuardRequest(1, "close"), more=more)[0] == 1
    said = capsys.readouterr().err
    assert (json.loads(said)["level"] == "error") if more else said.startswith("stiffopt guard: ")


def test_the_process_leaves_at_sigterm(process: Process, monkeypatch: pytest.MonkeyPatch) -> None:
    def arm() -> None:
        process.outlet.did.append("arm")
        signal.raise_signal(signal.SIGINT)  # ignored
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(process.outlet, "arm", arm)
    assert process.run(GuardRequest(1, "arm"))[0] == 0
    assert process.outlet.did == ["open", "arm", "vent", "close"]


@pytest.mark.parametrize(
    "error", [DeviceError("no answer"), MissingExtraError("pymodbus", "modbus")]
)
def test_the_process_says_why_it_cannot_start(process: Process, error: Exception) -> None:
    process.error = error
    code, said = process.run()
    assert code == 1
    assert said[1] == GuardNotice(
        "failed", {"kind": type(error).__name__, "args": list(error.args)}
    )


def test_the_file_is_a_program(process: Process, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hosted, "owned", process._owned)
    monkeypatch.setattr(sys, "argv", ["guard", str(process._descriptor)])
    process.error = DeviceError("no answer")
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(guard_module.__file__), run_name="__main__")
    assert end.value.code == 1


def test_a_signal_has_a_name() -> None:
    assert guard_module._signal_name(signal.SIGTERM) == "SIGTERM"
    assert guard_module._signal_name(signal.SIGRTMIN + 6) == f"signal {signal.SIGRTMIN + 6}"


def test_a_sigterm_before_there_is_a_supply_ends(
    process: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(rig: str, robot: str) -> Owned:
        signal.raise_signal(signal.SIGTERM)
        raise AssertionError("it did not end")

    monkeypatch.setattr(guard_module, "owned", interrupted)
    with pytest.raises(SystemExit):
        process.run()


# what it owns ------------------------------------------------------------------------------------

RIGS = Path(__file__).parent.parent / "rig"


def test_a_simulated_rig_is_hosted_whole() -> None:
    supply = owned(
        load_rig_description(RIGS / "sim-two-segment.yaml"),
        load_description("stiff-flop-2-hanging"),
    )
    supply.gate.open()
    rest = supply.hosted
    assert rest is not None
    assert supply.timeout == TIMEOUT
    first = rest.poses()  # none yet, but on a machine that is busy
    time.sleep(0.2)
    samples = (*first, *rest.poses())
    assert [sample.frame for sample in samples][:3] == [1, 2, 3]
    assert -0.1 < time.monotonic() - supply.epoch - samples[-1].received < 1.0
    assert np.shape(rest.ask("truth", {})) == (4, 4)
    assert np.shape(rest.ask("pressures", {})) == (6,)
    with pytest.raises(DeviceError, match="knows nothing of 'future'"):
        rest.ask("future", {})
    rest.ask("inject", {"device": "supply", "fault": "off", "channel": None})
    with pytest.raises(DeviceError):
        supply.gate.vent()
    rest.ask("inject", {"device": "supply", "fault": "ok", "channel": None})
    supply.gate.close()


def test_an_arm_that_cannot_be_followed_shows_no_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    description = load_rig_description(RIGS / "sim.yaml")
    rig = make_rig(description, load_description("stiff-flop-1"), real_time=True)
    rest = HostedDevices(rig)

    def fail() -> None:
        raise DeviceError("buckled")

    assert rig.tracker is not None
    rest.poses()
    monkeypatch.setattr(rig.tracker, "_poll", fail)
    assert rest.poses() == ()
    rig.tracker = None
    assert HostedDevices(rig).poses() == ()


def test_of_a_real_rig_only_the_supply_is_owned() -> None:
    supply = owned(
        load_rig_description(RIGS / "modbus-aurora.yaml"), load_description("stiff-flop-1")
    )
    assert supply.hosted is None
    assert supply.epoch == 0
    assert type(supply.gate.supply).__name__ == "ModbusSupply"


# the wire ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "message",
    [
        CommandFrame(3, 1.0, 2.0, 0.5, np.array([1e5, np.nan])),
        GuardAnswer(4, np.array([1.0, 2.0]), np.array([3.0, np.nan]), 5.0, True, True, True, 6, 7),
        GuardAnswer(
            4, np.zeros(9), np.ones(9), 5.0, tripped="a", refused="b", error="µ", value=[[1.5]]
        ),
        GuardRequest(5, "inject", {"device": "supply", "channel": None}),
        GuardNotice("ready", {"real_time": "yes"}),
        TrackedPoses(
            (sample(3), PoseSample(1.0, 2.0, 4, np.full(3, np.nan), np.array([1.0, 0, 0, 0])))
        ),
        TrackedPoses(()),
    ],
)
def test_messages_arrive_as_they_were_sent(message: Message) -> None:
    again = unpack(message.pack())
    assert type(again) is type(message)
    np.testing.assert_equal(again.pack(), message.pack())
    np.testing.assert_equal(_plain(again), _plain(message))


def _plain(message: Any) -> Any:
    parts = dict(vars(message))
    if isinstance(message, TrackedPoses):
        parts["samples"] = [vars(s) for s in message.samples]
    return parts


@pytest.mark.parametrize(
    "packet",
    [b"X", b"C", b"C123", b"A12", b"R", b"R[1]", b"R5", b"W{}", b"P123", b"R\xff", b"",
     b'R["1", "read", {}]', b'R[null, "read", {}]', b'R[-1, "read", {}]', b'R[1.0, "read", {}]',
     b'R[true, "read", {}]', b'R[18446744073709551616, "read", {}]', b'R[NaN, "read", {}]',
     b'R[1, ["read"], {}]', b'R[1, "read", []]', b'R[1, "read", {}, 2]', b'W["ready", 1]',
     b"W[1, {}]", b"R" + 30000 * b"[", b"R" + 30000 * b'{"a":', b"W" + 30000 * b"[",
     b"R[" + 9000 * b"1" + b', "read", {}]', b"P" + np.full(10, np.inf).tobytes(),
     GuardAnswer(1, np.zeros(2), np.zeros(2), 0.0).pack()[:-3],
     CommandFrame(1, 0.0, 0.0, 0.0, np.zeros(2)).pack()[:-3]],
)  # fmt: skip
def test_a_broken_packet_is_no_message(packet: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011  # of struct, json, numpy or ours
        unpack(packet)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        channel = GuardChannel(ours)
        theirs.send(packet)
        theirs.send(GuardNotice("ready").pack())
        assert channel.receive(1.0) == [GuardNotice("ready")]
        assert channel.broken == 1
        assert not channel.closed
        channel.close()


@pytest.mark.parametrize("seed", range(3))
def test_whatever_comes_is_a_message_or_left_out(seed: int) -> None:
    draw = np.random.default_rng(seed)
    good = [
        GuardRequest(5, "arm", {"told": 0}).pack(),
        GuardNotice("ready").pack(),
        TrackedPoses((sample(3),)).pack(),
        CommandFrame(1, 0.0, 0.0, 0.0, np.zeros(2)).pack(),
        GuardAnswer(1, np.zeros(2), np.zeros(2), 0.0).pack(),
    ]
    for _ in range(3000):
        packet = bytearray(good[draw.integers(len(good))])
        for place in draw.integers(len(packet), size=draw.integers(1, 4)):
            packet[place] = draw.integers(256)
        with suppress(ValueError):
            unpack(bytes(packet[: draw.integers(1, len(packet) + 1)]))


def test_who_sends_without_end_keeps_nobody_from_the_rest() -> None:
    class Endless:
        def setblocking(self, _: bool) -> None:
            pass

        def fileno(self) -> int:
            return 0

        def recv(self, _: int) -> bytes:
            return b"X"

    channel = GuardChannel(Endless())  # type: ignore[arg-type]
    assert channel.receive() == []
    assert channel.broken == 1000


def test_a_channel_that_nobody_reads_waits_for_nothing() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        channel = GuardChannel(ours)
        for _ in range(100000):
            if not channel.send(GuardNotice("ready")):
                break
        else:
            raise AssertionError("it took everything")
        assert not channel.closed
    assert not channel.send(GuardNotice("ready"))
    assert channel.closed
    assert channel.receive(5.0) == []
    channel.close()


def test_a_closed_end_is_noticed() -> None:
    for unread in (False, True):
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        channel = GuardChannel(ours)
        if unread:
            assert channel.send(GuardNotice("ready"))
        theirs.close()
        assert channel.receive(5.0) == []
        assert channel.closed
        channel.close()
