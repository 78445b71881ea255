"""Draw arms and random tasks from a seed."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from quality import KINDS, case, random_task
from reference import pose_errors
from stiffopt import Manipulator, Target, Task, load_robot
from stiffopt.lie import quaternion_from_rotation, rotation_from_quaternion
from stiffopt.optimise.task import Load

Vector = NDArray[np.float64]

STEP = 0.5e-3
"""How far a target moves between warm solutions, in m."""

SLACK = 1e-3
"""Relative overstepping of a tolerance that is forgiven; stiffopt itself does not use it."""

FREE_KINDS = (
    "pointing", "orientation", "pose-5", "pose-6", "free-axis", "guided", "clamped", "rotation",
    "several", "tip-frame", "least-pressure",
)  # fmt: skip
LOADED_KINDS = ("hanging", "tip load")
LOAD = Load(force=(0.0, 0.0, -0.02))


@cache
def arm(segments: int) -> Manipulator:
    """Arm of so many equal segments, the paper's, without gravity."""
    one = load_robot("stiff-flop-1")
    description = one.description
    if segments == 1:
        return one
    return load_robot(
        description.model_copy(
            update={
                "name": f"stiff-flop-{segments}",
                "segments": tuple(description.segments) * segments,
            }
        )
    )


def arm_words(segments: int) -> str:
    """Words for such an arm, in the names of figures."""
    return f"{segments} segment" + "s" * (segments > 1)


@cache
def hanging_arm() -> Manipulator:
    """Two segments under gravity, with 20 g at the tip."""
    return load_robot("stiff-flop-2-hanging")


def task_of(kind: str, segments: int, seed: int, number: int) -> tuple[Manipulator, Task]:
    """One of the random tasks of a kind, and the arm that it is for."""
    if kind in KINDS:
        return arm(segments), case(arm(segments), kind, seed, number)
    rng = np.random.default_rng([seed, segments, LOADED_KINDS.index(kind), number, 1])
    if kind == "hanging":
        return hanging_arm(), random_task(hanging_arm(), "position", rng)
    loaded = arm(segments).with_load(LOAD.force)  # so that the target can be reached under it
    task = random_task(loaded, "position", rng)
    return arm(segments), task.model_copy(update={"load": LOAD})


def holds(robot: Manipulator, task: Task, target: Target, p: Vector | None) -> bool:
    """Whether pressures reach a target within its tolerances and the limits."""
    if p is None or not np.isfinite(p).all():
        return False
    lower, upper = task.pressure_bounds(robot.description)
    if (p < lower - 1).any() or (p > upper + 1).any():
        return False
    load = task.load
    bearer = robot.with_load(load.force, load.moment, load.frame) if load else robot
    pose = bearer.tip_pose(np.clip(p, lower, upper))
    position, angle = pose_errors(task.model_copy(update={"target": target}), pose)
    near = target.tolerance
    return (position is None or position <= near.position * (1 + SLACK)) and (
        angle is None or angle <= near.angle * (1 + SLACK)
    )


def moved(robot: Manipulator, task: Task, p: Vector) -> Target:
    """The task's target moved by `STEP` (its orientation along with it), still within reach.

    The tip is led from the solution p towards the pose of the middle of the pressure range until it
    has moved by `STEP`; the target moves in the same way.
    """
    load = task.load
    bearer = robot.with_load(load.force, load.moment, load.frame) if load else robot
    lower, upper = task.pressure_bounds(robot.description)
    middle = (lower + upper) / 2
    before = bearer.tip_pose(p)
    low, high = 0.0, 1.0
    for _ in range(40):
        share = (low + high) / 2
        after = bearer.tip_pose(p + share * (middle - p))
        near = np.linalg.norm(after[:3, 3] - before[:3, 3]) < STEP
        low, high = (share, high) if near else (low, share)
    after = bearer.tip_pose(p + high * (middle - p))
    shift, turn = after[:3, 3] - before[:3, 3], after[:3, :3] @ before[:3, :3].T
    target, changes = task.target, {}
    if target.position is not None:
        changes["position"] = tuple(
            None if x is None else float(x + d) for x, d in zip(target.position, shift, strict=True)
        )
    if target.pointing is not None:
        changes["pointing"] = tuple((turn @ np.array(target.pointing)).tolist())
    if target.orientation is not None:
        rotation = turn @ rotation_from_quaternion(np.array(target.orientation))
        quaternion = quaternion_from_rotation(rotation)
        changes["orientation"] = tuple((quaternion * np.copysign(1.0, quaternion[0])).tolist())
    return target.model_copy(update=changes)
