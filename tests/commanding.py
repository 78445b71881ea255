"""All ways to command an arm and all drivers, for one contract; `test_commanding.py` has the tests.

A `Bench` is a supply whose wire is recorded: every set-point that reaches the device, and when. A
`Way` is somebody who commands it. A new driver is one function in `DRIVERS`, a new way to command
one class in `WAYS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fake_bench import FakeBench
from fake_control import FakeController
from fake_supply import HandClock
from stiffopt.control.loop import ControlLoop
from stiffopt.errors import StiffoptError
from stiffopt.experiments.conductor import Conductor
from stiffopt.model.robot_files import load_description
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.rig.interface import (
    Clock,
    PoseTracker,
    PressureCommand,
    PressureLimits,
    PressureReading,
    PressureSupply,
    RawPose,
    Rig,
)
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import Applied, SafetyGate
from stiffopt.safety.goal import GoalFollower, GoalSupply, TickingClock
from stiffopt.safety.guard import Guard
from stiffopt.safety.messages import CommandFrame, GuardAnswer, GuardRequest, Message

Array = NDArray[np.float64]

N = 3
PERIOD = 0.01
ROBOT = load_description("stiff-flop-1")
AREAS = np.array(ROBOT.channel_areas)
ROBOT_HIGH = 1.5e5


@dataclass(frozen=True)
class Limits:
    """What holds for an arm, and by whom it is set.

    Attributes
    ----------
    high : what no channel may exceed (n,), in Pa.
    channel, register, safety : highest pressures by driver settings, hardware and rig file.
    task : highest pressure of the task that the control loop pursues; others have none.
    slew : in Pa/s.
    force : in N.
    """

    channel: float | None = None
    register: float | None = None
    safety: float | None = None
    task: float | None = None
    slew: float = 5e5
    force: float | None = None

    @property
    def high(self) -> float:
        given = (ROBOT_HIGH, self.channel, self.register, self.safety, self.task)
        return min(value for value in given if value is not None)


LIMITS = {
    "robot": Limits(),
    "channel": Limits(channel=0.5e5),
    "supply": Limits(register=0.8e5),
    "safety": Limits(safety=0.7e5),
    "slew": Limits(slew=1e4),
    "force": Limits(force=2.0),
    "task": Limits(task=0.6e5),
    "all": Limits(channel=1.1e5, register=1.2e5, safety=1.3e5, slew=1e5, force=6.0),
}


@dataclass
class Bench:
    """A supply, its clock, and what was on its wire.

    Attributes
    ----------
    wire : moment, channel and pressure of all that reached the device.
    tolerance : of a set-point on the wire, in Pa.
    """

    supply: PressureSupply
    clock: Clock
    limits: Limits
    tolerance: float
    safety: Safety
    wire: list[tuple[float, int, float]] = field(default_factory=list)

    def gate(self) -> SafetyGate:
        return SafetyGate(
            self.supply,
            slew=self.limits.slew,
            safety=self.safety,
            force_per_pressure=AREAS,
            clock=self.clock,
            period=PERIOD,
        )

    @property
    def last(self) -> Array:
        now = np.zeros(N)
        for _, channel, pressure in self.wire:
            now[channel] = pressure
        return now

    def check(self) -> None:
        """Hold the whole wire against the limits."""
        slack = self.tolerance
        now, since = np.zeros(N), np.full(N, self.wire[0][0] if self.wire else 0.0)
        for moment, channel, pressure in self.wire:
            assert -slack <= pressure <= self.limits.high + 1e-6, (moment, channel, pressure)
            step, passed = abs(pressure - now[channel]), moment - since[channel]
            if pressure > slack:  # venting is at once
                most = self.limits.slew * min(passed, 3 * PERIOD) + 2 * slack
                assert step <= most, (moment, channel, now[channel], pressure)
            now[channel], since[channel] = pressure, moment
        if self.limits.force is not None:
            for _, pressures in self.moments():
                force = float(AREAS @ pressures)
                assert force <= self.limits.force + 2 * slack * AREAS.sum(), pressures

    def moments(self) -> Iterator[tuple[float, Array]]:
        """Yield what all channels have at the end of each moment."""
        now = np.zeros(N)
        for index, (moment, channel, pressure) in enumerate(self.wire):
            now[channel] = pressure
            if index + 1 == len(self.wire) or self.wire[index + 1][0] > moment:
                yield moment, now.copy()


# drivers -----------------------------------------------------------------------------------------


class RecordingBench(FakeBench):
    """A bench behind the virtual lab's peers that writes down what comes, and when."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(N)
        self.clock = clock
        self.wire: list[tuple[float, int, float]] = []

    def command(self, channel: int, pressure: float) -> None:
        super().command(channel, pressure)
        self.wire.append((self.clock.now(), channel, pressure))


def _safety(limits: Limits) -> Safety:
    return Safety(max_pressure=limits.safety, max_force=limits.force, unprotected_supply="accepted")


def _robot_limits() -> PressureLimits:
    return PressureLimits(np.zeros(N), np.full(N, ROBOT_HIGH))


def _channel(limits: Limits, **rest: Any) -> dict[str, Any]:
    return rest if limits.channel is None else {**rest, "max": limits.channel}


@contextmanager
def modbus(limits: Limits, table: str = "input") -> Iterator[Bench]:
    from stiffopt.lab.modbus_peer import ModbusPeer
    from stiffopt.rig.drivers.modbus import ModbusSettings

    clock = HandClock()
    reach = limits.register or 10e5
    settings = ModbusSettings(
        driver="modbus",
        tcp={"host": "127.0.0.1", "port": 0},
        timeout=5.0,
        scale={"counts": [0, 32767], "pressure": [0.0, reach]},
        channels=[_channel(limits, setpoint=2048 + i, reading=i) for i in range(N)],
        table=table,
        dump_valve={"coil": 5} if table == "holding" else None,
    )
    behind = RecordingBench(clock)
    peer = ModbusPeer(settings, behind)
    try:
        supply = peer.start().device(_robot_limits(), clock)
        yield Bench(supply, clock, limits, reach / 32767, _safety(limits), behind.wire)
    finally:
        peer.close()


@contextmanager
def nidaq(limits: Limits) -> Iterator[Bench]:
    from stiffopt.lab.nidaq_peer import NidaqPeer
    from stiffopt.rig.drivers.nidaq import NidaqSettings

    clock = HandClock()
    reach = limits.register or 3e5
    settings = NidaqSettings(
        driver="nidaq",
        timeout=5.0,
        channels=[
            _channel(
                limits,
                output={"channel": f"Dev2/ao{i}", "pressures": [0.0, reach]},
                input={"channel": f"Dev1/ai{i}", "pressures": [0.0, 4e5]},
            )
            for i in range(N)
        ],
    )
    behind = RecordingBench(clock)
    peer = NidaqPeer(settings, behind)
    try:
        supply = peer.start().device(_robot_limits(), clock)
        yield Bench(supply, clock, limits, 1e-3, _safety(limits), behind.wire)
    finally:
        peer.close()


@contextmanager
def open_regulator(limits: Limits) -> Iterator[Bench]:
    """The firmware's own logic on this machine, in a loop with pneumatics, on the bench's clock."""
    from firmware_loop import LoopPort, logic
    from stiffopt.rig.drivers.open_regulator import OpenRegulatorSettings, OpenRegulatorSupply
    from stiffopt.rig.drivers.open_regulator_line import BoardLine

    clock = HandClock()
    bounds = [high for high in (limits.channel, limits.register) if high is not None]
    channel: dict[str, Any] = {"max": min(bounds)} if bounds else {}
    channels = [{"output": k + 1, **channel} for k in range(N)]
    port = LoopPort(logic(), clock)

    class Line(BoardLine):
        def _port(self) -> Any:
            return port

    class Supply(OpenRegulatorSupply):
        def _new_line(self) -> BoardLine:
            return Line("loop", 500_000, 1, 5.0)

    settings = OpenRegulatorSettings(port="loop", startup=0.1, channels=channels)
    supply = Supply(settings, settings.limits_within(_robot_limits()), clock)
    yield Bench(supply, clock, limits, 10.0, _safety(limits), port.wire)


@contextmanager
def simulated(limits: Limits) -> Iterator[Bench]:
    from stiffopt.rig.assembly import make_rig
    from stiffopt.rig.config import RigDescription

    high = min(x for x in (limits.safety, limits.channel, limits.register, ROBOT_HIGH) if x)
    coarse = {"bending_degree": 1, "shear_degree": 0, "sub_intervals": 3, "step": PERIOD}
    description = RigDescription(
        robot="stiff-flop-1",
        supply={"driver": "simulated", "resolution": 0.0},
        safety={"max_pressure": high},  # it has no channels and no registers of its own
        plant={"dynamics": "quasi-static", "discretisation": coarse},
    )
    rig: Any = make_rig(description, ROBOT)
    wire: list[tuple[float, int, float]] = []
    told = rig.world.command

    def command(pressures: ArrayLike) -> None:
        p = np.array(pressures, dtype=float)
        wire.extend((rig.world.time, channel, float(p[channel])) for channel in range(N))
        told(p)

    rig.world.command = command
    yield Bench(rig.supply, rig.clock, limits, 1e-6, _safety(limits), wire)


@contextmanager
def third_party(limits: Limits) -> Iterator[Bench]:
    import third_party
    from stiffopt.rig.registry import load

    clock = HandClock()
    channel = _channel(limits, full_scale=limits.register or 9e5)
    settings = third_party.careless(watchdog=None, timeout=5.0, channels=[channel] * N)
    behind = RecordingBench(clock)
    peer = load(settings.peer)(settings, behind)
    try:
        supply = peer.start().device(_robot_limits(), clock)
        yield Bench(supply, clock, limits, 1.0, _safety(limits), behind.wire)
    finally:
        peer.close()


DRIVERS: dict[str, Callable[[Limits], AbstractContextManager[Bench]]] = {
    "simulated": simulated,
    "modbus": modbus,
    "modbus-at-once": lambda limits: modbus(limits, table="holding"),
    "nidaq": nidaq,
    "open-regulator": open_regulator,
    "third-party": third_party,
}


# ways to command ---------------------------------------------------------------------------------


class SeenTip(PoseTracker):
    """A tracker that sees the tip whenever it is asked, not quite at rest."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock=clock)
        self._frame = 0

    def _open(self) -> None: ...
    def _close(self) -> None: ...

    def _poll(self) -> None:
        self._frame += 1
        place = np.array([0.0, 1e-7 * (self._frame % 7), 0.09])
        now = self.clock.now()
        self._deliver(RawPose(now, self._frame, place, np.array([1.0, 0.0, 0.0, 0.0]), now))


class Way:
    """Somebody who commands. `push` asks for pressures, whatever they are, and lets time pass."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.refused: list[str] = []

    def start(self) -> None:
        raise NotImplementedError

    def ask(self, pressures: Any) -> None:
        raise NotImplementedError

    def rest(self, seconds: float) -> None:
        """Command nothing; the process lives."""
        raise NotImplementedError

    def finish(self) -> None:
        raise NotImplementedError

    def push(self, pressures: Any, seconds: float = PERIOD) -> None:
        try:
            self.ask(pressures)
        except StiffoptError as error:
            self.refused.append(str(error))
        self.rest(seconds)


class Script(Way):
    """A program with the rig of `stiffopt.open_rig`, on a simulated clock."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench)
        follower = GoalFollower(bench.gate(), period=PERIOD, ramp_time=1.0, clock=bench.clock)
        self.clock = TickingClock(bench.clock, follower)
        self.supply = GoalSupply(follower, self.clock)
        self.rig = Rig(
            ROBOT,
            self.supply,
            SeenTip(self.clock),
            clock=self.clock,
            slew=bench.limits.slew,
            max_force=bench.limits.force,
        )

    def start(self) -> None:
        self.rig.open()
        self.supply.arm()

    def ask(self, pressures: Any) -> None:
        self.rig.command(pressures, valid_for=0.5)

    def rest(self, seconds: float) -> None:
        self.clock.sleep(seconds)

    def finish(self) -> None:
        self.rig.close()


class Exchanges(Script):
    """The same, that reads with each command."""

    def ask(self, pressures: Any) -> None:
        self.supply.exchange(PressureCommand(pressures, self.clock.now()))


class Experiment(Script):
    """The conductor of the experiments."""

    def start(self) -> None:
        self.rig.open()
        self.conductor = Conductor(self.rig, 1 / PERIOD)
        self.conductor.start()

    def push(self, pressures: Any, seconds: float = PERIOD) -> None:
        begin = self.clock.now()
        while True:
            try:
                self.conductor.tick(pressures)
            except (StiffoptError, ValueError) as error:
                self.refused.append(str(error))
                self.clock.sleep(PERIOD)
            if self.clock.now() >= begin + seconds - 1e-9:
                return


class Wire:
    """A guard's channel, whose other end is here."""

    broken = 0
    closed = False

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.until = clock.now()
        self.coming: list[Message] = []
        self.answers: list[GuardAnswer] = []

    def wake_for(self, descriptors: object) -> None: ...

    def receive(self, wait: float) -> list[Message]:
        come, self.coming = self.coming, []
        if not come:
            now = self.clock.now()
            self.clock.sleep_until(min(now + max(wait, 1e-4), self.until))
        return come

    def send(self, message: Message) -> bool:
        if isinstance(message, GuardAnswer):
            self.answers.append(message)
        return True


class Stream(Way):
    """A client of the guard that sends a stream of commands, as the daemon does."""

    goals = False

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench)
        self.gate, self.clock = bench.gate(), bench.clock
        self.follower = GoalFollower(self.gate, period=PERIOD, ramp_time=1.0, clock=bench.clock)
        self.channel = Wire(bench.clock)
        self.guard = Guard(
            self.gate,
            self.channel,  # type: ignore[arg-type]
            0.05,
            follower=self.follower,
            clock=bench.clock.now,
            pause=bench.clock.sleep,
        )
        self.number = 0

    def request(self, do: str, **about: Any) -> GuardAnswer:
        self.number += 1
        return self.say(GuardRequest(self.number, do, about))

    def say(self, message: Message) -> GuardAnswer:
        self.channel.coming.append(message)
        self.guard.step()
        if self.channel.answers[-1].error:
            self.refused.append(self.channel.answers[-1].error)
        return self.channel.answers[-1]

    def start(self) -> None:
        self.gate.open()
        self.request("arm", told=0, goals=self.goals)

    def ask(self, pressures: Any) -> None:
        self.number += 1
        now = self.clock.now()
        p = np.array(pressures, dtype=float)
        answer = self.say(CommandFrame(self.number, now, now, 0.5, p, self.goals))
        if answer.refused:
            self.refused.append(answer.refused)

    def rest(self, seconds: float) -> None:
        self.channel.until = self.clock.now() + seconds
        while self.clock.now() < self.channel.until - 1e-9:
            self.guard.step()

    def finish(self) -> None:
        self.channel.closed = True  # the process of the client has ended
        self.guard.serve()


class Goals(Stream):
    """A client of the guard that sends goals, as a program on a real rig does."""

    goals = True


class Loop(Stream):
    """The control loop, whose controller wants what it is told to want, behind a guard."""

    def start(self) -> None:
        limits, supply = self.bench.limits, GoalSupply(self.follower, self.clock)
        rig = Rig(ROBOT, supply, SeenTip(self.clock), clock=self.clock, slew=limits.slew)
        self.limits = self.gate.limits
        self.controller = FakeController(N, np.array([0.0, 0.0, 0.09]), rate=1e9, period=PERIOD)
        self.loop = ControlLoop(rig, self.controller, self, safety=self.bench.safety, period=PERIOD)
        self.loop.configure()
        for _ in range(60):
            self.tick()
        self.loop.arm()
        if self.bench.limits.task is not None:
            target = Target(position=(0.0, 0.0, 0.09))
            pressure = PressureRange(max=self.bench.limits.task)
            task = Task(robot="stiff-flop-1", target=target, pressure=pressure)
            self.loop.set_task(task)

    def tick(self) -> None:
        super().rest(PERIOD)
        self.loop.tick()

    def ask(self, pressures: Any) -> None:
        p = np.array(pressures, dtype=float)
        self.controller.override = lambda _: p

    def push(self, pressures: Any, seconds: float = PERIOD) -> None:
        self.ask(pressures)
        for _ in range(max(1, round(seconds / PERIOD))):
            self.tick()

    # the loop's outlet, as `GuardLink` is

    def open(self) -> None:
        self.gate.open()

    def close(self) -> None: ...

    def arm(self) -> None:
        self._done("arm", told=self._trips())

    def restrict(self, high: Array) -> None:
        self._done("restrict", high=high.tolist())

    def vent(self) -> None:
        self._done("vent")

    def read(self) -> PressureReading:
        answer = self._done("read")
        return PressureReading(answer.time, answer.measured)

    def apply(self, command: PressureCommand) -> Applied:
        from stiffopt.errors import GuardTripped

        self.number += 1
        frame = CommandFrame(self.number, command.time, command.time, command.valid_for,
                             np.array(command.pressures))  # fmt: skip
        answer = self.say(frame)
        if answer.tripped:
            raise GuardTripped(answer.tripped)
        reading = PressureReading(answer.time, answer.measured)
        return Applied(answer.commanded, reading, answer.limited, answer.refused,
                       answer.force_limited)  # fmt: skip

    def _trips(self) -> int:
        return self.channel.answers[-1].trips if self.channel.answers else 0

    def _done(self, do: str, **about: Any) -> GuardAnswer:
        from stiffopt.errors import DeviceError

        answer = self.request(do, **about)
        if answer.error:
            raise DeviceError(answer.error)
        return answer


WAYS: dict[str, type[Way]] = {
    "script": Script,
    "script-exchange": Exchanges,
    "experiment": Experiment,
    "guard-stream": Stream,
    "guard-goals": Goals,
    "control-loop": Loop,
}
