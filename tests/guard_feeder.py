"""A control loop that only commands: run as a process of its own, to be killed, stopped, hung.

``python guard_feeder.py RIG`` presses all channels through a guard. It says ``feeding`` once the
pressure is commanded, and ``told: ...`` when the guard had vented, upon which it begins again.
SIGUSR1 lets it hang for half a second.
"""

from __future__ import annotations

import signal
import sys
import time

import numpy as np

from stiffopt.errors import DeviceError
from stiffopt.rig.config import load_rig
from stiffopt.rig.interface import PressureCommand
from stiffopt.safety.realtime import real_time
from stiffopt.safety.rigs import guarded_rig

PERIOD, RISE, PRESSURE = 0.01, 15, 0.4e5  # s, ticks, Pa


def main(path: str) -> None:
    rig, link = guarded_rig(*load_rig(path))
    signal.signal(signal.SIGUSR1, lambda *_: time.sleep(0.5))
    with rig, real_time():
        while True:
            link.arm()
            try:
                feed(link, rig.supply.n)
            except DeviceError as error:
                print(f"told: {error}", flush=True)


def feed(link: object, n: int) -> None:
    due, tick = time.monotonic(), 0
    while True:
        share = min(1.0, tick / RISE)
        command = PressureCommand(np.full(n, share * PRESSURE), time.monotonic(), 0.1)
        link.apply(command)  # type: ignore[attr-defined]
        tick, due = tick + 1, due + PERIOD
        if tick == 2 * RISE:
            print("feeding", flush=True)
        time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main(sys.argv[1])
