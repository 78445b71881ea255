"""Modbus in rig files: settings, mistakes, a missing library."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from fake_bench import FakeBench
from modbus_devices import LIMITS, settings, until
from stiffopt.errors import FileError, MissingExtraError
from stiffopt.files import read_file
from stiffopt.lab.modbus_peer import ModbusPeer
from stiffopt.rig.drivers.modbus import ModbusSettings
from stiffopt.schema import Schema

pytestmark = pytest.mark.real_time


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
        ("reading: 0}", "reading: 70000}", "[0].reading: must be at most 65535, not 70000"),
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
