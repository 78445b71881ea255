"""Holding the pressures: the reasons, since when, which pressures, and how they are let down."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from stiffopt.arrays import Array
from stiffopt.control.noticing_tuning import SupervisionTuning


@dataclass(frozen=True)
class HoldReason:
    """The reason for holding the pressures; only a request ends a `lasting` hold.

    `undo` is the share of the latest motion to undo.
    """

    reason: str
    lasting: bool = False
    undo: float = 0.0


class Holds:
    """The reasons for holding the pressures, by kind, and the time that they have lasted."""

    def __init__(self, tuning: SupervisionTuning) -> None:
        self._tuning = tuning
        self.forget()

    def forget(self) -> None:
        """Begin without a reason, as if there had never been one."""
        self._doubted_at = -np.inf
        # begin and end of the last series of holds that no client asked for, in s
        self._since = self._until = -np.inf
        self.clear()

    def clear(self) -> None:
        """Remove all reasons."""
        self._reasons: dict[str, HoldReason] = {}

    @property
    def reason(self) -> str | None:
        """The oldest reason; None without one."""
        return next((hold.reason for hold in self._reasons.values()), None)

    @property
    def doubt(self) -> HoldReason | None:
        """The hold of a doubted motion, if there is one."""
        return self._reasons.get("doubt")

    def add(self, now: float, kind: str, hold: HoldReason) -> bool:
        """Add a reason, or replace the one of its kind; return whether the kind is new."""
        is_new = kind not in self._reasons
        if not hold.lasting and now - self._until > self._tuning.hold_memory:
            self._since = now
        self._reasons[kind] = hold
        return is_new

    def remove(self, *kinds: str) -> bool:
        """Remove the reasons of these kinds; return whether there was one."""
        removed = [self._reasons.pop(kind, None) for kind in kinds]
        return any(hold is not None for hold in removed)

    def doubted(self, now: float) -> bool:
        """Note that the motion is doubted; return whether it was doubted lately before."""
        is_again = now - self._doubted_at < self._tuning.doubt_memory
        self._doubted_at = now
        return is_again

    def may_stop(self, now: float) -> bool:
        """Return whether a doubted motion is still to be brought to rest."""
        return self.doubt is not None and now - self._doubted_at <= self._tuning.longest_stop

    def exceeded(self, now: float, limit: float | None) -> str | None:
        """Return why the pressures have been held for `limit` seconds or longer, in each tick.

        It is None before, and if a client asked for the hold.
        """
        own = [hold for hold in self._reasons.values() if not hold.lasting]
        if not own:
            return None
        self._until = now
        return own[0].reason if limit is not None and now - self._since >= limit else None


class RecentCommands:
    """The commands (n,) over the time by which the chambers may lag behind them, in Pa."""

    def __init__(self, n: int, period: float, tuning: SupervisionTuning) -> None:
        self._falls = tuning.falls
        count = max(2, int(np.ceil(tuning.chamber_lag / period)))
        self._commands: deque[Array] = deque([np.zeros(n)], maxlen=count)

    def add(self, pressures: Array) -> None:
        """Note the set-points (n,) of the supply."""
        self._commands.append(pressures)

    def forget(self) -> None:
        """Keep the last command only."""
        self._commands = deque([self._commands[-1]], maxlen=self._commands.maxlen)

    def range(self) -> tuple[Array, Array]:
        """Return the lowest and the highest command (n,) of each channel."""
        return np.min(self._commands, axis=0), np.max(self._commands, axis=0)

    def stopping(self, measured: Array, requested: Array, undo: float) -> Array:
        """Return pressures (n,) that stop the arm, in Pa.

        Chambers lag behind commands, so these are the `measured` pressures (n,), NaN where there is
        no gauge. Whatever the gauges read, none is above or below all recent commands. `requested`
        (n,) is the last command before limits. A share `undo` of the recent motion is undone: the
        arm goes back towards the first of the recent commands.
        """
        last = np.minimum(requested, self._commands[-1])
        measured = np.clip(measured, *self.range())
        falls = measured - last > self._falls  # False for NaN: not measured
        held: Array = np.where(falls, measured, np.fmin(measured, last))
        return held + undo * (self._commands[0] - held)


@dataclass(frozen=True)
class Ramp:
    """Lets pressures (n,) down from the time `begin` on, within a duration in s.

    `stages` (k, n) are the shares of the pressures left at equal intervals, from 1 to 0.
    """

    begin: float
    duration: float
    pressures: Array
    reason: str
    stages: Array

    def progress(self, now: float) -> float:
        """Return the progress of the ramp at a time, from 0 to 1.

        It is 0 before `begin`: a request during a tick begins a ramp later than that tick's `now`.
        """
        return min(max((now - self.begin) / self.duration, 0.0), 1.0)

    def share(self, now: float) -> Array:
        """Return the shares (n,) of the pressures that are left at a time."""
        last = len(self.stages) - 1
        place = self.progress(now) * last
        before = min(int(place), last - 1)
        after = place - before
        return (1 - after) * self.stages[before] + after * self.stages[before + 1]
