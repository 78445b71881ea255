"""Search for braced answers, in which the arm leans on objects.

Samples whose body would enter an object are ranked by the tip position that the contact would
cause.  To first order, a contact at the station s of least gap g has the force
``f = -g / (n' C_ss n)`` and moves the tip by ``C_ts n f``.  The best ones, unlike each other, are
brought to the target in contact, exactly and from rest.  Descents of `optimise.local` start from
the stiffest of them, and their ends are judged at the equilibrium that is reached from rest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from copy import copy
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.errors import EquilibriumError, StoppedError
from stiffopt.model.arm_clearance import measured_scene
from stiffopt.model.contact.equilibrium import ContactEquilibrium, inside_at_rest
from stiffopt.model.contact.way import Rubbing
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.brace import quoted
from stiffopt.optimise.brace_uncertainty import BraceUncertainty
from stiffopt.optimise.leaning import FORCE_ON, MARGIN_ON, RIGID, BracedPoint, BracedProblem
from stiffopt.optimise.local import LocalResult, descend
from stiffopt.optimise.prices import prices_at
from stiffopt.optimise.problem import ProgramPoint
from stiffopt.optimise.program import Constraint
from stiffopt.optimise.reach import attempt, within
from stiffopt.optimise.reach_in_contact import reach_in_contact
from stiffopt.optimise.samples import SampleTable, distances
from stiffopt.optimise.search import Search, search, unlike_first
from stiffopt.optimise.settings import BRACE, Effort
from stiffopt.optimise.solution import Confidence, Judgement, PressureSolution, active_bounds
from stiffopt.optimise.task import Task

_LEAST_YIELDING = 1e-9  # m/N, of a contact, so that one at the base, which cannot yield, ranks last


def candidates(problem: BracedProblem, table: SampleTable) -> Iterator[Array]:
    """Yield variables (n,) at which the arm would lean on an object, the most promising first.

    Objects take turns, and promising starts alternate with arbitrary ones, since the estimate is
    poor for a deep contact. Starts unlike each other come before the rest.
    """
    robot, terms = problem.robot, problem.program.terms
    at = np.linspace(0, robot.length, BRACE.stations + 1)[1:]
    points = robot.pose(table.pressures, at)[..., :3, 3]
    radii = robot.body_radius(table.pressures, at)
    rows: list[list[int]] = []
    for item in measured_scene(problem.scene, robot.description).items:
        seen = item.distances(points.reshape(-1, 3))
        gaps = seen.values.reshape(radii.shape) - radii
        gaps[:, at < item.begin] = np.inf
        station, deepest = gaps.argmin(axis=1), gaps.min(axis=1)
        arbitrary = entering = np.flatnonzero(deepest < 0)
        rough = table.distances(terms, robot.length)[entering]
        entering = entering[np.argsort(rough, kind="stable")[: BRACE.screened]]
        normals = seen.normals.reshape(*radii.shape, 3)[entering, station[entering]]
        if not len(entering):
            continue
        moved = _moved_by_contact(
            robot, table.pressures[entering], at, station[entering], normals, -deepest[entering]
        )
        poses = _displaced(table.poses[entering], moved)
        ranked = entering[np.argsort(distances(poses, terms, robot.length), kind="stable")]
        pairs = np.stack([ranked, arbitrary[: len(ranked)]], axis=1).ravel()
        mixed = np.array(list(dict.fromkeys(pairs.tolist())))[: 8 * BRACE.effort.screened]
        x = table.pressures[mixed] / problem.unit
        rows.append([int(mixed[i]) for i in unlike_first(problem, x)])
    for turn in range(max(map(len, rows), default=0)):
        for own_rows in rows:
            if turn < len(own_rows):
                yield table.pressures[own_rows[turn]] / problem.unit


def _moved_by_contact(
    robot: Manipulator, p: Array, at: Array, station: NDArray[np.intp], n: Array, depth: Array
) -> Array:
    """Return twists (N, 6) of the tip, in base axes, due to a contact at a station of each row."""
    ends = np.full(len(at), robot.length)
    C = robot.compliance_between(p, np.concatenate([at, ends]), np.concatenate([at, at]))
    rows = np.arange(len(p))
    at_contact, to_tip = C[rows, station, :3, :3], C[rows, len(at) + station, :, :3]
    yielding = np.einsum("ni,nij,nj->n", n, at_contact, n)
    force = depth / np.maximum(yielding, _LEAST_YIELDING)
    return np.einsum("nij,nj,n->ni", to_tip, n, force)


def _displaced(poses: Array, twists: Array) -> Array:
    """Move poses (N, 4, 4) by twists (N, 6) in base axes."""
    found = poses.copy()
    found[:, :3, 3] += twists[:, :3]
    for T, twist in zip(found, twists, strict=True):
        T[:3, :3] = lie.exp(np.concatenate([np.zeros(3), twist[3:]]))[:3, :3] @ T[:3, :3]
    return found


def _places(
    problem: BracedProblem, starts: Iterable[Array]
) -> Iterator[tuple[int, ProgramPoint | None]]:
    """Yield points at the target in contact to descend from; see `search`.

    Starts are brought there by rounds, each when those before were not enough.  In a round the
    stiffest come first.
    """
    remaining, tried, arrived = iter(starts), 0, False
    while some := list(islice(remaining, BRACE.effort.screened)):
        found: list[tuple[float, BracedPoint]] = []
        for x in some:
            tried += 1
            try:
                found += _brought(problem, x)
            except StoppedError:
                if not (arrived or found):
                    raise
                remaining = iter(())
                break
        arrived = arrived or bool(found)
        found.sort(key=lambda each: each[0])
        if not found:
            yield tried, None
            continue
        for i in unlike_first(problem, np.array([point.x for _, point in found])):
            point = found[i][1]
            problem.here = point.equilibrium
            yield tried, point


def _brought(problem: BracedProblem, x: Array) -> list[tuple[float, BracedPoint]]:
    """Bring a start to the target in contact; return its objective and point.

    The list is empty if it does not arrive.
    """
    target_only = copy(problem)
    target_only.only_target = True
    target_only.restart()
    point = reach_in_contact(target_only, x)
    if point is None or not point.reached:
        return []
    problem.here, problem.leant = point.equilibrium, True
    point = reach_in_contact(problem, point.x)
    if point is None:
        return []
    if not point.reached:
        problem.missed.append(point)
        return []
    full = attempt(problem.point, point.x)
    return [] if full is None else [(problem.objective.value(full), full)]


def braced_answers(
    problem: BracedProblem, samples: Callable[[], SampleTable], guess: Array | None
) -> Search:
    """Return local optima in contact, best first; only those near a guess, (n,) in Pa, if any."""
    if guess is not None:
        x = within(problem.lower, guess / problem.unit, problem.upper)
        nearby = search(problem, [x], Effort(1, 1, 1), places=_places)
        if nearby.results:
            return nearby
    starts = islice(candidates(problem, samples()), BRACE.rounds * BRACE.effort.screened)
    return search(problem, starts, BRACE.effort, places=_places, best_found=BRACE.best_found)


def from_rest(problem: BracedProblem, result: LocalResult) -> Braced | None:
    """Judge the equilibrium at an optimum that is reached from rest; None without contact."""
    pressures = np.clip(result.point.x, problem.lower, problem.upper) * problem.unit
    try:
        eq = problem.robot.contact_equilibrium(
            pressures, problem.scene, approach=problem.brace.approach
        )
        rubbing = problem.rubbing(eq)
    except EquilibriumError:
        return None
    if not eq.contacts:
        return None
    return Braced(result, eq, problem.judgement(eq, rubbing), rubbing)


def reached_again(problem: BracedProblem, judged: Braced) -> Braced | None:
    """Bring an optimum to the target from its equilibrium from rest, and descend again.

    A descent follows one equilibrium from step to step.  From rest the arm may come to another one
    close by, which misses the target by little.  Then there is more to spare.  Returns None if that
    is not remedied.
    """
    problem = problem.tightened()
    problem.here = judged.equilibrium
    point = reach_in_contact(problem, judged.result.point.x)
    if point is None or not point.reached:
        return None
    result = descend(problem, point)
    if not np.isfinite(result.value):
        return None
    again = from_rest(problem, result)
    return again if again is not None and again.judgement.holds else None


class Braced(NamedTuple):
    """An optimum in contact, with its equilibrium from rest and its judgement.

    Also what friction does on the way there, or None.
    """

    result: LocalResult
    equilibrium: ContactEquilibrium
    judgement: Judgement
    rubbing: Rubbing | None = None

    @property
    def least(self) -> float:
        """The smallest stiffness that is maximised."""
        return least_maximised(self.result.problem.task, self.judgement.stiffnesses)


def least_maximised(task: Task, stiffnesses: tuple[float, ...]) -> float:
    """Return the smallest of the stiffnesses that a task maximises."""
    assert task.stiffness is not None
    return min(stiffnesses[: len(task.stiffness.maximise)])


def lean(
    problem: BracedProblem,
    samples: Callable[[], SampleTable],
    free: PressureSolution,
    guess: Array | None,
) -> PressureSolution:
    """Return the stiffer of the best answer that leans on objects and the free one.

    Parameters
    ----------
    problem : of the task.
    samples : returns its samples; called only if the guess does not suffice.
    free : answer that keeps clear of all objects.
    guess : (n,) in Pa, near the braced answer, or None.
    """
    task, why = problem.task, ""
    _ = free.message  # computed when first read, which must not be when the time has run out
    try:
        found = braced_answers(problem, samples, guess)
    except StoppedError as error:
        if not free.found:
            return replace(free, task=task)
        return _free_answer(task, free, f"the search for where to lean was ended: {error}")
    judged: list[Braced | None] = []
    holding: list[Braced] = []
    for result in found.results[: BRACE.tried]:
        judged.append(from_rest(problem, result))
        seen = judged[-1]
        if seen is not None and seen.judgement.holds:
            holding.append(seen)
            break
        again = None if seen is None else reached_again(problem, seen)
        if again is not None:
            holding.append(again)
    if not holding:
        if free.confidence is not None and any(each is not None for each in judged):
            # a posture was found and refused; another one nearby may hold
            free = replace(free, confidence=replace(free.confidence, complete=False))
        return _free_answer(task, free, _no_brace(problem, judged))
    best = max(holding, key=lambda each: each.least)
    if free.found and least_maximised(task, free.stiffnesses) >= best.least:
        unit = display_units().stiffness
        why = (
            f"leaning on {quoted(problem.brace.objects)} gives no more than {unit.text(best.least)}"
        )
        return _free_answer(task, free, why)
    answer = _braced_answer(problem, best, free, found.confidence_in(best.result))
    message = "; ".join(filter(None, (answer.message, _left_out(judged, best))))
    return replace(answer, message=message)


def _left_out(judged: list[Braced | None], best: Braced) -> str:
    """Tell of an optimum stiffer than the answer that does not hold from rest, or return ""."""
    others = [each for each in judged if each is not None and not each.judgement.holds]
    least = (1 + BRACE.stiffer) * best.least
    others = [each for each in others if least < each.least <= RIGID]
    if not others:
        return ""
    stiffest = max(others, key=lambda each: each.least)
    return (
        f"a posture of {display_units().stiffness.text(stiffest.least)} was left out; when it is "
        f"reached from rest, {_failure(stiffest.judgement)}"
    )


def _failure(judgement: Judgement) -> str:
    """Return the first reason why a judgement does not hold."""
    if judgement.shortfalls:
        return judgement.shortfalls[0]
    if not judgement.pose_holds:
        return "the target is missed by more than its tolerance"
    return "the pressures leave their limits" if judgement.is_clear else "the body hits an object"


def _free_answer(task: Task, free: PressureSolution, why: str) -> PressureSolution:
    message = "; ".join(filter(None, (free.message, why)))
    return replace(free, task=task, message=message, free=free)


def _no_brace(problem: BracedProblem, judged: list[Braced | None]) -> str:
    """Explain why no braced answer was found."""
    names = quoted(problem.brace.objects)
    lacking = [why for each in judged if each is not None for why in each.judgement.shortfalls]
    if lacking:
        return f"leaning on {names} does not do: {lacking[0]}"
    if judged:
        return (
            f"postures that lean on {names} at the target were found, but the arm comes to other "
            "ones from rest"
        )
    unit = display_units().force
    if not problem.missed and problem.leant:
        margin = unit.text(problem.brace.margin)
        return (
            f"leaning on {names} at the target, the arm has no equilibrium under a push of "
            f"{margin}, the margin"
        )
    if not problem.missed:
        why = f"no posture was found that leans on {names} and reaches the target"
        if problem.brace.approach == "pressures":
            try:
                problem.robot.contact_equilibrium(np.zeros(len(problem.unit)), problem.scene)
            except EquilibriumError as error:
                return f"{why}: {error}"
        return why
    point = min(problem.missed, key=_most_missed)
    lacking = [
        f"{name} by {unit.text(error - c.radius, '.2g')}" if _is_force(name) else name
        for name, error, c in _missed(point)
    ]
    return (
        f"leaning on {names} at the target misses what is asked for; the best attempt misses "
        f"{', '.join(dict.fromkeys(lacking))}"
    )


def _is_force(name: str) -> bool:
    return name.startswith((FORCE_ON, MARGIN_ON))


def _missed(point: ProgramPoint) -> list[tuple[str, float, Constraint]]:
    pairs = zip(point.errors, point.constraints, strict=True)
    found = [(c.name, error, c) for error, c in pairs if error > c.radius]
    return [each for each in found if _is_force(each[0])] or found


def _most_missed(point: ProgramPoint) -> float:
    return max(((error - c.radius) / c.scale for _, error, c in _missed(point)), default=0.0)


def _braced_answer(
    problem: BracedProblem, best: Braced, free: PressureSolution, confidence: Confidence
) -> PressureSolution:
    eq, judgement, task, robot = best.equilibrium, best.judgement, problem.task, problem.robot
    problem.here = eq
    return PressureSolution(
        status="solved",
        message="; ".join(
            filter(
                None,
                (
                    at_rest(problem),
                    _doubt(problem, eq),
                    _rubbed(best.rubbing),
                    _other_equilibrium(problem, eq),
                ),
            )
        ),
        task=task,
        pressures=eq.pressures,
        tip_pose=judgement.tip_pose,
        position_error=judgement.errors.get("position"),
        angle_error=judgement.errors.get("angle"),
        compliance=judgement.compliance,
        stiffness=judgement.stiffnesses[0],
        stiffness_unit=task.measures[0].unit,
        stiffnesses=judgement.stiffnesses,
        active_bounds=tuple(active_bounds(robot, task, eq.pressures)),
        confidence=confidence,
        errors=judgement.errors,
        robot=robot,
        contacts=eq.contacts,
        free=free,
        preloads=tuple(problem.preloads(eq)),
        limited_by=_limits(problem, best.result),
    )


def _size(problem: BracedProblem, name: str, radius: float) -> float:
    """Return the full size of a limit, for its price: a force, a margin, or a tolerance."""
    if name.startswith(MARGIN_ON):
        return problem.brace.margin
    forces = {f"{FORCE_ON}{item.name}": item.contact for item in problem.scene.objects}
    contact = forces.get(name)
    return radius if contact is None or contact.max_force is None else contact.max_force


def at_rest(problem: BracedProblem) -> str:
    """Return a message if an object that is in place pushes the arm aside at rest, or ""."""
    robot, scene = problem.robot, problem.scene
    inside = inside_at_rest(robot, scene)
    if not inside or problem.brace.approach == "objects":
        return ""
    if robot.clearance(np.zeros(robot.n_pressures), scene) >= 0:  # its weight moves it away
        return ""
    return f"{inside}, which is taken to push it aside; correct the object's place if it does not"


def _doubt(problem: BracedProblem, eq: ContactEquilibrium) -> str:
    """Return how far a calibrated arm's contact forces are in doubt, or ""."""
    doubt = float(BraceUncertainty(problem.robot, eq).forces.max())
    if doubt == 0.0:
        return ""
    by = display_units().force.text(doubt, ".2g")
    return f"contact forces may be smaller or larger by {by}, by errors of the calibration"


def _rubbed(rubbing: Rubbing | None) -> str:
    """Return what friction does on the way from rest, or ""."""
    if rubbing is None:
        return ""
    units, past = display_units(), ""
    if rubbing.past is not None:
        most = units.pressure.text(float(np.abs(rubbing.past).max()), ".2g")
        past = f"; the way goes past it by {most} and comes back, which eases the friction"
    return (
        f"when it is reached from rest, friction holds the tip "
        f"{units.length.text(float(np.linalg.norm(rubbing.tip)), '.2g')} away, and changes normal "
        f"forces by {units.force.text(float(np.abs(rubbing.normals).max()), '.2g')}, until that is "
        f"corrected{past}"
    )


def _other_equilibrium(problem: BracedProblem, eq: ContactEquilibrium) -> str:
    """Return a message if the arm could also touch nothing at these pressures, or ""."""
    if problem.robot.clearance(eq.pressures, problem.scene) < 0:
        return ""
    tip = problem.robot.tip_pose(eq.pressures)[:3, 3]
    away = display_units().length.text(float(np.linalg.norm(tip - eq.tip_pose[:3, 3])), ".3g")
    names = quoted(problem.brace.objects)
    way = (
        "raise all pressures together from rest"
        if problem.brace.approach == "pressures"
        else f"move {names} to the arm when it is under pressure"
    )
    return (
        f"at these pressures the tip may also come to rest {away} away, clear of {names}; {way} "
        "to reach this answer"
    )


def _limits(problem: BracedProblem, result: LocalResult) -> tuple[str, ...]:
    """Return the constraints and limits that keep a braced answer from being stiffer."""
    point = attempt(problem.needed, result.point.x)
    prices = None if point is None else prices_at(problem, point)
    if point is None or prices is None:
        return ()
    names = [
        ball.name
        for ball, pull in zip(point.bounded, prices.balls, strict=True)
        if float(np.linalg.norm(pull)) * _size(problem, ball.name, ball.radius) > BRACE.least_price
    ]
    bounds = active_bounds(problem.robot, problem.task, point.x * problem.unit)
    names += [
        name
        for name, (index, side) in bounds.items()
        if side * float(prices.bounds[index]) > BRACE.least_price
    ]
    return tuple(dict.fromkeys(names))
