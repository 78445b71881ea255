"""What stands in for the controller in tests of the loop: it does what a test tells it to."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from stiffopt.control.interface import ControlOutput, Notice, SampleCounts
from stiffopt.control.state import ControllerStatus
from stiffopt.errors import InputError
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.paths.trajectory import Trajectory
from stiffopt.rig.interface import PoseSample, PressureReading

Array = NDArray[np.float64]


class FakeController:
    """Goes to `wanted` at `rate`, believes what moves slower than `speed`, and keeps a diary."""

    def __init__(self, n: int, tip: Array, rate: float = 2e5, period: float = 0.01) -> None:
        self.n, self.tip, self.rate, self.period = n, tip, rate, period
        self.speed = 0.3  # m/s
        self.wanted = np.zeros(n)
        self.p = np.zeros(n)
        self.now = 0.0
        self.valid = True
        self.calls: list[str] = []
        self.seen: list[PoseSample] = []
        self.observed: tuple[float, Array, PressureReading] | None = None
        self.latest: PoseSample | None = None
        self.said: tuple[Notice, ...] = ()
        self.problem = ""
        self.closed = False
        self.override: Callable[[Array], Array] | None = None
        """Makes of the next pressures (n,) what is handed out instead."""
        self.stopping: Callable[[float], Array | None] = lambda now: None
        """Returns the pressures (n,) with which a doubted motion stops."""
        self.accident: Callable[[str], None] = lambda call: None
        """Called with the name of each call before it does anything."""

    def check(self) -> None:
        self.accident("check")
        if self.problem:
            raise InputError(self.problem)

    def begin(self, now: float) -> None:
        self.accident("begin")
        self.calls.append("begin")
        self.p = np.zeros(self.n)
        self.latest = None

    def set_task(self, task: Task) -> None:
        self.accident("set_task")
        self.calls.append("set_task")

    def set_target(self, target: Target) -> None:
        self.accident("set_target")
        self.calls.append("set_target")

    def follow(self, trajectory: Trajectory, now: float) -> None:
        self.accident("follow")
        self.calls.append("follow")

    def set_channels(self, without: Sequence[int]) -> None:
        self.accident("set_channels")
        self.calls.append("set_channels")

    def check_ahead(self, request: Task | Target | Trajectory) -> None:
        self.accident("check_ahead")

    def resume(self, now: float) -> None:
        self.accident("resume")
        self.calls.append("resume")
        assert self.observed is not None
        self.p = self.observed[1].copy()

    def observe(
        self,
        now: float,
        commanded: Array,
        reading: PressureReading,
        samples: Sequence[PoseSample],
    ) -> SampleCounts:
        self.accident("observe")
        self.now, self.observed = now, (now, commanded, reading)
        self.seen.extend(samples)
        used = rejected = 0
        for sample in samples:
            if not sample.visible:
                continue
            before = self.latest
            if before is not None and sample.time > before.time:
                way = np.linalg.norm(sample.position - before.position)
                if way > self.speed * (sample.time - before.time) + 1e-3:
                    rejected += 1
                    continue
            used += 1
            if before is None or sample.time > before.time:
                self.latest = sample
        return SampleCounts(used, rejected, -np.inf if self.latest is None else self.latest.time)

    def compute(self, now: float) -> ControlOutput:
        self.accident("compute")
        step = self.rate * self.period
        self.p = self.p + np.clip(self.wanted - self.p, -step, step)
        p = self.p if self.override is None else self.override(self.p)
        return ControlOutput(p, self.valid, np.zeros(self.n, dtype=bool))

    def stop(self, now: float) -> Array | None:
        self.accident("stop")
        return self.stopping(now)

    def status(self, now: float) -> ControllerStatus:
        self.accident("status")
        return ControllerStatus(
            plan=self.wanted,
            tip_position=self.tip,
            tip_quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
            seen_position=np.full(3, np.nan) if self.latest is None else self.latest.position,
            seen_age=np.inf if self.latest is None else now - self.latest.time,
            disturbance=np.zeros(3),
            wrench=np.zeros(6),
        )

    def notices(self) -> tuple[Notice, ...]:
        self.accident("notices")
        return self.said

    def close(self) -> None:
        self.closed = True


class Hang:
    """An accident: one call of a controller waits until `go_on` is set; `begun` says when."""

    def __init__(self, call: str) -> None:
        self.call = call
        self.begun, self.go_on = threading.Event(), threading.Event()

    def __call__(self, call: str) -> None:
        if call == self.call:
            self.begun.set()
            self.go_on.wait(10)
