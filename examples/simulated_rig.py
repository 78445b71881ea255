"""A rig on a simulated clock with the daemon's control loop and access to the arm's true body.

The examples beside it use it. On a real rig the same trajectory goes to the daemon instead:
``stiffopt.Client(...).follow_trajectory(trajectory)``.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from stiffopt import Manipulator, Trajectory, load_robot
from stiffopt.control.controller import TipController
from stiffopt.control.loop import ControlLoop
from stiffopt.control.ways import ClearanceWatch
from stiffopt.model.scene import Scene
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription, load_rig_description
from stiffopt.safety.gate import gate_before

_CAPTURE = 1.0  # s, in which the tracker is watched before the arm is armed


class SimulatedArm:
    """An armed arm.

    Parameters
    ----------
    rig :
        The rig file, or its content; its supply and tracker are simulated.
    model :
        The arm as the controller knows it; by default the rig's robot.
    """

    def __init__(
        self, rig: str | os.PathLike[str] | RigDescription, model: Manipulator | None = None
    ) -> None:
        described = isinstance(rig, RigDescription)
        description = rig if described else load_rig_description(rig)
        robot = load_robot(description.robot)
        model = model or robot
        self.scene: Scene | None = description.scene
        self.rig: Any = make_rig(description, robot.description)
        self.period, safety = 1 / description.rate, description.safety
        plant = description.plant
        self.controller = TipController(
            model,
            self.rig.supply.limits,
            self.rig.slew,
            period=self.period,
            control=description.control,
            safety=safety,
            vibrates=plant is None or plant.dynamics == "full",
            scene=self.scene,
        )
        self.loop = ControlLoop(
            self.rig,
            self.controller,
            gate_before(self.rig, safety, self.period),
            safety=safety,
            period=self.period,
            clearance=None if self.scene is None else ClearanceWatch(model, self.scene),
        )
        self.radii = np.array([each.outer_radius for each in robot.description.segments])
        self.loop.configure()
        self.run(_CAPTURE)
        self.loop.arm()

    def run(self, duration: float) -> dict[str, np.ndarray]:
        """Let time pass, in s; return what happened in each of N ticks.

        Returns
        -------
        dict
            ``times`` (N,) in s; ``commanded``, ``plan`` and ``pressures`` (N, n) in Pa: those that
            are commanded, those of the planned posture, and the true ones; ``tips`` (N, 3) and
            ``bodies`` (N, m, 3): the true tip, and nodes of the true centre line; ``errors`` (N,)
            of the estimated tip, in m; ``states`` (N,) of the control loop.
        """
        rows: dict[str, list[Any]] = {}
        for _ in range(round(duration / self.period)):
            self.rig.clock.sleep(self.period)
            self.loop.tick()
            now, world = self.loop.snapshot(), self.rig.world
            body = world.plant.poses()[:, :3, 3]
            row = {
                "times": now.time,
                "commanded": now.commanded,
                "plan": now.plan,
                "pressures": world.pressures.copy(),
                "tips": body[-1],
                "bodies": body,
                "errors": now.position_error,
                "states": str(now.state),
            }
            for key, value in row.items():
                rows.setdefault(key, []).append(value)
        return {key: np.array(values) for key, values in rows.items()}

    def play(self, trajectory: Trajectory, rest: float = 1.0) -> dict[str, np.ndarray]:
        """Follow a trajectory, and stay at its end for a time in s; see `run`."""
        self.loop.follow_trajectory(trajectory)
        return self.run(trajectory.duration + rest)

    def close(self) -> None:
        """Vent and disconnect."""
        self.loop.close()
