"""Move an arm that was never commissioned: one channel after another, by small steps from rest.

All commands pass the conductor and thus the safety gate. At the first sign of danger the procedure
raises `DangerError`; the caller then closes the rig, which vents it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from stiffopt.arrays import Array
from stiffopt.commissioning.expected import ExpectedSteps
from stiffopt.commissioning.settings import PROCEDURE
from stiffopt.errors import DeviceError
from stiffopt.experiments.conductor import Conductor, TickRecord, TrackedFrame
from stiffopt.experiments.folder import Progress, recorded
from stiffopt.rig.interface import Rig
from stiffopt.rig.settings import Safety

LOG = "commissioning"
"""Name of the recording, without ending."""


class DangerError(DeviceError):
    """The arm moved as no sound arm can; it must be vented."""


@dataclass(frozen=True)
class ChannelStep:
    """Times, in s, of a channel's (from 0) first part of the step, full step, release and end."""

    channel: int
    first: float
    up: float
    down: float
    end: float


@dataclass(frozen=True, eq=False)
class StepReadings:
    """All measurements during the steps, in SI; times are those of the rig's clock."""

    # time, position, quaternion, age: of the tracker's frames, (N,), (N, 3), (N, 4), (N,). `age` is
    # the time from capture to arrival. NaN where the tip was not seen
    time: Array
    position: Array
    quaternion: Array | None
    age: Array
    # tick, commanded, measured: times (M,), and pressures (M, n)
    tick: Array
    commanded: Array
    measured: Array
    rest: tuple[float, float]  # begin and end of the rest before the steps
    steps: tuple[ChannelStep, ...]  # one for each channel
    size: float  # of the steps, in Pa


@dataclass
class _StepWatch:
    """Collects all measurements; raises `DangerError` when the tip jumps or moves too far."""

    conductor: Conductor
    safety: Safety
    allowed: float = np.inf  # distance from rest, in m
    origin: Array = field(default_factory=lambda: np.zeros(3))
    frames: list[TrackedFrame] = field(default_factory=list)
    ages: list[float] = field(default_factory=list)
    ticks: list[TickRecord] = field(default_factory=list)

    def __call__(self, tick: TickRecord) -> None:
        self.ticks.append(tick)
        after = self.frames[-1].time if self.frames else self.ticks[0].time
        now = self.conductor.clock.now()
        for frame in self.conductor.since(after):
            if frame.time > after:
                self.frames.append(frame)
                self.ages.append(now - frame.time)
                self._look(frame)

    def _look(self, frame: TrackedFrame) -> None:
        if not frame.visible:
            return
        before = [each for each in self.frames[-6:-1] if each.visible]
        if before:
            way = float(np.linalg.norm(frame.position - before[-1].position))
            time = frame.time - before[-1].time
            if way > self.safety.max_tip_speed * time + 2e-3:
                raise DangerError(
                    f"the tip seems to have jumped by {1e3 * way:.0f} mm within {1e3 * time:.0f} "
                    "ms: the tracker is disturbed, or its sensor has come off"
                )
        moved = float(np.linalg.norm(frame.position - self.origin))
        if moved > self.allowed:
            raise DangerError(
                f"the tip has moved by {1e3 * moved:.1f} mm, and no arrangement of this arm's "
                f"channels explains more than {1e3 * self.allowed:.1f} mm: is the right robot file "
                "in the rig file, are regulators and tubes right?"
            )

    def settle(self, begin: float) -> None:
        """Set the origin of the motion to the tip's position at rest; check that it is at rest."""
        seen = np.array([f.position for f in self.frames if f.visible and f.time >= begin])
        if len(seen) < 10:
            raise DangerError(
                f"the tracker saw the tip {len(seen)} times in {PROCEDURE.rest:g} s; is it in its "
                "field, and fast enough?"
            )
        self.origin = np.median(seen, axis=0)
        swing = float(np.quantile(np.linalg.norm(seen - self.origin, axis=1), 0.9))
        if swing > PROCEDURE.restless:
            raise DangerError(
                f"the tip moves by {1e3 * swing:.1f} mm though the arm is vented; is the base "
                "fixed, does something shake it, is there metal near the tracker?"
            )


def run_steps(
    rig: Rig,
    expected: ExpectedSteps,
    folder: Path,
    *,
    rate: float,
    quick: bool = False,
    progress: Progress = lambda done, total, text: None,
    check: Callable[[], None] = lambda: None,
) -> StepReadings:
    """Move the channels one after another, and return all measurements.

    Raises `DangerError`: the tip moves as no sound arm can; `DeviceError`: a device fails.

    Parameters
    ----------
    rig : open.
    expected : the model's predictions; they contain the size of the steps.
    folder : gets the recording (log v1, CSV and MCAP).
    rate : rate of the commands, in Hz.
    quick : whether to hold the steps only briefly; slow leaks then go unnoticed.
    progress, check : as in `stiffopt.experiments.poses.run_poses`.
    """
    conductor = Conductor(rig, rate, check)
    watch = _StepWatch(conductor, Safety() if rig.settings is None else rig.settings.safety)
    limits = rig.supply.limits
    zero = limits.clamp(np.clip(0.0, limits.low, limits.high))
    conductor.start()
    conductor.watch = watch
    limit = PROCEDURE.danger * expected.farthest + PROCEDURE.slack
    steps: list[ChannelStep] = []
    with recorded(conductor, folder, LOG, {"experiment": LOG}):
        begin = conductor.clock.now()
        progress(0, conductor.n + 1, "at rest")
        _hold(conductor, zero, PROCEDURE.rest)
        watch.settle(begin)
        ready = conductor.clock.now()
        for channel in range(conductor.n):
            progress(channel + 1, conductor.n + 1, f"channel {channel + 1} of {conductor.n}")
            # its gauge may have shown another channel's step; then it seems to leak in its own
            conductor.forget_pressures()
            p, times = zero.copy(), list[float]()
            for share, hold in (
                (PROCEDURE.first, PROCEDURE.first_hold),
                (1.0, PROCEDURE.up if quick else PROCEDURE.long),
                (0.0, PROCEDURE.down if quick else PROCEDURE.long_down),
            ):
                times.append(conductor.clock.now())
                p[channel] = zero[channel] + share * expected.size
                watch.allowed = max(share, PROCEDURE.first) * limit if share else limit
                _hold(conductor, p, hold)
            first, up, down = times
            steps.append(ChannelStep(channel, first, up, down, conductor.clock.now()))
    return _readings(watch, (begin, ready), tuple(steps), expected.size)


def _hold(conductor: Conductor, pressures: Array, duration: float) -> None:
    end = conductor.clock.now() + duration
    while conductor.clock.now() < end:
        conductor.tick(pressures)


def _readings(
    watch: _StepWatch, rest: tuple[float, float], steps: tuple[ChannelStep, ...], size: float
) -> StepReadings:
    frames, ticks = watch.frames, watch.ticks
    turns = any(frame.quaternion is not None for frame in frames)
    nothing = np.full(4, np.nan)
    quaternion = None
    if turns:
        quaternion = np.array([nothing if f.quaternion is None else f.quaternion for f in frames])
        first = next(each for each in quaternion if np.isfinite(each).all())
        quaternion *= np.where(quaternion @ first < 0, -1.0, 1.0)[:, np.newaxis]
    return StepReadings(
        time=np.array([frame.time for frame in frames]),
        position=np.array([frame.position for frame in frames]),
        quaternion=quaternion,
        age=np.array(watch.ages),
        tick=np.array([tick.time for tick in ticks]),
        commanded=np.array([tick.commanded for tick in ticks]),
        measured=np.array([tick.measured for tick in ticks]),
        rest=rest,
        steps=steps,
        size=size,
    )
