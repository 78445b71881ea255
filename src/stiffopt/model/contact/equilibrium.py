"""`ContactEquilibrium`: an equilibrium in contact, its compliance, and pushes against it."""

from __future__ import annotations

from collections.abc import Collection
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.errors import EquilibriumError, InputError
from stiffopt.model.arguments import check_choice, checked_measure
from stiffopt.model.arm_clearance import SceneKey, measured_scene
from stiffopt.model.compliance import Boundary, Frame, Kind, stiffness_of
from stiffopt.model.contact.lines import SPACINGS
from stiffopt.model.contact.push import ContactLoss, GrowingPush, rigid_if_huge
from stiffopt.model.contact.rod import TURN, Condition, Rod, rotations
from stiffopt.model.contact.solve import ContactProblem
from stiffopt.model.contact.sticking import Sticking
from stiffopt.model.contact.surface import ContactSurface
from stiffopt.model.contact.system import ContactSystem, LeaningArm
from stiffopt.model.scene import Scene
from stiffopt.model.screws import Wrench, checked_wrench

if TYPE_CHECKING:
    from stiffopt.model.manipulator import Manipulator

Approach = Literal["pressures", "objects"]
Grip = Literal["sliding", "sticking"]

_BESIDE = 1e-5  # m along the arm, step of the differences for tangents


class Contact(NamedTuple):
    """A contact of an arm with an object.

    Attributes
    ----------
    object : its name.
    at : arc length at rest of the station nearest to it, in m.
    force : on the arm (3,), in base axes, in N.
    position : of the surface there (3,), in m.
    normal : unit vector (3,) from the surface to the arm.
    max_force : largest force that the scene allows, in N; infinite without a limit.
    """

    object: str
    at: float
    force: Array
    position: Array
    normal: Array
    max_force: float


class FrictionBounds(NamedTuple):
    """How far friction can keep an equilibrium from that of contacts that slide without it.

    Attributes
    ----------
    tip : largest distance of the tip, in m.
    forces : largest changes (contacts,) of the normal forces, in N.
    """

    tip: float
    forces: Array


class ContactEquilibrium:
    """An equilibrium with contacts; see `Manipulator.contact_equilibrium`.

    Attributes
    ----------
    pressures : (n,), in Pa.
    contacts : tuple of Contact.
    """

    def __init__(self, arm: LeaningArm) -> None:
        self._arm = arm
        self.pressures = arm.state.condition.pressures
        surfaces = [arm.problem.surfaces[touch.surface] for touch in arm.state.touches]
        self.contacts = tuple(
            Contact(
                surface.name,
                touch.station,
                touch.force,
                arm.shape.position[node] - row.point.distance * row.point.normal,
                row.point.normal,
                surface.max_force,
            )
            for surface, touch, node, row in zip(
                surfaces, arm.state.touches, arm.state.mesh.node, arm.rows, strict=True
            )
        )

    def __repr__(self) -> str:
        where = ", ".join(
            f"{each.object} at {1e3 * each.at:.1f} mm with {np.linalg.norm(each.force):.4g} N"
            for each in self.contacts
        )
        return f"ContactEquilibrium({where or 'no contact'})"

    # -- shape ------------------------------------------------------------------------------

    @property
    def tip_pose(self) -> Array:
        """Pose of the tip in the base frame, (4, 4)."""
        shape = self._arm.shape
        return np.asarray(lie.transform(shape.rotation[0], shape.position[0]))

    def poses(self, at: ArrayLike) -> Array:
        """Return poses (k, 4, 4) at arc lengths (k,) at rest, in m."""
        wanted = np.asarray(at, dtype=float)
        shape, up = self._arm.shape, slice(None, None, -1)
        q = [np.interp(wanted, shape.mesh.at[up], row[up]) for row in shape.nodes.quaternion.T]
        found = np.zeros((len(wanted), 4, 4))
        found[:, :3, :3] = rotations(np.stack(q, axis=1))
        found[:, :3, 3] = shape.body(wanted)[0]
        found[:, 3, 3] = 1
        return found

    def backbone(self, n: int = 50) -> Array:
        """Return points (n, 3) of the centre line, equally spaced at rest from base to tip."""
        wanted = np.linspace(0.0, self._arm.problem.rod.arm.length, n)
        return self._arm.shape.body(wanted)[0]

    @property
    def stable(self) -> bool:
        """Whether it is a minimum of the energy (for loads without a potential: no divergence)."""
        return self._arm.is_stable

    @property
    def within_limits(self) -> bool:
        """True if no force exceeds what the scene allows; forces along a line are added."""
        return all(force <= self.contacts[own[0]].max_force for own, force in self.pressed())

    def pressed(self) -> list[tuple[list[int], float]]:
        """Return contacts that share a limit, and the sum of their forces in N.

        The contacts along a line on an object count as one; the others alone.
        """
        groups: dict[tuple[str, int], list[int]] = {}
        for j, (each, touch) in enumerate(zip(self.contacts, self._arm.state.touches, strict=True)):
            groups.setdefault((each.object, -1 if touch.line else j), []).append(j)
        return [
            (own, float(sum(np.linalg.norm(self.contacts[j].force) for j in own)))
            for own in groups.values()
        ]

    @property
    def normal_forces(self) -> Array:
        """Forces (contacts,) along the normals, in N; negative where a contact pulls."""
        return np.array([touch.normal_force for touch in self._arm.state.touches])

    def line(self, at: Array) -> tuple[Array, Array, Array]:
        """Return centre line (k, 3), unit tangents (k, 3) and radii (k,) at arc lengths (k,)."""
        body, length = self._arm.shape.body, self._arm.problem.rod.arm.length
        points, radii = body(at)
        ends = [np.clip(at + step, 0.0, length) for step in (-_BESIDE, _BESIDE)]
        ways = body(ends[1])[0] - body(ends[0])[0]
        return points, ways / np.linalg.norm(ways, axis=1, keepdims=True), radii

    # -- compliance -------------------------------------------------------------------------

    @property
    def tip_compliance(self) -> Array:
        """Tangent compliance (6, 6) of the braced tip, in tip axes, linear first.

        All contacts stay closed and slide without friction; see `compliance` for sticking ones.
        """
        return self.compliance("sliding")

    def compliance(self, contacts: Grip = "sliding") -> Array:
        """Return the tangent compliance (6, 6) of the tip, in tip axes, linear first.

        Parameters
        ----------
        contacts : {"sliding", "sticking"}
            Whether contacts slide on their surfaces without resistance, or roll without slipping on
            those that have friction. With friction the real compliance lies between; small pushes
            on an arm whose contacts carry no tangential force leave them sticking.
        """
        check_choice("contacts", contacts, get_args(Grip))
        per_wrench = self._arm.tangent[:6]
        if contacts == "sticking" and (sticking := self._with_friction()):
            system, solution = self._arm.pushed(sticking)
            per_wrench = system.of_tip(solution)[:6]
        R = self._arm.shape.rotation[0]
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = R
        found: Array = turn.T @ per_wrench @ turn
        if self._arm.state.condition.is_conservative and contacts == "sliding":
            found = (found + found.T) / 2  # symmetric up to the integrator's error
        return found

    def _with_friction(self) -> list[int]:
        """Return the indices of contacts on surfaces with friction."""
        surfaces = self._arm.problem.surfaces
        touches = enumerate(self._arm.state.touches)
        return [j for j, touch in touches if surfaces[touch.surface].friction > 0]

    def _system_for(self, extras: str, sticking: Collection[int] = ()) -> ContactSystem:
        arm = self._arm
        return ContactSystem(arm.problem, arm.state, arm.shape.sections, extras, sticking)

    def stiffness(
        self,
        direction: ArrayLike,
        kind: Kind = "translation",
        boundary: Boundary = "free",
        frame: Frame = "base",
        contacts: Grip = "sliding",
    ) -> float:
        """Return the stiffness of the braced tip along a direction (N/m), or about it (N m/rad).

        See `Manipulator.stiffness` for the arguments and `compliance` for `contacts`.  It is
        infinite where a rigid surface holds the tip.
        """
        d = np.asarray(checked_measure(direction, kind, boundary, frame).direction)
        if frame == "base":
            d = self._arm.shape.rotation[0].T @ d
        with np.errstate(divide="ignore"):
            found = float(stiffness_of(self.compliance(contacts), d, kind, boundary))
        if found < 0 and self.stable:
            return np.inf  # a contact that slides holds the tip, but for the error of lines
        return rigid_if_huge(1 / found) if found and kind == "translation" else found

    @property
    def friction(self) -> FrictionBounds:
        """Bounds on how far friction can change this equilibrium, to first order.

        They hold for every approach. At each touched point a tangential force acts, of at most the
        coefficient of friction times the normal force, in the direction in which it changes tip and
        forces most. The contacts stay closed.
        """
        held, tip, forces = self.sticking, 0.0, np.zeros(len(self.contacts))
        for i, j in enumerate(held.own):
            slid = held.slides(np.eye(2 * len(held.own))[:, 2 * i : 2 * i + 2])
            largest = held.friction[i] * self._arm.state.touches[j].normal_force
            tip += largest * float(np.linalg.norm(held.tip[:3] @ slid, 2))
            forces += largest * np.linalg.norm(held.normals @ slid, axis=1)
        return FrictionBounds(tip, forces)

    @cached_property
    def sticking(self) -> Sticking:
        """How contacts with friction hold, to first order."""
        arm, own = self._arm, self._with_friction()
        system, pushed = arm.pushed(own)
        u, firsts = system.linear.unknowns, [3 + 7 * j for j in own]
        normals = [arm.rows[j].point.normal for j in own]
        across = [np.linalg.svd(n[None])[2][1:] for n in normals]

        def tangential(solution: Array, moves: Array) -> Array:
            """Changes (2k, e) of the tangential forces; a normal force turns with its normal."""
            found = [
                axes
                @ (
                    solution[first : first + 3]
                    - arm.state.touches[j].normal_force
                    * arm.rows[j].point.curvature
                    @ moves[arm.state.mesh.node[j]]
                )
                for j, first, axes in zip(own, firsts, across, strict=True)
            ]
            return np.concatenate([np.zeros((0, solution.shape[1])), *found])

        right = np.zeros((len(system.matrix), 2 * len(own)))
        for i, first in enumerate(firsts):  # of the equations that the body does not slide
            right[first + 1 : first + 3, 2 * i : 2 * i + 2] = np.eye(2)
        slid: Array = np.asarray(np.linalg.solve(system.matrix, right), dtype=float)
        moves = system.linear.moves[..., :u] @ slid[:u]
        turn = system.linear.changes[0, TURN, :u] @ slid[:u]
        pressed = self._system_for("pressures", own)
        by_pressure = pressed.solution()
        surfaces = arm.problem.surfaces
        return Sticking(
            tuple(own),
            np.array(across).reshape(len(own), 2, 3),
            np.array([surfaces[arm.state.touches[j].surface].friction for j in own]),
            tangential(by_pressure, pressed.along(by_pressure)[1]),
            tangential(pushed, system.along(pushed)[1])[:, :3],
            tangential(slid, moves),
            np.concatenate([moves[0], turn]),
            slid[u:],
        )

    # -- derivatives ------------------------------------------------------------------------

    @cached_property
    def _per_pressure(self) -> tuple[Array, Array, Array]:
        system = self._system_for("pressures")
        solution = system.solution()
        found = system.of_tip(solution)
        return found[:6], found[6:], solution[9 : system.linear.unknowns : 7]

    @property
    def tip_jacobian(self) -> Array:
        """Twist of the tip in tip axes per pressure, (6, n), while the contacts stay closed."""
        R = self._arm.shape.rotation[0]
        twist = self._per_pressure[0]
        return np.concatenate([R.T @ twist[:3], R.T @ twist[3:]])

    @property
    def force_gradients(self) -> Array:
        """Derivatives (contacts, n) of the normal forces by the pressures, in N/Pa."""
        return self._per_pressure[1]

    @property
    def station_gradients(self) -> Array:
        """Derivatives (contacts, n) of the contacts' arc lengths by the pressures, in m/Pa."""
        return self._per_pressure[2]

    def stiffness_gradient(
        self,
        direction: ArrayLike,
        kind: Kind = "translation",
        boundary: Boundary = "free",
        frame: Frame = "base",
        contacts: Grip = "sliding",
        step: float = 50.0,
    ) -> Array:
        """Return the derivative (n,) of `stiffness` by the pressures, contacts staying closed.

        Central differences over a step in Pa, of equilibria that are exact to rounding.
        """
        measure = (direction, kind, boundary, frame, contacts)
        found = []
        for k in range(len(self.pressures)):
            values = [
                self.shifted(step * sign * np.eye(len(self.pressures))[k]).stiffness(*measure)
                for sign in (1, -1)
            ]
            found.append((values[0] - values[1]) / (2 * step))
        return np.array(found)

    def shifted(
        self, change: ArrayLike = 0.0, push: ArrayLike = (0.0, 0.0, 0.0)
    ) -> ContactEquilibrium:
        """Return the nearby equilibrium with the same contacts, closed even if they pull.

        Parameters
        ----------
        change : (n,)
            Of the pressures, in Pa.
        push : (3,)
            Further force at the tip in base axes, in N.

        Raises
        ------
        EquilibriumError
            If there is none.
        """
        condition = self._arm.state.condition
        there = condition._replace(
            pressures=condition.pressures + np.asarray(change),
            dead=condition.dead + np.concatenate([np.asarray(push), np.zeros(3)]),
        )
        found = self._arm.problem.correct(self._arm.state._replace(condition=there))
        if found is None:
            raise EquilibriumError("the equilibrium is lost where pressures change by little")
        return ContactEquilibrium(found)

    # -- pushes -----------------------------------------------------------------------------

    def lift_off(
        self, direction: ArrayLike, limit: float = 1.0, contacts: Grip = "sliding"
    ) -> ContactLoss:
        """Return the push at the tip by which the first contact is lost.

        Parameters
        ----------
        direction : (3,)
            Of the push, in base axes; of any length.
        limit : float
            Largest push that is tested, in N.
        contacts : {"sliding", "sticking"}
            "sliding": without friction, and exact for large pushes.  "sticking": with the scene's
            friction; contacts carry no tangential force at first, and roll without slipping until
            one slips or lifts off.

        Returns
        -------
        ContactLoss
        """
        d = np.asarray(checked_measure(direction, "translation", "free", "base").direction)
        check_choice("contacts", contacts, get_args(Grip))
        if limit <= 0:
            raise InputError(f"limit must be positive; got {limit!r}")
        push = GrowingPush(self._arm.problem, d, limit)
        return push.loss(self._arm) if contacts == "sliding" else push.slip(self._arm)

    def foretold_loss(self, direction: ArrayLike, contacts: Grip = "sliding") -> float:
        """Return the push in N of `lift_off` to first order in the push; infinite if there is none.

        It takes a small part of the time, and ignores contacts that the push adds.  Parameters are
        those of `lift_off`.
        """
        d = np.asarray(checked_measure(direction, "translation", "free", "base").direction)
        check_choice("contacts", contacts, get_args(Grip))
        push = GrowingPush(self._arm.problem, d, np.inf)
        return push.foretold(self._arm, sticks=contacts == "sticking")


def contact_equilibrium(
    arm: Manipulator,
    p: ArrayLike,
    scene: Scene,
    load: ArrayLike | Wrench | None = None,
    approach: Approach = "pressures",
    nearby: ContactEquilibrium | None = None,
) -> ContactEquilibrium:
    """See `Manipulator.contact_equilibrium`."""
    pressures = arm.checked_pressures(p)
    arm._check_margin(pressures[np.newaxis], "")
    check_choice("approach", approach, get_args(Approach))
    wrench = np.zeros(6) if load is None else checked_wrench(load)
    tip = np.array(arm.tip_load)
    end = Condition(
        pressures, tip[:6] + wrench, tip[6:], np.array(arm.description.gravity),
        np.zeros(len(contact_problem(arm, scene).surfaces)),
    )  # fmt: skip
    if nearby is not None:
        problem = contact_problem(arm, scene, nearby._arm.problem.lines.share)
        found = problem.follow(nearby._arm, end)
        return _arrived(*found, "the way from the nearby equilibrium")
    error = None
    for spacing in SPACINGS:
        try:
            return _from_rest(contact_problem(arm, scene, spacing), end, approach)
        except _LostAlongLineError as lost:  # perhaps for the contacts that stand for the line
            error = error or lost
    assert error is not None
    raise error


def _from_rest(problem: ContactProblem, end: Condition, approach: Approach) -> ContactEquilibrium:
    """Return the equilibrium that is reached from rest."""
    if approach == "pressures":
        rest = _at_rest(problem)
        return _arrived(*problem.follow(rest._arm, end), "its pressures and load")
    alone, what = problem.alone, "its weight, pressures and load, free of objects"
    rest = _arrived(*alone.hanging, what)
    free = _arrived(*alone.follow(rest._arm, end._replace(retreat=np.zeros(0))), what)
    return _arrived(*problem.follow(problem.clear(free._arm), end), "the objects' way to it")


class _LostAlongLineError(EquilibriumError):
    """The way from rest is lost while the arm lies along a surface."""


def inside_at_rest(arm: Manipulator, scene: Scene) -> str:
    """Return how deep a straight arm, without pressure and weight, is inside an object, or ""."""
    return _inside(contact_problem(arm, scene))


def _inside(problem: ContactProblem) -> str:
    depths = problem.straight.state.condition.retreat
    if not depths.any():
        return ""
    worst = int(depths.argmax())
    depth = display_units().length.text(float(depths[worst]), ".2g")
    return f"the arm at rest is {depth} inside '{problem.surfaces[worst].name}'"


def _at_rest(problem: ContactProblem) -> ContactEquilibrium:
    """Return the equilibrium without pressures; say which object the straight arm is inside."""
    arm, share = problem.hanging
    inside = _inside(problem)
    if share < 1.0 and inside:
        raise EquilibriumError(
            f"{inside}, which cannot push it out continuously; move the object, or let it come to "
            "the arm under pressure (approach: objects)"
        )
    return _arrived(arm, share, "its own weight and payload")


def _arrived(arm: LeaningArm, share: float, what: str) -> ContactEquilibrium:
    if share < 1.0:
        touches = arm.state.touches
        names = sorted({arm.problem.surfaces[touch.surface].name for touch in touches})
        lies = any(touch.line for touch in touches)
        how = "lying along" if lies else "leaning on"
        on = f", {how} {' and '.join(names)}" if names else ""
        raise (_LostAlongLineError if lies else EquilibriumError)(
            f"no equilibrium is reached continuously beyond {share:.0%} of {what}{on}: the arm "
            "slips off, snaps through or buckles there"
        )
    return ContactEquilibrium(arm)


def contact_problem(arm: Manipulator, scene: Scene, spacing: float = SPACINGS[0]) -> ContactProblem:
    """Return the arm among the objects of a scene that allow contact; cached."""
    rod = arm.kept("contact rod", lambda: Rod(arm))
    return _problem(rod, SceneKey(scene), spacing)


@lru_cache(maxsize=64)
def _problem(rod: Rod, key: SceneKey, spacing: float) -> ContactProblem:
    measured = measured_scene(key.scene, rod.arm.description)
    pairs = zip(key.scene.objects, measured.items, strict=True)
    surfaces = (ContactSurface(item, near.begin) for item, near in pairs if item.may_be_leant_on)
    return ContactProblem(rod, tuple(surfaces), spacing)
