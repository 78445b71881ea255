"""Pushes at the tip of an arm in contact, and the loss of contacts under them."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.contact.rod import TURN
from stiffopt.model.contact.solve import ContactProblem
from stiffopt.model.contact.system import LEAST_COMPLIANCE, Contacts, ContactSystem, LeaningArm

_TILT = 0.5  # rad, largest turn of a contact's normal in a step of a push that slips
_LARGEST_SWING = 0.2  # rad, largest turn of the tip in a step of a push
_FORCE_LEFT = 1e-7  # N; a contact with less force has lifted off
_SAME_LOSS = 0.01  # share by which two foretold losses may differ
_NO_COMPLIANCE = 1e-11  # m/N; with less, a rigid surface holds the tip
_NEW_CONTACT = 0.02  # longest step that adds a contact, over the loss that is foretold
_MOST_STEPS = 150  # of a push, with those that are repeated
_SHORTEST = 1e-6  # share of the largest push; with a shorter step the equilibrium is lost


class ContactLoss(NamedTuple):
    """When and how a push makes the arm lose a contact.

    Attributes
    ----------
    force : of the push at the tip, in N; infinite if no contact is lost.
    object : on which a contact is lost, or None.
    at : arc length of that contact at rest, in m, or None.
    how : "lifts off" or "slips"; "buckles" where the equilibrium loses its stability instead, and
        "snaps" where it ends; "stalls" where the push could not be followed further, though nothing
        is lost yet; or "holds".
    stiffness : along the push, in N/m: just before the loss, and at first if nothing is lost.
    stiffness_after : the same without the contact, or with it slipping.
    """

    force: float
    object: str | None
    at: float | None
    how: str
    stiffness: float
    stiffness_after: float


class _Tangent(NamedTuple):
    """The equations for forces at the tip, and what follows for a push.

    Attributes
    ----------
    system, solution : the equations, and their unknowns (u, 6) for each component of a wrench.
    rates : of the unknowns (u,) per push.
    moves : of the nodes (N + 1, 3) per push.
    turn : of the tip per push, in rad/N.
    stiffness : along the push, in N/m.
    """

    system: ContactSystem
    solution: Array
    rates: Array
    moves: Array
    turn: float
    stiffness: float


class GrowingPush:
    """A push at the tip that grows from zero, along a unit direction (3,) in base axes."""

    def __init__(self, problem: ContactProblem, direction: Array, limit: float) -> None:
        self._problem, self._direction, self._limit = problem, direction, limit

    def slip(self, arm: LeaningArm) -> ContactLoss:
        """Return the first contact that slips or lifts off as the push grows from an equilibrium.

        Contacts with friction stick, and carry no tangential force at first.  One slips when the
        tangential force reaches the coefficient of friction times the normal force; one that the
        push adds may slide without being lost.  The push goes half of the way to the loss that the
        tangent foretells, until that no longer changes.
        """
        friction, count = self._friction(arm.state), len(arm.state.touches)
        sticking = [j for j, each in enumerate(friction) if each > 0]
        force, step, foretold, begin = 0.0, np.inf, -1.0, None
        for _ in range(_MOST_STEPS):
            tangent = self._tangent(arm, sticking)
            begin = begin if begin is not None else tangent.stiffness
            left, lost, how = _first_loss(arm, tangent, friction, self._limit - force)
            total = force + left
            if lost is not None and lost >= count and how == "slips":
                friction[lost] = 0.0
                sticking.remove(lost)
                continue
            if left == 0.0:
                break
            is_known = abs(total - foretold) <= _SAME_LOSS * total
            step = min(step, left if is_known else left / 2)
            step = min(step, _LARGEST_SWING / max(tangent.turn, 1e-9))
            push = step * np.concatenate([self._direction, np.zeros(3)])
            found = self._problem.pushed(tangent.system, tangent.solution, push)
            missed = None if found is None else self._problem.missed(found)
            if found is None or missed is None or _has_tilted(arm, found):
                step /= 2
                if step < _SHORTEST * self._limit:
                    return ContactLoss(force, None, None, "snaps", tangent.stiffness, 0.0)
                continue
            if missed and step > _NEW_CONTACT * total:
                step /= 2
                continue
            if not self._is_stable(found, sticking):
                if step < _SAME_LOSS * (force + step):
                    return ContactLoss(force, None, None, "buckles", tangent.stiffness, 0.0)
                step /= 2
                continue
            if is_known and not missed and step == left:
                break
            if missed:
                touches = (*found.state.touches, *missed)
                state = self._problem.with_touches(found.state, touches)
                friction += self._friction(state)[len(friction) :]
                sticking = [j for j, each in enumerate(friction) if each > 0]
                found = self._problem.correct(state, sticking) or found
            arm, force, step, foretold = found, force + step, np.inf, total
        else:
            return ContactLoss(force, None, None, "stalls", tangent.stiffness, 0.0)
        if lost is None:
            return ContactLoss(np.inf, None, None, how, begin, begin)
        touches = arm.state.touches
        if how == "slips":
            after = self._tangent(arm, [j for j in sticking if j != lost]).stiffness
        else:
            rest = (*touches[:lost], *touches[lost + 1 :])
            kept = [j - (j > lost) for j in sticking if j != lost]
            found = self._problem.correct(self._problem.with_touches(arm.state, rest), kept)
            after = 0.0 if found is None else self._tangent(found, kept).stiffness
        name = self._problem.surfaces[touches[lost].surface].name
        at = touches[lost].station
        return ContactLoss(total, name, at, how, tangent.stiffness, after)

    def foretold(self, arm: LeaningArm, *, sticks: bool) -> float:
        """Return the push at which the tangent at no push foretells a loss; see `foretold_loss`."""
        if not sticks:
            own, slopes = _forces(arm), self._rates(arm)[0]
            return float(_until_zero(own, slopes).min(initial=np.inf))
        friction = self._friction(arm.state)
        tangent = self._tangent(arm, [j for j, each in enumerate(friction) if each > 0])
        return _first_loss(arm, tangent, friction, np.inf)[0]

    def _friction(self, state: Contacts) -> list[float]:
        return [self._problem.surfaces[touch.surface].friction for touch in state.touches]

    def _tangent(self, arm: LeaningArm, sticking: Collection[int]) -> _Tangent:
        system, solution = arm.pushed(sticking)
        changes, moves = system.along(solution)
        along = moves[..., :3] @ self._direction
        turn = float(np.linalg.norm(changes[0, TURN, :3] @ self._direction))
        rates = solution[:, :3] @ self._direction
        stiffness = rigid_if_huge(float(self._direction @ along[0]))
        return _Tangent(system, solution, rates, along, turn, stiffness)

    def _is_stable(self, arm: LeaningArm, sticking: Collection[int]) -> bool:
        """Return whether an arm is stable, with contacts that slide, or else with those that stick.

        With the latter, a stiffness passes zero where stability is lost, so a compliance of the tip
        passes infinity and becomes negative.
        """
        settled = self._problem.settle(arm.state)  # points may have become lines
        if settled is not None and settled.is_stable:
            return True
        if not sticking:
            return False
        tangent = self._tangent(arm, sticking)
        compliance = tangent.system.of_tip(tangent.solution)[:6]
        scale = np.repeat([1.0, 1 / self._problem.rod.arm.length], 3)
        values = np.linalg.eigvals(scale[:, None] * compliance * scale)
        return not (values.real < -LEAST_COMPLIANCE * np.abs(values).max() - abs(values.imag)).any()

    def loss(self, arm: LeaningArm) -> ContactLoss:
        """Return the first contact that is lost as the push grows from an equilibrium."""
        without, force, step = arm.state.condition.dead, 0.0, np.inf
        *_, begin = self._rates(arm)
        for _ in range(_MOST_STEPS):
            own = _forces(arm)
            slopes, turn, stiffness = self._rates(arm)
            # a contact is lost where its force is zero, by Newton's method from one side
            until = _until_zero(own, slopes)
            step = min(step, _LARGEST_SWING / max(turn, 1e-9), self._limit - force)
            ahead = min(step, float(until.min(initial=np.inf)))
            dead = without + np.concatenate([(force + ahead) * self._direction, np.zeros(3)])
            start = arm.state._replace(condition=arm.state.condition._replace(dead=dead))
            found = self._problem.correct(start)
            if found is None or self._problem.is_far(start, found):
                if ahead < _SHORTEST * self._limit:
                    return ContactLoss(force, None, None, "snaps", stiffness, 0.0)
                step = ahead / 2
                continue
            forces = _forces(found)
            if (forces < -_FORCE_LEFT).any():
                step = ahead * min(0.9, max(0.1, float((own / (own - forces))[forces < 0].min())))
                continue
            missed = self._problem.missed(found)
            if missed != [] and ahead > _NEW_CONTACT * (force + ahead):
                step = ahead / 2
                continue
            settled = self._problem.settle(found.state) or found  # points may become lines
            if not settled.is_stable:
                if ahead < _SAME_LOSS * (force + ahead):
                    return ContactLoss(force, None, None, "buckles", stiffness, 0.0)
                step = ahead / 2
                continue
            force, step = force + ahead, np.inf
            if (forces < _FORCE_LEFT).any():
                return self._lifted(found, force, int(np.argmin(forces)))
            arm = settled
            if force >= self._limit * (1 - 1e-12):
                return ContactLoss(np.inf, None, None, "holds", begin, begin)
        return ContactLoss(force, None, None, "stalls", stiffness, 0.0)

    def _rates(self, arm: LeaningArm) -> tuple[Array, float, float]:
        """Return changes (k,) of normal forces and of the tip's turn per push; a stiffness."""
        found = arm.tangent[:, :3] @ self._direction
        stiffness = rigid_if_huge(float(self._direction @ found[:3]))
        return found[6:], float(np.linalg.norm(found[3:6])), stiffness

    def _lifted(self, arm: LeaningArm, force: float, lost: int) -> ContactLoss:
        state = arm.state
        *_, before = self._rates(arm)
        touches = (*state.touches[:lost], *state.touches[lost + 1 :])
        found = self._problem.correct(self._problem.with_touches(state, touches))
        after = 0.0 if found is None else self._rates(found)[2]
        touch = state.touches[lost]
        name = self._problem.surfaces[touch.surface].name
        return ContactLoss(force, name, touch.station, "lifts off", before, after)


def rigid_if_huge(compliance: float) -> float:
    """Return the stiffness in N/m; infinite where the compliance is zero but for rounding."""
    return 1 / compliance if abs(compliance) > _NO_COMPLIANCE else np.inf


def _until_zero(own: Array, slopes: Array) -> Array:
    """Return the pushes (k,) at which forces (k,) vanish; infinite for those that grow."""
    return np.divide(own, -slopes, out=np.full(len(own), np.inf), where=slopes < 0)


def _forces(arm: LeaningArm) -> Array:
    return np.array([touch.normal_force for touch in arm.state.touches])


def _has_tilted(before: LeaningArm, after: LeaningArm) -> bool:
    """Return whether the normal of a contact has turned too much for a step."""
    rows = zip(before.rows, after.rows, strict=True)
    return any(old.point.normal @ new.point.normal < np.cos(_TILT) for old, new in rows)


def _first_loss(
    arm: LeaningArm, tangent: _Tangent, friction: list[float], limit: float
) -> tuple[float, int | None, str]:
    """Return the further push, below a limit, at which the tangent foretells a loss.

    Also the contact that is lost, or None, and how.
    """
    first, lost, how = limit, None, "holds"
    for j, (touch, row) in enumerate(zip(arm.state.touches, arm.rows, strict=True)):
        n, N = row.point.normal, touch.normal_force
        own = tangent.rates[3 + 7 * j : 6 + 7 * j]
        rate = float(tangent.rates[tangent.system.linear.unknowns + j])
        ways = [("lifts off", -N / rate if rate < 0 else np.inf)]
        if friction[j] > 0:
            across = touch.force - N * n
            turning = N * row.point.curvature @ tangent.moves[arm.state.mesh.node[j]]
            changing = own - rate * n - turning
            ways.append(
                ("slips", until_equal(across, changing, friction[j] * N, friction[j] * rate))
            )
        for name, push in ways:
            if push < first:
                first, lost, how = push, j, name
    return first, lost, how


def until_equal(a: Array, b: Array, c: float, d: float) -> float:
    """Return the least x > 0 at which ``|a + b x| = c + d x``; infinite if there is none."""
    square, double, rest = b @ b - d * d, a @ b - c * d, a @ a - c * c
    if c <= 0 or rest >= 0:
        return 0.0
    root = double * double - square * rest
    if root < 0 or double + np.sqrt(root) <= 0:
        return np.inf
    return float(-rest / (double + np.sqrt(root)))
