"""Runs for tests: a loop that only says how things stand, and snapshots of a known motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stiffopt.control.state import Alarm, Event, Severity, Snapshot, State, Timing
from stiffopt.rig.interface import PoseSample

Array = NDArray[np.float64]

PERIOD = 0.01  # s
FRAME = 0.025  # s
LATENCY = 0.025  # s
BEGIN = 5000.0  # s on the rig's clock
N = 6
LOW, HIGH = np.zeros(N), np.full(N, 1.5e5)


class FakeEvents:
    def __init__(self) -> None:
        self.all: list[Event] = []

    def since(self, index: int) -> tuple[list[Event], int]:
        return self.all[index:], len(self.all)


class FakeLoop:
    """What telemetry, metrics and the like see of a control loop."""

    def __init__(self) -> None:
        self.events = FakeEvents()
        self.alarms: dict[str, str] = {}
        self.told: list[str] = []
        self.now = snapshot(BEGIN)

    def snapshot(self) -> Snapshot:
        return self.now

    def add_alarm(self, kind: str, text: str) -> None:
        self.alarms[kind] = text
        self.told.append(text)

    def clear_alarm(self, kind: str) -> None:
        self.alarms.pop(kind, None)


def command_at(time: float) -> Array:
    """Return the pressures (6,) that were commanded at a time after BEGIN: steps of a tick."""
    tick = np.floor((time - BEGIN) / PERIOD + 1e-6)
    return np.clip(100.0 * tick + 1000.0 * np.arange(N), 0, 1.4e5)


def measured_at(time: float) -> Array:
    """Return the pressures (6,) that were measured at a time: straight lines."""
    return 9000.0 * (time - BEGIN) + 900.0 * np.arange(N)


def tip_at(time: float) -> Array:
    """Return where the tip truly was (3,), in m."""
    t = time - BEGIN
    return np.array([0.03 * np.sin(2 * t), 0.02 * np.cos(1.3 * t), 0.19 + 0.005 * np.sin(3 * t)])


def turn_at(time: float) -> Array:
    half = 0.2 * np.sin(time - BEGIN)
    return np.array([np.cos(half), 0.0, np.sin(half), 0.0])


def sample(time: float, frame: int, *, seen: bool = True, late: float = LATENCY) -> PoseSample:
    position = tip_at(time) if seen else np.full(3, np.nan)
    return PoseSample(time, time + late, frame, position, turn_at(time) if seen else None)


def samples_between(begin: float, end: float) -> tuple[PoseSample, ...]:
    """Return what a tracker of 40 Hz, off the ticks by 3 ms, delivers in a time (begin, end]."""
    first = int(np.ceil((begin - LATENCY - BEGIN - 0.003) / FRAME - 1e-9))
    found = []
    for frame in range(first, first + 100):
        captured = BEGIN + 0.003 + frame * FRAME
        if captured + LATENCY > end + 1e-9:
            break
        if captured + LATENCY > begin + 1e-9:
            found.append(sample(captured, frame))
    return tuple(found)


def snapshot(
    time: float,
    *,
    state: State = State.ACTIVE,
    reason: str = "",
    samples: tuple[PoseSample, ...] = (),
    rejected: int = 0,
    alarms: tuple[Alarm, ...] = (),
) -> Snapshot:
    """Return how things stand in a tick; the estimate is 1 cm off what the tracker saw."""
    measured_time = time - 0.002
    return Snapshot(
        time=time,
        state=state,
        reason=reason,
        commanded=command_at(time),
        measured=measured_at(measured_time),
        measured_time=measured_time,
        plan=command_at(time) + 500.0,
        low=LOW,
        high=HIGH,
        saturated=np.arange(N) == 2,
        tip_position=tip_at(time) + 0.01,
        tip_quaternion=turn_at(time),
        seen_position=tip_at(time - LATENCY),
        seen_age=LATENCY,
        target_position=np.array([0.02, np.nan, 0.19]),
        target_pointing=np.array([0.0, 0.0, 1.0]),
        position_error=0.001 + 0.01 * np.exp(-(time - BEGIN)),
        stiffness=20.0 + np.sin(time),
        best_stiffness=22.0,
        alarms=alarms,
        task="stiff-x",
        timing=Timing(
            ticks=7,
            overruns=2,
            tick_time=3e-4,
            lateness_edges=(1e-4, 1e-3),
            lateness_counts=(90, 9, 1),
        ),
        samples=samples,
        rejected=rejected,
    )


def ticks(count: int) -> list[Snapshot]:
    """Return the first snapshots of a run, with all that the tracker delivered."""
    times = [BEGIN + k * PERIOD for k in range(count)]
    return [snapshot(t, samples=samples_between(t - PERIOD, t)) for t in times]


def event(time: float, kind: str, text: str, severity: Severity = Severity.INFO) -> Event:
    return Event(BEGIN + time, kind, text, severity)
