"""Baselines for the closed loop: the model alone, and integral feedback added to it.

Both get the same robot file and goals, and command the stiffest pressures by that file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt import PressureSolver, RobotDescription, Target, Task, load_robot
from stiffopt.control.controller import TipController
from stiffopt.control.interface import Controller, ControlOutput, SampleCounts
from stiffopt.control.state import ControllerStatus
from stiffopt.optimise.tip import TipModel
from stiffopt.paths.trajectory import Trajectory
from stiffopt.rig.interface import PoseSample, PressureReading, Rig

Array = NDArray[np.float64]

PERIOD = 0.01  # s


MakeController = Callable[[Rig, RobotDescription, str], Controller]
"""From a rig, the controller's robot file and the dynamics."""


@dataclass(frozen=True)
class Gains:
    """Of plain integral feedback.

    Attributes
    ----------
    gain : share of the error that is taken away per second; 0 for none.
    slew : of the ramps to new pressures, in Pa/s.
    """

    gain: float
    slew: float


TUNED = {"quasi-static": Gains(4.5, 5e5), "full": Gains(0.4, 1e5)}
"""The best on a grid of gains from 0.1 to 26 and slews from 3e4 to 5e5, on other seeds."""


class IntegralFeedback:
    """Pressures of the model, and ``dp = gain J^+ e dt`` at every frame of the tracker."""

    def __init__(self, rig: Rig, robot: RobotDescription, gains: Gains) -> None:
        self._limits = rig.supply.limits
        self._model = load_robot(robot)
        self._tip = TipModel(self._model)
        self._gains = gains
        self._task: Task | None = None
        self._way: tuple[Array, Array, Array] | None = None
        self.begin(rig.clock.now())

    def check(self) -> None:
        """Nothing to do."""

    def begin(self, now: float) -> None:
        """See `Controller.begin`."""
        n = self._limits.n
        self._commanded, self._added = np.zeros(n), np.zeros(n)
        self._seen = now

    def set_task(self, task: Task) -> None:
        """Go to where the model has the target."""
        self._task, self._added = task, np.zeros(self._limits.n)
        self._follow(np.zeros(1), [task.target])

    def set_target(self, target: Target) -> None:
        """The same with another target."""
        self.set_task(self._task.model_copy(update={"target": target}))

    def follow(self, trajectory: Trajectory, now: float) -> None:
        """Follow the model's pressures for the waypoints; what was added stays."""
        times = now + np.array([point.time for point in trajectory.waypoints])
        self._follow(times, [point.target for point in trajectory.waypoints])

    def _follow(self, times: Array, targets: Sequence[Target]) -> None:
        solver = PressureSolver(self._model, self._task)
        pressures: list[Array] = []
        for target in targets:
            answer = solver.solve(target, guess=pressures[-1] if pressures else None)
            if answer.pressures is not None:  # the nearest, where none reaches it
                pressures.append(np.array(answer.pressures))
            else:
                pressures.append(pressures[-1] if pressures else self._commanded)
        places = np.array([target.position for target in targets])
        self._way = times, np.array(pressures), places

    def _on_way(self, now: float, values: Array) -> Array:
        times = self._way[0]
        return np.array([np.interp(now, times, column) for column in values.T])

    def set_channels(self, without: Sequence[int]) -> None:
        """Not served."""

    def check_ahead(self, request: Any) -> None:
        """Nothing to do: there is no scene."""

    def resume(self, now: float) -> None:
        """Nothing to do: it goes on from what was commanded."""

    def observe(
        self, now: float, commanded: Array, reading: PressureReading, samples: Sequence[PoseSample]
    ) -> Any:
        """Add up what the frames say."""
        self._commanded = commanded.copy()
        for sample in samples:
            if not sample.visible:
                continue
            since, self._seen = self._seen, sample.time
            if self._way is None or not self._gains.gain:
                continue
            _, pressures, places = self._way
            model = self._on_way(now, pressures)
            pose, jacobian, _ = self._tip.at(model)
            error = self._on_way(sample.time, places) - sample.position
            part = min(sample.time - since, 0.1) * self._gains.gain
            change = part * np.linalg.pinv(pose[:3, :3] @ jacobian[:3]) @ error
            # no wind-up: what the limits take away is not added
            self._added = self._limits.clamp(model + self._added + change) - model
        return SampleCounts(len(samples), 0, self._seen)

    def compute(self, now: float) -> Any:
        """Ramp to the sum of both."""
        wanted = self._commanded
        if self._way is not None:
            wanted = self._limits.clamp(self._on_way(now, self._way[1]) + self._added)
        most = self._gains.slew * PERIOD
        self._commanded = self._commanded + np.clip(wanted - self._commanded, -most, most)
        at_limit = (wanted <= self._limits.low) | (wanted >= self._limits.high)
        return ControlOutput(self._commanded.copy(), valid=True, saturated=at_limit)

    def stop(self, now: float) -> None:
        """Nothing is doubted."""

    def status(self, now: float) -> ControllerStatus:
        """It knows of the tip what the model says."""
        return ControllerStatus(
            plan=np.full(self._limits.n, np.nan), disturbance=np.zeros(3),
            tip_position=self._tip.at(self._commanded).pose[:3, 3], seen_age=now - self._seen,
        )  # fmt: skip

    def notices(self) -> tuple[Any, ...]:
        """None."""
        return ()

    def close(self) -> None:
        """Nothing to do."""


def stiffopt_controller(rig: Rig, robot: RobotDescription, dynamics: str) -> Controller:
    """The controller that this is all about."""
    return TipController(
        load_robot(robot), rig.supply.limits, rig.slew, period=PERIOD,
        control=rig.settings.control, safety=rig.settings.safety, vibrates=dynamics == "full",
        slow_first_motion=False,
    )  # fmt: skip


def integral_controller(rig: Rig, robot: RobotDescription, dynamics: str) -> Controller:
    """Plain integral feedback, tuned."""
    return IntegralFeedback(rig, robot, TUNED[dynamics])


def open_loop_controller(rig: Rig, robot: RobotDescription, dynamics: str) -> Controller:
    """The model alone, as fast as may be."""
    return IntegralFeedback(rig, robot, Gains(0.0, 5e5))


CONTROLLERS: dict[str, MakeController] = {
    "stiffopt": stiffopt_controller,
    "integral": integral_controller,
    "open-loop": open_loop_controller,
}
