"""The supply on NI-DAQ devices: the real nidaqmx, over gRPC, against a device of our own."""

from __future__ import annotations

import ctypes.util
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from pydantic import ValidationError

from fake_bench import FakeBench
from running import wait_for
from stiffopt.errors import CommandError, DeviceError, InputError, MissingExtraError
from stiffopt.lab.nidaq_peer import DaqServer, NidaqPeer
from stiffopt.rig.drivers.daqmx import (
    AnalogueInput,
    AnalogueOutput,
    Daqmx,
    InputChannel,
    WatchdogTask,
)
from stiffopt.rig.drivers.nidaq import NidaqSettings, NidaqSupply
from stiffopt.rig.interface import PressureLimits

pytestmark = pytest.mark.real_time

LIMITS = PressureLimits(np.zeros(2), np.full(2, 1.5e5))
VALVE = {"line": "Dev1/port0/line0"}


def settings(**changes: Any) -> NidaqSettings:
    """Two regulators of 0 to 3 bar, on 0 to 10 V; they report on 0.5 to 9.5 V."""
    data: dict[str, Any] = {
        "driver": "nidaq",
        "timeout": 1.0,
        "channels": [
            {
                "output": {"channel": f"Dev2/ao{i}", "pressures": ["0 bar", "3 bar"]},
                "input": {
                    "channel": f"Dev1/ai{i}",
                    "volts": ["0.5 V", "9.5 V"],
                    "pressures": ["0 bar", "3 bar"],
                    "terminals": "rse",
                },
            }
            for i in range(2)
        ],
    }
    return NidaqSettings(**{**data, **changes})


def channels(**changes: Any) -> list[dict[str, Any]]:
    """The channels of `settings`, the first of them changed."""
    made = settings().model_dump(mode="json", exclude_none=True)["channels"]
    for key, value in changes.items():
        if isinstance(value, dict):
            made[0][key].update(value)
        else:
            made[0][key] = value
    return made


@pytest.fixture
def bench() -> FakeBench:
    return FakeBench(2)


@pytest.fixture
def started(bench: FakeBench) -> Iterator[Callable[..., NidaqSupply]]:
    """Return what starts a peer and makes the supply that reaches it."""
    peers: list[NidaqPeer] = []
    supplies: list[NidaqSupply] = []

    def make(**changes: Any) -> NidaqSupply:
        peers.append(NidaqPeer(settings(**changes), bench))
        supply = peers[-1].start().device(LIMITS)
        assert isinstance(supply, NidaqSupply)
        supply.peer = peers[-1]  # type: ignore[attr-defined]
        supplies.append(supply)
        return supply

    yield make
    bench.faults.clear()
    for supply in supplies:
        try:
            supply.close()
        except DeviceError:
            assert not supply.is_open
    for peer in peers:
        peer.close()
        peer.close()
    assert not [t for t in threading.enumerate() if t.name == "daq-server"]


class Wires:
    """A device of which only the volts are known."""

    def __init__(self) -> None:
        self.out: dict[str, float] = {}
        self.into = {"Dev1/ai0": 0.5, "Dev1/ai1": 0.5}
        self.server = DaqServer(
            None,
            "nidaq",
            outputs={f"Dev2/ao{i}": self._writer(f"Dev2/ao{i}") for i in range(2)},
            inputs={name: self._reader(name) for name in self.into},
        )

    def _writer(self, name: str) -> Callable[[float], None]:
        return lambda volts: self.out.update({name: volts})

    def _reader(self, name: str) -> Callable[[], float]:
        return lambda: self.into[name]


@pytest.fixture
def wires() -> Iterator[Wires]:
    made = Wires()
    yield made
    made.server.close()


# volts and pressures --------------------------------------------------------------------------


def test_volts_are_those_of_the_wiring(wires: Wires) -> None:
    with settings(grpc=wires.server.start()).device(LIMITS) as supply:
        assert wires.out == {"Dev2/ao0": 0.0, "Dev2/ao1": 0.0}
        supply.arm()
        supply.command([1.5e5, 0.3e5])
        assert wires.out == pytest.approx({"Dev2/ao0": 5.0, "Dev2/ao1": 1.0})
        wires.into = {"Dev1/ai0": 2.75, "Dev1/ai1": 0.44}  # a quarter of the way, and below zero
        assert supply.read().pressures == pytest.approx([0.75e5, -0.02e5])
    assert wires.out == {"Dev2/ao0": 0.0, "Dev2/ao1": 0.0}


def test_a_regulator_whose_zero_is_not_0_v_vents_at_its_zero(wires: Wires) -> None:
    output = {"volts": ["9 V", "1 V"], "pressures": ["-1 bar", "3 bar"]}
    made = settings(grpc=wires.server.start(), channels=channels(output=output))
    with made.device(PressureLimits(np.array([-0.5e5, 0]), np.full(2, 1.5e5))) as supply:
        assert wires.out["Dev2/ao0"] == pytest.approx(7.0)
        supply.arm()
        supply.command([-0.5e5, 0.0])
        assert wires.out["Dev2/ao0"] == pytest.approx(8.0)
    assert wires.out["Dev2/ao0"] == pytest.approx(7.0)


@pytest.mark.parametrize("junk", [1e9, np.inf, -1e9, -np.inf, np.nan])
def test_volts_are_clamped_just_before_they_are_written(wires: Wires, junk: float) -> None:
    made = settings(grpc=wires.server.start(), channels=channels(output={"volts": ["1 V", "9 V"]}))
    with made.device(LIMITS) as supply:
        supply._write(np.array([junk, 1e5]))  # what the base class never does
        assert 1.0 <= wires.out["Dev2/ao0"] <= 9.0
        assert wires.out["Dev2/ao0"] == (9.0 if junk == 1e9 else 1.0)


def test_limits_are_the_tightest_of_all() -> None:
    made = settings(channels=channels(max="0.9 bar", output={"pressures": ["0 bar", "1 bar"]}))
    assert list(made.device(LIMITS).limits.high) == [0.9e5, 1.5e5]
    made = settings(channels=channels(output={"pressures": ["0 bar", "1 bar"]}))
    assert list(made.device(LIMITS).limits.high) == [1e5, 1.5e5]
    with pytest.raises(CommandError, match=r"channel 1: 1.2 bar is out of range"):
        made.device(LIMITS).limits.check([1.2e5, 1.2e5])
    with pytest.raises(InputError, match="channel 1: its limits leave no pressure"):
        settings(channels=channels(min="1.6 bar")).device(LIMITS)
    with pytest.raises(InputError, match=r"there are 2 channels, but limits for 3"):
        settings().device(PressureLimits(np.zeros(3), np.ones(3)))


def test_a_channel_without_an_input_reads_nan(started: Any) -> None:
    made = channels()
    del made[0]["input"]
    with started(channels=made) as supply:
        supply.arm()
        supply.command([1e5, 0.6e5])
        np.testing.assert_allclose(supply.read().pressures, [np.nan, 0.6e5])
    for each in made:
        each.pop("input", None)
    with started(channels=made) as supply:
        supply.arm()
        assert np.isnan(supply.exchange([1e5, 0.6e5]).pressures).all()


@pytest.mark.parametrize("method", ["command", "exchange"])
def test_an_output_that_is_not_where_it_should_be(wires: Wires, method: str) -> None:
    made = settings(
        grpc=wires.server.start(), channels=channels(output={"read_back": "Dev1/ai1"}, input={})
    )
    made = made.model_copy(update={"channels": (made.channels[0], settings().channels[1])})
    wires.into["Dev1/ai1"] = 0.03
    with made.device(LIMITS) as supply:
        supply.arm()
        wires.into["Dev1/ai1"] = 4.97
        getattr(supply, method)([1.5e5, 0])
        wires.into["Dev1/ai1"] = 4.5
        with pytest.raises(DeviceError, match=r"channel 1: Dev2/ao0 is at 4.500 V instead of 5"):
            getattr(supply, method)([1.5e5, 0])
        wires.into["Dev1/ai1"] = 0.0


# dump valve and watchdog ----------------------------------------------------------------------


@pytest.mark.parametrize("closed_when", ["high", "low"])
def test_the_valve_opens_when_it_vents(started: Any, bench: FakeBench, closed_when: str) -> None:
    with started(dump_valve={**VALVE, "closed_when": closed_when}) as supply:
        assert bench.valve_states == [True]
        supply.arm()
        supply.command([1e5, 1e5])
        assert bench.valve_states == [True, False]
        supply.vent()
        assert bench.valve_states == [True, False, True]
        supply.arm()
    assert bench.valve_states == [True, False, True, False, True]


def test_the_level_of_the_line() -> None:
    levels: list[bool] = []
    for closed_when in ("high", "low"):
        server = DaqServer(
            None,
            "nidaq",
            outputs={f"Dev2/ao{i}": lambda volts: None for i in range(2)},
            inputs={f"Dev1/ai{i}": lambda: 0.5 for i in range(2)},
            lines={VALVE["line"]: levels.append},
        )
        valve = {**VALVE, "closed_when": closed_when}
        with settings(grpc=server.start(), dump_valve=valve).device(LIMITS) as supply:
            supply.arm()
        server.close()
    assert levels == [False, True, False, True, False, True]


def test_the_watchdog_empties_the_arm_when_the_software_is_silent(
    started: Any, bench: FakeBench
) -> None:
    with started(dump_valve=VALVE, watchdog=0.5) as supply:
        supply.arm()
        began = last = time.monotonic()
        while last < began + 1.0:  # twice as long as it waits
            last = time.monotonic()
            supply.command([1e5, 1e5])
        assert not bench.valve_open
        wait_for(lambda: bench.valve_open, 5)
        assert time.monotonic() - last > 0.49
        with pytest.raises(DeviceError, match=r"watchdog has opened the dump valve.*0.5 s"):
            supply.command([1e5, 1e5])
        assert bench.valve_open
        supply.command([0, 0])  # an empty arm is what was asked for
        supply.vent()
        supply.arm()
        assert not bench.valve_open
        supply.command([1e5, 1e5])
    assert bench.valve_open


def test_a_vented_supply_is_not_watched(started: Any, bench: FakeBench) -> None:
    with started(dump_valve=VALVE, watchdog=0.05) as supply:
        supply.arm()
        supply.vent()
        states = list(bench.valve_states)
        time.sleep(0.2)
        assert bench.valve_states == states


def test_the_watchdog_opens_a_valve_that_close_could_not(
    started: Any, bench: FakeBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    supply = started(dump_valve=VALVE, watchdog=0.2)
    supply.open()
    supply.arm()

    def fail(*, high: bool) -> None:
        raise DeviceError("the line is stuck")

    monkeypatch.setattr(supply._valve._line, "write", fail)
    with pytest.raises(DeviceError, match="the line is stuck"):
        supply.close()
    assert not supply.is_open
    assert bench.valve_open


def test_the_watchdog_acts_when_the_connection_is_lost(started: Any, bench: FakeBench) -> None:
    supply = started(dump_valve=VALVE, watchdog=0.2, timeout=0.5)
    supply.open()
    supply.arm()
    supply.command([1e5, 1e5])
    bench.faults["supply"] = "off"
    with pytest.raises(DeviceError, match=r"has not answered for 0.5 s"):
        supply.close()
    wait_for(lambda: bench.valve_open, 5)
    assert not bench.pressures_in_arm.any()


def test_a_watchdog_that_has_expired_before_is_cleared(started: Any, bench: FakeBench) -> None:
    supply = started(dump_valve=VALVE, watchdog=5.0)
    lost = Daqmx(supply._settings.grpc, 1.0, "nidaq")  # a program that died on the job
    watchdog = WatchdogTask(lost, VALVE["line"], 0.02, high=False)
    watchdog.start()
    wait_for(lambda: bench.valve_open, 5)
    watchdog.close()
    lost.close()
    with supply:
        supply.arm()
        assert not bench.valve_open


# failures -------------------------------------------------------------------------------------


def test_without_the_driver_of_ni_the_error_says_what_to_install() -> None:
    if ctypes.util.find_library("nidaqmx"):
        pytest.skip("NI's driver is here")
    with pytest.raises(DeviceError, match=r"opening Dev2/ao0, Dev2/ao1 failed: NI's driver is not"):
        settings().device(LIMITS).open()


@pytest.mark.parametrize("module", ["nidaqmx", "grpc"])
def test_without_the_library_the_error_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, module: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=r"nidaqmx.*stiffopt\[nidaq\]"):
        settings(grpc="127.0.0.1:1").device(LIMITS).open()


def test_a_server_that_is_not_there() -> None:
    with pytest.raises(DeviceError, match=r"server at 127.0.0.1:1 cannot be reached"):
        settings(grpc="127.0.0.1:1").device(LIMITS).open()


def test_a_server_that_accepts_and_says_nothing() -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        address = "{}:{}".format(*mute.getsockname())
        began = time.monotonic()
        with pytest.raises(DeviceError, match=r"has not answered|cannot be reached"):
            settings(grpc=address, timeout=0.2).device(LIMITS).open()
        assert time.monotonic() - began < 3.0


def test_a_device_that_goes_silent_does_not_hang_its_user(started: Any, bench: FakeBench) -> None:
    supply = started(timeout=1.0)
    supply.open()
    supply.arm()
    supply.command([1e5, 1e5])
    bench.faults["supply"] = "off"
    uses = (lambda: supply.command([1e5, 0]), supply.read, supply.vent, supply.close)
    for use in uses:
        began = time.monotonic()
        with pytest.raises(DeviceError, match=r"has not answered for 1 s"):
            use()
        assert time.monotonic() - began < 6.0
    assert not supply.is_open
    assert bench.pressures[0] == pytest.approx(1e5)  # it did not get through, and close said so
    assert bench.pressures[1] == pytest.approx(1e5)


@pytest.mark.parametrize("same", [True, False])
@pytest.mark.parametrize("how", ["silent", "unreachable"])
def test_tasks_that_could_not_be_closed_are_closed_when_it_comes_back(
    started: Any, bench: FakeBench, how: str, same: bool
) -> None:
    first = started(timeout=0.2, dump_valve=VALVE, watchdog=5.0 if how == "silent" else None)
    first.open()
    first.arm()
    first.command([1e5, 1e5])
    server = first.peer._server
    if how == "silent":
        bench.faults["supply"] = "off"
        first._valve._watchdog.stop = lambda: None  # else `close` waits for it
        first._valve._watchdog.running = False
    else:
        server._answers = lambda context: context.abort(grpc.StatusCode.UNAVAILABLE, "")
    with pytest.raises(DeviceError, match=r"has not answered|cannot be reached"):
        first.close()
    assert bench.pressures == pytest.approx([1e5, 1e5])
    again = first if same else first._settings.device(LIMITS)
    for _ in range(2):  # as long as it is away
        with pytest.raises(DeviceError, match=r"has not answered|cannot be reached"):
            again.open()
    bench.faults.clear()
    vars(server).pop("_answers", None)
    with again:
        assert not bench.pressures.any()
        assert bench.valve_open
        again.arm()
        again.command([0.5e5, 0.5e5])
        assert bench.pressures == pytest.approx([0.5e5, 0.5e5])
    assert not bench.pressures.any()
    assert not server._sessions


def test_a_server_that_has_started_anew_knows_no_tasks(bench: FakeBench) -> None:
    peer = NidaqPeer(settings(), bench)
    made = peer.start()
    supply = made.device(LIMITS)
    supply.open()
    supply.arm()
    supply.command([1e5, 1e5])
    peer.close()
    with pytest.raises(DeviceError, match="cannot be reached"):
        supply.close()
    anew = NidaqPeer(made, bench)
    anew.start()
    other = Daqmx(made.grpc, 1.0, "nidaq")  # asks for what was left to be closed
    sensor = AnalogueInput(other, [InputChannel("Dev1/ai1", "rse", -10.0, 10.0)], shared=True)
    with made.model_copy(update={"share_inputs": True}).device(LIMITS):
        assert not bench.pressures.any()
        assert np.isfinite(sensor.read()).all()
    sensor.close()
    other.close()
    supply.open()
    supply.close()
    assert not anew._server._sessions
    anew.close()


def test_a_device_that_comes_back(started: Any, bench: FakeBench) -> None:
    with started(timeout=0.5) as supply:
        supply.arm()
        bench.faults["supply"] = "off"
        with pytest.raises(DeviceError):
            supply.read()
        bench.faults["supply"] = "ok"
        supply.command([1e5, 1e5])
        assert supply.read().pressures == pytest.approx([1e5, 1e5])


def test_a_slow_device_still_serves(started: Any, bench: FakeBench) -> None:
    with started() as supply:
        supply.arm()
        bench.faults["supply"] = "slow"
        began = time.monotonic()
        supply.command([1e5, 1e5])
        assert time.monotonic() - began > 0.2
        assert bench.pressures == pytest.approx([1e5, 1e5])
        bench.faults.clear()


def test_a_server_that_dies(started: Any) -> None:
    supply = started(timeout=10.0)
    supply.open()
    supply.arm()
    supply.peer.close()
    began = time.monotonic()
    with pytest.raises(DeviceError, match="cannot be reached"):
        supply.command([1e5, 1e5])
    with pytest.raises(DeviceError, match="cannot be reached"):
        supply.read()
    assert time.monotonic() - began < 5.0
    with pytest.raises(DeviceError, match="cannot be reached"):
        supply.close()
    supply.close()


def test_a_channel_that_the_device_has_not(bench: FakeBench) -> None:
    peer = NidaqPeer(settings(), bench)
    address = peer.start().grpc
    wrong = settings(grpc=address, channels=channels(input={"channel": "Dev1/ai7"}))
    with pytest.raises(DeviceError) as caught:
        wrong.device(LIMITS).open()
    assert "opening Dev1/ai7, Dev1/ai1 failed" in str(caught.value)
    assert "NI-DAQmx -200170" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not peer._server._sessions  # nothing was left open
    peer.close()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dump_valve": {"line": "Dev1/port0/line7"}}, "opening Dev1/port0/line7 failed"),
        ({"channels": channels(input={"channel": "Dev1/ai7"})}, "opening Dev1/ai7, Dev1/ai1 fail"),
    ],
)
def test_an_opening_that_fails_leaves_no_pressure(
    wires: Wires, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], message: str
) -> None:
    made = settings(grpc=wires.server.start(), **changes)
    for index in (0, 1):
        wires.out[f"Dev2/ao{index}"] = 3.3  # of an earlier program
    with pytest.raises(DeviceError, match=message):
        made.device(LIMITS).open()
    assert wires.out == {"Dev2/ao0": 0.0, "Dev2/ao1": 0.0}
    assert not wires.server._sessions

    def fail(self: AnalogueOutput, volts: Any) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(AnalogueOutput, "write", fail)
    with pytest.raises(DeviceError, match=message):  # the first error is told
        made.device(LIMITS).open()
    assert not wires.server._sessions


def test_an_opening_that_fails_writes_the_zero_of_the_regulator(wires: Wires) -> None:
    output = {"volts": ["9 V", "1 V"], "pressures": ["-1 bar", "3 bar"]}
    valve = {"line": "Dev1/port0/line7"}
    made = settings(grpc=wires.server.start(), channels=channels(output=output), dump_valve=valve)
    with pytest.raises(DeviceError, match="line7"):
        made.device(LIMITS).open()
    assert wires.out == pytest.approx({"Dev2/ao0": 7.0, "Dev2/ao1": 0.0})


def test_a_device_that_is_taken(started: Any) -> None:
    with started() as supply:
        supply.arm()
        with pytest.raises(DeviceError, match=r"-50103.*close the program that uses the device"):
            supply._settings.device(LIMITS).open()
        supply.command([1e5, 1e5])  # the first is not disturbed


def test_inputs_are_shared_where_the_rig_file_says_so(started: Any, bench: FakeBench) -> None:
    other = [InputChannel("Dev1/ai1", "rse", -10.0, 10.0)]
    for shared in (True, False):
        with started(share_inputs=shared, timeout=0.2) as supply:
            supply.arm()
            supply.command([1e5, 0.6e5])
            daq = Daqmx(supply._settings.grpc, 0.2, "nidaq")
            sensor = AnalogueInput(daq, other, shared=True)
            if shared:
                for _ in range(5):
                    assert sensor.read()[0] == pytest.approx(2.3)  # 0.5 V + 9 V * 0.6 / 3
                    assert supply.read().pressures == pytest.approx([1e5, 0.6e5])
            else:
                with pytest.raises(DeviceError, match="-50103"):
                    sensor.read()
            sensor.close()
            sensor.close()
            daq.close()


def test_close_does_not_swallow_a_vent_that_failed(
    started: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    supply = started()
    supply.open()

    def fail(volts: Any) -> None:
        raise DeviceError("the outputs are stuck")

    monkeypatch.setattr(supply._outputs, "write", fail)
    with pytest.raises(DeviceError, match="the outputs are stuck"):
        supply.close()
    assert not supply.peer._server._sessions


# the peer -------------------------------------------------------------------------------------


def test_the_peer_listens_where_it_is_told_and_only_on_this_machine(bench: FakeBench) -> None:
    first = NidaqPeer(settings(), bench)
    address = first.start().grpc
    second = NidaqPeer(settings(grpc=address), bench)
    with pytest.raises(DeviceError, match=rf"cannot listen on {address}: the port is in use"):
        second.start()
    second.close()
    first.close()
    again = NidaqPeer(settings(grpc=address), bench)
    assert again.start().grpc == address
    again.close()
    far = NidaqPeer(settings(grpc="192.0.2.7:31763"), bench)
    assert re.fullmatch(r"127\.0\.0\.1:\d+", far.start().grpc or "")
    far.close()


def test_the_peer_refuses_what_it_does_not_know(started: Any) -> None:
    from nidaqmx.errors import RpcError
    from nidaqmx.grpc_session_options import GrpcSessionOptions
    from nidaqmx.system import System

    supply = started()
    with grpc.insecure_channel(supply._settings.grpc) as channel:
        system = System.remote(GrpcSessionOptions(channel, ""))
        assert system.driver_version.major_version > 0
        with pytest.raises(RpcError, match="UNIMPLEMENTED"):
            _ = system.devices.device_names


# the rig file ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"watchdog": "200 ms"}, "watchdog: needs a 'dump_valve'"),
        ({"grpc": "10.0.0.5"}, "'10.0.0.5' is not an address; expected one such as"),
        ({"grpc": "10.0.0.5:0"}, "is not an address"),
        ({"channels": []}, "channels: "),
        ({"timeout": "0 s"}, "timeout: must be greater than 0"),
        ({"channels": channels(output={"channel": "Dev1/ai0"})}, r"channels\[0\].output.channel"),
        ({"channels": channels(output={"channel": "Dev1/ao0:2"})}, r"channels\[0\].output.channel"),
        ({"channels": channels(output={"volts": ["1 V", "1 V"]})}, "two different values"),
        ({"channels": channels(output={"volts": ["1 bar", "1 V"]})}, "not a unit of voltage"),
        ({"channels": channels(output={"pressures": ["1 bar", "3 bar"]})}, "could not vent"),
        ({"channels": channels(output={"channel": "Dev2/ao1"})}, r"already that of channel 1"),
        ({"channels": channels(input={"channel": "Dev1/ai1"})}, r"already that of channel 1"),
        ({"channels": channels(input={"range": ["1 V", "-1 V"]})}, "must be below"),
        ({"channels": channels(input={"terminals": "single"})}, "not one of"),
        ({"dump_valve": {"line": "Dev1/ao0"}}, "dump_valve.line"),
        ({"dump_valve": VALVE, "watchdog": "1 ms"}, "watchdog: must be at least 10 ms"),
    ],
)
def test_a_bad_rig_file(changes: dict[str, Any], message: str) -> None:
    with pytest.raises((InputError, ValidationError), match=message):
        settings(**changes)


def test_the_template_is_a_rig_that_can_be_rehearsed() -> None:
    from stiffopt.lab.probe_peer import ProbePeer
    from stiffopt.model.robot_files import load_description
    from stiffopt.rig.config import limits_of, load_rig_description
    from stiffopt.rig.drivers.probe import ZaberProbeSettings

    path = Path(__file__).parents[1] / "rig" / "nidaq-aurora.yaml"
    description = load_rig_description(path)
    assert isinstance(description.supply, NidaqSettings)
    assert isinstance(description.probe, ZaberProbeSettings)
    bench = FakeBench(3)
    peers = (NidaqPeer(description.supply, bench), ProbePeer(description.probe, bench))
    limits = limits_of(description, load_description(description.robot))
    supply = peers[0].start().device(limits)
    probe = peers[1].start().device(prompt=lambda request: None)
    with supply as arm, probe as hand:
        arm.arm()
        arm.command([1.5e5, 0, 0.75e5])
        assert arm.read().pressures == pytest.approx([1.5e5, 0, 0.75e5])
        hand.align([1, 0, 0])
        hand.move_to(0.001, 0.005)
    assert not bench.pressures.any()
    for peer in peers:
        peer.close()
