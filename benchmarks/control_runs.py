"""Run a controller on a simulated arm, and evaluate the run; see `control.py`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from control_baselines import PERIOD, MakeController
from control_cases import DIRECTIONS, Case, Path8, settling_time
from stiffopt import Task
from stiffopt.control.interface import Controller, Notice
from stiffopt.control.loop import ControlLoop
from stiffopt.control.state import State
from stiffopt.paths.trajectory import Trajectory, Waypoint
from stiffopt.plant.devices import SimulatedRig
from stiffopt.safety.gate import SafetyGate

Array = NDArray[np.float64]

HOLD, LAST = 10.0, 2.0  # s of a step, and of its end over which the steady error is the mean
STAYS = 0.2  # s at the end in which the tip must not leave the target again
EARLY, LATE = (4.0, 6.0), (8.0, 10.0)  # s between which swings are compared
SWING = 1e-3  # m; a smaller one is no instability
AWAY = 0.030  # m beyond the step
FROM = 6.0  # s, from which on the tip's motion is looked at
SLACK = 1.0  # Pa
FAR = 3e-4  # m; further from the target, a channel at its limit must be said to be
LATENCY = 0.07  # s; lag and dead time of the regulators, for a controller that begins at once
CONNECTED = 0.5  # s until the tracker's rate is known
SETTLE_FIRST = 6.0  # s at the beginning of a path before it is followed


@dataclass(frozen=True)
class Step:
    """What a step to a target was worth; SI units.

    Attributes
    ----------
    seed, dynamics, controller, number, kind : which one.
    distance : of the targets.
    settling : until the tip stays within 1 mm; infinite if it does not.
    ideal : see `Aim`.
    steady : mean error at the end.
    swing : largest distance from the mean place at the end.
    motion : largest distance between two places (along an axis) from 6 s on.
    overshoot : how far the tip went beyond the target along the step.
    unstable : whether it swings and does not calm down, or goes far away.
    at_limit : share of ticks with a channel at a limit.
    unsaid : ticks at the end, away from the target, at a limit without a word.
    unsound : ticks without an answer, or in which the loop does not steer.
    broken : ticks in which a command broke limits or slew.
    kept, kept_by_arm : share of the stiffness that can be chosen, by the true model and by the
        simulated arm itself.
    stiffness : least, present and most, in N/m.
    tick_time : median of a tick, devices and plans included.
    """

    seed: int
    dynamics: str
    controller: str
    number: int
    kind: str
    distance: float
    settling: float
    ideal: float
    steady: float
    swing: float
    motion: float
    overshoot: float
    unstable: bool
    at_limit: float
    unsaid: int
    unsound: int
    broken: int
    kept: float
    kept_by_arm: float
    stiffness: tuple[float, float, float]
    tick_time: float


@dataclass(frozen=True)
class Follow:
    """What following a figure-eight was worth: RMS errors in m.

    Attributes
    ----------
    seed, dynamics, controller : which one.
    plain : error at the time.
    known : against where it should have been by its known delay before: that of the beginning of a
        trajectory, or `LATENCY`.
    best, latency : against where it should have been by that time before, which is the best time.
    """

    seed: int
    dynamics: str
    controller: str
    plain: float
    known: float
    best: float
    latency: float


@dataclass(frozen=True)
class Trace:
    """What happened in each tick: times (T,), tips (T, 3), commands (T, n) and the like."""

    times: Array
    tips: Array
    commands: Array
    pressures: Array
    saturated: NDArray[np.bool_]
    sound: NDArray[np.bool_]
    took: Array


class Run:
    """A controller at a rig, tick by tick, with nothing between it and the supply.

    `point` is what is looked at, a frame (4, 4) in that of the tip.
    """

    def __init__(self, rig: SimulatedRig, controller: Controller, point: Array) -> None:
        self.rig, self._controller, self._point = rig, controller, point

    def start(self) -> None:
        """Connect and arm."""
        rig = self.rig
        rig.open()
        self._controller.check()
        rig.clock.sleep(CONNECTED)
        rig.supply.arm()
        self._reading = rig.supply.read()
        self._count = round(rig.clock.now() / PERIOD)
        self._controller.begin(rig.clock.now())

    def tip(self) -> Array:
        """Where that point is (3,)."""
        return np.array((self.rig.world.plant.tip_pose() @ self._point)[:3, 3])

    def set_task(self, task: Task) -> None:
        """Pursue a task."""
        self._controller.set_task(task)

    def follow(self, trajectory: Trajectory) -> None:
        """Follow a trajectory."""
        self._controller.follow(trajectory, self.rig.clock.now())

    def delay(self) -> float:
        """By how much a trajectory is known to be late, in s."""
        return float(getattr(self._controller, "trajectory_delay", LATENCY))

    def notices(self) -> tuple[Notice, ...]:
        """What the controller says is wrong."""
        return self._controller.notices()

    def go(self, duration: float) -> Trace:
        """Let the controller steer."""
        rig, rows = self.rig, []
        begin = rig.clock.now()
        for _ in range(round(duration / PERIOD)):
            started = perf_counter()
            saturated, sound = self._tick(rig.clock.now())
            took = perf_counter() - started
            self._count += 1
            rig.clock.sleep_until(self._count * PERIOD)
            rows.append((
                rig.clock.now() - begin, self.tip(), rig.supply.commanded,
                rig.world.pressures.copy(), saturated, sound, took,
            ))  # fmt: skip
        return Trace(*map(np.array, zip(*rows, strict=True)))

    def _tick(self, now: float) -> tuple[NDArray[np.bool_], bool]:
        """Saturated channels, and whether all is well."""
        rig = self.rig
        self._controller.observe(now, rig.supply.commanded, self._reading, rig.tracker.read())
        output = self._controller.compute(now)
        self._reading = rig.supply.exchange(output.pressures)
        return output.saturated, output.valid

    def close(self) -> None:
        """Vent and disconnect."""
        self._controller.close()
        self.rig.close()


def control_loop(rig: SimulatedRig, controller: Controller) -> ControlLoop:
    """Control loop of a simulated rig, with a safety gate in front of its supply."""
    safety = rig.settings.safety
    gate = SafetyGate(
        rig.supply, slew=rig.slew, safety=safety, force_per_pressure=None, clock=rig.clock,
        period=PERIOD,
    )  # fmt: skip
    return ControlLoop(rig, controller, gate, safety=safety, period=PERIOD)


class LoopRun(Run):
    """The same in the control loop, with the safety gate in front of the supply."""

    def __init__(self, rig: SimulatedRig, controller: Controller, point: Array) -> None:
        super().__init__(rig, controller, point)
        self.loop = control_loop(rig, controller)

    def start(self) -> None:
        """Configure and arm."""
        self.loop.configure()
        self._count = round(self.rig.clock.now() / PERIOD)
        for _ in range(round(CONNECTED / PERIOD)):
            self.loop.tick()
            self._count += 1
            self.rig.clock.sleep_until(self._count * PERIOD)
        self.loop.arm()

    def set_task(self, task: Task) -> None:
        """Pursue a task."""
        self.loop.set_task(task)

    def follow(self, trajectory: Trajectory) -> None:
        """Follow a trajectory."""
        self.loop.follow_trajectory(trajectory)

    def _tick(self, now: float) -> tuple[NDArray[np.bool_], bool]:
        self.loop.tick()
        now_is = self.loop.snapshot()
        return now_is.saturated, now_is.state is State.ACTIVE

    def close(self) -> None:
        """Vent and disconnect."""
        self.loop.close()


@contextmanager
def started(case: Case, make: MakeController, dynamics: str, in_loop: bool) -> Iterator[Run]:
    """Context with a controller that steers a rig."""
    rig = case.rig(dynamics)
    controller = make(rig, case.believed, dynamics)
    run = (LoopRun if in_loop else Run)(rig, controller, case.point)
    try:
        run.start()
        yield run
    finally:
        run.close()


def run_case(
    case: Case,
    name: str,
    make: MakeController,
    dynamics: str,
    in_loop: bool = False,
) -> list[Step]:
    """Go from target to target."""
    rng = np.random.default_rng([case.seed, 9])
    steps = []
    with started(case, make, dynamics, in_loop) as run:
        before = run.tip()
        last = np.zeros(case.robot.n_pressures)
        for k, aim in enumerate(case.aims):
            run.set_task(case.task(aim.position, aim.kind))
            trace = run.go(HOLD)
            steps.append(_judged(case, (name, dynamics, k), before, last, trace, rng))
            before, last = aim.position, trace.commands[-1]
    return steps


def _judged(
    case: Case,
    which: tuple[str, str, int],
    before: Array,
    last: Array,
    trace: Trace,
    rng: np.random.Generator,
) -> Step:
    name, dynamics, number = which
    aim = case.aims[number]
    error = np.linalg.norm(trace.tips - aim.position, axis=1)
    end = trace.times > HOLD - LAST
    way = aim.position - before
    along = (trace.tips - aim.position) @ way / np.linalg.norm(way)
    late = trace.tips[trace.times > FROM]
    low, high = np.array(case.robot.pressure_min), np.array(case.robot.pressure_max)
    limits = (trace.commands <= low + SLACK) | (trace.commands >= high - SLACK)
    unsaid = end & (error > FAR) & limits.any(axis=1) & ~trace.saturated.any(axis=1)
    jumps = np.abs(np.diff(np.vstack([last, trace.commands]), axis=0))
    slew = np.array(case.robot.pressure_slew) * PERIOD
    broken = (jumps > slew + SLACK) | (trace.commands < low - SLACK)
    broken |= trace.commands > high + SLACK
    swing = _swing(trace, LATE)
    far = error[trace.times > 1.0].max() > np.linalg.norm(way) + AWAY
    held = trace.pressures[end].mean(axis=0)
    direction = DIRECTIONS[aim.kind]
    choice = case.truth.choice(held, direction, rng)
    here = case.truth.stiffness(held, direction)
    return Step(
        seed=case.seed,
        dynamics=dynamics,
        controller=name,
        number=number,
        kind=aim.kind,
        distance=float(np.linalg.norm(way)),
        settling=settling_time(trace.times, error, STAYS),
        ideal=aim.ideal,
        steady=float(error[end].mean()),
        swing=swing,
        motion=float(np.ptp(late, axis=0).max()),
        overshoot=float(max(along.max(), 0.0)),
        unstable=bool(far or (swing > SWING and swing > 0.8 * _swing(trace, EARLY))),
        at_limit=float(limits.any(axis=1).mean()),
        unsaid=int(unsaid.sum()),
        unsound=int((~trace.sound).sum()),
        broken=int(broken.any(axis=1).sum()),
        kept=(here - choice.least) / (choice.most - choice.least),
        kept_by_arm=float(np.clip(case.arm().kept(held, direction, choice), -1, 2)),
        stiffness=(choice.least, here, choice.most),
        tick_time=float(np.median(trace.took)),
    )


def _swing(trace: Trace, window: tuple[float, float]) -> float:
    """Largest distance of the tip from its mean in a window of time."""
    tips = trace.tips[(trace.times > window[0]) & (trace.times <= window[1])]
    return float(np.linalg.norm(tips - tips.mean(axis=0), axis=1).max())


def run_path(
    case: Case, path: Path8, name: str, make: MakeController, dynamics: str, in_loop: bool = False
) -> Follow:
    """Go to the beginning of a path and follow it."""
    points: Any = [
        Waypoint(time=time, target=case.target(place))
        for time, place in zip(path.times.tolist(), path.positions, strict=True)
    ]
    with started(case, make, dynamics, in_loop) as run:
        run.set_task(case.task(path.positions[0], "axial"))
        run.go(SETTLE_FIRST)
        known = run.delay()
        run.follow(Trajectory(waypoints=points))
        end = float(path.times[-1])
        trace = run.go(end + known)

    def rms(latency: float) -> float:
        there = (trace.times >= latency) & (trace.times <= end + latency)
        error = trace.tips[there] - path.at(trace.times[there] - latency)
        return float(np.sqrt((error**2).sum(axis=1).mean()))

    latencies = np.arange(0.0, 0.5, 0.01)
    errors = [rms(latency) for latency in latencies]
    best = int(np.argmin(errors))
    return Follow(
        case.seed, dynamics, name, errors[0], rms(known), errors[best], float(latencies[best])
    )
