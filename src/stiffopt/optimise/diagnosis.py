"""Closest configurations of tasks that cannot be met, and messages that explain answers."""

from collections.abc import Iterable
from math import inf

import numpy as np

from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.optimise.local import LocalResult
from stiffopt.optimise.problem import PressureProblem
from stiffopt.optimise.search import search
from stiffopt.optimise.settings import CLOSEST, OBSTACLES, Effort
from stiffopt.optimise.solution import Judgement, Sensitivities
from stiffopt.optimise.task import Task


def closest_configurations(
    problem: PressureProblem, candidates: Iterable[Array]
) -> list[LocalResult]:
    """Return pressures nearest to the target, found from all candidates, best first.

    The terms are approached one after the other: first inequalities, then others, the position
    last. Each keeps the terms before it within their tolerances or, if these cannot be met, at
    their least errors.
    """
    xs = list(candidates)
    terms = problem.program.terms
    free = {term.name: inf for term in terms}
    stage = problem.changed(problem.objective, free, floors=False)
    results: list[LocalResult] = []
    for term in problem.program.in_order_of_approach:
        stage = stage.changed(problem.closest(term.name))
        starts = [*(result.point.x for result in results[:1]), *xs]
        tries = Effort(len(starts), CLOSEST.agreeing, CLOSEST.most_descents)
        results = list(search(stage, starts, tries, CLOSEST.same).results)
        if not results:
            return []
        ball = [b for b in results[0].point.balls if b.name == term.name]
        least = max(b.error for b in ball)
        allowed = max(term.radius, least * (1 + 1e-6) + 1e-7)
        stage = stage.changed(stage.objective, {term.name: allowed})
    return results


def last_stage(problem: PressureProblem, errors: dict[str, float]) -> PressureProblem:
    """Return the last stage of `closest_configurations`, given the least errors."""
    *before, last = problem.program.in_order_of_approach
    radii = {}
    for term in before:
        error = errors[term.name]
        least = term.radius - error if term.is_inequality else error
        radii[term.name] = max(term.radius, least * (1 + 1e-6) + 1e-7)
    return problem.changed(problem.closest(last.name), {**radii, last.name: inf}, floors=False)


def unimproved(problem: PressureProblem, x: Array) -> LocalResult:
    """Wrap pressures as a result that can be judged like those of descents."""
    problem.restart()
    point = problem.pose(x)
    nearest = problem.changed(problem.closest(problem.program.terms[0].name), floors=False)
    return LocalResult(nearest, point, inf, 0.0, converged=False, is_optimum=False)


def freedom(problem: PressureProblem, x: Array) -> int:
    """Return the number of independent pressure changes that keep the residuals."""
    problem.restart()
    balls = [ball for ball in problem.pose(x).bounded if not ball.constraint.one_sided]
    rows = [np.zeros((0, len(x))), *(ball.jacobian / ball.radius for ball in balls)]
    return int(len(x) - np.linalg.matrix_rank(np.vstack(rows), rtol=1e-6))


def no_freedom_message(task: Task, n_pressures: int, sensitivities: Sensitivities | None) -> str:
    """Explain that the pose leaves no choice, and what a larger tolerance would gain."""
    text = (
        f"no freedom is left: the pose takes all {n_pressures} pressures, so the stiffness is what "
        "it is there"
    )
    if sensitivities is None or sensitivities.objective_unit not in ("N/m", "N*m/rad"):
        return text
    unit = display_units().of_si(sensitivities.objective_unit)
    offers = []
    for term in task.target.terms:
        price = sensitivities.per_tolerance.get(term.name)
        if price and not term.is_inequality:
            factor, shown = term.shown(1.0)
            per = "degree" if shown == "deg" else shown
            offers.append(f"{unit.text(price / factor, '.3g')} per {per}")
    return f"{text}; a larger tolerance would buy {' and '.join(offers)}" if offers else text


def unreachable_message(judgement: Judgement, task: Task, holding: list[str]) -> str:
    """Describe how far the closest configuration is and what holds it back."""
    away: list[str] = []
    beyond: list[str] = []
    for term in task.target.terms:
        value = judgement.errors[term.name]
        if not term.holds(value):
            (beyond if term.is_inequality else away).append(term.words(value))
    if task.scene is not None:
        beyond += _intrusions(task.scene, judgement.intruders)
    misses = [*([f"{' and '.join(away)} away"] if away else []), *beyond]
    held = "no pressure limit holds it back: the target is beyond the arm itself"
    if holding or task.scene is not None:
        held = f"held back by {', '.join(holding) or 'its scene'}"
    return f"unreachable: the closest configuration is {' and '.join(misses)}; {held}"


def no_way_message(judgement: Judgement, task: Task, samples: int) -> str:
    """Explain that no configuration keeps the clearance, and describe the clearest one."""
    assert task.scene is not None
    words = " and ".join(_intrusions(task.scene, judgement.intruders))
    return (
        f"unreachable: no configuration was found whose body keeps the clearance of the scene; the "
        f"clearest of {samples} is {words}"
    )


def in_the_way(robot: Manipulator, scene: Scene, pressures: Array) -> str:
    """List the objects nearer than the clearance at pressures (n,), and by how much."""
    near = robot.clearances(pressures, scene)
    missing = (scene.clearance - near.distances).tolist()
    words = _intrusions(scene, dict(zip(near.names, missing, strict=True)))
    return f"; without its scene the task is solved, with the body {' and '.join(words)}"


def mesh_error(robot: Manipulator, scene: Scene, name: str | None) -> float | None:
    """Return how much too small (m) the clearance of an object may be because of its mesh's grid.

    None if it is no mesh, or if this is less than a tenth of the clearance asked for.
    """
    shape = next((item.shape for item in scene.objects if item.name == name), None)
    if shape is None:
        return None
    radius = max(segment.outer_radius for segment in robot.description.segments)
    error = shape.error_at(radius + scene.clearance)
    return error if error > max(scene.clearance / 10, OBSTACLES.allowed) else None


def coarse_meshes(robot: Manipulator, scene: Scene | None, names: Iterable[str]) -> str:
    """List the objects that may hold an arm back only because their grids are coarse."""
    errors = {name: mesh_error(robot, scene, name) for name in names} if scene is not None else {}
    return "".join(
        f"; distances from '{name}' are up to {display_units().length.text(error, '.2g')} too "
        "small: a finer 'resolution' of its mesh would leave more room"
        for name, error in errors.items()
        if error
    )


def _intrusions(scene: Scene, missing: dict[str, float]) -> list[str]:
    """Describe by how much (m) the body lacks the clearance of each object that is too near."""
    shapes = {item.name: item.shape for item in scene.objects}
    return [
        f"{display_units().length.text(lack, '.3g')} {shapes[name].amiss} '{name}'"
        for name, lack in missing.items()
        if lack > OBSTACLES.allowed
    ]


def demands_message(judgement: Judgement) -> str:
    """Describe the stiffness that is not possible at the pose, and the best that is."""
    missed = "; ".join(judgement.shortfalls)
    return f"unreachable: the pose can be had, but not this stiffness there: {missed}"
