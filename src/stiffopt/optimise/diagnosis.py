"""What to say where a task cannot be met, or leaves no choice.

`closest_configuration` finds the pressures that come nearest to an unreachable pose; the rest
puts findings into words.
"""

from collections.abc import Iterable
from math import degrees, inf

import numpy as np
from numpy.typing import NDArray

from stiffopt.optimise.goal import MatchMatrix, MatchValue
from stiffopt.optimise.local import LocalResult
from stiffopt.optimise.problem import Problem
from stiffopt.optimise.search import search
from stiffopt.optimise.solution import Judgement, Sensitivities
from stiffopt.optimise.task import Task
from stiffopt.optimise.terms import pose_terms

Vector = NDArray[np.float64]

_MOST_DESCENTS = 16
_AGREEING = 4  # descents in a row that find nothing nearer before a search for it ends
_SAME = 1e-7  # half a squared error over a scale, of configurations that are as near


def closest_configurations(problem: Problem, candidates: Iterable[Vector]) -> list[LocalResult]:
    """Pressures that come nearest to the pose, from all candidates to start from, best first.

    The least position error; where an angle is asked for too, within the angle's tolerance if
    that can be had, else at the least angle error.
    """
    xs = list(candidates)
    names = [term.name for term in pose_terms(problem.task.target)]
    free = problem.changed(problem.objective, floors=False, position=inf, angle=inf)
    if names != ["position", "angle"]:
        return _descents(free.changed(problem.closest(names[0])), xs)
    turned = _descents(free.changed(problem.closest("angle")), xs)
    if not turned:
        return []
    least = next(ball.error for ball in turned[0].point.balls if ball.name == "angle")
    allowed = max(problem.task.target.tolerance.angle, least * (1 + 1e-6) + 1e-7)
    nearest = free.changed(problem.closest("position"), angle=allowed)
    return _descents(nearest, [turned[0].point.x, *xs])


def _descents(problem: Problem, xs: list[Vector]) -> list[LocalResult]:
    return list(search(problem, xs, _MOST_DESCENTS, _SAME, _AGREEING).results)


def unimproved(problem: Problem, x: Vector) -> LocalResult:
    """Pressures as they are, as a result that can be judged beside those of descents."""
    problem.restart()
    point = problem.pose(x)
    nearest = problem.changed(problem.closest(point.balls[0].name), floors=False)
    return LocalResult(nearest, point, inf, 0.0, converged=False, is_optimum=False)


def freedom(problem: Problem, x: Vector) -> int:
    """Directions in pressure space in which what is asked of the pose stays what it is."""
    problem.restart()
    rows = [ball.jacobian / ball.radius for ball in problem.pose(x).constraints]
    return int(len(x) - np.linalg.matrix_rank(np.vstack(rows), rtol=1e-6))


def no_freedom_message(task: Task, n_pressures: int, sensitivities: Sensitivities | None) -> str:
    """Say that the pose leaves no choice, and what a larger tolerance would buy."""
    text = (
        f"no freedom is left: the pose takes all {n_pressures} pressures, so the stiffness is what "
        "it is there"
    )
    if sensitivities is None or sensitivities.objective_unit not in ("N/m", "N*m/rad"):
        return text
    unit = sensitivities.objective_unit.replace("*", " ")
    offers = []
    if sensitivities.per_position_tolerance:
        offers.append(f"{sensitivities.per_position_tolerance * 1e-3:.3g} {unit} per mm")
    if sensitivities.per_angle_tolerance:
        per_degree = sensitivities.per_angle_tolerance * np.pi / 180
        offers.append(f"{per_degree:.3g} {unit} per degree")
    return f"{text}; a larger tolerance would buy {' and '.join(offers)}" if offers else text


def unreachable_message(judgement: Judgement, task: Task, holding: list[str]) -> str:
    """Say how far the closest configuration is and what holds it back."""
    misses = []
    tolerance = task.target.tolerance
    if judgement.position_error is not None and judgement.position_error > tolerance.position:
        misses.append(f"{judgement.position_error * 1e3:.4g} mm")
    if judgement.angle_error is not None and judgement.angle_error > tolerance.angle:
        misses.append(f"{degrees(judgement.angle_error):.3g} deg")
    held = (
        f"held back by {', '.join(holding)}"
        if holding
        else "no pressure limit holds it back: the target is beyond the arm itself"
    )
    return f"unreachable: the closest configuration is {' and '.join(misses)} away; {held}"


def demands_message(judgement: Judgement, task: Task) -> str:
    """Say which stiffness cannot be had at the pose, and the best that can."""
    goal = task.stiffness
    if goal is None:
        return ""
    parts = []
    match = goal.match
    first = len(goal.maximise) + isinstance(match, MatchValue)
    if isinstance(match, MatchValue):
        value = judgement.stiffnesses[0]
        if abs(value / match.value - 1) > match.tolerance:
            parts.append(f"{match.value:.4g} {_unit(match.unit)} asked for, {value:.4g} is nearest")
    if isinstance(match, MatchMatrix) and judgement.matrix_distance is not None:
        parts.append(
            f"the nearest stiffness matrix is {judgement.matrix_distance:.3g} away (relative "
            f"Frobenius distance, {match.tolerance:.3g} allowed)"
        )
    for floor, value in zip(goal.at_least, judgement.stiffnesses[first:], strict=True):
        if value < floor.value:
            parts.append(
                f"at least {floor.value:.4g} {_unit(floor.unit)} asked for, {value:.4g} is the most"
            )
    return f"unreachable: the pose can be had, but not this stiffness there: {'; '.join(parts)}"


def _unit(unit: str) -> str:
    return unit.replace("*", " ")
