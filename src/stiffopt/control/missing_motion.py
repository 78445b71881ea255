"""Finds a channel whose motion the tip lacks while the arm becomes stiff.

A chamber behind a kinked line keeps its pressure while its gauge shows more. In the slow change to
the stiffest pressures the tip's offset then grows as fast as the model moves the tip by this
channel, and against that motion. Errors of the model are a smaller share of it. A push has a
direction and a speed of its own, but one that grows for long with those of a channel looks the
same. If the loop went on to make up for what the tip lacks with that channel, its command would
rise on and on; at the next target the chamber would not follow it down, and the tip goes aside. So
such a channel goes back to where it was last seen to move the tip, as slowly as it has come, and
the others make up for it. A pressure that falls in vain is only told: nothing here raises one.

In a fast motion, on the way to a target, the offset shows too late for that; other tests judge it.
For each channel, the part of its motion that the tip lacks is added up, beyond half of it and half
of what the offset changes across it. Motion that the tip follows counts back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.noticing_tuning import MissingMotionTuning


@dataclass
class _WayBack:
    """The way back of a channel whose pressure has risen in vain."""

    highest: float  # pressure now, in Pa
    goal: float  # at the end of the way
    rate: float  # in Pa/s


class MissingMotion:
    """Adds up the motion that the tip lacks, of each channel.

    Parameters
    ----------
    tuning : how much of it is a fault.
    """

    def __init__(self, tuning: MissingMotionTuning) -> None:
        self._tuning = tuning
        self.begin()

    def begin(self) -> None:
        """Restart, as for another target."""
        # of each channel whose motion was found to be missing; None if its pressure was falling
        self._found: dict[int, _WayBack | None] = {}
        self._missing: Array = np.zeros(1)  # of each channel (n,), or of all, in m
        self._followed: Array = np.zeros(1)  # pressures (n,) with nothing missing yet, in Pa
        self.pause()

    @property
    def channels(self) -> tuple[int, ...]:
        """The channels whose motion was found to be missing, counted from 0; until `begin`."""
        return tuple(sorted(self._found))

    def pause(self) -> None:
        """Continue with the next sample: changes until then do not count."""
        self._last: tuple[float, Array, Array] | None = None  # time, offset and pressures

    def take(self, time: float, offset: Array, pressures: Array, jacobian: Array) -> None:
        """Take in a sample while the arm becomes stiff.

        Parameters
        ----------
        time : of capture, in s.
        offset : of the tip's position from the model's (3,), in m.
        pressures : effective ones (n,) at that time, in Pa.
        jacobian : of the tip's position (3, n), base axes, in m/Pa.
        """
        tuning = self._tuning
        if self._last is None or time - self._last[0] > tuning.longest_pause:
            self._last = time, offset.copy(), pressures.copy()
            return
        before, offset_before, pressures_before = self._last
        if time - before < tuning.interval:
            return
        self._last = time, offset.copy(), pressures.copy()
        change = offset - offset_before
        by_channels = jacobian * (pressures - pressures_before)  # (3, n)
        motions = np.sqrt((by_channels**2).sum(axis=0))
        if motions.max() > tuning.fastest * (time - before):
            self._missing = np.zeros(len(motions))  # the arm goes to its target
            return
        directions = by_channels / np.maximum(motions, 1e-12)
        along = -change @ directions
        across = np.sqrt(np.maximum(change @ change - along**2, 0.0))
        lacking = np.clip(along, -motions, motions) - tuning.across * across
        grown = np.maximum(lacking, -motions) - tuning.usual * motions
        self._followed = np.where(self._missing > 0, self._followed, pressures_before)
        self._missing = np.maximum(self._missing + grown, 0.0)
        for channel in map(int, np.flatnonzero(self._missing > tuning.most)):
            if channel not in self._found:
                highest, goal = float(pressures[channel]), float(self._followed[channel])
                rate = tuning.back_speed / float(np.linalg.norm(jacobian[:, channel]))
                way = _WayBack(highest, goal, rate) if highest > goal else None
                self._found[channel] = way

    def go_back(self, elapsed: float) -> None:
        """Let the channels that were found go back for a time, in s."""
        for way in self._found.values():
            if way is not None:
                way.highest = max(way.highest - way.rate * elapsed, way.goal)

    def limited(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Return the lowest and highest pressures (n,) that may be used, within others.

        A channel that was found while its pressure rose has at most that of its way back.
        """
        high = high.copy()
        for channel, way in self._found.items():
            if way is not None:
                high[channel] = max(min(high[channel], way.highest), low[channel])
        return low, high
