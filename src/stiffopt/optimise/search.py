"""Global search: where to start local optimisations, and when to stop.

Starts come from a table of sampled configurations: of those whose tip is nearest to the target
the stiffest first, in turn with the nearest and with ones from anywhere, each unlike the ones
before it.  The search stops when the Bayesian estimate of Boender and Rinnooy Kan (Math.
Programming 37, 1987) expects fewer than a quarter of a local optimum to be unseen: with w
distinct optima after n local searches, ``w (n - 1) / (n - w - 2) < w + 1/4``.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stiffopt.errors import EquilibriumError
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.local import LocalResult, descend, reach
from stiffopt.optimise.problem import BAR, Point, Problem
from stiffopt.optimise.solution import Confidence
from stiffopt.optimise.target import Target
from stiffopt.optimise.terms import pose_errors

Vector = NDArray[np.float64]

SAME_OPTIMUM = 1e-3
"""Objectives closer than this (0.1 % of a stiffness) count as the same optimum."""

_FREE_SAMPLES = 4096
_LOADED_SAMPLES = 128  # an equilibrium takes a thousand times longer than a closed form
_HOPELESS_SAMPLES = 16  # if none of so many first ones has an equilibrium, the arm has none
_RANKED = 256  # nearest samples that are ranked by their objective
_UNSEEN = 0.25  # local optima that may be expected to be unseen when the search stops


class SampleTable:
    """Configurations spread over the pressure range of an arm, with their tip poses.

    Parameters
    ----------
    robot : Manipulator
    lower, upper : ndarray (n,)
        Range in bar.
    seed : int
        Shifts the low-discrepancy sequence.
    """

    def __init__(self, robot: Manipulator, lower: Vector, upper: Vector, seed: int) -> None:
        count = _LOADED_SAMPLES if robot.is_loaded else _FREE_SAMPLES
        x = lower + (upper - lower) * _spread_with_edges(count, len(lower), seed)
        if robot.is_loaded:
            # under load little pressure can do much: every other sample is scaled down
            scale = 10 ** (-2.5 * np.arange(count) / count)
            scale[::2] = 1.0
            x, poses = _settled(robot, lower + (x - lower) * scale[:, np.newaxis])
        else:
            poses = robot.tip_pose(x * BAR)
        self.x, self.poses = x, poses

    def nearest_first(self, target: Target, length: float) -> NDArray[np.intp]:
        """Indices of the samples, those with the smallest pose error first."""
        errors = np.zeros(len(self.x))
        rotations, positions = self.poses[:, :3, :3], self.poses[:, :3, 3]
        if target.position is not None:
            asked = [axis for axis in range(3) if target.position[axis] is not None]
            wanted = np.array([target.position[axis] for axis in asked], dtype=float)
            errors += np.linalg.norm(positions[:, asked] - wanted, axis=1) / length
        if target.pointing is not None:
            cosines = rotations[:, :, 2] @ np.array(target.pointing)
            errors += np.arccos(np.clip(cosines, -1, 1)) / np.pi
        if target.orientation is not None:
            errors += [pose_errors(target, pose)["angle"].error / np.pi for pose in self.poses]
        return np.argsort(errors, kind="stable")


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


def starts(problem: Problem, table: SampleTable) -> Iterator[Vector]:
    """Pressures to start from: near the target, promising, and unlike each other."""
    order = table.nearest_first(problem.task.target, problem.robot.length)
    ranked = order[:_RANKED]
    if not problem.robot.is_loaded and problem.task.stiffness is not None:
        ranked = ranked[np.argsort(problem.objective_values(table.x[ranked]), kind="stable")]
    # in turn: a near one that is good, the nearest one left, and one from anywhere
    mixed = [i for trio in zip(ranked, order, range(len(order)), strict=False) for i in trio]
    mixed += list(order)
    apart = 0.2 * float(np.linalg.norm(problem.upper - problem.lower))
    given: list[Vector] = []
    later: list[int] = []
    for i in dict.fromkeys(mixed):
        x = table.x[i]
        if all(np.linalg.norm(x - other) > apart for other in given):
            given.append(x)
            yield x
        else:
            later.append(i)
    for i in later:
        yield table.x[i]


@dataclass(frozen=True)
class Search:
    """Outcome of a global search.

    Attributes
    ----------
    results : tuple of LocalResult
        One per start that reached the pose, the best first.
    nearest : tuple of Point
        Where the starts that did not reach the pose ended.
    confidence : Confidence
    """

    results: tuple[LocalResult, ...]
    nearest: tuple[Point, ...]
    confidence: Confidence


def search(
    problem: Problem, candidates: Iterator[Vector], most_starts: int, hopeless: int = 12
) -> Search:
    """Run local optimisations from candidates until the stopping rule holds.

    Gives up after `hopeless` starts of which none came to the pose.
    """
    results: list[LocalResult] = []
    nearest: list[Point] = []
    count, complete = 0, False
    for x in candidates:
        if count >= most_starts or (count >= hopeless and not results):
            break
        count += 1
        problem.restart()
        point = reach(problem, x)
        if point is None:
            continue
        if not point.reached:
            nearest.append(point)
            continue
        result = descend(problem, point)
        if np.isfinite(result.value):
            results.append(result)
        complete = _seen_all(results, problem)
        if complete:
            break
    results.sort(key=_rank)
    agreeing = sum(_same(result, results[0]) for result in results)
    confidence = Confidence(count, len(results), agreeing, len(_distinct(results)), complete)
    return Search(tuple(results), tuple(nearest), confidence)


def _rank(result: LocalResult) -> tuple[float, float]:
    return (round(result.violation, 7), result.value)


def _same(a: LocalResult, b: LocalResult) -> bool:
    return abs(a.value - b.value) < SAME_OPTIMUM and abs(a.violation - b.violation) < SAME_OPTIMUM


def _distinct(results: list[LocalResult]) -> list[LocalResult]:
    distinct: list[LocalResult] = []
    for result in sorted(results, key=_rank):
        if not any(_same(result, other) for other in distinct):
            distinct.append(result)
    return distinct


def _seen_all(results: list[LocalResult], problem: Problem) -> bool:
    """Stopping rule of Boender and Rinnooy Kan."""
    n, w = len(results), len(_distinct(results))
    if n - w - 2 <= 0:
        return False
    return w * (n - 1) / (n - w - 2) < w + _UNSEEN
