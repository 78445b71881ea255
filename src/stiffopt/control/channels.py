"""Channels that do not follow their commands: shortfalls, and limited, stuck or removed channels.

A channel that stays below its command by s has a leak, which its regulator may be able to feed, or
no more pressure. Its command is raised by s, slowly, up to `_max_allowed`, a share of the pressure
monitor's tolerance. If the channel is still short by more, it is *limited*: its present pressure
becomes the plan's upper bound, and the command stays just above it, where more pressure shows as
soon as there is some. If a limited channel does not follow its command down either, it is *stuck*:
the plan takes its pressure as fixed, and the command stays just below it. A reading that does not
move at all, although even a slow regulator would have moved it, shows both at once. A channel that
moves against its command is *opposed*: the pressures are held, as feedback would drive it on.
Until that is decided, the reference waits: it is slowed down by as much as a channel stays behind
what even a slow regulator would have reached. The others then do not run ahead of it, and the tip
stays near its way. Differences that last become usual, so the reference never waits for ever.
Faults of the pressure monitor remain faults: none of these commands exceeds the limits, nor differs
from the reading by more than the monitor tolerates.

A shortfall or an excess that grows while the command rests is reported long before it matters: the
gain and the offset of a healthy regulator or gauge do not change within seconds.

A channel that was *taken out* by request is let down and stays without pressure.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import casadi as ca
import numpy as np

from stiffopt.arrays import Array, Flags
from stiffopt.control.formula import Formula
from stiffopt.control.interface import Notice
from stiffopt.control.state import Severity
from stiffopt.control.tuning import RegulatorTuning
from stiffopt.errors import InputError
from stiffopt.rig.interface import PressureLimits


class Channels:
    """Finds channels that do not follow their commands, and their available pressures.

    Parameters
    ----------
    limits : limits of the commands.
    slew : greatest rate of change (n,), in Pa/s.
    tolerance : tolerance of the pressure monitor (n,), in Pa.
    tuning : tuning of the regulators.

    Attributes
    ----------
    limited, stuck, opposed, out : flags (n,) of channels that have no more pressure, that keep
        their pressure, that move against their command, and that were taken out by request.
    shortfall : commands minus settled pressures (n,), in Pa.
    pace : share of its speed that the reference may keep, for channels that stay behind.
    """

    def __init__(
        self, limits: PressureLimits, slew: Array, tolerance: Array, tuning: RegulatorTuning
    ) -> None:
        self._limits, self._tuning = limits, tuning
        self._min_allowed = np.full(limits.n, tuning.max_compensation)
        self._max_allowed = np.maximum(self._min_allowed, tuning.make_up_share * tolerance)
        self._alarm_above = tuning.alarm_share * self._max_allowed
        self._probe = tuning.probe_share * tolerance
        self._let_down = tuning.let_down_share * slew
        self._empty = np.clip(0.0, limits.low, limits.high)
        self.out: Flags = np.zeros(limits.n, dtype=bool)
        self._any_out = False
        self._none: Flags = np.zeros(limits.n, dtype=bool)
        self._look = _look(limits.n, tuning)
        self.begin()

    def begin(self) -> None:
        """Restart with a vented arm; channels that were taken out stay out."""
        n = self._limits.n
        self.limited: Flags = np.zeros(n, dtype=bool)
        self.stuck: Flags = np.zeros(n, dtype=bool)
        self.opposed: Flags = np.zeros(n, dtype=bool)
        self.shortfall: Array = np.zeros(n)
        self._allowed: Array = self._min_allowed.copy()  # shortfall to compensate, in Pa
        self._held: Array = np.zeros(n)  # pressure of a limited or stuck channel, in Pa
        self._found: Array = np.zeros(n)  # the same when it was found, in Pa
        # durations of being short by more than is made up for, too high, and short enough for an
        # alarm, in s
        self._durations: Array = np.zeros((3, n))
        self._fed: Flags = np.zeros(n, dtype=bool)  # whether there is that alarm
        # last readings that followed, NaN once they have moved; these without the regulators'
        # offset; and these, in Pa (3, n)
        self._followed: Array = np.zeros((3, n))
        self._smoothed: Array = np.zeros(n)  # smoothed readings, in Pa
        self._made_up: Array = np.zeros(n)  # see `compensated`, if no channel is short, in Pa
        self._ceiling: Array = np.where(self.out, self._empty, self._limits.high)
        self._rest = _Rest(n, self._tuning)
        self.pace = 1.0
        self._slow_for: Array = np.zeros(n)  # remaining time for which channels count as slow, in s
        self._usual: Array = np.zeros(n)  # lasting differences from the healthy pressures, in Pa
        self._quiet = True  # whether no channel is short, or was until now

    def take_out(self, channels: Iterable[int]) -> None:
        """Take exactly these channels, counted from 0, out of use."""
        chosen, n = set(channels), self._limits.n
        if wrong := sorted(c for c in chosen if not 0 <= c < n):
            raise InputError(f"there is no channel {wrong[0] + 1}; this arm has {n}")
        if len(chosen) == n:
            raise InputError("all channels cannot be taken out; disarm or vent instead")
        out = np.isin(np.arange(n), sorted(chosen))
        now = np.clip(self._smoothed, self._empty, self._limits.high)
        falling = np.where(self.out, self._ceiling, now)
        self._ceiling = np.where(out, falling, self._limits.high)
        self.out, self._any_out = out, bool(out.any())

    @property
    def lost(self) -> Flags:
        """Channels (n,) that the plan does without, or uses below their usual limit."""
        if self._quiet and not self._any_out:
            return self._none
        return self.limited | self.stuck | self.out

    @property
    def last_followed(self) -> Array:
        """Readings (n,) with which channels last followed their commands, in Pa."""
        return self._followed[2]

    def update(
        self, elapsed: float, command: Array, reading: Array, offset: Array, healthy: Array
    ) -> None:
        """Take in the latest commands and readings.

        Parameters
        ----------
        elapsed : time since the last call, in s.
        command, reading : commands and readings (n,), in Pa; NaN: not measured.
        offset : settled pressures relative to commands (n,), in Pa.
        healthy : least and greatest pressures (2, n) that regulators without a fault have now, in
            Pa.
        """
        share = -math.expm1(-elapsed / self._tuning.reading_time)
        looked, follows, strays, sound = self._look.view(
            share, self._smoothed, reading, offset, healthy
        )
        looked = looked.copy()
        self._smoothed, self._made_up, self.shortfall, now = *looked[:3], looked[3:]
        self._rest.advance(elapsed, command, self.shortfall)
        if self._any_out:
            self._ceiling = np.where(
                self.out, np.maximum(self._ceiling - self._let_down * elapsed, self._empty),
                self._limits.high,
            )  # fmt: skip
        if self._quiet and sound[0]:
            self._followed, self.pace = now, 1.0
            return
        self._set_pace(elapsed, reading, healthy)
        short, unmoved = self.shortfall, self._tuning.unmoved
        self._followed = np.where((follows > 0) & (strays == 0), now, self._followed)
        # a reading that has moved must not count as still when it comes by again
        still = np.abs(reading - self._followed[0]) < unmoved
        self._followed[0, ~still] = np.nan
        above, below = self._followed[1] - healthy[1], healthy[0] - self._followed[1]
        falls, rises = above > self._probe, below > self._probe
        ignores = still & np.stack([falls | rises, falls])
        moved = reading - self._followed[2]  # NaN: not measured
        opposed = (falls & (moved > self._probe)) | (rises & (moved < -self._probe))
        # a supply that fails while the command rises is short, not opposed
        self.opposed = (self.opposed | opposed) & (follows == 0) & ~self.limited
        self._smoothed = np.where(ignores[0], reading, self._smoothed)
        share = -math.expm1(-elapsed / self._tuning.make_up_time)
        wanted = np.minimum(np.maximum(short, self._min_allowed), self._max_allowed)
        self._allowed = self._allowed + share * (wanted - self._allowed)
        self._judge(elapsed, short, command, ignores)
        self._slow_for[self.lost] = 0.0
        self._quiet = not (
            self._durations.any()
            or self.opposed.any()
            or self.limited.any()
            or self._slow_for.any()
            or (self._allowed > self._min_allowed + 1.0).any()
        )

    def _set_pace(self, elapsed: float, reading: Array, healthy: Array) -> None:
        """Let the reference wait for channels that are behind their healthy pressures (2, n)."""
        tuning = self._tuning
        behind = np.fmax(np.fmax(healthy[0] - reading, reading - healthy[1]), 0.0)  # 0 for NaN
        self._usual += -math.expm1(-elapsed / tuning.wait_time) * (behind - self._usual)
        late = np.where(self.lost, 0.0, behind - self._usual) - tuning.follows
        self.pace = min(max(1 - float(late.max()) / tuning.longest_wait, 0.0), 1.0)
        left = np.maximum(self._slow_for - elapsed, 0.0)
        self._slow_for = np.where(late > tuning.longest_wait, tuning.slow_memory, left)

    def _judge(self, elapsed: float, short: Array, command: Array, ignores: Flags) -> None:
        """Find channels that are limited or stuck, and those that follow again.

        `ignores` (2, n) are readings that keep still, and those that should have fallen.
        """
        follows, patience = self._tuning.follows, self._tuning.patience
        too_high = self.limited & (-short > follows)
        wrong = np.stack([short > self._max_allowed, too_high, short > self._alarm_above])
        self._durations = np.clip(
            self._durations + np.where(wrong, elapsed, -elapsed), 0.0, patience
        )
        self._fed = (self._durations[2] >= patience) | (self._fed & (self._durations[2] > 0))
        lasting = (self._durations[:2] >= patience) | ignores
        moved = self._smoothed - self._found
        again = np.where(self.stuck, np.abs(moved) > follows, (moved > follows) & (short < follows))
        before = self.limited
        self.limited = (before & ~again) | (~before & lasting[0])
        found = self.limited & ~before
        self._found = np.where(found, self._smoothed, self._found)
        rising = np.minimum(self._smoothed, self._found + follows / 2)  # it may not rest yet
        self._held = np.where(found, self._smoothed, np.maximum(self._held, rising))
        pressed = np.minimum(short, command - self._smoothed) > self._max_allowed
        pressed &= self.limited & ~self.stuck & (self._smoothed < self._held)
        stuck = self.limited & lasting[1] & ~self.stuck
        self._held, self._found = (
            np.where(pressed | stuck, self._smoothed, past) for past in (self._held, self._found)
        )
        self.stuck = (self.stuck | stuck) & self.limited

    @property
    def compensated(self) -> Array:
        """The part of the regulators' offset (n,), see `update`, that commands compensate."""
        if self._quiet:
            return self._made_up
        most = np.where(self.limited, np.inf, self._allowed)
        above = np.where(self.limited, np.inf, self._min_allowed)
        return np.minimum(np.maximum(-self.shortfall, -most), above)

    def available(self) -> tuple[Array, Array]:
        """Return the lowest and highest pressures (n,) at which channels can settle, in Pa."""
        low, high = self._limits.low, self._limits.high
        if self._quiet and not self._any_out:
            return low, high
        has = np.clip(self._held, low, high)
        high = np.where(self.out, self._empty, np.where(self.limited, has, high))
        low = np.where(self.out, self._empty, np.where(self.stuck, has, low))
        return low, high

    def commands(
        self, path: Array, low: Array, high: Array, goal: Array | None = None
    ) -> tuple[Array, Array]:
        """Return the lowest and highest commands (n,) at a path's pressures (n,), in Pa.

        They stay within `low` and `high` (n,). Those of slow channels are those of the reference,
        `goal` (n,): feedback through them would come late, and excite what it is to damp.
        """
        if not self._quiet and goal is not None:
            slow = self._slow_for > 0
            low, high = (np.where(slow, np.clip(goal, low, high), bound) for bound in (low, high))
        if not self._quiet and self.limited.any():
            above, below = self._held + self._probe, self._smoothed - self._probe
            pressed = path > self._held - self._tuning.follows
            least = np.where(self.stuck, self._held - self._probe, np.where(pressed, above, below))
            greatest = np.where(self.stuck, least, above)
            low, high = (
                np.where(self.limited, np.clip(bound, low, high), limit)
                for bound, limit in ((least, low), (greatest, high))
            )
        if self._any_out:
            high = np.maximum(np.minimum(high, self._ceiling), low)
        return low, high

    def notices(self) -> Iterator[Notice]:
        """Yield alarms about lost, opposed and leaking channels."""
        if self.opposed.any():
            each = ", ".join(str(c + 1) for c in np.flatnonzero(self.opposed))
            text = (
                f"the pressure of channel {each} moves against its command: its regulator acts the "
                "wrong way, another channel's command reaches it, or the chamber has burst"
            )
            yield Notice("channel-opposed", text, Severity.ERROR, True, hold=True, undo=0.0)
        if not (self._quiet and not self._any_out) and self.lost.any():
            each = ", ".join(self._words(int(c)) for c in np.flatnonzero(self.lost))
            yield Notice("lost-channel", f"{each}; the plan goes on with the others", standing=True)
        if self._slow_for.any():
            each = ", ".join(str(c + 1) for c in np.flatnonzero(self._slow_for))
            text = (
                f"the pressure of channel {each} is not where even a slow regulator would have "
                "it: check regulator, gauge, supply and tubes, and control.regulator_lag in the "
                "rig file"
            )
            yield Notice("slow-channel", text, Severity.WARNING, standing=True)
        off = ~self.lost & (self._fed | self._rest.changed)
        if off.any():
            each = ", ".join(
                f"channel {c + 1} by {abs(self.shortfall[c]) * 1e-5:.2f} bar "
                + ("below" if self.shortfall[c] > 0 else "above")
                for c in np.flatnonzero(off)
            )
            text = (
                f"pressures differ from their commands, {each}: look for a leak and check gauge "
                "and regulator; up to "
                f"{self._max_allowed[off].min() * 1e-5:.2f} bar below is made up for"
            )
            yield Notice("shortfall", text, Severity.WARNING, standing=True)

    def _words(self, channel: int) -> str:
        name, has = f"channel {channel + 1}", f"{self._held[channel] * 1e-5:.2f} bar"
        if self.out[channel]:
            return f"{name} was taken out"
        return f"{name} is stuck at {has}" if self.stuck[channel] else f"{name} has {has} at most"


def _look(n: int, tuning: RegulatorTuning) -> Formula:
    """Return the formula of the checks that every tick makes.

    Inputs: share by which smoothed readings (n,) follow; these; readings and the regulators'
    offsets (n,); least and greatest healthy pressures (2, n). Outputs: rows (6, n) of smoothed
    readings, the part of the offset that commands compensate if no channel is short, shortfalls,
    readings, these without the offset, and readings again; 1 for channels (n,) that follow; 1 for
    those (n,) that are beyond the healthy pressures; and 1 if all follow and none is beyond them.
    """
    share, smoothed = ca.SX.sym("share"), ca.SX.sym("smoothed", n)
    reading, offset = ca.SX.sym("reading", n), ca.SX.sym("offset", n)
    healthy, short = ca.SX.sym("healthy", 2, n), -offset
    change = share * (reading - smoothed)
    after = smoothed + ca.if_else(ca.fabs(change) < np.inf, change, 0)  # 0 for NaN
    most = tuning.max_compensation
    made_up = ca.fmin(ca.fmax(-short, -most), most)
    settled = reading + short
    follows = ca.fabs(short) <= most
    below, above = healthy[0, :].T - settled, settled - healthy[1, :].T
    strays = ca.logic_or(below > tuning.unmoved, above > tuning.unmoved)
    sound = ca.logic_and(ca.mmin(follows) > 0, ca.mmax(strays) < 1)
    looked = ca.horzcat(after, made_up, short, reading, settled, reading).T
    inputs = [share, smoothed, reading, offset, healthy]
    return Formula(inputs, [looked, follows, strays, sound], [healthy, looked])


class _Rest:
    """Finds shortfalls of n channels that grow in size while their commands rest.

    `changed`: flags (n,) of these channels.
    """

    def __init__(self, n: int, tuning: RegulatorTuning) -> None:
        self._tuning, self._elapsed, self._step = tuning, 0.0, _rest(n, tuning)
        self._near: Array = np.zeros(n)  # the commands when they came to rest, in Pa
        self._rested: Array = np.zeros(n)  # for how long, in s
        self._usual: Array = np.zeros(n)  # shortfall of the channel at rest, in Pa
        self.changed: Flags = np.zeros(n, dtype=bool)

    def advance(self, elapsed: float, command: Array, short: Array) -> None:
        """Take in commands and shortfalls (n,), in Pa."""
        self._elapsed += elapsed
        if self._elapsed < self._tuning.rest_interval:
            return
        elapsed, self._elapsed = self._elapsed, 0.0
        self._near, self._rested, self._usual, changed = self._step(
            elapsed, command, short, self._near, self._rested, self._usual, self.changed
        )
        self.changed = changed > 0


def _rest(n: int, tuning: RegulatorTuning) -> Formula:
    """Return the formula of the test of shortfalls at rest.

    Inputs: the elapsed time, in s; commands and shortfalls (n,), in Pa; and what `_Rest` knows of
    each channel, (n,) each. Outputs: the latter after that time.
    """
    elapsed = ca.SX.sym("elapsed")
    command, short = ca.SX.sym("command", n), ca.SX.sym("short", n)
    near, rested = ca.SX.sym("near", n), ca.SX.sym("rested", n)
    usual, changed = ca.SX.sym("usual", n), ca.SX.sym("changed", n)
    inputs = [elapsed, command, short, near, rested, usual, changed]
    moved = ca.fabs(command - near) > tuning.rest_range
    near = ca.if_else(moved, command, near)
    rested = ca.if_else(moved, 0, rested + elapsed)
    settled = rested > tuning.rest_time
    least = tuning.unmoved + tuning.gain_error * ca.fabs(command - near)
    change, size = ca.fabs(short - usual), ca.fabs(short)
    grown = ca.logic_and(change > least, size > least)
    stays = ca.logic_and(changed, ca.logic_and(change > least / 2, size > least / 2))
    changed = ca.logic_or(ca.logic_and(settled, grown), stays)
    slow = -ca.expm1(-elapsed / tuning.usual_time)
    share = ca.if_else(ca.logic_and(settled, size > ca.fabs(usual)), slow, 1)
    usual = usual + ca.if_else(changed, 0, share) * (short - usual)
    return Formula(inputs, [near, rested, usual, changed])
