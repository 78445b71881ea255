"""A loop on the simulated rig, with a fake controller: what tests of faults begin with."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from fake_control import FakeController
from stiffopt.control.loop import ControlLoop
from stiffopt.control.state import Snapshot, State
from stiffopt.model.robot_files import load_description
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task
from stiffopt.plant.devices import SimulatedRig
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription
from stiffopt.safety.gate import SafetyGate

PERIOD = 0.01
TASK = Task(robot="stiff-flop-1", target=Target(position=(0.0, 0.0, 0.1)))


class Lab:
    """An arm without inertia, its rig and a loop that was armed and does nothing yet."""

    def __init__(self, *, ready: bool = True, **changes: Any) -> None:
        blocks: dict[str, Any] = {
            "robot": "stiff-flop-1",
            "supply": {"driver": "simulated", "dump_valve": True, "watchdog": 0.3},
            "tracker": {"driver": "simulated"},
            "safety": {},
            "commissioning": {},
            "plant": {"dynamics": "quasi-static", "faults": True, "discretisation": STEP},
        }
        for key, value in changes.items():
            blocks[key] = {**blocks[key], **value} if isinstance(value, dict) else value
        description = RigDescription(**blocks)
        robot = load_description("stiff-flop-1")
        self.rig = cast("SimulatedRig", make_rig(description, robot))
        self.world = self.rig.world
        n = robot.n_pressures
        self.controller = FakeController(
            n, self.world.plant.tip_pose()[:3, 3].copy(), period=PERIOD
        )
        self.gate = SafetyGate(
            self.rig.supply,
            slew=self.rig.slew,
            safety=description.safety,
            force_per_pressure=robot.channel_areas,
            clock=self.rig.clock,
            period=PERIOD,
        )
        self.loop = ControlLoop(
            self.rig, self.controller, self.gate, safety=description.safety, period=PERIOD
        )
        if ready:
            self.arm()

    def arm(self) -> None:
        if self.state is State.UNCONFIGURED:
            self.loop.configure()
        self.ticks(60)
        self.loop.arm()

    def under_pressure(self, *pressures: float) -> Lab:
        """Go to pressures and stay there for a while."""
        self.controller.wanted = np.array(pressures or (8e4, 4e4, 0.0))
        self.ticks(150)
        assert self.state is State.ACTIVE
        np.testing.assert_allclose(self.world.pressures, self.controller.wanted, atol=2e3)
        return self

    def tick(self) -> Snapshot:
        self.rig.clock.sleep(PERIOD)
        self.loop.tick()
        return self.loop.snapshot()

    def ticks(self, n: int) -> Snapshot:
        for _ in range(n):
            snapshot = self.tick()
        return snapshot

    def until(self, state: State, within: float = 3.0) -> float:
        """Tick until it is in a state; return how long that took, in s."""
        begin = self.now
        while self.now < begin + within:
            if self.tick().state is state:
                return self.now - begin
        raise AssertionError(f"it is not {state} but {self.state} after {within} s: {self.kinds}")

    @property
    def now(self) -> float:
        return self.rig.clock.now()

    @property
    def state(self) -> State:
        return self.loop.snapshot().state

    @property
    def kinds(self) -> list[str]:
        return [event.kind for event in self.loop.events.since(0)[0]]

    @property
    def alarms(self) -> set[str]:
        return {alarm.kind for alarm in self.loop.snapshot().alarms}

    def is_vented(self) -> bool:
        """Whether nothing is commanded, and after some time nothing is left."""
        self.ticks(60)
        return not self.world.set_point.any() and bool((self.world.pressures < 1e3).all())


STEP = {"bending_degree": 1, "shear_degree": 0, "sub_intervals": 3, "step": 0.002}
"""A coarse arm: what is tested here is not its shape."""
