"""The pressure monitor: finds faults of the supply by comparing readings with commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array, Flags
from stiffopt.rig.interface import PressureLimits, PressureReading
from stiffopt.rig.settings import Safety
from stiffopt.safety.expected_pressure import ExpectedPressure, Regulation
from stiffopt.safety.settings import MONITOR
from stiffopt.safety.shortage import Shortage, SupplyLine


@dataclass(frozen=True)
class Trouble:
    """A fault that the monitor has found.

    `kind`: ``pressure-reading``, ``regulator-stuck`` or ``leak``. `text`: a sentence for people.
    """

    kind: str
    text: str


class PressureMonitor:
    """Compares the measured pressures of n channels with their commands.

    Three things are a fault at once: readings no longer arrive, a reading is far outside the
    limits, or a channel that was measured before reads NaN. A reading that is outside the range of
    a healthy regulator, see `ExpectedPressure`, by more than the tolerance
    `Safety.max_pressure_error` is a fault after `Safety.pressure_error_time`: a leak if it is
    below, a stuck regulator if it is above.

    A leak and a regulator whose supply has too little pressure both read below the command. The
    pressure that the channel has reached since it was armed distinguishes them: a regulator at the
    end of its supply still reaches it, a leak does not. So a channel that stays below its command
    by half the tolerance is saturated, which is an alarm; one that stays below what it has reached
    leaks. While its command is at rest, the loss of a tenth of the pressure counts as a leak, if
    that is more than half the tolerance. A channel that leaked from the beginning is saturated
    until its command changes; then its response shows the leak, see `Shortage`.

    Several channels that fall together, while none reads more, are on a sagging line and saturated,
    see `SupplyLine`. A single one that falls below what it has reached counts as leaking, though
    its line might sag too.

    Before the first command since arming, three readings above the tolerance show a stuck
    regulator.

    Parameters
    ----------
    limits : limits of the commands.
    safety : the tolerance, how long it may be exceeded, and the greatest age of a reading.
    regulation : slowest response of healthy regulators.
    slew : greatest rate of change of a pressure, one value or (n,), in Pa/s.

    Attributes
    ----------
    saturated : channels (n,) that stay below what they should have; a new array when it changes.
    unsupervised : channels, counted from 0, that have never been measured.
    """

    def __init__(
        self, limits: PressureLimits, safety: Safety, regulation: Regulation, slew: ArrayLike
    ) -> None:
        n = limits.n
        most = np.broadcast_to(np.asarray(safety.max_pressure_error, dtype=float), n)
        self.saturated: Flags = np.zeros(n, dtype=bool)
        self._expected = ExpectedPressure(regulation, np.broadcast_to(slew, n).astype(float))
        self._commanded: Array = np.zeros(n)
        self._time, self._oldest = safety.pressure_error_time, safety.command_timeout
        self._tolerance: Array = np.array(most)
        self._half: Array = 0.5 * most
        self._reached: Array = np.zeros(n)  # highest readings since arming
        self._shortage = Shortage(self._tolerance, safety.pressure_error_time)
        self._line = SupplyLine(self._half)
        self._still: Array = np.full(n, np.inf)  # time when each command came to rest
        self._near: Array = np.zeros(n)
        self._idle, self._rising = True, 0  # nothing commanded yet; readings above the tolerance
        self._most = np.stack(
            (most, most, 0.5 * most)
        )  # tolerances (3, n) of: leak, stuck, saturated
        self._least = np.stack((0.5 * most, most, 0.5 * most))  # smallest values of `_most`
        self._for: Array = np.zeros((3, n))  # time exceeded minus time not exceeded, in s
        self._doubtful = False  # whether any of these times is not 0
        self._excess: Array = np.zeros((3, n))
        span = limits.high - np.minimum(limits.low, 0.0)
        self._lowest: Array = np.minimum(limits.low, 0.0) - span - most
        self._highest: Array = limits.high + span + most
        self._measures: Flags = np.zeros(n, dtype=bool)
        self.unsupervised = tuple(range(n))

    def tell(self, time: float, commanded: Array) -> None:
        """Record the set-points (n,) of the supply, in Pa, and when they were written."""
        self._commanded = commanded
        self._expected.tell(time, commanded)
        moved = (np.abs(commanded - self._near) > MONITOR.still) | (time < self._still)
        if moved.any():
            self._still = np.where(moved, time, self._still)
            self._near = np.where(moved, commanded, self._near)
        self._idle = self._idle and not commanded.any()

    def clear(self) -> None:
        """Restart, as after arming."""
        self._for[:] = 0.0
        self._doubtful = False
        self._reached = np.zeros_like(self._reached)
        self._shortage.clear()
        self._line.clear()
        self._idle, self._rising = True, 0
        self.saturated = np.zeros_like(self.saturated)

    def update(self, now: float, reading: PressureReading) -> Trouble | None:
        """Judge a reading; return a fault, or None."""
        trouble = self.implausible(now, reading)
        if trouble is not None:
            return trouble
        elapsed = min(self._expected.follow(reading.time), self._time / MONITOR.looks)
        due, p = self._expected.lowest, reading.pressures
        if self._idle and elapsed > 0:
            self._rising = self._rising + 1 if (p > self._tolerance).any() else 0
            if self._rising >= MONITOR.idle_readings:
                return self._stuck(int(np.nanargmax(p - self._tolerance)), p)
        excess = self._excess
        self._reached = np.fmax(self._reached, p)
        np.subtract(np.minimum(due, self._reached), p, out=excess[0])
        np.subtract(p, self._expected.highest, out=excess[1])
        np.subtract(due, p, out=excess[2])
        suspect = bool((excess > self._least).any())  # False where nothing is measured (NaN)
        if not (suspect or self._doubtful or self._line.known):
            return None
        sagging = self._line.look(excess[2], p, self._reached)
        np.minimum(excess[0], self._line.pressure - p, out=excess[0])
        at_rest = reading.time - self._still > MONITOR.settled
        share = np.maximum(
            self._half, np.minimum(self._tolerance, MONITOR.leak_share * self._reached)
        )
        self._most[0] = np.where(at_rest, share, self._tolerance)
        wrong = excess > self._most
        if wrong.any():
            self._for += np.where(wrong, elapsed, -elapsed)
        elif self._doubtful:
            self._for -= elapsed
        else:
            return None
        np.clip(self._for, 0.0, self._time, out=self._for)
        self._doubtful = bool(self._for.any())
        lasting = self._for >= self._time * (1 - 1e-9)
        self.saturated = lasting[2] | (self.saturated & (self._for[2] > 0))
        short = self.saturated & ~sagging
        lasting[0] |= self._shortage.leaks(elapsed, short, due, p, at_rest)
        return self._found(lasting, p)

    def _found(self, lasting: Flags, p: Array) -> Trouble | None:
        """Return the fault of a channel whose reading (n,) was wrong for too long, or None."""
        for channel in np.flatnonzero(lasting[1]):
            return self._stuck(int(channel), p)
        for channel in np.flatnonzero(lasting[0]):
            return Trouble(
                "leak",
                f"channel {channel + 1} reads {_bar(p[channel])}, though "
                f"{_bar(self._commanded[channel])} was commanded: it leaks, its regulator has no "
                "more pressure, or its gauge is another channel's; it is vented with all others",
            )
        return None

    def _stuck(self, channel: int, p: Array) -> Trouble:
        return Trouble(
            "regulator-stuck",
            f"channel {channel + 1} reads {_bar(p[channel])}, though "
            f"{_bar(self._commanded[channel])} was commanded: its regulator is stuck; "
            "everything is vented",
        )

    def implausible(self, now: float, reading: PressureReading) -> Trouble | None:
        """Return the fault of a reading with an impossible age, shape or value, or None."""
        p = reading.pressures
        if not -self._oldest <= now - reading.time <= self._oldest:
            return Trouble(
                "pressure-reading", f"the pressure reading is {now - reading.time:.3g} s old"
            )
        if p.shape != self._tolerance.shape:
            return Trouble(
                "pressure-reading",
                f"{p.size} pressures are read; expected {self._tolerance.size}",
            )
        plausible = (p >= self._lowest) & (p <= self._highest)
        if plausible.all():
            if self.unsupervised:
                self._measured(plausible)
            return None
        missing = np.isnan(p)
        for channel in np.flatnonzero(~plausible & (~missing | self._measures)):
            said = "nothing" if missing[channel] else _bar(p[channel])
            return Trouble(
                "pressure-reading",
                f"channel {channel + 1} reads {said}, which cannot be; check its gauge and wires",
            )
        self._measured(plausible)
        return None

    def _measured(self, channels: Flags) -> None:
        self._measures |= channels
        self.unsupervised = tuple(int(c) for c in np.flatnonzero(~self._measures))

    def under_pressure(self, reading: PressureReading) -> str:
        """Report a channel of a vented supply that is not at 0; empty if all are at 0."""
        p = reading.pressures
        for channel in np.flatnonzero(np.abs(p) > self._tolerance):  # NaN is not
            return f"channel {channel + 1} reads {_bar(p[channel])}, though it is vented"
        return ""

    def believable(self, reading: PressureReading) -> PressureReading:
        """Return a reading with NaN for impossible values."""
        p = reading.pressures
        if p.shape != self._tolerance.shape:
            return PressureReading(reading.time, np.full_like(self._tolerance, np.nan))
        plausible = (p >= self._lowest) & (p <= self._highest)
        return PressureReading(reading.time, np.where(plausible, p, np.nan))


def _bar(pressure: float) -> str:
    return f"{pressure * 1e-5:.3g} bar"
