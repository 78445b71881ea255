"""Map where a post or a wall would help an arm most to be stiff, and test the best places.

The map is of first order, about the best answer without the object and other postures at the
target. An arm that leans at the station s, with the normal n, has the tip compliance

    C_tt - C_ts n (n' C_ss n)^-1 n' C_st,

and a push of the margin m along d changes the contact force by ``m n' C_st d / n' C_ss n``. The
contact must carry more than that beforehand. `solve_pressure` then solves the task with an object
at the most promising places.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Literal, get_args

import numpy as np

from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.errors import InputError
from stiffopt.model.compliance import stiffness_of
from stiffopt.model.contact.equilibrium import Contact
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene, SceneObject
from stiffopt.model.stopping import Cancel
from stiffopt.optimise.brace import Brace
from stiffopt.optimise.braced import least_maximised
from stiffopt.optimise.measures.directional import StiffnessMeasure
from stiffopt.optimise.prepared import prepared
from stiffopt.optimise.problem import PressureProblem
from stiffopt.optimise.reach import reach
from stiffopt.optimise.search import starts
from stiffopt.optimise.solution import PressureSolution
from stiffopt.optimise.solver import solve_pressure
from stiffopt.optimise.task import Task
from stiffopt.schema import BadKeyError

Kind = Literal["post", "wall"]

POST_RADIUS, POST_LENGTH = 5e-3, 0.12  # m
_FIRST = 0.25  # of the arm's length, first station
_FREE_TIP = 2.0  # outer radii between the last station and the tip
_STATIONS, _SIDES, _BODY = 32, 36, 60
_FORCE = 3.0  # contact force over the least that the margin needs
_SHARE = 0.8  # of the largest force, at most
_ON_WAY = np.linspace(0.0, 1.0, 11)[:-1]  # shares of the pressures, as the arm comes from rest
_SPARE = 1e-3  # m, by which the free arm may come nearer on its way than at its end
_APART = 20e-3  # m on the body, between two places that are tested
_TESTS, _WANTED = 8, 3  # of each kind
_TRIED, _POSTURES = 64, 9  # starts that are brought to the target, and postures in addition
_WORTH = 1.05  # times the free stiffness, from which an object is suggested


@dataclass(frozen=True)
class Support:
    """A post or a wall that would make an arm stiffer.

    Attributes
    ----------
    kind : "post" or "wall".
    side : angle about the body there on which it would be, from the section's x axis, in rad.
    object : as it would be in a scene file.
    solution : the task's answer that leans on it.
    """

    kind: Kind
    side: float
    object: SceneObject
    solution: PressureSolution

    @property
    def touched(self) -> str:
        """Where and how hard it would be touched, in words."""
        units = display_units()
        force = units.force.text(self.force, ".2g")
        return f"touched {units.length.text(self.at, '.0f')} along the arm with {force}"

    @property
    def at(self) -> float:
        """Station of the body where the contact force is largest, arc length at rest, in m."""
        return max(self.solution.contacts, key=_size).at

    @property
    def force(self) -> float:
        """That force, in N."""
        return max(map(_size, self.solution.contacts))


def _size(contact: Contact) -> float:
    return float(np.linalg.norm(contact.force))


@dataclass(frozen=True)
class SupportMap:
    """Where a post or a wall would help; see `suggest_supports`.

    Attributes
    ----------
    free : the best answer without the object.
    at : stations (s,) of the body, arc lengths at rest, in m.
    sides : angles (a,) about the body, from the section's x axis, in rad.
    stiffness : for each kind (s, a), to first order, the smallest that is maximised, in N/m, if the
        arm leant on such an object there. NaN where none can be: the arm would run into it on its
        way from rest, or the margin needs a contact force that is not allowed.
    supports : places that were tested, stiffest first.
    """

    free: PressureSolution
    at: Array
    sides: Array
    stiffness: dict[Kind, Array]
    supports: tuple[Support, ...]

    def times(self, support: Support) -> float:
        """Return the stiffness with a support over that without."""
        return times(support.solution, self.free)


def times(solution: PressureSolution, free: PressureSolution) -> float:
    """Return the smallest stiffness that is maximised, over that of another solution."""
    first, second = (least_maximised(each.task, each.stiffnesses) for each in (solution, free))
    return first / second


def suggest_supports(
    robot: Manipulator,
    task: Task,
    max_force: float = 0.3,
    *,
    seed: int = 0,
    timeout: float | None = None,
    cancel: Cancel | None = None,
) -> SupportMap:
    """Return where a post or a wall would make a task's answer stiffest.

    Parameters
    ----------
    robot : Manipulator
    task : Task
        It maximises a stiffness against translation.  A `brace` of it only gives the margin, and
        the arm keeps clear of its objects.
    max_force : float
        Largest contact force, in N.
    seed, timeout, cancel :
        Of each answer, see `solve_pressure`.

    Raises
    ------
    InputError
        The task is not of that kind, or has no answer without the object.
    """
    measures = _maximised(task)
    if not max_force > 0:
        raise InputError(f"max_force must be positive; got {max_force!r}")
    margin = (task.brace or Brace(objects=("any",))).margin
    free = solve_pressure(robot, task.unbraced, seed=seed, timeout=timeout, cancel=cancel)
    if not free.found or free.pressures is None:
        raise InputError(f"without a new object the task has no answer: {free.message}")
    postures = [
        _Posture(free.robot or robot, p, measures, margin, max_force)
        for p in (free.pressures, *islice(_at_target(robot, task.unbraced, seed), _POSTURES))
    ]
    stiffness, found = {}, []
    for kind in get_args(Kind):
        known = np.array([each.stiffness(kind) for each in postures])  # (postures, s, a)
        own: list[Support] = []
        for which, row, column in islice(_best(postures[0], known), _TESTS):
            there, name = postures[which], _free_name(task, kind)
            item = there.object(kind, row, column, name, max_force)
            leaning = _leaning(task, item, margin)
            if _is_at_base(robot, leaning, item):
                continue
            answer = solve_pressure(robot, leaning, seed=seed, timeout=timeout, cancel=cancel)
            places = [each.at for each in answer.contacts]
            if not places or max(places) > there.last or times(answer, free) < _WORTH:
                continue
            own.append(Support(kind, float(there.sides[column]), item, answer))
            if len(own) == _WANTED:
                break
        stiffness[kind] = known.max(axis=0)
        stiffness[kind][np.isneginf(stiffness[kind])] = np.nan
        found += own
    found.sort(key=lambda each: -times(each.solution, free))
    first = postures[0]
    return SupportMap(free, first.at, first.sides, stiffness, tuple(found))


def _at_target(robot: Manipulator, task: Task, seed: int) -> Iterator[Array]:
    """Yield pressures (n,) at a task's target, unlike each other."""
    ready = prepared(robot, task, seed)
    problem = PressureProblem(ready.robot, task)
    for x in islice(starts(problem, ready.samples)[0], _TRIED):
        point = reach(problem, x)
        if point is not None and point.reached:
            yield point.x * problem.unit


def _best(posture: _Posture, stiffness: Array) -> Iterator[tuple[int, int, int]]:
    """Yield the indices of posture, station and side, stiffest first, none near an earlier one.

    The stiffness (postures, s, a) is -inf where there can be no object. Places are near each other
    on the body, in whatever posture.
    """
    taken = np.zeros((0, 3))
    for flat in np.argsort(-stiffness, axis=None, kind="stable"):
        which, row, column = (int(each) for each in np.unravel_index(flat, stiffness.shape))
        if np.isneginf(stiffness[which, row, column]):
            return
        side, radius = posture.sides[column], posture.radius[row]
        place = np.array([radius * np.cos(side), radius * np.sin(side), posture.at[row]])
        if (np.linalg.norm(taken - place, axis=1) > _APART).all():
            taken = np.vstack([taken, place])
            yield which, row, column


def _maximised(task: Task) -> list[StiffnessMeasure]:
    measures = () if task.stiffness is None else task.stiffness.maximise
    found = [each for each in measures if isinstance(each, StiffnessMeasure)]
    if not found or len(found) < len(measures) or any(m.kind != "translation" for m in found):
        raise InputError(
            "a post or a wall can be suggested for a task that maximises a stiffness against "
            "translation, under stiffness.maximise"
        )
    if task.press is not None:
        raise InputError("a post or a wall cannot be suggested for a task with press")
    return found


def _free_name(task: Task, kind: Kind) -> str:
    taken = {item.name for item in task.scene.objects} if task.scene is not None else set()
    names = (f"new {kind}{number}" for number in ("", *(f" {k}" for k in range(2, 99))))
    return next(name for name in names if name not in taken)


def _leaning(task: Task, item: SceneObject, margin: float) -> Task:
    scene = task.scene or Scene(objects=(item,))
    others = () if task.scene is None else task.scene.objects
    return task.model_copy(
        update={
            "scene": scene.model_copy(update={"objects": (*others, item)}),
            "brace": Brace(objects=(item.name,), margin=margin),
        }
    )


def _is_at_base(robot: Manipulator, task: Task, item: SceneObject) -> bool:
    """Return True if the arm's base is nearer to an object than the scene's clearance allows."""
    assert task.scene is not None
    try:
        item.shape.check_against(robot.description, task.scene.clearance)
    except BadKeyError:
        return True
    return False


class _Posture:
    """An arm at pressures (n,), and objects that touch its stations (s,) on sides (a,)."""

    def __init__(
        self,
        robot: Manipulator,
        p: Array,
        measures: list[StiffnessMeasure],
        margin: float,
        max_force: float,
    ) -> None:
        length, radius = robot.length, robot.description.segments[-1].outer_radius
        self.at = np.linspace(_FIRST * length, length - _FREE_TIP * radius, _STATIONS)
        self.last = length - radius  # beyond that the tip is not free
        self.sides = np.linspace(0.0, 2 * np.pi, _SIDES, endpoint=False)
        poses, tip = robot.pose(p, self.at), robot.tip_pose(p)
        around = np.stack([np.cos(self.sides), np.sin(self.sides), 0 * self.sides], axis=1)
        self._out = np.einsum("sij,aj->sai", poses[:, :3, :3], around)  # to the object, -n
        self.radius = robot.body_radius(p, self.at)
        self._axes = np.cross(poses[:, None, :3, 2], self._out)
        here = robot.compliance_between(p, self.at, self.at)[:, :3, :3]
        to_tip = robot.compliance_between(p, self.at, np.full(_STATIONS, length))[:, :3]
        own = robot.compliance_between(p, [length], [length])[0]
        soft = np.einsum("sai,sij,saj->sa", self._out, here, self._out)
        coupled = np.einsum("sai,sij->saj", self._out, to_tip)  # (s, a, 6)
        C = own - coupled[..., :, None] * coupled[..., None, :] / soft[..., None, None]
        ways = [tip[:3, :3] @ m.direction if m.frame == "tip" else m.direction for m in measures]
        self._braced = np.min(
            [
                stiffness_of(C, np.broadcast_to(way, (*soft.shape, 3)), m.kind, m.boundary)
                for way, m in zip(ways, measures, strict=True)
            ],
            axis=0,
        )
        needed = margin * np.max([np.abs(coupled[..., :3] @ way) for way in ways], axis=0) / soft
        # how far the contact moves the body if pressures of least norm hold the tip
        J = np.einsum("sij,sjn->sin", poses[:, :3, :3], robot.body_jacobian(p, self.at)[:, :3])
        held = J @ np.linalg.pinv(tip[:3, :3] @ robot.tip_jacobian(p)[:3])
        yields = soft - np.einsum("sai,sij,saj->sa", self._out, held, coupled[..., :3])
        self._depth = np.minimum(_FORCE * needed, _SHARE * max_force) * yields
        self._holds = needed < _SHARE * max_force
        outwards = (self.radius[:, None] - self._depth)[..., None] * self._out
        self.surface = poses[:, None, :3, 3] + outwards  # of an object (s, a, 3)
        shares = np.append(_ON_WAY, 1.0)[:, None] * p
        self._body = np.linspace(1e-3, 1.0, _BODY) * length
        self._lines = robot.pose(shares, self._body)[..., :3, 3]
        self._radii = robot.body_radius(shares, self._body)

    def stiffness(self, kind: Kind) -> Array:
        """Return stiffnesses (s, a) in contact, in N/m; -inf where there can be no object."""
        gaps = np.array([self._distances(kind, line) for line in self._lines])  # (way, s, a, body)
        gaps -= self._radii[:, None, None]
        nearest = self._body[gaps[-1].argmin(axis=-1)]
        is_first = np.abs(nearest - self.at[:, None]) < self.radius[0]
        least = gaps[:-1].min(axis=-1)
        is_clear = least[0] > _SPARE
        passes = least.min(axis=0) > -np.maximum(self._depth, 0.0) - _SPARE
        is_possible = self._holds & is_first & is_clear & passes
        return np.asarray(np.where(is_possible, self._braced, -np.inf))

    def _distances(self, kind: Kind, points: Array) -> Array:
        """Return distances (s, a, k) of points (k, 3) from the objects."""
        surface, out = self.surface, self._out
        if kind == "wall":
            level: Array = np.einsum("sai,sai->sa", surface, out)
            return np.asarray(level[..., None] - np.einsum("sai,ki->sak", out, points))
        apart = points - (surface + POST_RADIUS * out)[..., None, :]
        along = np.einsum("saki,sai->sak", apart, self._axes)
        along = np.clip(along, -POST_LENGTH / 2, POST_LENGTH / 2)
        across = apart - along[..., None] * self._axes[..., None, :]
        return np.asarray(np.linalg.norm(across, axis=-1) - POST_RADIUS)

    def object(self, kind: Kind, row: int, column: int, name: str, max_force: float) -> SceneObject:
        """Return the object at a place."""
        surface, out = self.surface[row, column], self._out[row, column]
        contact = {"allowed": True, "max_force": max_force}
        shape: dict[str, object]
        if kind == "wall":
            shape = {"half_space": {"point": tuple(surface), "normal": tuple(-out)}}
        else:
            centre, axis = surface + POST_RADIUS * out, self._axes[row, column] * POST_LENGTH / 2
            ends = {"from": tuple(centre - axis), "to": tuple(centre + axis)}
            shape = {"capsule": {**ends, "radius": POST_RADIUS}}
        return SceneObject.model_validate({"name": name, "contact": contact, **shape})
