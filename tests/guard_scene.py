"""What the tests of the guard share: a fake outlet, a fake channel, a clock by hand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stiffopt.rig.interface import PoseSample, PressureCommand, PressureLimits, PressureReading
from stiffopt.safety.gate import Applied
from stiffopt.safety.guard import Guard
from stiffopt.safety.messages import CommandFrame, GuardAnswer, GuardRequest, Message

TIMEOUT = 0.05


class Clock:
    """A time that moves when it is told to."""

    def __init__(self) -> None:
        self.time = 1000.0

    def __call__(self) -> float:
        return self.time


class FakeOutlet:
    """An outlet that remembers; `fail` says what raises, with what."""

    def __init__(self) -> None:
        self.limits = PressureLimits(np.zeros(2), np.full(2, 1e5))
        self.did: list[str] = []
        self.commands: list[PressureCommand] = []
        self.pressures = np.zeros(2)
        self.fail: dict[str, list[BaseException]] = {}
        self.takes = 0.0
        self.clock: Clock | None = None

    def _do(self, what: str) -> None:
        self.did.append(what)
        if self.clock is not None:
            self.clock.time += self.takes
        if self.fail.get(what):
            raise self.fail[what].pop(0)

    def open(self) -> None:
        self._do("open")

    def close(self) -> None:
        self._do("close")

    def arm(self) -> None:
        self._do("arm")

    def vent(self) -> None:
        self._do("vent")
        self.pressures = np.zeros(2)

    def restrict(self, high: Any) -> None:
        self._do(f"restrict {high.tolist()}")

    def apply(self, command: PressureCommand) -> Applied:
        self._do("apply")
        self.commands.append(command)
        self.pressures = command.pressures
        much = bool(command.pressures[0] > 5e4)
        return Applied(self.pressures, self._reading(), limited=much, force_limited=much)

    def read(self) -> PressureReading:
        self._do("read")
        return self._reading()

    def _reading(self) -> PressureReading:
        return PressureReading(7.0, self.pressures + 1.0)


class FakeChannel:
    """A channel whose other end is the test."""

    def __init__(self, clock: Clock) -> None:
        self.closed = False
        self.broken = 0
        self.coming: list[Message] = []
        self.sent: list[Message] = []
        self.waits: list[float] = []
        self.woken_for: list[int] = []
        self._clock = clock

    def wake_for(self, descriptors: Sequence[int]) -> None:
        self.woken_for = list(descriptors)

    def receive(self, wait: float) -> list[Message]:
        self.waits.append(wait)
        if not self.coming:
            self._clock.time += wait
        coming, self.coming = self.coming, []
        return coming

    def send(self, message: Message) -> bool:
        self.sent.append(message)
        return not self.closed

    def close(self) -> None:
        self.closed = True


class Scene:
    """A guard and all around it."""

    def __init__(self, **options: Any) -> None:
        self.clock = Clock()
        self.outlet = FakeOutlet()
        self.outlet.clock = self.clock
        self.channel = FakeChannel(self.clock)
        self.pauses: list[float] = []
        self.guard = Guard(
            self.outlet,
            self.channel,  # type: ignore[arg-type]
            TIMEOUT,
            clock=self.clock,
            pause=self.pauses.append,
            **options,
        )
        self._number = 0

    def request(self, do: str, **about: Any) -> GuardRequest:
        self._number += 1
        return GuardRequest(self._number, do, about)

    def command(self, pressure: float = 2e4, age: float = 0.0) -> CommandFrame:
        self._number += 1
        now = self.clock.time - age
        return CommandFrame(self._number, now, now, 0.1, np.full(2, pressure))

    def step(self, *messages: Message) -> list[GuardAnswer]:
        """Let the guard take messages; return its answers."""
        self.channel.coming += messages
        before = len(self.channel.sent)
        self.guard.step()
        return [m for m in self.channel.sent[before:] if isinstance(m, GuardAnswer)]

    def pressed(self) -> Scene:
        """Armed and under pressure."""
        self.step(self.request("arm"))
        (answer,) = self.step(self.command())
        assert answer.armed
        assert answer.commanded.tolist() == [2e4, 2e4]
        self.outlet.did.clear()
        return self


UNTURNED = np.array([1.0, 0, 0, 0])


def sample(frame: int) -> PoseSample:
    return PoseSample(10.0 + frame, 10.5 + frame, frame, np.full(3, float(frame)), UNTURNED)
