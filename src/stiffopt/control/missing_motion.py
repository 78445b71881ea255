"""Finds a channel whose motion the tip lacks while the arm becomes stiff.

A chamber behind a kinked line keeps its pressure while its gauge shows more. In the slow change to
the stiffest pressures the tip's offset then grows as fast as the model moves the tip by this
channel, and against that motion. Errors of the model are a smaller share of it. A push has a
direction and a speed of its own, but one that grows for long with those of a channel looks the
same. If the loop went on to make up for what the tip lacks with that channel, its command would
rise on and on; at the next target the chamber would not follow it down, and the tip goes aside. So
the channel goes back to where it was last seen to move the tip, as slowly as it has come, and the
others make up for it.

In a fast motion, on the way to a target, the offset shows too late for that; other tests judge it.
For each channel, the part of its motion that the tip lacks is added up, beyond half of it and half
of what the offset changes across it. Motion that the tip follows counts back.
"""

from __future__ import annotations

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.noticing_tuning import MissingMotionTuning


class MissingMotion:
    """Adds up the motion that the tip lacks, of each channel.

    Parameters
    ----------
    tuning : how much of it is a fault.

    Attributes
    ----------
    channel : the channel, counted from 0, whose motion was found to be missing; None: none. It
        stays until `begin`.
    """

    def __init__(self, tuning: MissingMotionTuning) -> None:
        self._tuning = tuning
        self.begin()

    def begin(self) -> None:
        """Restart, as for another target."""
        self.channel: int | None = None
        # of that channel: the pressure that it must not exceed, or must not fall below; where that
        # goes, in Pa; and how fast, in Pa/s
        self._bound = self._goal = self._rate = 0.0
        self._was_rising = True
        self._missing: Array = np.zeros(1)  # of each channel (n,), or of all, in m
        self._followed: Array = np.zeros(1)  # pressures (n,) with nothing missing yet, in Pa
        self.pause()

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
        most = int(np.argmax(self._missing))
        if self.channel is None and self._missing[most] > tuning.most:
            self.channel, self._bound = most, float(pressures[most])
            self._goal = float(self._followed[most])
            self._was_rising = self._bound > self._goal
            self._rate = tuning.back_speed / float(np.linalg.norm(jacobian[:, most]))

    def go_back(self, elapsed: float) -> None:
        """Let the channel that was found go back for a time, in s."""
        step = self._rate * elapsed
        self._bound += min(max(self._goal - self._bound, -step), step)

    def limited(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Return the lowest and highest pressures (n,) that plans may use, within others.

        The channel that was found goes no further than its bound.
        """
        if self.channel is None:
            return low, high
        bound = np.clip(self._bound, low, high)
        is_it = np.arange(len(low)) == self.channel
        if self._was_rising:
            return low, np.where(is_it, bound, high)
        return np.where(is_it, bound, low), high
