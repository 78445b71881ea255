"""What the gauges of a supply say about what became of the pressures."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import DeviceError
from stiffopt.rig.interface import PressureLimits

__all__ = ["AGREE", "Gauges"]

Array = NDArray[np.float64]

AGREE = 3
"""Readings in a row that are believed."""
_BEYOND = 5e4  # Pa, at least, by which a reading may be beyond the limits
_STEADY = 0.02e5  # Pa by which readings may differ while no chamber is being vented
_CALM = 0.5  # s for which a pressure may lag behind a command that lowers it


class Gauges:
    """Tells from the gauges whether a pressure has fallen that was not lowered.

    A reading is compared with earlier ones and not with the command, since a gauge may be wrong,
    and a single reading counts for nothing. Pressures here are magnitudes, along the sign of the
    set-point: a vacuum that is lost has fallen, too.

    Attributes
    ----------
    held : (n,), what the gauges have shown that the set-points hold, in Pa; -inf while unknown.
    """

    def __init__(self, n: int) -> None:
        self.held = np.full(n, -np.inf)
        self._lowered = np.full(n, -np.inf)  # when the set-points were
        self._readings: deque[Array] = deque([np.full(n, np.nan)] * AGREE, maxlen=AGREE)
        self._known: deque[Array] = deque([np.zeros(n)] * AGREE, maxlen=AGREE)  # NaN filled in

    def refuse_nonsense(self, limits: PressureLimits) -> None:
        """Give up when the latest readings all say what cannot be.

        Raises
        ------
        DeviceError
            It names a channel.
        """
        room = np.maximum(0.5 * (limits.high - limits.low), _BEYOND)
        low, high = np.minimum(limits.low, 0.0) - room, np.maximum(limits.high, 0.0) + room
        latest = np.array(self._known)
        for channel in np.flatnonzero(np.all((latest < low) | (latest > high), axis=0)):
            raise DeviceError(
                f"the supply reads {latest[-1, channel] * 1e-5:.3g} bar in channel {channel + 1}, "
                f"of which at most {limits.high[channel] * 1e-5:g} bar are ever commanded"
            )

    def look(self, measured: Array) -> None:
        """Take a reading (n,) from when nothing was commanded."""
        self._readings.append(measured)

    def note(self, time: float, before: Array, setpoint: Array, measured: Array) -> None:
        """Take a reading (n,) and between which set-points (n,) the command has just changed."""
        self._readings.append(measured)
        self._known.append(np.where(np.isfinite(measured), measured, self._known[-1]))
        drop = np.maximum(np.abs(before) - np.abs(setpoint), 0.0)
        self._lowered = np.where(drop > 0, time, self._lowered)
        same = np.sign(before) == np.sign(setpoint)
        self.held = np.where(same, self.held - drop, -np.inf)
        least = np.min(np.sign(setpoint) * np.array(self._readings), axis=0)
        least = np.minimum(least, np.abs(setpoint))  # the rest is lag, or an error of the gauge
        calm = time - self._lowered > _CALM
        self.held = np.where(calm & (least > self.held), least, self.held)

    def steady(self) -> bool:
        """Say whether the latest readings are the same, so that no chamber is being vented."""
        return not np.any(np.ptp(np.array(self._readings), axis=0) > _STEADY)

    def shown(self, setpoint: Array) -> Array:
        """Return the most (n,) that the latest readings show; NaN if one of them shows nothing."""
        most: Array = np.max(np.sign(setpoint) * np.array(self._readings), axis=0)
        return most

    def fallen(self, setpoint: Array, by: ArrayLike) -> NDArray[np.bool_]:
        """Say in which channels (n,) the latest readings agree that the pressure has fallen."""
        return self.shown(setpoint) < self.held - by
