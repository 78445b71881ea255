"""A follower of goals over a gate and a fake supply, on a clock that is moved by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fake_supply import SLEW, FakeSupply, HandClock
from stiffopt.rig.interface import PressureCommand
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import SafetyGate
from stiffopt.safety.goal import GoalFollower, GoalSupply, TickingClock

Array = NDArray[np.float64]
PERIOD = 0.01
RAMP = 0.5


class Bench:
    """A follower over a gate and a fake supply, and how programs see it."""

    def __init__(self, low: ArrayLike = 0.0, **safety: Any) -> None:
        self.hand = HandClock()
        self.device = FakeSupply(self.hand, low)
        self.gate = SafetyGate(
            self.device,
            slew=safety.pop("slew", SLEW),
            safety=Safety(**safety),
            force_per_pressure=None,
            clock=self.hand,
            period=PERIOD,
        )
        self.follower = GoalFollower(self.gate, period=PERIOD, ramp_time=RAMP, clock=self.hand)
        self.clock = TickingClock(self.hand, self.follower)
        self.supply = GoalSupply(self.follower, self.clock)
        self.supply.open()

    def armed(self) -> Bench:
        self.supply.arm()
        return self

    def pressed(self, *p: float, valid_for: float = 100.0) -> Bench:
        """Armed, and arrived at a goal."""
        self.armed().goal(*p, valid_for=valid_for)
        self.clock.sleep(3.0)
        np.testing.assert_array_equal(self.device.commanded, p)
        return self

    def goal(self, *p: float, valid_for: float = 100.0, age: float = 0.0) -> None:
        self.supply.command(PressureCommand(np.array(p), self.clock.now() - age, valid_for))

    def vented(self) -> bool:
        told = not self.device.commanded.any() and not self.supply.commanded.any()
        return told and not self.device.armed and not self.supply.armed

    def steps(self, seconds: float) -> list[tuple[float, Array]]:
        """Let time pass, and return when the set-points were written, and which."""
        told: list[tuple[float, Array]] = []
        end = self.hand.t + seconds
        while self.hand.t < end - 1e-9:
            before = len(self.device.written)
            self.clock.sleep_until(min(end, max(self.hand.t, self.follower.due) + 1e-9))
            told += [(self.hand.t, written) for written in self.device.written[before:]]
            if self.follower.due > end:
                break
        self.clock.sleep_until(end)
        return told
