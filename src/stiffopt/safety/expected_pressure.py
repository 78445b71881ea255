"""Where the pressures can be, by what was commanded and how regulators follow."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.description import RobotDescription
from stiffopt.rig.settings import ControlSettings

__all__ = ["ExpectedPressure", "Regulation"]

Array = NDArray[np.float64]

_TOLD = 1000  # commands that a dead time may hold back


@dataclass(frozen=True)
class Regulation:
    """How slowly regulators follow at most.

    Attributes
    ----------
    lag, lag_falling : time constants of each channel (n,) while its pressure rises and falls, in s.
    dead_time : until a command has any effect, in s.
    """

    lag: Array
    lag_falling: Array
    dead_time: float

    @classmethod
    def slowest(cls, robot: RobotDescription, control: ControlSettings, n: int) -> Regulation:
        """Return the larger, for each of n channels, of what the rig and the robot file say.

        The lag of a calibrated robot file may be that of the arm behind its regulators, or of both.
        A channel that is expected later than it comes is not wrong, one that is expected too early
        would be. Where the robot has another number of channels the rig's numbers alone count.
        """
        lag, dead_time = control.regulator_lag, control.regulator_dead_time
        if sum(segment.n_channels for segment in robot.segments) != n:
            return cls(np.full(n, lag), np.full(n, lag), dead_time)
        rising, falling = [], []
        for segment in robot.segments:
            up = down = lag
            if (history := segment.history) is not None:
                up = max(lag, history.lag)
                down = max(lag, history.lag_falling or history.lag)
                dead_time = max(dead_time, history.dead_time)
            rising += [up] * segment.n_channels
            falling += [down] * segment.n_channels
        return cls(np.array(rising), np.array(falling), dead_time)


class ExpectedPressure:
    """Between which pressures regulators are that work as they should.

    How slowly they follow at most is known: dead time, lag, limited rate. They may be faster, each
    one otherwise, and faster up than down. So the lowest pressure rises as slowly as may be and
    falls at once, and the highest rises at once and falls slowly. Every regulator that is no slower
    is between the two, whatever it is told.

    Readings do not correct them, unlike the estimator's model: they are what readings are held
    against.

    Parameters
    ----------
    regulation :
        How slowly regulators follow.
    slew :
        Rate of change (n,) that they can do at least, in Pa/s.

    Attributes
    ----------
    lowest, highest : ndarray
        Between which they are now (n,), in Pa.
    """

    def __init__(self, regulation: Regulation, slew: Array) -> None:
        n = len(regulation.lag)
        self.lowest: Array = np.zeros(n)
        self.highest: Array = np.zeros(n)
        self._up, self._down = _rates(regulation.lag), _rates(regulation.lag_falling)
        self._dead_time = regulation.dead_time
        self._slew = slew
        self._told: deque[tuple[float, Array]] = deque([(-np.inf, np.zeros(n))], maxlen=_TOLD)
        self._time = -np.inf

    def tell(self, time: float, commanded: Array) -> None:
        """Take in that something else is commanded (n,) from a moment on."""
        self._told.append((time, commanded))

    def follow(self, time: float) -> float:
        """Go on to a moment, and return by how much that is later than the last one, in s."""
        if np.isinf(self._time):
            self._time = time
        elapsed = time - self._time
        if not elapsed > 0:
            return 0.0
        told, acting = self._told, self._time - self._dead_time
        while len(told) > 1 and told[1][0] <= acting:
            told.popleft()
        # any of these may have acted meanwhile
        commands = np.array([commanded for _, commanded in told])
        least, most = np.minimum.reduce(commands), np.maximum.reduce(commands)
        reach = self._slew * elapsed
        rise = np.minimum((least - self.lowest) * -np.expm1(-elapsed * self._up), reach)
        self.lowest = np.minimum(self.lowest + rise, least)
        fall = np.minimum((self.highest - most) * -np.expm1(-elapsed * self._down), reach)
        self.highest = np.maximum(self.highest - fall, most)
        self._time = time
        return elapsed


def _rates(lag: Array) -> Array:
    at_once = lag <= 0
    return np.where(at_once, np.inf, 1 / np.where(at_once, 1.0, lag))
