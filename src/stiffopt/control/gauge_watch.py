"""Checks on the vented arm that its gauges are alive: dead ones are unsafe under pressure."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.rig.interface import PressureReading

_WINDOW = 200  # readings
_ENOUGH = 30  # readings, before the gauges are judged


class GaugeWatch:
    """Keeps the latest readings of a vented arm, and finds dead gauges in them.

    A gauge that the rig file declares is dead if it reads nothing. One that always reads exactly
    the same number is dead if that number is not 0, or if the gauge had noise when it was
    commissioned. A constant 0 alone is no proof: some converters read 0 at a vented arm.
    """

    def __init__(self) -> None:
        self._readings: deque[Array] = deque(maxlen=_WINDOW)
        self._time = -np.inf

    def learn(self, reading: PressureReading) -> None:
        """Take in a reading of the vented arm."""
        if reading.time > self._time:
            self._time = reading.time
            self._readings.append(reading.pressures)

    def forget(self) -> None:
        """Discard all readings: the arm was under pressure."""
        self._readings.clear()

    def dead(self, measured: Sequence[bool], noisy: Sequence[bool]) -> Iterator[str]:
        """Yield the problems of the gauges.

        `measured`: whether each channel has a gauge. `noisy`: whether that gauge had noise when it
        was commissioned.
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


def _names(channels: Flags) -> str:
    return ", ".join(str(k + 1) for k in np.flatnonzero(channels))
