"""Whether what the supply reads can be, and is what it should be after what it was told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.rig.interface import PressureLimits, PressureReading
from stiffopt.rig.settings import Safety
from stiffopt.safety.expected_pressure import ExpectedPressure, Regulation
from stiffopt.safety.shortage import Shortage
from stiffopt.safety.supply_line import SupplyLine

__all__ = ["PressureMonitor", "Trouble"]

Array = NDArray[np.float64]

_LOOKS = 3  # readings, at least, that it takes to find a regulator wrong, however long a pause


@dataclass(frozen=True)
class Trouble:
    """Something that is a fault.

    Attributes
    ----------
    kind : a word for programs.
    text : a sentence for people.
    """

    kind: str
    text: str


_STILL = 5e3  # Pa; a command that changes by less than this is at rest
_SETTLED = 0.5  # s after which a channel at rest has its pressure
_LEAK = 0.1  # of a pressure that was reached; less than that much less is no leak
_AT_ONCE = 3  # readings


class PressureMonitor:
    """Holds the readings of n channels against what was commanded.

    A reading that is not finite in a channel that was measured before, or that no gauge of this
    supply can show, is a fault at once, and so are readings that do not come any more. A reading
    that is where no good regulator would be by now, see `ExpectedPressure`, by more than
    `Safety.max_pressure_error`, for `Safety.pressure_error_time`, is a fault: a leak if it is
    below, a regulator stuck if above.

    A leak and a regulator whose supply runs out of pressure both stay below the command. What
    tells them apart is what the channel has reached since it was armed: a regulator that has no
    more pressure still reaches that, and a leak takes it away. So below what was commanded, by
    half of that error, a channel counts as saturated, which is an alarm; below what it is known to
    reach, it leaks. Where its command is at rest, a tenth of the pressure is enough for that, if it
    is more than half of that error. A channel that leaked from the beginning is saturated until its
    command changes: what it gives then tells, see `Shortage`.

    Several channels that fall together, of which none reads more, are at the end of a line that
    sags, and saturated, see `SupplyLine`. One alone that falls below what it has reached may be
    that too, but nobody can tell: it counts as leaking.

    While nothing has been commanded since arming, three readings above that error are enough for a
    regulator that is stuck.

    Parameters
    ----------
    limits :
        Of the commands.
    safety :
        What is too much.
    regulation :
        How regulators follow.
    slew :
        Greatest rate of change of a pressure, one value or (n,), in Pa/s.

    Attributes
    ----------
    saturated : ndarray
        Channels (n,) that stay below what they should be; another array when it changes.
    unsupervised : tuple of int
        Channels, counted from 0, that have never been measured.
    """

    def __init__(
        self, limits: PressureLimits, safety: Safety, regulation: Regulation, slew: ArrayLike
    ) -> None:
        n = limits.n
        most = np.broadcast_to(np.asarray(safety.max_pressure_error, dtype=float), n)
        self.saturated: NDArray[np.bool_] = np.zeros(n, dtype=bool)
        self._expected = ExpectedPressure(regulation, np.broadcast_to(slew, n).astype(float))
        self._commanded: Array = np.zeros(n)
        self._time, self._oldest = safety.pressure_error_time, safety.command_timeout
        self._tolerance: Array = np.array(most)
        self._half: Array = 0.5 * most
        self._reached: Array = np.zeros(n)  # the highest readings since it was armed
        self._shortage = Shortage(self._tolerance, safety.pressure_error_time)
        self._line = SupplyLine(self._half)
        self._still: Array = np.full(n, np.inf)  # since when each command is near what it was
        self._near: Array = np.zeros(n)
        self._idle, self._rising = True, 0  # nothing commanded yet; readings that rise all the same
        self._most = np.stack((most, most, 0.5 * most))  # (3, n): leaks, stuck, saturated
        self._least = np.stack((0.5 * most, most, 0.5 * most))  # that this can be
        self._for: Array = np.zeros((3, n))  # s, for how long it was so, less how long it was not
        self._doubtful = False  # whether any of that is not 0
        self._beside: Array = np.zeros((3, n))
        span = limits.high - np.minimum(limits.low, 0.0)
        self._lowest: Array = np.minimum(limits.low, 0.0) - span - most
        self._highest: Array = limits.high + span + most
        self._measures: NDArray[np.bool_] = np.zeros(n, dtype=bool)
        self.unsupervised = tuple(range(n))

    def tell(self, time: float, commanded: Array) -> None:
        """Take in what the supply is told (n,), in Pa, and when."""
        self._commanded = commanded
        self._expected.tell(time, commanded)
        moved = (np.abs(commanded - self._near) > _STILL) | (time < self._still)
        if moved.any():
            self._still = np.where(moved, time, self._still)
            self._near = np.where(moved, commanded, self._near)
        self._idle = self._idle and not commanded.any()

    def clear(self) -> None:
        """Forget for how long anything was wrong."""
        self._for[:] = 0.0
        self._doubtful = False
        self._reached = np.zeros_like(self._reached)
        self._shortage.clear()
        self._line.clear()
        self._idle, self._rising = True, 0
        self.saturated = np.zeros_like(self.saturated)

    def update(self, now: float, reading: PressureReading) -> Trouble | None:
        """Judge a reading; return what is wrong."""
        trouble = self.implausible(now, reading)
        if trouble is not None:
            return trouble
        elapsed = min(self._expected.follow(reading.time), self._time / _LOOKS)
        due, p = self._expected.lowest, reading.pressures
        if self._idle and elapsed > 0:
            self._rising = self._rising + 1 if (p > self._tolerance).any() else 0
            if self._rising >= _AT_ONCE:
                return self._stuck(int(np.nanargmax(p - self._tolerance)), p)
        beside = self._beside
        self._reached = np.fmax(self._reached, p)
        np.subtract(np.minimum(due, self._reached), p, out=beside[0])
        np.subtract(p, self._expected.highest, out=beside[1])
        np.subtract(due, p, out=beside[2])
        suspect = bool((beside > self._least).any())  # NaN, where nothing is measured, is not
        if not (suspect or self._doubtful or self._line.known):
            return None
        sagging = self._line.look(beside[2], p, self._reached)
        np.minimum(beside[0], self._line.pressure - p, out=beside[0])
        at_rest = reading.time - self._still > _SETTLED
        share = np.maximum(self._half, np.minimum(self._tolerance, _LEAK * self._reached))
        self._most[0] = np.where(at_rest, share, self._tolerance)
        wrong = beside > self._most
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

    def _found(self, lasting: NDArray[np.bool_], p: Array) -> Trouble | None:
        """Return the trouble where a reading (n,) was wrong for long enough."""
        for channel in np.flatnonzero(lasting[1]):
            return self._stuck(int(channel), p)
        for channel in np.flatnonzero(lasting[0]):
            return Trouble(
                "leak",
                f"channel {channel + 1} reads {_bar(p[channel])}, though "
                f"{_bar(self._commanded[channel])} was commanded: it leaks, or its regulator has "
                "no more pressure; it is vented with all others",
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
        """Return why a reading cannot be, if it cannot."""
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

    def _measured(self, channels: NDArray[np.bool_]) -> None:
        self._measures |= channels
        self.unsupervised = tuple(int(c) for c in np.flatnonzero(~self._measures))

    def under_pressure(self, reading: PressureReading) -> str:
        """Say which channel is not at 0, of a supply that is vented; empty if none is."""
        p = reading.pressures
        for channel in np.flatnonzero(np.abs(p) > self._tolerance):  # NaN is not
            return f"channel {channel + 1} reads {_bar(p[channel])}, though it is vented"
        return ""

    def believable(self, reading: PressureReading) -> PressureReading:
        """Return a reading with NaN for what cannot be."""
        p = reading.pressures
        if p.shape != self._tolerance.shape:
            return PressureReading(reading.time, np.full_like(self._tolerance, np.nan))
        plausible = (p >= self._lowest) & (p <= self._highest)
        return PressureReading(reading.time, np.where(plausible, p, np.nan))


def _bar(pressure: float) -> str:
    return f"{pressure * 1e-5:.3g} bar"
