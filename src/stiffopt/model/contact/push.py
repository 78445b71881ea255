"""Pushes at the tip of an arm in contact, and the loss of contacts under them."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.contact.solve import ContactProblem
from stiffopt.model.contact.system import ContactSystem, LeaningArm

Vector = NDArray[np.float64]

_LARGEST_SWING = 0.2  # rad, largest turn of the tip in a step of a push
_FORCE_LEFT = 1e-7  # N; a contact with less force has lifted off
_SHORTEST = 1e-6  # share of the largest push; with a shorter step the equilibrium is lost


class ContactLoss(NamedTuple):
    """When and how a push makes the arm lose a contact.

    Attributes
    ----------
    force : of the push at the tip, in N; infinite if no contact is lost.
    object : on which a contact is lost, or None.
    at : arc length of that contact at rest, in m, or None.
    how : "lifts off" or "slips", "snaps" where the equilibrium is lost instead, or "holds".
    stiffness : along the push just before, in N/m.
    stiffness_after : the same without the contact, or with it slipping.
    """

    force: float
    object: str | None
    at: float | None
    how: str
    stiffness: float
    stiffness_after: float


class GrowingPush:
    """A push at the tip that grows from zero, along a unit direction (3,) in base axes."""

    def __init__(self, problem: ContactProblem, direction: Vector, limit: float) -> None:
        self._problem, self._direction, self._limit = problem, direction, limit

    def slip(self, arm: LeaningArm) -> ContactLoss:
        """Return the first contact that slips or lifts off, linear about an equilibrium.

        Contacts with friction stick, and carry no tangential force at first. One
        slips when the tangential force reaches the coefficient of friction times the normal
        force.
        """
        touches = arm.state.touches
        friction = [self._problem.surfaces[touch.surface].friction for touch in touches]
        sticking = [j for j, each in enumerate(friction) if each > 0]
        system, solution, stiffness = self._tangent(arm, sticking)
        _, moves = system.along(solution)
        first, lost, how = self._limit, None, "holds"
        for j, touch in enumerate(touches):
            own = solution[3 + 7 * j : 6 + 7 * j, :3] @ self._direction
            change = float(solution[system.linear.unknowns + j, :3] @ self._direction)
            point = arm.rows[j].point
            moved = moves[arm.state.mesh.node[j]][:, :3] @ self._direction
            turned = touch.normal_force * point.curvature @ moved
            across = float(np.linalg.norm(own - change * point.normal - turned))
            ways = [("lifts off", -change, touch.normal_force)]
            if friction[j] > 0:
                limit = friction[j] * touch.normal_force
                ways.append(("slips", across - friction[j] * change, limit))
            for name, rate, limit in ways:
                if rate > 0 and limit / rate < first:
                    first, lost, how = limit / rate, j, name
        if lost is None:
            return ContactLoss(np.inf, None, None, how, stiffness, stiffness)
        if how == "slips":
            after = self._tangent(arm, [j for j in sticking if j != lost])[2]
        else:
            rest = (*touches[:lost], *touches[lost + 1 :])
            found = self._problem.correct(self._problem.with_touches(arm.state, rest))
            kept = [j - (j > lost) for j in sticking if j != lost]
            after = 0.0 if found is None else self._tangent(found, kept)[2]
        name = self._problem.surfaces[touches[lost].surface].name
        return ContactLoss(first, name, touches[lost].station, how, stiffness, after)

    def _tangent(
        self, arm: LeaningArm, sticking: Collection[int]
    ) -> tuple[ContactSystem, Vector, float]:
        """Return the equations for forces at the tip, their solution (u, 6), and a stiffness."""
        sections = arm.shape.sections
        system = ContactSystem(self._problem, arm.state, sections, "tip wrench", sticking)
        solution = system.solution()
        _, moves = system.along(solution)
        way = float(self._direction @ moves[0][:, :3] @ self._direction)
        return system, solution, 1 / way

    def loss(self, arm: LeaningArm) -> ContactLoss:
        """Return the first contact that is lost as the push grows from an equilibrium."""
        without, force, step = arm.state.condition.dead, 0.0, np.inf
        while True:
            own = _forces(arm)
            slopes, turn, stiffness = self._rates(arm)
            # a contact is lost where its force is zero, by Newton's method from one side
            until = np.divide(own, -slopes, out=np.full(len(own), np.inf), where=slopes < 0)
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
            arm, force, step = found, force + ahead, np.inf
            if (forces < _FORCE_LEFT).any():
                return self._lifted(arm, force, int(np.argmin(forces)))
            if force >= self._limit * (1 - 1e-12):
                return ContactLoss(np.inf, None, None, "holds", stiffness, stiffness)
            if self._problem.missed(arm):
                arm = self._problem.settle(arm.state) or arm

    def _rates(self, arm: LeaningArm) -> tuple[Vector, float, float]:
        """Return changes (k,) of normal forces and of the tip's turn per push; a stiffness."""
        found = arm.tangent[:, :3] @ self._direction
        stiffness = 1 / float(self._direction @ found[:3])
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


def _forces(arm: LeaningArm) -> Vector:
    return np.array([touch.normal_force for touch in arm.state.touches])
