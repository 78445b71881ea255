"""Pressures that healthy regulators can have, given their commands and how slowly they follow."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.description import RobotDescription
from stiffopt.rig.settings import ControlSettings

_MAX_COMMANDS = 1000  # commands kept, at most, while a dead time passes


@dataclass(frozen=True)
class Regulation:
    """The slowest response of healthy regulators: a dead time and a first-order lag.

    `lag`, `lag_falling`: time constants (n,) of rising and falling pressures, in s. `dead_time`:
    time until a command has any effect, in s.
    """

    lag: Array
    lag_falling: Array
    dead_time: float

    @classmethod
    def slowest(cls, robot: RobotDescription, control: ControlSettings, n: int) -> Regulation:
        """Return the slower of the rig file's and the robot file's lags, for each of n channels.

        The lag in a calibrated robot file may be that of the arm behind its regulators, or of both.
        Too slow a regulation delays the detection of a fault; too fast a one causes false faults.
        If the robot has another number of channels, only the rig file counts.
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
    """Bounds on the pressures of healthy regulators.

    Only their slowest response is known: dead time, lag, limited rate. Any regulator may be faster,
    even in one direction only. So the lower bound rises as slowly as possible and falls at once;
    the upper bound rises at once and falls as slowly as possible. Every regulator that is not
    slower stays between the two, whatever its commands. Readings are compared with the bounds and
    so must not correct them.

    Parameters
    ----------
    regulation : slowest response of the regulators.
    slew : rate of change (n,) that they reach at least, in Pa/s.

    Attributes
    ----------
    lowest, highest : the bounds (n,) at present, in Pa.
    """

    def __init__(self, regulation: Regulation, slew: Array) -> None:
        n = len(regulation.lag)
        self.lowest: Array = np.zeros(n)
        self.highest: Array = np.zeros(n)
        self._up, self._down = _rates(regulation.lag), _rates(regulation.lag_falling)
        self._dead_time = regulation.dead_time
        self._slew = slew
        self._commands: deque[tuple[float, Array]] = deque(
            [(-np.inf, np.zeros(n))], maxlen=_MAX_COMMANDS
        )
        self._time = -np.inf

    def tell(self, time: float, commanded: Array) -> None:
        """Record set-points (n,), in Pa, that apply from a time on, in s."""
        self._commands.append((time, commanded))

    def follow(self, time: float) -> float:
        """Advance the bounds to a time; return the time since the last call, both in s."""
        if np.isinf(self._time):
            self._time = time
        elapsed = time - self._time
        if not elapsed > 0:
            return 0.0
        commands, acting = self._commands, self._time - self._dead_time
        while len(commands) > 1 and commands[1][0] <= acting:
            commands.popleft()
        # any of these commands may have acted since then
        pressures = np.array([commanded for _, commanded in commands])
        least, most = np.minimum.reduce(pressures), np.maximum.reduce(pressures)
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
