"""The guard with a stream of commands: what it passes on, refuses, and when it vents."""

from __future__ import annotations

import gc
import io
import json
import math
import socket
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from guard_scene import TIMEOUT, Scene, sample
from stiffopt.errors import CommandError, DeviceError, InputError
from stiffopt.rig.interface import PoseSample
from stiffopt.safety.messages import (
    CommandFrame,
    GuardAnswer,
    GuardChannel,
    GuardNotice,
    Message,
    TrackedPoses,
    unpack,
)
from stiffopt.safety.settings import GUARD

SILENT = "no command had come for 50 ms: the program that commands, or this computer, was late"


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
