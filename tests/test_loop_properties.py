"""A million random ticks: nothing that may harm the arm ever reaches the supply."""

from __future__ import annotations

import contextlib
import math
import random
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
from numpy.typing import ArrayLike, NDArray

from conftest import is_long
from fake_control import FakeController
from fake_supply import HandClock
from stiffopt.control.interface import ControlOutput, Notice, SampleCounts
from stiffopt.control.loop import ControlLoop
from stiffopt.control.state import ControllerStatus, State
from stiffopt.errors import CommandError, DeviceError, InputError
from stiffopt.model.robot_files import load_description
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.paths.trajectory import Trajectory, Waypoint
from stiffopt.rig.interface import (
    Clock,
    PoseSample,
    PoseTracker,
    PressureLimits,
    PressureReading,
    PressureSupply,
    Rig,
)
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import SafetyGate

Array = NDArray[np.float64]

ROBOT = load_description("stiff-flop-1")
N = ROBOT.n_pressures
PERIOD = 0.01
VENTED_TIP = np.array([0.0, 0.0, ROBOT.length])
HIGH = np.array([1.5e5, 1.2e5, 1.0e5])
SLEW = np.array([5e5, 2e5, 8e5])
AREAS = np.array(ROBOT.channel_areas)
FORCE = 0.7 * float(AREAS @ HIGH)
SLACK = 1e-6  # Pa, for rounding


class Recorder(PressureSupply):
    """Writes down what it is told, and judges it: no check of a real supply is in the way."""

    endpoints = ()  # nothing that others could command too
    has_watchdog = True

    def __init__(self, clock: Clock, chance: random.Random, low: float) -> None:
        super().__init__(PressureLimits(np.full(N, low), HIGH), clock)
        self.chance = chance
        self.lowest = np.minimum(self.limits.low, 0.0)
        self.jumps = low > 0
        self.trouble = 0.0  # probability
        self.kind: int | None = None  # of all trouble; None: now this, now that
        self.after = False  # whether it fails after it did what it was told
        self.garbage = 0.0
        self.pinned: tuple[int, float] | None = None  # a channel that leaks or is stuck
        self.set_points = np.zeros(N)
        self.at = clock.now()
        self.pressures = np.zeros(N)
        self.read_at = clock.now()
        self.writes = self.vents = 0
        self.violations: list[str] = []  # an exception would be one more fault to the loop
        self.highest = np.zeros(N)
        self.vented = True

    def _open(self) -> None: ...
    def _close(self) -> None: ...
    def _read(self) -> ArrayLike:
        return self.pressures

    def open(self) -> None:
        self._is_open = True

    def close(self) -> None:
        self._is_open = False

    def _fail(self) -> None:
        if self.trouble and self.chance.random() < self.trouble:
            kind = self.chance.randrange(3) if self.kind is None else self.kind
            if kind == 2:
                raise OSError("gone")
            if kind == 1:
                raise DeviceError("no answer")
            self.after = True

    def _write(self, pressures: Array) -> None:
        now = self.clock.now()
        # what is not finite is not within the limits either
        if pressures.any():
            if not self._armed:
                self.violations.append("pressure though it is vented")
            reach = SLEW * min(now - self.at, 3 * PERIOD)
            high = np.minimum(self.set_points + reach, HIGH)
            if self.jumps:  # there is nothing between 0 and the low limit
                high = np.where(self.set_points == 0, np.maximum(high, self.limits.low), high)
            within = (pressures <= high + SLACK) & (pressures >= self.lowest - SLACK)
            if not within.all():
                self.violations.append(f"{pressures} after {self.set_points}, {now - self.at} s")
            force = float(AREAS @ np.maximum(pressures, 0))
            if not force <= FORCE * (1 + 1e-9):
                self.violations.append(f"{pressures}: {force} N")
            self.highest = np.maximum(self.highest, pressures)
            self.vented = False
        self.set_points, self.at = pressures.copy(), now
        self._commanded = self.set_points
        self.writes += 1

    def _settle(self) -> None:
        """Let the pressures follow, as regulators do."""
        now = self.clock.now()
        share = 1 - math.exp(-(now - self.read_at) / 0.06)
        self.pressures = self.pressures + share * (self.set_points - self.pressures)
        if self.pinned is not None:
            self.pressures[self.pinned[0]] = self.pinned[1]
        self.read_at = now

    def exchange(self, pressures: ArrayLike) -> PressureReading:  # type: ignore[override]
        self._settle()
        self._fail()
        self._write(np.asarray(pressures))
        return self._answer()

    def _answer(self) -> PressureReading:
        if self.after:
            self.after = False
            raise DeviceError("no answer after it was written")
        p = self.pressures
        if self.garbage and self.chance.random() < self.garbage:
            p = p.copy()
            p[self.chance.randrange(N)] = self.chance.choice(
                [math.nan, math.inf, 9.9e9, -9.9e9, 0.0, 1.4e5]
            )
            if self.chance.random() < 0.1:
                return None  # type: ignore[return-value]
            if self.chance.random() < 0.1:
                p = p[:2]
        return PressureReading(self.clock.now(), p)

    def read(self) -> PressureReading:
        self._settle()
        self._fail()
        return self._answer()

    def vent(self) -> None:
        self._armed = False
        self._settle()
        self._fail()
        self._write(np.zeros(N))
        self.vents += 1
        self.vented = True
        if self.after:
            self.after = False
            raise DeviceError("no answer after it was vented")

    def arm(self) -> None:
        self._fail()
        self._write(np.zeros(N))
        self._armed = True
        self._answer()


class Sometimes(PoseTracker):
    """Sees the tip of the vented arm, more or less."""

    def __init__(self, clock: Clock, chance: random.Random) -> None:
        super().__init__(None, clock)
        self.chance = chance
        self.mode = "good"
        self.number = 0
        self.next = clock.now()

    def _open(self) -> None: ...
    def _close(self) -> None: ...

    def read(self) -> tuple[PoseSample, ...]:
        now = self.clock.now()
        if now < self.next or self.mode == "silent":
            return ()
        if self.mode == "broken":
            raise DeviceError("the tracker does not answer")
        self.next = now + 0.025
        chance, position, captured = self.chance, VENTED_TIP, now - 0.02
        self.number += self.mode != "frozen"
        if self.mode == "nan":
            position = np.full(3, np.nan)
        elif self.mode == "jumps":
            position = position + chance.gauss(0, 0.1)
        elif self.mode == "times":
            captured = chance.choice([now - 0.5, now + 5.0, math.nan, now - 0.02])
        return (PoseSample(captured, now, self.number, position, None),)


class Whim:
    """A controller that wants anything."""

    def __init__(self, chance: random.Random) -> None:
        self.chance = chance
        self.wild = 0.0
        self.base = np.zeros(N)
        self.latest = -math.inf
        self.unsaturated = np.zeros(N, dtype=bool)
        self.nowhere = FakeController(N, VENTED_TIP).status(0.0)

    def _fail(self) -> None:
        if self.wild and self.chance.random() < 0.02 * self.wild:
            raise self.chance.choice([RuntimeError, ValueError, InputError, MemoryError])("oh")

    def check(self) -> None:
        self._fail()

    def begin(self, now: float) -> None:
        self._fail()
        self.latest = -math.inf

    def set_task(self, task: Task) -> None:
        self._fail()
        self._want()

    def set_target(self, target: Target) -> None:
        self._fail()
        self._want()

    def follow(self, trajectory: Trajectory, now: float) -> None:
        self._fail()
        self._want()

    def _want(self) -> None:
        self.base = HIGH * [self.chance.random() for _ in range(N)]

    def check_ahead(self, request: Task | Target | Trajectory) -> None:
        self._fail()

    def resume(self, now: float) -> None:
        self._fail()

    def observe(
        self, now: float, commanded: Array, reading: PressureReading, samples: Sequence[PoseSample]
    ) -> SampleCounts:
        self._fail()
        used = rejected = 0
        for sample in samples:
            if not sample.visible:
                continue
            if abs(sample.position[0]) > 0.02:
                rejected += 1
            else:
                used += 1
                if sample.time > self.latest:
                    self.latest = sample.time
        return SampleCounts(used, rejected, self.latest)

    def compute(self, now: float) -> ControlOutput:
        chance, p, sound = self.chance, self.base, True
        if chance.random() < 0.02:
            self._want()
        if self.wild and chance.random() < self.wild:
            self._fail()
            p = p.copy()
            kind, channel = chance.randrange(7), chance.randrange(N)
            if kind == 0:
                p[channel] = chance.choice([math.nan, math.inf, -math.inf])
            elif kind == 1:
                p[channel] = HIGH[channel] * (1 + 0.01 * chance.gauss(0, 1))
            elif kind == 2:
                p = p[:2]
            elif kind == 3:
                sound = False
            elif kind == 4:
                p[:] = HIGH
            elif kind == 5:
                p = chance.choice([None, "high", [1e5] * N, np.array([True] * N)])  # type: ignore[assignment]
            else:
                p = p * chance.uniform(-1e3, 1e3)
        return ControlOutput(p, sound, self.unsaturated)

    def stop(self, now: float) -> Array | None:
        kind = self.chance.randrange(4) if self.wild else 0
        if kind == 1:
            self._fail()
        return (None, None, self.base, np.full(2, math.nan))[kind]

    def status(self, now: float) -> ControllerStatus:
        self._fail()
        return self.nowhere

    def notices(self) -> tuple[Notice, ...]:
        if self.wild and self.chance.random() < 0.1 * self.wild:
            return (Notice("planner", "it died", standing=True),)
        return ()

    def close(self) -> None: ...


TASK = Task(robot="stiff-flop-1", target=Target(position=(0.0, 0.0, 0.1)))
TOO_HIGH = TASK.model_copy(update={"pressure": PressureRange(max=9e5)})
NOT_FINITE = Target.model_construct(position=(math.nan, 0.0, 0.1))
WAY = Trajectory(waypoints=(Waypoint(time=0.0, target=TASK.target),))


class World:
    """A loop among devices, clients and a clock that do anything."""

    def __init__(self, seed: int, low: float = 0.0) -> None:
        self.chance = chance = random.Random(seed)
        self.clock = HandClock(1000.0)
        self.supply = Recorder(self.clock, chance, low)
        self.tracker = Sometimes(self.clock, chance)
        self.controller = Whim(chance)
        safety = Safety(max_force=FORCE, ramp_time=0.2, max_pressure=tuple(HIGH))
        pressure = ROBOT.pressure.model_copy(update={"min": low})
        robot = ROBOT.model_copy(update={"pressure": pressure})
        self.rig = Rig(robot, self.supply, self.tracker, clock=self.clock, slew=SLEW)
        self.gate = SafetyGate(
            self.supply,
            slew=SLEW,
            safety=safety,
            force_per_pressure=AREAS,
            clock=self.clock,
            period=PERIOD,
        )
        self.loop = ControlLoop(self.rig, self.controller, self.gate, safety=safety, period=PERIOD)
        self.clear_after = 0
        self.faults = self.unvented = 0
        self.states = dict.fromkeys(State, 0)
        self.before = State.UNCONFIGURED

    def tick(self, wait: float = PERIOD) -> None:
        self.clock.t += wait
        self.loop.tick()
        self.judge()

    def judge(self) -> None:
        assert not self.supply.violations
        state = self.loop.snapshot().state
        self.states[state] += 1
        if state is State.FAULT:
            if self.before is not State.FAULT:
                self.faults += 1
            # vented, or it would not let itself be vented, and nothing but that was written
            if not self.supply.vented:
                self.unvented += 1
                assert self.supply.trouble, "in fault, not vented, though the supply works"
        elif state is State.INACTIVE:
            assert self.supply.vented
            assert not self.supply.set_points.any()
        self.before = state

    def ask(self) -> None:
        """Let a client ask for something, mostly what is of use now."""
        loop, chance = self.loop, self.chance
        state = loop.snapshot().state
        useful = {
            State.UNCONFIGURED: [loop.configure],
            State.INACTIVE: [loop.arm],
            State.ACTIVE: [lambda: loop.set_task(TASK), lambda: loop.set_target(TASK.target)],
            State.HOLDING: [lambda: loop.set_task(TASK)],
            State.FAULT: [loop.reset],
        }[state]
        anything = [
            loop.configure,
            loop.arm,
            loop.disarm,
            loop.hold,
            loop.vent,
            loop.reset,
            lambda: loop.set_task(TASK),
            lambda: loop.set_task(TOO_HIGH),
            lambda: loop.set_task(None),  # type: ignore[arg-type]
            lambda: loop.set_target(NOT_FINITE),
            lambda: loop.follow_trajectory(WAY),
            lambda: self.gate.expire(self.clock.now()),
            self.gate.vent,
        ]
        with contextlib.suppress(InputError, DeviceError, OSError):  # the gate's, without a loop
            chance.choice(useful if chance.random() < 0.9 else anything)()
        self.judge()

    def disturb(self) -> None:
        """Begin some trouble that ends by itself, or end all."""
        chance, kind = self.chance, self.chance.randrange(9)
        if kind == 0:
            self.supply.trouble = chance.choice([0.05, 1.0])
            self.supply.kind = chance.choice([None, 0, 1, 2])
        elif kind == 1:
            self.supply.garbage = chance.choice([0.01, 0.3, 1.0])
        elif kind in (2, 3):
            self.tracker.mode = chance.choice(
                ["silent", "nan", "jumps", "frozen", "times", "broken"]
            )
        elif kind in (4, 5):
            self.controller.wild = chance.choice([0.1, 1.0])
        elif kind == 6:
            self.supply.pinned = chance.randrange(N), chance.choice([0.0, 1e5])
        self.clear_after = chance.choice([2, 10, 60, 200])

    def calm(self) -> None:
        self.supply.trouble = self.supply.garbage = self.controller.wild = 0.0
        self.supply.pinned = None
        self.tracker.mode = "good"

    def live(self, ticks: int) -> None:
        chance = self.chance
        for _ in range(ticks):
            luck = chance.random()
            wait = PERIOD
            if luck < 0.0003:
                wait = chance.choice([0.7, 5.0, 3600.0])
            elif luck < 0.03:
                wait = chance.choice([0.0, 1e-6, 0.003, 0.02, 0.1, 0.4])
            elif luck < 0.07:
                self.ask()
            elif luck < 0.073:
                self.disturb()
            elif self.clear_after > 0:
                self.clear_after -= 1
                if not self.clear_after:
                    self.calm()
            self.tick(wait)

    def settle(self) -> None:
        """End all trouble: whatever has gone wrong must be vented then."""
        self.calm()
        for _ in range(3):
            self.tick()
        if self.loop.snapshot().state is State.FAULT:
            assert self.supply.vented
            assert not self.supply.set_points.any()


@pytest.mark.parametrize(
    ("seed", "low"),
    [(1, 0.0), pytest.param(2, 0.0, marks=pytest.mark.long), (3, 2e4), (4, -3e4)],
)
def test_random_ticks(seed: int, low: float) -> None:
    """Long, these are a million ticks. `Recorder` judges every write, `World.judge` every state."""
    world = World(seed, low)
    parts = 10 if is_long() else 1
    for _ in range(parts):
        world.live(25_000)
        world.settle()
    ticks = sum(world.states.values())
    assert ticks >= 25_000 * parts
    # it was no quiet time, and not spent in fault alone
    assert world.faults > 30 * parts
    assert world.states[State.ACTIVE] > 0.2 * ticks
    assert min(world.states[s] for s in State if s is not State.UNCONFIGURED) > 0.01 * ticks
    assert world.unvented > 0 or not is_long()
    assert (world.supply.highest > (0.98 if is_long() else 0.9) * HIGH).all()


class LoopMachine(RuleBasedStateMachine):
    """The same, with small cases that Hypothesis makes smaller where one fails."""

    def __init__(self) -> None:
        super().__init__()
        self.world = World(0)
        self.world.loop.configure()
        for _ in range(40):
            self.world.tick()
        self.world.loop.arm()

    @rule(wait=st.sampled_from([0.0, 1e-9, 0.003, PERIOD, 0.05, 0.3, 0.6, 1e4]))
    def pause(self, wait: float) -> None:
        self.world.tick(wait)

    @rule(ticks=st.integers(1, 20))
    def go_on(self, ticks: int) -> None:
        for _ in range(ticks):
            self.world.tick()

    @rule(p=st.lists(st.floats(-1e6, 1e6) | st.just(math.nan), min_size=N, max_size=N))
    def want(self, p: list[float]) -> None:
        self.world.controller.base = np.array(p)

    @rule()
    def want_all(self) -> None:
        self.world.controller.base = HIGH.copy()

    @rule(trouble=st.sampled_from([0.0, 0.5, 1.0]), garbage=st.sampled_from([0.0, 1.0]))
    def disturb_the_supply(self, trouble: float, garbage: float) -> None:
        self.world.supply.trouble, self.world.supply.garbage = trouble, garbage

    @rule(mode=st.sampled_from(["good", "silent", "nan", "jumps", "frozen", "times", "broken"]))
    def disturb_the_tracker(self, mode: str) -> None:
        self.world.tracker.mode = mode

    @rule(
        name=st.sampled_from(["configure", "arm", "disarm", "hold", "vent", "reset"]),
    )
    def ask(self, name: str) -> None:
        with contextlib.suppress(InputError):
            getattr(self.world.loop, name)()
        self.world.judge()

    @rule()
    def set_a_task(self) -> None:
        with contextlib.suppress(CommandError):
            self.world.loop.set_task(TASK)

    @invariant()
    def nothing_harmful_was_written(self) -> None:
        self.world.judge()

    def teardown(self) -> None:
        self.world.settle()


LoopMachine.TestCase.settings = settings(
    max_examples=25,
    stateful_step_count=30,
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
)
test_any_course_of_events = LoopMachine.TestCase
