"""What the tests of Modbus share: settings, and a supply that is open on a handmade device."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from stiffopt.rig.drivers.modbus import ModbusSettings
from stiffopt.rig.interface import PressureLimits

LIMITS = PressureLimits(np.zeros(3), np.full(3, 1.5e5))


P = (1e5, 0.5e5, 1.2e5)


def settings(port: int = 0, **changes: Any) -> ModbusSettings:
    values: dict[str, Any] = {
        "driver": "modbus",
        "tcp": {"host": "127.0.0.1", "port": port},
        "timeout": 2.0,
        "scale": "1 mbar",
        "channels": [{"setpoint": 0x800 + i, "reading": 0x10 + i} for i in range(3)],
    }
    return ModbusSettings(**{**values, **changes})


def until(condition: Callable[[], bool], seconds: float = 5.0) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.005)
    return condition()


WATCHDOG = {
    "timeout": "400 ms",
    "address": 0x1000,
    "resolution": "100 ms",
    "before": [{"address": 0x1008, "value": 0x55AA}],
    "after": [{"address": 0x1001, "value": 0x8000}],
    "trigger": 0x1003,
}
