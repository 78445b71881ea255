"""`MotionRequest`: the checked arguments of `plan_motion`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import InputError, shown
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.optimise.solution import Status
from stiffopt.optimise.task import Load, Task
from stiffopt.paths.configurations import End, checked_pressures, several
from stiffopt.paths.solution import PathSolution

_PER_PIECE = 6  # pressures on each piece of a way at which the calibrated uncertainty is evaluated


@dataclass(frozen=True)
class MotionRequest:
    """The checked arguments of `plan_motion`.

    `bare`, `robot`: the robot without and with the load of the motion. `margin`: clearance added
    for the calibrated uncertainty, in m; None without a calibration or a scene.
    """

    bare: Manipulator
    robot: Manipulator
    load: Load | None
    start: Array | Task
    goals: list[Array | Task]
    scene: Scene | None
    clearance: float
    margin: float | None
    slew: Array
    seed: int

    @classmethod
    def of(
        cls,
        robot: Manipulator,
        start: End,
        goal: End | Sequence[End],
        scene: Scene | None,
        clearance: float | None,
        slew: float | ArrayLike | None,
        load: Load | None,
        seed: int,
    ) -> MotionRequest:
        """Check the arguments of `plan_motion`."""
        if not isinstance(robot, Manipulator):
            raise InputError(f"robot must be a Manipulator, see load_robot; got {shown(robot)}")
        goals = several(goal)
        if not goals:
            raise InputError("a motion needs a goal; got an empty list")
        tasks = [each for each in (*goals, start) if isinstance(each, Task)]
        load = _load_of(tasks, load)
        bearer = robot.with_load(load.force, load.moment, load.frame) if load else robot
        scene = scene or next((task.scene for task in tasks if task.scene is not None), None)
        if scene is not None:
            if not isinstance(scene, Scene):
                raise InputError(f"scene must be a Scene, see load_scene; got {shown(scene)}")
            if clearance is not None:
                scene = scene.model_copy(update={"clearance": _checked_clearance(clearance)})
            scene.check_against(robot.description)
        elif clearance is not None:
            raise InputError("a clearance needs a scene, to whose objects it is kept")
        ends = [
            each if isinstance(each, Task) else checked_pressures(name, robot, each)
            for name, each in (("start", start), *(("goal", each) for each in goals))
        ]
        return cls(
            bare=robot,
            robot=bearer,
            load=load,
            start=ends[0],
            goals=ends[1:],
            scene=scene,
            clearance=0.0 if scene is None else scene.clearance,
            margin=None if scene is None or robot.description.calibration is None else 0.0,
            slew=_rates(robot, slew),
            seed=seed,
        )

    @property
    def required(self) -> float:
        """Clearance required of the model's body, in m, margin included."""
        return self.clearance + (self.margin or 0.0)

    def uncertainty(self, way: Array) -> float:
        """Return the largest calibrated uncertainty of the tip along a way (k, n), in m."""
        shares = np.linspace(0.0, 1.0, _PER_PIECE)[:, None]
        pieces = [a + shares * (b - a) for a, b in pairwise(way)]
        rows = np.unique(np.concatenate([way, *pieces]), axis=0)
        return max(float(self.robot.tip_uncertainty(p).semi_axes[0]) for p in rows)

    def posed(self, task: Task) -> Task:
        """Return a task with the load, the scene and the clearance of the motion."""
        scene = self.scene
        if scene is not None:
            scene = scene.model_copy(update={"clearance": self.required})
        return task.model_copy(update={"load": self.load, "press": None, "scene": scene})

    def without_answer(self, message: str, status: Status) -> PathSolution:
        """Return a solution with a message alone."""
        return PathSolution.without_answer(status, message, self.robot, self.slew)


def _load_of(tasks: list[Task], load: Load | None) -> Load | None:
    """Return the load of the whole motion; refuse tasks that differ in it."""
    if load is not None:
        if not isinstance(load, Load):
            raise InputError(f"load must be a Load; got {shown(load)}")
        return load
    loads = [task.tip_load for task in tasks]
    if any(each != loads[0] for each in loads):
        raise InputError("the tasks of a motion must have the same load; give one for all of them")
    return loads[0] if loads else None


def _checked_clearance(clearance: float) -> float:
    if not isinstance(clearance, int | float) or not 0 <= clearance < np.inf:
        raise InputError(f"clearance must be a length in m, not negative; got {shown(clearance)}")
    return float(clearance)


def _rates(robot: Manipulator, slew: float | ArrayLike | None) -> Array:
    """Return the largest rates (n,) of the pressures, in Pa/s."""
    own = None
    if slew is not None:
        try:
            own = np.broadcast_to(np.asarray(slew, dtype=float), robot.n_pressures)
        except (TypeError, ValueError):
            own = np.zeros(0)
        if not own.size or not ((own > 0) & np.isfinite(own)).all():
            raise InputError(
                f"slew must be one rate above 0 in Pa/s or {robot.n_pressures} of them; "
                f"got {shown(slew)}"
            )
    rates = robot.description.slew_limits(own)
    if rates is None:
        raise InputError(
            "a motion needs to know the rates of the pressures; give slew, or pressure.slew in "
            "the robot file"
        )
    return rates
