"""A control loop that does nothing but remember what it was asked to do."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from stiffopt.control.checks import check_task
from stiffopt.control.state import Event, Severity, Snapshot, State
from stiffopt.rig.interface import Clock, PressureLimits

N = 6


class ManualClock(Clock):
    """Time that stands still until a test moves it."""

    def __init__(self, time: float = 100.0) -> None:
        self.time = time

    def now(self) -> float:
        return self.time

    def sleep_until(self, moment: float) -> None:
        self.time = max(self.time, moment)


class FakeEvents:
    def __init__(self) -> None:
        self.all = [
            Event(1.0, "armed", "the arm is armed"),
            Event(2.5, "tracker-missing", "no tip \ud800 seen", Severity.WARNING),
        ]

    def since(self, index: int) -> tuple[list[Event], int]:
        return self.all[index:], len(self.all)


class FakeLoop:
    """Records commands in `calls`; `refusal` is raised instead, `gate` keeps them waiting."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, Any]] = []
        self.refusal: Exception | None = None
        self.gate: Callable[[str], None] = lambda name: None
        self.events = FakeEvents()
        self.lock = threading.Lock()
        unknown = np.full(3, np.nan)
        self.now = Snapshot(
            time=12.5,
            state=State.INACTIVE,
            reason="",
            commanded=np.zeros(N),
            measured=np.array([1.0, 2.0, np.nan, 4.0, 5.0, 6.0]),
            plan=np.full(N, np.nan),
            low=np.zeros(N),
            high=np.full(N, 1.5e5),
            saturated=np.zeros(N, dtype=bool),
            tip_position=np.array([0.0, 0.01, 0.2]),
            tip_quaternion=np.array([1.0, 0, 0, 0]),
            seen_position=unknown,
            seen_age=float("inf"),
        )

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.calls]

    def snapshot(self) -> Snapshot:
        return self.now

    def arm(self) -> None:
        self._do("arm", State.ACTIVE)

    def disarm(self) -> None:
        self._do("disarm", State.INACTIVE)

    def set_task(self, task: Any) -> None:
        check_task(task, PressureLimits(self.now.low, self.now.high))  # as the real one does
        self._do("set_task", State.ACTIVE, task)

    def set_target(self, target: Any) -> None:
        self._do("set_target", State.ACTIVE, target)

    def follow_trajectory(self, trajectory: Any) -> None:
        self._do("follow_trajectory", State.ACTIVE, trajectory)

    def set_channels(self, without: Any) -> None:
        self._do("set_channels", self.now.state, without)

    def hold(self, reason: str = "asked to", *, lasting: bool = True) -> None:
        self._do("hold", State.HOLDING, reason)

    def vent(self, reason: str = "asked to") -> None:
        self._do("vent", State.INACTIVE, reason)

    def reset(self) -> None:
        self._do("reset", State.INACTIVE)

    def _do(self, name: str, state: State, given: Any = None) -> None:
        self.gate(name)
        with self.lock:
            if self.refusal is not None:
                raise self.refusal
            self.calls.append((name, given))
            self.now = replace(self.now, state=state)
