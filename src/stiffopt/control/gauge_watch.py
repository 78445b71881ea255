"""Whether the gauges of the vented arm are alive: dead ones must not be trusted under pressure."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from stiffopt.rig.interface import PressureReading

Array = NDArray[np.float64]

_KEPT = 200  # readings
_ENOUGH = 30  # of them, before anything is said


class GaugeWatch:
    """Keeps the latest readings of a vented arm.

    A gauge that reads nothing is dead where the rig file says that there is one. One that reads the
    very same number all the time is dead if that is not 0, which converters that cannot say less
    read of a vented arm, or if it was commissioned and had noise then.
    """

    def __init__(self) -> None:
        self._readings: deque[Array] = deque(maxlen=_KEPT)
        self._time = -np.inf

    def learn(self, reading: PressureReading) -> None:
        """Take in a reading of the vented arm."""
        if reading.time > self._time:
            self._time = reading.time
            self._readings.append(reading.pressures)

    def forget(self) -> None:
        """Start over: the arm was under pressure."""
        self._readings.clear()

    def dead(self, measured: Sequence[bool], noisy: Sequence[bool]) -> Iterator[str]:
        """Yield what is wrong with the gauges.

        Parameters
        ----------
        measured : whether each channel has a gauge.
        noisy : whether that gauge had noise when it was commissioned.
        """
        if len(self._readings) < _ENOUGH:
            if any(measured):
                yield f"read {len(self._readings)} times, {_ENOUGH} are needed; wait a moment"
            return
        readings = np.array(self._readings)
        silent = np.isnan(readings).all(axis=0) & np.asarray(measured)
        if silent.any():
            yield (
                f"the gauges of channels {_names(silent)} read nothing; look at their cables and "
                "power. If there are none, the supply's settings in the rig file must say so"
            )
        same = (readings == readings[0]).all(axis=0) & np.asarray(measured)
        frozen = same & (np.asarray(noisy) | (readings[0] != 0))
        if frozen.any():
            yield (
                f"the gauges of channels {_names(frozen)} have read the very same number "
                f"{len(readings)} times: they are dead, or their input is frozen"
            )


def _names(channels: NDArray[np.bool_]) -> str:
    return ", ".join(str(k + 1) for k in np.flatnonzero(channels))
