"""The contract of pressure supplies, over all of them.

A case is a context manager that yields a `Case`; its function is listed in `CASES`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress

import numpy as np
import pytest

from fake_bench import FakeBench

pytestmark = pytest.mark.real_time

pytest.register_assert_rewrite("supply_contract")

from stiffopt.rig.interface import PressureLimits  # noqa: E402
from stiffopt.rig.registry import driver_names  # noqa: E402
from supply_contract import Case, SupplyContract  # noqa: E402

LIMITS = PressureLimits(np.zeros(3), np.array([1.5e5, 1.2e5, 0.9e5]))


@contextmanager
def modbus(table: str = "input", valve: bool = False) -> Iterator[Case]:
    from stiffopt.lab.modbus_peer import ModbusPeer
    from stiffopt.rig.drivers.modbus import ModbusSettings

    settings = ModbusSettings(
        driver="modbus",
        tcp={"host": "127.0.0.1", "port": 0},
        timeout=2.0,
        scale={"counts": [0, 32767], "pressure": ["0 bar", "10 bar"]},
        channels=[{"setpoint": 2048 + i, "reading": i} for i in range(3)],
        table=table,
        dump_valve={"coil": 5} if valve else None,
    )
    bench = FakeBench()
    peer = ModbusPeer(settings, bench)
    try:
        supply = peer.start().device(LIMITS)
        yield Case(
            supply,
            wire=lambda: bench.pressures,
            tolerance=1e6 / 32767,
            disturb=lambda: bench.command(1, 5e4),
            valve_open=(lambda: bench.valve_open) if valve else None,
        )
    finally:
        peer.close()


@contextmanager
def nidaq() -> Iterator[Case]:
    from stiffopt.lab.nidaq_peer import NidaqPeer
    from stiffopt.rig.drivers.nidaq import NidaqSettings

    settings = NidaqSettings(
        driver="nidaq",
        timeout=5.0,
        channels=[
            {
                "output": {
                    "channel": f"Dev2/ao{i}",
                    "pressures": ["0 bar", "3 bar"],
                    "read_back": f"Dev2/_ao{i}_vs_aognd",
                },
                "input": {"channel": f"Dev1/ai{i}", "pressures": ["0 bar", "4 bar"]},
            }
            for i in range(3)
        ],
        dump_valve={"line": "Dev1/port0/line0"},
        watchdog=5.0,
    )
    bench = FakeBench()
    peer = NidaqPeer(settings, bench)
    try:
        supply = peer.start().device(LIMITS)
        yield Case(
            supply,
            wire=lambda: np.round(bench.pressures, 6),  # volts are not pressures to the last bit
            disturb=lambda: bench.command(1, 5e4),
            valve_open=lambda: bench.valve_open,
        )
    finally:
        peer.close()


@contextmanager
def open_regulator() -> Iterator[Case]:
    from board_host import SET, Host, command, need_firmware
    from stiffopt.lab.open_regulator_peer import OpenRegulatorPeer
    from stiffopt.rig.drivers.open_regulator import OpenRegulatorSettings

    need_firmware()
    settings = OpenRegulatorSettings(
        port="any", timeout=2.0, channels=[{"output": output} for output in (3, 1, 2)]
    )
    # a board that waits for 10 s: these tests are about something else, and may be slow
    peer = OpenRegulatorPeer(settings, FakeBench(), SILENCE_MS=10_000)
    addressed = peer.start()
    host = Host(addressed.port)

    def disturb() -> None:
        for _ in range(5):  # until the board has started: what comes before may be lost
            with suppress(AssertionError):
                host.report()
                break
        set_points = command(host.report(3), 5000, 0, 0, validity=10_000)
        assert host.report(SET, set_points).armed

    def valve_open() -> bool:
        time.sleep(0.05)  # it is told 200 times a second
        return peer.dump_open

    try:
        yield Case(
            addressed.device(LIMITS),
            wire=lambda: np.array(host.report().set_points)[[2, 0, 1]] * 10.0,
            tolerance=10.0,
            disturb=disturb,
            valve_open=valve_open,
        )
    finally:
        host.close()
        peer.close()


@contextmanager
def simulated(valve: bool = False) -> Iterator[Case]:
    from stiffopt.model.robot_files import load_description
    from stiffopt.plant.devices import simulated_rig
    from stiffopt.rig.config import RigDescription

    description = RigDescription(
        robot="stiff-flop-1",
        supply={"driver": "simulated", "resolution": 0.0, "dump_valve": valve},
        plant={"dynamics": "quasi-static"},
    )
    rig = simulated_rig(description, load_description("stiff-flop-1"), LIMITS)
    yield Case(
        rig.supply,
        wire=lambda: rig.world.set_point,
        disturb=lambda: rig.world.command_channel(1, 5e4),
        valve_open=(lambda: rig.world.valve_open) if valve else None,
    )


@contextmanager
def line() -> Iterator[Case]:
    import third_party
    from stiffopt.rig.registry import driver_class, load

    third_party.install()
    settings = driver_class("supply", "line")(timeout=2.0, watchdog=None, channels=[{}] * 3)
    bench = FakeBench()
    peer = load(settings.peer)(settings, bench)
    try:
        yield Case(
            peer.start().device(LIMITS),
            wire=lambda: bench.pressures,
            tolerance=1.0,
            disturb=lambda: bench.command(1, 5e4),
        )
    finally:
        peer.close()


CASES: dict[str, Callable[[], AbstractContextManager[Case]]] = {
    "modbus": modbus,
    "modbus-at-once": lambda: modbus(table="holding", valve=True),
    "nidaq": nidaq,
    "open-regulator": open_regulator,
    "simulated": simulated,
    "simulated-with-valve": lambda: simulated(valve=True),
    "line": line,
}
"""The cases, each by the name of its driver and what is special about it."""


def test_every_supply_is_held_to_the_contract() -> None:
    for driver in driver_names("supply"):
        assert any(name.startswith(driver) for name in CASES), driver


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> Iterator[Case]:
    with CASES[request.param]() as made:
        made.name = request.param
        yield made


class TestSupply(SupplyContract):
    pass
