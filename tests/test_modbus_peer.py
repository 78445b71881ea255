"""The simulated Modbus device, by its registers and by the driver."""

from __future__ import annotations

import os
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from fake_bench import FakeBench
from modbus_devices import LIMITS, WATCHDOG, P, settings, until
from stiffopt.errors import DeviceError
from stiffopt.lab.modbus_peer import ModbusPeer
from stiffopt.rig.drivers.modbus import ModbusSettings

pytestmark = pytest.mark.real_time


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
