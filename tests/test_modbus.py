"""The Modbus driver against a device written by hand, the peer of the lab against raw requests."""

from __future__ import annotations

import os
import random
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fake_bench import FakeBench
from modbus_device import HandmadeDevice
from stiffopt.errors import DeviceError, FileError, InputError, MissingExtraError
from stiffopt.files import read_file
from stiffopt.lab.modbus_peer import ModbusPeer
from stiffopt.rig.drivers.modbus import ModbusLine, ModbusSettings, ModbusSupply, ModbusTcp
from stiffopt.rig.drivers.modbus_registers import PressureRegister, PressureScale
from stiffopt.rig.interface import Clock, PressureLimits
from stiffopt.schema import Schema

pytestmark = pytest.mark.real_time

LIMITS = PressureLimits(np.zeros(3), np.full(3, 1.5e5))
P = (1e5, 0.5e5, 1.2e5)
COUNTS = (1000, 500, 1200)  # at 1 mbar per count


def settings(port: int = 0, **changes: Any) -> ModbusSettings:
    values: dict[str, Any] = {
        "driver": "modbus",
        "tcp": {"host": "127.0.0.1", "port": port},
        "timeout": 2.0,
        "scale": "1 mbar",
        "channels": [{"setpoint": 0x800 + i, "reading": 0x10 + i} for i in range(3)],
    }
    return ModbusSettings(**{**values, **changes})


@pytest.fixture
def device() -> Iterator[HandmadeDevice]:
    made = HandmadeDevice()
    yield made
    made.close()


class StandingClock(Clock):
    """Time does not pass, so that nobody looks whether others command the device."""

    t = 1.0

    def now(self) -> float:
        return self.t

    def sleep_until(self, moment: float) -> None:
        self.t = max(self.t, moment)


@contextmanager
def opened(device: HandmadeDevice, **changes: Any) -> Iterator[ModbusSupply]:
    supply = settings(device.port, **changes).device(LIMITS, StandingClock())
    with supply:
        supply.arm()
        device.requests.clear()
        yield supply


def until(condition: Callable[[], bool], seconds: float = 5.0) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.005)
    return condition()


# counts ------------------------------------------------------------------------------------------

TYPES = ("int16", "uint16", "int32", "uint32", "float32")
SCALES = (
    PressureScale(counts=(0, 32767), pressure=(0.0, 1e6)),
    PressureScale(counts=(6553, 32767), pressure=(0.0, 1e6)),
    PressureScale(counts=(0, 4095), pressure=(2e5, -1e4)),
    PressureScale(counts=(0, 1), pressure=(0.0, 100.0)),
)


@given(
    st.sampled_from(TYPES),
    st.sampled_from(["big", "little"]),
    st.sampled_from(SCALES),
    st.floats(0, 1.5e5),
)
def test_counts_never_say_more_than_the_limit(
    kind: Any, order: Any, scale: PressureScale, pressure: float
) -> None:
    point = PressureRegister(7, "holding", kind, order, scale)
    per_count = abs(np.diff(scale.pressure)[0] / np.diff(scale.counts)[0])
    for highest, slack in ((pressure, 1.0), (1e9, 0.5)):
        registers = point.encode(pressure, highest=highest)
        assert len(registers) == point.width
        assert all(0 <= word <= 0xFFFF for word in registers)
        said = point.decode(registers)
        assert said <= highest + 1e-9 * highest
        assert abs(said - pressure) <= (slack + 1e-3) * per_count


@given(
    st.sampled_from(TYPES),
    st.sampled_from(SCALES),
    st.lists(st.floats(-1.5e5, 1.5e5), min_size=3, max_size=3),
)
def test_counts_stay_within_both_limits(
    kind: Any, scale: PressureScale, pressures: list[float]
) -> None:
    low, pressure, high = sorted(pressures)
    point = PressureRegister(7, "holding", kind, "big", scale)
    per_count = abs(np.diff(scale.pressure)[0] / np.diff(scale.counts)[0])
    reach = point.pressure_range()
    try:
        said = point.decode(point.encode(pressure, lowest=low, highest=high))
    except InputError:  # only where the register can say nothing between them
        assert min(high, reach[1]) - max(low, reach[0]) < 1.001 * per_count
    else:
        assert low <= said <= high or (pressure == 0 and said <= max(high, 0))
        assert abs(said - pressure) <= 1.001 * per_count or not reach[0] <= pressure <= reach[1]
    vented = point.decode(point.encode(0.0, lowest=low, highest=high))
    assert -1.001 * per_count <= vented <= max(high, 0.0)


def test_words_are_in_order() -> None:
    scale = PressureScale(counts=(0, 1), pressure=(0.0, 1.0))
    for kind, value, words in (
        ("int32", 0x12345, (0x0001, 0x2345)),
        ("uint32", 0x12345, (0x0001, 0x2345)),
        ("int16", -1.0, (0xFFFF,)),
        ("float32", 1.5, (0x3FC0, 0x0000)),
    ):
        assert PressureRegister(0, "holding", kind, "big", scale).encode(value) == words
        little = PressureRegister(0, "holding", kind, "little", scale)
        assert little.encode(value) == words[::-1]
        assert little.decode(words[::-1]) == value


def test_counts_stay_in_the_register() -> None:
    scale = PressureScale(counts=(0, 1), pressure=(0.0, 1.0))
    assert PressureRegister(0, "holding", "int16", "big", scale).encode(1e9) == (0x7FFF,)
    assert PressureRegister(0, "holding", "uint16", "big", scale).encode(-5.0) == (0,)
    with pytest.raises(InputError):
        PressureRegister(0, "holding", "int16", "big", scale).encode(float("nan"))


# driver: what is on the wire ---------------------------------------------------------------------


def test_writes_all_channels_in_one_request_and_reads_back(device: HandmadeDevice) -> None:
    with opened(device) as supply:
        supply.command(P)
        assert device.requests == [
            bytes.fromhex("10 0800 0003 06 03e8 01f4 04b0"),
            bytes.fromhex("03 0800 0003"),
        ]
        device.inputs.update({0x10: 990, 0x11: 0xFFFE, 0x12: 65535})
        np.testing.assert_allclose(supply.read().pressures, [99000.0, -200.0, -100.0])
        assert device.requests[-1] == bytes.fromhex("04 0010 0003")


def test_writes_and_reads_at_once(device: HandmadeDevice) -> None:
    with opened(device, table="holding", verify=False) as supply:
        device.holding.update({0x10: 1, 0x11: 2, 0x12: 3})
        reading = supply.exchange(P)
        assert device.requests == [
            bytes.fromhex("17 0010 0003 0800 0003 06 03e8 01f4 04b0"),
        ]
        np.testing.assert_allclose(reading.pressures, [100.0, 200.0, 300.0])
        np.testing.assert_array_equal(supply.commanded, P)


def test_one_request_also_reads_back_where_registers_meet(device: HandmadeDevice) -> None:
    channels = [{"setpoint": 100 + i, "reading": 103 + i} for i in range(3)]
    with opened(device, table="holding", channels=channels) as supply:
        device.holding[104] = 7
        np.testing.assert_allclose(supply.exchange(P).pressures, [0.0, 700.0, 0.0])
        assert device.requests == [bytes.fromhex("17 0064 0006 0064 0003 06 03e8 01f4 04b0")]
        device.answers[23] = lambda request: bytes.fromhex("17 0c") + bytes(12)
        with pytest.raises(DeviceError, match=r"channel 1 holds 0 bar after 1 bar"):
            supply.exchange(P)


def test_reads_back_apart_where_registers_do_not_meet(device: HandmadeDevice) -> None:
    with opened(device, table="holding") as supply:
        supply.exchange(P)
        assert device.requests[1:] == [bytes.fromhex("03 0800 0003")]
        device.answers[3] = lambda request: bytes.fromhex("03 06 03e8 01f5 04b0")
        with pytest.raises(DeviceError, match=r"register 2049 of channel 2 holds 0\.501 bar"):
            supply.exchange(P)
        device.answers.clear()


def test_asks_in_two_requests_where_one_is_unknown(device: HandmadeDevice) -> None:
    device.unknown.add(23)
    with opened(device, table="holding", verify=False) as supply:
        supply.exchange(P)
        assert device.functions() == [23, 16, 3]
        supply.exchange(P)
        assert device.functions() == [23, 16, 3, 16, 3]
    device.requests.clear()
    with opened(device, table="holding", verify=False, read_write=False) as supply:
        supply.exchange(P)
        assert device.functions() == [16, 3]


def test_registers_with_gaps_are_written_apart(device: HandmadeDevice) -> None:
    channels = [{"setpoint": 30}, {"setpoint": 10, "reading": 5}, {"setpoint": 11}]
    with opened(device, channels=channels) as supply:
        supply.command(P)
        assert device.requests[:2] == [
            bytes.fromhex("10 000a 0002 04 01f4 04b0"),
            bytes.fromhex("10 001e 0001 02 03e8"),
        ]
        device.inputs[5] = 20
        np.testing.assert_array_equal(supply.exchange(P).pressures, [np.nan, 2000.0, np.nan])


def test_reads_back_at_another_address(device: HandmadeDevice) -> None:
    channels = [{"setpoint": {"address": i, "read_back": 0x200 + i}} for i in range(3)]
    with opened(device, channels=channels, verify=False) as supply:
        supply.command(P)
    supply = settings(device.port, channels=channels).device(LIMITS)
    device.holding[0x201] = 9
    with pytest.raises(DeviceError, match=r"register 513 of channel 2 holds 0\.009 bar"):
        supply.open()


def test_floats(device: HandmadeDevice) -> None:
    channels = [{"setpoint": 2 * i, "reading": 2 * i} for i in range(3)]
    kinds = {"type": "float32", "word_order": "little", "scale": "1 bar"}
    with opened(device, channels=channels, **kinds) as supply:
        supply.command(P)
        assert device.holding[1] == 0x3F80  # 1.0, the low word first
        values = (float("nan"), 1e30, -0.25)
        for i, value in enumerate(values):
            high, low = struct.unpack(">HH", struct.pack(">f", value))
            device.inputs.update({2 * i: low, 2 * i + 1: high})
        read = supply.read().pressures
        np.testing.assert_allclose(read, np.array(values) * 1e5, rtol=1e-6)


def test_junk_given_to_the_last_method_is_clamped_too(device: HandmadeDevice) -> None:
    with opened(device) as supply:
        for junk in (np.nan, np.inf, -np.inf, 1e12, -1e12):
            for write in (supply._write, supply._exchange):
                write(np.array([junk, 1e5, junk]))
                held = [device.holding[0x800 + i] for i in range(3)]
                assert all(0 <= count <= 1500 for count in held), junk
                assert held[1] == 1000 or write == supply._exchange


def test_limits_of_channels_and_registers_hold(device: HandmadeDevice) -> None:
    channels = [
        {"setpoint": 1, "max": "1.2 bar"},
        {"setpoint": 2, "min": "0.1 bar"},
        {"setpoint": {"address": 3, "type": "uint16", "scale": "0.01 mbar"}},
    ]
    supply = settings(channels=channels).device(LIMITS)
    np.testing.assert_allclose(supply.limits.high, [1.2e5, 1.5e5, 65535.0])
    np.testing.assert_allclose(supply.limits.low, [0.0, 1e4, 0.0])
    with pytest.raises(InputError, match="3 channels, but limits for 2"):
        settings().device(PressureLimits(np.zeros(2), np.ones(2)))
    with pytest.raises(InputError, match="channel 1: its limits leave no pressure"):
        settings().device(PressureLimits(np.full(3, 1e9), np.full(3, 2e9)))


FALLING = {"counts": [0, 1000], "pressure": ["1 bar", "0 bar"]}


@pytest.mark.parametrize(
    ("low", "high", "asked", "count", "scale"),
    [
        (-50060.0, 0.0, -50060.0, -500, "1 mbar"),
        (-1e5, -20040.0, -20040.0, -201, "1 mbar"),
        (30040.0, 1e5, 30040.0, 301, "1 mbar"),
        (0.0, 30060.0, 30060.0, 300, "1 mbar"),
        (30040.0, 1e5, 30040.0, 699, FALLING),
        (0.0, 30060.0, 30060.0, 700, FALLING),
    ],
)
def test_what_is_on_the_wire_is_within_both_limits(
    device: HandmadeDevice, low: float, high: float, asked: float, count: int, scale: Any
) -> None:
    limits = PressureLimits(np.array([low]), np.array([high]))
    given = settings(device.port, channels=[{"setpoint": 0, "reading": 1}], scale=scale)
    given = given.model_copy(update={"table": "holding"})
    with given.device(limits, StandingClock()) as supply:
        supply.arm()
        for write, size in ((supply.command, 5), (supply.exchange, 9)):
            device.requests.clear()
            write([asked])
            assert struct.unpack(">h", device.requests[0][-2:]) == (count,), size
        supply.command([0.0])  # whatever the limits
        assert device.holding[0] == (1000 if scale is FALLING else 0)


def test_limits_between_two_counts_leave_nothing() -> None:
    made = settings(channels=[{"setpoint": 0}])
    with pytest.raises(
        InputError, match=r"channel 1: its register can say nothing from 0\.3004 to"
    ):
        made.device(PressureLimits(np.array([30040.0]), np.array([30060.0])))
    made.device(PressureLimits(np.array([0.0]), np.array([60.0])))
    made.device(PressureLimits(np.array([0.0]), np.array([0.0])))


# driver: failures --------------------------------------------------------------------------------


def refuse(code: int) -> Callable[[bytes], bytes]:
    return lambda request: bytes([request[0] | 0x80, code])


def test_says_what_was_refused(device: HandmadeDevice) -> None:
    with opened(device) as supply:
        device.answers[16] = refuse(2)
        text = (
            r"refuses: write channels 1, 2, 3 \(holding registers 2048 to 2050\).*no such address"
        )
        with pytest.raises(DeviceError, match=text):
            supply.command(P)
        assert not supply.commanded.any()
        device.answers = {4: refuse(99)}
        with pytest.raises(DeviceError, match=r"input registers 16 to 18.*exception 99"):
            supply.read()
        device.answers = {3: lambda request: bytes.fromhex("03 06 03e8 01f4 04b1")}
        with pytest.raises(DeviceError, match=r"register 2050 of channel 3 holds 1\.201 bar"):
            supply.command(P)
        device.answers.clear()
        supply.command(P)


def test_nobody_there() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        supply = settings(unused.getsockname()[1]).device(LIMITS)
        with pytest.raises(DeviceError, match=r"127\.0\.0\.1:\d+ cannot be reached; is it"):
            supply.open()
    assert not supply.is_open
    serial = settings(tcp=None, serial={"port": "/dev/no-such-port"}).device(LIMITS)
    with pytest.raises(DeviceError, match="/dev/no-such-port cannot be reached"):
        serial.open()


def test_silence_ends_in_time_and_nothing_is_sent_twice(device: HandmadeDevice) -> None:
    with opened(device, timeout=0.4) as supply:
        device.answers[16] = lambda request: b""
        began = time.monotonic()
        with pytest.raises(DeviceError, match=r"does not answer: write.*within 0.4 s"):
            supply.command(P)
        assert 0.35 < time.monotonic() - began < 1.2
        assert device.functions() == [16]
        device.answers.clear()
        supply.read()
        assert device.functions() == [16, 4]  # on a new connection, without the old command
        assert device.connections == 2
        supply.command(P)


def test_a_late_answer_is_not_taken_for_the_next(device: HandmadeDevice) -> None:
    def late(request: bytes) -> bytes:
        device.answers.clear()
        time.sleep(0.5)
        return bytes.fromhex("04 06 1111 1111 1111")

    with opened(device, timeout=0.4) as supply:
        device.answers[4] = late
        with pytest.raises(DeviceError):
            supply.read()
        for _ in range(5):
            np.testing.assert_array_equal(supply.read().pressures, np.zeros(3))
            time.sleep(0.03)


def test_a_broken_connection_is_an_error_once(device: HandmadeDevice) -> None:
    with opened(device) as supply:
        supply.command(P)
        device.hang_up()
        with pytest.raises(DeviceError, match="the connection broke"):
            supply.command(P)
        supply.command(P)
        assert device.connections == 2


def test_venting_survives_a_broken_connection(device: HandmadeDevice) -> None:
    with opened(device, dump_valve={"coil": 4}) as supply:
        supply.command(P)
        device.hang_up()
        supply.vent()
        assert not any(device.holding[0x800 + i] for i in range(3))
        assert device.coils[4] is False
        supply.arm()
        supply.command(P)
        assert device.holding[0x800] == COUNTS[0]
        device.hang_up()  # and now `close` finds it broken
    assert not any(device.holding[0x800 + i] for i in range(3))


def test_venting_goes_on_to_other_registers(device: HandmadeDevice) -> None:
    channels = [{"setpoint": 10}, {"setpoint": 20}, {"setpoint": 30}]

    def stubborn(request: bytes) -> bytes:
        return refuse(4)(request) if request[1:3] == b"\0\x14" else device._answer(request)

    supply = settings(device.port, channels=channels).device(LIMITS)
    supply.open()
    supply.arm()
    supply.command(P)
    device.answers[16] = stubborn
    with pytest.raises(DeviceError, match=r"channel 2 \(holding register 20\)"):
        supply.close()
    assert (device.holding[10], device.holding[20], device.holding[30]) == (0, 500, 0)
    assert not supply.is_open
    supply.close()


def test_venting_goes_on_after_a_register_that_does_not_answer(device: HandmadeDevice) -> None:
    def partly_silent(request: bytes) -> bytes:
        return b"" if request[1:3] == b"\0\0" else device._answer(request)

    channels = [{"setpoint": 0}, {"setpoint": 10}, {"setpoint": 20}]
    with opened(device, channels=channels, timeout=0.15) as supply:
        supply.command(P)
        device.answers[16] = partly_silent
        with pytest.raises(DeviceError, match=r"write channel 1 \(holding register 0\)"):
            supply.command(np.array(P) / 2)
        assert (device.holding[10], device.holding[20]) == (500, 1200)  # not so if it is no vent
        with pytest.raises(DeviceError, match=r"write channel 1 \(holding register 0\)"):
            supply.vent()
        assert [device.holding[i] for i in (0, 10, 20)] == [1000, 0, 0]
        device.answers.clear()


@pytest.mark.parametrize(
    ("method", "request_"), [("_write", "ask"), ("_exchange", "ask_registers")]
)
def test_what_was_checked_before_close_is_not_written_after_it(
    device: HandmadeDevice, monkeypatch: pytest.MonkeyPatch, method: str, request_: str
) -> None:
    supply = settings(device.port, table="holding", verify=False).device(LIMITS)
    supply.open()
    supply.arm()
    checked, closed = threading.Event(), threading.Event()
    send = getattr(supply._line, request_)
    failed: list[DeviceError] = []

    def late(*args: Any, **options: Any) -> Any:
        if threading.current_thread() is thread:
            checked.set()
            assert closed.wait(5)
        return send(*args, **options)

    def write() -> None:
        try:
            getattr(supply, method)(np.array(P))
        except DeviceError as error:
            failed.append(error)

    monkeypatch.setattr(supply._line, request_, late)
    thread = threading.Thread(target=write)
    thread.start()
    assert checked.wait(5)
    supply.close()
    before = list(device.requests)
    closed.set()
    thread.join(5)
    assert not thread.is_alive()
    assert "is closed; nothing was sent" in str(failed[0])
    assert device.requests == before
    assert device.connections == 1
    assert not any(device.holding[0x800 + i] for i in range(3))
    supply.open()  # and then it is another line
    supply.close()


def test_a_closed_line_stays_closed(device: HandmadeDevice) -> None:
    line = ModbusLine(ModbusTcp(host="127.0.0.1", port=device.port), 1, 2.0)
    line.connect()
    line.close()
    line.close()
    for use in (line.connect, lambda: line.write(1, 2), lambda: line.read("it", "input", 0, 1)):
        with pytest.raises(DeviceError, match="is closed; nothing was sent"):
            use()
    line.disconnect()
    with pytest.raises(DeviceError, match="is closed"):
        line.write(1, 2)
    assert until(lambda: device.connections == 1)
    assert not device.requests


@pytest.mark.parametrize("end", [ModbusLine.close, ModbusLine.disconnect])
def test_a_line_is_closed_after_the_request_under_way(
    device: HandmadeDevice, end: Callable[[ModbusLine], None]
) -> None:
    go = threading.Event()

    def late(request: bytes) -> bytes:
        assert go.wait(5)
        return bytes.fromhex("04 02 0007")

    device.answers[4] = late
    line = ModbusLine(ModbusTcp(host="127.0.0.1", port=device.port), 1, 2.0)
    got: list[Any] = []
    reader = threading.Thread(target=lambda: got.append(line.read("it", "input", 0, 1)))
    closer = threading.Thread(target=lambda: end(line))
    reader.start()
    assert until(lambda: bool(device.requests))
    closer.start()
    closer.join(0.1)
    assert closer.is_alive()
    go.set()
    for thread in (reader, closer):
        thread.join(5)
        assert not thread.is_alive()
    assert got == [[7]]
    line.close()


def test_close_without_a_peer_ends_in_time(device: HandmadeDevice) -> None:
    supply = settings(device.port, dump_valve={"coil": 4}, timeout=0.3).device(LIMITS)
    supply.open()
    device.answers = dict.fromkeys((3, 5, 16), lambda request: b"")
    began = time.monotonic()
    with pytest.raises(DeviceError):
        supply.close()
    assert time.monotonic() - began < 4.0  # eight requests of 0.3 s: both outputs, all insisted on
    assert not supply.is_open


@pytest.mark.parametrize("other", ["03 02 0000", "06 0800 03e8", "10 0801 0003", "97 01"])
def test_an_answer_to_something_else_is_no_answer(device: HandmadeDevice, other: str) -> None:
    with opened(device, verify=False) as supply:
        device.answers[16] = lambda request: bytes.fromhex(other)
        with pytest.raises(DeviceError, match="answers something else: write channels 1, 2, 3"):
            supply.command(P)
        device.answers.clear()
        supply.command(P)
        assert device.connections == 2


@pytest.mark.parametrize(("answer", "n"), [("04 04 0001 0002", 2), ("04 08" + "0001" * 4, 4)])
def test_readings_that_are_too_few_or_too_many(device: HandmadeDevice, answer: str, n: int) -> None:
    with opened(device) as supply:
        device.answers[4] = lambda request: bytes.fromhex(answer)
        with pytest.raises(DeviceError, match=f"sends {n} registers, not 3: read channels 1, 2, 3"):
            supply.read()


def test_garbage_is_a_device_error(device: HandmadeDevice) -> None:
    generator = random.Random(1)
    failures = 0
    with opened(device, verify=False, table="holding") as supply:
        for _ in range(100):
            head = generator.choice([bytes([3]), bytes([23]), bytes([16]), bytes([0x83]), b""])
            junk = head + generator.randbytes(generator.randrange(1, 12))
            device.answers = dict.fromkeys((3, 16, 23), lambda request, junk=junk: junk)
            device.rude = True
            for act in (supply.read, lambda: supply.exchange(P), lambda: supply.command(P)):
                try:
                    act()
                except DeviceError as error:
                    failures += "\n" not in str(error)
        device.answers.clear()
        device.rude = False
        device.hang_up()
    assert failures > 200
    assert not any(device.holding[0x800 + i] for i in range(3))


@pytest.mark.parametrize(("energised", "shut"), [("closed", True), ("open", False)])
def test_dump_valve(device: HandmadeDevice, energised: str, shut: bool) -> None:
    valve = {"coil": 9, "energised": energised}
    with opened(device, dump_valve=valve) as supply:
        assert supply.has_dump_valve
        assert device.coils == {9: shut}
        supply.vent()
        assert device.coils == {9: not shut}
        supply.arm()
        assert device.coils == {9: shut}
    assert device.coils == {9: not shut}


# driver: the device's watchdog -------------------------------------------------------------------

WATCHDOG = {
    "timeout": "400 ms",
    "address": 0x1000,
    "resolution": "100 ms",
    "before": [{"address": 0x1008, "value": 0x55AA}],
    "after": [{"address": 0x1001, "value": 0x8000}],
    "trigger": 0x1003,
}


def test_watchdog_is_started_before_anything_moves(device: HandmadeDevice) -> None:
    with settings(device.port, watchdog=WATCHDOG, verify=False).device(LIMITS) as supply:
        assert device.requests[:5] == [
            bytes.fromhex("06 1008 55aa"),
            bytes.fromhex("03 1000 0001"),
            bytes.fromhex("06 1000 0004"),
            bytes.fromhex("06 1001 8000"),
            bytes.fromhex("10 0800 0003 06 0000 0000 0000"),
        ]
        supply.arm()
        device.requests.clear()
        supply.command(P)
        supply.exchange(P)
        beats = [request for request in device.requests if request[:3] == b"\x06\x10\x03"]
        assert len(beats) == 2
        assert beats[0] != beats[1]


@pytest.mark.parametrize(("method", "code"), [("command", 16), ("exchange", 23)])
def test_watchdog_is_started_anew_on_a_new_connection(
    device: HandmadeDevice, method: str, code: int
) -> None:
    with opened(device, watchdog=WATCHDOG, verify=False, table="holding") as supply:
        device.hang_up()
        device.holding.clear()  # it was switched off and on
        with pytest.raises(DeviceError):
            getattr(supply, method)(P)
        device.requests.clear()
        getattr(supply, method)(P)
        assert device.functions() == [6, 3, 6, 6, code, 6]
        assert device.holding[0x1000] == 4
        device.requests.clear()
        device.hang_up()
        supply.vent()  # goes first, whatever the watchdog says
        assert device.requests[0] == bytes.fromhex("10 0800 0003 06 0000 0000 0000")


def test_watchdog_is_started_anew_when_opened_again(device: HandmadeDevice) -> None:
    supply = settings(device.port, watchdog=WATCHDOG).device(LIMITS)
    for _ in range(2):
        device.holding.clear()
        with supply:
            assert device.holding[0x1000] == 4


def test_time_of_the_watchdog_is_not_written_again(device: HandmadeDevice) -> None:
    device.holding[0x1120] = 500
    with settings(device.port, watchdog={"address": 0x1120}).device(LIMITS):
        assert device.functions()[:2] == [3, 16]


def test_supply_vents_though_the_watchdog_is_refused(device: HandmadeDevice) -> None:
    device.holding.update({0x800: 9, 0x801: 9, 0x802: 9})
    device.answers[6] = refuse(2)
    supply = settings(device.port, watchdog=WATCHDOG).device(LIMITS)
    with pytest.raises(DeviceError, match="write 21930 to register 4104"):
        supply.open()
    assert not supply.is_open
    assert not any(device.holding[0x800 + i] for i in range(3))


# settings ----------------------------------------------------------------------------------------


class RigFile(Schema):
    supply: ModbusSettings


RIG = """
format: stiffopt-rig/1
supply:
  driver: modbus
  tcp: {host: 192.168.1.10}
  scale: {counts: [0, 32767], pressure: [0 bar, 10 bar]}
  watchdog: {timeout: 500 ms, address: 0x1120}
  channels:
    - {setpoint: 0x0800, reading: 0}
    - setpoint: {address: 0x0801, type: uint16, scale: 1 mbar}
"""


def test_settings_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(RIG)
    read = read_file(path, "rig", RigFile).supply
    assert read.setpoints[0].address == 0x800
    assert read.setpoints[0].encode(1e6) == (32767,)
    assert read.setpoints[1].encode(1e5) == (1000,)
    assert list(read.readings) == [0]
    assert read.timeout == 0.2
    assert read.watchdog is not None
    assert read.watchdog.counts == 500


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0x0801, type", "0x0800, type", "[1].setpoint: register 2048 is that of channel 1"),
        ("scale: 1 mbar", "scale: 1", "scale: bare number 1 has no unit"),
        ("scale: 1 mbar", "scale: 1 mm", "scale: '1 mm': 'mm' is not a unit of pressure per count"),
        ("tcp: {host: 192.168.1.10}", "timeout: 1 s", "one of the keys 'tcp' and 'serial'"),
        ("reading: 0}", "reading: 70000}", "must be at most 65535"),
        ("[0, 32767]", "[5, 5]", "scale.counts: the two points must differ"),
        ("reading: 0}", "reading: 0, max: 0 bar, min: 1 bar}", "[0].max: must be above min"),
        ("type: uint16, scale: 1 mbar", "scale: {counts: [0, 1], pressure: [4 bar, 5 bar]}, "
         "type: uint16", "the register cannot say 0 bar"),
        ("timeout: 500 ms", "timeout: 0.1 ms", "expected 1 to 65535 times the resolution"),
        ("0x1120", "0x0800", "register 2048 is that of the watchdog"),
        ("0x1120}", "0x1120, trigger: 0x0801}", "register 2049 is that of the watchdog"),
        ("reading: 0}", "reading: {address: 65535, type: int32}}", "[0]: its registers go beyond"),
        ("type: uint16", "typ: uint16", "did you mean 'type'?"),
        ("192.168.1.10}", "192.168.1.10}\n  serial: {port: COM3}", "one of the keys"),
        ("tcp: {host: 192.168.1.10}", "serial: {port: COM3}\n  unit: 0", "expected 1 to 247"),
        ("reading: 0}", "reading: true}", "expected a mapping, not True"),
    ],
)  # fmt: skip
def test_mistakes_in_a_file(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "rig.yaml"
    assert old in RIG
    path.write_text(RIG.replace(old, new))
    with pytest.raises(FileError) as error:
        read_file(path, "rig", RigFile)
    assert message in str(error.value)


@pytest.mark.parametrize("module", ["pymodbus.client", "serial"])
def test_library_that_is_missing(monkeypatch: pytest.MonkeyPatch, module: str) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    supply = settings(tcp=None, serial={"port": "COM3"}).device(LIMITS)
    with pytest.raises(MissingExtraError, match=r"stiffopt\[modbus\]"):
        supply.open()


def test_template_can_be_rehearsed() -> None:
    from stiffopt.rig.config import RigDescription

    template = Path(__file__).parents[1] / "rig" / "modbus-aurora.yaml"
    given = read_file(template, "rig", RigDescription).supply.model_copy(update={"timeout": 2.0})
    assert given.verify
    assert given.dump_valve is not None
    bench = FakeBench()
    peer = ModbusPeer(given, bench)
    try:
        with peer.start().device(LIMITS) as supply:
            assert bench.valve_open
            supply.arm()
            measured = supply.exchange(LIMITS.high).pressures
            assert supply._joint is not None
            for values in (measured, bench.pressures, bench.pressures_in_arm):
                np.testing.assert_allclose(values, LIMITS.high, atol=1e6 / 32767)
            assert until(lambda: bench.valve_open)  # the watchdog
            assert not bench.pressures.any()
    finally:
        peer.close()


# the lab's peer ----------------------------------------------------------------------------------


class Raw:
    """A Modbus TCP client by hand."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=5)

    def __enter__(self) -> Raw:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def ask(self, request: str) -> str:
        body = bytes.fromhex(request)
        self.socket.sendall(struct.pack(">HHHB", 77, 0, len(body) + 1, 1) + body)
        head = self.socket.recv(7, socket.MSG_WAITALL)
        transaction, _, length, _ = struct.unpack(">HHHB", head)
        assert transaction == 77
        return self.socket.recv(length - 1, socket.MSG_WAITALL).hex()


@contextmanager
def peer_for(**changes: Any) -> Iterator[tuple[ModbusSettings, FakeBench]]:
    bench = FakeBench()
    peer = ModbusPeer(settings(**changes), bench)
    try:
        yield peer.start(), bench
    finally:
        peer.close()


def port_of(given: ModbusSettings) -> int:
    assert given.tcp is not None
    return given.tcp.port


def test_peer_carries_pressures_over() -> None:
    with peer_for() as (given, bench), Raw(port_of(given)) as raw:
        assert raw.ask("10 0800 0003 06 03e8 01f4 04b0") == "1008000003"
        np.testing.assert_allclose(bench.pressures, P)
        assert raw.ask("03 0800 0003") == "030603e801f404b0"
        assert raw.ask("04 0010 0003") == "040603e801f404b0"
        bench.readings = np.array([-100.0, np.nan, 1e9])
        assert raw.ask("04 0010 0003") == "0406ffff7fff7fff"
        assert raw.ask("06 0801 0001") == "0608010001"
        assert bench.pressures[1] == 100.0
        assert raw.ask("03 0803 0001") == "8302"  # no such address
        assert raw.ask("10 07ff 0002 04 0001 0001") == "9002"
        assert raw.ask("04 0000 0001") == "8402"


def test_peer_hides_set_points_behind_readings_as_couplers_do() -> None:
    channels = [
        {"setpoint": {"address": i, "read_back": 0x200 + i}, "reading": i} for i in range(3)
    ]
    with peer_for(channels=channels, table="holding") as (given, bench):
        bench.readings = np.array([100.0, 200.0, 300.0])
        with given.device(LIMITS) as supply, Raw(port_of(given)) as raw:
            supply.arm()
            reading = supply.exchange(P)
            np.testing.assert_allclose(reading.pressures, bench.readings)
            np.testing.assert_allclose(bench.pressures, P)
            assert raw.ask("03 0000 0003") == "0306000100020003"
            assert raw.ask("03 0200 0003") == "030603e801f404b0"
            assert raw.ask("17 0000 0001 0001 0001 02 0007") == "17020001"
            assert bench.pressures[1] == 700.0


@pytest.mark.parametrize("kind", ["int32", "uint32", "float32"])
@pytest.mark.parametrize("order", ["big", "little"])
def test_peer_and_driver_in_wide_registers(kind: str, order: str) -> None:
    channels = [{"setpoint": 2 * i, "reading": 10 + 2 * i} for i in range(3)]
    wide = {"type": kind, "word_order": order, "scale": "1 Pa", "table": "holding"}
    with peer_for(channels=channels, **wide) as (given, bench), given.device(LIMITS) as supply:
        supply.arm()
        np.testing.assert_allclose(supply.exchange(P).pressures, P)
        np.testing.assert_allclose(bench.pressures, P)
        bench.readings = np.array([np.nan, 1e5, 2e5])
        assert np.isnan(supply.read().pressures[0]) == (kind == "float32")


def test_peer_has_a_watchdog() -> None:
    valve = {"coil": 3}
    watchdog = {**WATCHDOG, "timeout": 0.5, "resolution": 0.01}
    with peer_for(watchdog=watchdog, dump_valve=valve) as (given, bench):
        assert bench.valve_open  # as long as nobody is there
        with given.device(LIMITS) as supply:
            supply.arm()
            end = time.monotonic() + 0.9
            while time.monotonic() < end:
                supply.command(P)
                supply.read()
                time.sleep(0.01)
            assert bench.pressures.all()
            assert not bench.valve_open
            assert until(lambda: bench.valve_open)
            assert not bench.pressures.any()
            commands = len(bench.commands)
            time.sleep(0.1)
            assert len(bench.commands) == commands
            with pytest.raises(DeviceError, match="has the device's watchdog run out"):
                supply.command(P)
            supply.vent()
            supply.arm()
            supply.command(P)
            assert bench.pressures.all()


@pytest.mark.parametrize("table", ["input", "holding"])
def test_a_foreign_set_point_is_a_fault(device: HandmadeDevice, table: str) -> None:
    with opened(device, table=table) as supply:
        for _ in range(20):
            supply.clock.sleep(0.01)
            supply.exchange(P)
        device.holding[0x801] += 1  # another program writes to it
        supply.clock.sleep(0.05)
        with pytest.raises(DeviceError, match="does another program write to it"):
            supply.exchange(P)


def test_peer_without_a_watchdog_keeps_pressures() -> None:
    with peer_for() as (given, bench), Raw(port_of(given)) as raw:
        raw.ask("10 0800 0003 06 03e8 01f4 04b0")
        time.sleep(0.3)
        np.testing.assert_allclose(bench.pressures, P)


def test_peer_that_is_off_or_slow() -> None:
    with peer_for(timeout=0.6) as (given, bench), given.device(LIMITS) as supply:
        supply.arm()
        supply.command(P)
        bench.faults["supply"] = "off"
        with pytest.raises(DeviceError, match="does not answer"):
            supply.command(np.zeros(3))
        np.testing.assert_allclose(bench.pressures, P)
        bench.faults["supply"] = "slow"
        began = time.monotonic()
        supply.read()
        assert time.monotonic() - began > 0.05
        bench.faults.clear()
        supply.command(np.zeros(3))
        assert not bench.pressures.any()


def test_peer_listens_where_it_may() -> None:
    with peer_for(tcp={"host": "192.168.1.10", "port": 502}) as (given, _):
        assert given.tcp is not None
        assert given.tcp.host == "127.0.0.1"
        assert given.tcp.port != 502
        with pytest.raises(DeviceError, match=f"port {given.tcp.port} of 127.0.0.1 is in use"):
            ModbusPeer(given, FakeBench()).start()
        with Raw(given.tcp.port) as raw:  # it still answers after that
            assert raw.ask("03 0800 0001") == "03020000"


def test_peer_leaves_nothing_behind() -> None:
    def state() -> tuple[int, int]:
        return threading.active_count(), len(os.listdir("/proc/self/fd"))

    for changes in ({}, {"tcp": None, "serial": {"port": "/dev/ttyUSB0"}}):
        with peer_for(**changes):  # what libraries open once stays open
            pass
        before = state()
        for _ in range(3):
            bench = FakeBench()
            peer = ModbusPeer(settings(**changes), bench)
            with peer.start().device(LIMITS) as supply:
                supply.arm()
                supply.command(P)
            peer.close()
            peer.close()
            with pytest.raises(DeviceError):
                supply.open()
        assert until(lambda before=before: state() <= before), (before, state())


def test_serial_line() -> None:
    serial = {"port": "/dev/ttyUSB0", "baudrate": 115200}
    lost = {"tcp": None, "serial": serial, "dump_valve": {"coil": 1}, "table": "holding"}
    with peer_for(**lost) as (given, bench):
        assert given.serial is not None
        assert given.serial.baudrate == 115200
        with given.device(LIMITS) as supply:
            supply.arm()
            for p in (P, P[::-1]):
                np.testing.assert_allclose(supply.exchange(p).pressures, p)
                np.testing.assert_allclose(bench.pressures, p)
            bench.faults["supply"] = "off"
            with pytest.raises(DeviceError, match=f"{given.serial.port} does not answer"):
                supply.read()
            bench.faults.clear()
            np.testing.assert_allclose(supply.read().pressures, P[::-1])
        assert not bench.pressures.any()
        assert bench.valve_open
