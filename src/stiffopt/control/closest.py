"""The configuration nearest to a target that cannot be reached, soon enough for a control loop.

Gauss-Newton on ``|e|^2``, e the position error and a lever times the angle error, within the
limits of pressure; the same measure by which the controller weighs them.
"""

from __future__ import annotations

import math

import daqp
import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.optimise.target import Target
from stiffopt.optimise.tip import TipAt, TipModel

__all__ = ["LEVER", "closest", "pose_error"]

Array = NDArray[np.float64]

LEVER = 0.05  # m/rad; a turn of the tip weighs as much as a motion of this lever's end

_BAR = 1e5
_ITERATIONS = 40
_STEP = 0.3  # bar, at most
_ENOUGH = 1e-7  # m, of progress
_STEADY = 1e-4  # m/bar; regularisation


def pose_error(target: Target, at: TipAt) -> tuple[Array, Array, float, float]:
    """By what a tip misses a target.

    Returns
    -------
    error : (t,)
        In m; angles times `LEVER`.
    jacobian : (t, n)
        Its derivative by the pressures, m/Pa.
    away, turned : float
        Position error in m and angle error in rad.
    """
    rotation, position = at.pose[:3, :3], at.pose[:3, 3]
    linear, angular = rotation @ at.jacobian[:3], rotation @ at.jacobian[3:]
    errors, rows = [np.zeros(0)], [np.zeros((0, linear.shape[1]))]
    away = turned = 0.0
    if target.position is not None:
        asked = np.array([axis is not None for axis in target.position])
        goal = np.array([0.0 if axis is None else axis for axis in target.position])
        errors.append((position - goal)[asked])
        rows.append(linear[asked])
        away = float(np.linalg.norm(errors[-1]))
    if target.pointing is not None:
        goal = np.array(target.pointing)
        turn = np.cross(goal, rotation[:, 2])
        turned = math.atan2(float(np.linalg.norm(turn)), float(goal @ rotation[:, 2]))
        across = np.eye(3) - np.outer(rotation[:, 2], rotation[:, 2])
        errors.append(LEVER * _of_length(turn, turned))
        rows.append(LEVER * across @ angular)
    if target.orientation is not None:
        wanted = lie.rotation_from_quaternion(np.array(target.orientation))
        turn = lie.rotation_vector_from_quaternion(
            lie.quaternion_from_rotation(rotation @ wanted.T)
        )
        turned = float(np.linalg.norm(turn))
        errors.append(LEVER * turn)
        rows.append(LEVER * angular)
    return np.concatenate(errors), np.concatenate(rows), away, turned


def closest(
    tip: TipModel, target: Target, bounds: tuple[Array, Array], start: Array
) -> tuple[Array, float, float]:
    """Pressures (n,) in Pa that come nearest to a target, and by what they miss it, in m and rad.

    Parameters
    ----------
    tip :
        The model.
    bounds :
        Lower and upper limits (n,), in Pa.
    start :
        Where to begin (n,), in Pa; the answer is a local optimum from there.
    """
    low, high = bounds[0] / _BAR, bounds[1] / _BAR
    x = np.clip(start / _BAR, low, high)
    error, rows, away, turned = pose_error(target, tip.at(x * _BAR))
    none = np.zeros((0, len(x)))
    for _ in range(_ITERATIONS):
        J = rows * _BAR
        H = J.T @ J + _STEADY**2 * np.eye(len(x))
        lower, upper = np.maximum(low - x, -_STEP), np.minimum(high - x, _STEP)
        step, *_ = daqp.solve(H * 1e6, J.T @ error * 1e6, none, upper, lower)
        if step is None or not np.isfinite(step).all():
            break
        share, value = 1.0, float(error @ error)
        while share > 1e-3:
            trial = np.clip(x + share * np.asarray(step), low, high)
            found = pose_error(target, tip.at(trial * _BAR))
            if float(found[0] @ found[0]) < value:
                break
            share *= 0.5
        else:
            break
        x = trial
        error, rows, away, turned = found
        if math.sqrt(value) - float(np.linalg.norm(error)) < _ENOUGH:
            break
    result: Array = x * _BAR
    return result, away, turned


def _of_length(vector: Array, length: float) -> Array:
    size = float(np.linalg.norm(vector))
    return vector * (length / size) if size > 1e-12 else vector
