"""Conductor: commands the pressures of a rig open loop and collects what its devices say."""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import DeviceError, InputError
from stiffopt.experiments.gauges import AGREE, Gauges
from stiffopt.logs import LogRow
from stiffopt.rig.interface import PoseSample, PressureCommand, Rig

__all__ = ["Conductor", "Row", "at_rest", "check_pressures", "steepest"]

Array = NDArray[np.float64]

LOST = 2.0
"""Seconds without sight of the tip after which an experiment is given up, if no rig file says."""
VALID = 0.5
"""Seconds for which a command holds, if no rig file says."""
GENTLE = 5e4
"""Rate in Pa/s at which pressures are brought to where an experiment wants them."""
STEEPEST = 5e5
"""Rate in Pa/s of a channel for which neither robot nor rig file has a limit."""
_FIRST = 5.0  # s that a tracker may take to see the tip for the first time
_MOST_PERIODS = 2.0  # that count in one step: a loop that was held up does not catch up with a jump
_PAUSE = 0.15  # s without a command after which a device may have vented by itself
_GLANCE = 0.01  # s between two readings after a pause
_MOST_LOOKS = 20  # after a pause, at pressures that change all the time
_FAR = 0.1e5  # Pa by which a pressure must have fallen, for noise and lag
_LOOK = 0.1  # s between two looks at whether something has settled
_KEPT = 4096  # rows and moments
_RECENT = 200  # moments among which that of a frame is looked for
_NEAR = 0.1  # s between a frame and readings that belong to it
_PATIENCE = 10  # times the steps that a ramp over the whole range takes


@dataclass(frozen=True)
class Row:
    """What was so when the tracker looked: tip, pressures, and the probe if it is in use.

    Times are those of the rig's clock; positions are those of the tip in the base frame.
    """

    time: float
    position: Array
    quaternion: Array | None
    commanded: Array
    measured: Array
    force: float
    stage: float

    @property
    def visible(self) -> bool:
        """Whether the tip was seen."""
        return bool(np.isfinite(self.position).all())

    def logged(self, begin: float) -> LogRow:
        """Return the row of a log whose time 0 is `begin`."""
        return LogRow(
            time=self.time - begin,
            commanded=self.commanded,
            measured=self.measured,
            position=self.position,
            quaternion=self.quaternion,
            force=self.force,
            stage=self.stage,
        )


@dataclass(frozen=True)
class _Moment:
    time: float
    commanded: Array
    measured: Array
    force: float
    stage: float


class Conductor:
    """Steps a rig at a fixed rate: a command, a look at all devices, a wait for the next moment.

    Commands are within the rig's limits and never change faster than its slew (`steepest`). A loop
    that was held up goes on from where it was. Where the pressure has gone meanwhile, because a
    device's own watchdog has vented, the channel is vented and comes up again under the slew. No
    reading of a gauge is ever commanded.

    Parameters
    ----------
    rig : Rig
        Open, with a tracker.
    rate : float
        Steps a second.
    check : callable, optional
        Called at each step; raises to stop the experiment.

    Attributes
    ----------
    rows : deque of Row
        The latest of what was seen, one for each frame of the tracker.
    sink : callable or None
        Is given every new row.
    probing : bool
        Whether the probe is read at each step.
    """

    def __init__(self, rig: Rig, rate: float, check: Callable[[], None] = lambda: None) -> None:
        if rig.tracker is None:
            raise InputError("this rig has no tracker; the experiment needs one")
        if not np.all(rig.slew > 0):
            raise InputError("the slew of this rig must be above 0 for each channel")
        self.rig = rig
        self.tracker = rig.tracker
        self.clock = rig.clock
        self.rows: deque[Row] = deque(maxlen=_KEPT)
        self.sink: Callable[[Row], None] | None = None
        self.probing = False
        self._period = 1.0 / rate
        self._check = check
        self._slew = steepest(rig)
        self._setpoint = np.array(rig.supply.commanded, dtype=float)
        self._gauges = Gauges(self.n)
        self._moments: deque[_Moment] = deque(maxlen=_KEPT)
        self._last = self._deadline = self.clock.now()
        safety = None if rig.settings is None else rig.settings.safety
        self._valid = VALID if safety is None else safety.command_timeout
        self._lost = LOST if safety is None else safety.tracker_timeout
        self._hidden = False  # somebody may stand before the tracker

    @property
    def n(self) -> int:
        """Number of channels."""
        return self.rig.supply.n

    def start(self) -> None:
        """Let commands have an effect, and wait for the tracker.

        Raises
        ------
        DeviceError
            The tracker does not see the tip.
        """
        self.rig.supply.arm()
        self._last = begin = self.clock.now()
        while not any(row.visible for row in self.rows):
            if self.clock.now() - begin > _FIRST:
                raise DeviceError(
                    f"the tracker has not seen the tip for {_FIRST:g} s; "
                    "is it connected, is the sensor in its field?"
                )
            self.tick(self._setpoint)

    def tick(self, target: ArrayLike, slew: float | None = None) -> None:
        """Command pressures (n,), as far as the slew lets them go, and wait for the next step.

        Raises
        ------
        DeviceError
            A device fails, or the tracker has lost the tip.
        """
        self._check()
        gone = self._gone()
        now = self.clock.now()
        reach = self._slew if slew is None else np.minimum(self._slew, slew)
        reach = reach * min(max(now - self._last, 0.0), _MOST_PERIODS * self._period)
        limits, target = self.rig.supply.limits, np.asarray(target, dtype=float)
        before, start = self._setpoint, np.where(gone, 0.0, self._setpoint)
        wanted = np.clip(target, start - reach, start + reach)
        outside = (wanted < limits.low) | (wanted > limits.high)
        self._setpoint = limits.clamp(np.where((target == 0) & outside, 0.0, wanted))
        self._last = now
        reading = self.rig.supply.exchange(PressureCommand(self._setpoint, now, self._valid))
        self._setpoint = self.rig.supply.commanded  # as far as the gate has let it go
        self._gauges.note(now, before, self._setpoint, reading.pressures)
        self._gauges.refuse_nonsense(limits)
        force, stage = np.nan, np.nan
        if self.probing and self.rig.probe is not None:
            felt = self.rig.probe.sample()
            force, stage = felt.force, felt.position
        self._moments.append(_Moment(now, self._setpoint, reading.pressures, force, stage))
        for sample in self.tracker.read():
            self._take(sample)
        if self._lost < self.tracker.age() < np.inf and not self._hidden:
            raise DeviceError(f"the tracker has not seen the tip for {self._lost:g} s")
        self._deadline += self._period
        if self._deadline <= self.clock.now():
            self._deadline = self.clock.now() + self._period
        self.clock.sleep_until(self._deadline)

    def _gone(self) -> NDArray[np.bool_]:
        """Say in which channels (n,) the pressure is no longer what it was commanded to be.

        After a pause nothing is commanded before that is known. Where the command has expired and
        no gauge shows that it still holds, it is taken for gone: to vent is always allowed.
        """
        half = 0.5 * np.abs(self._setpoint)
        pause = self.clock.now() - self._last
        if pause <= max(_PAUSE, 3 * self._period):
            return self._gauges.fallen(self._setpoint, np.maximum(half, _FAR))
        if not self.rig.supply.armed:  # nobody may be there any more: do not begin by itself
            raise DeviceError(
                f"the experiment stood still for {pause:.3g} s, so that the arm was let down and "
                "vented; go on with --resume"
            )
        for count in range(_MOST_LOOKS):
            if count >= AGREE and self._gauges.steady():
                break
            if count:
                self.clock.sleep(_GLANCE)
            self._gauges.look(self.rig.supply.read().pressures)
        gone = self._gauges.fallen(self._setpoint, _FAR)
        if pause > self._valid:
            gone |= ~(self._gauges.shown(self._setpoint) >= half)
        return gone

    def _take(self, sample: PoseSample) -> None:
        """Put a frame together with what held when it was captured."""
        if self.rows and sample.time <= self.rows[-1].time:
            return  # a frame that came twice
        held, nearest = self._moments_at(sample.time)
        row = Row(
            time=sample.time,
            position=sample.position,
            quaternion=sample.quaternion,
            commanded=held.commanded,
            measured=nearest.measured,
            force=nearest.force,
            stage=nearest.stage,
        )
        self.rows.append(row)
        if self.sink is not None:
            self.sink(row)

    def _moments_at(self, time: float) -> tuple[_Moment, _Moment]:
        """Return the moment whose command held at a time, and that with the nearest readings."""
        recent = [self._moments[-k] for k in range(min(len(self._moments), _RECENT), 0, -1)]
        after = bisect_right(recent, time, key=lambda moment: moment.time)
        around = recent[max(after - 1, 0) : after + 1]
        nearest = min(around, key=lambda moment: abs(moment.time - time))
        if abs(nearest.time - time) > _NEAR:
            nearest = _Moment(time, nearest.commanded, np.full(self.n, np.nan), np.nan, np.nan)
        return around[0], nearest

    # -- longer manoeuvres ------------------------------------------------------------------

    def meanwhile(self, task: Callable[[], None]) -> None:
        """Hold the pressures while a task, in a thread of its own, waits for a person.

        The supply is spoken to all the time, for its watchdog; that the tip is hidden is no fault.
        Whatever the task raises is raised here.
        """
        failures: list[BaseException] = []

        def work() -> None:
            try:
                task()
            except BaseException as error:  # told by who waits
                failures.append(error)

        thread = threading.Thread(target=work, name="person", daemon=True)
        self._hidden = True
        try:
            thread.start()
            while thread.is_alive():
                self.tick(self._setpoint)
            done = self.clock.now()
            while self.tracker.age() > _NEAR and self.clock.now() - done < _FIRST and not failures:
                self.tick(self._setpoint)  # whoever stood before the tracker steps aside
        finally:
            self._hidden = False
        if failures:
            raise failures[0]

    def ramp(self, target: ArrayLike, slew: float = GENTLE) -> None:
        """Bring the pressures (n,) somewhere.

        Raises
        ------
        DeviceError
            They do not get there, for the supply vents by itself again and again.
        """
        limits = self.rig.supply.limits
        target = limits.clamp(np.asarray(target, dtype=float))
        span = np.maximum(limits.high, 0.0) - np.minimum(limits.low, 0.0)
        steps = float(np.max(span / np.minimum(self._slew, slew))) / self._period
        for _ in range(_PATIENCE * (int(steps) + 10)):
            self.tick(target, slew)  # at least one: they may have fallen
            if np.array_equal(self._setpoint, target):
                return
        raise DeviceError(
            "the pressures do not get to where they shall be: they fall again and again; "
            "is there air, does the supply's watchdog wait long enough?"
        )

    def settle(
        self, target: ArrayLike, settled: Callable[[Sequence[Row]], bool], timeout: float
    ) -> bool:
        """Hold pressures (n,) until rows seen since then satisfy a condition; say if they did."""
        begin = looked = self.clock.now()
        while (now := self.clock.now()) - begin < timeout:
            self.tick(target)
            if now - looked >= _LOOK:
                looked = now
                if settled(self.since(begin)):
                    return True
        return False

    def since(self, begin: float) -> list[Row]:
        """Rows whose time is not before `begin`, in order."""
        found = []
        for row in reversed(self.rows):
            if row.time < begin:
                break
            found.append(row)
        return found[::-1]


def steepest(rig: Rig) -> Array:
    """Return the rates (n,) in Pa/s that no command exceeds: the rig's slew, or `STEEPEST`."""
    return np.where(np.isfinite(rig.slew), rig.slew, STEEPEST)


def at_rest(
    rows: Sequence[Row], window: float = 1.0, tolerance: float = 5e-5, parts: int = 4
) -> bool:
    """Whether the tip has come to rest: the means of the parts of a window agree.

    Means, since a tracker's noise is of the size of the tolerance; four of them, so that a slow
    swing shows.
    """
    groups = split_window([row for row in rows if row.visible], window, parts)
    if groups is None:
        return False
    means = np.array([np.mean([row.position for row in group], axis=0) for group in groups])
    return float(np.linalg.norm(np.ptp(means, axis=0))) <= tolerance


def split_window(rows: Sequence[Row], window: float, parts: int) -> list[list[Row]] | None:
    """Rows of the last `window` s in equal parts, or None while there are too few."""
    if not rows or rows[-1].time - rows[0].time < 0.95 * window:
        return None
    begin = rows[-1].time - window
    groups: list[list[Row]] = [[] for _ in range(parts)]
    for row in reversed(rows):
        if row.time < begin:
            break
        place = int((row.time - begin) / window * parts)
        groups[min(place, parts - 1)].append(row)
    return groups if all(len(group) >= 2 for group in groups) else None


def check_pressures(rig: Rig, pressures: ArrayLike, channels: Sequence[int]) -> None:
    """Refuse pressures (any number) that channels (counted from 0) may not have, one at a time.

    Raises
    ------
    InputError
        It names the channel and its limits.
    """
    limits = rig.supply.limits
    for channel in channels:
        for p in np.ravel(pressures):
            low, high = limits.low[channel], limits.high[channel]
            if not (low <= p <= high * (1 + 1e-9) or p == 0):
                raise InputError(
                    f"channel {channel + 1} cannot have {p * 1e-5:g} bar; the limits of this rig "
                    f"are {low * 1e-5:g} to {high * 1e-5:g} bar"
                )
            _check_force(rig, channel, float(p))


def _check_force(rig: Rig, channel: int, pressure: float) -> None:
    """Refuse a pressure of a channel, in Pa, that alone is above the limit of the total force."""
    alone = np.zeros(rig.supply.n)
    alone[channel] = pressure
    force = rig.force(alone)
    if rig.max_force is not None and force > rig.max_force:
        most = pressure * rig.max_force / force
        raise InputError(
            f"channel {channel + 1} cannot have {pressure * 1e-5:g} bar: that is {force:.3g} N, "
            f"and the rig file's safety.max_force is {rig.max_force:g} N, or {most * 1e-5:.3g} bar "
            "of this channel"
        )
