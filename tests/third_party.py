"""A supply whose driver is not ours: the example package `examples/line-driver`, installed.

`careless` gives settings whose driver forgets the limits that it is given.
"""

from __future__ import annotations

import atexit
import importlib
import os
import shutil
import sys
import tempfile
import zipfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from hatchling.builders.wheel import WheelBuilder

from stiffopt.rig.interface import Clock, PressureLimits

EXAMPLE = Path(__file__).parent.parent / "examples" / "line-driver"


def install() -> None:
    """Install the example for this process and all that it starts, where that is not done yet."""
    if find_spec("line_driver") is not None:
        return
    folder = tempfile.mkdtemp(prefix="line-driver-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    install_into(Path(folder))
    sys.path.append(folder)
    importlib.invalidate_caches()
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [before, folder]))


def install_into(folder: Path) -> None:
    """Build the wheel of the example and unpack it, as `pip install --target` does."""
    (wheel,) = WheelBuilder(str(EXAMPLE)).build(directory=str(folder), versions=["standard"])
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(folder)
    Path(wheel).unlink()


def careless(**settings: Any) -> Any:
    """Return settings of the example whose supply is made with far too wide limits."""
    install()
    from line_driver import LineSettings, LineSupply

    class CarelessSettings(LineSettings):
        def _make(self, limits: PressureLimits, clock: Clock | None) -> LineSupply:
            wide = PressureLimits(np.full(limits.n, -1e6), np.full(limits.n, 1e6))
            return LineSupply(self, wide, clock)

    return CarelessSettings(**settings)
