"""A supply whose driver is not ours: as docs/extending.md says, and not a line more careful."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.rig.interface import Clock, PressureLimits, PressureSupply, SupplySettings
from stiffopt.schema import Items, Schema
from stiffopt.units import Pressure

Array = NDArray[np.float64]


class BoxChannel(Schema):
    """One regulator."""

    port: int
    min: Pressure | None = None
    max: Pressure | None = None


class BoxSettings(SupplySettings):
    """A box with a regulator at each port."""

    driver: Literal["box"] = "box"
    channels: Items[BoxChannel]

    def _make(self, limits: PressureLimits, clock: Clock | None) -> BoxSupply:
        return BoxSupply(
            self, PressureLimits(np.full(limits.n, -1e6), np.full(limits.n, 1e6)), clock
        )


class BoxSupply(PressureSupply):
    """Forgets the limits that it is given."""

    has_watchdog = True

    def __init__(self, settings: BoxSettings, limits: PressureLimits, clock: Clock | None) -> None:
        super().__init__(limits, clock)
        self.settings = settings
        self.wire = np.zeros(limits.n)
        self.log: list[tuple[float, Array]] = []

    def _open(self) -> None: ...
    def _close(self) -> None: ...

    def _write(self, pressures: Array) -> None:
        self.wire = np.array(pressures)
        self.log.append((self.clock.now(), self.wire))

    def _read(self) -> ArrayLike:
        return self.wire
