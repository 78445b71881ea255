"""`Conductor`: command the pressures of a rig during an experiment, and collect its readings.

Commands are goals of the supply of `stiffopt.open_rig`: the safety gate limits them, and lets the
arm down when commands stop. The pressure monitor checks every reading.
"""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import DeviceError, InputError
from stiffopt.logs import LogRow
from stiffopt.rig.interface import PoseSample, PressureCommand, PressureReading, Rig
from stiffopt.rig.settings import ControlSettings, Safety
from stiffopt.safety.expected_pressure import Regulation
from stiffopt.safety.goal import GoalSupply
from stiffopt.safety.monitors import PressureMonitor

_KEPT = 4096  # number of frames and ticks in memory
_RECENT = 200  # number of ticks searched for that of a frame


@dataclass(frozen=True)
class ConductorTuning:
    """Tuning of the conductor's motions and checks."""

    gentle: float = 5e4  # rate of pressures on the way to a new pose, in Pa/s
    first_sight: float = 5.0  # time within which the tracker must first see the tip, in s
    near: float = 0.1  # largest time between a frame and its readings, in s
    settle_look: float = 0.1  # period of checks whether something has settled, in s
    # largest time constant of a healthy regulator, in s; far above a usual `regulator_lag`, since
    # the arm of an experiment may not be identified yet
    slowest_lag: float = 2.0
    bad_readings: int = 3  # consecutive impossible readings that end an experiment
    # a ramp fails if it takes this many times the expected number of ticks
    ramp_patience: int = 10


CONDUCTOR = ConductorTuning()


@dataclass(frozen=True)
class TrackedFrame:
    """A frame of the tracker with the pressures and probe readings of that moment."""

    time: float  # of capture, on the rig's clock, in s
    position: Array  # of the tip in the base frame (3,), in m; NaN if it was not seen
    quaternion: Array | None  # of the tip in the base frame (w, x, y, z); None if it is not tracked
    commanded: Array  # set-points (n,) then, in Pa
    measured: Array  # nearest measured pressures (n,), in Pa; NaN if none is near in time
    force: float  # of the probe, in N; NaN while not in use
    stage: float  # position of the probe, in m; NaN while not in use

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
class TickRecord:
    """Set-points and readings of one tick; units as in `TrackedFrame`."""

    time: float
    commanded: Array
    measured: Array
    force: float
    stage: float


class Conductor:
    """Steps a rig at a fixed rate: command, read all devices, wait for the next tick.

    The safety gate limits every command, so that a delayed loop makes no jump. The experiment ends
    with `DeviceError` if a device fails, the tracker loses the tip, the pressure monitor finds a
    fault, or the arm was let down because the loop had stopped. The caller must then close the rig,
    which vents it.

    Parameters
    ----------
    rig : open, with a tracker, from `stiffopt.open_rig`.
    rate : ticks per second.
    check : called in each tick; it may raise to stop the experiment.
    """

    def __init__(self, rig: Rig, rate: float, check: Callable[[], None] = lambda: None) -> None:
        if rig.tracker is None:
            raise InputError("this rig has no tracker; the experiment needs one")
        if not isinstance(rig.supply, GoalSupply):
            raise InputError("this rig's supply has no safety gate; open it by stiffopt.open_rig")
        self.rig = rig
        self.tracker = rig.tracker
        self.clock = rig.clock
        self.rows: deque[TrackedFrame] = deque(maxlen=_KEPT)  # the latest
        self.sink: Callable[[TrackedFrame], None] | None = None  # called with every new frame
        self.watch: Callable[[TickRecord], None] | None = None  # called in every tick; may raise
        self.probing = False  # whether the probe is read in each tick
        self.origin: float | None = None  # time 0 of the logs, set by the first one
        self._period = 1.0 / rate
        self._check = check
        safety = Safety() if rig.settings is None else rig.settings.safety
        control = ControlSettings() if rig.settings is None else rig.settings.control
        lag = max(control.regulator_lag, CONDUCTOR.slowest_lag)
        regulation = Regulation.slowest(
            rig.robot, control.model_copy(update={"regulator_lag": lag}), self.n
        )
        self._monitor = PressureMonitor(rig.supply.limits, safety, regulation, rig.slew)
        self._impossible = 0  # consecutive impossible readings
        self._valid, self._lost = safety.command_timeout, safety.tracker_timeout
        self._target = self._commanded = np.array(rig.supply.commanded, dtype=float)
        self._ticks: deque[TickRecord] = deque(maxlen=_KEPT)
        self._last = self._deadline = self.clock.now()
        self._hidden = False  # whether a person may block the tracker's view

    @property
    def n(self) -> int:
        """Number of channels."""
        return self.rig.supply.n

    def start(self) -> None:
        """Arm the supply and wait until the tracker sees the tip."""
        self.rig.supply.arm()
        self._monitor.clear()
        self._target = self._commanded = np.zeros(self.n)
        self._last = begin = self.clock.now()
        while not any(row.visible for row in self.rows):
            if self.clock.now() - begin > CONDUCTOR.first_sight:
                raise DeviceError(
                    f"the tracker has not seen the tip for {CONDUCTOR.first_sight:g} s; "
                    "is it connected, is the sensor in its field?"
                )
            self.tick(self._target)

    def forget_pressures(self) -> None:
        """Restart the pressure monitor: what the channels have reached so far no longer counts."""
        self._monitor.clear()

    def tick(self, target: ArrayLike) -> None:
        """Command pressures (n,), in Pa, as the gate's goal, and wait for the next tick.

        `CommandError`: the pressures are outside the limits.
        """
        self._check()
        now = self.clock.now()
        pause = now - self._last
        if pause > self._valid and not self.rig.supply.armed:
            raise DeviceError(
                f"the experiment stalled for {pause:.3g} s, so the arm was let down and "
                "vented; go on with --resume"
            )
        self._last = now
        self._target = np.array(target, dtype=float)
        reading = self.rig.supply.exchange(PressureCommand(self._target, now, self._valid))
        self._commanded = self.rig.supply.commanded  # after the gate's limits
        self._judge(now, reading)
        force, stage = np.nan, np.nan
        if self.probing and self.rig.probe is not None:
            felt = self.rig.probe.sample()
            force, stage = felt.force, felt.position
        self._ticks.append(TickRecord(now, self._commanded, reading.pressures, force, stage))
        for sample in self.tracker.read():
            self._take(sample)
        if self.watch is not None:
            self.watch(self._ticks[-1])
        if self._lost < self.tracker.age() < np.inf and not self._hidden:
            raise DeviceError(f"the tracker has not seen the tip for {self._lost:g} s")
        self._deadline += self._period
        if self._deadline <= self.clock.now():
            self._deadline = self.clock.now() + self._period
        self.clock.sleep_until(self._deadline)

    def _judge(self, now: float, reading: PressureReading) -> None:
        """Raise `DeviceError` if the readings show a fault of the supply."""
        self._monitor.tell(now, self._commanded)
        trouble = self._monitor.update(self.clock.now(), reading)
        impossible = trouble is not None and trouble.kind == "pressure-reading"
        self._impossible = self._impossible + 1 if impossible else 0
        if trouble is None or 0 < self._impossible < CONDUCTOR.bad_readings:
            return
        hint = "" if impossible else " (if its gauge is wrong, allow for it: max_pressure_error)"
        raise DeviceError(trouble.text + hint)

    def _take(self, sample: PoseSample) -> None:
        """Combine a frame with the set-points and readings of the moment of its capture."""
        if self.rows and sample.time <= self.rows[-1].time:
            return  # a repeated frame
        held, nearest = self._ticks_at(sample.time)
        row = TrackedFrame(
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

    def _ticks_at(self, time: float) -> tuple[TickRecord, TickRecord]:
        """Return the tick whose command held at a time, and the one with the nearest readings."""
        recent = [self._ticks[-k] for k in range(min(len(self._ticks), _RECENT), 0, -1)]
        after = bisect_right(recent, time, key=lambda tick: tick.time)
        around = recent[max(after - 1, 0) : after + 1]
        nearest = min(around, key=lambda tick: abs(tick.time - time))
        if abs(nearest.time - time) > CONDUCTOR.near:
            nearest = TickRecord(time, nearest.commanded, np.full(self.n, np.nan), np.nan, np.nan)
        return around[0], nearest

    # -- longer manoeuvres ------------------------------------------------------------------

    def meanwhile(self, task: Callable[[], None]) -> None:
        """Hold the pressures while a task, in its own thread, waits for a person.

        Commands go on, so that they do not expire; meanwhile a hidden tip is not a fault. An
        exception of the task is raised here.
        """
        failures: list[BaseException] = []

        def work() -> None:
            try:
                task()
            except BaseException as error:  # raised by the thread that waits
                failures.append(error)

        thread = threading.Thread(target=work, name="person", daemon=True)
        self._hidden = True
        try:
            thread.start()
            while thread.is_alive():
                self.tick(self._target)
            done = self.clock.now()
            while (
                self.tracker.age() > CONDUCTOR.near
                and self.clock.now() - done < CONDUCTOR.first_sight
                and not failures
            ):
                self.tick(self._target)  # until the person has left the tracker's view
        finally:
            self._hidden = False
        if failures:
            raise failures[0]

    def _approach(self, target: Array) -> None:
        """Tick once towards pressures (n,), in Pa, at most at the gentle rate."""
        limits = self.rig.supply.limits
        reach = CONDUCTOR.gentle * min(max(self.clock.now() - self._last, 0.0), 2 * self._period)
        near = np.clip(target, self._commanded - reach, self._commanded + reach)
        outside = (near < limits.low) | (near > limits.high)  # on the way from or to 0
        self.tick(limits.clamp(np.where((target == 0) & outside, 0.0, near)))

    def ramp(self, target: ArrayLike) -> None:
        """Ramp the pressures to a target (n,), in Pa, gently, see `ConductorTuning`."""
        limits = self.rig.supply.limits
        target = limits.clamp(np.asarray(target, dtype=float))
        span = np.maximum(limits.high, 0.0) - np.minimum(limits.low, 0.0)
        ticks = int(np.max(span / np.minimum(self.rig.slew, CONDUCTOR.gentle)) / self._period)
        for _ in range(CONDUCTOR.ramp_patience * (ticks + 10)):
            self._approach(target)
            if np.array_equal(self._commanded, target):
                return
        raise DeviceError("the commands do not reach their target: the gate limits them")

    def settle(
        self, target: ArrayLike, settled: Callable[[Sequence[TrackedFrame]], bool], timeout: float
    ) -> bool:
        """Hold pressures (n,) until new frames satisfy a condition, or for `timeout` s.

        Return whether they did.
        """
        begin = looked = self.clock.now()
        while (now := self.clock.now()) - begin < timeout:
            self.tick(target)
            if now - looked >= CONDUCTOR.settle_look:
                looked = now
                if settled(self.since(begin)):
                    return True
        return False

    def since(self, begin: float) -> list[TrackedFrame]:
        """Return the frames from the time `begin` on, in order."""
        found = []
        for row in reversed(self.rows):
            if row.time < begin:
                break
            found.append(row)
        return found[::-1]


def at_rest(
    rows: Sequence[TrackedFrame], window: float = 1.0, tolerance: float = 5e-5, parts: int = 4
) -> bool:
    """Return whether the tip has come to rest: the means over the parts of a window agree.

    Means are compared since the tracker's noise is about as large as the tolerance; four of them
    reveal a slow swing.
    """
    groups = split_window([row for row in rows if row.visible], window, parts)
    if groups is None:
        return False
    means = np.array([np.mean([row.position for row in group], axis=0) for group in groups])
    return float(np.linalg.norm(np.ptp(means, axis=0))) <= tolerance


def split_window(
    rows: Sequence[TrackedFrame], window: float, parts: int
) -> list[list[TrackedFrame]] | None:
    """Split the frames of the last `window` s into equal parts; None if there are too few."""
    if not rows or rows[-1].time - rows[0].time < 0.95 * window:
        return None
    begin = rows[-1].time - window
    groups: list[list[TrackedFrame]] = [[] for _ in range(parts)]
    for row in reversed(rows):
        if row.time < begin:
            break
        place = int((row.time - begin) / window * parts)
        groups[min(place, parts - 1)].append(row)
    return groups if all(len(group) >= 2 for group in groups) else None


def check_pressures(rig: Rig, pressures: ArrayLike, channels: Sequence[int]) -> None:
    """Raise `InputError` unless each channel (from 0) alone may have each of the pressures."""
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
    """Raise `InputError` if a channel's pressure, in Pa, alone exceeds the limit of force."""
    alone = np.zeros(rig.supply.n)
    alone[channel] = pressure
    force = rig.force(alone)
    if rig.max_force is not None and force > rig.max_force:
        allowed = pressure * rig.max_force / force
        raise InputError(
            f"channel {channel + 1} cannot have {pressure * 1e-5:g} bar: that is {force:.3g} N, "
            f"and the rig file's safety.max_force is {rig.max_force:g} N, or "
            f"{allowed * 1e-5:.3g} bar of this channel"
        )
