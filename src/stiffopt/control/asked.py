"""What a task asks of the tip, and by how much a tip misses it."""

from __future__ import annotations

import math
from collections.abc import Callable

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.control.requested import tightened
from stiffopt.model.compliance import directional_stiffness
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import PressureRange, Task
from stiffopt.rig.interface import PressureLimits

__all__ = [
    "angle_to",
    "distance_to",
    "is_far",
    "parts_of",
    "stiffness_of",
    "within_limits",
]

Array = NDArray[np.float64]

_FAR, _TURNED = 5e-3, math.cos(math.radians(5))  # m, and the cosine of an angle


def within_limits(task: Task, robot: Manipulator, limits: PressureLimits) -> Task:
    """Return a task with a rig's limits of pressure.

    Raises
    ------
    InputError
        It asks for more than the rig may give (see `tightened`), or leaves a channel no pressure.
    """
    on_the_rig = task.model_copy(update={"pressure": tightened(task.pressure, limits)})
    lower, upper = on_the_rig.pressure_bounds(robot.description)
    pressure = PressureRange(min=tuple(lower.tolist()), max=tuple(upper.tolist()))
    # of a load, the tip's offset tells how much of it there is
    return task.model_copy(update={"pressure": pressure, "load": None})


def stiffness_of(task: Task) -> Callable[..., float] | None:
    """Stiffness along the first direction that a task names, by compliance and rotation."""
    measures = task.measures
    if not measures:
        return None
    measure = measures[0]
    if measure.boundary == "free":  # NumPy alone is ten times as quick
        block = slice(0, 3) if measure.kind == "translation" else slice(3, 6)
        direction, in_base = np.array(measure.direction), measure.frame == "base"

        def along(compliance: Array, rotation: Array) -> float:
            d = rotation.T @ direction if in_base else direction
            return float(1 / (d @ compliance[block, block] @ d))

        return along
    C, R = ca.SX.sym("C", 6, 6), ca.SX.sym("R", 3, 3)
    value = directional_stiffness(
        C, R, ca.DM(measure.direction),
        frame=measure.frame, kind=measure.kind, boundary=measure.boundary,
    )  # fmt: skip
    function: Callable[..., float] = ca.Function("stiffness", [C, R], [value])
    return function


def is_far(before: Target, target: Target) -> bool:
    """Whether another configuration may be better for a target than for the one before."""
    (here, *directions), (there, *others) = parts_of(before), parts_of(target)
    if (
        here is not None
        and there is not None
        and np.linalg.norm(np.nan_to_num(there - here)) > _FAR
    ):
        return True
    turned = [
        abs(float(a @ b)) < _TURNED
        for a, b in zip(directions, others, strict=True)
        if a is not None and b is not None
    ]
    return any(turned)


def parts_of(target: Target | None) -> tuple[Array | None, Array | None, Array | None]:
    """Position, pointing and orientation of a target."""
    if target is None:
        return None, None, None
    position = None
    if target.position is not None:
        position = np.array([np.nan if axis is None else axis for axis in target.position])
    pointing = None if target.pointing is None else np.array(target.pointing)
    return position, pointing, None if target.orientation is None else np.array(target.orientation)


def distance_to(position: Array, target: Array | None) -> float:
    """Distance of a tip from a position (3,), NaN for free axes, in m; NaN where none is asked."""
    if target is None:
        return math.nan
    away = position - target
    return float(np.linalg.norm(away[np.isfinite(away)]))


def angle_to(rotation: Array, pointing: Array | None, quaternion: Array | None) -> float:
    """Angle of a tip (3, 3) to a pointing (3,) or quaternion (4,), in rad; NaN: none is asked."""
    if pointing is not None:
        return float(np.arccos(np.clip(rotation[:, 2] @ pointing, -1, 1)))
    if quaternion is not None:
        between = rotation.T @ lie.rotation_from_quaternion(quaternion)
        return float(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1)))
    return math.nan
