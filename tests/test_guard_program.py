"""The guard as a program: it opens, hosts a rig, and ends with a vented arm."""

from __future__ import annotations

import io
import json
import pickle
import runpy
import signal
import socket
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from guard_scene import TIMEOUT, FakeOutlet
from stiffopt.errors import DeviceError, MissingExtraError, SlowWarning
from stiffopt.model.robot_files import load_description
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import load_rig_description
from stiffopt.safety import guard as guard_module
from stiffopt.safety import hosted
from stiffopt.safety.guard import main
from stiffopt.safety.hosted import HostedDevices, Owned, owned
from stiffopt.safety.messages import GuardAnswer, GuardChannel, GuardNotice, GuardRequest, Message


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


RIGS = Path(__file__).parent.parent / "rig"


@pytest.mark.real_time
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
    with pytest.raises(DeviceError, match="has no 'future'"):
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
