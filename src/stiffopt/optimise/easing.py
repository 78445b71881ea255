"""Ease an arm that comes into contact of the friction that its way leaves.

A body that has slid comes to the end of its way with tangential forces t on their cones, against
the slide (`stiffopt.model.contact.way`). With their derivatives T by the pressures, while contacts
stick, choose dp so that::

    T dp = t

Where the pressures go on past their end by dp, the body slides on, with the same t. On the way back
it sticks, and t - T dp = 0 is left. What is left in fact, as T is not the same there, corrects dp.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError
from stiffopt.model.arm_clearance import measured_scene
from stiffopt.model.contact.equilibrium import ContactEquilibrium
from stiffopt.model.contact.way import Rubbing, rubbed, rubbings
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.optimise.brace import kept_clear_of
from stiffopt.optimise.quadratic import solve_qp
from stiffopt.optimise.settings import BRACE
from stiffopt.optimise.task import Task

STATES = 12  # equilibria from the end of a way to where it turns, and as many back
_ROUNDS = 3
_STATIONS = 41  # of the body
_FORGIVEN = 1e-4  # m, tolerated lack of clearance from other objects
_LESS = 0.05  # share by which contact forces should be smaller where it turns
_LITTLE = 1e-3  # weight of pressures, in 1 / bar^2
_BAR = 1e5  # Pa


def eased(
    arm: Manipulator, task: Task, scene: Scene, states: Sequence[ContactEquilibrium]
) -> tuple[list[ContactEquilibrium], Rubbing]:
    """Return a way that ends where another one does, with little friction, and what is left of it.

    It is the same way, unless friction keeps the tip from the target. Then it goes past its end and
    comes back to the same equilibrium, if this leaves less friction, and meanwhile the arm leans,
    keeps clear of the other objects, and presses none with more than its greatest force, or by
    friction with more than a tenth above it.

    Parameters
    ----------
    scene : the objects that the arm may lean on.
    states : equilibria from rest.

    Raises
    ------
    EquilibriumError
        The arm touches nothing at the end.
    """
    way, end, found = list(states), states[-1], rubbed(states)
    best, past, least = (way, found), np.zeros_like(end.pressures), _away(found)
    limits = task.pressure_bounds(arm.description)
    if distance_left(arm, task, end, found) <= allowed_distance(task):
        return best
    assert task.scene is not None
    assert task.brace is not None
    others = kept_clear_of(task.scene, task.brace)
    for _ in range(_ROUNDS):
        if _away(found) <= BRACE.missed:
            break
        past = past + _going_on(end, found, limits[0] - past, limits[1] - past)
        try:
            back = _past_and_back(arm, scene, end, past)
        except EquilibriumError:
            break
        apart = float(np.linalg.norm(back[-1].tip_pose[:3, 3] - end.tip_pose[:3, 3]))
        followed = list(rubbings([*way, *back]))[len(way) :]
        last = followed[-1]
        if last is None or apart > BRACE.same or not all(map(_is_allowed, back[:-1], followed)):
            break
        if others is not None and missing_clearance(arm, others, back) > 0:
            break
        found = last
        if _away(found) < least:
            best, least = ([*way, *back], found._replace(past=past)), _away(found)
    return best


def body_lines(arm: Manipulator, states: Sequence[ContactEquilibrium]) -> tuple[Array, Array]:
    """Return stations (stations,) and the centre line there, in each state (k, stations, 3)."""
    at = np.linspace(0.0, arm.length, _STATIONS)
    return at, np.array([eq.poses(at)[:, :3, 3] for eq in states])


def missing_clearance(
    arm: Manipulator, others: Scene, states: Sequence[ContactEquilibrium]
) -> float:
    """Return by how much the body comes nearer to objects than their clearance, in m.

    0 if it keeps clear of all within 0.1 mm, in all states.
    """
    at, lines = body_lines(arm, states)
    radii = arm.body_radius(np.zeros(arm.n_pressures), at)
    least = np.inf
    for item in measured_scene(others, arm.description).items:
        gaps = item.distances(lines.reshape(-1, 3)).values.reshape(lines.shape[:2]) - radii
        least = min(least, gaps[:, at >= item.begin].min(initial=np.inf))
    missing = others.clearance - float(least)
    return missing if missing > _FORGIVEN else 0.0


def allowed_distance(task: Task) -> float:
    """Return how far from its target friction may keep the tip, in m."""
    return max(task.target.tolerance.position, BRACE.missed)


def distance_left(arm: Manipulator, task: Task, eq: ContactEquilibrium, rubbing: Rubbing) -> float:
    """Return how far from its target a tip stays that friction has moved, in m; see `corrected`.

    The contacts stick meanwhile.
    """
    position = task.target.position
    if position is None:
        return 0.0
    rows = [i for i, each in enumerate(position) if each is not None]
    R, held = eq.tip_pose[:3, :3], rubbing.sticking
    jacobian = R @ eq.tip_jacobian[:3] + held.bent()[0][:3] @ held.per_pressure
    aim = np.array([0.0 if each is None else each for each in position])
    off = eq.tip_pose[:3, 3] + rubbing.tip - aim
    limits = task.pressure_bounds(arm.description)
    return corrected(eq.pressures, limits, off[rows], jacobian[rows])


def corrected(pressures: Array, limits: tuple[Array, Array], off: Array, jacobian: Array) -> float:
    """Return how far from its place a tip that is off by so much (k,) stays, in m.

    The pressures (n,) change by at most `BRACE.corrected` each, within their limits (n,);
    `jacobian` (k, n).
    """
    most = BRACE.corrected
    low = np.maximum(limits[0] - pressures, -most) / most
    high = np.minimum(limits[1] - pressures, most) / most
    # in mm, with little weight on the changes themselves
    A, b, n = 1e3 * most * jacobian, 1e3 * off, len(pressures)
    H, g, none = A.T @ A + 1e-6 * np.eye(n), A.T @ b, np.zeros((0, n))
    found = solve_qp(H, g, none, np.minimum(low, 0.0), np.maximum(high, 0.0))
    step = np.zeros(n) if found is None else found[0]
    return float(np.linalg.norm(off + most * jacobian @ step))


def _is_allowed(eq: ContactEquilibrium, found: Rubbing | None) -> bool:
    """Return whether an arm leans with at most the greatest forces, or a tenth more by friction."""
    if found is None:
        return False
    for own, force in eq.pressed():
        most = eq.contacts[own[0]].max_force
        if force > most or force + found.pressing(own) > most * (1 + BRACE.rubbed):
            return False
    return True


def _away(found: Rubbing) -> float:
    return float(np.linalg.norm(found.tip))


def _past_and_back(
    arm: Manipulator, scene: Scene, end: ContactEquilibrium, past: Array
) -> list[ContactEquilibrium]:
    """Return equilibria from one to pressures that differ by `past` (n,), in Pa, and back."""
    shares, there = np.arange(1, STATES + 1) / STATES, end
    found = []
    for share in [*shares, *shares[-2::-1], 0.0]:
        there = arm.contact_equilibrium(end.pressures + share * past, scene, nearby=there)
        found.append(there)
    return found


def _going_on(end: ContactEquilibrium, found: Rubbing, low: Array, high: Array) -> Array:
    """Return the least change dp (n,) of the pressures with T dp = t, as far as limits allow.

    Contact forces hardly change by it. `low`, `high`: limits (n,) of the pressures at the end.
    """
    whole = max(float(end.normal_forces.sum()), 1e-6)
    size = max(float(np.linalg.norm(found.tangential)), 1e-6)
    A = _BAR * np.vstack([found.sticking.per_pressure / size, end.force_gradients / whole])
    b = np.concatenate([found.tangential / size, -_LESS * end.normal_forces / whole])
    n = len(end.pressures)
    bounds = (
        np.minimum((low - end.pressures) / _BAR, 0.0),
        np.maximum((high - end.pressures) / _BAR, 0.0),
    )
    change = solve_qp(A.T @ A + _LITTLE * np.eye(n), -A.T @ b, np.zeros((0, n)), *bounds)
    return np.zeros(n) if change is None else _BAR * change[0]
