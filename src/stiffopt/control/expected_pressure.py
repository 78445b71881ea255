"""Where the pressures should be, by what was commanded and how regulators follow."""

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
    lag : time constant of each channel (n,), in s.
    dead_time : until a command has any effect, in s.
    """

    lag: Array
    dead_time: float

    @classmethod
    def slowest(cls, robot: RobotDescription, control: ControlSettings, n: int) -> Regulation:
        """Return the larger, for each of n channels, of what the rig and the robot file say.

        The lag of a calibrated robot file may be that of the arm behind its regulators, or of both.
        A channel that is expected later than it comes is not wrong, one that is expected too early
        would be. Where the robot has another number of channels the rig's numbers alone count.
        """
        lags, dead_time = [], control.regulator_dead_time
        for segment in robot.segments:
            history, slowest = segment.history, control.regulator_lag
            if history is not None:
                slowest = max(slowest, history.lag, history.lag_falling)
                dead_time = max(dead_time, history.dead_time)
            lags += [slowest] * segment.n_channels
        if len(lags) != n:
            return cls(np.full(n, control.regulator_lag), control.regulator_dead_time)
        return cls(np.array(lags), dead_time)


class ExpectedPressure:
    """Where a regulator that works as it should would be: dead time, lag, limited rate.

    Readings do not correct it, unlike the estimator's model: it is what they are held against.

    Parameters
    ----------
    regulation :
        How regulators follow.
    slew :
        Greatest rate of change (n,), in Pa/s.

    Attributes
    ----------
    pressures : ndarray
        Where they are now (n,), in Pa.
    """

    def __init__(self, regulation: Regulation, slew: Array) -> None:
        n = len(regulation.lag)
        self.pressures: Array = np.zeros(n)
        lag, at_once = regulation.lag, regulation.lag <= 0
        self._rate: Array = np.where(at_once, np.inf, 1 / np.where(at_once, 1.0, lag))
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
        acting = time - 0.5 * elapsed - self._dead_time  # midway, as if it were so all the while
        told = self._told
        while len(told) > 1 and told[1][0] <= acting:
            told.popleft()
        change = (told[0][1] - self.pressures) * -np.expm1(-elapsed * self._rate)
        reach = self._slew * elapsed
        self.pressures = self.pressures + np.minimum(np.maximum(change, -reach), reach)
        self._time = time
        return elapsed
