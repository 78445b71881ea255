"""The Modbus driver against a handmade device: requests, refusals, broken lines, watchdog."""

from __future__ import annotations

import random
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from fake_supply import HandClock
from modbus_device import HandmadeDevice
from modbus_devices import LIMITS, WATCHDOG, P, settings, until
from stiffopt.errors import DeviceError, InputError
from stiffopt.rig.drivers.modbus import ModbusLine, ModbusSupply, ModbusTcp
from stiffopt.rig.interface import PressureLimits

pytestmark = pytest.mark.real_time


COUNTS = (1000, 500, 1200)  # at 1 mbar per count


@pytest.fixture
def device() -> Iterator[HandmadeDevice]:
    made = HandmadeDevice()
    yield made
    made.close()


@contextmanager
def opened(device: HandmadeDevice, **changes: Any) -> Iterator[ModbusSupply]:
    supply = settings(device.port, **changes).device(
        LIMITS, HandClock()
    )  # nobody looks whether others command
    with supply:
        supply.arm()
        device.requests.clear()
        yield supply


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
    with given.device(limits, HandClock()) as supply:
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
        InputError, match=r"channel 1: its register cannot represent any pressure from 0\.3004 to"
    ):
        made.device(PressureLimits(np.array([30040.0]), np.array([30060.0])))
    made.device(PressureLimits(np.array([0.0]), np.array([60.0])))
    made.device(PressureLimits(np.array([0.0]), np.array([0.0])))


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
        with pytest.raises(DeviceError, match="sent an unexpected answer: write channels 1, 2, 3"):
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
