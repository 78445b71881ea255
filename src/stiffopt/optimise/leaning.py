"""`BracedProblem`: the nonlinear program of a task whose arm leans on objects.

All quantities are evaluated at the equilibrium in contact. The rows of the terms, and of the
objects that the body keeps clear of, are followed by these rows for each object that it may lean
on: the largest contact force, ``|f| + e <= max_force``; and, for both signs of each direction that
is maximised, the normal force that remains under a push of the margin, ``f(push) - e >= 0``, with
sticking contacts also the push at which one slips if forces are smaller by e. The doubt e is that
of a calibration. Derivatives are differences of equilibria with the same contacts, at constant e.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np

from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.errors import EquilibriumError
from stiffopt.model.batch import InterpretedFunction
from stiffopt.model.clearance import Nearest
from stiffopt.model.codegen import dense
from stiffopt.model.contact.equilibrium import ContactEquilibrium, Grip
from stiffopt.model.contact.way import Rubbing, states_from_rest
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene, SceneObject
from stiffopt.model.shape import PointOfArm
from stiffopt.model.stopping import checkpoint
from stiffopt.optimise.brace import Brace, kept_clear_of, leant_on
from stiffopt.optimise.brace_uncertainty import BraceUncertainty
from stiffopt.optimise.easing import allowed_distance, distance_left, eased
from stiffopt.optimise.measures.directional import StiffnessMeasure
from stiffopt.optimise.problem import Objective, PressureProblem, ProgramPoint
from stiffopt.optimise.program import Constraint, Program
from stiffopt.optimise.settings import BRACE, OBSTACLES
from stiffopt.optimise.solution import Judgement, Preload, are_within
from stiffopt.optimise.task import Task

FORCE_ON, MARGIN_ON = "force on ", "margin on "
"""Prefixes of the names of constraints of contacts."""
_GRIPS: tuple[Grip, ...] = ("sliding", "sticking")


@dataclass(frozen=True)
class PlacedTip:
    """A tip whose pose and compliance are symbols; implements `stiffopt.model.shape.Shape`."""

    pressures: ca.SX
    position: ca.SX
    rotation: ca.SX
    compliance: ca.SX
    stations: dict[float, PointOfArm]

    @classmethod
    def of(cls, n: int) -> PlacedTip:
        """Return a tip for n pressures."""
        p, C = ca.SX.sym("p", n), ca.SX.sym("C", 6, 6)
        return cls(p, ca.SX.sym("position", 3), ca.SX.sym("rotation", 3, 3), C, {})

    @property
    def transform(self) -> ca.SX:
        """Pose (4, 4)."""
        return ca.vertcat(ca.horzcat(self.rotation, self.position), ca.DM([[0.0, 0.0, 0.0, 1.0]]))

    def flexibility(self, wrench: ca.SX) -> ca.SX:
        """Return ``w' C w`` of a wrench (6,), in tip axes."""
        return ca.bilin(self.compliance, wrench, wrench)

    def station(self, at: float) -> PointOfArm:
        """Return another point of the arm, a further input."""
        if at not in self.stations:
            name = f"at{len(self.stations)}"
            self.stations[at] = PointOfArm(ca.SX.sym(name, 3), ca.SX.sym(f"{name}r", 3, 3))
        return self.stations[at]


RIGID = 1e5  # N/m, beyond which no arm is stiff by itself


class PlacedProgram:
    """Residuals and measures of a program, for an arm with given poses and compliance."""

    def __init__(self, program: Program, n: int) -> None:
        tip, parameters = PlacedTip.of(n), ca.SX.sym("parameters", program.n_parameters)
        residuals, _, _, values = program.judge(cast("Any", tip), parameters)
        self.at = np.array(list(tip.stations))
        places = [part for each in tip.stations.values() for part in (each.position, each.rotation)]
        inputs = [tip.position, tip.rotation, tip.compliance, *places, parameters]
        self._function = InterpretedFunction(
            dense(ca.Function("placed", inputs, [residuals, values]))
        )
        self._parameters = program.parameters

    def __call__(self, eq: ContactEquilibrium, C: Array) -> tuple[Array, Array]:
        """Return residuals (m,) of the terms and measures (k,); C is (6, 6), in tip axes."""
        tip = eq.tip_pose
        poses = eq.poses(self.at) if len(self.at) else ()
        places = [part for T in poses for part in (T[:3, 3], T[:3, :3])]
        found = self._function(tip[:3, 3], tip[:3, :3], C, *places, self._parameters)
        return found[0][:, 0], found[1][:, 0]


class BracedPoint(ProgramPoint):
    """The program's values at an equilibrium in contact.

    `force`: sum of the contacts' normal forces, in N. `force_gradient`: (n,), its derivative, per
    variable.
    """

    __slots__ = ("equilibrium", "force", "force_gradient")

    equilibrium: ContactEquilibrium
    force: float
    force_gradient: Array


class Quantities(NamedTuple):
    """Quantities at one equilibrium from which the program's rows and values are computed."""

    residuals: Array
    values: Array
    distances: Array
    forces: Array  # along the normals, as large as they may be
    pushed: Array
    slips: Array
    foretold: Array  # slips, by the tangent


class BracedProblem(PressureProblem):
    """The nonlinear program of a task with a brace.

    Attributes
    ----------
    scene : the objects that the arm may lean on.
    here : equilibrium from which the next one is sought, or None: from rest.
    only_target : whether the demands on contacts are ignored.
    spare : share of tolerances, forces and margins that is not used.
    leant : whether a posture that leans was found at the target, its contacts not yet judged.
    missed : points at the target at which contacts do not meet their demands.
    """

    def __init__(self, robot: Manipulator, task: Task) -> None:
        assert task.brace is not None
        assert task.scene is not None  # see `Brace.check`
        self.brace: Brace = task.brace
        self.scene: Scene = leant_on(task.scene, task.brace)
        self.here: ContactEquilibrium | None = None
        self.only_target = self.leant = False
        self.spare = BRACE.spare
        self.missed: list[ProgramPoint] = []
        super().__init__(robot, task)

    def _set_functions(self) -> None:
        assert self.task.scene is not None
        others = kept_clear_of(self.task.scene, self.brace)
        plain = self.task.unbraced.model_copy(update={"scene": others})
        self.program = Program.of(plain, self.robot.description)
        self.judged_by = PlacedProgram(self.program, len(self.unit))
        self._kept: tuple[bytes, ContactEquilibrium] | None = None

    def _all_constraints(self) -> tuple[Constraint, ...]:
        inside = 1 - self.spare  # from rest, the integration may take other steps
        own = [c._replace(radius=inside * c.radius) for c in super()._all_constraints()]
        for row, name in enumerate(self._row_names, start=own[-1].end if own else 0):
            own.append(Constraint(name, row, row + 1, BRACE.force, BRACE.scale, one_sided=True))
        return tuple(own)

    @property
    def _row_names(self) -> Iterator[str]:
        """Names of the rows: for each object, one for its force and one for each push.

        With sticking contacts, two more for each push: see `_slips`.
        """
        per_object = len(self.directions) * (2 if self.brace.contacts == "sliding" else 6)
        for item in self.scene.objects:
            yield f"{FORCE_ON}{item.name}"
            yield from [f"{MARGIN_ON}{item.name}"] * per_object

    def _objective(self) -> Objective:
        return replace(super()._objective(), precision=BRACE.precision)

    @property
    def directions(self) -> list[StiffnessMeasure]:
        """The measures that are maximised."""
        goal = self.task.stiffness
        assert goal is not None
        return list(goal.maximise)

    # -- evaluation -------------------------------------------------------------------------

    def tightened(self) -> BracedProblem:
        """Return the same program with more to spare."""
        other = copy(self)
        other.spare = BRACE.more_spare
        other._set_constraints()
        other.restart()
        return other

    def restart(self) -> None:
        """Find the next equilibrium from rest."""
        self.here = self._kept = None

    def equilibrium(self, x: Array) -> ContactEquilibrium:
        """Return the equilibrium at pressures x, found from `here`.

        Raises `EquilibriumError` if there is none, or none with contact.
        """
        if self._kept is not None and self._kept[0] == x.tobytes():
            return self._kept[1]
        eq = self.robot.contact_equilibrium(
            x * self.unit, self.scene, approach=self.brace.approach, nearby=self.here
        )
        if not eq.contacts:
            raise EquilibriumError("the arm does not lean on anything there")
        self.here, self._kept = eq, (x.tobytes(), eq)
        return eq

    def pose(self, x: Array) -> BracedPoint:
        """See `PressureProblem.pose`."""
        return self._evaluated(x, full=False)

    def point(self, x: Array) -> BracedPoint:
        """See `PressureProblem.point`."""
        return self._evaluated(x, full=True)

    def worth(self, x: Array) -> BracedPoint:
        """See `PressureProblem.worth`."""
        return self._evaluated(x, full=True)

    def _evaluated(self, x: Array, *, full: bool) -> BracedPoint:
        checkpoint()
        eq = self.equilibrium(x)
        pushes = [] if self.only_target else list(self.pushes(eq))
        known = BraceUncertainty(self.robot, eq)
        near = self._nearest(eq, quickly=True)
        base = self._seen(eq, pushes, known, near, full)
        differences = []
        for k, inwards in enumerate(x > (self.lower + self.upper) / 2):
            step = (-1.0 if inwards else 1.0) * BRACE.step
            change = step * self.unit[k] * np.eye(len(x))[k]
            seen = self._seen(eq.shifted(change), pushes, known, near, full, base)
            with np.errstate(invalid="ignore"):  # an infinite stiffness has no derivative
                differences.append([(b - a) / step for a, b in zip(base, seen, strict=True)])
        slopes = Quantities(
            *(np.stack(columns, axis=-1) for columns in zip(*differences, strict=True))
        )
        residual = np.concatenate([base.residuals, self._rows(eq, base, near)])
        jacobian = np.vstack([slopes.residuals, self._slopes(eq, base, slopes)])
        first = len(self.program.measures) - self.program.n_floors
        rest = (
            -base.values[:first], -slopes.values[:first], base.values[first:], slopes.values[first:]
        ) if full else _nothing(len(x))  # fmt: skip
        point = BracedPoint(x, residual, jacobian, self.constraints, *rest)
        point.equilibrium, point.force = eq, float(eq.normal_forces.sum())
        point.force_gradient = slopes.forces.sum(axis=0)
        return point

    def pushes(self, eq: ContactEquilibrium) -> Iterator[Array]:
        """Yield unit vectors (3,) of pushes at the tip, both ways per direction, in base axes."""
        R = eq.tip_pose[:3, :3]
        for measure, sign in product(self.directions, (1.0, -1.0)):
            d = np.array(measure.direction)
            yield sign * (R @ d if measure.frame == "tip" else d)

    def _seen(
        self,
        eq: ContactEquilibrium,
        pushes: list[Array],
        known: BraceUncertainty,
        near: list[Nearest],
        full: bool,
        base: Quantities | None = None,
    ) -> Quantities:
        C = eq.compliance(self.brace.contacts) if full else np.eye(6)
        residuals, values = self.judged_by(eq, C)
        margin, forces = (1 + self.spare) * self.brace.margin, eq.normal_forces
        pushed = [eq.shifted(push=margin * push).normal_forces - known.forces for push in pushes]
        slips = foretold = np.zeros(0)
        if pushes:
            forces = forces + known.forces
            if self.brace.contacts == "sticking":
                slips, foretold = self._slips(eq, pushes, known.grip, base)
        at = np.array([each.s for each in near])
        points, _, radii = eq.line(at) if near else (np.zeros((0, 3)), None, np.zeros(0))
        distances = np.array(
            [each.normal @ x - each.radius_share * r
             for each, x, r in zip(near, points, radii, strict=True)]
        )  # fmt: skip
        return Quantities(residuals, values, distances, forces, np.array(pushed), slips, foretold)

    def _slips(
        self, eq: ContactEquilibrium, pushes: list[Array], grip: float, base: Quantities | None
    ) -> tuple[Array, Array]:
        """Return the pushes at which a contact is lost or the arm snaps, at most twice the margin.

        Those of contacts that stick and, as friction is not certain, of contacts that slide; `grip`
        is the share of the former that is sure.  The second result is what the tangent foretells.
        Next to an equilibrium with the quantities `base`, pushes at the limit stay there, and the
        others change by the same share as those that are foretold.
        """
        most = 2 * self.brace.margin
        found, foretold = np.full(2 * len(pushes), most), np.full(2 * len(pushes), np.inf)
        for k, (push, contacts) in enumerate(product(pushes, _GRIPS)):
            if base is not None and base.slips[k] == most:
                continue
            foretold[k] = eq.foretold_loss(push, contacts)
            if base is None:
                sure = grip if contacts == "sticking" else 1.0
                found[k] = min(most, sure * eq.lift_off(push, most / sure, contacts).force)
            else:
                share = foretold[k] / base.foretold[k] if np.isfinite(base.foretold[k]) else 1.0
                found[k] = base.slips[k] * (share if np.isfinite(share) else 1.0)
        return found, foretold

    def _rows(self, eq: ContactEquilibrium, seen: Quantities, near: list[Nearest]) -> Array:
        rows = self.obstacle_rows(near)
        if self.only_target:
            return np.array([*rows, *(0.0 for _ in self._row_names)])
        for item in self.scene.objects:
            own = self._of(eq, item.name)
            if not own:
                rows += [0.0] * (1 + len(seen.pushed) + len(seen.slips))
                continue
            limit = _max_force(item)
            force = max(float(seen.forces[each].sum()) for each in self._limited(eq, own))
            force -= (1 - self.spare) * (limit or np.inf)
            rows.append(BRACE.force + force if limit else 0.0)
            rows += (BRACE.force - seen.pushed[:, own].min(axis=1)).tolist()
            margin = (1 + self.spare) * self.brace.margin
            rows += (BRACE.force + margin - seen.slips).tolist()
        return np.array(rows)

    def obstacle_rows(self, near: list[Nearest]) -> list[float]:
        """Return rows for the objects that the body keeps clear of; see `Obstacles`."""
        if self.program.obstacles is None:
            return []
        required = self.program.obstacles.scene.clearance
        return [OBSTACLES.margin - (each.distance - required) for each in near]

    def _slopes(self, eq: ContactEquilibrium, base: Quantities, slopes: Quantities) -> Array:
        """Return derivatives (rows, n) of `_rows`; of several contacts on an object, the worst."""
        rows = list(-slopes.distances)
        none = np.zeros(len(self.unit))
        if self.only_target:
            return np.array([*rows, *(none for _ in self._row_names)]).reshape(-1, len(none))
        for item in self.scene.objects:
            own = self._of(eq, item.name)
            if not own:
                rows += [none] * (1 + len(base.pushed) + len(base.slips))
                continue
            most = max(self._limited(eq, own), key=lambda each: float(base.forces[each].sum()))
            rows.append(slopes.forces[most].sum(axis=0) if _max_force(item) else none)
            for at_push, slope in zip(base.pushed, slopes.pushed, strict=True):
                rows.append(-slope[own[int(at_push[own].argmin())]])
            rows += list(-slopes.slips)
        return np.array(rows).reshape(-1, len(none))

    @staticmethod
    def _of(eq: ContactEquilibrium, name: str) -> list[int]:
        """Return the indices of the contacts on an object."""
        return [j for j, each in enumerate(eq.contacts) if each.object == name]

    @staticmethod
    def _limited(eq: ContactEquilibrium, own: list[int]) -> list[list[int]]:
        """Return the groups of an object's contacts to which its greatest force applies."""
        return [each for each, _ in eq.pressed() if each[0] in own]

    def _nearest(self, eq: ContactEquilibrium, *, quickly: bool) -> list[Nearest]:
        """Return the body's nearest point to each object that it keeps clear of, by rows."""
        obstacles = self.program.obstacles
        if obstacles is None:
            return []
        return obstacles.nearest(eq.line) if quickly else obstacles.exactly_nearest(eq.line)

    # -- judgement --------------------------------------------------------------------------

    def rubbing(self, eq: ContactEquilibrium) -> Rubbing | None:
        """Return what friction does on the way from rest to an equilibrium; None without friction.

        Objects that come to the arm are taken to leave no friction.

        Raises `EquilibriumError`: the way is lost.
        """
        if self.brace.approach == "objects" or not eq.sticking.own:
            return None
        states = list(states_from_rest(self.robot, self.scene, eq.pressures))
        apart = states[-1].tip_pose[:3, 3] - eq.tip_pose[:3, 3]
        if float(np.linalg.norm(apart)) > BRACE.same:
            raise EquilibriumError("in smaller steps the arm comes to another equilibrium")
        return eased(self.robot, self.task, self.scene, states)[1]

    def judgement(self, eq: ContactEquilibrium, rubbing: Rubbing | None = None) -> Judgement:
        """Judge an equilibrium by the task, with what friction does on the way to it."""
        C = eq.compliance(self.brace.contacts)
        residuals, values = self.judged_by(eq, C)
        rows = [*residuals.tolist(), *self.obstacle_rows(self._nearest(eq, quickly=False))]
        within = are_within(eq.pressures, self.lower * self.unit, self.upper * self.unit)
        found = Judgement.of(self.program, (rows, eq.tip_pose, C, values.tolist()), within)
        return found._replace(shortfalls=(*found.shortfalls, *self.refusals(eq, rubbing)))

    def refusals(self, eq: ContactEquilibrium, rubbing: Rubbing | None = None) -> Iterator[str]:
        """Yield the reasons why an equilibrium is not acceptable."""
        unit, known = display_units().force, BraceUncertainty(self.robot, eq)
        if rubbing is not None:
            yield from self._out_of_reach(eq, rubbing)
        for own, force in eq.pressed():
            each, doubt = eq.contacts[own[0]], float(np.sum(known.forces[own]))
            if force + doubt > each.max_force * (1 + 1e-9):
                more = f", and {unit.text(doubt)} that the calibration leaves in doubt"
                yield (
                    f"the arm leans on '{each.object}' with {unit.text(force)}"
                    f"{more if doubt else ''}; at most {unit.text(each.max_force)} is allowed"
                )
            rub = 0.0 if rubbing is None else rubbing.pressing(own)
            if force + rub > each.max_force * (1 + BRACE.rubbed):
                yield (
                    f"friction on the way presses the arm on '{each.object}' with "
                    f"{unit.text(rub)} more than {unit.text(force)}; at most "
                    f"{unit.text(each.max_force)} is allowed"
                )
        if not eq.stable:
            yield "the equilibrium is not stable"
        if self._held_at_tip(eq):
            yield "an object holds the tip itself, so that its stiffness there is without limit"
            return
        grips = _GRIPS[: 1 + (self.brace.contacts == "sticking")]
        sure = {"sliding": 1.0, "sticking": known.grip}
        kept = (
            (sure[each.contacts] * each.loss.force, each.loss.object is not None)
            for each in self.preloads(eq)
            if each.contacts in grips
        )
        least, is_contact = min(kept, default=(np.inf, True))
        if least < self.brace.margin * (1 - 1e-6):
            what = "takes a contact away" if is_contact else "makes the arm buckle or snap"
            yield (
                f"a push of {unit.text(least)} {what}; the margin is {unit.text(self.brace.margin)}"
            )
            return
        left, doubt = self._left_in_doubt(eq, known.forces)
        if left < -1e-6:
            yield (
                f"a push of the margin leaves a contact force of {unit.text(left + doubt)}, less "
                f"than the {unit.text(doubt)} that the calibration leaves in doubt"
            )
        yield from self._not_robust(eq, known)

    def _not_robust(self, eq: ContactEquilibrium, known: BraceUncertainty) -> Iterator[str]:
        """Yield which stiffness that is maximised a likely error of the calibration takes away."""
        for measure in self.directions:
            k, least = self._stiffness(eq, measure), known.least_stiffness(measure, self.task)
            if least < BRACE.robust * k:
                unit = display_units().stiffness
                yield (
                    f"errors of the calibration (one standard deviation) leave {unit.text(least)} "
                    f"of the stiffness of {unit.text(k)}"
                )

    def _out_of_reach(self, eq: ContactEquilibrium, rubbing: Rubbing) -> Iterator[str]:
        """Yield that pressures cannot bring the tip back that friction has moved."""
        left = distance_left(self.robot, self.task, eq, rubbing)
        if left > allowed_distance(self.task):
            length, most = display_units().length, display_units().pressure.text(BRACE.corrected)
            away = length.text(float(np.linalg.norm(rubbing.tip)), ".2g")
            yield (
                f"friction on the way keeps the tip {away} away; pressures that are corrected by "
                f"{most} leave it {length.text(left, '.2g')} from the target"
            )

    def _held_at_tip(self, eq: ContactEquilibrium) -> bool:
        """Return True if a rigid object holds the tip along a direction that is maximised."""
        return any(self._stiffness(eq, measure) > RIGID for measure in self.directions)

    def _stiffness(self, eq: ContactEquilibrium, measure: StiffnessMeasure) -> float:
        """Return a measure's stiffness, with contacts as the task has them."""
        m = measure
        return eq.stiffness(m.direction, m.kind, m.boundary, m.frame, self.brace.contacts)

    def _left_in_doubt(self, eq: ContactEquilibrium, doubt: Array) -> tuple[float, float]:
        """Return the force that a push of the margin leaves beyond the doubt, and that, in N."""
        if not doubt.any():
            return np.inf, 0.0
        try:
            pushed = [eq.shifted(push=self.brace.margin * d) for d in self.pushes(eq)]
        except EquilibriumError:  # other contacts take over before
            return np.inf, 0.0
        least = np.min([each.normal_forces - doubt for each in pushed], axis=0)
        worst = int(least.argmin())
        return float(least[worst]), float(doubt[worst])

    def preloads(self, eq: ContactEquilibrium) -> Iterator[Preload]:
        """Yield the push by which the first contact is lost, both ways along each direction.

        For contacts that slide and, where there is friction, for contacts that stick.
        """
        has_friction = any(item.contact and item.contact.friction for item in self.scene.objects)
        for d in self.pushes(eq):
            for grip in _GRIPS if has_friction else _GRIPS[:1]:
                yield Preload(d, grip, eq.lift_off(d, BRACE.largest_push, grip))


def _max_force(item: SceneObject) -> float | None:
    return None if item.contact is None else item.contact.max_force


def _nothing(n: int) -> tuple[Array, Array, Array, Array]:
    none = np.zeros((0, n))
    return none[:, 0], none, none[:, 0], none
