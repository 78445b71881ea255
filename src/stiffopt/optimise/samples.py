"""`SampleTable`: sampled configurations of an arm, from which searches start."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError
from stiffopt.model.loaded_arm import LoadedArm
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.program import pressure_ranges
from stiffopt.optimise.settings import SAMPLES
from stiffopt.optimise.term import Term


class SampleTable:
    """Configurations spread over the pressure range of an arm, with their tip poses.

    Parameters
    ----------
    lower, upper : (n,), range in Pa.
    seed : shifts the low-discrepancy sequence.
    arm : the robot in machine code, to find equilibria under load.
    count : number of configurations, before those without an equilibrium are left out.

    Attributes
    ----------
    pressures : (N, n), in Pa.
    poses : ndarray (N, 4, 4)
    states : (N, s), states of the equilibria; only with `arm`.
    """

    def __init__(
        self,
        robot: Manipulator,
        lower: Array,
        upper: Array,
        seed: int,
        arm: LoadedArm | None = None,
        count: int | None = None,
    ) -> None:
        self.arm, self._ranges = arm, pressure_ranges(robot.description)
        if count is None:
            loaded = SAMPLES.loaded if arm is None else SAMPLES.compiled
            count = loaded if robot.is_loaded else SAMPLES.free
        x = lower + (upper - lower) * _spread_with_edges(count, len(lower), seed)
        if robot.is_loaded:
            # under load small pressures can have a large effect: scale down every other sample
            scale = 10 ** (-2.5 * np.arange(count) / count)
            scale[::2] = 1.0
            x = lower + (x - lower) * scale[:, np.newaxis]
            if arm is not None:
                found, states, flat = arm.settled(x)
                x, self.states = x[found], np.ascontiguousarray(states[found])
                poses = _unflattened(flat[found])
            else:
                x, poses = _settled(robot, x)
        else:
            poses = robot.tip_pose(x)
        self.pressures, self.poses = np.ascontiguousarray(x), poses

    @cached_property
    def shares(self) -> Array:
        """Pressures (N, n) as shares of the channels' ranges."""
        return np.ascontiguousarray(self.pressures / self._ranges)

    @cached_property
    def flat_poses(self) -> Array:
        """Positions and rotations (by columns), (N, 12)."""
        return _flattened(self.poses)

    def distances(self, terms: tuple[Term, ...], length: float) -> Array:
        """Return rough distances (N,) of the tips from meeting all terms (see `Nearness`)."""
        return _distances(self.flat_poses, terms, length)

    def nearest_first(self, distances: Array, count: int | None = None) -> NDArray[np.intp]:
        """Return the indices of `count` samples (default: all) by increasing distance (N,)."""
        if count is None or count >= len(distances):
            return np.argsort(distances, kind="stable")
        nearest = np.sort(np.argpartition(distances, count)[:count])
        return nearest[np.argsort(distances[nearest], kind="stable")]


def _spread_with_edges(count: int, n: int, seed: int) -> Array:
    """Return points (count, n) of the unit cube, a part of them on its faces and edges.

    Additive recurrence with the generalised golden ratio (M. Roberts, 2018).  Optima often lie at
    limits, so the cube is stretched by a quarter and clipped.
    """
    ratio = 2.0
    for _ in range(60):
        ratio = (1 + ratio) ** (1 / (n + 1))
    steps = ratio ** -np.arange(1.0, n + 1)
    shift = np.random.default_rng(seed).random(n)
    points = (shift + np.outer(np.arange(1.0, count + 1), steps)) % 1.0
    return np.clip(1.25 * points - 0.125, 0.0, 1.0)


def distances(poses: Array, terms: tuple[Term, ...], length: float) -> Array:
    """Return rough distances (N,) of poses (N, 4, 4) from meeting all terms; see `Nearness`."""
    return _distances(_flattened(poses), terms, length)


def _distances(flat: Array, terms: tuple[Term, ...], length: float) -> Array:
    position, rotation = flat[:, :3], flat[:, 3:]
    total = np.zeros(len(flat))
    for term in terms:
        near = term.nearness(length)
        value = near.offset + position @ np.array(near.linear)
        value += position**2 @ np.array(near.square) + rotation @ np.array(near.turn)
        np.maximum(value, 0.0, out=value)
        value = np.sqrt(value) if near.root else value
        total += np.maximum(value - near.limit, 0.0)
    return total


def _flattened(poses: Array) -> Array:
    columns = poses[:, :3, [3, 0, 1, 2]].swapaxes(1, 2)
    return np.ascontiguousarray(columns.reshape(-1, 12))


def _unflattened(flat: Array) -> Array:
    """Return poses (N, 4, 4) from positions and rotations by columns (N, 12)."""
    poses = np.tile(np.eye(4), (len(flat), 1, 1))
    poses[:, :3, 3] = flat[:, :3]
    poses[:, :3, :3] = flat[:, 3:].reshape(-1, 3, 3).swapaxes(1, 2)
    return poses


def _settled(robot: Manipulator, x: Array) -> tuple[Array, Array]:
    """Return the configurations of a loaded arm that have an equilibrium, and their poses."""
    evaluator = robot.evaluator("pose", lambda shape, _: [shape.transform])
    kept: list[int] = []
    poses: list[Array] = []
    for index in range(len(x)):
        evaluator.restart()  # from rest, so that local searches start on the right branch
        try:
            (pose,) = evaluator(x[index])
        except EquilibriumError:
            if not kept and index >= SAMPLES.hopeless:
                raise
            continue
        kept.append(index)
        poses.append(pose)
    return x[kept], np.stack(poses)
