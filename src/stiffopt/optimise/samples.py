"""Sampled configurations of an arm, from which searches start."""

import math
from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import EquilibriumError
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.program import BAR
from stiffopt.optimise.target import Target

Vector = NDArray[np.float64]

Settled = Callable[[Vector], tuple[NDArray[np.bool_], Vector, Vector]]

_FREE_SAMPLES = 4096
_LOADED_SAMPLES = 128  # an equilibrium takes a thousand times longer than a closed form
_COMPILED_SAMPLES = 64  # each load has its own; measured to do
_HOPELESS_SAMPLES = 16  # if none of so many first ones has an equilibrium, the arm has none


class SampleTable:
    """Configurations spread over the pressure range of an arm, with their tip poses.

    Parameters
    ----------
    robot : Manipulator
    lower, upper : ndarray (n,)
        Range in bar.
    seed : int
        Shifts the low-discrepancy sequence.
    settled : callable, optional
        Of a loaded arm, in place of its own equilibria: which pressures (N, n) in Pa have one,
        their states (N, s) and poses (N, 12).

    Attributes
    ----------
    x : ndarray (N, n)
        In bar.
    poses : ndarray (N, 4, 4)
    states : ndarray (N, s)
        Of the equilibria, if `settled` is given.
    """

    def __init__(
        self,
        robot: Manipulator,
        lower: Vector,
        upper: Vector,
        seed: int,
        settled: Settled | None = None,
    ) -> None:
        count = _FREE_SAMPLES
        if robot.is_loaded:
            count = _LOADED_SAMPLES if settled is None else _COMPILED_SAMPLES
        x = lower + (upper - lower) * _spread_with_edges(count, len(lower), seed)
        if robot.is_loaded:
            # under load little pressure can do much: every other sample is scaled down
            scale = 10 ** (-2.5 * np.arange(count) / count)
            scale[::2] = 1.0
            x = lower + (x - lower) * scale[:, np.newaxis]
            if settled is not None:
                found, states, flat = settled(x * BAR)
                x, self.states = x[found], np.ascontiguousarray(states[found])
                poses = _unflattened(flat[found])
            else:
                x, poses = _settled(robot, x)
        else:
            poses = robot.tip_pose(x * BAR)
        self.x, self.poses = np.ascontiguousarray(x), poses

    @cached_property
    def flat_poses(self) -> Vector:
        """Position and rotation, this by columns, (N, 12)."""
        columns = self.poses[:, :3, [3, 0, 1, 2]].swapaxes(1, 2)
        return np.ascontiguousarray(columns.reshape(-1, 12))

    def nearest_first(
        self, target: Target, length: float, most: int | None = None
    ) -> NDArray[np.intp]:
        """Indices of the samples with the smallest pose errors (see `nearness`), in order."""
        near = np.array(nearness(target, length))
        apart = near[:3] * (self.flat_poses[:, :3] - near[3:6])
        errors = np.sqrt(np.einsum("ij,ij->i", apart, apart))
        if near[6]:
            square = np.maximum(near[7] - self.flat_poses[:, 3:] @ near[8:], 0.0)
            errors += near[6] * np.sqrt(square)
        if most is None or most >= len(errors):
            return np.argsort(errors, kind="stable")
        nearest = np.sort(np.argpartition(errors, most)[:most])
        return nearest[np.argsort(errors[nearest], kind="stable")]


def nearness(target: Target, length: float) -> tuple[float, ...]:
    """How far a pose is from a target, roughly, as 17 numbers.

    Weights w (3), position q (3), factor a, offset b and matrix M (9, by columns), so that the
    distance is ``|w * (position - q)| + a sqrt(b - <M, rotation>)``: the position error over the
    arm's length plus a chord for the angle over pi.
    """
    weights, wanted = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    for axis, value in enumerate(target.position or ()):
        if value is not None:
            weights[axis], wanted[axis] = 1 / length, value
    if target.pointing is not None:
        # |z - d|^2 = 2 - 2 z.d
        matrix = (0.0,) * 6 + tuple(2 * value for value in target.pointing)
        return (*weights, *wanted, 1 / math.pi, 2.0, *matrix)
    if target.orientation is not None:
        w, x, y, z = target.orientation
        # |R - W|^2 = 6 - 2 <W, R>, twice the square of a small angle
        columns = (
            1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y),
            2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
            2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y),
        )  # fmt: skip
        matrix = tuple(2 * value for value in columns)
        return (*weights, *wanted, 1 / (math.pi * math.sqrt(2)), 6.0, *matrix)
    return (*weights, *wanted, *(0.0,) * 11)


def _spread_with_edges(count: int, n: int, seed: int) -> Vector:
    """Points (count, n) of the unit cube, a part of them on its faces and edges.

    Additive recurrence with the generalised golden ratio (M. Roberts, 2018); optima often lie
    at limits, so the cube is stretched by a quarter and clipped.
    """
    ratio = 2.0
    for _ in range(60):
        ratio = (1 + ratio) ** (1 / (n + 1))
    steps = ratio ** -np.arange(1.0, n + 1)
    shift = np.random.default_rng(seed).random(n)
    points = (shift + np.outer(np.arange(1.0, count + 1), steps)) % 1.0
    return np.clip(1.25 * points - 0.125, 0.0, 1.0)


def _unflattened(flat: Vector) -> Vector:
    """Poses (N, 4, 4) from position and rotation by columns (N, 12)."""
    poses = np.tile(np.eye(4), (len(flat), 1, 1))
    poses[:, :3, 3] = flat[:, :3]
    poses[:, :3, :3] = flat[:, 3:].reshape(-1, 3, 3).swapaxes(1, 2)
    return poses


def _settled(robot: Manipulator, x: Vector) -> tuple[Vector, Vector]:
    """Those configurations of a loaded arm that have an equilibrium, and their poses."""
    evaluator = robot.evaluator("pose", lambda shape, _: [shape.transform])
    kept: list[int] = []
    poses: list[Vector] = []
    for index in range(len(x)):
        evaluator.restart()  # each from rest, so that local searches start on the right branch
        try:
            (pose,) = evaluator(x[index] * BAR)
        except EquilibriumError:
            if not kept and index >= _HOPELESS_SAMPLES:
                raise
            continue
        kept.append(index)
        poses.append(pose)
    return x[kept], np.stack(poses)
